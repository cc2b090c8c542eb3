"""Methods of charts around the inverse map q(phi), and the CasADi functions of a chart, the inverse among them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.clearance import Clearance
from orthocas.charts.coordinates import Coordinates, InvertibleMap
from orthocas.charts.curve_tracer import CurveTracer
from orthocas.charts.curves import SelfMotionCurves
from orthocas.charts.descent import RULES as DESCENT
from orthocas.charts.descent import BoxedPhi
from orthocas.charts.inside import Inside
from orthocas.charts.inverse import Inverse, InverseStatus, Solutions, join_solutions
from orthocas.charts.newton import (
    NEWTON,
    Continuation,
    FewRows,
    LocalSolver,
    Newton,
    OwnInverse,
    PointFunctions,
    inverse_function,
)
from orthocas.charts.phi import Differences, PhiFunctions, PhiMap, fill_coordinates, largest, leave_over
from orthocas.charts.search import Cells, InDomain, Starts
from orthocas.charts.trackers import ReachingTracker, Tracker, near_function
from orthocas.errors import InvalidValueError, InverseError, NoExpressionError, ShapeError, units_hint
from orthocas.robots.collisions import Collisions
from orthocas.tasks.problem import measure_task_sizes
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Indices,
    as_float_array,
    as_point,
    as_point_set,
    require_at_least,
    require_kind,
    require_known,
    require_shape,
)
from orthocas.tools.display import listed
from orthocas.tools.expressions import choose_form

FUNCTIONS = ("xi", "phi", "jacobian", "second_derivative", "task", "task_jacobian", "manipulability", "inverse")


class InverseMethods(PhiFunctions):
    """What a chart has on top of phi: its inverse in batches, for streams, and as a CasADi function."""

    def inverse(
        self, phi: ArrayLike, q_start: ArrayLike | None = None, *, outside: bool = False, tolerance: float = 1e-9
    ) -> Array:
        """Solve phi(q) = phi for q: fitted charts by Newton's method with line search, grown ones along the flow.

        Several q may have the same phi, inside the domain too. With `q_start`, q is the one that is reached from there.
        Without it, q is the first that the search of `solve` finds inside. `solutions` has all.

        Args:
            phi: target values, (n,) or (N, n).
            q_start: initial guess (n,), or (N, n) with one guess per row of phi. For grown coordinates it selects the
                number of full turns and the sheet of a linear leaf.
            outside: accept solutions outside the domain, where the chart is not known to be good, and beyond joint
                limits.
            tolerance: largest remaining |phi(q) - phi|, relative to the sizes of the components: how far those of the
                task move over the domain, and 1 for xi.

        Returns:
            q, (n,) or (N, n), inside the domain unless `outside`.

        Raises:
            InverseError: if no solution is found, J is singular there, or it lies outside the domain. The message names
                the rows. If solutions lie outside, `error.nearest` has q, (n,) or (N, n), inside the domain: solutions
                where there are any, otherwise the same x with the nearest xi that is found (see `solve` with
                `inside=True`); None for grown coordinates.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
            >>> start = [0.6, 0.8, 0.8]
            >>> try:
            ...     chart.inverse(chart.phi(start) + [0.0, 0.0, 2.0], start)
            ... except oc.errors.InverseError as error:
            ...     bool(chart.problem.domain.contains(error.nearest))
            True
        """
        targets, single = as_point_set("phi", phi, self.n)
        if q_start is not None:
            as_point_set("q_start", q_start, self.n)
        require_kind("outside", outside, bool)
        found = self.solve(targets, q_start, tolerance=tolerance)
        # a row without any solution is an error, whatever `outside` says
        try:
            found.require(inside=False)
        except InverseError as error:
            hint = units_hint(self.problem.task.units, np.abs(targets[:, : self.m]).max(axis=0).tolist())
            raise InverseError(f"{error}{hint}") from None
        # solutions outside the domain are refused, with the nearest ones inside
        beyond = np.flatnonzero(~found.found)
        if beyond.size and not outside:
            raise self._outside_error(targets, q_start, found, beyond, single)
        return found.q[0] if single else found.q

    def solve(
        self,
        phi: ArrayLike | None = None,
        q_start: ArrayLike | None = None,
        *,
        x: Any = None,
        xi: ArrayLike | None = None,
        tolerance: float = 1e-9,
        inside: bool = False,
        all: bool = False,  # noqa: A002
        collisions: Collisions | None = None,
        local: LocalSolver | None = None,
    ) -> Solutions:
        """Solve phi(q) = phi for q, with a status for each row: a row that fails does not disturb the others.

        Several q may have the same phi, inside the domain too. With `q_start`, Newton's method searches from there
        only, and q is the solution that it reaches. Where that is none inside the domain, q follows the straight line
        from phi(q_start) to phi, so that every xi within `xi_range(q_start)` is found. Without a start, Newton's method
        starts at a rough inverse of phi, a polynomial fitted to points of the domain, then at stored points of the
        domain whose phi is nearest. Rows that still have no solution inside are searched for along the self-motion
        curves of x (r = 1, or some of them in wide charts), or in all cells of the domain that may hold one. q is the
        first solution inside that is found; `solutions` looks for all.

        Args:
            phi: target values, (n,) or (N, n). Rows that are not finite get the status BAD_INPUT.
            q_start: initial guess (n,), or (N, n) with one guess per row of phi.
            x: in place of phi, with `xi`: task values (m,) or (N, m), or poses as `Task.target` takes them.
            xi: coordinates (r,) or (N, r); one for many x, or many for one.
            tolerance: largest remaining |phi(q) - phi|, as in `inverse`.
            inside: keep q in the domain, and so within the joint limits. Rows without a solution there, from q_start or
                other starts, get the q inside with the same x and the nearest xi that is found, with the status
                NEAREST. If none with that x is found inside, the status is OUTSIDE_DOMAIN with a q within the box of
                the domain that has it, such as one too near to a singular position, or else NOT_FOUND. With r = 1, the
                nearest is that on all self-motion curves of x that are found; with more coordinates, a local minimum.
                Not for grown coordinates.
            all: for one phi: every solution inside the domain that `solutions` finds, in rows.
            collisions: of the chart's robot, such as `robot.collisions`. Rows whose solution touches something get the
                nearest free one of all solutions that are found, or else the status COLLIDING. With `all`, free ones
                come first. A NEAREST that touches is COLLIDING; `self_motion` knows what is free there.
            local: another solver of phi(q) = phi near given starts; `orthocas.compile_inverse` has one.

        Returns:
            `Solutions` with q (N, n), status, iterations, error and distance (N,); N = 1 for one phi.

        Raises:
            ShapeError: if a row has another number of entries, or q_start another number of rows.
            InvalidValueError: if `all` comes with several phi, a start or `inside`, or collisions are another robot's.
            NoExpressionError: if `inside` or `all` is asked of grown coordinates.

        Source:
            ours: docs/how-to/inverse.md.
        """
        # check what is asked
        if local is not None and not callable(local):
            raise InvalidValueError("local", repr(local)[:80], "a function of targets and starts")
        phi = build_phi(self, phi, x, xi)
        if collisions is not None:
            require_kind("collisions", collisions, Collisions)
            collisions.require_for(self.problem.robot.tree)
        require_kind("all", all, bool)
        # all solutions of one phi
        if all:
            if q_start is not None or inside:
                raise InvalidValueError("all", "given with q_start or inside", "all alone")
            return self._solve_all(as_point("phi", phi, self.n), tolerance, collisions)
        # one solution for each row, and where it touches something another one
        search = self.parts.inverse if local is None else replace(self.parts.inverse, local=local, brief=local)
        found = solve_with(search, self, phi, q_start, tolerance, inside)
        return found if collisions is None else self._prefer_free(rows_of(self, "phi", phi), found, collisions)

    def nearest_xi(self, q_wish: ArrayLike, x: Any = None, *, tolerance: float = 1e-9) -> Solutions:
        """Joint positions in the domain with task values x, and of these the xi nearest to that of a wished posture.

        For postures of a person or a demonstration, which the arm is to resemble while its hand is elsewhere. It is
        `solve` for phi = [x; xi(q_wish)] with `inside=True`, from q_wish.

        Args:
            q_wish: wished joint positions, (n,) or (N, n). What lies beyond the box of the domain is moved to its face.
            x: task values, (m,) or (N, m), or poses as `Task.target` takes them. Default: those of q_wish.
            tolerance: as in `solve`.

        Returns:
            As `solve`: FOUND where a position with that xi was found, NEAREST where only others with that x were
            found, OUTSIDE_DOMAIN where only such outside the domain were, NOT_FOUND where none was.

        Raises:
            ShapeError: if a row has another number of entries, or x another number of rows.
            NoExpressionError: for grown coordinates.
        """
        phi, wishes = targets_of_wish(self, q_wish, x)
        return self.solve(phi, wishes, tolerance=tolerance, inside=True)

    def _solve_all(self, phi: Array, tolerance: float, collisions: Collisions | None) -> Solutions:
        """All solutions inside that a search finds, free ones first."""
        require_at_least("tolerance", tolerance, 0)
        require_expression(self, "a search for all solutions")
        in_domain = self.parts.inverse.in_domain
        assert in_domain is not None
        # free ones first, otherwise the nearest to the centre first
        q = in_domain.all_solutions(phi, float(tolerance))
        status = np.full(len(q), int(InverseStatus.FOUND))
        if collisions is not None and len(q):
            status[~collisions.check_free(q)] = InverseStatus.COLLIDING
        order = np.argsort(status, kind="stable")
        q, rows = q[order], np.broadcast_to(phi, q.shape)
        # their errors, and what is left of xi
        error = largest(self.parts.phi_map.residual(rows, q)) if len(q) else np.zeros(0)
        own = self.parts.phi_map.difference(rows, np.asarray(self.phi(q)))[:, self.m :] if len(q) else q[:, self.m :]
        steps = np.zeros(len(q), dtype=np.int64)
        return Solutions(q, status[order], steps, error, np.linalg.norm(own, axis=1), float(tolerance))

    def _prefer_free(self, targets: Array, found: Solutions, collisions: Collisions) -> Solutions:
        """Solutions with free ones in place of those that touch, where there are any."""
        rows = np.flatnonzero(np.isin(found.status, (InverseStatus.FOUND, InverseStatus.NEAREST)))
        # rows whose solution touches something
        rows = rows[~collisions.check_free(found.q[rows])] if rows.size else rows
        if not rows.size:
            return found
        status = found.status.copy()
        status[rows] = InverseStatus.COLLIDING
        parts = [replace(found, status=status).row(k) for k in range(len(found))]
        # of all solutions of such a row, the free one nearest to the first
        for k in rows[found.status[rows] == InverseStatus.FOUND].tolist():
            if not isinstance(self.coordinates, InvertibleMap):
                every = self._solve_all(targets[k], found.tolerance, collisions)
                free = np.flatnonzero(every.found)
                if free.size:
                    parts[k] = every.row(free[np.argmin(np.linalg.norm(every.q[free] - found.q[k], axis=1))])
        return join_solutions(parts)

    def solutions(self, phi: ArrayLike, tolerance: float = 1e-9, collisions: Collisions | None = None) -> Array:
        """All q inside the domain with phi(q) = phi that a search of the whole domain finds.

        A chart without a fold may have several: det J != 0 makes phi one-to-one near each point only. On the box of a
        certificate's proof "one-to-one", there is at most one. The search starts in all cells of the domain that may
        hold a solution. It is no proof that there are no others; docs/explanation/inverse.md has what it misses.

        Args:
            phi: target values, (n,).
            tolerance: as in `solve`.
            collisions: of the chart's robot: solutions without a contact come first. `solve` with `all` says which.

        Returns:
            Different solutions, the one nearest to the centre of the domain first, (k, n).

        Raises:
            NoExpressionError: if the coordinates are grown.

        Example:
            >>> import numpy as np
            >>> import orthocas as oc
            >>> robot = oc.Robot.planar(lengths=[1.0, 1.0], masses=[1.0, 1.0])
            >>> problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box([0.5, 0.5], 1.0))
            >>> chart = oc.fit(problem, oc.Linear()).chart  # it folds
            >>> len(chart.solutions(chart.phi([0.4, 0.3])))
            2
        """
        return self.solve(phi, tolerance=tolerance, all=True, collisions=collisions).q

    def tracker(
        self,
        q0: ArrayLike,
        largest_step: ArrayLike | None = None,
        *,
        nearest: bool = False,
        collisions: Collisions | None = None,
        margin: float | None = None,
        avoid: float | None = None,
    ) -> Tracker:
        """A tracker that follows a stream of phi from q0; see `Tracker`.

        Args:
            q0: a joint position inside the domain, (n,).
            largest_step: largest change of each joint in a call, (n,) or one number [rad] or [m]; default: a tenth of
                the half-widths of the domain.
            nearest: where phi is out of reach, descend to the nearest x, and with that to the nearest xi, instead of
                staying where it was; see `ReachingTracker`.
            collisions: of the chart's robot, such as `robot.collisions`: no call comes nearer to a contact than margin.
            margin: that distance [m]. Default: 0.01.
            avoid: distance below which xi gives way [m], above the margin. Default: it does not.

        Raises:
            NoExpressionError: if the coordinates are grown.
            InvalidValueError: if q0 lies outside the domain, J is singular there, or a pair touches.
            DomainError: if the domain has a condition, but no expression of it.
        """
        require_expression(self, "a tracker")
        require_kind("nearest", nearest, bool)
        clearance = Clearance.build(collisions, self.problem.robot.tree, margin, avoid)
        parts = self.parts.point_functions, self.problem.domain, q0, largest_step, self.m, clearance
        return ReachingTracker(*parts, self.parts.reaching) if nearest else Tracker(*parts)

    def function(self, name: str) -> ca.Function:
        """A CasADi function: xi, phi, jacobian, task, task_jacobian, manipulability, second_derivative, inverse.

        The input q is a column (n, 1). second_derivative takes q, v, w (n, 1) and returns d^2 phi(q)[v, w] =
        (d/ds) J(q + s v) w, (n, 1). For v = dq this is dJ/dt w. inverse takes phi and q_start (n, 1), and returns q
        (n, 1) with phi(q) = phi, or NaN where Newton's method finds none. Its derivatives are those of the implicit
        function theorem, of any order; so it can be part of an optimal control problem. The gradient of the
        manipulability is `chart.function("manipulability").jacobian()`, away from singular positions.

        Raises:
            UnknownNameError: if there is no such function.
            NoExpressionError: if the coordinates are grown. `orthocas.distil` fits an expression to them.
        """
        require_known("chart function", name, FUNCTIONS)
        if name == "manipulability":
            # sqrt(det(J J^T)) is the product of the diagonal of the Cholesky factor.
            q = ca.MX.sym("q", self.n)
            J = self.problem.task.frame_jacobian_function(q)
            product = ca.SX.sym("P", J.shape[0], J.shape[0])
            volume = ca.Function("volume", [product], [ca.det(ca.diag(ca.diag(ca.chol(product))))])
            return ca.Function(name, [q], [volume(J @ J.T)], ["q"], [name])
        return self._inverse_function if name == "inverse" else self._graph(name)

    @cached_property
    def parts(self) -> ChartParts:
        """What other packages of orthocas use of a chart; it may change without notice."""
        return ChartParts(self)

    @cached_property
    def _inverse_function(self) -> ca.Function:
        return inverse_function(self.function("phi"), self.parts.phi_sizes, self.parts.phi_map.difference)

    def _outside_error(
        self, targets: Array, q_start: ArrayLike | None, found: Solutions, beyond: Indices, single: bool
    ) -> InverseError:
        """What to raise for solutions (N, n) of which some rows lie outside the domain."""
        nearest = None
        # the nearest inside, for those who catch the error
        if not isinstance(self.coordinates, InvertibleMap):
            nearest = found.q.copy()
            own = None if q_start is None else np.broadcast_to(rows_of(self, "q_start", q_start), targets.shape)[beyond]
            nearest[beyond] = self.solve(targets[beyond], own, tolerance=found.tolerance, inside=True).q
        # the joint of the first row that is farthest outside
        q, domain = found.q[beyond[0]], self.problem.domain
        low, high = domain.bounds
        j = int(np.argmax(np.maximum(low - q, q - high) / domain.half_width))
        reason = (
            f"joint '{self.problem.robot.joint_names[j]}' at {q[j]:.4g}, expected within [{low[j]:.4g}, {high[j]:.4g}]"
        )
        if not domain.is_box and low[j] <= q[j] <= high[j]:
            reason = domain.explain(q)
        return InverseError(
            f"q with phi(q) = phi lies outside the domain for {found.named(beyond)}: {reason}. "
            "`error.nearest` has joint positions inside; outside=True accepts those outside",
            None if nearest is None else nearest[0] if single else nearest,
        )


def solve_with(
    search: Inverse, chart: InverseMethods, phi: ArrayLike, q_start: ArrayLike | None, tolerance: float, inside: bool
) -> Solutions:
    """`InverseMethods.solve` by a search of one's own."""
    require_at_least("tolerance", tolerance, 0)
    targets = rows_of(chart, "phi", phi)
    # one start serves all rows; grown coordinates begin at the centre
    starts = None if q_start is None else rows_of(chart, "q_start", q_start)
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


