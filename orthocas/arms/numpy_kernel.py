"""The search for self-motion curves in NumPy, for machines without a C compiler: as runtime/self_motion.c."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise, product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.arms.kernel import RULES, Curve, crossing_type, evaluate_cubic
from orthocas.arms.stored import StoredPostures
from orthocas.tools.batch import Batched
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

_TURN = 2 * np.pi
Component = Callable[[float], float]  #: of a cubic step, as a function of the share of the step


@dataclass(frozen=True, eq=False)
class NumpyKernel:
    """`orthocas.arms.kernel.Kernel` in NumPy. Threads may share it."""

    equations: ca.Function
    lower: Array
    upper: Array
    turning: NDArray[np.bool_]

    def choose_starts(self, stored: StoredPostures, place: Array) -> Array:
        """As `Kernel.choose_starts`."""
        return stored.near(place, RULES.starts)

    def find_curves(self, target: Array, starts: Array, patience: int = RULES.patience) -> list[Curve]:
        """As `Kernel.find_curves`; the same curves, from other first points."""
        curves: list[Curve] = []
        left, quiet = list(zip(*self._reach(target, starts), strict=True))[::-1], 0
        bridges: list[tuple[Array, Array, np.bool_]] = []
        while len(curves) < RULES.curves and (bridges or (left and quiet < patience)):
            quiet += not bridges
            q, t, good = (bridges or left).pop()
            if not good or any(self.lies_on(target, curve, q, t) for curve in curves):
                continue
            curve = self._trace(target, q, t)
            if curve is not None:
                curves.append(curve)
                quiet = 0
                if len(starts := self._find_bridges(target, curve)):
                    bridges += zip(*self._reach(target, starts), strict=True)
        return curves

    def correct(self, target: Array, q: Array, tangent: Array) -> NDArray[np.bool_]:
        """As `Kernel.correct`."""
        row, left, good = tangent.copy(), np.arange(len(q)), np.zeros(len(q), dtype=bool)
        for _ in range(RULES.corrections):
            e, J = self._evaluate(q[left], target)
            change, t = _solve_bordered(J, e, row[left], np.zeros(len(left)))
            size = np.linalg.norm(change, axis=1)
            kept = size < RULES.missed
            q[left[kept]] += change[kept]
            tangent[left[kept]] = t[kept]
            good[left[kept & (size < 1e-7)]] = True
            left = left[kept & ~(size < 1e-7)]
            if not left.size:
                break
        good[left[: len(left)]] = True
        return np.asarray(good & ((row * tangent).sum(axis=1) > 0))

    def _find_bridges(self, target: Array, curve: Curve) -> Array:
        """Starts (K, n) beyond the singular positions next to a curve, where another one may run beside it."""
        rows = len(curve.q) * (2 * np.arange(RULES.bridges) + 1) // (2 * RULES.bridges)
        q = curve.q[rows]
        _, s, V = np.linalg.svd(self._evaluate(q, target)[1], full_matrices=False)
        steps = (RULES.across * s[:, -1:] * V[:, -1])[s[:, -1] < RULES.narrow]
        q = q[s[:, -1] < RULES.narrow]
        return np.concatenate([q - steps, q + steps])

    def _reach(self, target: Array, starts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Where damped least squares lead from starts (S, n), the tangents there, and whether they arrive."""
        q, good, left = starts.copy(), np.zeros(len(starts), dtype=bool), np.arange(len(starts))
        tangents = np.zeros_like(q)
        for _ in range(RULES.reach):
            e, J = self._evaluate(q[left], target)
            error = np.abs(e).max(axis=1)
            gram = J @ J.transpose(0, 2, 1)
            damping = np.where(error > 0.1, RULES.far_damping, np.where(error > 1e-3, RULES.near_damping, 1e-14))
            damping = damping * np.trace(gram, axis1=1, axis2=2)
            y = np.linalg.solve(gram + (damping[:, None, None] + 1e-300) * np.eye(e.shape[1]), e[:, :, None])
            step = (J.transpose(0, 2, 1) @ y)[:, :, 0]
            size = np.linalg.norm(step, axis=1)
            q[left] += np.minimum(1.0, RULES.largest / (size + 1e-300))[:, None] * step
            done = (error <= RULES.reached) & (size < RULES.arrived)
            if done.any():
                tangents[left[done]] = _find_tangents(J[done])
                good[left[done]] = True
            left = left[~done & np.isfinite(error)]
            if not left.size:
                break
        return q, tangents, good

    def _trace(self, target: Array, q: Array, t: Array) -> Curve | None:
        """The curve through q (n,) from end to end."""
        nodes, tangents, closed = self._follow(target, q, t, 1.0)
        if not closed:
            behind, back, _ = self._follow(target, q, t, -1.0)
            nodes, tangents = behind[:0:-1] + nodes, [-part for part in back[:0:-1]] + tangents
        if len(nodes) < 3:
            return None
        points, directions = np.array(nodes), np.array(tangents)
        lengths = np.append(_length_of(points[:-1], points[1:], directions[:-1], directions[1:]), 0.0)
        bare = Curve(points, directions, lengths, closed, np.empty(0, crossing_type(len(q))))
        return Curve(points, directions, lengths, closed, self._find_crossings(target, bare))

    def _follow(self, target: Array, q0: Array, t0: Array, sense: float) -> tuple[list[Array], list[Array], bool]:
        """Points and tangents from q0 (n,) on, those against the tangent reversed; whether the last is the first."""
        nodes, tangents = [q0], [sense * t0]
        h, before = RULES.step / 3, 0.0
        while len(nodes) < RULES.nodes:
            q, t = nodes[-1], tangents[-1]
            new = q + h * t
            if before > 0:
                new = evaluate_cubic(nodes[-2], q, tangents[-2], t, before, 1.0 + h / before)[0]
            new, onward, missed, good = self._correct_step(target, new, t, sense, h)
            turned = float(onward @ t)
            if not (good and turned > RULES.turned):
                h /= 2
                if h < RULES.shortest:
                    break
                continue
            last, before = h, float(_length_of(q[None], new[None], t[None], onward[None])[0])
            nodes.append(new)
            tangents.append(onward)
            step = Curve(np.array(nodes[-2:]), np.array(tangents[-2:]), np.array([before, 0.0]), False, _NONE)
            if len(nodes) > 3 and self.lies_on(target, step, q0, sense * t0):
                nodes[-1] = q0 + np.where(self.turning, _TURN * np.rint((new - q0) / _TURN), 0.0)
                tangents[-1] = sense * t0
                return nodes, tangents, True
            room = RULES.prismatic * (self.upper - self.lower)
            outside = (new < self.lower - room) | (new > self.upper + room)
            if (outside & ~self.turning & np.isfinite(room)).any():
                break
            h = min(h * min(1.6, max(0.5, np.cbrt(min(RULES.aim, RULES.tight * h) / max(missed, 1e-9)))), RULES.step)
            h = min(h, last) if turned < RULES.straight else h
        return nodes, tangents, False

    def _correct_step(
        self, target: Array, new: Array, t: Array, sense: float, h: float
    ) -> tuple[Array, Array, float, bool]:
        """A point (n,) predicted for a step h, on the curve across t; the tangent, first correction, and success."""
        missed, onward = 0.0, t
        for k in range(RULES.corrections):
            e, J = self._evaluate(new[None], target)
            change, found = _solve_bordered(J, e, t[None], np.zeros(1))
            size = float(np.linalg.norm(change))
            missed = size if k == 0 else missed
            if not size < min(RULES.missed, RULES.loose * h):
                return new, onward, np.inf, False
            new, onward = new + change[0], sense * found[0]
            if size < min(RULES.corrected, RULES.exact * h):
                return new, onward, missed, True
        return new, onward, missed, False

    def lies_on(self, target: Array, curve: Curve, q: Array, t: Array) -> bool:
        """Whether a posture q (n,) of the target, with the tangent there, lies on a curve, up to full turns."""
        away = q - curve.q[:-1]
        away = np.where(self.turning, away - _TURN * np.rint(away / _TURN), away)
        length = curve.length[:-1]
        most = np.minimum(RULES.known, RULES.resolved * length)
        near = np.flatnonzero((away**2).sum(axis=1) <= (length + most) ** 2)
        if not near.size:
            return False
        a, b = np.zeros((len(near), len(q))), curve.q[near + 1] - curve.q[near]
        start, end, away, h = curve.tangent[near], curve.tangent[near + 1], away[near], length[near, None]
        u = (away * start).sum(axis=1, keepdims=True) / h
        for _ in range(3):
            at, slope = evaluate_cubic(a, b, start, end, h, np.clip(u, 0.0, 1.0))
            u = np.clip(u, 0.0, 1.0) + ((away - at) * slope).sum(axis=1, keepdims=True) / h
        at, slope = evaluate_cubic(a, b, start, end, h, np.clip(u, 0.0, 1.0))
        gaps = np.linalg.norm(at - away, axis=1)
        for k in np.flatnonzero((gaps < most[near]) & (slope @ t > 0)):
            beside = curve.q[near[k]] + away[k]
            point = at[k] - away[k] + beside
            if gaps[k] < RULES.sure * most[near[k]] or self._is_beside(target, point, slope[k], beside, gaps[k]):
                return True
        return False

    def _is_beside(self, target: Array, point: Array, direction: Array, q: Array, gap: float) -> bool:
        """Whether the posture across a direction from q (n,), which one near a curve leads to, is q."""
        for _ in range(RULES.corrections):
            e, J = self._evaluate(point[None], target)
            change = _solve_bordered(J, e, direction[None], np.array([direction @ (q - point)]))[0][0]
            point = point + change
            if not np.linalg.norm(change) >= RULES.sure * gap:
                break
        return bool(np.linalg.norm(q - point) < 0.1 * gap)

    def _find_crossings(self, target: Array, curve: Curve) -> NDArray[np.void]:
        """Where a curve crosses limits, in order."""
        found: list[tuple[float, Array, int, int, int, int]] = []
        for k in range(len(curve.q) - 1):
            step = curve.q[k], curve.q[k + 1], curve.tangent[k], curve.tangent[k + 1], float(curve.length[k])
            self._cross_step(target, step, float(curve.places[k]), 0, found)
        found.sort(key=lambda item: item[0])
        result = np.zeros(len(found), crossing_type(curve.q.shape[1]))
        for row, (place, q, joint, side, turns, rises) in zip(result, found, strict=True):
            row["place"], row["q"], row["joint"], row["side"] = place, q, joint, side
            row["turns"], row["rises"] = turns, rises
        return result

    def _cross_step(
        self,
        target: Array,
        step: tuple[Array, Array, Array, Array, float],
        place: float,
        depth: int,
        found: list[tuple[float, Array, int, int, int, int]],
    ) -> None:
        """Add the crossings of a step; it is divided where a joint turns back next to a limit."""
        a, b, start, end, h = step
        joints = np.flatnonzero(np.isfinite(self.lower) | np.isfinite(self.upper)).tolist()
        cubics = {i: _find_pieces(b[i] - a[i], h * start[i], h * end[i]) for i in joints}
        u = self._find_graze(a, cubics, RULES.graze / 2 ** (4 * depth)) if depth < RULES.halvings else -1.0
        if u > 0.0:
            q, t = (part[None] for part in evaluate_cubic(a, b, start, end, h, u))
            if self.correct(target, q, t)[0]:
                self._cross_step(target, (a, q[0], start, t[0], u * h), place, depth + 1, found)
                rest = (q[0], b, t[0], end, (1 - u) * h)
                self._cross_step(target, rest, place + u * h, depth + 1, found)
                return
        for i, (value, bends) in cubics.items():
            values = [value(u) for u in bends]
            for side, bound in enumerate((self.lower[i], self.upper[i])):
                ends = [(part - bound + a[i]) / _TURN for part in (min(values), max(values))]
                numbers = range(int(np.ceil(ends[0])), int(np.floor(ends[1])) + 1) if self.turning[i] else (0,)
                for turns, (left, right) in product(numbers, pairwise(bends)):
                    v = bound - a[i] + _TURN * turns
                    above = value(left) > v
                    if above == (value(right) > v):
                        continue
                    low, high = left, right
                    for _ in range(30):
                        u = (low + high) / 2
                        low, high = (u, high) if (value(u) > v) == above else (low, u)
                    q = self._meet_limit(target, *evaluate_cubic(a, b, start, end, h, low), i, a[i] + v)
                    found.append((place + low * h, q, i, side, turns, int(not above)))

    def _find_graze(self, a: Array, cubics: Mapping[int, tuple[Component, list[float]]], graze: float) -> float:
        """The share of a step at which a joint turns next to a limit; -1 where none does."""
        for i, (value, bends) in cubics.items():
            for u in bends[1:-1]:
                gaps = a[i] + value(u) - np.array([self.lower[i], self.upper[i]])
                gaps = gaps - _TURN * np.rint(gaps / _TURN) if self.turning[i] else gaps
                if np.abs(gaps).min() < graze:
                    return u if 1e-6 < u < 1 - 1e-6 else -1.0
        return -1.0

    def _meet_limit(self, target: Array, start: Array, t: Array, joint: int, value: float) -> Array:
        """The exact point near one (n,) at which a joint has a value, or else on the curve."""
        row, q, size = np.eye(len(start))[joint][None], start.copy(), np.inf
        for _ in range(RULES.corrections):
            e, J = self._evaluate(q[None], target)
            change, _ = _solve_bordered(J, e, row, np.array([value - q[joint]]))
            size = float(np.linalg.norm(change))
            q = q + change[0]
            if not RULES.missed > size >= 1e-9:
                break
        if size < 1e-6 and np.linalg.norm(q - start) < RULES.missed:
            return q
        points, tangents = start[None].copy(), t[None].copy()
        self.correct(target, points, tangents)
        return np.asarray(points[0])

    def _evaluate(self, q: Array, target: Array) -> tuple[Array, Array]:
        """e (N, m) and J (N, m, n) at q (N, n)."""
        e, J = self._batched(np.ascontiguousarray(q), np.tile(target, (len(q), 1)))
        return e.reshape(len(q), -1), J.reshape(len(q), -1, q.shape[1])

    @cached_property
    def _batched(self) -> Batched:
        return Batched(self.equations)


