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
    """A problem and its fitted or grown coordinates xi(q) ([AS2023] eq. (27)).

    Methods take one joint position (n,), a column (n, 1), or a set (N, n), [rad] or [m]. The methods `xi`, `task`,
    `phi` and `jacobian` also take a CasADi column (n, 1), SX or MX, and return an expression. Grown coordinates are NaN
    at points from which the flow does not reach the charted part of the base leaf.

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
            raise InvalidValueError("coordinates", f"a {type(self.coordinates).__name__}", "those of a chart")
        require_kind("notes", self.notes, Mapping)
        object.__setattr__(self, "notes", MappingProxyType(dict(self.notes)))
        if self.certificate is not None:
            self._check_certificate(self.certificate)

    def _check_certificate(self, certificate: Certificate) -> None:
        """Raise CertifyError for a proof of another chart."""
        from orthocas.charts.chart_file import fingerprint  # all that files may hold, which a fit does not need

        certificate.require_for(fingerprint(self.problem, self.coordinates))

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        """Pickle and copy the fields, with the notes as a plain dict: a read-only mapping supports neither."""
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
        """Where the chart is meant to be used."""
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
        """Extra coordinates, (r,) or (N, r)."""
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
        """Task values and extra coordinates stacked, (n,) or (N, n)."""
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
        """Solve phi(q) = phi for q, with a status for each row: a row that fails does not disturb the others.

        Several q may have the same phi, inside the domain too. With `q_start`, Newton's method searches from there
        only, and q is the solution that it reaches. Where that is none inside the domain, q follows the straight line
        from phi(q_start) to phi, so that every xi within `xi_range(q_start)` is found. Without a start, Newton's method
        starts at a rough inverse of phi, a polynomial fitted to points of the domain, then at stored points of the
        domain whose phi is nearest. Rows that still have no solution inside are searched for along the self-motion
        curves of x (r = 1, or some of them in wide charts), or from more stored points. q is the first solution inside
        that is found; `solutions` looks for all.

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

        Returns:
            `Solutions` with q (N, n), status, iterations, error and distance (N,); N = 1 for one phi.

        Raises:
            ShapeError: if a row has another number of entries, or q_start another number of rows.
            InvalidValueError: if `all` comes with several phi, a start or `inside`, or collisions are another robot's.
            NoExpressionError: if `inside` or `all` is asked of grown coordinates.

        Source:
            ours: docs/how-to/inverse.md.
        """
        phi = build_phi(self, phi, x, xi)
        if collisions is not None:
            require_collisions(collisions, self.problem.robot.tree)
        require_kind("all", all, bool)
        # all solutions of one phi
        if all:
            if q_start is not None or inside:
                raise InvalidValueError("all", "given with q_start or inside", "all alone")
            return solve_all(self, as_point("phi", phi, self.n), tolerance, collisions)
        # one solution for each row, and where it touches something another one
        found = solve_rows(self, self.parts.inverse, phi, q_start, tolerance, inside)
        return found if collisions is None else prefer_free(self, phi, found, collisions)

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
        phi, wishes = build_phi_of_wish(self, q_wish, x)
        return self.solve(phi, wishes, tolerance=tolerance, inside=True)

    def solutions(self, phi: ArrayLike, tolerance: float = 1e-9, collisions: Collisions | None = None) -> Array:
        """All q inside the domain with phi(q) = phi that a search of the whole domain finds.

        A chart without a fold may have several: det J != 0 makes phi one-to-one near each point only. On the box of a
        certificate's proof "one-to-one", there is at most one. With r = 1 the search follows all self-motion curves of
        x, with more coordinates it descends from stored positions. It is no proof that there are no others;
        docs/explanation/inverse.md has what it misses.

        Args:
            phi: target values, (n,).
            tolerance: as in `solve`.
            collisions: of the chart's robot: solutions without a contact come first. `solve` with `all` says which.

        Returns:
            Solutions that differ by more than full turns of joints without boundaries, the one nearest to the centre of
            the domain first, (k, n). Where full turns change xi, those within one and a half turns of the centre.

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
        return self.parts.functions[name]

    def xi_range(self, q: ArrayLike, collisions: Collisions | None = None) -> XiRange:
        """How far each extra coordinate reaches alone from q, the task value and the other coordinates held.

        For each coordinate, the curve through q along which only that coordinate changes is followed in both directions
        until it leaves the domain or meets a fold. The ends are exact to 1e-9; the path between them is checked at
        steps of at most 0.1 rad or m.

        With r = 1 and no collisions it is C, compiled at the first call for a chart (a second or two) and kept for
        later ones; without a C compiler, Python finds the same in some ten times the time.

        Args:
            q: a joint position (n,) inside the domain.
            collisions: of the chart's robot, such as `robot.collisions`: a range ends where a pair touches, which its
                stop names. Contacts deeper than 0.1 mm are not passed between steps.

        Returns:
            An `Interval` for each coordinate: lowest and highest value, and what stops it there.

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
        """What can move at the task value of q without leaving the domain.

        With r = 1 it is the curve through q, followed along the null space of J_x in both directions until it leaves
        the domain or closes. It goes on where the coordinate turns back. With r > 1 it is a set of points on a lattice
        in xi, filled from q on, and as far as the chart does not fold. All points have the task value of q to 1e-9.

        Args:
            q: a joint position (n,) inside the domain.
            step: for r = 1: the largest distance of points along the curve [rad] or [m].
            samples: for r > 1: about how many points, at most 10,000.
            collisions: as in `xi_range`; with r > 1, points of the set are free, the ways between them are not checked.

        Returns:
            Joint positions, their coordinates, and how far each coordinate reaches: exactly for r = 1, at least so far
            for r > 1. With r = 1 a `SelfMotionCurve`, with the length of the curve and whether it closes.

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
        """How good the chart is at one joint position (n,), or at each of a set or a path (N, n).

        Returns:
            The leak of each coordinate [deg], the conditioning, and the distance to the boundary of the domain. The
            leak is the angle in the metric between the gradient of a coordinate and the space orthogonal to the task.

        Raises:
            ShapeError, InvalidValueError: if q has another number of joints, or is not finite.

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
        """w = sqrt(det(J J^T)) of the task at q (n,), or at each row of (N, n): `Task.manipulability`."""
        return self.task.manipulability(q)

    def manipulability_gradient(self, q: ArrayLike, along: str = "q") -> Array:
        """How the manipulability w changes at q (n,), or at each row of (N, n).

        Args:
            q: a joint position (n,), or several (N, n).
            along: "q" gives dw/dq, (n,) or (N, n). "xi" gives the change along each coordinate with x and the others
                held, (r,) or (N, r): the last r entries of dw/dq J^-1.

        Returns:
            The gradient; NaN at singular positions of the task.

        Raises:
            ShapeError, InvalidValueError: for bad positions, or another word for `along`.

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
        """Coordinates, problem, and how it was made."""
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
        """The arm along each coordinate, as far as it reaches from the centre of the domain, with the task held.

        Returns:
            A matplotlib figure with one panel for each coordinate, which notebooks show.

        Raises:
            InvalidValueError: if the chart is not finite at the centre of the domain.
        """
        from orthocas.charts.figures import self_motion_figure  # with matplotlib, which takes long to import

        return self_motion_figure(self)

    def save(self, path: str | Path, force: bool = False, collisions: Collisions | None = None) -> None:
        """Write a self-contained chart file. It replaces a chart file of that name, and with `force` any other file.

        Args:
            path: the file.
            force: replace a file that is no chart.
            collisions: of the chart's robot, such as `robot.collisions`: the file holds its solids and pairs, which
                `chart.robot.collisions` of the loaded chart has, with corners of hulls in single precision.

        Raises:
            InvalidValueError: if collisions are another robot's.
            ChartFileError: if the folder is missing or cannot be written, if there is a file that is no chart, or a
                symbolic link.
        """
        from orthocas.charts.chart_file import write_chart  # all that files may hold, which a fit does not need

        require_collisions(collisions, self.problem.robot.tree)
        target = as_path("path", path)
        write_chart(target, self.problem, self.coordinates, self.notes, self.certificate, force, collisions)

    @cached_property
    def parts(self) -> ChartParts:
        """What other packages of orthocas use of a chart; it may change without notice."""
        return ChartParts(self)


@dataclass(frozen=True, eq=False, repr=False)
class GrownChart(Chart):
    """A chart with grown coordinates. It has the interface of a fitted chart except for `function`.

    `coordinates.leaf` is the base leaf. `coordinates.pull` gives the point of it that each q flows to, with a status.
    """

    coordinates: GrownCoordinates

    def __post_init__(self) -> None:
        from orthocas.exact.flow import GrownCoordinates  # flows and meshes, which fitted charts do not need

        if not isinstance(self.coordinates, GrownCoordinates):
            raise InvalidValueError(
                "chart",
                f"one with {getattr(self.coordinates, 'label', type(self.coordinates).__name__)} coordinates",
                "a grown chart",
            )
        Chart.__post_init__(self)


def load_file(path: Path) -> Chart:
    """Read a chart file. A grown chart comes back as a `GrownChart`."""
    from orthocas.charts.chart_file import read_chart  # all that files may hold, which a fit does not need
    from orthocas.exact.flow import GrownCoordinates

    problem, coordinates, notes, certificate = read_chart(path)
    if isinstance(coordinates, GrownCoordinates):
        return GrownChart(problem, coordinates, notes)
    return Chart(problem, coordinates, notes, certificate)
