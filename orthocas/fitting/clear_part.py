"""The part of a domain that would stay clear of the near-singular positions where a chart fails (ours)."""

from dataclasses import dataclass

import numpy as np

from orthocas.domains import Box
from orthocas.errors import DomainError
from orthocas.postures.clear_box import ClearBox
from orthocas.postures.corridor import Corridor
from orthocas.problem import Problem, ProblemCheck
from orthocas.worst_points import WorstPoints

_STEP = 0.05  # of the bounds that are offered
_FAILS = 0.05  # conditioning below which a chart is of no use; folds have less than 0
_MOST = 0.9  # share of such points that a bound should leave out
_LARGEST = 0.25  # bound; charts that fail at larger singular values have other reasons
_ANY = 1e-12  # bound of a ClearBox that only measures


@dataclass(frozen=True)
class ClearPart:
    """A bound on the relative singular value of the task that leaves out near-singular positions where charts fail."""

    least_singular_value: float
    share: float  #: of the box that is left

    @property
    def told(self) -> str:
        """The offer in words."""
        return f"least singular value {self.least_singular_value:g} stays clear, on {self.share:.1%} of the box"


def clear_part(problem: Problem, check: ProblemCheck, worst: WorstPoints | None) -> ClearPart | None:
    """What to offer after a fit: a bound if the domain touches near-singular positions, or if charts fail near them.

    The bound leaves out nine in ten of the points with a conditioning below 0.05 that the fit's search found.

    Returns:
        The offer; None if nothing is wrong, if charts fail elsewhere too, or if the centre itself would be left out.
    """
    domain = problem.domain
    failed = np.zeros((0, problem.n)) if worst is None else worst.below(_FAILS)
    if not isinstance(domain, Box) or isinstance(domain, Corridor) or not (len(failed) or check.singular_samples):
        return None
    try:
        measured = domain if isinstance(domain, ClearBox) else ClearBox(domain, problem.task, _ANY)
        values = measured.singular_values(failed)
        wanted = float(np.quantile(values, _MOST)) if len(failed) else 0.0
        if not wanted <= _LARGEST:
            return None
        bound = round(_STEP * (1 + wanted // _STEP), 2)
        return ClearPart(bound, ClearBox(domain, problem.task, bound, measured.scale, measured.rows).share)
    except DomainError:  # the centre is not clear
        return None
