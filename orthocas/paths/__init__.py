"""Tool paths to joint motions, and charts along paths of postures."""

from orthocas.paths.chart_along import chart_along, corridor_problem
from orthocas.paths.follow import follow
from orthocas.paths.joint_motion import JointMotion, Margins, read_joints

__all__ = ["JointMotion", "Margins", "chart_along", "corridor_problem", "follow", "read_joints"]
