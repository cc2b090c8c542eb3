"""The inverse map q(x, xi): targets, the searches in order, how each row ended, and the results."""

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
    """Numbers of the order of searches."""

    rounding: float = 1e-9  #: of the length of the arm: task values next to the limit may be rounded
    rows: int = 16_384  #: solved at once
    first: int = 2  #: restarts from points of the table, and the centre, before all of the domain is searched
    restarts: int = 8  #: from points of the table, where nothing leads to any solution
    snap: float = 1e-9  #: half-widths: solutions so close to the boundary are moved onto it
    slack: float = 1e-9  #: half-widths: joint limits are decimal numbers, see `require_within_limits`
    turned: float = 3 * math.pi  #: [rad] from the centre, of joints whose full turns change xi: of all solutions
    same: float = 1e-6  #: half-widths up to which two solutions count as one
    named: int = 5  #: rows that a message names


RULES = InverseRules()


class InverseStatus(IntEnum):
    """How the search for a q with phi(q) = phi ended, from best to worst."""

    FOUND = 0  #: a solution inside the domain
    NEAREST = 1  #: none was found inside; this q lies inside, has the same x, and the nearest xi that was found
    OUTSIDE_DOMAIN = 2  #: none was found inside; this solution lies within the joint limits, but outside the domain; of
    #: `inside=True` and `nearest_xi`, no q with that x was found inside, and this one, with another xi, lies there
    LIMIT = 3  #: none was found within the joint limits; this solution lies beyond them
    SINGULAR = 4  #: a solution at which J is singular, so that it need not be unique
    NOT_FOUND = 5  #: no solution was found, which does not prove that there is none; q has the smallest error found
    BAD_INPUT = 6  #: a number of phi or of the start is not finite; q is NaN
    OUT_OF_REACH = 7  #: no solution: x is farther than the arm is long, or turns beyond half a turn; q as for NOT_FOUND
    COLLIDING = 8  #: a solution inside the domain where a pair touches; no free one was found


_ACCEPTED = (InverseStatus.FOUND, InverseStatus.NEAREST)
_BEYOND = (InverseStatus.OUTSIDE_DOMAIN, InverseStatus.LIMIT)
_FAILED = (InverseStatus.NOT_FOUND, InverseStatus.BAD_INPUT, InverseStatus.OUT_OF_REACH)
_COLUMNS = ("q", "status", "iterations", "error", "distance")  # of solutions, a row for each target


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
    error: Array  #: largest |phi(q) - phi| relative to the sizes, (N,); of x alone where only x is kept
    distance: Array  #: |xi(q) - xi|, (N,)
    tolerance: float  #: the largest error of a solution

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
        """The status of each row by name."""
        return tuple(InverseStatus(value) for value in self.status)

    def facts(self) -> dict[str, str]:
        """How many rows ended how."""
        counts = {status.name: int((self.status == status).sum()) for status in InverseStatus}
        solved = self.error[np.isin(self.status, (*_ACCEPTED, *_BEYOND, InverseStatus.COLLIDING))]
        return {
            "solutions": listed(f"{count} {name}" for name, count in counts.items() if count) or "no rows",
            **({"largest error": f"{solved.max():.3g}"} if solved.size else {}),
            **({"iterations": f"{self.iterations.mean():.3g} on average"} if len(self) else {}),
        }

    def require(self, inside: bool = True) -> Self:
        """These solutions, if all rows have one.

        Args:
            inside: do not accept solutions outside the domain.

        Raises:
            InverseError: if a row is not solved; the message names the rows.
        """
        # from the worst to the mildest, so that a message names the reason that matters
        accepted = _ACCEPTED if inside else (*_ACCEPTED, *_BEYOND)
        missing = np.flatnonzero(np.isin(self.status, _FAILED))
        if missing.size:
            raise InverseError(
                f"no q with phi(q) = phi found for {self.named(missing)}: relative error is "
                f"{self.error[missing].max():.3g}, expected <= {self.tolerance:.1g}. "
                "The target may be out of reach, or the path to it singular"
            )
        colliding = np.flatnonzero(self.status == InverseStatus.COLLIDING)
        if colliding.size:
            raise InverseError(f"all q found touch something for {self.named(colliding)}")
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
        """Some rows in words, for messages."""
        return f"rows {rows[: RULES.named].tolist()}" if len(self) > 1 else "phi"


