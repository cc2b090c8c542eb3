"""Numbers of the search along self-motion curves in C, `runtime/self_motion.c`."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CurveRules:
    """Numbers of the search for curves. Chosen on panda and xarm7, held on others (benchmarks/arm.py).

    Errors of x are in radians, or as long as a radian moves the tip. Joint positions are in [rad] or [m].
    """

    starts: int = 128  #: stored postures from which curves are sought
    patience: int = 96  #: starts in turn that find no new curve, after which the search ends
    reach: int = 25  #: steps from a start to x
    reached: float = 1e-5  #: error that one more step reduces to its square
    arrived: float = 1e-6  #: length of the last step, after which another one is rounding, also on curves of 1e-4 rad
    far_damping: float = 1e-3  #: of steps with an error above 0.1, relative to the trace of J J^T
    near_damping: float = 1e-5  #: of steps with an error above 1e-3
    largest: float = 0.7  #: norm of a step to x
    bridges: int = 6  #: places on a curve from which another one is sought beyond singular positions beside it
    narrow: float = 0.2  #: least singular value of J, scaled, below which it is
    across: float = 5.0  #: how far, times that value
    known: float = 0.02  #: distance from the cubic of a step up to which a point may lie on the curve
    resolved: float = 0.2  #: the same, in lengths of the step
    sure: float = 0.05  #: the part of that distance up to which it does, without another look
    step: float = 0.4  #: longest step along a curve
    shortest: float = 1e-6  #: a curve that needs shorter ones ends, at a singular position
    aim: float = 0.02  #: first correction of a step that its length is chosen for
    tight: float = 0.1  #: the same, in lengths of the step
    missed: float = 0.08  #: largest correction of a step
    loose: float = 0.25  #: the same, in lengths of the step
    corrected: float = 3e-4  #: correction after which the next one is rounding for most purposes, 1e-7
    exact: float = 2.5e-3  #: the same, in lengths of the step
    corrections: int = 6  #: of a step, at most
    turned: float = 0.94  #: least cosine between the tangents at both ends of a step
    straight: float = 0.985  #: cosine from which the next step may be longer
    prismatic: float = 1.0  #: widths of its range that a sliding joint may leave it by
    curves: int = 64  #: of a task value, at most
    graze: float = 2e-3  #: distance from a limit within which the turn of a joint is looked at closely
    halvings: int = 4  #: of a step, to look closely
    nodes: int = 8000  #: points on all curves of a task value, at most
    crossings: int = 4000  #: of limits, at most
    spacing: float = 0.05  #: of points among which the best posture of a task value is sought
    samples: int = 20_000  #: such points of a curve, at most
    candidates: int = 12  #: of them next to which it is sought
    nearly: float = 2e-3  #: from limits, within which a point of a cubic may be outside
    rounded: float = 1e-11  #: beyond limits, of exact points
    narrowed: float = 1e-11  #: of the place of the best posture
    piece: int = 8  #: rows that a thread takes at once
    rounds: int = 60  #: of the search for it, at most


RULES = CurveRules()