_NONE = np.empty(0, crossing_type(1))
_GAUSS = ((1 - np.sqrt(0.6)) / 2, 0.5, (1 + np.sqrt(0.6)) / 2), (5 / 18, 8 / 18, 5 / 18)  # places and weights


def _solve_bordered(J: Array, e: Array, rows: Array, rest: Array) -> tuple[Array, Array]:
    """dq with J dq = e and row . dq = rest, and unit tangents with det [J; t] > 0, (N, n) each; NaN where singular."""
    N, m, n = J.shape
    A, right = np.concatenate([J, rows[:, None]], axis=1), np.zeros((N, n, 2))
    right[:, :m, 0], right[:, m, 0], right[:, m, 1] = e, rest, 1.0
    try:
        found = np.linalg.solve(A, right)
    except np.linalg.LinAlgError:
        return np.full((N, n), np.nan), np.full((N, n), np.nan)
    sign = np.sign(np.linalg.det(A))[:, None]
    with np.errstate(all="ignore"):
        t = found[:, :, 1] / np.linalg.norm(found[:, :, 1], axis=1, keepdims=True)
    return found[:, :, 0], sign * t


def _find_tangents(J: Array) -> Array:
    """Unit tangents (N, n) with det [J; t] > 0."""
    t = np.linalg.svd(J)[2][:, -1]
    sign = np.sign(np.linalg.det(np.concatenate([J, t[:, None]], axis=1)))
    return np.asarray(t * np.where(sign == 0, 1.0, sign)[:, None])


