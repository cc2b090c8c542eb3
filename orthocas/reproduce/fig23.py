"""[AS2023] Fig. 23: the interleaved steps of Fig. 22 with fitted coordinates."""

from orthocas.reproduce.chosen_fit import USUAL, ChosenFit
from orthocas.reproduce.closed_loop_picture import interleaved
from orthocas.reproduce.drawing import Drawing
from orthocas.reproduce.planar_loop import GENTLE, Arm


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw the panels of Fig. 22; the numbers show that nothing couples."""
    return interleaved(Arm().fitted("x", GENTLE, quick, chosen), quick)
