"""[AS2023] Fig. 23: the interleaved steps of Fig. 22 with fitted coordinates."""

from .chosen_fit import USUAL, ChosenFit
from .closed_loop_picture import interleaved
from .drawing import Drawing
from .planar_loop import GENTLE, Arm


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw the panels of Fig. 22; the numbers show that nothing couples."""
    return interleaved(Arm().fitted("x", GENTLE, quick, chosen), quick)
