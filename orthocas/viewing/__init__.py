"""Charts, robots and motions in the browser. Only what opens a page needs the extra `[view]`."""

from orthocas.viewing.comparison import cyclic_motions
from orthocas.viewing.motion import Motion
from orthocas.viewing.view import View, export_page, view

__all__ = ["Motion", "View", "cyclic_motions", "export_page", "view"]
