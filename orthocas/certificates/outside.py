"""What a proof must know beyond the box: parts of a domain, endless joints."""

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
    """Margins of proofs that boxes lie outside a domain, and when they are tried."""

    rounding: float = 1e-6  #: of distances, far above that of floating-point numbers
    #: of squares: far above what singular vectors miss that are orthogonal up to 1e-9, and roundings of D
    lengths: float = 1e-7
    #: how much a singular value changes over a box, at least in most cases: by so much of its half-widths
    steep: float = 0.08
    thin: float = 0.25  #: of the widest joint: narrower boxes are thin
    guards: float = 1e-12  #: of |J|^2: elimination in floating-point numbers is exact to less, so guards agree


RULES = OutsideRules()


def choose_check(chart: Chart, rows: ChartRows, bound: float, method: str | None = None) -> RegularCheck:
    """The check of a chart: of its whole box or, of a part of it, of what is not proved to lie outside.

    Args:
        chart: the chart.
        rows: its rows.
        bound: of the conditioning.
        method: of the proofs inside. Default: the fastest.

    Raises:
        CertifyError: if there is no such method for the chart; if a joint is unbounded, and a proof for its half-width
            is none for all its positions. In a corridor, an unbounded joint whose distance to the path counts is one of
            these.
    """
    domain = chart.problem.domain
    domain.require_bounds("proof")
    require_all_positions(chart, rows.variables)
    check, path, singular = choose_inside_check(chart, rows, bound, method), domain.path_bound, domain.singular_bound
    if path is not None:
        # After a turn of an unbounded joint that counts, what is far from the path may be near it.
        for joint in {*path.unbounded} & {*path.counted.tolist()}:
            name = chart.problem.robot.joint_names[joint]
            raise CertifyError(f"joint '{name}' is unbounded and counts in the corridor, expected an infinite radius")
        start = path.postures[path.contains(path.postures)][:1]
        return CorridorCheck(check, path, float(check(start, start).sign[0]))
    if singular is None:
        return check
    own, variables = _choose_rows(chart, singular)
    require_all_positions(chart, variables)
    # The sign is that of these rows, which have other scales than the chart's.
    sign = float(check(domain.home[None], domain.home[None]).sign[0])
    return OutsideCheck(check, own, singular, sign, tuple(sorted(variables)), domain.room_to_fold is not None)


def choose_inside_check(chart: Chart, rows: ChartRows, bound: float, method: str | None = None) -> RegularCheck:
    """The check of boxes that lie in the domain; see `choose_check`."""
    determinant = Determinant.build(chart) if bound == 0 and method != ELIMINATION else None
    if determinant is not None:
        return CofactorCheck(determinant)
    if method == COFACTORS:
        raise CertifyError("the chart's determinant has no expansion, so it has no certificate of this method")
    return EliminationCheck(rows, bound)


def _choose_rows(chart: Chart, domain: SingularBound) -> tuple[GraphRows, set[int]]:
    """The rows that check positions, as `domain.is_clear` takes them, and the joints that they depend on.

    Rows of a whole position or a whole orientation may be rotated if they have the same scale: then the rotation
    changes no singular value, and rows in the axes of a body of the arm depend on fewer joints.
    """
    task, joints = chart.problem.task, range(chart.n)
    tip = TipRows.build(task)
    # the rows of the tip serve if the scale does not depend on the axes
    if tip is not None and tip.axis is None and len(domain.scale) % 3 == 0:
        own_axes = domain.jacobian_function is task.frame_jacobian_function or not tip.rotation
        if own_axes and (domain.scale[::3] == domain.scale.reshape(-1, 3).T).all():
            return build_task_rows(task, chart.problem.domain, joints)
    if domain.jacobian_function is not task.jacobian_function:
        return build_closed_form(domain.jacobian_function, joints)
    return build_true_gradients(task, joints)


