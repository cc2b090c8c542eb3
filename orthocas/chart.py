"""Charts phi(q) = [h(q); xi(q)]: task and extra coordinates together, with Jacobian and inverse map."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.certificates.certificate import Certificate
from orthocas.checks import (
    Array,
    as_float_array,
    as_path,
    as_point,
    as_point_set,
    require_at_least,
    require_kind,
    require_known,
    require_shape,
)
from orthocas.coordinates.fitted import Coordinates
from orthocas.coordinates.map import CoordinateMap, InvertibleMap
from orthocas.errors import InvalidValueError, NoExpressionError, ShapeError, SingularTaskError
from orthocas.files.chart_file import fingerprint, read_chart, write_chart
from orthocas.growing import GrownCoordinates
from orthocas.inverting import (
    FewRows,
    Inverse,
    LocalSolver,
    Nearest,
    Newton,
    OwnInverse,
    PhiMap,
    PointFunctions,
    Solutions,
    Tracker,
    inverse_function,
)
from orthocas.judging.pointwise import PointQuality, point_quality
from orthocas.problem import Problem, task_jacobians, task_sizes
from orthocas.reaching.intervals import XiRange, xi_range
from orthocas.reaching.self_motion import SelfMotion, self_motion
from orthocas.showing import Shown, listed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Symbolic = TypeVar("Symbolic", ca.SX, ca.MX)
FUNCTIONS = ("xi", "phi", "jacobian", "second_derivative", "task", "task_jacobian", "inverse")


@dataclass(frozen=True, eq=False, repr=False)
class Chart(Shown):
    """A problem and its fitted or grown coordinates xi(q) ([AS2023] eq. (27)).

    Methods take one joint position (n,), a column (n, 1), or a set (N, n), [rad] or [m]. The methods xi, task, phi and
    jacobian also take a CasADi column (n, 1), SX or MX, and return an expression. Grown coordinates are NaN at points
    from which the flow does not reach the charted part of the base leaf.

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
            self.certificate.require_for(fingerprint(self.problem, self.coordinates))

    def __reduce__(self) -> tuple[type[Self], tuple[Any, ...]]:
        """Pickle and copy the fields, with the notes as a plain dict: a read-only mapping supports neither."""
        parts = {part.name: getattr(self, part.name) for part in fields(self)}
        return type(self), tuple((parts | {"notes": dict(self.notes)}).values())

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.problem.n

    @property
    def m(self) -> int:
        """Number of task components."""
        return self.problem.m

    @property
    def r(self) -> int:
        """Number of extra coordinates."""
        return self.problem.r

    def facts(self) -> dict[str, str]:
        """Coordinates, problem, and how it was made."""
        problem = self.problem.facts()
        made = listed(
            f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in self.notes.items()
        )
        return {
            "chart": f"{self.coordinates.label} coordinates of {self.problem.heading}",
            "phi": listed(self.labels),
            "parameters": str(self.coordinates.size),
            **{name: problem[name] for name in ("task", "metric", "domain")},
            **({"made by": made} if made else {}),
            **({"certificate": self.certificate.heading} if self.certificate else {}),
        }

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the components of phi: those of the task, then xi1, xi2, ..."""
        return (*self.problem.task.labels, *(f"xi{k + 1}" for k in range(self.r)))

    def runnable(self, graph: ca.Function) -> ca.Function:
        """The fast form of a graph of this chart's functions: scalar code, or the graph itself for networks."""
        matrices = isinstance(self.coordinates, Coordinates) and self.coordinates.as_matrices
        return graph if matrices else scalar_code(graph)

    @overload
    def xi(self, q: Symbolic) -> Symbolic: ...
    @overload
    def xi(self, q: ArrayLike) -> Array: ...
    def xi(self, q: Any) -> Any:
        """Extra coordinates, (r,) or (N, r)."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("xi", q)
        points, single = as_point_set("q", q, self.n)
        values = self.coordinates.xi(points)
        return values[0] if single else values

    @overload
    def task(self, q: Symbolic) -> Symbolic: ...
    @overload
    def task(self, q: ArrayLike) -> Array: ...
    def task(self, q: Any) -> Any:
        """Task values x = h(q), (m,) or (N, m)."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("task", q)
        points, single = as_point_set("q", q, self.n)
        values = self.problem.task.batched(points)[0]
        return values[0] if single else values

    @overload
    def phi(self, q: Symbolic) -> Symbolic: ...
    @overload
    def phi(self, q: ArrayLike) -> Array: ...
    def phi(self, q: Any) -> Any:
        """Task values and extra coordinates stacked, (n,) or (N, n)."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("phi", q)
        points, single = as_point_set("q", q, self.n)
        phi = np.empty((len(points), self.n))
        self.problem.task.batched.into(phi[:, : self.m], points)
        self._coordinates_into("xi", phi[:, self.m :], points)
        return phi[0] if single else phi

    @overload
    def jacobian(self, q: Symbolic) -> Symbolic: ...
    @overload
    def jacobian(self, q: ArrayLike) -> Array: ...
    def jacobian(self, q: Any) -> Any:
        """J = dphi/dq, (n, n) or (N, n, n); task rows first."""
        if isinstance(q, ca.SX | ca.MX):
            return self._expression("jacobian", q)
        points, single = as_point_set("q", q, self.n)
        J = np.empty((len(points), self.n, self.n))
        task_jacobians(self.problem, points, J[:, : self.m])
        self._coordinates_into("jacobian", J[:, self.m :], points)
        return J[0] if single else J

    def quality(self, q: ArrayLike) -> PointQuality:
        """How good the chart is at one joint position (n,), or at each of a set or a path (N, n).

        Returns:
            The leak of each coordinate [deg], the conditioning, and the distance to the border of the domain. The leak
            is the angle in the metric between the gradient of a coordinate and the space orthogonal to the task.

        Raises:
            ShapeError, InvalidValueError: if q has another number of joints, or is not finite.

        Example:
            >>> import orthocas as oc
            >>> from orthocas import problems
            >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
            >>> quality = chart.quality([0.6, 0.8, 0.8])  # the centre, where linear coordinates are exact
            >>> bool(quality.leak_deg.max() < 1e-4), float(quality.border_distance.round(3))
            (True, 0.393)
        """
        points, single = as_point_set("q", q, self.n)
        found = point_quality(self.problem, self.coordinates, points)
        if single:
            found = PointQuality(found.leak_deg[0], found.conditioning[0], found.border_distance[0])
        return found

    def xi_range(self, q: ArrayLike) -> XiRange:
        """How far each extra coordinate reaches alone from q, the task value and the other coordinates held.

        For each coordinate, the curve through q along which only that coordinate changes is followed in both directions
        until it leaves the domain or meets a fold. The ends are exact to 1e-9; the path between them is checked at
        steps of at most 0.1 rad or m.

        Args:
            q: a joint position (n,) inside the domain.

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
        return xi_range(self, q)

    def self_motion(self, q: ArrayLike, step: float = 0.05, samples: int = 1000) -> SelfMotion:
        """What can move at the task value of q without leaving the domain.

        With r = 1 it is the curve through q, followed along the null space of J_x in both directions until it leaves
        the domain or closes. It goes on where the coordinate turns back. With r > 1 it is a set of points on a lattice
        in xi, filled from q on, and as far as the chart does not fold. All points have the task value of q to 1e-9.

        Args:
            q: a joint position (n,) inside the domain.
            step: for r = 1: the largest distance of points along the curve [rad] or [m].
            samples: for r > 1: about how many points, at most 10,000.

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
            >>> motion.closed, motion.q.shape[1], round(float(abs(chart.task(motion.q) - motion.x).max()), 9)
            (False, 3, 0.0)
        """
        return self_motion(self, q, step, samples)

    def plot(self) -> "Figure":
        """The arm along each coordinate, as far as it reaches from the centre of the domain, with the task held.

        Returns:
            A matplotlib figure with one panel for each coordinate, which notebooks show.

        Raises:
            InvalidValueError: if the chart is not finite at the centre of the domain.
        """
        figure: Figure = import_module("orthocas.plotting").self_motion_figure(self, reach=None)
        return figure

    def inverse(self, phi: ArrayLike, q_start: ArrayLike | None = None, tolerance: float = 1e-9) -> Array:
        """Solve phi(q) = phi for q: fitted charts by Newton's method with line search, grown ones along the flow.

        Args:
            phi: target values, (n,) or (N, n).
            q_start: initial guess (n,), or (N, n) with one guess per row of phi; default: starts that are found as in
                `solve`. For grown coordinates it selects the number of full turns and the sheet of a linear leaf.
            tolerance: largest remaining |phi(q) - phi|, relative to the sizes of the components, `phi_sizes`.

        Returns:
            q, (n,) or (N, n). It may lie outside the domain; check with `orthocas.contains`.

        Raises:
            InverseError: if no solution is found, or J is singular there. The message names the rows.
        """
        targets, single = as_point_set("phi", phi, self.n)
        if q_start is not None:
            as_point_set("q_start", q_start, self.n)
        q = self.solve(targets, q_start, tolerance=tolerance).require(inside=False).q
        return q[0] if single else q

    def solve(
        self,
        phi: ArrayLike,
        q_start: ArrayLike | None = None,
        *,
        tolerance: float = 1e-9,
        inside: bool = False,
        local: LocalSolver | None = None,
    ) -> Solutions:
        """Solve phi(q) = phi for q, with a status for each row: a row that fails does not disturb the others.

        Newton's method works on all rows at once. With `q_start`, it searches from there only, and q is the solution
        near the start. Otherwise it starts at a rough inverse of phi, a polynomial fitted to points of the domain.
        Rows that do not lead to a solution inside the domain start again at its centre, and at the 8 points of a table
        whose phi is nearest.

        Args:
            phi: target values, (n,) or (N, n). Rows that are not finite get the status BAD_INPUT.
            q_start: initial guess (n,), or (N, n) with one guess per row of phi.
            tolerance: largest remaining |phi(q) - phi|, relative to the sizes of the components, `phi_sizes`.
            inside: keep q in the domain, and so within the joint limits. Rows without a solution there, from q_start or
                other starts, get the q inside with the same x and the nearest xi that Ipopt finds (10 ms a row),
                status NEAREST, or OUT_OF_REACH if none has that x. Not for grown coordinates.
            local: another solver of phi(q) = phi near given starts; `orthocas.compile_inverse` has one.

        Returns:
            `Solutions` with q (N, n), status, iterations, error and distance (N,); N = 1 for one phi.

        Raises:
            ShapeError: if a row has another number of entries, or q_start another number of rows.
            NoExpressionError: if `inside` is asked of grown coordinates.

        Source:
            ours: docs/inverse.md.
        """
        require_at_least("tolerance", tolerance, 0)
        targets = self._rows("phi", phi)
        starts = None if q_start is None else self._rows("q_start", q_start)
        if starts is None and isinstance(self.coordinates, InvertibleMap):
            starts = self.problem.domain.centre[None]
        if starts is not None:
            if len(starts) not in (1, len(targets)):
                raise ShapeError("q_start", starts.shape, targets.shape)
            starts = np.broadcast_to(starts, targets.shape)
        require_kind("inside", inside, bool)
        if local is not None and not callable(local):
            raise InvalidValueError("local", repr(local)[:80], "a function of targets and starts")
        if inside:
            self._require_expression("inside=True")
        inverse = self._inverse if local is None else replace(self._inverse, local=local)
        return inverse.solve(targets, starts, float(tolerance), inside)

    def solutions(self, phi: ArrayLike, tolerance: float = 1e-9) -> Array:
        """All q inside the domain with phi(q) = phi that a search from 1,026 starts finds.

        A chart that does not fold has one at most. The search is no proof: it may miss solutions near folds.

        Args:
            phi: target values, (n,).
            tolerance: as in `solve`.

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
        require_at_least("tolerance", tolerance, 0)
        self._require_expression("a search for all solutions")
        return self._inverse.all_inside(as_point("phi", phi, self.n), float(tolerance))

    def tracker(self, q0: ArrayLike, largest_step: ArrayLike | None = None) -> Tracker:
        """A tracker that follows a stream of phi from q0; see `Tracker`.

        Args:
            q0: a joint position inside the domain, (n,).
            largest_step: largest change of each joint in a call, (n,) or one number [rad] or [m]; default: a tenth of
                the half-widths of the domain.

        Raises:
            NoExpressionError: if the coordinates are grown.
            InvalidValueError: if q0 lies outside the domain, or J is singular there.
        """
        self._require_expression("a tracker")
        return Tracker(self._point_functions, self.problem.domain, q0, largest_step)

    def function(self, name: str) -> ca.Function:
        """A CasADi function: xi, phi, jacobian, task, task_jacobian, second_derivative or inverse.

        The input q is a column (n, 1). second_derivative takes q, v, w (n, 1) and returns d^2 phi(q)[v, w] =
        (d/ds) J(q + s v) w, (n, 1). For v = dq this is dJ/dt w. inverse takes phi and q_start (n, 1), and returns q
        (n, 1) with phi(q) = phi, or NaN where Newton's method finds none. Its derivatives are those of the implicit
        function theorem, of any order; so it can be part of an optimal control problem.

        Raises:
            UnknownNameError: if there is no such function.
            NoExpressionError: if the coordinates are grown. `orthocas.distil` fits an expression to them.
        """
        require_known("chart function", name, FUNCTIONS)
        if name == "task":
            return self.problem.task.function
        if name == "inverse":
            return self._inverse_function
        return self.problem.task.jacobian_function if name == "task_jacobian" else self._functions[name]

    def _expression(self, name: str, q: Any) -> Any:
        """Evaluate a function at a CasADi column (n, 1)."""
        require_shape("q", q.shape, (self.n, 1))
        return self.function(name)(q)

    def _coordinates_into(self, name: str, results: Array, points: Array) -> None:
        """Write xi or its Jacobian at points (N, n) to part of an array."""
        if isinstance(self.coordinates, Coordinates):
            self.coordinates.into(name, results, points)
        else:
            results[...] = getattr(self.coordinates, name)(points)

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write a self-contained chart file. It replaces a chart file of that name, and with `force` any other file.

        Raises:
            ChartFileError: if the folder is missing or cannot be written, if there is a file that is no chart, or a
                symbolic link.
        """
        write_chart(as_path("path", path), self.problem, self.coordinates, self.notes, self.certificate, force)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a chart file. Loading never runs code from the file.

        Raises:
            ChartFileError: if the file is missing, truncated, foreign, edited, or from a newer version.
        """
        return cls(*read_chart(as_path("path", path)))

    @cached_property
    def _functions(self) -> dict[str, ca.Function]:
        q = ca.MX.sym("q", self.n)
        task, coordinates = self.problem.task, self.coordinates.functions
        x, J_x = task.function(q), task.jacobian_function(q)
        xi, J_xi = coordinates["xi"](q), coordinates["jacobian"](q)
        outputs = {
            "xi": xi,
            "phi": ca.vertcat(x, xi),
            "jacobian": ca.vertcat(J_x, J_xi),
        }
        functions = {name: ca.Function(name, [q], [ca.densify(out)], ["q"], [name]) for name, out in outputs.items()}
        v, w = ca.MX.sym("v", self.n), ca.MX.sym("w", self.n)
        second = ca.vertcat(task.second_derivative_function(q, v, w), coordinates["second_derivative"](q, v, w))
        functions["second_derivative"] = ca.Function(
            "second_derivative", [q, v, w], [ca.densify(second)], ["q", "v", "w"], ["second_derivative"]
        )
        return functions

    @cached_property
    def phi_sizes(self) -> Array:
        """Sizes of the components of phi, (n,): how far task components move over the domain, and 1 for xi."""
        return np.concatenate([task_sizes(self.problem), np.ones(self.r)])

    @cached_property
    def phi_map(self) -> PhiMap:
        """phi and J for solvers of phi(q) = phi."""
        return PhiMap(self.phi, self._jacobian_or_nan, self.phi_sizes)

    @cached_property
    def _inverse(self) -> Inverse:
        phi_map = self.phi_map
        if isinstance(self.coordinates, InvertibleMap):
            return Inverse(self.problem, phi_map, OwnInverse(self.coordinates, phi_map, self.m))
        local = FewRows(phi_map, self._point_functions, Newton(phi_map))
        return Inverse(self.problem, phi_map, local, Nearest(self.problem, self.function("phi"), phi_map))

    @cached_property
    def _inverse_function(self) -> ca.Function:
        return inverse_function(self.function("phi"), self.phi_sizes)

    @cached_property
    def _point_functions(self) -> PointFunctions:
        return PointFunctions.of(self.function("phi"), self.function("jacobian"), self.phi_sizes)

    def _jacobian_or_nan(self, points: Array) -> Array:
        """J at points (N, n), with NaN where the task has no finite Jacobian."""
        try:
            return self.jacobian(points)
        except SingularTaskError:
            J_x = self.problem.task.batched_jacobian(points)[0].reshape(-1, self.m, self.n)
            return np.concatenate([J_x, self.coordinates.jacobian(points)], axis=1)

    def _require_expression(self, what: str) -> None:
        """Raise NoExpressionError if the coordinates are grown."""
        if isinstance(self.coordinates, InvertibleMap):
            raise NoExpressionError(f"{what} needs coordinates with a CasADi expression; received grown coordinates")

    def _rows(self, name: str, value: ArrayLike) -> Array:
        """One point or a set, as `as_point_set` takes them, but finite or not, (N, n)."""
        array = as_float_array(name, value)
        as_point_set(name, np.zeros_like(array), self.n)
        return array.reshape(-1, self.n)


@dataclass(frozen=True, eq=False, repr=False)
class GrownChart(Chart):
    """A chart with grown coordinates. It has the interface of a fitted chart except for `function`.

    `coordinates.leaf` is the base leaf. `coordinates.pull` gives the point of it that each q flows to, with a status.
    """

    coordinates: GrownCoordinates

    def __post_init__(self) -> None:
        if not isinstance(self.coordinates, GrownCoordinates):
            raise InvalidValueError(
                "chart",
                f"one with {getattr(self.coordinates, 'label', type(self.coordinates).__name__)} coordinates",
                "a grown chart",
            )
        Chart.__post_init__(self)


def load(path: str | Path) -> Chart:
    """Read a chart file; see `Chart.load`. A grown chart comes back as a `GrownChart`.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Linear()).chart
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "arm.orthocas"
        ...     chart.save(path)
        ...     again = oc.load(path)
        >>> bool((again.xi([0.7, 0.9, 0.6]) == chart.xi([0.7, 0.9, 0.6])).all())
        True
    """
    chart = Chart.load(path)
    if isinstance(chart.coordinates, GrownCoordinates):
        return GrownChart(chart.problem, chart.coordinates, chart.notes)
    return chart
