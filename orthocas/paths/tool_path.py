"""Tool paths as splines through waypoints, and path files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import counted_on
from orthocas.errors import InvalidValueError, PathFileError, ShapeError
from orthocas.robots.spatial import build_rotations
from orthocas.tasks.relative import Relative
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array, as_float_array, freeze_array
from orthocas.tools.files import RULES as FILE_RULES
from orthocas.tools.files import find_columns, read_table

MOST_WAYPOINTS = 100_000


@dataclass(frozen=True, slots=True)
class PathRules:
    """Numbers of tool paths and of motions along them."""

    samples: int = 501  #: samples of a path that is given as a function
    same_ends: float = 1e-9  #: distance of the ends of closed paths, relative to the sizes of the task

    residual: float = 1e-10  #: residual of phi at all positions of a motion, relative to `ChartParts.phi_sizes`
    curve_step: float = 0.15  #: longest step of q along the path [rad] or [m]
    first_step: float = 0.01  #: first step of s
    shortest_step: float = 1e-6  #: step of s below which the path is lost

    law_degree: int = 3  #: degree of the spline z(s), the square of the speed
    law_pieces: int = 60  #: number of pieces of that spline
    parts: int = 300  #: parts of the path; in each, the limits are imposed where a joint turns most
    part_places: int = 8  #: places in each part
    turning_slope: float = 0.01  #: smallest slope of a joint, as a fraction of its largest, where the path reverses
    time_steps: int = 6000  #: steps in the integration of time
    least_square: float = 1e-9  #: smallest z inside the path, relative to its largest value

    to_full_speed: float = 0.5  #: [s] to reach the velocity limit under the default acceleration limits
    instants: int = 2001  #: instants at which the limits are checked in addition to the time stamps
    stretches: int = 20  #: largest number of stretchings of time until the limits hold
    stretch_margin: float = 1.001  #: factor by which time is stretched beyond the need
    most_stamps: int = 1_000_000
    returns: float = 1e-8  #: tolerance of phi for a path that ends where it began, relative to its sizes

    scale_samples: int = 256  #: samples of the domain, for the scale of the task Jacobian
    inside: float = 0.97  #: fraction of the half-width beyond which a joint's residual continues as a straight line
    regular: float = 0.1  #: scale of the residual of the relative singular value
    nearly_singular: float = 0.02  #: singular value below which that residual continues as a straight line
    away: float = 0.02  #: scale of the residual of a pair's distance [m]
    nearest: int = 6  #: number of nearest pairs of parts with such residuals, by bounds of their capsules
    stations: int = 49  #: stations of the search of all xi, for paths that contacts block
    station_parts: int = 8  #: parts of each step along the self-motions there, of up to 0.4 rad or m
    station_postures: int = 300  #: most postures of a station
    station_step: float = 0.35  #: longest joint step between stations [rad] or [m]
    station_places: int = 3  #: places between two stations at which edges are checked
    too_near: float = 0.004  #: distance below which the residual of a pair continues as a straight line [m]

    walk_steps: int = 3  #: steps of a walk at each place
    walk_step: float = 0.1  #: longest step of a walk [rad] or [m]
    walk_damping: float = 1e-2
    fewest_pieces: int = 20  #: fewest pieces of the spline xi(s)
    most_pieces: int = 60
    piece_density: float = 10  #: pieces per length of the path, relative to the range of x over the domain
    cost_places: int = 8  #: places on every piece at which costs are evaluated
    speed_weight: float = 2e-2  #: weight of the square of xi'
    bend_weight: float = 1e-4  #: weight of the square of xi''
    iterations: int = 40
    least_gain: float = 1e-3  #: the iterations end if the cost decreases by less than this, relative
    damping: float = 1e-2  #: initial damping
    most_damping: float = 1e8


RULES = PathRules()
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")  #: columns of poses in files: position [m] and unit quaternion


def sample_path(name: str, path: Any, size: int, labels: tuple[str, ...]) -> Array:
    """The points (N, size) of a path: an array, or 501 values of a function of s in [0, 1].

    Raises:
        InvalidValueError, ShapeError: for anything else. The message names the first bad entry.
    """
    if callable(path):
        rows = []
        for s in np.linspace(0, 1, RULES.samples).tolist():
            try:
                value = path(s)
            except Exception as error:
                raise InvalidValueError(f"{name}({s:g})", f"{type(error).__name__}: {error}", "a value") from None
            rows.append(freeze_array(f"{name}({s:g})", value, (size,)))
        return np.array(rows)
    points = as_float_array(name, path)
    if points.ndim != 2 or points.shape[1] != size:
        raise ShapeError(f"{name} ({', '.join(labels)})", points.shape, (None, size))
    if not 2 <= len(points) <= MOST_WAYPOINTS:
        raise InvalidValueError(f"number of rows of {name}", len(points), f"from 2 to {MOST_WAYPOINTS}")
    bad = np.argwhere(~np.isfinite(points))
    if bad.size:
        row, column = (int(k) for k in bad[0])
        raise InvalidValueError(f"{labels[column]} of {name}[{row}]", points[row, column], "a finite number")
    return points


class TaskSpline:
    """A spline x(s) through task values; it is cubic, and for a whole orientation it is cubic in unit quaternions.

    Orientations take the shorter turn between waypoints, also through half a turn from the reference of the task.

    Args:
        relative: errors and rates of the task.
        s: parameters (N,).
        points: task values (N, m).
        sizes: sizes of the components, (m,).
    """

    def __init__(self, relative: Relative, s: Array, points: Array, sizes: Array) -> None:
        self._relative, self._s = relative, s
        rows = points
        # Convert orientations to quaternions, each with the sign nearer to the previous one.
        if relative.turned:
            p = Batched(relative.task.quaternion_function)(points)[0]
            turns = np.where((p[1:] * p[:-1]).sum(axis=1) < 0, -1.0, 1.0)
            p = p * np.concatenate([[1.0], np.cumprod(turns)])[:, None]
            rows = np.hstack([points[:, : relative.first], p])
            sizes = np.concatenate([sizes[: relative.first], np.ones(4)])
        away = np.abs(rows[-1] - rows[0])
        self.returns = (
            bool((away <= RULES.same_ends * sizes).all()) and len(rows) > 2
        )  #: displacement of the closed path to its first point, without a full turn
        self._rows = rows
        self._curve = build_spline(s, rows, False)

    def close(self) -> TaskSpline:
        """The path as a periodic spline."""
        self._curve = build_spline(self._s, self._rows, True)
        return self

    def __call__(self, s: ArrayLike) -> Array:
        """x at parameters (N,), (N, m), or at one number, (m,)."""
        rows = np.asarray(self._curve(s))
        if not self._relative.turned:
            return rows
        first, p = np.split(rows.reshape(-1, rows.shape[-1]), [self._relative.first], axis=1)
        R = build_rotations(p / np.linalg.norm(p, axis=1, keepdims=True))
        x = np.hstack([first, Batched(self._relative.task.components_function)(R)[0]])
        return np.asarray(x.reshape(*rows.shape[:-1], -1))

    def evaluate_rates(self, s: ArrayLike, order: int) -> Array:
        """The first or second derivative of x. With the J of `Relative.rates`, it is J q' or J q'' + dJ/ds q'."""
        rows = [np.asarray(self._curve(s, k)) for k in range(order + 1)]
        if not self._relative.turned:
            return rows[order]
        first = self._relative.first
        # omega = 2 conj(p) p' / |p|^2 and its derivative, in the tip's axes.
        p, *slopes = (row[..., first:] for row in rows)
        square = (p**2).sum(axis=-1, keepdims=True)
        omega = 2 * _multiply_conjugate(p, slopes[0]) / square
        if order == 2:
            growth = 2 * (p * slopes[0]).sum(axis=-1, keepdims=True) / square
            omega = 2 * _multiply_conjugate(p, slopes[1]) / square - growth * omega
        assert self._relative.task.turn is not None
        return np.concatenate([rows[order][..., :first], omega @ self._relative.task.turn.order.T], axis=-1)


def _multiply_conjugate(a: Array, b: Array) -> Array:
    """The vector part of conj(a) b, (..., 3)."""
    product: Array = a[..., :1] * b[..., 1:] - b[..., :1] * a[..., 1:] - np.cross(a[..., 1:], b[..., 1:])
    return product


def place_waypoints(steps: Array) -> Array:
    """Parameters s (N,) from 0 to 1, proportional to the lengths of the chords (N - 1, k) between points.

    Raises:
        InvalidValueError: if a point equals the previous one.
    """
    chords = np.linalg.norm(steps, axis=1)
    repeated = np.flatnonzero(chords <= 1e-12)
    if repeated.size:
        k = int(repeated[0]) + 1
        raise InvalidValueError(f"waypoint {k}", "the same as the previous one", "different successive waypoints")
    s = np.concatenate([[0.0], np.cumsum(chords)])
    return np.asarray(s / s[-1])


def build_spline(s: Array, points: Array, closed: bool) -> CubicSpline:
    """The spline through points (N, k) at parameters s (N,)."""
    if closed:
        points = np.vstack([points[:-1], points[:1]])
    return CubicSpline(s, points, bc_type="periodic" if closed else "not-a-knot")


@dataclass(frozen=True, eq=False)
class ToolPath:
    """A path of the tool, with a path of the extra coordinates."""

    x: TaskSpline  #: s -> (m,)
    xi: CubicSpline  #: s -> (r,)
    s: Array  #: (N,) parameters of the waypoints
    waypoints: Array  #: (N, m)
    steps: Array  #: steps between waypoints, relative to the sizes of the task components, (N - 1, m)
    is_function: bool  #: whether the path was given as a function, with waypoints as samples of it
    closed: bool

    @classmethod
    def hold(cls, chart: Chart, tool_path: Any, xi: Array) -> ToolPath:
        """A tool path with constant coordinates (r,)."""
        return cls._build(chart, tool_path, np.tile(xi, (2, 1)), np.array([0.0, 1.0]))

    @classmethod
    def schedule(cls, chart: Chart, tool_path: Any, xi: Any) -> ToolPath:
        """A tool path with a schedule: coordinates at the waypoints (N, r), or a function of s."""
        values = counted_on(sample_path("xi", xi, chart.r, chart.labels[chart.m :]), chart.parts.turns[chart.m :])
        if callable(xi) or callable(tool_path):
            return cls._build(chart, tool_path, values, np.linspace(0.0, 1.0, len(values)))
        return cls._build(chart, tool_path, values, None)

    @classmethod
    def _build(cls, chart: Chart, tool_path: Any, xi: Array, s_xi: Array | None) -> ToolPath:
        """Build the splines; the coordinates have parameters of their own, or those of the waypoints (None)."""
        target = chart.task.target
        x = (lambda s: target(tool_path(s))) if callable(tool_path) else target(tool_path)
        x = sample_path("tool_path", x, chart.m, chart.labels[: chart.m])
        if s_xi is None and len(xi) != len(x):
            raise InvalidValueError("number of rows of xi", len(xi), f"{len(x)}, as many as tool_path has")
        # s grows with the chord length, in sizes of the task components.
        steps = chart.parts.relative.difference(x[1:], x[:-1]) / chart.parts.phi_sizes[: chart.m]
        if callable(tool_path):
            s = np.linspace(0.0, 1.0, len(x))
        else:
            s = place_waypoints(np.hstack([steps, np.diff(xi, axis=0)]) if s_xi is None else steps)
        path = TaskSpline(chart.parts.relative, s, x, chart.parts.phi_sizes[: chart.m])
        closed = path.returns and bool(np.abs(xi[-1] - xi[0]).max() < 1e-9)
        curve = build_spline(s if s_xi is None else s_xi, xi, closed and len(xi) > 2)
        return cls(path.close() if closed else path, curve, s, x, steps, callable(tool_path), closed)

    def replace_xi(self, xi: CubicSpline) -> ToolPath:
        """The same tool path with other coordinates."""
        return replace(self, xi=xi)

    def phi(self, s: Array, order: int = 0) -> Array:
        """phi (N, n) at parameters (N,), (n,) at one number; or a derivative, see `TaskSpline.evaluate_rates`."""
        return np.concatenate([self.x.evaluate_rates(s, order) if order else self.x(s), self.xi(s, order)], axis=-1)

    def list_checks(self) -> Array:
        """Parameters (P,) at which the path is checked: at the waypoints and between them."""
        return np.union1d(self.s, np.linspace(0.0, 1.0, 1001))

    def describe_place(self, s: float, labels: tuple[str, ...]) -> str:
        """A parameter's place on the path, in words."""
        x = ", ".join(f"{label} = {value:.4g}" for label, value in zip(labels, self.x(s), strict=False))
        if self.is_function:
            return f"at s = {s:.4g} ({x})"
        k = int(np.searchsorted(self.s, s - 1e-12))
        last = len(self.s) - 1
        if abs(self.s[min(k, last)] - s) < 1e-9:
            return f"at waypoint {k} of 0 to {last} ({x})"
        return f"between waypoints {k - 1} and {k} of 0 to {last} ({x})"


