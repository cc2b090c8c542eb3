"""[AS2023] Fig. 22: interleaved steps in x and xi1 with linear coordinates where leaves are little curved, PD+.

Arm, base, gains and steps stand in `orthocas.reproduce.planar_loop`; Fig. 23 takes the same with fitted coordinates.
"""

from orthocas.reproduce.closed_loop_picture import interleaved
from orthocas.reproduce.drawing import Drawing
from orthocas.reproduce.planar_loop import GENTLE, Arm


def draw(quick: bool) -> Drawing:
    """Coordinates over time, their plane, and joints; numbers tell the coupling."""
    return interleaved(Arm().linear("x", GENTLE), quick)
