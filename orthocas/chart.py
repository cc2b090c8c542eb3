"""Charts phi(q) = [h(q); xi(q)]: task and extra coordinates together, with Jacobian and inverse map."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.scalar_code import scalar_code
from orthocas.certificates.certificate import Certificate
from orthocas.checks import Array, as_path, as_point_set, require_at_least, require_kind, require_known, require_shape
from orthocas.coordinates.fitted import Coordinates
from orthocas.coordinates.inverse import NewtonInverse, error_scale, require_solved
from orthocas.coordinates.map import CoordinateMap, InvertibleMap
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.files.chart_file import fingerprint, read_chart, write_chart
from orthocas.growing import GrownCoordinates
from orthocas.judging.pointwise import PointQuality, point_quality
from orthocas.problem import Problem, task_jacobians, task_sizes
from orthocas.reaching.intervals import XiRange, xi_range
from orthocas.reaching.self_motion import SelfMotion, self_motion
from orthocas.showing import Shown, listed

Symbolic = TypeVar("Symbolic", ca.SX, ca.MX)
FUNCTIONS = ("xi", "phi", "jacobian", "second_derivative", "task", "task_jacobian")


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

    def inverse(self, phi: ArrayLike, q_start: ArrayLike, tolerance: float = 1e-9) -> Array:
        """Solve phi(q) = phi for q: fitted charts by Newton's method with line search, grown ones along the flow.

        Args:
            phi: target values, (n,) or (N, n).
            q_start: initial guess (n,), or (N, n) with one guess per row of phi. For grown coordinates it selects the
                number of full turns and the sheet of a linear leaf.
            tolerance: largest remaining |phi(q) - phi|, relative to the sizes of the components, `phi_sizes`.

        Returns:
            q, (n,) or (N, n). It may lie outside the domain; check with `orthocas.contains`.

        Raises:
            InverseError: if there is no solution near q_start, or J becomes singular on the way. The message names the
                rows.
        """
        require_at_least("tolerance", tolerance, 0)
        targets, single = as_point_set("phi", phi, self.n)
        starts, _ = as_point_set("q_start", q_start, self.n)
        if len(starts) not in (1, len(targets)):
            raise ShapeError("q_start", starts.shape, targets.shape)
        starts = np.broadcast_to(starts, targets.shape)
        if isinstance(self.coordinates, InvertibleMap):
            solutions = self.coordinates.inverse(targets, starts)
        else:
            solutions = self._newton.solve(targets, starts)
        solutions = solutions.reshape(-1, self.n)
        self._require_solved(solutions, targets, tolerance)
        return solutions[0] if single else solutions

    def function(self, name: str) -> ca.Function:
        """The CasADi function behind a method: xi, phi, jacobian, task, task_jacobian or second_derivative.

        The input q is a column (n, 1). second_derivative takes q, v, w (n, 1) and returns d^2 phi(q)[v, w] =
        (d/ds) J(q + s v) w, (n, 1). For v = dq this is dJ/dt w.

        Raises:
            UnknownNameError: if there is no such function.
            NoExpressionError: if the coordinates are grown. `orthocas.distil` fits an expression to them.
        """
        require_known("chart function", name, FUNCTIONS)
        if name == "task":
            return self.problem.task.function
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
    def _newton(self) -> NewtonInverse:
        return NewtonInverse(self._functions["phi"], self.phi_sizes)

    def _require_solved(self, solutions: Array, targets: Array, tolerance: float) -> None:
        """Check solutions of the inverse map by evaluating them."""
        finite = np.asarray(np.isfinite(solutions).all(axis=1))
        safe = np.where(finite[:, None], solutions, self.problem.domain.centre)
        difference = self.phi(safe) - targets
        if isinstance(self.coordinates, InvertibleMap) and self.coordinates.turn:
            turn = self.coordinates.turn
            difference[:, self.m :] -= turn * np.round(difference[:, self.m :] / turn)
        relative = np.abs(difference / error_scale(targets, self.phi_sizes)).max(axis=1)
        require_solved(np.where(finite, relative, np.inf), self.jacobian(safe), self.phi_sizes, tolerance)


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
