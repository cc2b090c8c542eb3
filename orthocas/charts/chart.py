"""Charts phi(q) = [h(q); xi(q)]: task and extra coordinates together, with Jacobian and inverse map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.certificate import Certificate
from orthocas.charts.coordinates import CoordinateMap, fill_coordinates
from orthocas.charts.inverse import (
    Solutions,
    build_phi,
    build_phi_of_wish,
    prefer_free,
    require_expression,
    require_solutions,
    solve_all,
    solve_rows,
)
from orthocas.charts.parts import FUNCTIONS, ChartParts
from orthocas.charts.point_quality import PointQuality, point_quality
from orthocas.charts.self_motion import SelfMotion, XiRange, self_motion, xi_range
from orthocas.charts.trackers import ReachingTracker, Tracker
from orthocas.charts.walls import Clearance, require_collisions
from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Domain
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_path, as_point, as_point_set, require_kind, require_known
from orthocas.tools.display import Shown, listed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from orthocas.exact.flow import GrownCoordinates

Symbolic = TypeVar("Symbolic", ca.SX, ca.MX)


@dataclass(frozen=True, eq=False, repr=False)
class Chart(Shown):
    """A chart phi(q) = [h(q); xi(q)]: a problem with task h, and fitted or grown coordinates xi ([AS2023] eq. (27)).

    Methods take one joint position (n,), a column (n, 1), or a set (N, n), [rad] or [m]. The methods `xi`, `x`, `phi`
    and `jacobian` also take a CasADi column (n, 1), SX or MX, and return an expression. Grown coordinates are NaN at
    points from which the flow does not reach the charted part of the base leaf.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> chart.labels
        ('x', 'y', 'xi1')
        >>> q = np.array([0.7, 0.9, 0.6])
        >>> phi = chart.phi(q)
        >>> np.allclose(chart.inverse(phi, q_start=[0.6, 0.8, 0.8]), q)
        True
    """

    problem: Problem
    coordinates: CoordinateMap
    notes: Mapping[str, str | float] = field(default_factory=dict)  #: how it was made: solver, weights, seed, ...
    certificate: Certificate | None = None  #: a proof that it does not fold, see `orthocas.certify`

    def __post_init__(self) -> None:
        require_kind("problem", self.problem, Problem)
        methods = [getattr(type(self.coordinates), name, None) for name in ("xi", "jacobian", "size")]
        if None in methods:
            kind = type(self.coordinates).__name__
            raise InvalidValueError("coordinates", f"a {kind}", "a CoordinateMap, with `xi`, `jacobian` and `size`")
        require_kind("notes", self.notes, Mapping)
        object.__setattr__(self, "notes", MappingProxyType(dict(self.notes)))
        if self.certificate is not None:
            self._check_certificate(self.certificate)

    def _check_certificate(self, certificate: Certificate) -> None:
        """Raise CertifyError if the certificate belongs to another chart."""
        from orthocas.charts.chart_file import fingerprint  # imports all that a file may contain; a fit needs none

        certificate.require_for(fingerprint(self.problem, self.coordinates))

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        """Pickle and copy by the fields. The notes become a dict, because a read-only mapping supports neither."""
        parts = {part.name: getattr(self, part.name) for part in fields(self)}
        return type(self), tuple((parts | {"notes": dict(self.notes)}).values())

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.problem.robot

    @property
    def task(self) -> Task:
        """The task h; `task(q)` and `x(q)` are its values."""
        return self.problem.task

    @property
    def domain(self) -> Domain:
        """The part of joint space where the chart is valid."""
        return self.problem.domain

    @cached_property
    def n(self) -> int:
        """Number of joints."""
        return self.problem.n

    @cached_property
    def m(self) -> int:
        """Number of task components."""
        return self.problem.m

    @cached_property
    def r(self) -> int:
        """Number of extra coordinates."""
        return self.problem.r

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the components of phi: those of the task, then xi1, xi2, ..."""
        return (*self.problem.task.labels, *(f"xi{k + 1}" for k in range(self.r)))

    @overload
    def xi(self, q: Symbolic) -> Symbolic: ...
    @overload
    def xi(self, q: ArrayLike) -> Array: ...
    def xi(self, q: Any) -> Any:
        """Extra coordinates xi, (r,) or (N, r)."""
        if isinstance(q, ca.SX | ca.MX):
            return self.parts.express("xi", q)
        points, single = as_point_set("q", q, self.n)
        values = self.coordinates.xi(points)
        return values[0] if single else values

    @overload
    def x(self, q: Symbolic) -> Symbolic: ...
    @overload
    def x(self, q: ArrayLike) -> Array: ...
    def x(self, q: Any) -> Any:
        """Task values x = h(q), (m,) or (N, m)."""
        return self.task(q)

    @overload
    def phi(self, q: Symbolic) -> Symbolic: ...
    @overload
    def phi(self, q: ArrayLike) -> Array: ...
    def phi(self, q: Any) -> Any:
        """Task values and extra coordinates stacked, phi = [x; xi], (n,) or (N, n)."""
        if isinstance(q, ca.SX | ca.MX):
            return self.parts.express("phi", q)
        points, single = as_point_set("q", q, self.n)
        phi = np.empty((len(points), self.n))
        self.problem.task.batched.into(phi[:, : self.m], points)
        fill_coordinates(self.coordinates, "xi", phi[:, self.m :], points)
        return phi[0] if single else phi

    @overload
    def jacobian(self, q: Symbolic) -> Symbolic: ...
    @overload
    def jacobian(self, q: ArrayLike) -> Array: ...
    def jacobian(self, q: Any) -> Any:
        """J = dphi/dq, (n, n) or (N, n, n); task rows first."""
        if isinstance(q, ca.SX | ca.MX):
            return self.parts.express("jacobian", q)
        points, single = as_point_set("q", q, self.n)
        J = np.empty((len(points), self.n, self.n))
        self.problem.task.evaluate_jacobian(points, J[:, : self.m])
        fill_coordinates(self.coordinates, "jacobian", J[:, self.m :], points)
        return J[0] if single else J

    def inverse(
        self, phi: ArrayLike, q_start: ArrayLike | None = None, *, outside: bool = False, tolerance: float = 1e-9
    ) -> Array:
        """Solve phi(q) = phi for q: fitted charts by Newton's method with line search, grown ones along the flow.

        Several q may have the same phi, even inside the domain. With `q_start`, the result is the solution reached from
        there. Without it, the result is the first solution inside that `solve` finds. `solutions` looks for all.

        Args:
            phi: target values, (n,) or (N, n).
            q_start: initial guess (n,), or (N, n) with one guess per row of phi. For grown coordinates it selects the
                number of full turns and the sheet of a linear leaf.
            outside: also accept solutions outside the domain, where the quality of the chart is unknown, and solutions
                beyond the joint limits.
            tolerance: largest error of a component of phi(q), divided by the size of that component. The size of a
                task component is about its range over the domain; the size of a component of xi is 1.

        Returns:
            q, (n,) or (N, n), inside the domain unless `outside`.

        Raises:
            InverseError: if no solution is found, if J is singular at the solution, or if the solution lies outside the
                domain. The message names the rows. In the last case, `error.nearest` holds q inside the domain, (n,) or
                (N, n): a solution where one exists, otherwise the same x with the nearest xi found, as from `solve`
                with `inside=True`. It is None for grown coordinates.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
            >>> start = [0.6, 0.8, 0.8]
            >>> try:
            ...     chart.inverse(chart.phi(start) + [0.0, 0.0, 0.5], start)
            ... except oc.errors.InverseError as error:
            ...     bool(chart.problem.domain.contains(error.nearest))
            True
        """
        targets, single = as_point_set("phi", phi, self.n)
        if q_start is not None:
            as_point_set("q_start", q_start, self.n)
        require_kind("outside", outside, bool)
        found = self.solve(targets, q_start, tolerance=tolerance)
        require_solutions(self, targets, q_start, found, outside, single)
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
    ) -> Solutions:
        """Solve phi(q) = phi for q. Each row gets a status of its own, so a row that fails does not stop the others.

        Several q may have the same phi, even inside the domain. With `q_start`, Newton's method starts there only, and
        q is the solution that it reaches. If that solution is missing or outside the domain, q instead follows the
        straight line from phi(q_start) to phi, which finds every xi within `xi_range(q_start)`. Without `q_start`,
        Newton's method starts at a polynomial fit of the inverse, then at stored points of the domain whose phi is
        nearest. For rows that still have no solution inside, the search continues along the self-motion curves of x
        (for r = 1, and along some of them in wide charts with r > 1), or from more stored points. The result is the
        first solution found inside; `solutions` looks for all.

        Args:
            phi: target values, (n,) or (N, n). Rows that are not finite get the status BAD_INPUT.
            q_start: initial guess (n,), or (N, n) with one guess per row of phi.
            x: task values (m,) or (N, m), or poses as `Task.target` takes them. `x` and `xi` together replace `phi`.
            xi: coordinates (r,) or (N, r). One xi may go with many x, and many xi with one x.
            tolerance: largest error of phi(q), as in `inverse`.
            inside: keep q in the domain, and so within the joint limits. A row without a solution there gets the status
                NEAREST and a q inside the domain with the same x and the nearest xi found. With r = 1, that is the
                nearest xi on all self-motion curves of x that are found; with r > 1, it is a local minimum of the
                distance. If no q with that x is found inside, the row gets a q in the box of the domain with that x and
                the status OUTSIDE_DOMAIN, for example near a singular position; without such a q, the status is
                NOT_FOUND. Not available for grown coordinates.
            all: for one phi: return every solution inside the domain that `solutions` finds, one per row.
            collisions: a collision model of the chart's robot, such as `robot.collisions`. If the solution of a row is
                in collision, the row gets the nearest free solution that is found, or else the status COLLIDING. With
                `all`, free solutions come first. A NEAREST point in collision gets the status COLLIDING;
                `self_motion` shows which positions with that x are free.

        Returns:
            `Solutions` with q (N, n), status, iterations, error and distance (N,); N = 1 for one phi.

        Raises:
            ShapeError: if a row does not have n entries, or q_start has another number of rows than phi.
            InvalidValueError: if `all` is combined with several phi, `q_start` or `inside`, or if the collision model
                belongs to another robot.
            NoExpressionError: if `inside` or `all` is used with grown coordinates.

        Source:
            ours: docs/how-to/inverse.md.
        """
        phi = build_phi(self, phi, x, xi)
        if collisions is not None:
            require_collisions(collisions, self.problem.robot.tree)
        require_kind("all", all, bool)
        # all solutions for one phi
        if all:
            if q_start is not None or inside:
                raise InvalidValueError("all", "given with q_start or inside", "neither of them")
            return solve_all(self, as_point("phi", phi, self.n), tolerance, collisions)
        # one solution for each row; solutions in collision are replaced by free ones
        found = solve_rows(self, self.parts.inverse, phi, q_start, tolerance, inside)
        return found if collisions is None else prefer_free(self, phi, found, collisions)

    def nearest_xi(self, q_wish: ArrayLike, x: Any = None, *, tolerance: float = 1e-9) -> Solutions:
        """Joint positions in the domain with task values x whose xi is nearest to that of a desired posture q_wish.

        One use is to imitate the posture of a person or a demonstration while the hand is at another x. The method is
        `solve` for phi = [x; xi(q_wish)] with `inside=True`, started at q_wish.

        Args:
            q_wish: desired joint positions, (n,) or (N, n). They are clipped to the box of the domain.
            x: task values, (m,) or (N, m), or poses as `Task.target` takes them. Default: those of q_wish.
            tolerance: as in `solve`.

        Returns:
            As `solve`. The status is FOUND if q has this x and xi(q_wish), NEAREST if it has this x and another xi,
            OUTSIDE_DOMAIN if positions with this x were found only outside the domain, and NOT_FOUND if there are none.

        Raises:
            ShapeError: if a row of q_wish does not have n entries, or x has another number of rows or entries.
            NoExpressionError: for grown coordinates.
        """
        phi, wishes = build_phi_of_wish(self, q_wish, x)
        return self.solve(phi, wishes, tolerance=tolerance, inside=True)

    def solutions(self, phi: ArrayLike, tolerance: float = 1e-9, collisions: Collisions | None = None) -> Array:
        """All q inside the domain with phi(q) = phi that a search of the whole domain finds.

        Even a chart without a fold may have several solutions, because det J != 0 makes phi one-to-one only locally. On
        the box of a certificate's proof "one-to-one", there is at most one. With r = 1 the search follows all
        self-motion curves of x that it finds; with r > 1 it descends from stored positions. The search does not prove
        that there are no other solutions; docs/explanation/inverse.md says what it may miss.

        Args:
            phi: target values, (n,).
            tolerance: as in `solve`.
            collisions: a collision model of the chart's robot: free solutions come first. `solve` with `all` also
                returns the status of each solution.

        Returns:
            Solutions (k, n), the one nearest to the centre of the domain first. Of solutions that differ only by full
            turns of joints without boundaries, one is returned. If full turns of such a joint change xi, the solutions
            within one and a half turns of the domain's home are returned.

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
            nearest: if phi is out of reach, descend to the nearest x, and with that x to the nearest xi, instead of
                staying at the last q; see `ReachingTracker`.
            collisions: a collision model of the chart's robot, such as `robot.collisions`. The tracker then keeps all
                pairs at a distance of at least `margin`.
            margin: smallest distance to a contact [m]. Default: 0.01.
            avoid: distance to a contact below which xi yields [m]; larger than `margin`. Default: xi does not yield.

        Raises:
            NoExpressionError: if the coordinates are grown.
            InvalidValueError: if q0 lies outside the domain, if J is singular there, or if a pair touches there.
            DomainError: if the domain has a condition, but no expression of it.
        """
        require_expression(self, "a tracker")
        require_kind("nearest", nearest, bool)
        clearance = Clearance.build(collisions, self.problem.robot.tree, margin, avoid)
        parts = self.parts.point_functions, self.problem.domain, q0, largest_step, self.m, clearance
        return ReachingTracker(*parts, self.parts.reaching) if nearest else Tracker(*parts)

    def function(self, name: str) -> ca.Function:
        """A CasADi function: xi, phi, jacobian, task, task_jacobian, manipulability, second_derivative, inverse.

        The input q is a column (n, 1). `second_derivative` takes q, v, w (n, 1) and returns d^2 phi(q)[v, w] =
        (d/ds) J(q + s v) w, (n, 1); for v = dq this is dJ/dt w. `inverse` takes phi and q_start (n, 1), and returns a q
        (n, 1) with phi(q) = phi, or NaN if Newton's method finds none. Its derivatives follow from the implicit
        function theorem, in any order, so `inverse` can be part of an optimal control problem. The gradient of the
        manipulability is `chart.function("manipulability").jacobian()`, away from singular positions.

        Raises:
            UnknownNameError: if there is no such function.
            NoExpressionError: if the coordinates are grown. `orthocas.distil` fits an expression to them.
        """
        require_known("chart function", name, FUNCTIONS)
        return self.parts.functions[name]

    def xi_range(self, q: ArrayLike, collisions: Collisions | None = None) -> XiRange:
        """Range of each extra coordinate from q, with the task value and the other coordinates held.

        For each coordinate, the method follows the curve through q on which only that coordinate changes, in both
        directions, until the curve leaves the domain or meets a fold. The ends are exact to 1e-9; the curve between
        them is checked at steps of at most 0.1 rad or m.

        With r = 1 and no collision model, the curve is followed in C. The code is compiled at the first call for a
        chart, in a second or two, and kept for later calls. Without a C compiler, Python finds the same in about ten
        times the time.

        Args:
            q: a joint position (n,) inside the domain.
            collisions: a collision model of the chart's robot, such as `robot.collisions`. A range then also ends where
                a pair touches, and its stop names the pair. No contact deeper than 0.1 mm is missed between steps.

        Returns:
            An `Interval` for each coordinate: lowest and highest value, and what stops the coordinate there.

        Raises:
            ShapeError, InvalidValueError: if q is not a joint position inside the domain.

        Source:
            ours.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
            >>> print(chart.xi_range([0.6, 0.8, 0.8])["xi1"])
            Interval: xi1 in [-0.3359, 0.2538], 0 now
              low   joint 'q2' at 0.4073
              high  joint 'q3' at 0.4073
        """
        return xi_range(self, q, collisions)

    def self_motion(
        self, q: ArrayLike, step: float = 0.05, samples: int = 1000, collisions: Collisions | None = None
    ) -> SelfMotion:
        """Joint positions that the arm can reach from q inside the domain without changing the task value.

        With r = 1 they form the curve through q along the null space of J_x, followed in both directions until it
        leaves the domain or closes. The curve does not end where the coordinate turns back. With r > 1 they are points
        on a lattice in xi, filled from q outwards, on the same side of any fold as q. All points have the task value of
        q to 1e-9.

        Args:
            q: a joint position (n,) inside the domain.
            step: for r = 1: largest distance between points along the curve [rad] or [m].
            samples: for r > 1: approximate number of points, at most 10,000.
            collisions: as in `xi_range`. With r > 1, all points are free, but the paths between them are not checked.

        Returns:
            Joint positions, their coordinates, and the range of each coordinate: exact for r = 1, a lower bound of the
            range for r > 1. With r = 1 the result is a `SelfMotionCurve`, which also has the length of the curve and
            whether it closes.

        Raises:
            ShapeError, InvalidValueError: if q is not a joint position inside the domain, or a number is out of range.

        Source:
            ours.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
            >>> motion = chart.self_motion([0.6, 0.8, 0.8])
            >>> motion.closed, motion.q.shape[1], round(float(abs(chart.x(motion.q) - motion.x).max()), 9)
            (False, 3, 0.0)
        """
        return self_motion(self, q, step, samples, collisions)

    def quality(self, q: ArrayLike) -> PointQuality:
        """Quality of the chart at one joint position (n,), or at each of several (N, n).

        Returns:
            The leak of each coordinate [deg], the conditioning, and the distance to the boundary of the domain. The
            leak is the angle in the metric between the gradient of a coordinate and the space orthogonal to the task.

        Raises:
            ShapeError, InvalidValueError: if q does not have n joints, or is not finite.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
            >>> quality = chart.quality([0.6, 0.8, 0.8])  # the centre, where linear coordinates are exact
            >>> bool(quality.leak_deg.max() < 1e-4), float(quality.boundary_distance.round(3))
            (True, 0.393)
        """
        points, single = as_point_set("q", q, self.n)
        found = point_quality(self.problem, self.coordinates, points)
        if single:
            found = PointQuality(found.leak_deg[0], found.conditioning[0], found.boundary_distance[0])
        return found

    def manipulability(self, q: ArrayLike) -> Array:
        """Manipulability w = sqrt(det(J_x J_x^T)) at q, (n,) or (N, n); see `Task.manipulability`."""
        return self.task.manipulability(q)

    def manipulability_gradient(self, q: ArrayLike, along: str = "q") -> Array:
        """Gradient of the manipulability w with respect to q, or to xi with x held.

        Args:
            q: a joint position (n,), or several (N, n).
            along: "q" gives dw/dq, (n,) or (N, n). "xi" gives dw/dxi with x held, (r,) or (N, r): the last r entries of
                dw/dq J^-1.

        Returns:
            The gradient; NaN at singular positions of the task.

        Raises:
            ShapeError, InvalidValueError: if q is invalid, or `along` is neither "q" nor "xi".

        Source:
            Along q: [Y1985], differentiated; along xi: ours.

        Example:
            >>> import orthocas as oc
            >>> chart = oc.load("panda-wide")
            >>> slope = chart.manipulability_gradient(chart.domain.home, along="xi")
            >>> slope.shape
            (1,)
        """
        gradient = self.task.manipulability_gradient(q)
        if along == "q":
            return gradient
        if along != "xi":
            raise InvalidValueError("along", repr(along)[:80], "'q' or 'xi'")
        J = self.jacobian(q)
        rows = np.linalg.solve(np.moveaxis(J, -1, -2), gradient[..., None])[..., 0]
        return np.asarray(rows[..., self.m :])

    def facts(self) -> dict[str, str]:
        """Coordinates, problem, and how the chart was made."""
        problem = self.problem.facts()
        made = listed(
            f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in self.notes.items()
        )
        return {
            "chart": f"{self.coordinates.label} coordinates of {self.problem.heading}",
            "phi": listed([*self.labels[: self.m], *self.parts.named_coordinates]),
            "parameters": str(self.coordinates.size),
            **{name: problem[name] for name in ("task", "metric", "domain")},
            **({"made by": made} if made else {}),
            **({"certificate": self.certificate.heading} if self.certificate else {}),
        }

    def plot(self) -> Figure:
        """Plot the arm along the range of each coordinate, from the home of the domain, with all else held.

        Returns:
            A matplotlib figure with one panel for each coordinate, which notebooks show.
        """
        from orthocas.charts.figures import self_motion_figure  # imports matplotlib, which takes long

        return self_motion_figure(self)

    def save(self, path: str | Path, force: bool = False, collisions: Collisions | None = None) -> None:
        """Write a self-contained chart file. An existing chart file is replaced; other files only with `force`.

        Args:
            path: the file.
            force: also replace an existing file that is not a chart file.
            collisions: a collision model of the chart's robot, such as `robot.collisions`. Its solids and pairs are
                stored in the file, with the vertices of hulls in single precision. The loaded chart has them as
                `chart.robot.collisions`.

        Raises:
            InvalidValueError: if the collision model belongs to another robot.
            ChartFileError: if the folder is missing or cannot be written, or if `path` is a symbolic link or a file
                that is not a chart.
        """
        from orthocas.charts.chart_file import write_chart  # imports all that a file may contain; a fit needs none

        require_collisions(collisions, self.problem.robot.tree)
        target = as_path("path", path)
        write_chart(target, self.problem, self.coordinates, self.notes, self.certificate, force, collisions)

    @cached_property
    def parts(self) -> ChartParts:
        """Internal parts of the chart for other packages of orthocas; they may change without notice."""
        return ChartParts(self)


@dataclass(frozen=True, eq=False, repr=False)
class GrownChart(Chart):
    """A chart with grown coordinates. Methods that need a CasADi expression of xi raise NoExpressionError.

    `coordinates.leaf` is the base leaf. `coordinates.pull` returns the point of the leaf to which each q flows, with a
    status.
    """

    coordinates: GrownCoordinates

    def __post_init__(self) -> None:
        from orthocas.exact.flow import GrownCoordinates  # imports flows and meshes; fitted charts need none

        if not isinstance(self.coordinates, GrownCoordinates):
            kind = getattr(self.coordinates, "label", type(self.coordinates).__name__)
            raise InvalidValueError("coordinates", kind, "grown coordinates")
        Chart.__post_init__(self)


def load_file(path: Path) -> Chart:
    """Read a chart file. A grown chart is returned as a `GrownChart`."""
    from orthocas.charts.chart_file import read_chart  # imports all that a file may contain; a fit needs none
    from orthocas.exact.flow import GrownCoordinates

    problem, coordinates, notes, certificate = read_chart(path)
    if isinstance(coordinates, GrownCoordinates):
        return GrownChart(problem, coordinates, notes)
    return Chart(problem, coordinates, notes, certificate)