def solve_rows(
    chart: Chart, search: Inverse, phi: ArrayLike, q_start: ArrayLike | None, tolerance: float, inside: bool
) -> Solutions:
    """`Chart.solve` for targets of phi, by a search of one's own."""
    require_at_least("tolerance", tolerance, 0)
    targets = as_rows("phi", phi, chart.n)[0]
    # one start serves all rows; grown coordinates begin at the centre
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
    """Target values of phi: those given, or [x; xi]."""
    if phi is not None and x is None and xi is None:
        # What people hold is often a pose.
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
    # x in any form that tasks take, and xi; one may serve many of the other
    first, second = chart.task.target(x), as_float_array("xi", xi)
    if second.ndim == 0 and chart.r == 1:
        second = second[None]
    for name, part, size in (("x", first, chart.m), ("xi", second, chart.r)):
        require_shape(name, part.shape, (size,) if part.ndim == 1 else (None, size))
    if first.ndim == second.ndim == 2 and len(first) != len(second) and 1 not in (len(first), len(second)):
        raise ShapeError("xi", second.shape, (len(first), chart.r))
    # both side by side, row by row
    rows = np.broadcast_shapes(first.shape[:-1], second.shape[:-1])
    return np.concatenate([np.broadcast_to(part, (*rows, part.shape[-1])) for part in (first, second)], axis=-1)


def build_phi_of_wish(chart: Chart, q_wish: ArrayLike, x: Any) -> tuple[Array, Array]:
    """Targets of phi for `nearest_xi`, and the wishes moved into the box of the domain, (N, n) each."""
    wishes = np.clip(as_rows("q_wish", q_wish, chart.n)[0], *chart.problem.domain.bounds)
    phi = np.array(chart.phi(wishes))
    if x is not None:
        values = chart.task.target(x)
        if values.shape not in ((chart.m,), (len(phi), chart.m)):
            raise ShapeError("x", values.shape, (len(phi), chart.m))
        phi[:, : chart.m] = values
    return phi, wishes


def solve_all(chart: Chart, phi: Array, tolerance: float, collisions: Collisions | None) -> Solutions:
    """All solutions for one target (n,) inside the domain that a search finds, free ones first."""
    require_at_least("tolerance", tolerance, 0)
    require_expression(chart, "a search for all solutions")
    search, phi_map, domain = chart.parts.inverse, chart.parts.phi_map, chart.problem.domain
    whole = search.in_domain if search.curves is None else search.curves
    assert whole is not None
    # what Newton's method finds from stored points, then all of the domain
    starts = search.starts.nearest(phi[None], RULES.first, chart.n)[:, 0]
    near = search.brief(np.broadcast_to(phi, starts.shape), starts)
    solved = near.q[largest(near.residual) <= tolerance]
    every = np.concatenate([solved[domain.contains(solved)], whole.find_all(phi, near.q, float(tolerance))])
    # where full turns change xi, solutions have no end: those within one and a half turns of the centre
    away = np.where(chart.parts.boxed.winding, np.abs(every - domain.home), 0.0)
    every = every[np.asarray((away <= RULES.turned).all(axis=1))]
    if measure_excess(chart.problem.task, phi[None, : chart.m])[0] > tolerance:
        every = every[:0]
    # of all that are found, those that differ by more than full turns, the nearest to the centre first
    endless = np.isinf(domain.bounds[0]) & ~np.array(chart.problem.robot.tree.prismatic)
    turns = np.where(endless, 2 * np.pi, 0.0)
    kept: list[int] = []
    for k in np.argsort(np.linalg.norm((every - domain.centre) / domain.half_width, axis=1)):
        apart = np.abs(wrap_shortest(every[k] - every[kept], turns)) / domain.half_width
        if (apart.max(axis=1) > RULES.same).all():
            kept.append(int(k))
    # free ones come first
    q = every[kept]
    status = np.full(len(q), int(InverseStatus.FOUND))
    if collisions is not None and len(q):
        status[~collisions.check_free(q)] = InverseStatus.COLLIDING
    order = np.argsort(status, kind="stable")
    q, rows = q[order], np.broadcast_to(phi, q.shape)
    # their errors, and what is left of xi
    error = largest(phi_map.residual(rows, q)) if len(q) else np.zeros(0)
    own = phi_map.difference(rows, np.asarray(chart.phi(q)))[:, chart.m :] if len(q) else q[:, chart.m :]
    steps = np.zeros(len(q), dtype=np.int64)
    return Solutions(q, status[order], steps, error, np.linalg.norm(own, axis=1), float(tolerance))


