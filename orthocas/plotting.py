"""All figures in one place: quality and self-motion of charts, fronts of comparisons, runs of controllers."""

from orthocas.charts.figures import quality_figure, self_motion_figure
from orthocas.fitting.comparison_figures import convergence_figure, front_figure
from orthocas.simulation.figure import trajectory_figure

__all__ = ["convergence_figure", "front_figure", "quality_figure", "self_motion_figure", "trajectory_figure"]
