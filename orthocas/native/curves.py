"""Numbers of the search for self-motion curves in C, `runtime/self_motion.c`."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CurveRules:
    """Numbers of the search for curves. Chosen on panda and xarm7, held on others (benchmarks/arm.py).

    Errors of x are in radians; those of lengths are divided by the length that a radian moves the tip. Distances and
    lengths along curves are in joint positions, [rad] or [m].
    """

    starts: int = 128  #: number of stored postures from which curves are searched
    patience: int = 96  #: the search ends after this many consecutive starts without a new curve
    reach: int = 25  #: most Newton steps from a start to x
    reached: float = 1e-5  #: error below which a start may count as being at x, because the next step squares it
    arrived: float = 1e-6  #: length of the last step to x; the next one is rounding, even on curves of 1e-4 rad
    far_damping: float = 1e-3  #: damping of steps with an error above 0.1, relative to the trace of J J^T
    near_damping: float = 1e-5  #: the same with an error above 1e-3
    largest: float = 0.7  #: largest norm of a step to x
    bridges: int = 6  #: points on a curve that are tested for another curve across a singular position
    narrow: float = 0.2  #: least singular value of the scaled J below which such a point gives two starts
    across: float = 5.0  #: distance of these starts from the curve, over that singular value
    known: float = 0.02  #: distance from the cubic of a step within which a point may lie on the curve
    resolved: float = 0.2  #: the same, in lengths of the step
    sure: float = 0.05  #: fraction of that distance within which the point is on the curve without a further check
    step: float = 0.4  #: longest step along a curve
    shortest: float = 1e-6  #: a curve that needs shorter steps ends, at a singular position
    aim: float = 0.02  #: size of the first correction of a step for which its length is chosen
    tight: float = 0.1  #: the same, in lengths of the step
    missed: float = 0.08  #: largest correction of a step
    loose: float = 0.25  #: the same, in lengths of the step
    corrected: float = 3e-4  #: a step is done after a correction below this, because the next one would be about 1e-7
    exact: float = 2.5e-3  #: the same, in lengths of the step
    corrections: int = 6  #: most corrections of a step
    turned: float = 0.94  #: least cosine between the tangents at both ends of a step
    straight: float = 0.985  #: cosine from which the next step may be longer
    prismatic: float = 1.0  #: a curve ends where a sliding joint is outside its range by this many widths of it
    curves: int = 64  #: most curves of a task value
    graze: float = 2e-3  #: if a joint turns back this close to a limit, its step is divided there
    halvings: int = 4  #: most divisions of a step for that reason, one within another
    nodes: int = 8000  #: most points on all curves of a task value
    crossings: int = 4000  #: most crossings of limits
    spacing: float = 0.05  #: distance of the samples on a curve among which the best posture is searched
    samples: int = 20_000  #: most samples of a curve
    candidates: int = 12  #: number of the best samples from which the best posture is searched
    nearly: float = 2e-3  #: distance from limits within which a point of a cubic does not count as inside
    rounded: float = 1e-11  #: distance beyond limits up to which exact points count as inside
    narrowed: float = 1e-11  #: accuracy of the position of the best posture along its curve
    piece: int = 8  #: rows that a thread takes at once
    rounds: int = 60  #: most rounds of the search for the best posture


RULES = CurveRules()