def _length_of(a: Array, b: Array, start: Array, end: Array) -> Array:
    """Lengths of steps (N,) with unit tangents at both ends: of a cubic whose slopes have the length of an arc."""
    turn = 1.0 - np.minimum(1.0, (start * end).sum(axis=1))
    h = np.linalg.norm(b - a, axis=1, keepdims=True) * (1.0 + turn[:, None] / 12)
    length = np.zeros(len(a))
    for u, weight in zip(_GAUSS[0], _GAUSS[1], strict=True):
        slope = 6 * (u - u * u) * (b - a) + h * ((1 - 4 * u + 3 * u * u) * start + (3 * u * u - 2 * u) * end)
        length += weight * np.linalg.norm(slope, axis=1)
    return length


def _find_pieces(d: float, start: float, end: float) -> tuple[Component, list[float]]:
    """A component of a cubic step from 0 to d with slopes, as a function of the share; 0, where it turns, and 1."""
    one, two, three = start, 3 * d - 2 * start - end, start + end - 2 * d

    def value(u: float) -> float:
        return float(u * (one + u * (two + u * three)))

    turns = np.roots([3 * three, 2 * two, one]) if three else np.roots([2 * two, one])
    inner = sorted(float(u.real) for u in turns if abs(u.imag) == 0 and 0 < u.real < 1)
    return value, [0.0, *inner, 1.0]
