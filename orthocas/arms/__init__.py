"""The whole arm: every posture of a task value on all branches, and trackers that are never lost.

`arm.Arm` holds a task with r = 1 and charts of branches. `kernel` finds the self-motion curves of a task value, in
compiled C, or `numpy_kernel` without a compiler, from postures of `stored`. `self_motion` cuts them at joint limits,
and answers questions about them. `tracker` follows a stream of targets anywhere. `targets` reads task values as people
hold them, and `maps` holds what all of these need of the robot.
"""

from orthocas.arms.arm import Arm, Postures
from orthocas.arms.numpy_tracker import TrackStatus
from orthocas.arms.self_motion import Arc, Place, SelfMotions
from orthocas.arms.tracker import ArmTracker

__all__ = ["Arc", "Arm", "ArmTracker", "Place", "Postures", "SelfMotions", "TrackStatus"]
