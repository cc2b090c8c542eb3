"""Motions to play: runs, joint motions, their files, and a tool path followed by two methods."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.trackers import TrackerStatus
from orthocas.errors import InvalidValueError, PathError, PathFileError
from orthocas.paths.joint_motion import JointMotion, read_joints
from orthocas.robots.robot import Robot
from orthocas.simulation.trajectory import Trajectory
from orthocas.tools.checks import Array, as_float_array, as_point_set, freeze_array, require_count, require_kind
from orthocas.tools.files import find_columns, read_table
from orthocas.viewer.looks import RULES

_TIME = "time_s"


@dataclass(frozen=True, eq=False)
class Motion:
    """Joint positions over time, with associated quantities."""

    name: str
    times: Array  #: (N,) [s], increasing
    q: Array  #: (N, n) [rad] or [m]
    labels: tuple[str, ...]  #: names of the quantities
    values: Array  #: (N, k)
    references: Array | None = None  #: (N, k) references of the quantities
    marked: NDArray[np.bool_] | None = None  #: (N,) whether the controller used its fallback
    cycles: tuple[float, ...] = ()  #: ends of the cycles, if the motion repeats a path [s]
    commands: Array | None = None  #: (N, n) commands of a controller
    kind: str = "torque"  #: kind of the commands: "torque" or "velocity"

    def __post_init__(self) -> None:
        for name in ("times", "q", "values"):
            object.__setattr__(self, name, as_float_array(name, getattr(self, name)))

    @classmethod
    def of_run(cls, run: Trajectory) -> "Motion":
        """Convert a simulated run."""
        return cls(
            run.controller,
            run.times,
            run.q,
            run.labels,
            run.value,
            run.reference,
            run.fell_back,
            (),
            run.command,
            run.kind,
        )

    @classmethod
    def of_path(cls, motion: JointMotion) -> "Motion":
        """Convert a motion along a tool path."""
        return cls("tool path", motion.times, motion.q, motion.labels, np.hstack([motion.x, motion.xi]))

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self.times[-1] - self.times[0])

    def at(self, seconds: float) -> Array:
        """The joint position (n,) at a time after the start [s]."""
        t = self.times[0] + seconds
        return np.array([np.interp(t, self.times, column) for column in self.q.T])

    def index(self, seconds: float) -> int:
        """The index of the last instant up to a time after the start [s]."""
        return int(np.clip(np.searchsorted(self.times, self.times[0] + seconds + 1e-9) - 1, 0, len(self.times) - 1))

    def returns(self, seconds: float) -> list[tuple[int, float]]:
        """For each finished cycle: its number, and the largest distance of a joint from its start [deg]."""
        over = [(k, end) for k, end in enumerate(self.cycles, 1) if end <= seconds + 1e-9]
        return [(k, float(np.degrees(np.abs(self.at(end) - self.q[0]).max()))) for k, end in over]


def require_joints(names: tuple[str, ...], robot: Robot, what: str) -> None:
    """Raise InvalidValueError unless a motion has exactly the joints of a robot."""
    if names != robot.joint_names:
        raise InvalidValueError(f"joints of {what}", ", ".join(names), ", ".join(robot.joint_names))


def read_run(path: Path, robot: Robot) -> Motion:
    """Read a file of `orthocas simulate`.

    Raises:
        TrajectoryFileError: if the file is not a run.
        InvalidValueError: if its joints are not those of the robot.
    """
    run = Trajectory.load(path)
    require_joints(run.joint_names, robot, str(path))
    return Motion.of_run(run)


def read_joint_motion(path: Path, robot: Robot) -> Motion:
    """Read a file of `orthocas follow`: a header with time_s and the names of all joints, then one row per instant.

    Columns of velocities and accelerations are ignored; other columns are quantities to show. In an MCAP file of
    rosbag2, the JointState messages are read.

    Raises:
        PathFileError: names the file and the error.
    """
    if path.suffix.lower() == ".mcap":
        times, q = read_joints(path, robot)
        # Keep the first of several messages with equal time.
        kept = np.append(True, np.diff(times) > 0)
        return Motion(path.stem, times[kept], q[kept], (), np.zeros((int(kept.sum()), 0)))
    header: list[str] = []

    def choose_columns(names: Sequence[str]) -> list[int]:
        find_columns(names, (_TIME, *robot.joint_names))
        header.extend(names)
        return find_columns(names, names)

    table = read_table(path, "motion file", "instants", RULES.most_instants, choose_columns)
    # Quantities are columns other than time, joints and their rates.
    rates = {f"{order}_{name}" for order in ("d", "dd") for name in robot.joint_names}
    labels = tuple(name for name in header if name not in {_TIME, *robot.joint_names, *rates})
    times, q, values = (
        table[:, [header.index(name) for name in names]] for names in ([_TIME], robot.joint_names, labels)
    )
    if (np.diff(times[:, 0]) <= 0).any():
        raise PathFileError(f"motion file {path}: time_s does not increase in every line")
    arrays = (freeze_array("a column", part, (None, None)) for part in (q, values))
    return Motion(Path(path).stem, times[:, 0], next(arrays), labels, next(arrays))


def write_joints(names: Sequence[str], times: Array, q: Array) -> str:
    """Write the text of a motion file for `read_joint_motion`: times (N,) [s] from 0, and joint positions (N, n)."""
    kept = np.append(True, np.diff(times) > 0)
    rows = np.column_stack([times - times[0], q])[kept]
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows.tolist()]
    return "\n".join([",".join([_TIME, *names]), *lines, ""])


Place = Callable[[Array], Array]  #: fraction of a cycle (N,) -> task values (N, m)


def cyclic_motions(chart: Chart, path: Array | None = None, cycles: int = 3) -> tuple[Motion, Motion]:
    """Motions along a closed tool path: the first with constant xi, the second by the pseudo-inverse.

    The second motion takes the shortest joint step in each interval, q' = q + J_x^+ (x' - h(q)), with corrections until
    the tool is on the path. Both motions begin at the centre of the domain.

    Args:
        chart: a fitted chart.
        path: task values of waypoints of a closed path (N, m), joined by straight lines. Its first point should be near
            the task value at the centre. Default: the largest circle there, of several candidates, that the chart can
            follow.
        cycles: number of repetitions.

    Raises:
        PathError: if the path is not closed, or leaves the domain with constant xi.
        NoExpressionError: for grown charts.
    """
    require_kind("chart", chart, Chart)
    require_count("cycles", cycles, most=RULES.most_cycles)
    # Time stamps [s], and the completed fraction of a cycle; each cycle starts and ends at rest.
    t = np.linspace(0.0, 1.0, RULES.cycle_points + 1)
    fraction = t**3 * (10 - 15 * t + 6 * t**2)
    times = RULES.cycle * np.concatenate([[0.0], *(k + t[1:] for k in range(cycles))])
    fractions = np.concatenate([[0.0], *(fraction[1:] for _ in range(cycles))])
    start = chart.problem.domain.home
    if path is None:
        along, q = _find_largest_circle(chart, start, fractions)
    else:
        # The path must be closed, measured in sizes of the task.
        points, _ = as_point_set("path", path, chart.m)
        sizes = chart.parts.phi_sizes[: chart.m]
        if len(points) < 3 or np.abs((points[-1] - points[0]) / sizes).max() > RULES.same_ends:
            raise PathError(f"the path of {len(points)} waypoints is not closed, expected its last to be its first")
        along = join_waypoints(points, sizes)
        q = _follow_with_constant_xi(chart, along(fractions), start)
    x = along(fractions)
    ends = tuple(RULES.cycle * (k + 1) for k in range(cycles))
    other = _follow_by_pseudo_inverse(chart, x, q[0])
    labels = chart.labels[: chart.m]
    return (
        Motion("constant ξ", times, q, labels, x, cycles=ends),
        Motion("pseudo-inverse", times, other, labels, chart.x(other), cycles=ends),
    )


def _find_largest_circle(chart: Chart, start: Array, fractions: Array) -> tuple[Place, Array]:
    """The largest circle in two of the task's first three components, or line in one, that the chart can follow."""
    # Try circles through the start, on either side of it in each plane, with decreasing size.
    x0, sizes = chart.x(start), chart.parts.phi_sizes[: chart.m]
    alike = [k for k in range(min(chart.m, 3)) if chart.problem.task.units[k] == chart.problem.task.units[0]]
    sides = [(i, j, sign) for i in alike for j in alike if i != j for sign in (-1.0, 1.0)] or [(0, 0, 1.0)]

    def place(radius: float, first: int, second: int, sign: float, fraction: Array) -> Array:
        angle = 2 * np.pi * fraction
        x = np.repeat(x0[None], len(fraction), axis=0)
        x[:, first] += sign * radius * (np.cos(angle) - 1)
        x[:, second] += radius * np.sin(angle) * (first != second)
        return x

    largest = RULES.circle * float(sizes[alike].min())
    for radius in largest / 1.3 ** np.arange(np.log(RULES.circle / RULES.smallest_circle) / np.log(1.3) + 1):
        for side in sides:
            along = partial(place, radius, *side)
            try:
                return along, _follow_with_constant_xi(chart, along(fractions), start)
            except PathError as error:
                last = error
    raise last


