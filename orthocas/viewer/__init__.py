"""Charts, robots and motions in the browser. Only functions that open a page need the extra `[view]`."""

from orthocas.viewer.motion import Motion, cyclic_motions
from orthocas.viewer.view import View, export_page, view

__all__ = ["Motion", "View", "cyclic_motions", "export_page", "view"]
