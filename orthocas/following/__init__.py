"""Tool paths to joint motions."""

from orthocas.following.follow import follow
from orthocas.following.joint_motion import JointMotion, Margins

__all__ = ["JointMotion", "Margins", "follow"]
