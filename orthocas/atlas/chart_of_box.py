"""From numbers in an atlas to boxes and charts as the rest of orthocas knows them."""

from collections.abc import Sequence
from functools import reduce

import numpy as np

from orthocas.atlas.lattice import Cell
from orthocas.atlas.plan import Plan, is_turning
from orthocas.bases.family import JointSpace
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import DomainError
from orthocas.tasks.clear_box import ClearBox
from orthocas.tasks.domains import Box, Domain
from orthocas.tasks.problem import Problem, problem_from_data, problem_to_data
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array
from orthocas.tools.json import plain

STEP = 0.6  # [rad]


def box_of(plan: Plan, cell: Cell) -> Box:
    """The box of a cell: it reaches into its neighbours by the overlap, perhaps beyond joint limits.

    Of images of a box, only the one that is fitted may lie there.
    """
    low, high = cell.bounds_of(plan.lattice)
    return plan.box_around(*widened(plan, low, high))


def widened(plan: Plan, low: Array, high: Array) -> tuple[Array, Array]:
    """Boundaries of boxes for those of cells, (k,) or (cells, k)."""
    room = plan.settings.overlap * (high - low) / 2
    return low - room, high + room


def clipped(plan: Plan, low: Array, high: Array) -> Box:
    """The part of a box within the joint limits.

    Raises:
        DomainError: if there is none, as for images of boxes near limits that the symmetry does not keep.
    """
    joints = list(plan.joints)
    robot = plan.problem.robot
    low, high = np.maximum(low, robot.lower[joints]), np.minimum(high, robot.upper[joints])
    beyond = np.flatnonzero(low >= high)
    if beyond.size:
        name = robot.joint_names[joints[int(beyond[0])]]
        raise DomainError(
            f"the box of the chart lies beyond the limits of joint '{name}', expected one that chart_at finds"
        )
    return plan.box_around(low, high)


def part_near(plan: Plan, box: Box, steps: Sequence[int]) -> Box:
    """The part of a box where cyclic joints lie within 1.2 rad of so many steps of 0.6 rad from its middle.

    There, a reference orientation in the middle is less than half a turn away.
    """
    cyclic = list(plan.cyclic)
    middle = box.centre[cyclic] + STEP * np.array(steps)
    low = np.maximum(middle - 2 * STEP, (box.centre - box.half_width)[cyclic])
    high = np.minimum(middle + 2 * STEP, (box.centre + box.half_width)[cyclic])
    centre, half_width = box.centre.copy(), box.half_width.copy()
    centre[cyclic], half_width[cyclic] = (low + high) / 2, (high - low) / 2
    return Box(centre, half_width, [i for i in box.unbounded if i not in cyclic])


def steps_to(plan: Plan, q: Array) -> tuple[int, ...]:
    """Steps of 0.6 rad from the middle of cyclic joints that come nearest to a position (n,)."""
    cyclic = list(plan.cyclic)
    return tuple(np.round((q - plan.problem.domain.centre)[cyclic] / STEP).astype(int).tolist())


def chart_of(plan: Plan, box: Box, numbers: Array, clear: float, problem: Problem) -> Chart:
    """The chart of a box from its numbers on the cube (fitted, 1 + K).

    Args:
        plan: plan of the atlas.
        box: the box.
        numbers: constants and coefficients.
        clear: share of its samples that are clear of singular positions. If it is not 1, or the task compares
            orientations, the domain is a ClearBox.
        problem: that of the plan, or `without_limits` of it for a box beyond them.
    """
    base = problem
    domain: Domain = box
    if clear < 1 or is_turning(base.task):
        domain = clear_part(box, base.task, plan)
    problem = Problem(base.robot, base.task, base.metric, domain, base.name)
    parametrisation = Polynomial(plan.settings.degree, plan.cyclic_names)
    r = plan.fitted
    coordinates = Coordinates(
        parametrisation, JointSpace.of(problem), plan.idle, numbers[:, 1:].ravel(), -numbers[:, 0], np.ones(r)
    )
    return Chart(problem, coordinates)


def clear_part(box: Box, task: Task, plan: Plan) -> ClearBox:
    """What the atlas covers of a box. It ends before x does, half a turn away from the reference."""
    return ClearBox(box, task, plan.settings.least_singular_value, plan.scale, rows="x")


def without_limits(problem: Problem) -> Problem:
    """The same problem for an arm without joint limits."""
    header, arrays = problem_to_data(problem)
    free = {name: np.full(problem.n, side * np.inf) for name, side in (("robot_lower", -1), ("robot_upper", 1))}
    return problem_from_data(plain(header), {**arrays, **free})


def moved(numbers: Array, terms: Array, shift: Array, scale: Array) -> Array:
    """Numbers of the same functions on another box: u of the first is shift + scale u of the second, (n,) each.

    A polynomial of degree d on one box is one of degree d on any other, so nothing changes but rounding.
    """
    degree, n = int(terms.max()), terms.shape[1]
    tensor = np.zeros((len(numbers), *(degree + 1,) * n))
    tensor[(slice(None), *np.zeros(n, dtype=int))] = numbers[:, 0]
    tensor[(slice(None), *terms.T)] = numbers[:, 1:]
    tables = [_table(degree, a, b) for a, b in zip(shift, scale, strict=True)]
    tensor = reduce(lambda T, i: np.moveaxis(np.tensordot(T, tables[i], (1 + i, 0)), -1, 1 + i), range(n), tensor)
    return np.column_stack([tensor[(slice(None), *np.zeros(n, dtype=int))], tensor[(slice(None), *terms.T)]])


def _table(degree: int, a: float, b: float) -> Array:
    """M with p_k(a + b v) = sum_l M[k, l] p_l(v), where p_k = sqrt(2 k + 1) P_k: exact Gauss quadrature."""
    v, weights = np.polynomial.legendre.leggauss(degree + 1)
    sizes = np.sqrt(2 * np.arange(degree + 1) + 1)
    here = np.polynomial.legendre.legvander(v, degree) * sizes
    there = np.polynomial.legendre.legvander(a + b * v, degree) * sizes
    return np.asarray((there * weights[:, None]).T @ here / 2)