def prefer_free(chart: Chart, phi: ArrayLike, found: Solutions, collisions: Collisions) -> Solutions:
    """Solutions for phi with free ones in place of those that touch, where there are any."""
    rows = np.flatnonzero(np.isin(found.status, _ACCEPTED))
    rows = rows[~collisions.check_free(found.q[rows])] if rows.size else rows
    if not rows.size:
        return found
    # rows whose solution touches something
    columns, targets = {name: getattr(found, name).copy() for name in _COLUMNS}, as_rows("phi", phi, chart.n)[0]
    columns["status"][rows] = InverseStatus.COLLIDING
    # of all solutions of such a row, the free one nearest to the first
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
    """Raise InverseError where targets (N, n) have no solution, or, unless `outside`, none inside the domain."""
    # a row without any solution is an error, whatever `outside` says
    try:
        found.require(inside=False)
    except InverseError as error:
        hint = units_hint(chart.problem.task.units, np.abs(targets[:, : chart.m]).max(axis=0).tolist())
        raise InverseError(f"{error}{hint}") from None
    beyond = np.flatnonzero(~found.found)
    if outside or not beyond.size:
        return
    # the nearest inside, for those who catch the error
    nearest = None
    if not isinstance(chart.coordinates, InvertibleMap):
        nearest = found.q.copy()
        if q_start is not None:
            q_start = np.broadcast_to(as_rows("q_start", q_start, chart.n)[0], targets.shape)[beyond]
        nearest[beyond] = chart.solve(targets[beyond], q_start, tolerance=found.tolerance, inside=True).q
    # the joint of the first row that is farthest outside
    q, domain = found.q[beyond[0]], chart.problem.domain
    low, high = domain.bounds
    j = int(np.argmax(np.maximum(low - q, q - high) / domain.half_width))
    name = chart.problem.robot.joint_names[j]
    reason = f"joint '{name}' at {q[j]:.4g}, expected within [{low[j]:.4g}, {high[j]:.4g}]"
    if not domain.is_box and low[j] <= q[j] <= high[j]:
        reason = domain.explain(q)
    raise InverseError(
        f"q with phi(q) = phi lies outside the domain for {found.named(beyond)}: {reason}. "
        "`error.nearest` has joint positions inside; outside=True accepts those outside",
        None if nearest is None else nearest[0] if single else nearest,
    )


def require_expression(chart: Chart, what: str) -> None:
    """Raise NoExpressionError if the coordinates are grown."""
    if isinstance(chart.coordinates, InvertibleMap):
        raise NoExpressionError(f"{what} needs coordinates with a CasADi expression; received grown coordinates")


def beyond_reach(task: Task, x: Array) -> NDArray[np.bool_]:
    """Which task values (N, m) no joint position within the limits has, because the arm is too short, (N,).

    Never for tasks without a position of the tip, nor for arms with an unlimited prismatic joint.
    """
    columns = [k for k, label in enumerate(task.labels) if label in ("x", "y", "z") and task.units[k] == "m"]
    if not task.of_tip or not columns:
        return np.zeros(len(x), dtype=bool)
    # place of the first joint that moves the tip, (3,), and the largest distance of the tip from it [m]
    tree = task.robot.tree
    chain = tree.carriers(tree.tip_parent)
    offsets = [*tree.translations[chain], tree.tip_translation]
    slides = [i for i in chain if tree.body_kinds[i] == "prismatic"]
    strokes = np.maximum(np.abs(tree.expand(tree.lower)), np.abs(tree.expand(tree.upper)))[slides]
    origin, length = offsets[0], float(sum(np.linalg.norm(offset) for offset in offsets[1:]) + strokes.sum())
    away = x[:, columns] - origin[["xyz".index(task.labels[k]) for k in columns]]
    return np.asarray(np.linalg.norm(away, axis=1) > (1 + RULES.rounding) * length)


