"""Quantities that are coordinates themselves, on the part of a branch where self-motions change them steadily."""

from dataclasses import dataclass

import numpy as np

from orthocas.bases.family import JointSpace, Parametrisation, require_parametrisation
from orthocas.bases.given import Given
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import DomainError, InvalidValueError
from orthocas.fitting.like import Like, Likeness
from orthocas.fitting.terms import find_least_volume
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_problem
from orthocas.tools.checks import Array, require_kind
from orthocas.tools.display import listed


@dataclass(frozen=True, slots=True)
class ExactRules:
    """Numbers of the choice between a quantity itself and coordinates like it."""

    enough: float = 0.995  #: share of nonsingular positions on which a quantity is regular, to be taken by itself
    samples: int = 2000  #: that tell whether self-motions change a quantity anywhere


RULES = ExactRules()


def choose_quantities(
    problem: Problem, like: Likeness | None, exact: bool | None, parametrisation: Parametrisation | None
) -> tuple[Like | None, bool | None]:
    """The quantities of `like`, or those that a parametrisation without parameters is; and whether xi is to be these.

    Raises:
        InvalidValueError: if arguments contradict each other, or there are more quantities than coordinates.
    """
    if exact is not None:
        require_kind("exact", exact, bool)
    if parametrisation is not None:
        require_parametrisation(parametrisation)
        if parametrisation.closed_form is not None and isinstance(given := parametrisation.for_problem(problem), Given):
            if like is not None or exact is False:
                name = "exact" if like is None else "like"
                raise InvalidValueError(name, f"given with {given.label}", "this left out: xi is what is given")
            given.family(JointSpace.of(problem), problem.r)  # of the right shape
            return Like.of_given(given), True
    if like is None:
        if exact is not None:
            raise InvalidValueError("exact", "given without like", "a quantity, such as like='swivel'")
        return None, None
    if exact and parametrisation is not None:
        raise InvalidValueError("exact", "given with a parametrisation to fit", "one of them")
    quantities = Like.of(problem, like)
    quantities.require_at_most(problem.r)
    return quantities, exact if parametrisation is None else False


def take_exactly(problem: Problem, quantities: Like, exact: bool | None, counted: Array) -> Coordinates | None:
    """Quantities as coordinates, xi = y(q), if they are to be that.

    Coordinates of r quantities are regular where the volume of `RegularPart`, with r = 1 the cosine between gradient
    and self-motion, is above the least one of wide charts, with the sign of the centre of the domain.

    Args:
        problem: the problem, on the clear part of a branch.
        quantities: at most r quantities.
        exact: True to take them on however small a part, False never, None where they are regular nearly everywhere.
        counted: nonsingular positions of the branch, (N, n).

    Returns:
        The coordinates; None if coordinates are to be fitted to the quantities.

    Raises:
        InvalidValueError: with `exact`, if there are fewer quantities than coordinates, or they are not independent.
        DomainError: with `exact`, if they are not regular at the centre.
    """
    count = len(quantities.names)
    if exact is False or (count < problem.r and not exact):
        return None
    if count < problem.r:
        what = f"given with {count} {'quantity' if count == 1 else 'quantities'}"
        raise InvalidValueError("exact", what, f"{problem.r} of them, one for each coordinate; or leave it out")
    coordinates, domain = _build(quantities, problem), problem.domain
    inside = counted[domain.contains(counted)]
    try:
        regular = RegularPart(domain, coordinates, find_least_volume(problem))
    except DomainError:
        if not exact:
            return None
        # that they are nowhere regular is worse
        quantities.project(sample_problem(problem, RULES.samples, RULES.samples))
        turning = f"in the middle of branch '{problem.name}', self-motions do not change {listed(quantities.names)}"
        raise DomainError(f"{turning}: give a smaller box as branch, another branch, or another quantity") from None
    return coordinates if exact or np.mean(regular.contains(inside)) >= RULES.enough else None


def _build(quantities: Like, problem: Problem) -> Coordinates:
    """The quantities themselves: not shifted, and not scaled."""
    r = problem.r
    return Coordinates(quantities.given, JointSpace.of(problem), (), np.zeros(0), np.zeros(r), np.ones(r))