def build_phi(chart: InverseMethods, phi: ArrayLike | None, x: Any, xi: ArrayLike | None) -> ArrayLike:
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


def targets_of_wish(chart: InverseMethods, q_wish: ArrayLike, x: Any) -> tuple[Array, Array]:
    """Targets of phi for `nearest_xi`, and the wishes moved into the box of the domain, (N, n) each."""
    wishes = np.clip(rows_of(chart, "q_wish", q_wish), *chart.problem.domain.bounds)
    phi = np.array(chart.phi(wishes))
    if x is not None:
        values = chart.task.target(x)
        if values.shape not in ((chart.m,), (len(phi), chart.m)):
            raise ShapeError("x", values.shape, (len(phi), chart.m))
        phi[:, : chart.m] = values
    return phi, wishes


def require_expression(chart: InverseMethods, what: str) -> None:
    """Raise NoExpressionError if the coordinates are grown."""
    if isinstance(chart.coordinates, InvertibleMap):
        raise NoExpressionError(f"{what} needs coordinates with a CasADi expression; received grown coordinates")


def rows_of(chart: InverseMethods, name: str, value: ArrayLike) -> Array:
    """One point or a set, as `as_point_set` takes them, but finite or not, (N, n)."""
    array = as_float_array(name, value)
    as_point_set(name, np.zeros_like(array), chart.n)
    return array.reshape(-1, chart.n)