def measure_excess(task: Task, x: Array) -> Array:
    """How far whole orientations of task values (N, m) lie beyond half a turn, where no rotation is, (N,); else 0."""
    first, end = Relative(task).turns
    excess = np.linalg.norm(x[:, first:end], axis=1) - 2
    return np.where(excess > 2 * RULES.rounding, excess, 0.0)


@dataclass(eq=False)
class Found:
    """The best points so far."""

    q: Array  #: (N, n), finite
    residual: Array  #: (phi - phi(q)) / scale, (N, n)
    iterations: Indices  #: (N,)
    status: Indices  #: (N,)

    @classmethod
    def none(cls, targets: Array) -> Found:
        """Nothing, as for rows that are not finite."""
        q, bad = np.full(targets.shape, np.nan), np.full(len(targets), int(InverseStatus.BAD_INPUT))
        return cls(q, q.copy(), np.zeros_like(bad), bad)

    def put(self, rows: Indices, other: Found) -> None:
        """Replace some rows by the results of another search."""
        for name, values in vars(other).items():
            getattr(self, name)[rows] = values

    def improve(self, rows: Indices, other: Found) -> None:
        """Take over what another search found in some rows, where it is better."""
        better = other.status < self.status[rows]
        same = other.status == self.status[rows]
        better |= same & (other.status == InverseStatus.NOT_FOUND) & (other.error < self.error[rows])
        self.put(rows[better], Found(*(values[better] for values in vars(other).values())))

    @property
    def error(self) -> Array:
        """Largest entries of the residuals, (N,)."""
        return largest(self.residual)


