"""Branches: the parts into which hypersurfaces cut the joint range where self-motions cannot cross."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike

from orthocas.errors import InvalidValueError, SingularTaskError, UnknownNameError
from orthocas.robots.robot import Robot
from orthocas.tasks.clear_box import ClearBox
from orthocas.tasks.domains import Box
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.samples import compute_row_scale, sample_evenly
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, as_point, require_kind
from orthocas.tools.display import Shown, listed, percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class BranchRules:
    """Numbers of the search for branches, chosen on eight arms."""

    #: relative singular value above which a position counts as clear, in fractions of volume and in slices
    nonsingular: float = 0.1
    #: clearance needed at the centre of a wide chart, relative to the chart's clearance
    of_centre: float = 1.5
    slices: int = 61  #: slices q_k = v of a joint
    on_slice: int = 200  #: positions on a slice
    on_fine_slice: int = 400  #: positions on a slice while a cut is refined
    seed: int = 0  #: of all positions
    few: int = 8  #: fewer nonsingular positions on a slice than this say nothing about self-motions
    quantile: float = 0.9  #: this fraction of a slice must be singular, or must not be left by self-motions
    low: float = 0.12  #: largest such quantile at a cut, relative to the largest one over the slices of the joint
    still: float = 0.02  #: no cut of a joint whose self-motions are smaller than this on all slices
    #: quantile below which a cut is exact, and not only approximate because of offsets between axes
    exact: float = 1e-4
    apart: float = 0.45  #: [rad] or [m]; cuts of one joint nearer than this count as one
    most_cuts: int = 2  #: largest number of cuts of a joint
    well: float = 0.15  #: a part counts if the quantile on its best slice reaches this value ...
    well_of_joint: float = 0.6  #: ... or this fraction of the value on the best slice of the joint
    neighbours: int = 5  #: number of slices on each side that a minimum is compared with
    same_pose: float = 1e-8  #: [m] and [rad]; poses that differ less are equal
    samples: int = 20_000  #: positions of the joint range
    drawn: int = 25  #: a sampler draws at most this many times the requested number
    centres: int = 20_000  #: sampled positions that may be the centre of a chart
    surely: float = 3.0  #: a value of this many times `nonsingular` in a branch guarantees a centre for any smaller box
    arm: int = 7  #: number of last joints of an arm whose self-motions are examined


RULES = BranchRules()

_PARTS = {6: {1: "shoulder", 2: "elbow", 4: "wrist"}, 7: {1: "shoulder", 3: "elbow", 5: "wrist"}}


@dataclass(frozen=True)
class Cut:
    """A hypersurface q_k = value that cuts the joint range."""

    joint: int  #: k
    joint_name: str
    part: str  #: "elbow", ... or the name of the joint
    value: float  #: position of joint k [rad] or [m]
    singular: bool  #: True: all its positions are singular; False: self-motions cannot leave it
    exact: bool  #: whether this holds exactly, and not only approximately

    @property
    def explained(self) -> str:
        """The cut in words."""
        why = "singular" if self.singular else "self-motions do not cross it"
        return f"{self.joint_name} = {self.value:.4g}, {why}{'' if self.exact else ', nearly'}"


@dataclass(frozen=True, eq=False)
class Branch:
    """A part of the joint range between cuts."""

    name: str  #: such as "shoulder+ elbow- wrist+"; "whole" without cuts
    box: Box  #: box from cut to cut, or to the joint limits
    posture: Array  #: the clear position farthest from limits and cuts, (n,)
    clear_share: float  #: fraction of its positions that are clear: relative singular value above 0.1
    share: float  #: its fraction of all clear positions of the joint range
    #: largest clearance up to 0.1 for which some position can be the centre of a chart
    clearance: float = RULES.nonsingular


@dataclass(frozen=True, eq=False, repr=False)
class Branches(Shown, Sequence[Branch]):
    """The branches of a robot, sorted by their number of clear positions; see `orthocas.branches`."""

    robot: Robot
    cuts: tuple[Cut, ...]
    items: tuple[Branch, ...]
    mirrors: tuple[int, ...]  #: indices of cuts at which a reflection of the joints keeps the pose of the tip

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Branch]:
        return iter(self.items)

    def __getitem__(self, key: int | str) -> Branch:  # type: ignore[override]
        """A branch by its index or its name."""
        if isinstance(key, str):
            names = [item.name for item in self.items]
            if key not in names:
                raise UnknownNameError("branch", key, names)
            return self.items[names.index(key)]
        if not isinstance(key, int | np.integer) or not -len(self.items) <= key < len(self.items):
            raise InvalidValueError(
                "branch", repr(key)[:80], f"a name, or an index of one of {len(self.items)} branches"
            )
        return self.items[key]

    def of(self, q: ArrayLike) -> Branch | None:
        """The branch of a joint position (n,); None outside the joint range and on parts without clear positions."""
        point = as_point("q", q, self.robot.n)
        return next((item for item in self.items if item.box.contains(point)), None)

    def mirrored(self, q: ArrayLike, cut: int) -> Array:
        """The joint position (n,) on the other side of a cut among `mirrors`, with the same pose of the tip.

        q_k - value changes its sign. The two neighbouring joints turn by half a turn, towards the centre of their
        ranges.
        """
        q = as_point("q", q, self.robot.n)
        image: Array = _reflect(self.robot, self.cuts[cut], q[None])[0]
        return image

    def plot(self) -> Figure:
        """Draw the posture of each branch in a panel of its own, with name and fraction of the clear positions."""
        # matplotlib is slow to import, and searches need no pictures.
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        from orthocas.tools.picture import Picture, equal_axes

        columns = min(len(self), 4)
        rows = -(-len(self) // columns)
        layout = ConstrainedLayoutEngine(h_pad=0.1, w_pad=0.15, rect=(0, 0, 0.97, 1))
        figure = Picture(figsize=(2.3 * columns, 2.6 * rows), layout=layout)
        postures = self.robot.joint_points(np.array([item.posture for item in self]))
        for k, (item, points) in enumerate(zip(self, postures, strict=True)):
            panel = figure.add_subplot(rows, columns, k + 1, projection="3d")
            panel.plot(*points.T, "-o", color="#1f5fa8", markersize=4, linewidth=2.2)
            panel.set_title(f"{item.name}\n{percent(item.share)} of the clear positions", fontsize=9)
            equal_axes(panel, postures.reshape(-1, 3))
            panel.locator_params(nbins=3)
        return figure

    def facts(self) -> dict[str, str]:
        """Cuts and branches, and the branches too singular for a wide chart with the usual clearance."""
        shares = [f"{item.name} ({percent(item.share)})" for item in self.items]
        facts = {
            "branches": f"{len(self)} of {self.robot.heading}",
            "cuts": "; ".join(cut.explained for cut in self.cuts) or "none",
            "clear positions": listed(shares),
        }
        below = [item for item in self.items if item.clearance < RULES.nonsingular]
        if below:
            lower = listed([f"{item.name} ({item.clearance:.2g} or less)" for item in below])
            facts["too singular"] = f"for wide charts of clearance {RULES.nonsingular:g}: {lower}"
        return facts


def branches(robot: Robot, task: Task | None = None) -> Branches:
    """Find the parts of the joint range that self-motions and paths around singular positions do not connect.

    Cuts are hypersurfaces q_k = v of two kinds. On a singular cut, every position is singular; an example is the
    stretched elbow. On the other kind, joint k does not move during self-motions (motions of the arm with the tip at
    rest), so self-motions do not cross the cut. An example is the second joint of a shoulder with three intersecting
    axes at q2 = 0. A coordinate keeps its sign along self-motions on each side of a cut, but not across it.

    The search takes slices of every joint except the first and the last of the arm, and refines the minima that it
    finds. A cut may be approximate, because offsets between axes disturb these places a little. A cut of the second
    kind is dropped if hardly any position between it and the next cut is nonsingular. Cuts are found from samples, not
    proved.

    The self-motions are those of the tip's pose by the last seven joints; charts of the tip's position use the same
    cuts. A robot with several tips has self-motions of each tip by the last seven joints that carry it, if these joints
    move the task. With fewer than six joints, self-motions are those of the task. Branches are the parts that contain
    clear positions of the task. Joints that can turn more than a full turn are taken from -pi to pi.

    Args:
        robot: the robot.
        task: a task of that robot, required with fewer than six joints. Default: the pose of the tip, by the last seven
            joints.

    Raises:
        SingularTaskError: if no sampled position is clear.

    Source:
        ours, docs/how-to/wide.md.

    Example:
        >>> import orthocas as oc
        >>> found = oc.branches(oc.problems.get("iiwa").robot)
        >>> [cut.explained for cut in found.cuts][1], len(found)
        ('A4 = 0, singular', 8)
        >>> found["shoulder+ elbow- wrist+"].share > 0.1
        True
    """
    require_kind("robot", robot, Robot)
    if task is not None:
        require_kind("task", task, Task)
    whole = find_joint_range(robot, 0)
    arms = _Arm.build_all(robot, task, whole)
    cuts = tuple(cut for arm in arms for k in arm.inner for cut in arm.find_cuts(k))
    points = sample_evenly(Box(whole.centre, whole.half_width), RULES.samples, RULES.seed)
    if task is not None:
        values = _scale_to_range(robot, task)(points)
    else:
        values = np.min([arm.measure_self_motions(points)[0] for arm in arms], axis=0)
    if not (values > RULES.nonsingular).any():
        raise SingularTaskError(
            "all sampled positions of the joint range are near-singular, expected a task with clear positions"
        )
    # A joint with k cuts has k + 1 parts, and a branch takes one part of each joint.
    parts = [range(1 + sum(cut.joint == k for cut in cuts)) for k in sorted({cut.joint for cut in cuts})]
    candidates = [_build_branch(whole, cuts, sides, points, values) for sides in product(*parts)]
    items = [item for item in candidates if item]
    # Find the clearance that each branch allows, unless its values guarantee the usual one.
    served = task or (arms[0].task if len(arms) == 1 else None)
    if served is not None and served.m < robot.n:
        for k, item in enumerate(items):
            if values[item.box.contains(points)].max() <= RULES.surely * RULES.nonsingular:
                largest = float(sample_centres(robot, served, item.box)[1].max()) / RULES.of_centre
                items[k] = replace(item, clearance=min(RULES.nonsingular, math.floor(1e3 * largest) / 1e3))
    items.sort(key=lambda item: -item.share)
    mirrors = tuple(i for i, cut in enumerate(cuts) if _is_mirror(robot, cut, points[:50]))
    return Branches(robot, cuts, tuple(items), mirrors)


@dataclass(frozen=True, eq=False)
class _Arm:
    """The joints of one arm, for examining its self-motions."""

    robot: Robot
    task: Task
    whole: Box
    joints: list[int]
    scale: Array

    @classmethod
    def build_all(cls, robot: Robot, task: Task | None, whole: Box) -> list[_Arm]:
        """One arm if the robot has one tip; otherwise one arm per tip whose joints move the task."""
        # One tip: take its last seven joints, or the task if the arm is shorter.
        points = sample_evenly(Box(whole.centre, whole.half_width), 2000, RULES.seed)
        if len(robot.tips) == 1:
            joints = list(range(max(0, robot.n - RULES.arm), robot.n))
            one = Task.pose(robot) if robot.n >= 6 or task is None else task
            return [cls._build(robot, one, whole, joints, points)]
        # Several tips: take each tip whose joints move the task.
        moved = np.ones(robot.n, dtype=bool)
        if task is not None:
            moved = np.asarray(_evaluate_jacobians(task.with_reference_at(whole.centre), points[:20]).any(axis=(0, 1)))
        arms = []
        for tip in robot.tips:
            # Joints that move the tip, including leaders of mimic joints, each once.
            bodies = robot.tree.carriers(robot.tree.frame(tip).parent)
            joints = list(dict.fromkeys(robot.tree.leaders[body] for body in bodies))[-RULES.arm :]
            if joints and moved[joints].any():
                arms.append(cls._build(robot, Task.pose(robot, frame=tip), whole, joints, points))
        return arms

    @classmethod
    def _build(cls, robot: Robot, task: Task, whole: Box, joints: list[int], points: Array) -> _Arm:
        centred = task.with_reference_at(whole.centre)
        J = _evaluate_jacobians(centred, points)
        return cls(robot, centred, whole, joints, compute_row_scale(J[:, :, joints], centred.units))

    @property
    def inner(self) -> list[int]:
        """The joints that may have cuts: all but the first and the last, which turn the base and the tool only."""
        return self.joints[1:-1]

    def measure_self_motions(self, points: Array) -> tuple[Array, Array]:
        """Relative singular values (N,), and displacements of joints in a unit self-motion, (N, n), NaN without one."""
        J = _evaluate_jacobians(self.task, points)[:, :, self.joints] / self.scale[:, None]
        m = J.shape[1]
        moved = np.full(points.shape, np.nan)
        if m >= len(self.joints):
            return np.asarray(np.linalg.svd(J, compute_uv=False)[:, -1]), moved
        _, s, V = np.linalg.svd(J)
        moved[:, self.joints] = np.sqrt((V[:, m:] ** 2).sum(axis=1))
        return np.asarray(s[:, -1]), moved

    def find_cuts(self, k: int) -> list[Cut]:
        """The cuts of joint k."""
        low, high = (self.whole.centre[k] + side * self.whole.half_width[k] for side in (-1, 1))
        values = np.linspace(low, high, RULES.slices)
        cuts: list[tuple[Cut, float]] = []
        of_slices = np.array([self._measure_slice(k, v, RULES.on_slice) for v in values])
        # Refine the minima over the slices, singular cuts first. Drop a cut near another one.
        for singular, sizes in zip((True, False), of_slices.T, strict=True):
            if not np.isfinite(sizes).any() or (not singular and np.nanmax(sizes) < RULES.still):
                continue
            # Inner slices that are lowest among their neighbours and low enough, in ascending order.
            low_enough, near = RULES.low * float(np.nanmax(sizes)), RULES.neighbours
            minima = [
                i
                for i in range(1, len(sizes) - 1)
                if sizes[i] <= low_enough and sizes[i] == np.nanmin(sizes[max(0, i - near) : i + near + 1])
            ]
            for i in sorted(minima, key=lambda i: float(sizes[i])):
                cut, size = self._refine_cut(k, values, i, singular)
                if all(abs(cut.value - other.value) > RULES.apart for other, _ in cuts):
                    cuts.append((cut, size))
        # Keep the strongest cuts. Drop nonsingular cuts beside a part with hardly any nonsingular slice.
        strongest = sorted(cuts, key=lambda pair: pair[1])[: RULES.most_cuts]
        while weakest := _find_sliver_cut(strongest, low, high, values, of_slices[:, 0]):
            strongest.remove(weakest)
        return sorted((cut for cut, _ in strongest), key=lambda cut: cut.value)

    def _measure_slice(self, k: int, value: float, count: int) -> tuple[float, float]:
        """90 % quantiles over a slice: of the singular value, and of the joint's displacement in unit self-motions."""
        points = sample_evenly(Box(self.whole.centre, self.whole.half_width), count, (RULES.seed, k))
        points[:, k] = value
        s, moved = self.measure_self_motions(points)
        clear = moved[s > RULES.nonsingular, k]
        moves = float(np.quantile(clear, RULES.quantile)) if len(clear) >= RULES.few else np.nan
        return float(np.quantile(s, RULES.quantile)), moves

    def _refine_cut(self, k: int, values: Array, i: int, singular: bool) -> tuple[Cut, float]:
        """The cut near slice i, and its quantile."""

        def size(value: float) -> float:
            quantile = self._measure_slice(k, value, RULES.on_fine_slice)[0 if singular else 1]
            return quantile if np.isfinite(quantile) else 1.0

        # On most robots exact cuts lie at zero, so try zero besides the result of the minimisation.
        minimum = scipy.optimize.minimize_scalar(
            size, bounds=(values[i - 1], values[i + 1]), method="bounded", options={"xatol": 1e-6}
        )
        at_zero = size(0.0) <= minimum.fun + RULES.exact and values[i - 1] < 0 < values[i + 1]
        value = 0.0 if at_zero else float(minimum.x)
        name = self.robot.joint_names[k]
        parts = _PARTS.get(len(self.joints), {}) if len(self.robot.tips) == 1 else {}
        part = parts.get(k - self.joints[0], name)
        least = size(value)
        return Cut(k, name, part, value, singular, least < RULES.exact), least


