"""Parts of a box outside the domain, and endless joints, for proofs."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from orthocas.bases.family import LinearFamily
from orthocas.bases.mlp import MLPFamily
from orthocas.certificates.box_checks import (
    NEVER,
    BoxResults,
    EliminationCheck,
    RegularCheck,
    find_most_influential,
    find_singular_vectors,
    is_orthogonal,
    multiply_between,
)
from orthocas.certificates.determinant import CofactorCheck, Determinant
from orthocas.certificates.rows import (
    ChartRows,
    GraphRows,
    TipRows,
    build_closed_form,
    build_joint_models,
    build_task_rows,
    build_true_gradients,
)
from orthocas.certificates.taylor import UP, TaylorModel, Variables
from orthocas.charts.certificate import COFACTORS, ELIMINATION
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.errors import CertifyError
from orthocas.tasks.domains import PathBound, SingularBound
from orthocas.tools.batch import dense_function, one_blas_thread
from orthocas.tools.checks import Array
from orthocas.tools.expressions import Tape, evaluate_tape, find_gradient_dependences, write_tape


@dataclass(frozen=True, slots=True)
class OutsideRules:
    """Margins of proofs that boxes lie outside a domain, and when to try these proofs."""

    rounding: float = 1e-6  #: margin of distances, far above floating-point errors
    #: margin of squares, far above the error of singular vectors that are orthogonal up to 1e-9, and rounding of D
    lengths: float = 1e-7
    #: typical change of a singular value over a box, per half-width
    steep: float = 0.08
    thin: float = 0.25  #: boxes narrower than this fraction of the widest joint are thin
    #: margin relative to |J|^2, above the error of floating-point elimination, so that domain checks agree
    guards: float = 1e-12


RULES = OutsideRules()


def choose_check(chart: Chart, rows: ChartRows, bound: float, method: str | None = None) -> RegularCheck:
    """The check of a chart on the whole box, or on the part of it that is not proved to lie outside the domain.

    Args:
        chart: the chart.
        rows: its rows.
        bound: bound of the conditioning.
        method: method of the proofs inside. Default: the fastest.

    Raises:
        CertifyError: if the chart has no such method, or if a joint is unbounded and a proof for its half-width does
            not hold at all its positions. The latter includes unbounded joints whose distance to the path of a corridor
            is counted.
    """
    domain = chart.problem.domain
    domain.require_bounds("proof")
    require_all_positions(chart, rows.variables)
    check, path, singular = choose_inside_check(chart, rows, bound, method), domain.path_bound, domain.singular_bound
    if path is not None:
        # A full turn of an unbounded counted joint may lead from far to near the path.
        for joint in {*path.unbounded} & {*path.counted.tolist()}:
            name = chart.problem.robot.joint_names[joint]
            raise CertifyError(f"joint '{name}' is unbounded, expected an infinite radius for it in the corridor")
        start = path.postures[path.contains(path.postures)][:1]
        return CorridorCheck(check, path, float(check(start, start).sign[0]))
    if singular is None:
        return check
    own, variables = _choose_rows(chart, singular)
    require_all_positions(chart, variables)
    # Take the sign from these rows, because their scales differ from the chart's.
    sign = float(check(domain.home[None], domain.home[None]).sign[0])
    return OutsideCheck(check, own, singular, sign, tuple(sorted(variables)), domain.room_to_fold is not None)


def choose_inside_check(chart: Chart, rows: ChartRows, bound: float, method: str | None = None) -> RegularCheck:
    """The check of boxes inside the domain; see `choose_check`."""
    determinant = Determinant.build(chart) if bound == 0 and method != ELIMINATION else None
    if determinant is not None:
        return CofactorCheck(determinant)
    if method == COFACTORS:
        raise CertifyError("the chart's determinant has no expansion, so this method cannot certify it")
    return EliminationCheck(rows, bound)


def _choose_rows(chart: Chart, domain: SingularBound) -> tuple[GraphRows, set[int]]:
    """The rows whose singular values `domain.is_clear` bounds, and the joints that they depend on.

    The rows of a whole position or a whole orientation may be rotated if they have the same scale, because a rotation
    preserves singular values. In the axes of a body of the arm they depend on fewer joints.
    """
    task, joints = chart.problem.task, range(chart.n)
    tip = TipRows.build(task)
    # Rotated rows can be used if the scale is the same for all axes.
    if tip is not None and tip.axis is None and len(domain.scale) % 3 == 0:
        own_axes = domain.jacobian_function is task.frame_jacobian_function or not tip.rotation
        if own_axes and (domain.scale[::3] == domain.scale.reshape(-1, 3).T).all():
            return build_task_rows(task, chart.problem.domain, joints)
    if domain.jacobian_function is not task.jacobian_function:
        return build_closed_form(domain.jacobian_function, joints)
    return build_true_gradients(task, joints)


def require_all_positions(chart: Chart, variables: Collection[int]) -> None:
    """Raise CertifyError unless a proof for the half-widths of unbounded joints holds for all their positions.

    It holds for a joint that is not a variable of the proof. It also holds for a revolute joint whose half-width is at
    least half a turn, if J is the same after a full turn. This is determined from the operations of h and of xi, not
    from statements of the file. The joints of a torus are unbounded.
    """
    problem = chart.problem
    # Unbounded joints that the proof depends on must be periodic.
    endless = np.flatnonzero(np.isinf(problem.domain.bounds[1])).tolist()
    endless_variables = [joint for joint in endless if joint in variables]
    if not endless_variables:
        return
    coordinates = chart.coordinates
    # `build_chart_rows` has refused other types.
    assert isinstance(coordinates, Coordinates)
    # A full turn must change neither J_x nor J_xi.
    alike = _find_unchanged(write_tape(problem.task.smooth_function), chart.n)
    if len(coordinates.offset):
        alike &= {*coordinates.idle, *(coordinates.active[i] for i in _find_periodic_inputs(coordinates))}
    for joint in endless_variables:
        name = problem.robot.joint_names[joint]
        if problem.robot.tree.prismatic[joint] or problem.domain.half_width[joint] < np.pi:
            raise CertifyError(
                f"joint '{name}' is unbounded and J depends on it, expected bounds, or a half-width of pi"
            )
        if joint not in alike:
            raise CertifyError(
                f"joint '{name}' is unbounded and J is not periodic in it, expected bounds, or a task and coordinates "
                "that are periodic (Fourier terms, networks of sines and cosines, or a linear term in this joint only)"
            )


def _find_periodic_inputs(coordinates: Coordinates) -> set[int]:
    """Indices among the active joints of those whose full turns do not change J_xi."""
    family, n = coordinates.family, len(coordinates.active)
    # Networks are periodic in the joints that enter as sines and cosines.
    if isinstance(family, MLPFamily):
        return {*range(n)} - {*family.direct}
    q = ca.SX.sym("q", n)
    # Check each function of a basis by itself.
    if isinstance(family, LinearFamily):
        values = family.basis(q)
    else:
        values = family.expression(q, ca.SX(ca.DM(coordinates.theta)))
    return _find_unchanged(write_tape(dense_function("values", [q], [values])), n)


def _find_unchanged(tape: Tape, n: int) -> set[int]:
    """The joints that may make full turns without changing a gradient."""
    needed = {k for row in find_gradient_dependences(tape) for joints in row.values() for k in joints}
    return {k for k in range(n) if k not in needed} | find_periodic_joints(tape, n)


def find_periodic_joints(tape: Tape, n: int) -> frozenset[int]:
    """The joints k of n for which h(q + 2 pi e_k) - h(q) is the same constant at every q, for all outputs h."""
    nothing, unit = np.zeros(n), np.eye(n)

    def leaf(name: str, of: Any) -> _Shift:
        return _Shift(nothing, float(of)) if name == "const" else _Shift(unit[of])

    # Only integers of moderate size are added and multiplied, which is exact.
    def step(name: str, of: Sequence[_Shift]) -> _Shift:
        shifts = [each.turn for each in of]
        if name in _EXACT:
            return _Shift(_keep_whole(_EXACT[name](*shifts)))
        for one, other in ((of[0], of[-1]), (of[-1], of[0])):
            if name == "mul" and one.constant is not None:
                return _Shift(_keep_whole(np.where(other.turn == 0, 0.0, other.turn * one.constant)))
        # Other functions are unchanged if their operands are. Periodic ones are also unchanged after full turns of an
        # operand.
        still = np.all([shift == 0 for shift in shifts], axis=0)
        if name in ("sin", "cos", "tan"):
            still = ~np.isnan(shifts[0])
        return _Shift(np.where(still, 0.0, np.nan))

    shifts = evaluate_tape(tape, leaf, step)
    alike = np.all([~np.isnan(each.turn) for each in shifts], axis=0)
    return frozenset(np.flatnonzero(alike).tolist())


class _Shift(NamedTuple):
    """The effect of full turns on a value."""

    turn: Any  #: change by a turn of each joint / 2 pi; NaN if it is not a constant
    constant: float | None = None  #: the value itself, if it is a number


_EXACT: Mapping[str, Callable[..., Any]] = {
    "assign": lambda a: a,
    "neg": lambda a: -a,
    "twice": lambda a: 2 * a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
}


def _keep_whole(shift: Any) -> Any:
    return np.where((shift == np.round(shift)) & (np.abs(shift) < 2.0**40), shift, np.nan)


@dataclass(frozen=True, eq=False, repr=False)
class OutsideCheck:
    """Marks boxes that lie outside a ClearBox, with s(q) <= bound on the whole box, as proved without a sign.

    s(q) <= |v^T D^-1 J(q)| for all |v| >= 1, with the rows J of that ClearBox. Here v(q) starts from the singular
    vector of the smallest singular value at the centre of the box. Multiples of the other singular vectors, linear in
    q, are added to it, so that they cancel the first-order change of v^T D^-1 J along them.

    Another check evaluates the other boxes. Their det J must have the sign of the centre of the domain. A box with the
    other sign is halved until its parts lie outside or a fold is found. If the domain itself excludes folds, a box with
    the other sign is left open without halving, and its sign does not count as a fold of the chart.
    """

    inside: RegularCheck
    rows: GraphRows  #: J, the bounded rows, or C(q) J with orthogonal C if all entries of D are equal
    domain: SingularBound
    sign: float  #: sign of det J at the centre of the domain
    variables: Variables
    guarded: bool = False  #: whether the domain itself excludes folds

    @property
    def method(self) -> str:
        """Name of the method of the inner check."""
        return self.inside.method

    @property
    def joints(self) -> Variables:
        """The joints that J or the bound depends on."""
        return tuple(sorted({*self.inside.joints, *self.variables}))

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        inside = self.inside(low, high)
        own = inside.proved & (inside.sign == self.sign)
        # Compute singular values at the centres of boxes without a proof.
        values = np.full(len(low), np.inf)
        if not own.all():
            values[~own] = self.domain.singular_values((low + high)[~own] / 2)
        # Try boxes that may lie outside. Other boxes are too large for the value at their centre.
        half = (high - low)[:, list(self.variables)] / 2
        near = np.asarray(self.domain.least_singular_value - values > RULES.steep * half.sum(axis=1))
        # Halve thin boxes with a centre outside in their widest joint, so that a proof becomes likely.
        joints = np.array(self.joints)
        widths = (high - low)[:, joints] / 2
        halved = (high - low)[np.arange(len(low)), np.maximum(inside.widest, 0)] / 2
        thin = (halved < RULES.thin * widths.max(axis=1)) & (inside.widest >= 0)
        thin &= values < self.domain.least_singular_value
        widest = np.where(thin, joints[widths.argmax(axis=1)], inside.widest)
        outside = np.zeros(len(low), dtype=bool)
        if near.any():
            with one_blas_thread():
                outside[near], widest[near] = self.check_outside(low[near], high[near])
        regular, sign = inside.regular & ~outside, np.where(outside, 0, inside.sign)
        # A domain that excludes folds handles boxes with the other sign itself.
        if self.guarded:
            widest[regular & ~own & (values > self.domain.least_singular_value)] = NEVER
            regular, sign = regular & (sign == self.sign), np.where(sign == self.sign, sign, 0)
        return BoxResults(
            proved=own | outside,
            regular=regular,
            sign=sign,
            conditioning=np.where(outside, np.inf, inside.conditioning),
            widest=widest,
        )

    def check_outside(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Whether boxes lie outside, and the joint to halve otherwise."""
        joints = build_joint_models(low, high, self.variables)[0]
        J = self.rows(joints).multiply_by(1 / self.domain.scale[:, None, None])
        # Row v^T J, with its change along the other singular vectors removed.
        left, right = find_singular_vectors(J)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            turned = multiply_between(left, J, right)
            least, linear = turned[-1], slice(1, 1 + len(turned.variables))
            # v = (a_1, ..., a_m-1, 1) in the singular basis, with a_j = -(linear part) / s_j.
            for j in range(len(turned.remainder) - 1):
                part = np.zeros_like(turned.coefficients[:, -1, j])
                part[linear] = -turned.coefficients[linear, -1, j] / turned.centre[j, j]
                away = TaylorModel(turned.variables, part[:, None], np.zeros(part[:1].shape))
                least = least + away * turned[j]
            sizes = least.bound_magnitude()
            squared = (sizes**2).sum(axis=0) * UP
            squared += RULES.guards * (J.bound_magnitude() ** 2).sum(axis=(0, 1))
            influences = (least.compute_gains() * sizes).sum(axis=1)
        # The length of this row is an upper bound of the smallest singular value.
        small = squared <= self.domain.least_singular_value**2 * (1 - RULES.lengths)
        outside: Array = small & is_orthogonal(left) & is_orthogonal(right)
        return outside, find_most_influential(influences.T, least.variables)


@dataclass(frozen=True, eq=False, repr=False)
class CorridorCheck:
    """Marks boxes that are farther from the path than the radius as proved, without a sign.

    A box is farther if the distance of its centre exceeds the radius by more than half its diagonal.

    Another check evaluates the other boxes. Their det J must have the sign of the first posture of the path.
    """

    inside: RegularCheck
    domain: PathBound
    sign: float

    @property
    def method(self) -> str:
        """Name of the method of the inner check."""
        return self.inside.method

    @property
    def joints(self) -> Variables:
        """All joints, because parts may lie outside in each of them."""
        return tuple(range(len(self.domain.centre)))

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        centre, half = (low + high) / 2, (high - low) / 2
        distance: Any = np.sqrt(self.domain.squared_distance(centre))
        outside = distance > 1 + RULES.rounding + self.domain.lengths(half)
        inside = self.inside(low, high)
        return BoxResults(
            proved=(inside.proved & (inside.sign == self.sign)) | outside,
            # Only signs at centres in the corridor count.
            regular=inside.regular & (distance <= 1),
            sign=np.where(outside, 0, inside.sign),
            conditioning=np.where(outside, np.inf, inside.conditioning),
            widest=inside.widest,
        )