def join_waypoints(points: Array, sizes: Array) -> Place:
    """Straight lines between waypoints (N, k), as a function of the fraction of their length in sizes (k,)."""
    lengths = np.linalg.norm(np.diff(points, axis=0) / sizes, axis=1)
    if not lengths.sum() > 0:
        raise InvalidValueError("path", "one point", "waypoints at different places")
    place = np.append(0.0, np.cumsum(lengths)) / lengths.sum()
    return lambda fraction: np.column_stack([np.interp(fraction, place, column) for column in points.T])


def _follow_with_constant_xi(chart: Chart, x: Array, start: Array) -> Array:
    """Joint positions (N, n) with task values x (N, m) and the xi of the start."""
    # Solve for the first point, and track the others.
    xi = chart.xi(start)
    q = chart.solve(np.concatenate([x[0], xi]), start).require(inside=True).q[0]
    tracker = chart.tracker(q)
    positions = np.empty((len(x), chart.n))
    for k, value in enumerate(x):
        positions[k] = tracker.step(np.concatenate([value, xi]))
        if tracker.status is not TrackerStatus.OK:
            raise PathError(
                f"the path cannot be followed with constant xi from point {k} of {len(x)}: {tracker.status.name}"
            )
    return positions


def _follow_by_pseudo_inverse(chart: Chart, x: Array, start: Array) -> Array:
    """Joint positions (N, n) with task values x (N, m), each by the shortest step from the previous one."""
    task, q = chart.problem.task, start
    positions = np.empty((len(x), chart.n))
    for k, value in enumerate(x):
        for _ in range(RULES.corrections + 1):
            J = task.batched_jacobian(q[None])[0].reshape(chart.m, chart.n)
            q = q + np.linalg.lstsq(J, value - chart.x(q), rcond=None)[0]
        positions[k] = q
    return positions
