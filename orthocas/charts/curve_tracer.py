"""Tracing of self-motion curves, for many task values at once in NumPy, and kernels in C for r = 1.

`CurveTracer` traces curves regardless of limits. `MotionKernel` follows a self-motion within the domain in C, and
`SearchKernel` is the search of `curves.SelfMotionCurves` in C.
"""

from __future__ import annotations

import ctypes
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.charts.coordinates import Coordinates
from orthocas.charts.descent import BoxedPhi
from orthocas.charts.newton import inverses
from orthocas.errors import CompileError, InvalidValueError
from orthocas.native import curves
from orthocas.native.kernels import generate_kernels, get_source, render
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.tasks.relative import Relative
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.expressions import wrap_shortest

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

# With -O3, compilation takes twice as long, and the code is only a tenth faster.
_FLAGS = ("-O1",)


@dataclass(frozen=True, slots=True)
class CurveRules:
    """Numbers of the search along curves. Chosen on panda-wide and xarm7-wide (benchmarks/round_trips.py)."""

    near_phi: int = 4  #: stored positions near each phi at which curves start
    near_x: int = 8  #: stored positions near each x at which curves start
    more: int = 24  #: further stored positions near x, for rows without a solution
    reach: int = 25  #: largest number of steps from a start to its x
    reached: float = 1e-3  #: error of x, relative to the component sizes, at which a start counts as arrived
    largest: float = 0.7  #: [rad] or [m] largest norm of one of those steps
    missed: float = 0.08  #: [rad] or [m] largest correction of a step along a curve
    step: float = 0.4  #: [rad] or [m] longest step along a curve
    shortest: float = 0.03  #: [rad] or [m] a curve that needs shorter steps ends; it is near a singular position
    most: int = 80  #: largest number of steps of a curve in one direction
    turned: float = 0.9  #: least cosine between the tangents at both ends of a step
    straight: float = 0.96  #: cosine above which the next step may be longer
    known: float = 0.05  #: [rad] or [m] distance from a curve up to which a start counts as lying on it
    parts: int = 3  #: parts of a step between points at which xi is evaluated
    corrections: int = 2  #: Newton steps from such points to x
    last_correction: float = 1e-3  #: [rad] or [m] largest last correction of a point that counts as having x
    sagitta: float = 6e-3  #: [rad] or [m] largest distance of the curve from the chords of those parts
    halvings: int = 5  #: halvings of chords that pass through the box between points outside
    narrow: float = 1e-10  #: [rad] or [m] width of the bracket of an end of an arc
    narrowings: int = 100  #: largest number of halvings of that bracket
    newton: int = 8  #: Newton steps to a solution; solutions near a fold need more than four
    snap: float = 1e-9  #: [half-widths] solutions so close to the boundary are moved onto it
    few: int = 16  #: number of rows up to which all starts are traced at once, even if some lie on one curve
    prismatic: float = 1.0  #: [half-widths] how far curves may leave the range of a prismatic joint


RULES = CurveRules()


@dataclass(frozen=True, eq=False)
class Traces:
    """K curves, each for one target: points in order, at most about `RULES.step` apart."""

    row: Indices  #: number of the target, (K,)
    q: Array  #: (K, P, n), continuous angles; the last point is repeated after the end of a curve
    tangent: Array  #: unit tangents there, (K, P, n)
    count: Indices  #: points of each curve, (K,)

    def part(self, curves: Indices) -> Traces:
        """The selected curves."""
        row, q, tangent, count = (array[curves] for array in vars(self).values())
        longest = count.max(initial=1)
        return Traces(row, q[:, :longest], tangent[:, :longest], count)


