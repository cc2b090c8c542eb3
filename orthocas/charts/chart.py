"""Charts phi(q) = [h(q); xi(q)]: task and extra coordinates together, with Jacobian and inverse map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.certificate import Certificate
from orthocas.charts.coordinates import CoordinateMap
from orthocas.charts.methods import InverseMethods
from orthocas.charts.point_quality import PointQuality, point_quality
from orthocas.charts.self_motion import SelfMotion, XiRange, self_motion, xi_range
from orthocas.errors import InvalidValueError
from orthocas.robots.collisions import Collisions
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array, as_path, as_point_set, require_kind
from orthocas.tools.display import Shown, listed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from orthocas.exact.flow import GrownCoordinates


@dataclass(frozen=True, eq=False, repr=False)
class Chart(InverseMethods, Shown):
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

    def xi_range(self, q: ArrayLike, collisions: Collisions | None = None) -> XiRange:
        """How far each extra coordinate reaches alone from q, the task value and the other coordinates held.

        For each coordinate, the curve through q along which only that coordinate changes is followed in both directions
        until it leaves the domain or meets a fold. The ends are exact to 1e-9; the path between them is checked at
        steps of at most 0.1 rad or m.

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

    def plot(self) -> Figure:
        """The arm along each coordinate, as far as it reaches from the centre of the domain, with the task held.

        Returns:
            A matplotlib figure with one panel for each coordinate, which notebooks show.

        Raises:
            InvalidValueError: if the chart is not finite at the centre of the domain.
        """
        from orthocas.charts.figures import self_motion_figure  # with matplotlib, which takes long to import

        return self_motion_figure(self, reach=None)

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

        if collisions is not None:
            require_kind("collisions", collisions, Collisions)
            collisions.require_for(self.problem.robot.tree)
        target = as_path("path", path)
        write_chart(target, self.problem, self.coordinates, self.notes, self.certificate, force, collisions)


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