def require_all_positions(chart: Chart, variables: Collection[int]) -> None:
    """Raise CertifyError unless a proof for the half-widths of unbounded joints is one for all their positions.

    It is one for a joint that is not among the variables of the proof, and for a revolute joint whose half-width is at
    least half a turn, if J is the same after a full turn of it. No word of the file is taken for that: the steps of h
    and of xi are read. The joints of a torus are unbounded.
    """
    problem = chart.problem
    # Joints without bounds on which the proof depends must repeat after a turn.
    endless = np.flatnonzero(np.isinf(problem.domain.bounds[1])).tolist()
    endless_variables = [joint for joint in endless if joint in variables]
    if not endless_variables:
        return
    coordinates = chart.coordinates
    # `build_chart_rows` has refused others.
    assert isinstance(coordinates, Coordinates)
    # A full turn must change neither J_x nor J_xi.
    alike = _find_unchanged(write_tape(problem.task.smooth_function), chart.n)
    if len(coordinates.offset):
        alike &= {*coordinates.idle, *(coordinates.active[i] for i in _find_periodic_inputs(coordinates))}
    for joint in endless_variables:
        name = problem.robot.joint_names[joint]
        if problem.robot.tree.prismatic[joint] or problem.domain.half_width[joint] < np.pi:
            raise CertifyError(f"joint '{name}' is unbounded and J depends on it, expected bounds, or a full turn")
        if joint not in alike:
            raise CertifyError(
                f"joint '{name}' is unbounded and J is not periodic in it, expected bounds, or a task and coordinates "
                "that are (Fourier, networks of sines and cosines, or a linear term only)"
            )


def _find_periodic_inputs(coordinates: Coordinates) -> set[int]:
    """The active joints, by their places among these, whose full turns do not change J_xi."""
    family, n = coordinates.family, len(coordinates.active)
    # Networks take sines and cosines of all joints that they do not take as they are.
    if isinstance(family, MLPFamily):
        return {*range(n)} - {*family.direct}
    q = ca.SX.sym("q", n)
    # Each function of a basis is looked at alone.
    if isinstance(family, LinearFamily):
        values = family.basis(q)
    else:
        values = family.expression(q, ca.SX(ca.DM(coordinates.theta)))
    return _find_unchanged(write_tape(dense_function("values", [q], [values])), n)


def _find_unchanged(tape: Tape, n: int) -> set[int]:
    """The joints whose full turns do not change a gradient."""
    needed = {k for row in find_gradient_dependences(tape) for joints in row.values() for k in joints}
    return {k for k in range(n) if k not in needed} | find_periodic_joints(tape, n)


def find_periodic_joints(tape: Tape, n: int) -> frozenset[int]:
    """The joints k of n for which h(q + 2 pi e_k) - h(q) is the same constant at every q, for all outputs h."""
    nothing, unit = np.zeros(n), np.eye(n)

    def leaf(name: str, of: Any) -> _Shift:
        return _Shift(nothing, float(of)) if name == "const" else _Shift(unit[of])

    # Only whole numbers of moderate size are added and multiplied, which is exact.
    def step(name: str, of: Sequence[_Shift]) -> _Shift:
        shifts = [each.turn for each in of]
        if name in _EXACT:
            return _Shift(_keep_whole(_EXACT[name](*shifts)))
        for one, other in ((of[0], of[-1]), (of[-1], of[0])):
            if name == "mul" and one.constant is not None:
                return _Shift(_keep_whole(np.where(other.turn == 0, 0.0, other.turn * one.constant)))
        # Other functions stay where all that they depend on does; those with a period, where it turns as a whole.
        still = np.all([shift == 0 for shift in shifts], axis=0)
        if name in ("sin", "cos", "tan"):
            still = ~np.isnan(shifts[0])
        return _Shift(np.where(still, 0.0, np.nan))

    shifts = evaluate_tape(tape, leaf, step)
    alike = np.all([~np.isnan(each.turn) for each in shifts], axis=0)
    return frozenset(np.flatnonzero(alike).tolist())


