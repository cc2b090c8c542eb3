"""All figures in one place: quality and self-motion of charts, fronts of comparisons, runs of controllers."""

from orthocas.comparing.figures import convergence_figure, front_figure
from orthocas.judging.figures import quality_figure, self_motion_figure
from orthocas.simulation.figure import trajectory_figure

__all__ = ["convergence_figure", "front_figure", "quality_figure", "self_motion_figure", "trajectory_figure"]
