"""[AS2023] Fig. 22: interleaved steps in x and xi1 with PD+ and linear coordinates, where leaves have low curvature.

Arm, base, gains and steps are defined in `planar_loop.py`. Fig. 23 uses the same with fitted
coordinates.
"""

from .closed_loop_picture import interleaved
from .drawing import Drawing
from .planar_loop import GENTLE, Arm


def draw(quick: bool) -> Drawing:
    """Draw coordinates over time, their plane, and joints; the numbers are the coupling."""
    return interleaved(Arm().linear("x", GENTLE), quick)
