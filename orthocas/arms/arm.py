"""`orthocas.Arm`: an arm with charts of all its branches, and its postures for any task value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.arms.arm_file import read_charts, write_charts
from orthocas.arms.chart_kernel import ChartKernel, write_tracker
from orthocas.arms.maps import ArmMaps
from orthocas.arms.self_motion import SelfMotions, find_motions
from orthocas.arms.tracker import ArmTracker, TrackStatus
from orthocas.charts.chart import Chart
from orthocas.charts.inverse import InverseStatus
from orthocas.charts.ready import load, names
from orthocas.charts.walls import Clearance, require_collisions
from orthocas.codegen.generate import require_free_folder, require_name
from orthocas.errors import BranchWarning, DomainError, InvalidValueError, NotRedundantError, ShapeError, warn_caller
from orthocas.fitting.wide import fit_wide
from orthocas.robots.collisions import Collisions
from orthocas.robots.robot import Robot
from orthocas.tasks.branches import branches
from orthocas.tasks.domains import Domain
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.task import Task
from orthocas.tools.batch import run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Indices,
    as_float_array,
    as_number,
    as_path,
    as_point,
    as_point_set,
    require_count,
    require_kind,
    require_known,
)
from orthocas.tools.display import Shown, listed, percent
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.files import make_folder, publish
from orthocas.tools.progress import Monitor, Progress, silent
from orthocas.version import VERSION

ANY = "any"  #: name that stands for all branches


_DATA = files(__package__) / "data"
_WIDE = "-wide"  # ends the names of ready charts that an arm can have


def list_arms() -> tuple[str, ...]:
    """Names of the arms that `Arm.load` knows; each has a ready wide chart."""
    return tuple(name.removesuffix(_WIDE) for name in names() if name.endswith(_WIDE))


@dataclass(frozen=True, slots=True)
class ArmRules:
    """Settings of an arm's searches."""

    spacing: float = 0.05  #: distance of postures on an arc that are checked for contacts or branches [rad] or [m]
    postures: int = 100_000  #: largest number of stored postures of a chart in generated C


RULES = ArmRules()


@dataclass(frozen=True, eq=False, repr=False)
class Postures(Shown):
    """Joint positions with given task values, from `Arm.solve`: for one value, or for several in rows."""

    q: Array  #: (n,) or (N, n), within the joint limits; NaN where none was found
    status: Any  #: `InverseStatus`, or its numbers (N,); with NEAREST and OUTSIDE_DOMAIN, only x is met
    branch: Any  #: name of the branch, or a tuple of names; "" if on no branch
    xi: Array  #: coordinate in the branch's chart, () or (N,); NaN outside its domain

    def __len__(self) -> int:
        return len(np.atleast_2d(self.q))

    @property
    def found(self) -> Any:
        """Whether x, and xi where it was given, are met, bool or (N,)."""
        return self.status == InverseStatus.FOUND

    def facts(self) -> dict[str, str]:
        """Number of rows with each status."""
        values = np.atleast_1d(self.status)
        counts = {status.name: int((values == status).sum()) for status in InverseStatus}
        names = [self.branch] if isinstance(self.branch, str) else sorted(set(self.branch))
        return {
            "postures": listed(f"{count} {name}" for name, count in counts.items() if count) or "none",
            "branches": listed(name or "none" for name in names) or "none",
        }