def read_path(path: str | Path, chart: Chart) -> tuple[Array, Array | None]:
    """Read waypoints (N, m), and their coordinates (N, r) if the file has columns for them.

    The columns are the chart's labels, or x, y, z, qw, qx, qy, qz for poses.

    Raises:
        PathFileError: names the file, the line and the error.
    """
    task: tuple[str, ...] = ()

    def find(names: Sequence[str]) -> list[int]:
        nonlocal task
        task = POSE if "qw" in names else chart.labels[: chart.m]
        # Columns of the task, then of the coordinates if there are any.
        extra = chart.labels[chart.m :]
        columns = (*task, *extra) if set(extra) & set(names) else task
        for name in names:
            if name not in (*task, *extra):
                expected = f"{', '.join(task)}, and if the path has a schedule {', '.join(extra)}"
                raise ValueError(f"line 1: unknown column {name[: FILE_RULES.cell]!r}, expected {expected}")
        return find_columns(names, columns)

    values = read_table(path, "path file", "waypoints", MOST_WAYPOINTS, find)
    x, xi = values[:, : len(task)], values[:, len(task) :]
    if task is POSE:
        # Files round to three digits or more. A larger deviation from length 1 is not rounding.
        lengths = np.linalg.norm(x[:, 3:], axis=1)
        if (off := np.flatnonzero(np.abs(lengths - 1) > 5e-3)).size:
            came = f"row {off[0] + 1} has a quaternion of length {lengths[off[0]]:.4g}"
            raise PathFileError(f"path file {path}: {came}, expected 1")
        x[:, 3:] /= lengths[:, None]
        x = chart.task.target((x[:, :3], x[:, 3:]))
    return x, xi if xi.size else None