@dataclass(frozen=True, eq=False)
class Inverse:
    """Solves phi(q) = phi, and reports for each row how the search ended."""

    problem: Problem
    phi_map: PhiMap
    local: LocalSolver
    brief: LocalSolver  #: in place of `local` where another search follows anyway; it may give up early
    starts: Starts
    along: Continuation | None = None  #: follows lines of values from given starts; for fitted coordinates
    in_domain: InDomain | None = None  #: searches all of the domain; for fitted coordinates with r > 1
    inside: Inside | None = None  #: finds points inside that keep the task; for fitted coordinates
    curves: SelfMotionCurves | None = None  #: finds the nearest xi at a task value; for fitted coordinates with r = 1

    def solve(self, targets: Array, starts: Array | None, tolerance: float, inside: bool) -> Solutions:
        """Solutions for targets (N, n), from starts (N, n) or our own. Rows that are not finite fail."""
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
        # |xi(q) - xi|: infinite where xi(q) is undefined
        error, of_xi = found.error, (found.residual * self.phi_map.scale(targets))[:, self._m :]
        distance = np.sqrt((of_xi**2).sum(axis=1))
        distance[~np.isfinite(distance)] = np.inf
        error[~good] = distance[~good] = np.nan
        if inside:
            kept = np.isin(found.status, (InverseStatus.NEAREST, InverseStatus.OUTSIDE_DOMAIN))
            error[kept] = largest(found.residual[kept, : self._m])
        # what no rotation has counts as half a turn until here, and q has that
        excess = measure_excess(self.problem.task, targets[:, : self._m])
        beyond = good & (excess > tolerance)
        if beyond.any():
            found.status[beyond] = InverseStatus.OUT_OF_REACH
            error[beyond] = np.fmax(error[beyond], excess[beyond])
        return Solutions(found.q, found.status, found.iterations, error, distance, tolerance)

    def _search(self, targets: Array, starts: Array | None, tolerance: float, inside: bool) -> Found:
        """What the search finds from given starts, or from the rough inverse and, where that fails, in the domain."""
        # Where a longer search follows in any case, as with `inside`, so that both begin it at the same places.
        follows = inside or (starts is None and (self.curves is not None or not self.problem.domain.is_box))
        first = self.brief if follows else self.local
        best = self._attempt(targets, self.starts.guess(targets) if starts is None else starts, tolerance, first)
        # most rows end here
        if not best.status.any():
            return best
        # rows without a solution, because the arm is too short
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
                # other solutions, or the nearest coordinates, inside the domain
                rows = np.flatnonzero(best.status != InverseStatus.FOUND)
                q, distance = self.inside.nearest(targets[rows], own[rows])
                has = np.isfinite(distance)
                self._replace(targets, best, rows[has], q[has], tolerance)
                missing = rows[~has]
                q = self.inside.with_task(targets[missing], best.q[missing])[0]
                self._replace(targets, best, missing, q, tolerance)
                # Descents in a box find solutions that slides in it miss.
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
        """Rows that may have another solution, inside the domain."""
        return np.flatnonzero(~np.isin(best.status, (InverseStatus.FOUND, InverseStatus.OUT_OF_REACH)))

    def _search_domain(self, targets: Array, best: Found, own: Array, tolerance: float) -> None:
        """Search all of the domain in rows that are not found: from q (N, n), as with `inside`, or stored positions."""
        rows = self._open(best)
        # r = 1: all self-motion curves of x are known, so a root on them is a solution
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
        else:  # it may be a small part of its box, and most cells lie outside
            q = self.inside.nearest(targets[rows], own[rows])[0]
        # other coordinates: the best point of the cells, or near stored ones
        attempt = Attempt(q, self.phi_map.residual(targets[rows], q), best.iterations[rows], np.ones(len(q), bool))
        best.improve(rows, self._evaluate(attempt, tolerance))

    def _restart(
        self, targets: Array, best: Found, rows: Indices, count: int, worst: InverseStatus, tolerance: float
    ) -> None:
        """Search some rows again from points of the table and the centre, until their status is `worst` or better."""
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
        """Put the nearest points on curves into some rows; returns the rows without any."""
        if not rows.size:
            return rows
        near = curves.search(targets[rows], own, tolerance)
        has = np.isfinite(near.distance)
        between = np.flatnonzero(near.between & has)
        # xi turns back there
        if between.size:
            near.q[between] = inside.nearer(targets[rows[between]], near.q[between])
        self._replace(targets, best, rows[has], near.q[has], tolerance)
        return np.asarray(rows[~has], dtype=np.int64)

    def _replace(self, targets: Array, best: Found, rows: Indices, q: Array, tolerance: float) -> None:
        """Put points of the box into some rows, with their status; singular solutions stay."""
        moved = np.isin(best.status[rows], (*_BEYOND, InverseStatus.NOT_FOUND, InverseStatus.OUT_OF_REACH))
        rows, q = rows[moved], q[moved]
        residual = self.phi_map.residual(targets[rows], q)
        # a status claims no more than was checked: x, all of phi, the domain
        kept, inside = largest(residual[:, : self._m]) <= tolerance, self.problem.domain.contains(q)
        whole = kept & (largest(residual) <= tolerance)
        best.q[rows], best.residual[rows] = q, residual
        beyond = best.status[rows] == InverseStatus.OUT_OF_REACH
        missed = np.where(beyond, InverseStatus.OUT_OF_REACH, InverseStatus.NOT_FOUND)
        within = np.where(whole, InverseStatus.FOUND, InverseStatus.NEAREST)
        best.status[rows] = np.where(kept, np.where(inside, within, InverseStatus.OUTSIDE_DOMAIN), missed)

    def _attempt(self, targets: Array, starts: Array, tolerance: float, local: LocalSolver | None = None) -> Found:
        """One search from starts (N, n), with a status."""
        attempt = (local or self.local)(targets, starts)
        # joints that miss the boundary by rounding are moved onto it, where the point is a solution still
        low, high = self._bounds
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
        """Where a search ended, with a status."""
        solved = np.flatnonzero(largest(attempt.residual) <= tolerance)
        status = np.full(len(attempt.q), int(InverseStatus.NOT_FOUND))
        status[solved] = InverseStatus.FOUND
        doubtful = solved if attempt.inside is None else solved[~attempt.inside[solved]]
        if doubtful.size and (outside := doubtful[~self.problem.domain.contains(attempt.q[doubtful])]).size:
            # within the joint limits, or beyond
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

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """Lowest and highest joint positions of the domain, (n,) each."""
        return self.problem.domain.bounds