@dataclass(frozen=True, eq=False, repr=False)
class Arm(Shown):
    """An arm with more joints than its task needs, and charts of the branches of its joint range.

    A chart ends at the boundary of its domain, but an arm knows all postures of a task value x within the
    joint limits. Without limits they are a few closed curves, which are traced from stored postures and then cut at
    the limits: `self_motion` and `solve`. Charts give postures a number xi on each branch.
    `tracker` follows a stream of x and xi through borders of charts, singular positions and out of reach. Arms with
    several joints more than the task needs, such as those on mobile bases, have trackers only.

    Curves, postures with xi and trackers are C that is compiled on first use and kept. Without a C compiler these
    methods raise CompileError, which says how to get one. `Arm(task)` has no charts: it is ready at once, and knows no
    xi.

    A task value x is the task's vector (m,). For tasks of a whole orientation it is also a 4 x 4 matrix, a pair of
    position and rotation (3, 3) or quaternion (w, x, y, z), or a `pinocchio.SE3`. Methods that take several, take rows
    of these.

    Args:
        task: a task with m < n; with m = n - 1 for all but trackers.
        charts: of branches, with equal tasks.

    Raises:
        NotRedundantError, InvalidValueError: if the task leaves no joint free, or charts have another task.

    Example:
        >>> import orthocas as oc
        >>> chart = oc.load("panda-wide")
        >>> arm = oc.Arm(chart.task, (chart,))
        >>> q = [0.3, 0.4, 0.1, -1.9, 0.2, 2.2, 0.5]
        >>> motions = arm.self_motion(arm.robot.pose(q))
        >>> len(motions), str(motions.components[0].ends[0])
        (3, "joint 'panda_joint2' at 1.763, its limit")
        >>> bool(motions.nearest(q).value < 1e-9)
        True
    """

    task: Task
    charts: tuple[Chart, ...] = ()

    def __post_init__(self) -> None:
        require_kind("task", self.task, Task)
        robot = self.task.robot
        free = robot.n - len(robot.tree.floating)
        if self.task.m >= free:
            raise NotRedundantError(self.task.m, free)
        # Turns of a joint are counted from one limit to the other, so a revolute joint with one limit is refused.
        one = np.flatnonzero(np.isfinite(robot.lower) != np.isfinite(robot.upper))
        if any(not robot.tree.prismatic[k] for k in one):
            raise InvalidValueError("joint", f"'{robot.joint_names[one[0]]}' with one limit", "two limits, or none")
        object.__setattr__(self, "task", self.task.with_reference_at(find_joint_range(robot, 0).centre))
        if not isinstance(self.charts, tuple | list):
            raise InvalidValueError("charts", repr(self.charts)[:80], "a tuple of charts")
        # All charts and the arm must have the same x.
        for chart in self.charts:
            require_kind("charts", chart, Chart)
            same = chart.problem.task.recipe == self.task.recipe
            if not same and (chart.m, chart.n) == (self.task.m, robot.n):
                home = chart.problem.domain.home[None]
                values = chart.problem.task.batched(home)[0], self.task.batched(home)[0]
                same = np.allclose(*values, rtol=0, atol=1e-9)
            if not same:
                raise InvalidValueError("charts", f"one of the task {chart.problem.task.name}", self.task.name)
        object.__setattr__(self, "charts", tuple(self.charts))

    @classmethod
    def fit(
        cls,
        robot: Robot,
        task: Task | None = None,
        metric: Metric | MetricSpec = "euclidean",
        *,
        seed: int = 0,
        monitor: Monitor = silent,
    ) -> Self:
        """Fit a wide chart to every branch of the joint range; it takes some seconds for each.

        Args:
            robot: the robot.
            task: its task, with m = n - 1. Default: the pose of the tip.
            metric: as in `Problem`.
            seed: random seed of samples.
            monitor: called with progress.

        Raises:
            NotRedundantError, InvalidValueError: if n - m is not 1.
            DomainError: if no branch can be fitted. If only some cannot, a BranchWarning names them.
        """
        require_kind("robot", robot, Robot)
        bare = cls(Task.pose(robot) if task is None else task)
        bare.require_one_free()
        # One chart for each branch; those that cannot be fitted are reported, not fatal.
        parts, found, reasons = branches(robot, bare.task), [], []
        for k, branch in enumerate(parts):
            own = f"branch {k + 1} of {len(parts)}, "

            def report(progress: Progress, own: str = own) -> None:
                monitor(replace(progress, stage=own + progress.stage))

            try:
                found.append(fit_wide(robot, bare.task, branch, metric, seed=seed, monitor=report).chart)
            except DomainError as error:
                reasons.append(str(error))
        for reason in reasons if found else ():
            warn_caller(reason, BranchWarning)
        if not found:
            raise DomainError(f"no branch can be fitted: {listed(reasons)}")
        return cls(bare.task, tuple(found))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an arm file, or take a known arm by its name, such as "panda". Loading never runs code from a file.

        "panda", "iiwa7", "xarm7" and "baxter-left" have charts of all their branches, which `Arm.fit` made; the others
        have that of one branch, `oc.load(f"{name}-wide")`.

        Raises:
            UnknownNameError: for a word that is neither a file nor the name of a known arm.
            ChartFileError: if the file is missing, truncated, foreign, edited, or from a newer version.
        """
        # A name without a folder or an ending is that of a known arm.
        file = as_path("path", path)
        if not (file.exists() or file.suffix or len(file.parts) > 1):
            require_known("arm file or known arm", file.name, list_arms())
            if (_DATA / f"{file.name}.arm").is_file():
                with as_file(_DATA / f"{file.name}.arm") as stored:
                    return cls.load(stored)
            chart = load(f"{file.name}{_WIDE}")
            return cls(chart.task, (chart,))
        charts = read_charts(file)
        return cls(charts[0].problem.task, charts)

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write all charts to one file. It replaces an arm file of that name, and with `force` any other file.

        Raises:
            InvalidValueError: if the arm has no charts.
            ChartFileError: as `Chart.save`.
        """
        if not self.charts:
            raise InvalidValueError("arm", "one without charts", "an arm with charts, as `Arm.fit` makes it")
        write_charts(as_path("path", path), self.charts, force)

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.task.robot

    @property
    def branch_names(self) -> tuple[str, ...]:
        """Names of the branches that have charts."""
        return tuple(str(chart.notes.get("branch", chart.problem.name)) for chart in self.charts)

    def x(self, q: ArrayLike) -> Array:
        """The task's vector, (m,) or (N, m), at joint positions (n,) or (N, n)."""
        points, single = as_point_set("q", q, self.robot.n)
        values = np.asarray(self.task.batched(points)[0])
        return values[0] if single else values

    def self_motion(self, x: Any) -> SelfMotions:
        """All postures within the joint limits with a task value: arcs, with their ends and what stops them there.

        Curves that pass near one another are told apart by the direction in which det [J; t] > 0. That all curves are
        found is no theorem: docs/how-to/arm.md has how often they are.

        Args:
            x: one task value.

        Raises:
            InvalidValueError: if x is no task value, or not finite, or n - m is not 1.
        """
        self.require_one_free()
        return find_motions(self.maps, self._read_one(x))

    def solve(
        self,
        x: Any,
        xi: ArrayLike | None = None,
        start: ArrayLike | None = None,
        branch: str = ANY,
        collisions: Collisions | None = None,
        *,
        all: bool = False,  # noqa: A002
    ) -> Postures:
        """A posture within the joint limits for each task value, or all that are found for one x and xi.

        With xi, charts are asked in turn: that of the start's branch first, or else the largest. Newton's method goes
        to (x, xi) from the start, or from the nearest of stored postures; the first chart in which it arrives gives the
        posture. Otherwise the self-motion curves of x are searched for postures with xi. Where there is none, the
        posture whose xi is nearest is NEAREST; where charts hold none, one with that x within the limits is
        OUTSIDE_DOMAIN. Without xi, it is the posture nearest to the start, or without one, far from limits.

        If full turns of joints without limits change xi, only postures within one and a half turns of the start, or of
        the centre of the domain, are returned.

        Rows are spread over the cores, in C that is compiled on first use.

        Args:
            x: one task value, or N of them. Rows that are not finite are BAD_INPUT, orientations beyond half a turn
                OUT_OF_REACH.
            xi: a number, or one for each row (N,).
            start: a posture (n,), or one for each row (N, n).
            branch: name of a branch, to accept no other; "any" for all.
            collisions: of the robot, such as `robot.collisions`. Where the posture touches something, a free one with
                the same x and xi takes its place; else, of free postures 0.05 rad apart on the arcs, that with the
                nearest xi (NEAREST), or without xi that nearest to the start, or farthest from limits. Where none is
                free, the status is COLLIDING.
            all: return the postures with one task value in which the chart of their branch has one xi, those without a
                contact first, the others COLLIDING. They are sought between places 0.05 rad apart on the arcs, also
                where xi turns back once in between. Without xi, postures are the arcs of `self_motion`.

        Raises:
            InvalidValueError, ShapeError: for arguments that do not fit, an xi or branch without charts, or all without
                xi.
        """
        self.require_one_free()
        require_kind("all", all, bool)
        require_collisions(collisions, self.robot.tree)
        require_kind("branch", branch, str)
        if branch != ANY:
            require_known("branch", branch, self.branch_names)
        if all:
            return self._solve_all(x, xi, start, branch, collisions)
        # Read the request: targets, starts, charts that may answer, and xi.
        targets, single = self._read(x)
        N, n = len(targets), self.robot.n
        starts = None if start is None else _repeat_rows("start", as_point_set("start", start, n)[0], N)
        chosen = [k for k, name in enumerate(self.branch_names) if branch in (ANY, name)]
        values = None
        good = np.asarray(np.isfinite(targets).all(axis=1))
        if xi is not None:
            self._require_charts()
            values = _repeat_rows("xi", as_float_array("xi", xi).reshape(-1, 1), N)[:, 0]
            good = good & np.isfinite(values)
        # Rows with numbers that are not finite, or beyond half a turn, have their answer already.
        q, status = np.full((N, n), np.nan), np.full(N, int(InverseStatus.NOT_FOUND))
        owners = np.full(N, -1)
        status[~good] = InverseStatus.BAD_INPUT
        beyond = good & self.maps.targets.lack_rotation(targets)
        status[beyond] = InverseStatus.OUT_OF_REACH
        good = good & ~beyond
        rows, near = np.flatnonzero(good), None if starts is None else starts[good]
        # Without xi, the arcs of x are searched; with xi, charts first, and then the arcs, in C.
        if values is None:
            q[rows], status[rows] = self._solve_on_arcs(targets[rows], near, chosen, branch == ANY)
            found = rows[np.isfinite(q[rows]).all(axis=1)]
            owners[found] = self.find_branches(q[found])
        else:
            q[rows], status[rows], owners[rows] = self.chart_kernel.solve_rows(
                targets[rows], values[rows], near, chosen
            )
            if branch != ANY:
                beyond = status == InverseStatus.OUTSIDE_DOMAIN
                q[beyond], status[beyond] = np.nan, InverseStatus.NOT_FOUND
        # Replace postures that touch something by free ones.
        if collisions is not None:
            known = np.flatnonzero(np.isfinite(q).all(axis=1))
            for row in known[~collisions.check_free(q[known])].tolist():
                wish = None if starts is None else starts[row]
                value = None if values is None else float(values[row])
                free = self._find_free(targets[row], value, wish, chosen, branch == ANY, collisions)
                q[row], status[row] = free or (q[row], InverseStatus.COLLIDING)
                owners[row] = self.find_branches(q[row : row + 1])[0]
        # Names and xi of the branches that hold the answers.
        names = tuple(self.branch_names[k] if k >= 0 else "" for k in owners.tolist())
        own = np.full(N, np.nan) if values is None else np.where(status == InverseStatus.FOUND, values, np.nan)
        unknown = np.flatnonzero(np.isnan(own) & (owners >= 0))
        if unknown.size:
            own[unknown] = self._evaluate_xi(q[unknown], owners[unknown])
        if single:
            return Postures(q[0], InverseStatus(int(status[0])), names[0], own[0])
        return Postures(q, status, names, own)

    def _solve_all(
        self, x: Any, xi: ArrayLike | None, start: ArrayLike | None, branch: str, collisions: Collisions | None
    ) -> Postures:
        """All postures with x and xi, those without a contact first, and then those nearest to a start."""
        self._require_charts()
        if xi is None:
            raise InvalidValueError("all", True, "an xi with it; without one, they are the arcs of `self_motion(x)`")
        value = as_number("xi", xi)
        if not np.isfinite(value):
            raise InvalidValueError("xi", value, "a finite number")
        chosen = [k for k, name in enumerate(self.branch_names) if branch in (ANY, name)]
        q, owners = self.chart_kernel.solve_all(self._read_one(x), value, None, chosen)
        status = np.full(len(q), int(InverseStatus.FOUND))
        if collisions is not None and len(q):
            status[~collisions.check_free(q)] = InverseStatus.COLLIDING
        away = np.zeros(len(q)) if start is None else np.linalg.norm(q - as_point("start", start, self.robot.n), axis=1)
        order = np.lexsort((owners, away, status))
        names = tuple(self.branch_names[k] for k in owners[order])
        return Postures(q[order], status[order], names, np.full(len(q), value))

    def tracker(
        self,
        q: ArrayLike,
        *,
        period: float = 0.01,
        velocity_limits: ArrayLike | None = None,
        acceleration_limits: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        detours: bool = True,
        collisions: Collisions | None = None,
        margin: float | None = None,
        avoid: float | None = None,
    ) -> ArmTracker:
        """A tracker of a stream of x and xi that is never lost; see `ArmTracker`.

        Args:
            q: posture within the joint limits, (n,).
            period: time from one call to the next [s].
            velocity_limits: (n,) or one number [rad/s] or [m/s]. Default: those of the robot's file.
            acceleration_limits: (n,) or one number [rad/s^2] or [m/s^2]. Default: none.
            weights: weights (n,) of the joints' steps, and of the return to the last posture with a chart, or without
                charts, to q. Only their ratios matter. A large weight of the base makes it move less than the arm.
            detours: whether the arm may leave x for a while where it is stuck, to get to a posture that has it, or to
                one that has xi as well.
            collisions: of the robot, such as `robot.collisions`; with margin and avoid as in `Chart.tracker`.
            margin: distance to a contact that no call falls below [m]. Default: 0.01.
            avoid: distance below which xi gives way [m], above the margin. Default: it does not.
        """
        clearance = Clearance.build(collisions, self.robot.tree, margin, avoid)
        rules = velocity_limits, acceleration_limits, weights, detours, clearance
        return ArmTracker(self.chart_kernel, q, period, *rules)

    def follow(
        self,
        path: Any,
        xi: ArrayLike | None = None,
        *,
        q: ArrayLike,
        period: float = 0.01,
        velocity_limits: ArrayLike | None = None,
        collisions: Collisions | None = None,
        margin: float | None = None,
        avoid: float | None = None,
    ) -> tuple[Array, tuple[TrackStatus, ...]]:
        """Postures along task values, by a tracker that makes one call for each.

        Args:
            path: N task values.
            xi: coordinate for each task value, (N,), or one number; None keeps xi of the first posture where possible.
            q: posture of the arm before the first call, (n,).
            period: as in `tracker`.
            velocity_limits: as in `tracker`.
            collisions: as in `tracker`.
            margin: as in `tracker`.
            avoid: as in `tracker`.

        Returns:
            q (N, n), and how each call ended.
        """
        # One call of a tracker for each task value.
        targets, _ = self.maps.targets.read(path)
        tracker = self.tracker(
            q, period=period, velocity_limits=velocity_limits, collisions=collisions, margin=margin, avoid=avoid
        )
        values: list[Any] = [None] * len(targets)
        if xi is not None:
            r = self.robot.n - self.task.m
            values = list(_repeat_rows("xi", as_float_array("xi", xi).reshape(-1, r), len(targets)))
            values = [row.item() for row in values] if r == 1 else values
        found, statuses = np.empty((len(targets), self.robot.n)), []
        for k, (target, value) in enumerate(zip(targets, values, strict=True)):
            found[k] = tracker.step_to(target, value)
            statuses.append(tracker.status)
        return found, tuple(statuses)

    def generate_c(
        self, folder: str | Path, name: str = "arm", postures: int = 200, force: bool = False
    ) -> tuple[Path, Path]:
        """Write the tracker as C99: NAME_track.h and NAME_track.c, without memory of its own or other libraries.

        A call does what `ArmTracker.step` does without a collision model, in a bounded time.

        Args:
            folder: created if its parent exists.
            name: prefix of all C names.
            postures: number of stored postures for each chart, and for the whole joint range. Searches for another way
                try 24 of them, one a call.
            force: also replace files of these names that were not generated.

        Returns:
            The header and the source.

        Raises:
            InvalidValueError, ArchiveError: as `orthocas.generate_c`.
            DomainError: if a domain has a condition, but no expression of it.
        """
        out = as_path("folder", folder)
        require_name(name)
        require_count("postures", postures, least=1, most=RULES.postures)
        names = f"{name}_track.h", f"{name}_track.c"
        require_free_folder(out, name, names, force)
        # All files appear together, or none.
        header = f"/* Generated by orthocas {VERSION}. Do not edit; generate it again instead. */"
        sources = write_tracker(self.maps, self.charts, name, "arm_track.c", header, postures)
        with publish(make_folder("folder", out)) as drafts:
            for file, text in sources.items():
                (drafts / file).write_text(text, encoding="utf-8")
        return out / names[0], out / names[1]

    def find_branches(self, q: Array) -> Indices:
        """Numbers of the charts whose domains hold postures (N, n); -1 for none."""
        owners = np.full(len(q), -1)
        for k, chart in enumerate(self.charts):
            left = np.flatnonzero(owners < 0)
            owners[left[np.asarray(chart.problem.domain.contains(q[left]))]] = k
        return owners

    def facts(self) -> dict[str, str]:
        """Task, charts, and how much of their branches they cover."""
        names = [
            f"{name} {percent(float(chart.notes['share of the branch']), 2)}"
            if "share of the branch" in chart.notes
            else name
            for name, chart in zip(self.branch_names, self.charts, strict=True)
        ]
        return {
            "arm": self.robot.heading,
            "task": self.task.heading,
            "charts": f"{len(names)} (share of the branch): {listed(names)}" if names else "none",
        }

    @cached_property
    def maps(self) -> ArmMaps:
        """Data of the arm for other files of this package; it may change without notice."""
        return ArmMaps(self.task)

    @cached_property
    def chart_kernel(self) -> ChartKernel:
        """Searches with the charts, and trackers, in C. For other files of this package."""
        return ChartKernel(self.maps, self.charts)

    def _require_charts(self) -> None:
        if not self.charts:
            raise InvalidValueError("xi", "for an arm without charts", "None, or an arm of `Arm.fit`")

    def require_one_free(self) -> None:
        """Refuse arms with several joints more than the task needs.

        Raises:
            InvalidValueError: if n - m is not 1.
        """
        free = self.robot.n - self.task.m
        if free != 1:
            raise InvalidValueError("task", f"n - m = {free}", "one with n - m = 1; here, use charts, or a tracker")

    def _read(self, x: Any) -> tuple[Array, bool]:
        """As `TargetReader.read`, in C where x is an array of vectors."""
        m = self.task.m
        plain = type(x) is np.ndarray and x.dtype == np.float64 and (x.shape == (m,) or x.shape[1:] == (m,) != (4,))
        if not (plain and self.charts):
            return self.maps.targets.read(x)
        return self.chart_kernel.build_targets(np.ascontiguousarray(x).reshape(-1, m)), x.ndim == 1

    def _read_one(self, x: Any) -> Array:
        targets, single = self.maps.targets.read(x)
        if not single or not np.isfinite(targets).all():
            raise InvalidValueError(
                "x", f"{len(targets)} values" if not single else "NaN or infinity", "one task value"
            )
        if self.maps.targets.lack_rotation(targets).any():
            raise InvalidValueError(
                "x", "an orientation beyond half a turn", "2 sin(angle / 2) axis, of length 2 at most"
            )
        return np.asarray(targets[0])

    def _solve_on_arcs(
        self, targets: Array, starts: Array | None, chosen: Sequence[int], anywhere: bool
    ) -> tuple[Array, Indices]:
        """Postures of targets (N, k) on their arcs, nearest to starts or far from limits, and how they ended."""
        if anywhere:
            q = self.maps.choose_postures(targets, starts)
        else:
            q = np.full((len(targets), self.robot.n), np.nan)
            domains = [self.charts[k].problem.domain for k in chosen]

            def solve_row(row: int) -> None:
                # Take the best of the postures 0.05 rad apart on the arcs that lie in one of the domains.
                start = None if starts is None else starts[row]
                places = self._spread_postures(targets[row], start)
                inside = np.vstack([self._find_inside(places, domain) for domain in domains])
                if len(inside):
                    q[row] = inside[self._choose(inside, start)]

            run_in_threads(solve_row, range(len(targets)))
        return q, np.where(np.isfinite(q[:, 0]), int(InverseStatus.FOUND), int(InverseStatus.NOT_FOUND))

    def _spread_postures(self, target: Array, start: Array | None) -> Array:
        """Postures (P, n) on all arcs of a target, at most `RULES.spacing` apart."""
        motions = find_motions(self.maps, target, *(() if start is None else (start[None],)))
        counts = [max(2, int(arc.length / RULES.spacing) + 2) for arc in motions]
        q = [arc.at(np.linspace(0.0, arc.length, count)) for arc, count in zip(motions, counts, strict=True)]
        return np.vstack([np.empty((0, self.robot.n)), *q])

    def _find_inside(self, q: Array, domain: Domain) -> Array:
        """The postures among q (N, n) in a domain, after full turns of joints without limits into its box."""
        bounded = np.isinf(self.robot.lower) & np.isfinite(domain.bounds[0]) & self.maps.turning
        moved = domain.home + wrap_shortest(q - domain.home, np.where(bounded, 2 * np.pi, 0.0))
        return np.asarray(moved[np.asarray(domain.contains(moved))])

    def _find_free(
        self,
        target: Array,
        xi: float | None,
        start: Array | None,
        chosen: Sequence[int],
        anywhere: bool,
        collisions: Collisions,
    ) -> tuple[Array, InverseStatus] | None:
        """A posture of one target without a contact, of those with xi or of many on its arcs; None if there is none."""
        # With xi, first look for free postures that have it exactly.
        if xi is not None:
            exact = self.chart_kernel.solve_all(target, xi, start, chosen)[0]
            exact = exact[collisions.check_free(exact)] if len(exact) else exact
            if len(exact):
                return exact[
                    0 if start is None else np.linalg.norm(exact - start, axis=1).argmin()
                ], InverseStatus.FOUND
        # Otherwise, collect free postures on the arcs.
        q = self._spread_postures(target, start)
        q = q[collisions.check_free(q)] if len(q) else q
        owners = np.zeros(len(q), dtype=np.int64)
        if not (xi is None and anywhere):
            parts = [self._find_inside(q, self.charts[k].problem.domain) for k in chosen]
            q, owners = np.vstack(parts), np.repeat(chosen, [len(part) for part in parts])
        if not len(q):
            return None
        # Choose the posture with the nearest xi; without xi, nearest to the start, or farthest from limits.
        if xi is not None:
            periods = np.array([self.charts[k].parts.turns[self.charts[k].m] for k in owners])
            away = np.abs(wrap_shortest(self._evaluate_xi(q, owners) - xi, periods))
            return q[np.argmin(away)], InverseStatus.NEAREST
        return q[self._choose(q, start)], InverseStatus.FOUND

    def _choose(self, q: Array, start: Array | None) -> int:
        """Index of the posture nearest to a start; without a start, farthest from the limits, in half-widths."""
        if start is not None:
            return int(np.argmin(np.linalg.norm(q - start, axis=1)))
        low, high = self.robot.lower, self.robot.upper
        bounded = np.isfinite(low)
        room = np.minimum(q - low, high - q)[:, bounded] / (high - low)[bounded]
        return int(np.argmax(2 * room.min(axis=1, initial=1.0)))

    def _evaluate_xi(self, q: Array, owners: Indices) -> Array:
        """xi (N,) of postures in the charts that hold them; NaN elsewhere."""
        values = np.full(len(q), np.nan)
        for k, chart in enumerate(self.charts):
            rows = np.flatnonzero(owners == k)
            if rows.size:
                values[rows] = chart.xi(q[rows])[:, 0]
        return values


def _repeat_rows(name: str, rows: Array, count: int) -> Array:
    """Rows (count, k), from as many rows or from one row for all."""
    if len(rows) not in (1, count):
        raise ShapeError(name, rows.shape, (count, rows.shape[1]))
    return np.broadcast_to(rows, (count, rows.shape[1]))
