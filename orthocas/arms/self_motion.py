"""The self-motions of a task value within the joint limits: arcs, their ends, and questions about them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import minimum_filter
from scipy.optimize import minimize

from orthocas.arms.kernel import Curve, build_curvature, evaluate_cubic
from orthocas.arms.maps import ArmMaps
from orthocas.charts.walls import Stop
from orthocas.errors import InvalidValueError
from orthocas.tasks.domains import StopKind
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_float_array, as_point, require_count, require_kind, require_known
from orthocas.tools.display import Shown
from orthocas.tools.expressions import call_user, wrap_shortest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TURN = 2 * np.pi


@dataclass(frozen=True, slots=True)
class ArcRules:
    """Settings of searches on arcs. Lengths are in [rad] or [m]."""

    parts: int = 4  #: points on each step that are searched for the nearest
    candidates: int = 3  #: largest number of these points, or of pairs of them, that are refined
    refinements: int = 12  #: largest number of refinements of a place
    refined: float = 1e-10  #: change of a place, or slope of half a squared gap, that ends its refinement
    largest: float = 0.2  #: largest change of a place, and least distance between candidates
    least_slope: float = 0.1  #: least secant slope of the derivative of half the squared distance along an arc
    most: int = 1_000_000  #: largest number of postures of a sample
    spacing: float = 0.05  #: distance of postures at which a function is evaluated
    golden: int = 40  #: steps of golden-section search for a maximum
    metric_spacing: float = 0.02  #: distance of postures between which the length in a metric is summed


RULES = ArcRules()


@dataclass(frozen=True, slots=True)
class MergeRules:
    """Settings of the search for a way that joins two components."""

    images: int = 31  #: least number of postures of the way
    spacing: float = 0.1  #: largest distance between these postures [rad] or [m]
    parts: int = 16  #: points from each posture to the next at which errors are measured
    rounds: int = 400  #: largest number of rounds of the search
    step: float = 0.3  #: fraction of a Gauss-Newton step towards x, across the way, that a posture takes
    longest: float = 0.05  #: largest length of these steps [rad] or [m]
    damping: float = 1e-2  #: damping of these steps, relative to the trace of J J^T
    pairs: int = 40  #: largest number of rounds of the search for a pass
    near: float = 0.2  #: largest relative difference between the errors of a pass and of the worst posture of the way
    away: float = 1.0  #: largest distance between these two [rad] or [m]
    flat: float = 1e-4  #: curvature, relative to the largest, below which it counts as none
    settled: float = 1e-7  #: relative change of the largest error, or of a gap, that ends a search


MERGE = MergeRules()


class Piece(NamedTuple):
    """A part of a curve, after some full turns of its joints."""

    begin: float  #: place on the curve, from its first point on
    end: float
    turns: tuple[int, ...]  #: (n,)


class Place(NamedTuple):
    """A posture on an arc."""

    q: Array  #: (n,)
    value: float  #: distance to the wished posture [rad] or [m], or value of the function
    component: int  #: index of the arc in `SelfMotions.components`
    place: float  #: length of the arc up to there [rad] or [m]


class Gap(NamedTuple):
    """The least distance of two components, and the two postures that have it."""

    value: float  #: |q_a - q_b| [rad] or [m]
    first: Place
    second: Place


class Merge(NamedTuple):
    """A way from one component to another, with the least deviation from x that was found."""

    value: float  #: largest error of x, at 16 places from each posture to the next [rad], or as far as a radian moves x
    q: Array  #: posture with the largest error (n,); for its value of x, the components meet, or a limit separates them
    x: Array  #: value of x at `q`, (m,)
    way: Array  #: postures (P, n) from one component to the other


@dataclass(frozen=True, eq=False, repr=False)
class Arc(Shown):
    """A connected set of postures within the joint limits with one task value: a curve with two ends, or a closed one.

    Joints that can turn farther than a full turn have an arc for each number of full turns. A closed arc returns to its
    first posture, up to full turns of joints without limits.
    """

    maps: ArmMaps
    target: Array  #: task value, as the kernel takes it
    curve: Curve  #: curve that contains the arc
    pieces: tuple[Piece, ...]  #: parts of the curve in order along the arc
    ends: tuple[Stop, Stop]  #: what stops the motion at the begin and at the end of the arc
    closed: bool

    @property
    def length(self) -> float:
        """Length in joint space [rad] or [m]."""
        return sum(piece.end - piece.begin for piece in self.pieces)

    @cached_property
    def q(self) -> Array:
        """Postures along the arc, (P, n), at most 0.4 rad or m apart, from end to end."""
        return self.at(self._nodes[2])

    def at(self, place: ArrayLike) -> Array:
        """Postures at lengths from the begin, one (n,) or several (P, n); beyond an end, the posture at that end.

        Args:
            place: lengths [rad] or [m].
        """
        s = as_float_array("place", place)
        if np.isnan(s).any():
            raise InvalidValueError("place", "NaN", "lengths along the arc")
        places = np.clip(s.reshape(-1), 0.0, self.length)
        q = self._stand(places)[0]
        return np.asarray(q.reshape(*s.shape, q.shape[1]))

    def direction(self, place: float) -> Array:
        """The direction of the arc (n,) at a length from its begin."""
        return np.asarray(self._stand(np.array([min(max(place, 0.0), self.length)]))[1][0])

    def _stand(self, places: Array) -> tuple[Array, Array]:
        """Postures (P, n) at places from end to end, and directions there."""
        q, t = self._guess(places)
        self.maps.kernel.correct(self.target, q, t)
        if not self.closed:
            q[places <= 0.0], q[places >= self.length] = self._nodes[0][0], self._nodes[0][-1]
        return np.clip(q, self.maps.robot.lower, self.maps.robot.upper), t

    def sample(self, n: int, metric: Metric | MetricSpec = "euclidean") -> Array:
        """Postures at equal distances along the arc, (n, joints), with both ends; a closed arc has its start once.

        Args:
            n: their number.
            metric: metric of the distances: "euclidean", "inertia", a matrix, or a function, as in `Problem`.
        """
        require_count("n", n, least=2, most=RULES.most)
        known = metric if isinstance(metric, Metric) else Metric.from_spec(self.maps.robot, metric)
        places = np.linspace(0.0, self.length, n, endpoint=not self.closed)
        # Lengths in a metric are sums over short chords.
        if not known.is_identity:
            dense = np.linspace(0.0, self.length, max(8, int(self.length / RULES.metric_spacing)) + 1)
            steps = np.diff(self._guess(dense)[0], axis=0)
            A = known.evaluate(self._guess((dense[1:] + dense[:-1]) / 2)[0])
            sums = np.concatenate([[0.0], np.cumsum(np.sqrt(np.einsum("ki,kij,kj->k", steps, A, steps)))])
            places = np.interp(np.linspace(0.0, sums[-1], n, endpoint=not self.closed), sums, dense)
        return self.at(places)

    def facts(self) -> dict[str, str]:
        """Length of the arc, and what stops the motion at its ends."""
        if self.closed:
            return {"arc": f"closed, of length {self.length:.4g}"}
        begin, end = (str(stop) for stop in self.ends)
        return {"arc": f"of length {self.length:.4g}", "begin": begin, "end": end}

    def _guess(self, places: Array) -> tuple[Array, Array]:
        """Postures (P, n) on cubic curves between the points of the arc, and directions there."""
        q, t, at = self._nodes
        k = np.clip(np.searchsorted(at, places, side="right") - 1, 0, len(at) - 2)
        h = (at[k + 1] - at[k])[:, None]
        return evaluate_cubic(q[k], q[k + 1], t[k], t[k + 1], h, (places - at[k])[:, None] / np.maximum(h, 1e-300))

    @cached_property
    def _nodes(self) -> tuple[Array, Array, Array]:
        """Points (P, n), exact at the ends and nearly so between, tangents, and their places (P,)."""
        curve, before = self.curve, 0.0
        parts: list[tuple[Array, Array, Array]] = []
        along = curve.places
        for piece in self.pieces:
            # Take the points of the curve inside the piece, and its ends, which are exact at limits.
            inner = np.flatnonzero((along > piece.begin + 1e-12) & (along < piece.end - 1e-12))
            (first, t_first), (last, t_last) = (curve.point(place) for place in (piece.begin, piece.end))
            shift = _TURN * np.array(piece.turns)
            q = np.vstack([first, curve.q[inner], last]) + shift
            # Where a piece goes on beyond the last point of a closed curve, endless joints keep their full turns.
            q += _TURN * np.rint((parts[-1][0][-1] - q[0]) / _TURN) if parts else 0.0
            t = np.vstack([t_first, curve.tangent[inner], t_last])
            at = np.concatenate([[piece.begin], along[inner], [piece.end]]) - piece.begin + before
            parts.append((q, t, at))
            before = at[-1]
        # Pieces meet at the first point of the curve.
        kept = [slice(0, None if k + 1 == len(parts) else -1) for k in range(len(parts))]
        q, t, at = (np.concatenate([part[i][cut] for part, cut in zip(parts, kept, strict=True)]) for i in range(3))
        return q, t, at


@dataclass(frozen=True, eq=False, repr=False)
class SelfMotions(Shown):
    """All postures within the joint limits with one task value; `Arm.self_motion` finds them."""

    maps: ArmMaps
    target: Array  #: the task value as the kernel takes it
    components: tuple[Arc, ...]  #: the longest first
    curves: int  #: number of curves without limits that the components are parts of

    @cached_property
    def x(self) -> Array:
        """The task value, (m,)."""
        return np.asarray(self.maps.targets.vector(self.target[None])[0])

    @property
    def length(self) -> float:
        """Length of all components in joint space [rad] or [m]."""
        return sum(arc.length for arc in self.components)

    def __len__(self) -> int:
        return len(self.components)

    def __iter__(self) -> Iterator[Arc]:
        return iter(self.components)

    def sample(self, n: int, metric: Metric | MetricSpec = "euclidean") -> Array:
        """About n postures at equal distances along all components, (about n, joints), at least two on each.

        Args:
            n: their number.
            metric: as in `Arc.sample`; distances are equal on each component by itself.
        """
        require_count("n", n, least=2, most=RULES.most)
        counts = [max(2, round(n * arc.length / self.length)) for arc in self.components]
        parts = [arc.sample(count, metric) for arc, count in zip(self.components, counts, strict=True)]
        return np.vstack([np.empty((0, self.maps.robot.n)), *parts])

    def nearest(self, q: ArrayLike) -> Place:
        """The posture nearest to q (n,), by |q - q_wish| without full turns of joints without limits.

        Raises:
            InvalidValueError: if there are no components.
        """
        wish = as_point("q", q, self.maps.robot.n)
        self._require_components()
        arcs = self.components
        # Compute distances of points on all arcs, `RULES.parts` on each step.
        shares = np.arange(RULES.parts) / RULES.parts
        nodes = [arc._nodes for arc in arcs]
        places = [np.concatenate([(at[:-1] + np.diff(at) * u) for u in shares] + [at[-1:]]) for _, _, at in nodes]
        owners = np.repeat(np.arange(len(arcs)), [len(part) for part in places])
        guesses = np.vstack([arc._guess(part)[0] for arc, part in zip(arcs, places, strict=True)])
        distances = (self.measure_away(guesses, wish) ** 2).sum(axis=1)
        along = np.concatenate(places)
        # The squared distance may have several minima, so a few of the nearest points, far apart, are refined.
        order, chosen = np.argsort(distances), list[int]()
        for row in order[: RULES.parts * RULES.candidates].tolist():
            apart = [owners[row] != owners[other] or abs(along[row] - along[other]) > RULES.largest for other in chosen]
            near = np.sqrt(distances[row]) < np.sqrt(distances[order[0]]) + RULES.largest
            if all(apart) and near and len(chosen) < RULES.candidates:
                chosen.append(row)
        found = [self._refine(int(owners[row]), float(along[row]), wish) for row in chosen]
        return min(found, key=lambda place: place.value)

    def best(self, f: Callable[[Array], ArrayLike] | str) -> Place:
        """The posture at which a function is largest, such as the distance from limits.

        It is evaluated at postures 0.05 rad or m apart on all components, and then between the best of them.

        Args:
            f: joint positions (N, n) -> values (N,), or "manipulability", `Task.manipulability` of the task.

        Raises:
            InvalidValueError: if there are no components, or f returns a wrong shape, or no number at any posture.
        """
        self._require_components()

        if isinstance(f, str):
            require_known("criterion", f, ("manipulability",))
            f = self.maps.task.manipulability

        def evaluate(q: Array) -> Array:
            values = as_float_array("what f returns", call_user("f", "a function of joint positions (N, n)", f, q))
            if values.shape != (len(q),):
                raise InvalidValueError("what f returns", f"shape {values.shape}", f"({len(q)},)")
            return np.where(np.isnan(values), -np.inf, values)

        # Evaluate f at even places on all arcs.
        counts = [max(2, int(arc.length / RULES.spacing) + 2) for arc in self.components]
        places = [np.linspace(0.0, arc.length, count) for arc, count in zip(self.components, counts, strict=True)]
        q = np.vstack([arc.at(part) for arc, part in zip(self.components, places, strict=True)])
        values = evaluate(q)
        if values.max() == -np.inf:
            raise InvalidValueError("what f returns", "NaN or -infinity at all postures", "a number at some of them")
        row, owners = int(np.argmax(values)), np.repeat(np.arange(len(counts)), counts)
        k = int(owners[row])
        arc, at, step = self.components[k], float(np.concatenate(places)[row]), self.components[k].length / counts[k]
        # Refine the best place by golden-section search on its arc, across the seam of a closed one.
        low, high = at - 2 * step, at + 2 * step
        if not arc.closed:
            low, high = max(0.0, low), min(arc.length, high)
        best = Place(q[row], float(values[row]), k, at)
        ratio = (np.sqrt(5) - 1) / 2
        for _ in range(RULES.golden):
            pair = np.array([high - ratio * (high - low), low + ratio * (high - low)])
            along = pair % arc.length if arc.closed else pair
            tried = arc.at(along)
            first, second = evaluate(tried)
            j = 0 if first >= second else 1
            if (first, second)[j] > best.value:
                best = Place(tried[j], float((first, second)[j]), k, float(along[j]))
            low, high = (low, pair[1]) if j == 0 else (pair[0], high)
            if high - low < RULES.refined:
                break
        return best

    def gap(self, a: int, b: int) -> Gap:
        """The least distance in joint space between two components.

        Args:
            a: index of a component.
            b: index of another component.

        Raises:
            InvalidValueError: if there are no such components, or they are the same.
        """
        for name, k in (("a", a), ("b", b)):
            require_kind(name, k, int)
            if not 0 <= k < len(self):
                raise InvalidValueError(name, k, f"the number of one of {len(self)} components, from 0 on")
        if a == b:
            raise InvalidValueError("b", b, "another component than a")
        first, second = self.components[a], self.components[b]
        spaced = [np.linspace(0.0, arc.length, max(2, int(arc.length / RULES.spacing) + 2)) for arc in (first, second)]
        rows = [arc.at(places) for arc, places in zip((first, second), spaced, strict=True)]
        apart = np.array([np.linalg.norm(self.measure_away(rows[1], q), axis=1) for q in rows[0]])

        def halve_square(places: Array) -> tuple[float, Array]:
            """Half the squared distance of the postures at two places, and its gradient (2,)."""
            (q,), (t,) = first._stand(_turn_back(first, places[:1]))
            (other,), (u,) = second._stand(_turn_back(second, places[1:]))
            away = self.measure_away(other[None], q)[0]
            return 0.5 * float(away @ away), np.array([-away @ t, away @ u])

        # Descend along both arcs at once from the pairs of points that are nearer than those around them.
        bounds = [(None, None) if arc.closed else (0.0, arc.length) for arc in (first, second)]
        cells = np.argwhere(apart <= minimum_filter(apart, size=3))
        cells = cells[np.argsort(apart[tuple(cells.T)])][: RULES.candidates]
        ends = [
            minimize(
                halve_square,
                [spaced[0][i], spaced[1][j]],
                jac=True,
                method="L-BFGS-B",
                bounds=bounds,
                options={"ftol": 0.0, "gtol": RULES.refined},
            )
            for i, j in cells
        ]
        x, y = min(ends, key=lambda end: float(end.fun)).x
        place, goal = (float(_turn_back(arc, np.array([at]))[0]) for arc, at in ((first, x), (second, y)))
        q, other = first.at(place), second.at(goal)
        other = q + self.measure_away(other[None], q)[0]
        value = float(np.linalg.norm(other - q))
        return Gap(value, Place(q, value, a, place), Place(other, value, b, goal))

    def merge(self, a: int, b: int) -> Merge:
        """A way from one component to another on which x deviates little.

        The search starts from the straight way across their gap. Its postures move across the way to smaller errors of
        x, and stay at equal distances. The way is a local solution: another one may have a smaller largest error.
        Errors are also measured on the straight line between neighbouring postures, at 16 places.

        Args:
            a: number of a component.
            b: number of another one.

        Raises:
            InvalidValueError: if there are no such components, or they are the same.

        Source:
            The string method: E, Ren and Vanden-Eijnden, J. Chem. Phys. 126 (2007) 164103, with Gauss-Newton steps.
        """
        gap = self.gap(a, b)
        # Start with postures at equal distances on the straight way across the gap.
        end = gap.first.q + self.measure_away(gap.second.q[None], gap.first.q)[0]
        q, before = np.linspace(gap.first.q, end, MERGE.images), np.inf
        low, high = self.maps.robot.lower, self.maps.robot.upper
        for _ in range(MERGE.rounds):
            e, J = self.maps.evaluate(q, np.tile(self.target, (len(q), 1)))
            most = float(np.linalg.norm(e, axis=1).max())
            if abs(before - most) < MERGE.settled * most:
                break
            before = most
            # Move each posture towards x, but not along the way.
            gram = J @ J.transpose(0, 2, 1)
            floor = MERGE.damping * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(e.shape[1])
            step = (J.transpose(0, 2, 1) @ np.linalg.solve(gram + floor, e[:, :, None]))[:, :, 0]
            along = np.gradient(q, axis=0)
            along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
            step -= (step * along).sum(axis=1, keepdims=True) * along
            step *= np.minimum(
                MERGE.step, MERGE.longest / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300)
            )
            q[1:-1] = np.clip(q + step, low, high)[1:-1]
            # Space the postures evenly again, and add some as the way gets longer.
            lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
            even = np.linspace(0.0, lengths[-1], max(MERGE.images, int(lengths[-1] / MERGE.spacing) + 2))
            q = np.column_stack([np.interp(even, lengths, column) for column in q.T])
        # The largest error is at a saddle between both sides, which Newton's method finds exactly.
        errors = self._measure_errors(q)
        k = int(np.argmax(errors))
        q[k] = self._find_pass(q[k], float(errors[k]))
        # Measure errors between neighbouring postures, too.
        shares = np.arange(MERGE.parts)[:, None, None] / MERGE.parts
        whole = np.vstack([(q[:-1] + shares * np.diff(q, axis=0)).reshape(-1, q.shape[1]), q[-1:]])
        errors = self._measure_errors(whole)
        worst = whole[[int(np.argmax(errors))]]
        vector = self.maps.targets.vector(self.maps.targets_of(worst))[0]
        return Merge(float(errors.max()), worst[0], np.asarray(vector), q)

    def _measure_errors(self, q: Array) -> Array:
        """|e| of postures (N, n), (N,)."""
        return np.asarray(np.linalg.norm(self.maps.evaluate(q, np.tile(self.target, (len(q), 1)))[0], axis=1))

    def _find_pass(self, q: Array, error: float) -> Array:
        """The posture near q (n,) within the limits at which |e|^2 is stationary; q if there is none."""
        at, target = q.copy(), self.target[None]
        bend = build_curvature(self.maps.equations)
        for _ in range(MERGE.pairs):
            e, J = (part[0] for part in self.maps.evaluate(at[None], target))
            step = np.linalg.lstsq(np.asarray(bend(at, self.target)), J.T @ e, rcond=MERGE.flat)[0]
            size = float(np.linalg.norm(step))
            at = at + min(1.0, RULES.largest / (size + 1e-300)) * step
            if size < MERGE.settled:
                break
        # Accept only a pass near the given posture.
        inside = ((at >= self.maps.robot.lower) & (at <= self.maps.robot.upper)).all()
        found = float(np.linalg.norm(self.maps.evaluate(at[None], target)[0]))
        good = inside and size < MERGE.settled and abs(found - error) < MERGE.near * error
        return at if good and np.linalg.norm(at - q) < MERGE.away else q

    def plot(self) -> Figure:
        """Plot the joints along each component, relative to their ranges; titles name the joints that stop it."""
        from matplotlib.figure import Figure  # heavy, and few calls need it

        robot, figure = self.maps.robot, Figure(figsize=(8.0, 2.2 * max(1, len(self))), layout="constrained")
        # Draw one row of axes for each arc, with the outer tenth of the joints' ranges in grey.
        for k, arc in enumerate(self.components):
            axes = figure.add_subplot(len(self), 1, k + 1)
            places = np.linspace(0.0, arc.length, max(2, int(arc.length / RULES.spacing)))
            q = arc.at(places)
            for i, name in enumerate(robot.joint_names):
                low, high = float(robot.lower[i]), float(robot.upper[i])
                bounded = math.isfinite(low) and math.isfinite(high)
                centre, half = ((low + high) / 2, (high - low) / 2) if bounded else (0.0, np.pi)
                axes.plot(places, (q[:, i] - centre) / half, label=name, linewidth=1.2)
            axes.axhspan(0.9, 1.0, color="0.9")
            axes.axhspan(-1.0, -0.9, color="0.9")
            axes.set(ylim=(-1.02, 1.02), xlim=(0.0, arc.length), ylabel=f"component {k}")
            ends = "closed" if arc.closed else " -> ".join(str(stop) for stop in arc.ends)
            axes.set_title(ends, fontsize="small", loc="left")
        if self.components:
            figure.axes[-1].set_xlabel("length along the component [rad]")
            figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize="small")
        return figure

    def facts(self) -> dict[str, str]:
        """Number and length of the components, and what stops them."""
        closed = sum(arc.closed for arc in self.components)
        stops: dict[str, int] = {}
        for arc in self.components:
            for stop in () if arc.closed else arc.ends:
                stops[str(stop)] = stops.get(str(stop), 0) + 1
        most = sorted(stops.items(), key=lambda item: -item[1])[:5]
        return {
            "self-motions": f"{len(self)} arcs of length {self.length:.4g}, {closed} of them closed",
            **({"stopped by": "; ".join(f"{name} ({count})" for name, count in most)} if most else {}),
        }

    def _require_components(self) -> None:
        if not self.components:
            raise InvalidValueError("x", self.x.tolist(), "a task value that a posture within the limits has")

    def measure_away(self, q: Array, wish: Array) -> Array:
        """q - wish (N, n), without full turns of joints without limits."""
        robot, turning = self.maps.robot, self.maps.turning
        free = turning & np.isinf(robot.lower) & np.isinf(robot.upper)
        return np.asarray(wrap_shortest(q - wish, np.where(free, _TURN, 0.0)))

    def _refine(self, k: int, place: float, wish: Array) -> Place:
        """The nearest posture on an arc near a place, by secant steps for (q - wish) . t = 0 along the arc."""
        arc = self.components[k]
        best, pull, slope, trial, step = Place(wish, np.inf, k, place), 0.0, 1.0, place, 0.0
        for _ in range(RULES.refinements):
            q, t = (part[0] for part in arc._stand(np.array([trial])))
            away = self.measure_away(q[None], wish)[0]
            gap, turned = float(np.linalg.norm(away)), float(away @ t)
            # The distance is least where q - wish is perpendicular to the arc.
            if step:
                slope = max(
                    RULES.least_slope, (turned - pull) / step, 0.0 if gap < best.value else 2 * abs(pull / step)
                )
            if gap < best.value:
                best, pull = Place(wish + away, gap, k, trial), turned
            # Step from the best place so far; after a worse place, the next step is at most half as long.
            new = best.place - float(np.clip(pull / slope, -RULES.largest, RULES.largest))
            trial = new % arc.length if arc.closed else min(max(new, 0.0), arc.length)
            step = (new if arc.closed else trial) - best.place
            if abs(step) < RULES.refined:
                break
        return best


def _turn_back(arc: Arc, places: Array) -> Array:
    """Places (P,) on an arc, also of those beyond the ends of a closed one."""
    return places % arc.length if arc.closed else places


def find_motions(maps: ArmMaps, target: Array, *starts: Array) -> SelfMotions:
    """All self-motions of a target (k,), from given starts (S, n) and from stored postures."""
    curves = maps.find_curves(target, *starts)
    arcs = [arc for curve in curves for arc in cut_curve(maps, target, curve)]
    arcs.sort(key=lambda arc: -arc.length)
    return SelfMotions(maps, target, tuple(arcs), len(curves))


def cut_curve(maps: ArmMaps, target: Array, curve: Curve) -> list[Arc]:
    """The arcs of a curve within the limits: for each number of full turns of the joints, where all are inside."""
    # Find the full turns that put each joint within its limits at the begin.
    present: list[set[int]] = []
    for q, (low, high, turns) in zip(curve.q[0].tolist(), maps.limits, strict=True):
        if turns and math.isfinite(low):
            lowest, highest = math.ceil((low - q) / _TURN), math.floor((high - q) / _TURN)
            present.append(set(range(lowest, highest + 1)))
        else:
            present.append({0} if low <= q <= high else set())
    # Pieces that no limit ends stop at the seam of a closed curve, which is joined later, or at the end of the curve.
    opened = Stop(StopKind.SINGULAR)
    seam = Stop(StopKind.ENDLESS) if curve.closed else opened
    active: dict[tuple[int, ...], tuple[float, Stop]] = dict.fromkeys(product(*present), (0.0, seam))
    pieces: list[tuple[Piece, Stop, Stop]] = []
    found, stops = curve.crossings, maps.stops
    columns = (found[name].tolist() for name in ("place", "joint", "side", "turns", "rises"))
    for place, i, side, turns, rises in zip(*columns, strict=True):
        # A joint after k turns enters or leaves its limits, so pieces begin or end for all turns of the other joints.
        k, enters, stop = -turns, side != rises, stops[i][side]
        if enters and k not in present[i]:
            present[i].add(k)
            others = [part if j != i else {k} for j, part in enumerate(present)]
            active |= dict.fromkeys(product(*others), (place, stop))
        elif not enters and k in present[i]:
            present[i].remove(k)
            for lift in [lift for lift in active if lift[i] == k]:
                begin, began = active.pop(lift)
                pieces.append((Piece(begin, place, lift), began, stop))
    whole = float(curve.places[-1])
    pieces += [(Piece(begin, whole, lift), began, seam) for lift, (begin, began) in active.items()]
    if not curve.closed:
        return [Arc(maps, target, curve, (piece,), (began, ended), False) for piece, began, ended in pieces]
    return _join_at_seam(maps, target, curve, pieces, seam)


def _join_at_seam(
    maps: ArmMaps, target: Array, curve: Curve, pieces: list[tuple[Piece, Stop, Stop]], seam: Stop
) -> list[Arc]:
    """Join pieces of a closed curve across its last point to arcs."""
    winding = np.where(np.isfinite(maps.robot.lower), np.rint((curve.q[-1] - curve.q[0]) / _TURN), 0.0)
    winding = np.where(maps.turning, winding, 0.0).astype(int)
    # The next piece after the last point has the turns of this one plus the winding of the curve.
    begins = {piece.turns: k for k, (piece, began, _) in enumerate(pieces) if began is seam}
    follower: dict[int, int] = {}
    for k, (piece, _, ended) in enumerate(pieces):
        if ended is seam:
            after = tuple((np.array(piece.turns) + winding).tolist())
            if after in begins:
                follower[k] = begins[after]
    # Chain the pieces: first chains that begin at a limit, then closed chains.
    arcs, used = [], set[int]()
    heads = [k for k in range(len(pieces)) if k not in follower.values()]
    for head in [*heads, *range(len(pieces))]:
        if head in used:
            continue
        chain, k = [head], head
        used.add(head)
        while k in follower and follower[k] not in used:
            k = follower[k]
            chain.append(k)
            used.add(k)
        closed = follower.get(k) == head
        ends = (pieces[head][1], pieces[k][2])
        arcs.append(Arc(maps, target, curve, tuple(pieces[j][0] for j in chain), ends, closed))
    return arcs
