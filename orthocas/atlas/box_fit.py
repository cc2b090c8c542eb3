"""Fits and judges the chart of one box, with a basis that all boxes share."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.atlas.lattice import Cell
from orthocas.atlas.plan import Plan, is_turning
from orthocas.bases.family import JointSpace
from orthocas.bases.products import Polynomial, ProductFamily
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import DomainError
from orthocas.fitting.basis_gradients import BoxGradients, ProductGradients
from orthocas.fitting.basis_objective import BasisObjective
from orthocas.fitting.probe import leak_and_conditioning
from orthocas.fitting.terms import Weights
from orthocas.solvers.gauss_newton import GaussNewton
from orthocas.solvers.protocol import Status
from orthocas.tasks.clear_box import ClearBox
from orthocas.tasks.domains import Box, Domain, sample_evenly, sample_heavily, sample_uniform
from orthocas.tasks.metric import metric_matrices
from orthocas.tasks.problem import Problem, problem_from_data, problem_to_data, task_jacobians
from orthocas.tasks.samples import Samples, samples_at
from orthocas.tasks.task import Task
from orthocas.tools.batch import one_blas_thread
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import BlockFunction, ColumnFunction, fill
from orthocas.tools.interrupts import deferred
from orthocas.tools.json import plain

STEP = 0.6  # [rad]
_EVEN, _HEAVY = 384, 128  # training samples, and those of them near faces and corners
_UNIFORM, _JUDGES = 600, 300  # held-out samples, and those near faces and corners
_FRAME_SAMPLES, _SEED = 500, 0
_WEIGHTS = Weights(angles="metric")  # what is asked of charts is their leak
_SOLVER = GaussNewton(max_iterations=25, tolerance=1e-2)
Mask = NDArray[np.bool_]


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


@dataclass(frozen=True, eq=False)
class CubeBasis:
    """psi(u) on the cube. Compiled once, it serves all boxes: dpsi/dq_i = dpsi/du_i / half_width_i."""

    degree: int
    names: tuple[str, ...]  #: of the joints
    cyclic: tuple[str, ...]  #: names of joints with a linear term only
    outputs: int

    @cached_property
    def family(self) -> ProductFamily:
        """The family of polynomials on the cube."""
        n = len(self.names)
        space = JointSpace(np.zeros(n), np.ones(n), (False,) * n, self.names)
        return Polynomial(self.degree, self.cyclic).family(space, self.outputs)

    @property
    def width(self) -> int:
        """Number of terms K."""
        return self.family.width

    @cached_property
    def gradients(self) -> ProductGradients:
        """dpsi/du."""
        return ProductGradients(self.family, len(self.names))

    def values(self, u: Array) -> Array:
        """psi(u), (N, K), at points (N, n)."""
        results = np.empty((len(u), self.width))
        fill(results, u, self._make_values)
        return results

    def slopes(self, u: Array) -> Array:
        """dpsi/du, (N, n, K), at points (N, n)."""
        return self.gradients.dense(self.gradients.at(u), len(u))

    @cached_property
    def exponents(self) -> Array:
        """Degree of every term in every joint, (K, n)."""
        return np.array(self.family.terms, dtype=float)

    @cached_property
    def linear_terms(self) -> list[int]:
        """Places of the terms sqrt(3) u_i, (n,)."""
        n = len(self.names)
        return [self.family.terms.index(tuple(int(i == k) for i in range(n))) for k in range(n)]

    @cached_property
    def _columns(self) -> ColumnFunction:
        u = ca.SX.sym("u", len(self.names))
        return ColumnFunction(ca.Function("cube_basis", [u], [ca.densify(self.family.basis(u))]))

    def _make_values(self) -> BlockFunction:
        run = self._columns.on_one_block()
        return lambda columns: run(columns)[0]


@dataclass(frozen=True, eq=False)
class BoxChart:
    """Coordinates of one box and their quality at held-out samples of it."""

    numbers: Array  #: (fitted, 1 + K): xi_j = numbers[j, 0] + sum_k numbers[j, 1 + k] psi_k(u)
    leak_deg: float  #: root mean square over uniform samples and coordinates
    conditioning: float  #: least of all samples; negative if the chart folds
    excess: Array  #: how much each sample misses what is asked, (tests,)
    u: Array  #: these samples, (tests, n)


class BoxFitter:
    """Fits charts of boxes. The basis and its gradients at the training samples are computed once for all boxes."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        names = tuple(plan.problem.robot.joint_names[i] for i in plan.active)
        self.basis = CubeBasis(plan.settings.degree, names, plan.cyclic_names, plan.fitted)
        cube = Box(np.zeros(len(names)), 1.0)
        self._training = np.vstack([sample_evenly(cube, _EVEN, _SEED), sample_heavily(cube, _HEAVY, _SEED)])
        self._tests = np.vstack([sample_evenly(cube, _UNIFORM, _SEED + 1), sample_heavily(cube, _JUDGES, _SEED + 1)])
        self._objective: BasisObjective | None = None
        self._uniform = np.arange(len(self._tests)) < _UNIFORM

    def fit(self, box: Box) -> tuple[BoxChart | None, Mask]:
        """The chart of a box, and which of its test samples are clear of singular positions; no chart without any."""
        training, seen = self._samples(box, self._training)
        tests, clear = self._samples(box, self._tests)
        if not clear.any() or seen.sum() < len(seen) / 4:
            return None, clear
        with one_blas_thread(), deferred():
            C = self._coefficients(box, training, self._training if seen.all() else self._training[seen])
            return self._judged(box, C, tests, clear), clear

    @property
    def tests(self) -> Array:
        """The test samples on the cube, (tests, n)."""
        return self._tests

    def clear(self, box: Box) -> Mask:
        """Which test samples are clear of singular positions, (tests,)."""
        return self._samples(box, self._tests)[1]

    def _samples(self, box: Box, u: Array) -> tuple[Samples, Mask]:
        """Samples of the active joints at points of the cube, and which of these are clear of singular positions."""
        plan, active = self.plan, list(self.plan.active)
        q = np.repeat(box.centre[None], len(u), axis=0)
        q[:, active] += box.half_width[active] * u
        J = task_jacobians(plan.local, q)
        scaled = J / plan.scale[:, None]
        squares = np.linalg.eigvalsh(scaled @ scaled.transpose(0, 2, 1))[:, 0]
        clear: Mask = squares > plan.settings.least_singular_value**2
        inverse: Array | None = None
        if not plan.problem.metric.is_identity:
            inverse = np.asarray(np.linalg.inv(metric_matrices(plan.problem.metric, q[clear])), dtype=float)
        return Samples(q[clear], J[clear], inverse).restricted_to(active), clear

    def _coefficients(self, box: Box, samples: Samples, u: Array) -> Array:
        """Coefficients C (fitted, K) of the chart with the least loss near linear coordinates."""
        half_width = box.half_width[list(self.plan.active)]
        gradients = BoxGradients(self.basis.gradients, half_width, self._training, self._known)
        start = self._linear(box)
        at_cube = Samples(u, samples.task_jacobian, samples.metric_inverse)
        objective = self._objective
        if objective is None:  # the first box builds the loss, others move it
            family = self.basis.family
            objective = self._objective = BasisObjective(
                family, at_cube, _WEIGHTS, start.ravel(), lambda count, seed: at_cube, gradients=gradients
            )
        result = _SOLVER.minimise(objective.moved(gradients, at_cube, start.ravel()), start.ravel())
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return np.asarray(result.theta.reshape(start.shape))

    def _linear(self, box: Box) -> Array:
        """Coefficients of linear coordinates that are exact at the centre; of all such, those nearest to the frame."""
        active = list(self.plan.active)
        here = samples_at(self.plan.local, box.centre[None]).restricted_to(active)
        Z = here.null_basis[0]
        covectors = Z if here.metric_inverse is None else np.linalg.solve(here.metric_inverse[0], Z)
        left, _, right = np.linalg.svd(covectors.T @ self._frame)
        C = np.zeros((self.plan.fitted, self.basis.width))
        C[:, self.basis.linear_terms] = (covectors @ (left @ right)).T * box.half_width[active] / np.sqrt(3)
        return C

    def _judged(self, box: Box, C: Array, tests: Samples, clear: Mask) -> BoxChart:
        half_width = box.half_width[list(self.plan.active)]
        G = self._test_slopes[clear] / half_width[:, None]
        J = (G @ C.T).transpose(0, 2, 1)
        C = C / np.linalg.norm(J, axis=2).mean(axis=0)[:, None]
        leaks, conditioning = leak_and_conditioning(tests, J)
        uniform = self._uniform[clear]
        squares = leaks[uniform] ** 2 if uniform.any() else leaks**2
        asked = self.plan.settings
        excess = (leaks**2).mean(axis=1) / np.radians(asked.leak_deg) ** 2 + (
            asked.conditioning / np.maximum(conditioning, asked.conditioning / 3)
        ) ** 2
        constant = -(self._psi_at_centre @ C.T)
        return BoxChart(
            np.column_stack([constant, C]),
            float(np.degrees(np.sqrt(squares.mean()))),
            float(conditioning.min()),
            excess,
            self._tests[clear],
        )

    @cached_property
    def free(self) -> Problem:
        """The problem without joint limits, which boxes may leave whose images lie within."""
        return without_limits(self.plan.problem)

    @cached_property
    def _known(self) -> Array:
        return self.basis.gradients.at(self._training)

    @cached_property
    def _test_slopes(self) -> Array:
        return self.basis.slopes(self._tests)

    @cached_property
    def _psi_at_centre(self) -> Array:
        return np.asarray(self.basis.values(np.zeros((1, len(self.plan.active))))[0])

    @cached_property
    def _frame(self) -> Array:
        """The r covectors that are most nearly orthogonal to the task all over the region, (n, fitted)."""
        plan, active = self.plan, list(self.plan.active)
        points = sample_uniform(plan.problem.domain, _FRAME_SAMPLES, _SEED)
        Z = samples_at(plan.local, points).restricted_to(active).null_basis
        mean = (Z @ Z.transpose(0, 2, 1)).mean(axis=0)
        return np.asarray(np.linalg.eigh(mean)[1][:, -plan.fitted :])
