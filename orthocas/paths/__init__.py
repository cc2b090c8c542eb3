"""Tool paths to joint motions."""

from orthocas.paths.follow import follow
from orthocas.paths.joint_motion import JointMotion, Margins

__all__ = ["JointMotion", "Margins", "follow"]
