"""The whole arm: every posture of a task value on all branches, and trackers that are never lost.

`arm.Arm` holds a robot, a task with r = 1, and charts of its branches. `kernel` finds the self-motion curves of a task
value, in compiled C or, without a compiler, in NumPy; `self_motion` cuts them at joint limits and answers questions about
them. `tracker` follows a stream of targets anywhere, `targets` reads task values as people hold them.
"""

from orthocas.arms.arm import Arm, Postures
from orthocas.arms.self_motion import Arc, SelfMotions
from orthocas.arms.tracker import ArmTracker, TrackStatus

__all__ = ["Arc", "Arm", "ArmTracker", "Postures", "SelfMotions", "TrackStatus"]
