"""The inverse map q(x, xi): its targets, its searches in order, and its results with a status for each row."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.charts.coordinates import InvertibleMap
from orthocas.charts.curves import SelfMotionCurves
from orthocas.charts.descent import InDomain
from orthocas.charts.inside import Inside
from orthocas.charts.newton import Attempt, Continuation, LocalSolver, PhiMap, Starts, largest
from orthocas.errors import InvalidValueError, InverseError, NoExpressionError, ShapeError, units_hint
from orthocas.robots.collisions import Collisions
from orthocas.tasks.problem import Problem
from orthocas.tasks.relative import Relative
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Indices,
    as_float_array,
    as_rows,
    require_at_least,
    require_kind,
    require_shape,
)
from orthocas.tools.display import Shown, listed
from orthocas.tools.expressions import wrap_shortest

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart


@dataclass(frozen=True, slots=True)
class InverseRules:
    """Numbers that order and bound the searches of `Inverse`."""

    rounding: float = 1e-9  #: relative tolerance on the length of the arm, so that rounded task values stay in reach
    rows: int = 16_384  #: rows solved at once
    first: int = 2  #: stored points from which rows restart, besides home, before the whole domain is searched
    restarts: int = 8  #: stored points from which rows restart if no search has found a solution
    snap: float = 1e-9  #: [half-widths] solutions so close to the boundary are moved onto it
    slack: float = 1e-9  #: [half-widths] tolerance at joint limits, see `require_within_limits`
    turned: float = 3 * math.pi  #: [rad] in `solve_all`: largest distance from home if full turns of a joint change xi
    same: float = 1e-6  #: [half-widths] distance up to which two solutions count as one
    named: int = 5  #: largest number of rows that a message names


RULES = InverseRules()


class InverseStatus(IntEnum):
    """How the search for a q with phi(q) = phi ended, from best to worst."""

    FOUND = 0  #: q is a solution inside the domain
    NEAREST = 1  #: no solution was found inside; q lies inside and has the same x and the nearest xi found
    OUTSIDE_DOMAIN = 2  #: no solution was found inside; q is a solution outside the domain, within the joint limits.
    #: With `inside=True` and in `nearest_xi`: no q with that x was found inside; q has that x and lies outside
    LIMIT = 3  #: no solution was found within the joint limits; q is a solution beyond them
    SINGULAR = 4  #: q is a solution at which J is singular, so it need not be unique
    NOT_FOUND = 5  #: no solution was found, which does not prove that there is none; q has the smallest error found
    BAD_INPUT = 6  #: an entry of phi or of the start is not finite; q is NaN
    OUT_OF_REACH = 7  #: there is no solution: the arm is too short for x, or x turns by more than half a turn;
    #: q has the smallest error found
    COLLIDING = 8  #: q is inside the domain, but in collision; no free solution was found


_ACCEPTED = (InverseStatus.FOUND, InverseStatus.NEAREST)
_BEYOND = (InverseStatus.OUTSIDE_DOMAIN, InverseStatus.LIMIT)
_FAILED = (InverseStatus.NOT_FOUND, InverseStatus.BAD_INPUT, InverseStatus.OUT_OF_REACH)
_COLUMNS = ("q", "status", "iterations", "error", "distance")  # fields of `Solutions` with a row for each target


@dataclass(frozen=True, eq=False, repr=False)
class Solutions(Shown):
    """Joint positions with given task values and coordinates; see `Chart.solve`.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> phi = chart.phi([[0.7, 0.9, 0.6], [0.6, 0.8, 0.8]])
        >>> solutions = chart.solve(np.vstack([phi, [9.0, 0.0, 0.0]]))
        >>> [status.name for status in solutions.statuses], solutions.found.tolist()
        (['FOUND', 'FOUND', 'OUT_OF_REACH'], [True, True, False])
    """

    q: Array = field(repr=False)  #: the best points found, (N, n) [rad] or [m]
    status: Indices  #: an `InverseStatus` for each row, (N,)
    iterations: Indices  #: steps of Newton's method that led to q, (N,)
    error: Array  #: largest error of phi(q), relative to the component sizes, (N,); of x only, if q has another xi
    distance: Array  #: |xi(q) - xi|, (N,)
    tolerance: float  #: largest accepted error of a solution

    def __post_init__(self) -> None:
        for name in _COLUMNS:
            getattr(self, name).setflags(write=False)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def found(self) -> NDArray[np.bool_]:
        """Rows with a solution inside the domain, (N,)."""
        return np.asarray(self.status == InverseStatus.FOUND)

    @property
    def statuses(self) -> tuple[InverseStatus, ...]:
        """The status of each row as an `InverseStatus`."""
        return tuple(InverseStatus(value) for value in self.status)

    def facts(self) -> dict[str, str]:
        """Number of rows with each status, the largest error of the solved ones, and the mean number of iterations."""
        counts = {status.name: int((self.status == status).sum()) for status in InverseStatus}
        solved = self.error[np.isin(self.status, (*_ACCEPTED, *_BEYOND, InverseStatus.COLLIDING))]
        return {
            "solutions": listed(f"{count} {name}" for name, count in counts.items() if count) or "no rows",
            **({"largest error": f"{solved.max():.3g}"} if solved.size else {}),
            **({"iterations": f"{self.iterations.mean():.3g} on average"} if len(self) else {}),
        }

    def require(self, inside: bool = True) -> Self:
        """Return these solutions if all rows are solved, and raise an error otherwise.

        Args:
            inside: do not accept solutions outside the domain.

        Raises:
            InverseError: if a row is not solved; the message names the rows.
        """
        # The worst failures are checked first, so that the message names the most serious one.
        accepted = _ACCEPTED if inside else (*_ACCEPTED, *_BEYOND)
        missing = np.flatnonzero(np.isin(self.status, _FAILED))
        if missing.size:
            raise InverseError(
                f"no q with phi(q) = phi found for {self.named(missing)}: relative error is "
                f"{self.error[missing].max():.3g}, expected <= {self.tolerance:.1g}. "
                "The target may be out of reach, or the search may have met a singular position"
            )
        colliding = np.flatnonzero(self.status == InverseStatus.COLLIDING)
        if colliding.size:
            raise InverseError(f"every q found for {self.named(colliding)} is in collision: a pair touches")
        singular = np.flatnonzero(self.status == InverseStatus.SINGULAR)
        if singular.size:
            raise InverseError(
                f"the Jacobian is singular at the solution of row {singular[0]}: q need not be unique there"
            )
        beyond = np.flatnonzero(~np.isin(self.status, accepted))
        if beyond.size:
            raise InverseError(f"q was found only outside the domain for {self.named(beyond)}")
        return self

    def named(self, rows: Indices) -> str:
        """Name some rows in a message."""
        return f"rows {rows[: RULES.named].tolist()}" if len(self) > 1 else "phi"


def solve_rows(
    chart: Chart, search: Inverse, phi: ArrayLike, q_start: ArrayLike | None, tolerance: float, inside: bool
) -> Solutions:
    """`Chart.solve` for target values phi, with the given search object."""
    require_at_least("tolerance", tolerance, 0)
    targets = as_rows("phi", phi, chart.n)[0]
    # One start may serve all rows. Grown coordinates always need a start; the default is the domain's home.
    starts = None if q_start is None else as_rows("q_start", q_start, chart.n)[0]
    if starts is None and isinstance(chart.coordinates, InvertibleMap):
        starts = chart.problem.domain.home[None]
    if starts is not None:
        if len(starts) not in (1, len(targets)):
            raise ShapeError("q_start", starts.shape, targets.shape)
        starts = np.broadcast_to(starts, targets.shape)
    require_kind("inside", inside, bool)
    if inside:
        require_expression(chart, "inside=True")
    return search.solve(targets, starts, float(tolerance), inside)


def build_phi(chart: Chart, phi: ArrayLike | None, x: Any, xi: ArrayLike | None) -> ArrayLike:
    """Target values of phi: the given phi, or [x; xi]."""
    if phi is not None and x is None and xi is None:
        # A pose in place of phi is a likely mistake: the message says which methods take a pose.
        matrix = isinstance(phi, np.ndarray) and phi.shape[-2:] == (4, 4) and chart.n != 4
        if matrix or hasattr(phi, "homogeneous"):
            instead = (
                f"{chart.n} numbers; solve(x=pose, xi=...) takes a pose with xi, and nearest_xi(q, pose) one alone"
            )
            raise InvalidValueError("phi", "a pose", instead)
        return phi
    if phi is not None or x is None or xi is None:
        given = listed(name for name, value in (("phi", phi), ("x", x), ("xi", xi)) if value is not None)
        raise InvalidValueError("target", given or "nothing", "phi, or x and xi; `nearest_xi` takes x and a posture")
    # x may have any form that the task accepts; one x may go with many xi, and one xi with many x
    first, second = chart.task.target(x), as_float_array("xi", xi)
    if second.ndim == 0 and chart.r == 1:
        second = second[None]
    for name, part, size in (("x", first, chart.m), ("xi", second, chart.r)):
        require_shape(name, part.shape, (size,) if part.ndim == 1 else (None, size))
    if first.ndim == second.ndim == 2 and len(first) != len(second) and 1 not in (len(first), len(second)):
        raise ShapeError("xi", second.shape, (len(first), chart.r))
    # stack x and xi in each row
    rows = np.broadcast_shapes(first.shape[:-1], second.shape[:-1])
    return np.concatenate([np.broadcast_to(part, (*rows, part.shape[-1])) for part in (first, second)], axis=-1)


def build_phi_of_wish(chart: Chart, q_wish: ArrayLike, x: Any) -> tuple[Array, Array]:
    """Targets phi = [x; xi(q_wish)] for `nearest_xi`, and q_wish clipped to the box of the domain, (N, n) each."""
    wishes = np.clip(as_rows("q_wish", q_wish, chart.n)[0], *chart.problem.domain.bounds)
    phi = np.array(chart.phi(wishes))
    if x is not None:
        values = chart.task.target(x)
        if values.shape not in ((chart.m,), (len(phi), chart.m)):
            raise ShapeError("x", values.shape, (len(phi), chart.m))
        phi[:, : chart.m] = values
    return phi, wishes


def solve_all(chart: Chart, phi: Array, tolerance: float, collisions: Collisions | None) -> Solutions:
    """All solutions inside the domain for one target (n,) that the search finds, free ones first."""
    require_at_least("tolerance", tolerance, 0)
    require_expression(chart, "a search for all solutions")
    search, phi_map, domain = chart.parts.inverse, chart.parts.phi_map, chart.problem.domain
    whole = search.in_domain if search.curves is None else search.curves
    assert whole is not None
    # solutions from Newton's method at stored points, then from a search of the whole domain
    starts = search.starts.nearest(phi[None], RULES.first, chart.n)[:, 0]
    near = search.brief(np.broadcast_to(phi, starts.shape), starts)
    solved = near.q[largest(near.residual) <= tolerance]
    every = np.concatenate([solved[domain.contains(solved)], whole.find_all(phi, near.q, float(tolerance))])
    # If full turns of a joint change xi, there may be infinitely many solutions: keep those within 1.5 turns of home.
    away = np.where(chart.parts.boxed.winding, np.abs(every - domain.home), 0.0)
    every = every[np.asarray((away <= RULES.turned).all(axis=1))]
    # an orientation beyond half a turn has no solution
    if measure_excess(chart.problem.task, phi[None, : chart.m])[0] > tolerance:
        every = every[:0]
    # of solutions that differ only by full turns keep the one nearest to the centre; sort by that distance
    endless = np.isinf(domain.bounds[0]) & ~np.array(chart.problem.robot.tree.prismatic)
    turns = np.where(endless, 2 * np.pi, 0.0)
    kept: list[int] = []
    for k in np.argsort(np.linalg.norm((every - domain.centre) / domain.half_width, axis=1)):
        apart = np.abs(wrap_shortest(every[k] - every[kept], turns)) / domain.half_width
        if (apart.max(axis=1) > RULES.same).all():
            kept.append(int(k))
    # free solutions first
    q = every[kept]
    status = np.full(len(q), int(InverseStatus.FOUND))
    if collisions is not None and len(q):
        status[~collisions.check_free(q)] = InverseStatus.COLLIDING
    order = np.argsort(status, kind="stable")
    q, rows = q[order], np.broadcast_to(phi, q.shape)
    # errors of phi, and |xi - xi(q)|
    error = largest(phi_map.residual(rows, q)) if len(q) else np.zeros(0)
    own = phi_map.difference(rows, np.asarray(chart.phi(q)))[:, chart.m :] if len(q) else q[:, chart.m :]
    steps = np.zeros(len(q), dtype=np.int64)
    return Solutions(q, status[order], steps, error, np.linalg.norm(own, axis=1), float(tolerance))


def prefer_free(chart: Chart, phi: ArrayLike, found: Solutions, collisions: Collisions) -> Solutions:
    """Replace solutions in collision by the nearest free solutions, if the search for all solutions finds any."""
    rows = np.flatnonzero(np.isin(found.status, _ACCEPTED))
    rows = rows[~collisions.check_free(found.q[rows])] if rows.size else rows
    if not rows.size:
        return found
    # rows in collision get the status COLLIDING until a free solution is found
    columns, targets = {name: getattr(found, name).copy() for name in _COLUMNS}, as_rows("phi", phi, chart.n)[0]
    columns["status"][rows] = InverseStatus.COLLIDING
    # for each of these rows: the free solution nearest to the one in collision
    grown = isinstance(chart.coordinates, InvertibleMap)
    for k in () if grown else rows[found.status[rows] == InverseStatus.FOUND].tolist():
        every = solve_all(chart, targets[k], found.tolerance, collisions)
        free = np.flatnonzero(every.found)
        if free.size:
            nearest = free[np.argmin(np.linalg.norm(every.q[free] - found.q[k], axis=1))]
            for name, values in columns.items():
                values[k] = getattr(every, name)[nearest]
    return Solutions(**columns, tolerance=found.tolerance)


def require_solutions(
    chart: Chart, targets: Array, q_start: ArrayLike | None, found: Solutions, outside: bool, single: bool
) -> None:
    """Raise InverseError if a target (N, n) has no solution, or has none inside the domain and `outside` is False."""
    # A row without any solution is an error for both values of `outside`.
    try:
        found.require(inside=False)
    except InverseError as error:
        hint = units_hint(chart.problem.task.units, np.abs(targets[:, : chart.m]).max(axis=0).tolist())
        raise InverseError(f"{error}{hint}") from None
    beyond = np.flatnonzero(~found.found)
    if outside or not beyond.size:
        return
    # the nearest q inside, for callers that catch the error
    nearest = None
    if not isinstance(chart.coordinates, InvertibleMap):
        nearest = found.q.copy()
        if q_start is not None:
            q_start = np.broadcast_to(as_rows("q_start", q_start, chart.n)[0], targets.shape)[beyond]
        nearest[beyond] = chart.solve(targets[beyond], q_start, tolerance=found.tolerance, inside=True).q
    # for the message: the joint of the first such row that is farthest outside its interval
    q, domain = found.q[beyond[0]], chart.problem.domain
    low, high = domain.bounds
    j = int(np.argmax(np.maximum(low - q, q - high) / domain.half_width))
    name = chart.problem.robot.joint_names[j]
    reason = f"joint '{name}' at {q[j]:.4g}, expected within [{low[j]:.4g}, {high[j]:.4g}]"
    if not domain.is_box and low[j] <= q[j] <= high[j]:
        reason = domain.explain(q)
    raise InverseError(
        f"q with phi(q) = phi lies outside the domain for {found.named(beyond)}: {reason}. "
        "`error.nearest` has the nearest q inside; outside=True accepts solutions outside",
        None if nearest is None else nearest[0] if single else nearest,
    )


def require_expression(chart: Chart, what: str) -> None:
    """Raise NoExpressionError for `what` if the coordinates are grown."""
    if isinstance(chart.coordinates, InvertibleMap):
        raise NoExpressionError(f"{what} needs coordinates with a CasADi expression; received grown coordinates")


def beyond_reach(task: Task, x: Array) -> NDArray[np.bool_]:
    """Whether the arm is too short for task values x (N, m), (N,).

    True only if the tip position of x is farther from the first joint than the sum of all link lengths and strokes.
    Tasks without a tip position, and arms with an unlimited prismatic joint, are never beyond reach.
    """
    columns = [k for k, label in enumerate(task.labels) if label in ("x", "y", "z") and task.units[k] == "m"]
    if not task.of_tip or not columns:
        return np.zeros(len(x), dtype=bool)
    # position (3,) of the first joint that moves the tip, and the largest distance of the tip from it [m]
    tree = task.robot.tree
    chain = tree.carriers(tree.tip_parent)
    offsets = [*tree.translations[chain], tree.tip_translation]
    slides = [i for i in chain if tree.body_kinds[i] == "prismatic"]
    strokes = np.maximum(np.abs(tree.expand(tree.lower)), np.abs(tree.expand(tree.upper)))[slides]
    origin, length = offsets[0], float(sum(np.linalg.norm(offset) for offset in offsets[1:]) + strokes.sum())
    away = x[:, columns] - origin[["xyz".index(task.labels[k]) for k in columns]]
    return np.asarray(np.linalg.norm(away, axis=1) > (1 + RULES.rounding) * length)


def measure_excess(task: Task, x: Array) -> Array:
    """How far the orientations of task values (N, m) exceed half a turn, (N,); 0 for valid orientations.

    An orientation vector has the length 2 sin(angle / 2), so vectors longer than 2 are no rotation.
    """
    first, end = Relative(task).turns
    excess = np.linalg.norm(x[:, first:end], axis=1) - 2
    return np.where(excess > 2 * RULES.rounding, excess, 0.0)


@dataclass(eq=False)
class Found:
    """The best points found so far for N targets."""

    q: Array  #: (N, n), finite except for rows with the status BAD_INPUT
    residual: Array  #: (phi - phi(q)) / scale, (N, n)
    iterations: Indices  #: (N,)
    status: Indices  #: (N,)

    @classmethod
    def none(cls, targets: Array) -> Found:
        """N rows of NaN with the status BAD_INPUT."""
        q, bad = np.full(targets.shape, np.nan), np.full(len(targets), int(InverseStatus.BAD_INPUT))
        return cls(q, q.copy(), np.zeros_like(bad), bad)

    def put(self, rows: Indices, other: Found) -> None:
        """Replace the given rows by the results of another search."""
        for name, values in vars(other).items():
            getattr(self, name)[rows] = values

    def improve(self, rows: Indices, other: Found) -> None:
        """Replace those of the given rows for which another search found a better status, or a smaller error."""
        better = other.status < self.status[rows]
        same = other.status == self.status[rows]
        better |= same & (other.status == InverseStatus.NOT_FOUND) & (other.error < self.error[rows])
        self.put(rows[better], Found(*(values[better] for values in vars(other).values())))

    @property
    def error(self) -> Array:
        """Largest entry of the residual of each row, (N,)."""
        return largest(self.residual)


@dataclass(frozen=True, eq=False)
class Inverse:
    """Solves phi(q) = phi for many targets, and reports for each row how the search ended.

    The fields are the solvers that it combines. The optional ones exist for fitted coordinates only.
    """

    problem: Problem
    phi_map: PhiMap
    local: LocalSolver  #: Newton's method, or the inverse of grown coordinates
    brief: LocalSolver  #: the same with few halvings of a step, used where another search follows
    starts: Starts
    along: Continuation | None = None  #: follows the line from phi(start) to phi
    in_domain: InDomain | None = None  #: searches the whole domain
    inside: Inside | None = None  #: finds points inside the domain with a given task value
    curves: SelfMotionCurves | None = None  #: finds the nearest xi at a task value; for r = 1 only

    def solve(self, targets: Array, starts: Array | None, tolerance: float, inside: bool) -> Solutions:
        """Solutions for targets (N, n), from given starts (N, n) or our own. Rows that are not finite are BAD_INPUT."""
        good = np.asarray(np.isfinite(targets).all(axis=1))
        if starts is not None:
            good &= np.isfinite(starts).all(axis=1)
        if good.all() and 0 < len(good) <= RULES.rows:
            found = self._search(targets, starts, tolerance, inside)
        else:
            found, rows = Found.none(targets), np.flatnonzero(good)
            for first in range(0, len(rows), RULES.rows):
                some = rows[first : first + RULES.rows]
                found.put(
                    some, self._search(targets[some], None if starts is None else starts[some], tolerance, inside)
                )
        # distance = |xi(q) - xi|, infinite where xi(q) is undefined
        error, of_xi = found.error, (found.residual * self.phi_map.scale(targets))[:, self._m :]
        distance = np.sqrt((of_xi**2).sum(axis=1))
        distance[~np.isfinite(distance)] = np.inf
        error[~good] = distance[~good] = np.nan
        if inside:
            kept = np.isin(found.status, (InverseStatus.NEAREST, InverseStatus.OUTSIDE_DOMAIN))
            error[kept] = largest(found.residual[kept, : self._m])
        # An orientation beyond half a turn is no rotation. The search treated it as half a turn, so q only solves that.
        excess = measure_excess(self.problem.task, targets[:, : self._m])
        beyond = good & (excess > tolerance)
        if beyond.any():
            found.status[beyond] = InverseStatus.OUT_OF_REACH
            error[beyond] = np.fmax(error[beyond], excess[beyond])
        return Solutions(found.q, found.status, found.iterations, error, distance, tolerance)

    def _search(self, targets: Array, starts: Array | None, tolerance: float, inside: bool) -> Found:
        """Run the searches in order: Newton's method from the starts, then, for rows without a solution, wider ones.

        Without `starts`, Newton's method starts at the polynomial inverse of `Starts`.
        """
        # If a wider search follows anyway, the first one may give up early. This holds for `inside` with and without
        # `starts`, so that both begin the wider search at the same points.
        follows = inside or (starts is None and (self.curves is not None or not self.problem.domain.is_box))
        first = self.brief if follows else self.local
        best = self._attempt(targets, self.starts.guess(targets) if starts is None else starts, tolerance, first)
        # in most calls all rows are solved here
        if not best.status.any():
            return best
        # rows without a solution because the arm is too short
        rows = np.flatnonzero(best.status == InverseStatus.NOT_FOUND)
        beyond = beyond_reach(self.problem.task, targets[rows, : self._m])
        best.status[rows[beyond]] = InverseStatus.OUT_OF_REACH
        if inside and self.inside is not None:
            own = best.q.copy() if starts is None else starts
            if self.curves is not None:
                # r = 1: other solutions, or the nearest xi, on self-motion curves
                rows = np.flatnonzero(best.status != InverseStatus.FOUND)
                missing = self._take_nearest(self.curves, self.inside, targets, best, rows, own[rows], tolerance)
                # again from points inside that have x; if the curves through these have none, the points themselves
                q, in_reach = self.inside.with_task(targets[missing], best.q[missing])
                again, own = missing[in_reach], q[in_reach]
                left = self._take_nearest(self.curves, self.inside, targets, best, again, own, tolerance)
                self._replace(targets, best, missing[~in_reach], q[~in_reach], tolerance)
                self._replace(targets, best, left, own[np.isin(again, left)], tolerance)
            else:
                # r > 1: other solutions, or the nearest xi, inside the domain
                rows = np.flatnonzero(best.status != InverseStatus.FOUND)
                q, distance = self.inside.nearest(targets[rows], own[rows])
                has = np.isfinite(distance)
                self._replace(targets, best, rows[has], q[has], tolerance)
                missing = rows[~has]
                q = self.inside.with_task(targets[missing], best.q[missing])[0]
                self._replace(targets, best, missing, q, tolerance)
                # In a box, descents on |phi - phi(q)| find solutions that the steps along h(q) = x miss.
                if self.problem.domain.is_box:
                    self._search_domain(targets, best, own, tolerance)
        elif starts is None:
            own = best.q.copy()
            if self.curves is None:
                self._restart(targets, best, self._open(best), RULES.first, InverseStatus.FOUND, tolerance)
            self._search_domain(targets, best, own, tolerance)
            rows = np.flatnonzero(best.status == InverseStatus.NOT_FOUND)
            self._restart(targets, best, rows, RULES.restarts, InverseStatus.SINGULAR, tolerance)
        elif self.along is not None:
            rows = self._open(best)
            best.improve(rows, self._evaluate(self.along(targets[rows], starts[rows]), tolerance))
        return best

    def _open(self, best: Found) -> Indices:
        """Rows for which a search may still find a solution inside the domain."""
        return np.flatnonzero(~np.isin(best.status, (InverseStatus.FOUND, InverseStatus.OUT_OF_REACH)))

    def _search_domain(self, targets: Array, best: Found, own: Array, tolerance: float) -> None:
        """Search the whole domain for rows without a solution inside, and update `best`.

        `own` (N, n) are positions from which the search starts, besides stored ones.
        """
        rows = self._open(best)
        # r = 1: search for roots of xi(q) = xi on the self-motion curves of x
        if rows.size and self.curves is not None:
            near = self.curves.search(targets[rows], own[rows], tolerance)
            found = near.distance == 0
            rows, q = rows[found], near.q[found]
            solved = np.full(len(q), int(InverseStatus.FOUND))
            best.improve(rows, Found(q, self.phi_map.residual(targets[rows], q), np.zeros_like(solved), solved))
            return
        if not rows.size or self.in_domain is None or self.inside is None:
            return
        if self.problem.domain.is_box:
            q = self.in_domain.search(targets[rows], tolerance)
        else:  # the domain may be a small part of its box, so that descents in the box would mostly end outside
            q = self.inside.nearest(targets[rows], own[rows])[0]
        attempt = Attempt(q, self.phi_map.residual(targets[rows], q), best.iterations[rows], np.ones(len(q), bool))
        best.improve(rows, self._evaluate(attempt, tolerance))

    def _restart(
        self, targets: Array, best: Found, rows: Indices, count: int, worst: InverseStatus, tolerance: float
    ) -> None:
        """Search some rows again from `count` stored points and home, until their status is `worst` or better."""
        if not rows.size:
            return
        near = self.starts.nearest(targets[rows], count, self.problem.n)
        for start in (*near, np.broadcast_to(self.problem.domain.home, near.shape[1:])):
            left = best.status[rows] > worst
            if not left.any():
                break
            best.improve(rows[left], self._attempt(targets[rows[left]], start[left], tolerance))

    def _take_nearest(
        self,
        curves: SelfMotionCurves,
        inside: Inside,
        targets: Array,
        best: Found,
        rows: Indices,
        own: Array,
        tolerance: float,
    ) -> Indices:
        """Set some rows of `best` to the nearest points on their self-motion curves; return rows without a point."""
        if not rows.size:
            return rows
        near = curves.search(targets[rows], own, tolerance)
        has = np.isfinite(near.distance)
        between = np.flatnonzero(near.between & has)
        # Here xi turns back along the curve. Refine q, because the minimum of |xi - xi(q)| lies between samples.
        if between.size:
            near.q[between] = inside.nearer(targets[rows[between]], near.q[between])
        self._replace(targets, best, rows[has], near.q[has], tolerance)
        return np.asarray(rows[~has], dtype=np.int64)

    def _replace(self, targets: Array, best: Found, rows: Indices, q: Array, tolerance: float) -> None:
        """Set some rows of `best` to points q of the box, and their status. Rows already solved or singular stay."""
        moved = np.isin(best.status[rows], (*_BEYOND, InverseStatus.NOT_FOUND, InverseStatus.OUT_OF_REACH))
        rows, q = rows[moved], q[moved]
        residual = self.phi_map.residual(targets[rows], q)
        # the status follows from three checks: x is met, all of phi is met, q lies in the domain
        kept, inside = largest(residual[:, : self._m]) <= tolerance, self.problem.domain.contains(q)
        whole = kept & (largest(residual) <= tolerance)
        best.q[rows], best.residual[rows] = q, residual
        beyond = best.status[rows] == InverseStatus.OUT_OF_REACH
        missed = np.where(beyond, InverseStatus.OUT_OF_REACH, InverseStatus.NOT_FOUND)
        within = np.where(whole, InverseStatus.FOUND, InverseStatus.NEAREST)
        best.status[rows] = np.where(kept, np.where(inside, within, InverseStatus.OUTSIDE_DOMAIN), missed)

    def _attempt(self, targets: Array, starts: Array, tolerance: float, local: LocalSolver | None = None) -> Found:
        """Search once from starts (N, n) with a local solver, and evaluate the status of each row."""
        attempt = (local or self.local)(targets, starts)
        # move joints that miss the boundary by rounding onto it, if the point then still is a solution
        low, high = self.problem.domain.bounds
        moved = np.clip(attempt.q, low, high)
        off = np.abs(moved - attempt.q)
        if off.any():
            near = (off <= RULES.snap * self.problem.domain.half_width).all(axis=1)
            rows = np.flatnonzero(off.any(axis=1) & near)
            residual = self.phi_map.residual(targets[rows], moved[rows])
            good = largest(residual) <= tolerance
            attempt.q[rows[good]], attempt.residual[rows[good]] = moved[rows[good]], residual[good]
        return self._evaluate(attempt, tolerance)

    def _evaluate(self, attempt: Attempt, tolerance: float) -> Found:
        """The points at which a search ended, with a status for each row."""
        solved = np.flatnonzero(largest(attempt.residual) <= tolerance)
        status = np.full(len(attempt.q), int(InverseStatus.NOT_FOUND))
        status[solved] = InverseStatus.FOUND
        doubtful = solved if attempt.inside is None else solved[~attempt.inside[solved]]
        if doubtful.size and (outside := doubtful[~self.problem.domain.contains(attempt.q[doubtful])]).size:
            # solutions outside the domain: within the joint limits, or beyond them
            q, robot, slack = attempt.q[outside], self.problem.robot, RULES.slack * self.problem.domain.half_width
            allowed = ((q >= robot.lower - slack) & (q <= robot.upper + slack)).all(axis=1)
            status[outside] = np.where(allowed, InverseStatus.OUTSIDE_DOMAIN, InverseStatus.LIMIT)
        doubtful = solved[attempt.suspicious[solved]]
        if doubtful.size:
            status[doubtful[self.phi_map.is_singular(attempt.q[doubtful])]] = InverseStatus.SINGULAR
        return Found(attempt.q, attempt.residual, attempt.iterations, status)

    @cached_property
    def _m(self) -> int:
        """Number of task components."""
        return self.problem.m