@dataclass(frozen=True, eq=False)
class ChartParts:
    """What solvers, laws and generated code use of a chart; no interface for users."""

    chart: InverseMethods

    @cached_property
    def phi_sizes(self) -> Array:
        """Sizes of the components of phi, (n,): how far task components move over the domain, and 1 for xi."""
        return np.concatenate([measure_task_sizes(self.chart.problem), np.ones(self.chart.r)])

    @property
    def turns(self) -> Array:
        """Periods of the components of phi, (n,): 2 pi for circle-valued coordinates, 0 where there is none."""
        own, chart = self.chart.coordinates, self.chart
        periods = own.turns if isinstance(own, Coordinates) else np.full(chart.r, getattr(own, "turn", 0.0))
        return np.concatenate([np.zeros(chart.m), periods])

    @property
    def named_coordinates(self) -> tuple[str, ...]:
        """Labels of the coordinates, with what the first ones are, or are like: 'xi1: like swivel [rad]'."""
        labels, notes = self.chart.labels[self.chart.m :], self.chart.notes
        meaning, exact = notes.get("meaning"), "exact" in notes
        named = meaning.split("; ") if isinstance(meaning, str) else []
        # older charts only name what they are like
        named = [name if exact or name.startswith("like ") else f"like {name}" for name in named]
        return (*(f"{label}: {name}" for label, name in zip(labels, named, strict=False)), *labels[len(named) :])

    def runnable(self, graph: ca.Function) -> ca.Function:
        """The fast form of a graph of this chart's functions: scalar code, or the graph itself for networks.

        It is also the graph itself for robots with more than 10 joints.
        """
        own = self.chart.coordinates
        return graph if isinstance(own, Coordinates) and own.as_matrices else choose_form(graph, self.chart.n)

    def left_over(self, q_start: ArrayLike, q: ArrayLike, tolerance: float = 1e-9) -> Array | None:
        """What a loop in (x, xi) leaves over in the joints: q - q_start (n,), less full turns of endless joints.

        phi is one-to-one near each point only, so x and xi may come back while the joints do not. A loop that can be
        shrunk to a point, while its joints stay in the domain, leaves nothing over. A loop around a full turn of the
        tool or the base cannot be shrunk, and closes only if xi does not change with the joint that turns.

        Args:
            q_start: where the loop began, (n,).
            q: where it ended, (n,).
            tolerance: of phi, relative to `phi_sizes`.

        Returns:
            (n,) [rad] or [m]; None if x or xi differ, so that the path is open.
        """
        start, end = as_point("q_start", q_start, self.chart.n), as_point("q", q, self.chart.n)
        apart = self.phi_map.difference(self.chart.phi(end), self.chart.phi(start)) / self.phi_sizes
        return leave_over(float(np.abs(apart).max()), tolerance, end - start, self.chart.problem.turning)

    @cached_property
    def relative(self) -> Relative:
        """Task values relative to wanted ones."""
        return Relative(self.chart.problem.task)

    @cached_property
    def rates(self) -> ca.Function:
        """q (n, 1) -> J (n, n) with the rows of `Relative.rates` for the task: for solvers and laws."""
        chart = self.chart
        if not self.relative.turned:
            return chart.function("jacobian")
        q = ca.MX.sym("q", chart.n)
        rows = ca.vertcat(self.relative.rates(q), chart.coordinates.functions["jacobian"](q))
        return ca.Function("rates", [q], [ca.densify(rows)], ["q"], ["rates"])

    def batched_rates(self, points: Array) -> Array:
        """The rows of `rates` at points (N, n), (N, n, n); NaN where the task has no finite Jacobian."""
        chart = self.chart
        J = np.empty((len(points), chart.n, chart.n))
        J[:, : chart.m] = self.relative.batched_rates(points)[0].reshape(-1, chart.m, chart.n)
        fill_coordinates(chart.coordinates, "jacobian", J[:, chart.m :], points)
        return J

    @cached_property
    def phi_map(self) -> PhiMap:
        """phi and J for solvers of phi(q) = phi."""
        chart = self.chart
        return PhiMap(chart.phi, self.batched_rates, self.phi_sizes, Differences(self.turns, self.relative))

    @cached_property
    def boxed(self) -> BoxedPhi:
        """phi in the box of the domain."""
        return BoxedPhi(self.chart.problem.task, self.chart.problem.domain, self.phi_map, self.chart.xi)

    @cached_property
    def tracer(self) -> CurveTracer:
        """Traces self-motion curves, r = 1."""
        return CurveTracer(self.boxed)

    @cached_property
    def turn_shifts(self) -> dict[str, Array]:
        """What a full turn of a joint that turns without end adds to xi everywhere, (r,) by the joint's name.

        One posture then has many values of xi, these apart. Joints whose turns do not change xi are missing, and so are
        those whose turns change it by different amounts in different postures.
        """
        chart, shifts = self.chart, {}
        q = sample_uniform(chart.problem.domain, 8, 0)
        for k in chart.problem.turning:
            turned = chart.phi(q + 2 * np.pi * np.eye(chart.n)[k])
            shift = self.phi_map.difference(turned, chart.phi(q))[:, chart.m :]
            if np.abs(shift[0]).max() > DESCENT.same and np.ptp(shift, axis=0).max() < DESCENT.same:
                shifts[chart.problem.robot.joint_names[k]] = np.asarray(shift[0])
        return shifts

    @cached_property
    def inverse(self) -> Inverse:
        """The search of `InverseMethods.solve`."""
        chart, phi_map, domain = self.chart, self.phi_map, self.chart.problem.domain
        # grown coordinates bring their own inverse
        starts = Starts(phi_map, domain)
        if isinstance(chart.coordinates, InvertibleMap):
            return Inverse(chart.problem, phi_map, OwnInverse(chart.coordinates, phi_map), starts)
        boxed = self.boxed
        local, brief = (
            FewRows(phi_map, self.point_functions, Newton(phi_map, k)) for k in (NEWTON.halvings, NEWTON.brief)
        )
        in_domain, inside = InDomain(boxed, Cells(boxed)), Inside(boxed, starts)
        curves = SelfMotionCurves(boxed, starts, self.tracer) if chart.r == 1 else None
        return Inverse(chart.problem, phi_map, local, starts, Continuation(phi_map), in_domain, inside, curves, brief)

    @cached_property
    def point_functions(self) -> PointFunctions:
        """The functions that trackers and `solve` call for one row."""
        phi_map = self.phi_map
        phi = self.chart.function("phi")
        return PointFunctions.of(phi, self.rates, phi_map.sizes, phi_map.difference, self.chart.problem.turning)

    @cached_property
    def reaching(self) -> ca.Function:
        """The function of `ReachingTracker`: see `near_function`."""
        chart = self.chart
        return near_function(chart.function("phi"), self.rates, chart.m, self.phi_map, chart.problem.domain)
