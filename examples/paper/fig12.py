"""[AS2023] Fig. 12: following the gradient flow of the task x of the planar arm with two joints, A = I."""

from .drawing import Drawing
from .flow_picture import draw_flow


def draw(quick: bool) -> Drawing:
    """Draw both panels; the numbers tell where flow lines end and how exactly pulled points lie on the base leaf."""
    return draw_flow("euclidean", quick)
