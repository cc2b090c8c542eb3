"""Figures that notebooks show inline, whatever backend matplotlib has."""

import io

from matplotlib.figure import Figure


class Picture(Figure):
    """A matplotlib figure that shows itself in a notebook. It needs no pyplot."""

    def _repr_png_(self) -> bytes:
        """The picture as PNG."""
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=120)
        return file.getvalue()