class _Shift(NamedTuple):
    """What a full turn does to a value."""

    turn: Any  #: change by a turn of each joint / 2 pi; NaN where it is no constant
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
    """Counts boxes as proved, without a sign, that lie outside a ClearBox: s(q) <= bound all over the box.

    s(q) <= |v^T D^-1 J(q)| for all |v| >= 1, with the rows J that count in that ClearBox. Here v(q) is the singular
    vector of the smallest singular value at the centre of the box, plus as much of the others, linear in q, as cancels
    the change of v^T D^-1 J along them to first order. Another check evaluates the other boxes, and their det J must
    have the sign of the centre of the domain: a box with the other sign is halved until its parts lie outside, or a
    fold shows. Where the domain itself keeps folds out, a box with the other sign is left to it: it is not proved,
    halving it is of no use, and its sign is no fold of the chart.
    """

    inside: RegularCheck
    rows: GraphRows  #: J, the rows that check, or C(q) J with orthogonal C if all entries of D are the same
    domain: SingularBound
    sign: float  #: of det J at the centre of the domain
    variables: Variables
    guarded: bool = False  #: whether the domain itself keeps folds out

    @property
    def method(self) -> str:
        """The method of the proofs inside."""
        return self.inside.method

    @property
    def joints(self) -> Variables:
        """The joints that J or the bound depends on."""
        return tuple(sorted({*self.inside.joints, *self.variables}))

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        inside = self.inside(low, high)
        own = inside.proved & (inside.sign == self.sign)
        # Singular values are needed at the centres of boxes that are not proved.
        values = np.full(len(low), np.inf)
        if not own.all():
            values[~own] = self.domain.singular_values((low + high)[~own] / 2)
        # Boxes that may lie outside: others, too large for the value at their centre, are rarely proved to.
        half = (high - low)[:, list(self.variables)] / 2
        near = np.asarray(self.domain.least_singular_value - values > RULES.steep * half.sum(axis=1))
        # Thin boxes with a centre outside are halved in their widest joint, so that they become worth a try.
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
        # A domain that keeps folds out takes care of boxes with the other sign itself.
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
        """Whether boxes lie outside, and the joint to halve to find out."""
        joints = build_joint_models(low, high, self.variables)[0]
        J = self.rows(joints).multiply_by(1 / self.domain.scale[:, None, None])
        # The row v^T J with the change along the other singular vectors taken out.
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
        # Its length bounds the smallest singular value from above.
        small = squared <= self.domain.least_singular_value**2 * (1 - RULES.lengths)
        outside: Array = small & is_orthogonal(left) & is_orthogonal(right)
        return outside, find_most_influential(influences.T, least.variables)


@dataclass(frozen=True, eq=False, repr=False)
class CorridorCheck:
    """Counts boxes as proved, without a sign, that are farther from the path than the radius.

    A box is, if the distance of its centre is larger than the radius by more than half of its diagonal.

    Another check evaluates the other boxes, and their det J must have the sign of the first posture of the path.
    """

    inside: RegularCheck
    domain: PathBound
    sign: float

    @property
    def method(self) -> str:
        """The method of the proofs inside."""
        return self.inside.method

    @property
    def joints(self) -> Variables:
        """All joints: parts may lie outside in each of them."""
        return tuple(range(len(self.domain.centre)))

    def __call__(self, low: Array, high: Array) -> BoxResults:
        """Evaluate boxes between corners (boxes, n)."""
        centre, half = (low + high) / 2, (high - low) / 2
        distance: Any = np.sqrt(self.domain.squared_distance(centre))
        outside = distance > 1 + RULES.rounding + self.domain.lengths(half)
        inside = self.inside(low, high)
        return BoxResults(
            proved=(inside.proved & (inside.sign == self.sign)) | outside,
            # Only these signs are of the corridor.
            regular=inside.regular & (distance <= 1),
            sign=np.where(outside, 0, inside.sign),
            conditioning=np.where(outside, np.inf, inside.conditioning),
            widest=inside.widest,
        )