def _find_sliver_cut(
    cuts: list[tuple[Cut, float]], low: float, high: float, values: Array, sizes: Array
) -> tuple[Cut, float] | None:
    """The weakest nonsingular cut that bounds a part with hardly any clear slice; None if there is no such cut."""
    placed = sorted(cuts, key=lambda pair: pair[0].value)
    ends = [low, *(cut.value for cut, _ in placed), high]
    enough = min(RULES.well, RULES.well_of_joint * float(sizes.max()))
    slivers = [sizes[(values > start) & (values < end)].max(initial=0.0) <= enough for start, end in pairwise(ends)]
    candidates = [pair for i, pair in enumerate(placed) if not pair[0].singular and (slivers[i] or slivers[i + 1])]
    return max(candidates, key=lambda pair: pair[1], default=None)


def sample_nonsingular(robot: Robot, task: Task, box: Box, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Uniform clear positions of a box, (N, n), with the same meaning of clear as in `branches`.

    Args:
        robot: the robot.
        task: a task of that robot.
        box: the box to draw from.
        samples: N; fewer are returned if less than one in 25 positions is clear.
        seed: seed of the random positions.
    """
    values, rng = _scale_to_range(robot, task), np.random.default_rng(seed)
    kept, count = [np.empty((0, robot.n))], 0
    for _ in range(RULES.drawn):
        points = rng.uniform(box.centre - box.half_width, box.centre + box.half_width, (samples, robot.n))
        kept.append(points[values(points) > RULES.nonsingular])
        count += len(kept[-1])
        if count >= samples:
            break
    return np.concatenate(kept)[:samples]


def sample_centres(robot: Robot, task: Task, box: Box) -> tuple[Array, Array]:
    """Positions of a box (N, n) and their relative singular values (N,), with rows scaled over the joint range."""
    points = sample_evenly(Box(box.centre, box.half_width), RULES.centres, RULES.seed)
    return points, _scale_to_range(robot, task)(points)


def build_clear_box(robot: Robot, task: Task, box: Box, clearance: float, home: Array | None = None) -> ClearBox:
    """The clear part of a box, with the same meaning of clear as in `branches`.

    Raises:
        DomainError: if the home, by default the centre, is not clear.
    """
    return ClearBox(box, task, clearance, _compute_range_scale(robot, task), home=home)


def _compute_range_scale(robot: Robot, task: Task) -> Array:
    """Root mean square lengths of the rows of the frame Jacobian over the joint range, (m,), to compare units."""
    whole = find_joint_range(robot, 0)
    centred = task.with_reference_at(whole.centre)
    samples = sample_evenly(Box(whole.centre, whole.half_width), RULES.samples, RULES.seed)
    return compute_row_scale(_evaluate_jacobians(centred, samples), centred.units)


def _scale_to_range(robot: Robot, task: Task) -> Callable[[Array], Array]:
    """Relative singular values of a task at points (N, n), (N,); rows are scaled over the joint range."""
    centred, scale = task.with_reference_at(find_joint_range(robot, 0).centre), _compute_range_scale(robot, task)

    def values(points: Array) -> Array:
        return np.asarray(np.linalg.svd(_evaluate_jacobians(centred, points) / scale[:, None], compute_uv=False)[:, -1])

    return values


def _evaluate_jacobians(task: Task, points: Array) -> Array:
    """Frame Jacobians, zero where they are not finite, (N, m, n)."""
    J: Array = task.batched_frame_jacobian(points)[0].reshape(len(points), task.m, points.shape[1])
    return np.where(np.isfinite(J), J, 0.0)


def _build_branch(
    whole: Box, cuts: tuple[Cut, ...], sides: tuple[int, ...], points: Array, values: Array
) -> Branch | None:
    """The branch between the cuts that `sides` selects; None if it has no clear sample."""
    # Side k of a joint is the interval between its cuts k - 1 and k; the first and last sides end at a limit.
    low, high = whole.centre - whole.half_width, whole.centre + whole.half_width
    clear, words = points[values > RULES.nonsingular], []
    for k, side in zip(sorted({cut.joint for cut in cuts}), sides, strict=True):
        own = [cut for cut in cuts if cut.joint == k]
        if side:
            low[k] = own[side - 1].value
        if side < len(own):
            high[k] = own[side].value
        words.append(own[0].part + ("-", "+")[side] if len(own) == 1 else own[0].part + ("-", "0", "+")[side])
    # Find the clear position farthest from all boundaries.
    inside = clear[((clear > low) & (clear < high)).all(axis=1)]
    if not len(inside):
        return None
    box = Box((low + high) / 2, (high - low) / 2, whole.unbounded)
    drawn = int(((points > low) & (points < high)).all(axis=1).sum())
    room = (1 - np.abs((inside - box.centre) / box.half_width)).min(axis=1)
    posture = inside[np.argmax(room)]
    return Branch(" ".join(words) or "whole", box, posture, len(inside) / drawn, len(inside) / len(clear))


def _reflect(robot: Robot, cut: Cut, points: Array) -> Array:
    """Reflect points (N, n) at a cut: joint k changes sign about it, and its neighbours turn by half a turn."""
    k = cut.joint
    moved = points.copy()
    moved[:, k] = 2 * cut.value - points[:, k]
    middle = np.where(np.isfinite(robot.tree.centre_posture), robot.tree.centre_posture, 0.0)
    for j in (k - 1, k + 1):
        if 0 <= j < robot.n:
            moved[:, j] += np.where(points[:, j] > middle[j], -np.pi, np.pi)
    return moved


def _is_mirror(robot: Robot, cut: Cut, points: Array) -> bool:
    """Whether the reflection at a cut keeps the pose of the tip."""
    # A reflection needs an exact cut, with revolute joints beside it.
    prismatic = robot.tree.prismatic
    near = [j for j in (cut.joint - 1, cut.joint, cut.joint + 1) if 0 <= j < robot.n]
    if not cut.exact or any(prismatic[j] for j in near):
        return False
    # All tips must keep their positions and rotations at the samples.
    moved = _reflect(robot, cut, points)
    same = [
        np.abs(of(points, tip) - of(moved, tip)).max() < RULES.same_pose
        for of in (robot.frame_position, robot.frame_rotation)
        for tip in robot.tips
    ]
    return bool(all(same))
