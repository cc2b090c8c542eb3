"""The whole arm: every posture of a task value on all branches, and trackers that are never lost.

`arm.Arm` holds a task with r = 1 and charts of branches. `kernel` finds the self-motion curves of a task value, in
compiled C, from stored postures. `self_motion` cuts them at joint limits, and answers questions about them.
`chart_kernel` compiles the search for postures with x and xi, and the tracker, which `tracker` calls. `maps` holds
the data of robot and task that all of these need, and reads task values in all accepted forms.
"""

from orthocas.arms.arm import Arm, Postures
from orthocas.arms.self_motion import Arc, Gap, Merge, Place, SelfMotions
from orthocas.arms.tracker import ArmTracker, TrackStatus

__all__ = ["Arc", "Arm", "ArmTracker", "Gap", "Merge", "Place", "Postures", "SelfMotions", "TrackStatus"]