@dataclass(frozen=True, eq=False)
class CurveTracer:
    """Traces curves of joint positions with the same task value and the same positions of r - 1 held joints.

    In this class, x (n - 1,) stands for the m task values followed by the positions of the held joints.
    """

    boxed: BoxedPhi
    held: tuple[int, ...] = ()  #: indices of the r - 1 held joints; none for r = 1

    def reach(self, x: Array, starts: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Move starts (M, n) to x (M, n - 1) by damped least squares, regardless of limits.

        Returns:
            Their ends (M, n), and whether x is met there, (M,).
        """
        q, arrived, left = starts.copy(), np.zeros(len(starts), dtype=bool), np.arange(len(starts))
        # rows drop out when they arrive, or when a step is not finite
        for _ in range(RULES.reach):
            found = self._damped_step(q[left], x[left])[0]
            q[left] += found[:, :-1]
            arrived[left] = found[:, -1] <= RULES.reached
            left = left[(found[:, -1] > RULES.reached) & np.isfinite(found[:, -1])]
            if not left.size:
                break
        return q, arrived

    def trace(self, x: Array, q: Array, rows: Indices) -> Traces:
        """Trace the curves through points q (K, n), from end to end, for x (K, n - 1). `rows` (K,) are row numbers."""
        m, n = self.boxed.m, q.shape[1]
        # the tangent spans the null space of the n - 1 rows of J
        J = np.empty((len(q), n - 1, n))
        J[:, :m] = self.boxed.phi_map.jacobian(q)[:, :m] / self.boxed.phi_map.sizes[:m, None]
        J[:, m:] = np.eye(n)[list(self.held)]
        t = np.linalg.qr(J.transpose(0, 2, 1), mode="complete")[0][:, :, -1]
        # follow each curve in one direction; if it does not close, also in the other
        ahead, tangents, count, closed = self._follow(x, q, t)
        back = np.flatnonzero(~closed)
        if not back.size:
            return Traces(rows, ahead, tangents, count)
        behind, behind_tangents, behind_count, _ = self._follow(x[back], q[back], -t[back])
        before = np.zeros(len(q), dtype=np.int64)
        before[back] = behind_count - 1
        # join both halves: the second one reversed, then the first
        total = count + before
        place = np.arange(total.max())
        after = np.clip(place - before[:, None], 0, (count - 1)[:, None])
        points, directions = (np.take_along_axis(part, after[:, :, None], axis=1) for part in (ahead, tangents))
        turned_round = np.maximum(before[back, None] - place, 0)
        early = (place < before[back, None])[:, :, None]
        turned_round = np.minimum(turned_round, behind.shape[1] - 1)[:, :, None]
        points[back] = np.where(early, np.take_along_axis(behind, turned_round, axis=1), points[back])
        opposite = -np.take_along_axis(behind_tangents, turned_round, axis=1)
        directions[back] = np.where(early, opposite, directions[back])
        return Traces(rows, points, directions, total)

    def on_curves(self, q: Array, traces: Traces) -> NDArray[np.bool_]:
        """Whether positions q (K, S, n) lie on their curves, up to full turns, (K, S)."""
        # compare angles as points on circles, so that full turns do not matter
        mine, exists = self._on_circles(q), np.arange(traces.q.shape[1]) < traces.count[:, None]
        points = np.zeros((*exists.shape, mine.shape[2]))
        points[exists] = self._on_circles(traces.q[exists])
        # the nearest vertex of each curve
        squares = np.where(exists, (points**2).sum(axis=2), np.inf)[:, None] - 2 * mine @ points.transpose(0, 2, 1)
        nearest = np.argmin(squares, axis=2)
        found = np.zeros(nearest.shape, dtype=bool)
        # distance to the segments on both sides of this vertex
        for place in (np.maximum(nearest - 1, 0), nearest):
            start = np.take_along_axis(traces.q, place[:, :, None], axis=1)
            after = np.minimum(place + 1, traces.q.shape[1] - 1)
            step = np.take_along_axis(traces.q, after[:, :, None], axis=1) - start
            away = without_turns(q - start, self.turning)
            share = (away * step).sum(axis=2) / np.maximum((step**2).sum(axis=2), 1e-300)
            gap = away - np.clip(share, 0.0, 1.0)[:, :, None] * step
            found |= (gap**2).sum(axis=2) < RULES.known**2
        return found

    def away(self, q: Array) -> Array:
        """Distance of q (N, S, n) to the domain's box, up to full turns: that of the farthest joint, (N, S)."""
        low, high = self.boxed.domain.bounds
        bounded = np.isfinite(low)
        centre, half = np.where(bounded, (low + high) / 2, 0.0), np.where(bounded, (high - low) / 2, np.inf)
        return np.asarray((np.abs(without_turns(q - centre, self.turning)) - half).max(axis=2).clip(0.0))

    def correct(self, x: Array, q: Array, t: Array) -> tuple[Array, Array]:
        """Newton steps from q (K, n) to x, perpendicular to t (K, n), and tangents u with t . u = 1, (K, n) each."""
        found = self._bordered_step(q, x, t)[0]
        return found[:, : q.shape[1]], found[:, q.shape[1] :]

    def _follow(self, x: Array, q0: Array, t0: Array) -> tuple[Array, Array, Indices, NDArray[np.bool_]]:
        """Follow curves from q0 (K, n) along t0 until they close, leave the ranges of prismatic joints, or fail.

        Returns:
            Points and unit tangents (K, P, n), the number of points of each curve (K,), and whether it closes, (K,).
        """
        (K, n), size = q0.shape, RULES.most + 1
        points, tangents = np.empty((K, size, n)), np.empty((K, size, n))
        points[:, 0], tangents[:, 0] = q0, t0
        count, closed = np.ones(K, dtype=np.int64), np.zeros(K, dtype=bool)
        # input of `_step` for each curve: point, tangent, curvature, length of the step, first point and tangent
        state = np.concatenate([q0, t0, np.zeros((K, n)), np.full((K, 1), RULES.step / 2), q0, t0], axis=1)
        left, before = np.arange(K), np.zeros(K)
        (low, high), room = self.boxed.domain.bounds, RULES.prismatic * self.boxed.domain.half_width
        for _ in range(RULES.most):
            found = self._step(state, x)[0]
            # accept a step if its correction is short and the tangent turns little
            new, onward, (missed, turned, gap, ahead) = found[:, :n], found[:, n : 2 * n], found[:, 2 * n :].T
            good = (missed < RULES.missed) & (turned > RULES.turned)
            moved, h = left[good], state[:, 3 * n]
            # The curve closes if it is near its start and passes it in the initial direction.
            around = good & (gap < 1.6 * RULES.step) & (before < 0) & (ahead >= 0) & (count[left] > 3)
            closed[left] = around
            points[moved, count[moved]], tangents[moved, count[moved]] = new[good], onward[good]
            count[moved] += 1
            # the next step predicts with the curvature of this one
            bend = (onward - state[:, n : 2 * n]) / h[:, None]
            state[:, : 3 * n] = np.where(good[:, None], np.hstack([new, onward, bend]), state[:, : 3 * n])
            before = np.where(good, ahead, before)
            # longer steps on straight parts, half the step after a failure
            longer = np.where(turned > RULES.straight, np.minimum(1.6 * h, RULES.step), h)
            h[:] = np.where(good, longer, h / 2)
            goes_on = ~around & (h > RULES.shortest)
            # stop curves whose prismatic joints are far outside their ranges
            if not self.turning.all():
                goes_on &= (((state[:, :n] >= low - room) & (state[:, :n] <= high + room)) | self.turning).all(axis=1)
            if not goes_on.all():
                state, x, left, before = state[goes_on], x[goes_on], left[goes_on], before[goes_on]
            if not left.size:
                break
        # curves that ended earlier repeat their last point
        last = np.minimum(np.arange(count.max()), count[:, None] - 1)[:, :, None]
        points, tangents = (np.take_along_axis(part, last, axis=1) for part in (points, tangents))
        return points, tangents, count, closed

    def _on_circles(self, q: Array) -> Array:
        """Cosines and sines of revolute joints of q (..., n), then positions of prismatic ones, (..., k)."""
        turning, sliding = q[..., self.turning], q[..., ~self.turning]
        return np.concatenate([np.cos(turning), np.sin(turning), sliding], axis=-1)

    @property
    def equations(self) -> ca.Function:
        """Function of q and x: scaled errors e (n - 1, 1) and scaled J (n - 1, n), as in `_symbols`."""
        q, x, e, J = self._symbols
        return dense_function("equations", [q, x], [e, J])

    @cached_property
    def _bordered_step(self) -> BlockedFunction:
        """`_bordered` for many points."""
        return BlockedFunction(self._bordered)

    @cached_property
    def _bordered(self) -> ca.Function:
        """Function of q, x, t: the solution of J dq = e, t . dq = 0, then that of J u = 0, t . u = 1, (2n, 1)."""
        q, x, e, J = self._symbols
        t = ca.SX.sym("t", q.shape[0])
        right = ca.vertcat(ca.horzcat(e, ca.SX.zeros(e.shape[0])), ca.SX([[0.0, 1.0]]))
        found = ca.solve(ca.vertcat(J, t.T), right)
        return dense_function("bordered_step", [q, x, t], [ca.cse(ca.vec(found))])

    @cached_property
    def _step(self) -> BlockedFunction:
        """One step along many curves: a column (q, t, bend, h, q0, t0) and x -> new q, new t, four numbers.

        bend is the curvature vector dt/ds, h the length of the step, and q0, t0 the start of the curve. The numbers are
        the length of the correction, the cosine between old and new t, the distance of the new q from q0 up to full
        turns, and the component of this difference along t0.
        """
        q, x = self._symbols[:2]
        n = q.shape[0]
        state = ca.SX.sym("state", 5 * n + 1)
        at, t, bend, h, q0, t0 = ca.vertsplit(state, [0, n, 2 * n, 3 * n, 3 * n + 1, 4 * n + 1, 5 * n + 1])
        # predict to second order, then correct orthogonally to the tangent
        ahead = at + h * t + h**2 / 2 * bend
        change, onward = ca.horzsplit(ca.reshape(self._bordered(ahead, x, t), n, 2))
        new, onward = ahead + change, onward / ca.norm_2(onward)
        # difference from the start, without full turns
        gap = new - q0
        gap -= 2 * np.pi * ca.DM(self.turning.astype(float)) * ca.floor(gap / (2 * np.pi) + 0.5)
        numbers = ca.vertcat(ca.norm_2(change), ca.dot(t, onward), ca.norm_2(gap), ca.dot(gap, t0))
        return BlockedFunction(dense_function("step", [state, x], [ca.cse(ca.vertcat(new, onward, numbers))]))

    @cached_property
    def _damped_step(self) -> BlockedFunction:
        """Function of q and x for many points: a damped least-squares step to x, then the largest error, (n + 1, 1)."""
        q, x, e, J = self._symbols
        error, gram = ca.norm_inf(e), J @ J.T
        damping = ca.if_else(error > 0.1, 1e-2, ca.if_else(error > 1e-3, 1e-5, 1e-14)) * ca.trace(gram)
        step = J.T @ ca.solve(gram + damping * ca.SX.eye(e.shape[0]), e)
        step *= ca.fmin(1, RULES.largest / (ca.norm_2(step) + 1e-300))
        return BlockedFunction(dense_function("damped_step", [q, x], [ca.cse(ca.vertcat(step, error))]))

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Symbols q (n, 1) and x (n - 1, 1), and expressions of the errors e (n - 1, 1) and their J (n - 1, n).

        The task rows are e = (x - h(q)) / sizes and J = (dh/dq) / sizes. For held joints, e = x - q, and J has rows of
        the identity.
        """
        task, held = self.boxed.task, list(self.held)
        n, m, scale = task.robot.n, task.m, ca.DM(self.boxed.phi_map.sizes[: self.boxed.m])
        relative = Relative(task)
        q, x = ca.SX.sym("q", n), ca.SX.sym("x", n - 1)
        e = relative.difference(x[:m, :], task.function(q)) / scale
        J = relative.rates(q) / ca.repmat(scale, 1, n)
        return q, x, ca.vertcat(e, x[m:, :] - q[held, :]), ca.vertcat(J, ca.SX.eye(n)[held, :])

    @cached_property
    def turning(self) -> NDArray[np.bool_]:
        """Whether each joint is revolute, (n,)."""
        return ~np.array(self.boxed.task.robot.tree.prismatic)


def without_turns(difference: Array, turning: NDArray[np.bool_]) -> Array:
    """Differences of joint positions (..., n), wrapped to half a turn for revolute joints."""
    return np.asarray(wrap_shortest(difference, np.where(turning, 2 * np.pi, 0.0)))


def solutions_of(A: Array, right: Array) -> Array:
    """A^-1 right, (N, n, k), for A (N, n, n) and right (N, n, k); if A is singular, its pseudo-inverse times right."""
    try:
        found: Array = np.asarray(np.linalg.solve(A, right), dtype=float)
    except np.linalg.LinAlgError:
        found = inverses(A)[0] @ right
    return found


@dataclass(frozen=True, slots=True)
class MotionKernelRules:
    """Numbers of the kernels in C."""

    points: int = 30_000  #: largest number of points of a curve; longer curves are followed in Python
    nodes: int = 4000  #: number of steps after which a curve counts as endless
    divided: float = 0.95  #: distance between points on a chord, relative to the required spacing along the curve
    rounding: float = 2e-12  #: [rad] or [m] tolerance of the place where a step crosses a boundary
    piece: int = 64  #: rows that a thread searches at once


MOTION = MotionKernelRules()
ENDLESS, SINGULAR, WALL, FOLD = range(4)  #: what ends a curve, as in templates/chart_motion.c.jinja


@dataclass(frozen=True, eq=False)
class MotionKernel:
    """Follows self-motions of a chart in C, with `runtime/self_motion.c`. Threads may share it."""

    chart: Chart

    def follow(
        self, q: Array, x: Array, direction: int, folds: bool, spacing: float
    ) -> tuple[Array, Array, Array, int, Array] | None:
        """Follow the self-motion from q within the domain.

        Args:
            q: the start inside the domain, (n,).
            x: its task value, (m,).
            direction: 1 if xi rises from q, -1 if it falls.
            folds: whether the curve ends where xi turns back.
            spacing: largest distance between points [rad] or [m].

        Returns:
            Points (N, n), the start first; xi (N,) and the arc length (N,) at each; what ends the curve; and, if that
            is a wall or a fold, a point (n,) just beyond it. None if the curve has more than `MOTION.points` points.
        """
        n, most = len(q), MOTION.points
        # Buffers of the largest size cost nothing: pages that are never written are never allocated.
        room, points = np.empty(MOTION.nodes * (2 * n + 1)), np.empty((most, n))
        xi, length, beyond = np.empty(most), np.empty(most), np.full(n, np.nan)
        stop = ctypes.c_int()
        count = self._c.follow_inside(
            *(pointer(q), pointer(x), direction, int(folds), ctypes.c_double(spacing), pointer(room), MOTION.nodes),
            *(pointer(points), pointer(xi), pointer(length), most, pointer(beyond), ctypes.byref(stop)),
        )
        if not count:
            return None
        return points[:count].copy(), xi[:count].copy(), length[:count].copy(), stop.value, beyond

    @cached_property
    def _c(self) -> Any:
        """The compiled library."""
        values = {"divided": MOTION.divided, "rounding": MOTION.rounding, "rules": asdict(curves.RULES)}
        sources = ("self_motion.c", "curve_math.c")
        return _load("chart", "chart_motion.c", _write_chart(self.chart) | values, sources, None)


@dataclass(frozen=True, eq=False)
class SearchKernel:
    """Searches the self-motion curves of a chart for many task values in C, with `runtime/curve_rows.c`.

    Threads may share it.
    """

    chart: Chart
    folder: Path | None = None  #: folder of the compiled library; None: the default of `keep_library`

    def search(self, targets: Array, starts: Array, first: int, tolerance: float) -> tuple[Array, Array, Any]:
        """As `SelfMotionCurves.search`, for starts (N, S, n). Starts after the `first` ones are for unsolved rows.

        Returns:
            The fields of `Nearest`: points (N, n), their distances (N,), and `between` (N,).
        """
        count = len(targets)
        q, distance, between = np.empty(targets.shape), np.empty(count), np.empty(count, dtype=np.bool_)
        inputs = np.ascontiguousarray(targets), np.ascontiguousarray(starts)
        most, room = starts.shape[1], self._c.curve_room()

        def search_piece(begin: int) -> None:
            rows = slice(begin, begin + MOTION.piece)
            phi, own, *found = (pointer(part[rows]) for part in (*inputs, q, distance, between))
            memory = np.empty(room, dtype=np.uint8)
            sizes = ctypes.c_long(first), ctypes.c_long(most), ctypes.c_double(tolerance)
            self._c.curve_rows(
                ctypes.c_long(min(MOTION.piece, count - begin)), phi, own, *sizes, pointer(memory), *found
            )

        run_in_threads(search_piece, range(0, count, MOTION.piece))
        return q, distance, between

    def trace(self, target: Array, starts: Array) -> list[tuple[Array, Array]]:
        """Trace the curves of a target phi (n,) to which starts (S, n) lead: points (P, n) and unit tangents."""
        n, nodes, used = self.chart.n, np.empty((curves.RULES.nodes, 2 * self.chart.n + 1)), ctypes.c_int()
        ends, closed = (np.zeros(curves.RULES.curves, dtype=np.intc) for _ in range(2))
        first = np.ascontiguousarray(starts)
        count = self._c.find_curves(
            *(pointer(np.ascontiguousarray(target)), pointer(first), len(first), len(first)),
            *(pointer(nodes), len(nodes), pointer(ends), pointer(closed), ctypes.byref(used)),
        )
        parts = np.split(nodes[: ends[count - 1]], ends[: count - 1]) if count else []
        return [(part[:, :n], part[:, n : 2 * n]) for part in parts]

    @cached_property
    def _c(self) -> Any:
        """The compiled library."""
        parts, m = self.chart.parts, self.chart.m
        values = {
            "rules": asdict(curves.RULES) | {"starts": 1 + RULES.near_phi + RULES.near_x + RULES.more},
            "row_rules": asdict(RULES),
            "xi_size": float(parts.phi_sizes[m]),
            "period": float(parts.turns[m]),
            "winding": parts.boxed.winding,
        }
        sources = ("self_motion.c", "curve_math.c", "curve_rows.c")
        library = _load("search", "chart_search.c", _write_chart(self.chart) | values, sources, self.folder)
        library.curve_room.restype, library.curve_rows.restype = ctypes.c_ulong, None
        return library


def has_library(kernel: MotionKernel | SearchKernel) -> bool:
    """Whether a kernel can be used; compiles it if needed.

    False without a C compiler, and for charts that the kernels do not support. They support fitted coordinates with
    r = 1 on domains whose condition, if there is one, has a CasADi expression.
    """
    chart, domain = kernel.chart, kernel.chart.problem.domain
    known = domain.is_box or domain.known_condition is not None
    if chart.r != 1 or not known or not isinstance(chart.coordinates, Coordinates):
        return False
    try:
        kernel._c  # noqa: B018
    except (CompileError, InvalidValueError):
        return False
    return True


def _load(kind: str, template: str, values: dict[str, Any], sources: tuple[str, ...], folder: Path | None) -> Any:
    """Compile and load the library of a template, filled with `values`, and of the runtime sources that it includes."""
    texts = {template: render(template, values, __package__), **{name: get_source(name) for name in sources}}
    return load_library(keep_library(kind, texts, _FLAGS, folder))


def _write_chart(chart: Chart) -> dict[str, Any]:
    """Values of a chart for the C templates: generated kernels, domain, and joint types.

    The kernels are errors and rates of the task, xi, its gradient, and the condition of the domain, if there is one.
    """
    domain, (low, high), own = chart.domain, chart.domain.bounds, chart.coordinates.functions
    q, x = ca.MX.sym("q", chart.n), ca.MX.sym("x", chart.m)
    functions = [
        dense_function("task", [q, x], chart.parts.tracer.equations.call([q, x])),
        dense_function("xi", [q], [chart.parts.runnable(own["xi"])(q)]),
        dense_function("gradient", [q], [chart.parts.runnable(own["jacobian"])(q)]),
    ]
    if domain.condition is not None:
        functions.append(dense_function("pivots", [q], [domain.condition.pivots(q)]))
    kernels = generate_kernels(functions, "kernel")
    revolute = ~np.array(chart.problem.robot.tree.prismatic)
    return {
        "kernels": kernels.code,
        "arrays": kernels.declare_arrays,
        "call": kernels.write_call,
        "n": chart.n,
        "low": low,
        "high": high,
        "centre": domain.centre,
        "half_width": domain.half_width,
        "revolute": revolute,
        "endless": np.isinf(low) & revolute,
        "bounded": np.isfinite(low),
        "pivots": kernels.numbers.get("pivots", 0),
    }
