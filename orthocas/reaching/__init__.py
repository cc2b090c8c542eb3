"""What can be reached at a task value: ranges of the extra coordinates, and self-motions."""

from orthocas.reaching.intervals import Interval, XiRange
from orthocas.reaching.self_motion import SelfMotion, SelfMotionCurve
from orthocas.reaching.stops import Stop, StopKind

__all__ = ["Interval", "SelfMotion", "SelfMotionCurve", "Stop", "StopKind", "XiRange"]
