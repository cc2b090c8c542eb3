"""Postures with x and xi, and the tracker, in C that is compiled for an arm with its charts."""

import ctypes
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.arms.kernel import build_curvature, write_curves
from orthocas.arms.maps import ArmMaps
from orthocas.charts.chart import Chart
from orthocas.codegen.rendering import render
from orthocas.errors import InvalidValueError
from orthocas.native.curves import RULES as CURVES
from orthocas.native.kernels import generate_kernels
from orthocas.native.libraries import keep_library, load_library, pointer
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import dense_function, run_in_threads
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices
from orthocas.tools.expressions import wrap_shortest

_FLAGS = ("-O3",)
_PROBES = 32  # number of postures at which full turns are tried


@dataclass(frozen=True, slots=True)
class ChartKernelRules:
    """Settings of the search for postures with x and xi, and of the tracker.

    Errors of x are in radians, or as long as a radian moves the tip; joint positions in [rad] or [m].
    """

    met: float = 1e-10  #: error of x below which x is met
    xi_met: float = 1e-10  #: error of xi below which xi is met
    squared: float = 3e-6  #: errors of x and xi that one more step of Newton's method reduces to their squares
    xi_found: float = 1e-9  #: error of xi of a posture that has it
    xi_weight: float = 1e-3  #: weight of errors of xi, relative to errors of x
    posture_weight: float = 1e-4  #: weight of the return to the last posture with a chart, outside charts
    push_weight: float = 1.0  #: weight of pairs that come nearer than `avoid`, relative to x
    pushes: int = 8  #: largest number of these pairs; the nearest are taken
    turns: int = 4  #: largest number of repetitions of a call, until no more pairs come nearer
    kept: float = 1e-5  #: distance by which pairs may be nearer than `avoid` [m]
    aligned: float = 0.9  #: cosine between the rows of two pairs, or of one at two postures, above which one counts
    way_weight: float = 1e-2  #: weight of the way to a posture with x and xi that was found
    step_damping: float = 1e-8  #: damping of squared joint steps
    error_damping: float = 0.3  #: damping of squared joint steps, times the squared error of x
    damping: float = 1e-3  #: least damping of squared joint steps after a step that does not lower the error
    grows: float = 10.0  #: factor of damping after each further such step; damping shrinks as much after a good step
    rounds: int = 12  #: largest number of rounds of a descent
    far_rounds: int = 4  #: largest number of these rounds with an error above `near`
    gain: float = 1e-9  #: relative decrease of the squared error below which a minimum is reached
    near: float = 3e-4  #: error of x below which the last posture with a chart is ignored
    decrease: float = 1e-4  #: least decrease of the cost, relative to the predicted decrease
    enough: float = 1e-2  #: relative decrease of the cost below which a far arm leaves the rest to the next call
    falls: float = 0.9  #: of an error at the end of a window, relative to that at its begin, where the arm is not stuck
    guesses: int = 8  #: of the joints at bounds in a quadratic program, many at a time
    changes: int = 40  #: of these joints, one at a time, at most
    rounding: float = 1e-14  #: slope of the cost at a bound below which it counts as zero
    sweeps: int = 8  #: largest number of sweeps of Jacobi's method for eigenvalues
    flattest: float = 2.0  #: least curvature that counts, in errors: less would amplify the tremor of a hand
    calms: float = 0.8  #: factor of it for each call since the target moved
    saddle: float = 0.02  #: slope of the error, relative to its curvature, below which a posture is next to a saddle
    onward: float = 0.3  #: step across a saddle of the last call, in the largest steps of joints, that goes on
    unstable: float = 0.2  #: curvature along which a saddle falls, in errors, that any side is better than none
    even: float = 1e-7  #: slope of a saddle, relative to its curvature, below which both sides are alike
    astride: float = 0.05  #: step to a side of a saddle
    largest: float = 0.7  #: norm of a step of Newton's method
    in_chart: int = 10  #: rounds of Newton's method in one call in the chart
    seek_rounds: int = 24  #: rounds of Newton's method from a stored posture
    solve_rounds: int = 8  #: rounds of Newton's method from one of many near postures
    searched: int = 24  #: number of stored postures that a tracker tries, one a call
    longest: int = 16  #: largest number of windows that a tracker waits after a search that found nothing
    near_starts: int = 6  #: stored postures of a chart that a row tries before all curves of x are searched
    spacing: float = 0.05  #: distance between points of curves at which xi is evaluated
    room: float = 0.05  #: beyond limits, within which a point between nodes may be inside
    same: float = 1e-6  #: distance below which postures are the same [rad] or [m]
    every: int = 1000  #: largest number of postures with x and xi
    lifts: int = 4096  #: largest number of combinations of full turns of joints
    singular_bend: float = 2.0  #: second derivative of the least singular value along a curve [1/rad^2]
    inverse_rounds: int = 3  #: rounds of inverse iteration for the least singular value
    bisections: int = 30  #: largest number of bisections between two points of a curve
    halved: int = 3  #: number of bisections before Newton's method is tried
    curve_starts: int = CURVES.starts  #: number of starts of the search for all curves
    patience: int = 32  #: number of starts in turn without a new curve after which the search ends
    postures: int = 2000  #: number of postures stored in each chart's domain, and in the whole joint range
    seed: int = 0  #: random seed of these postures
    speed: float = 2.0  #: velocity limit of joints whose file gives none [rad/s] or [m/s]
    window: float = 0.25  #: time without progress after which a tracker looks for another way [s]
    piece: int = 32  #: rows that a thread takes at once


RULES = ChartKernelRules()


class PosturesInC(ctypes.Structure):
    """`NAME_postures` of templates/arm_track.h.jinja."""

    _fields_ = (
        ("count", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("q", "places", "xi", "begins")),
    )


class RangeInC(ctypes.Structure):
    """`range_postures` of templates/arm_rows.c.jinja."""

    _fields_ = (
        ("count", ctypes.c_int),
        ("branches", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("q", "places", "weights", "begins")),
    )


def tracker_type(n: int, r: int, target: int) -> np.dtype[Any]:
    """`NAME_tracker` of templates/arm_track.h.jinja."""
    rows = ("q", "most", "change", "weight", "near", "moved", "last", "goal")
    fields: list[Any] = [(name, "f8", (n,)) for name in rows]
    fields += [("wish", "f8", (r,)), ("target", "f8", (target,)), ("far", "f8"), ("best", "f8")]
    fields += [("push", "f8", (RULES.pushes, n)), ("room", "f8", (RULES.pushes,)), ("pushes", "i4")]
    numbers = ("detours", "patience", "chart", "inside", "status", "mode", "ticks", "pause", "rested", "next", "listed")
    fields += [(name, "i4") for name in numbers]
    return np.dtype([*fields, ("list", "i4", (RULES.searched,))], align=True)


@dataclass(frozen=True, eq=False)
class ChartPostures:
    """Postures in the domains of charts, one chart after the other, then in the whole joint range."""

    q: Array  #: (S, n)
    places: NDArray[np.float32]  #: (S, k), as in `StoredPostures`, but in rows
    xi: NDArray[np.float32]  #: coordinates in the chart of each posture, (S, r); 0 for postures of the joint range
    begins: NDArray[np.intc]  #: index of the first posture of each chart, then of the joint range, (charts + 1,)

    @classmethod
    def build(cls, maps: ArmMaps, charts: Sequence[Chart], count: int) -> "ChartPostures":
        """Sample `count` postures for each chart, and for the whole joint range."""
        robot, r = maps.robot, maps.robot.n - maps.task.m
        whole = find_joint_range(robot, 0)
        # Postures of charts are starts with x and xi; postures of the whole range are starts with x alone.
        own = [np.asarray(chart.problem.domain.sample(count, RULES.seed)) for chart in charts]
        rng = np.random.default_rng(RULES.seed)
        free = rng.uniform(whole.centre - whole.half_width, whole.centre + whole.half_width, (count, robot.n))
        xi = [np.asarray(chart.xi(q)).reshape(-1, r) for chart, q in zip(charts, own, strict=True)]
        q = np.vstack([*own, free])
        begins = np.cumsum([0, *(len(part) for part in own)])
        return cls(
            np.ascontiguousarray(q),
            np.ascontiguousarray(maps.targets_of(q) / maps.place_sizes, dtype=np.float32),
            np.ascontiguousarray(np.vstack([*xi, np.zeros((len(free), r))]), dtype=np.float32),
            begins.astype(np.intc),
        )

    @cached_property
    def in_c(self) -> PosturesInC:
        """The record for C, valid as long as this object lives."""
        return PosturesInC(len(self.q), *(pointer(part) for part in (self.q, self.places, self.xi, self.begins)))


@dataclass(frozen=True, eq=False)
class ChartKernel:
    """Searches and trackers of an arm and its charts, which may be none, in compiled C. Threads may share it.

    `solve_rows` asks charts in turn, that of the start first: Newton's method on x and xi from the start, or from the
    stored postures that are nearest in x and xi. Where none arrives, all curves of x are traced and xi is looked at
    along them.

    Raises:
        CompileError, InvalidValueError: at the first call, if there is no C compiler, or no folder to keep the library.
        DomainError: at the first call, if a domain has a condition, but no expression of it.
    """

    maps: ArmMaps
    charts: tuple[Chart, ...]

    def solve_rows(
        self, targets: Array, xi: Array, starts: Array | None, allowed: Sequence[int]
    ) -> tuple[Array, Indices, Indices]:
        """Postures (N, n) of targets (N, k) and xi (N,), `InverseStatus` numbers, and chart indices; -1 for none."""
        count, n = len(targets), self.maps.robot.n
        q = np.empty((count, n))
        status, owner = (np.empty(count, dtype=np.intc) for _ in range(2))
        # Mark the charts that may answer.
        flags = np.isin(np.arange(len(self.charts)), allowed).astype(np.int8)
        solve, stored, whole = self.library.solve_rows, self.postures.in_c, self._range
        inputs = [np.ascontiguousarray(part) for part in (targets, xi)]
        first = None if starts is None else np.ascontiguousarray(starts)

        def solve_piece(begin: int) -> None:
            rows, room = slice(begin, begin + RULES.piece), self._build_room()
            start = None if first is None else pointer(first[rows])
            solve(
                *(len(q[rows]), *(pointer(part[rows]) for part in inputs), start, pointer(flags)),
                *(ctypes.byref(stored), ctypes.byref(whole), RULES.patience, pointer(room), CURVES.nodes),
                *(pointer(part[rows]) for part in (q, status, owner)),
            )

        # Solve a few rows without threads.
        if count <= RULES.piece:
            solve_piece(0)
        else:
            run_in_threads(solve_piece, range(0, count, RULES.piece))
        return q, status.astype(np.int64), owner.astype(np.int64)

    def solve_all(self, target: Array, xi: float, start: Array | None, allowed: Sequence[int]) -> tuple[Array, Indices]:
        """All postures (N, n) of a target (k,) and xi on its curves, and their charts; a start leads to curves, too.

        Raises:
            InvalidValueError: if there are more than 1,000.
        """
        flags, room = np.isin(np.arange(len(self.charts)), allowed).astype(np.int8), self._build_room()
        q, owner = np.empty((RULES.every, self.maps.robot.n)), np.empty(RULES.every, dtype=np.intc)
        count = self.library.solve_all(
            *(pointer(target), ctypes.c_double(xi), None if start is None else pointer(np.ascontiguousarray(start))),
            *(pointer(flags), ctypes.byref(self._range), CURVES.patience, pointer(room), CURVES.nodes),
            *(pointer(q), pointer(owner), RULES.every),
        )
        if count > RULES.every:
            raise InvalidValueError("xi", f"{xi:g}, which more than {RULES.every} postures have", "fewer postures")
        return q[:count], owner[:count].astype(np.int64)

    def _build_room(self) -> Array:
        """Room for the points of all curves of a target, and for distances (float) of the stored postures."""
        return np.empty(CURVES.nodes * (2 * self.maps.robot.n + 1) + (len(self.maps.stored.q) + 1) // 2)

    def build_targets(self, vectors: Array) -> Array:
        """As `TargetReader.build`, for contiguous vectors (N, m)."""
        targets = np.empty((len(vectors), self.target_size))
        self.library.build_targets(len(vectors), pointer(vectors), pointer(targets))
        return targets

    @cached_property
    def postures(self) -> ChartPostures:
        """Postures from which searches start."""
        return ChartPostures.build(self.maps, self.charts, RULES.postures)

    @cached_property
    def library(self) -> Any:
        """The compiled library; trackers call `arm_track`, `track_value`, and `arm_track_reset` and `_hold`."""
        sources = write_tracker(self.maps, self.charts, "arm", "arm_rows.c")
        if self.charts and self.maps.robot.n - self.maps.task.m == 1:
            sources |= write_curves(self.maps.equations, *self._limits)
        library = load_library(keep_library("arm", sources, _FLAGS))
        library.arm_track_reset.restype = library.arm_track_hold.restype = library.build_targets.restype = None
        if self.charts and self.maps.robot.n - self.maps.task.m == 1:
            library.solve_rows.restype = None
        return library

    @property
    def _limits(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        return self.maps.robot.lower, self.maps.robot.upper, self.maps.turning

    @cached_property
    def _range(self) -> RangeInC:
        stored = self.maps.stored
        parts = (pointer(part) for part in (stored.q, stored.places, stored.weights, stored.begins))
        return RangeInC(len(stored.q), len(stored.begins) - 1, *parts)

    @cached_property
    def target_size(self) -> int:
        """Length of a target vector."""
        return int(self.maps.equations.size1_in(1))


def write_tracker(
    maps: ArmMaps, charts: Sequence[Chart], name: str, template: str, header: str = "", postures: int = 0
) -> dict[str, str]:
    """Sources of an arm's tracker, by the names of their files: NAME_track.h and .c.

    Args:
        maps: maps of the arm.
        charts: charts of the arm, possibly none.
        name: prefix of names in C.
        template: "arm_track.c", or "arm_rows.c" for the searches of many rows as well.
        header: first lines of both files.
        postures: number of postures per chart that the code stores; 0 for none.
    """
    robot, task, n = maps.robot, maps.task, maps.robot.n
    equations, rows = maps.equations, template != "arm_track.c"
    functions = [equations, build_curvature(equations), maps.target_function]
    parts = []
    # Of each chart: xi and its gradient, and what its domain asks for besides the box.
    for k, chart in enumerate(charts):
        q, own, domain = ca.MX.sym("q", n), chart.coordinates.functions, chart.problem.domain
        xi = [chart.parts.runnable(own[word])(q) for word in ("xi", "jacobian")]
        functions.append(dense_function(f"xi_{k}", [q], xi))
        pivots = 0
        if domain.condition is not None:
            functions.append(dense_function(f"pivots_{k}", [q], [domain.condition.pivots(q)]))
            pivots = functions[-1].numel_out(0)
        low, high = domain.bounds
        periods, sizes = chart.parts.turns[chart.m :], chart.parts.phi_sizes[chart.m :]
        part = {"low": low, "high": high, "slack": domain.slack, "pivots": pivots, "period": periods, "size": sizes}
        if rows and chart.r == 1 and (singular := domain.singular_bound) is not None:
            functions.append(dense_function(f"gram_{k}", [q], [singular.gram(q)]))
            part |= {"bound": singular.least_singular_value, "alike": _find_alike(chart)}
        parts.append({"bound": 0.0, "alike": np.zeros(n, dtype=bool), **part})
    kernels = generate_kernels(functions, f"{name}_kernel")
    size = equations.size1_in(1)
    # Describe a target for the header.
    words = f"its vector ({size})"
    if maps.turned:
        words = "the rotation (3, 3) of the frame by columns"
        words = f"the position (3), then {words}" if size > 9 else words
    values = {
        "header": header,
        "name": name,
        "robot": robot.heading,
        "target_words": words,
        "kernels": kernels.code,
        "arrays": kernels.declare_arrays,
        "call": kernels.write_call,
        "n": n,
        "m": task.m,
        "target": size,
        "places": len(maps.place_sizes),
        "place_scale": 1 / maps.place_sizes,
        "charts": parts,
        "rules": {name: value for name, value in asdict(RULES).items() if name != "lifts"},
        "curve_rules": asdict(CURVES),
        "low": robot.lower,
        "high": robot.upper,
        "slides": ~maps.turning,
        "endless": np.isinf(robot.lower) & np.isinf(robot.upper),
        "turned": maps.turned,
        "include": f'#include "{name}_track.h"',
    }
    # The exported tracker brings its own postures; the library in Python shares them between trackers.
    speed = np.where(np.isfinite(robot.velocity_limits), robot.velocity_limits, RULES.speed)
    values |= {"stored": ChartPostures.build(maps, charts, postures) if postures else None, "speed": speed}
    values |= {"window": RULES.window}
    values["rows"] = rows
    if rows:
        values["branches"] = len(maps.stored.begins) if charts and n - task.m == 1 else 0
    if values.get("branches"):
        # Where full turns count: within limits, or without these, in boxes of charts, or where they change xi.
        lows, highs = (np.array([chart.problem.domain.bounds[k] for chart in charts]) for k in (0, 1))
        winds = np.any([chart.parts.boxed.winding for chart in charts], axis=0)
        home, endless = charts[0].problem.domain.home, np.isinf(robot.lower)
        around = [home + np.where(winds, sign * 3 * np.pi, sign * np.inf) for sign in (-1, 1)]
        lift_low = np.where(endless, np.maximum(lows.min(axis=0), around[0]), robot.lower)
        lift_high = np.where(endless, np.minimum(highs.max(axis=0), around[1]), robot.upper)
        # Reserve memory for all combinations of full turns, so that none is dropped.
        ranges = np.where(maps.turning, lift_high - lift_low + 2 * RULES.room + CURVES.step, 0.0)
        lifts = np.prod(np.floor(ranges[np.isfinite(ranges)] / (2 * np.pi)) + 1)
        if lifts > RULES.lifts:
            raise InvalidValueError("limits", f"{lifts:.0f} combinations of full turns", f"at most {RULES.lifts}")
        values |= {"lift_low": lift_low, "lift_high": lift_high, "winds": winds, "lifts": int(lifts)}
    source = f"{name}_track.c" if template == "arm_track.c" else f"{name}.c"
    return {f"{name}_track.h": render("arm_track.h", values), source: render(template, values)}


def _find_alike(chart: Chart) -> NDArray[np.bool_]:
    """Revolute joints whose full turns change neither xi nor the condition of a domain on singular values, (n,)."""
    robot, periods = chart.robot, chart.parts.turns[chart.m :]
    q = sample_uniform(chart.domain, _PROBES, 0)
    turned = np.stack([chart.xi(q + 2 * np.pi * row) - chart.xi(q) for row in np.eye(robot.n)])
    same = np.abs(wrap_shortest(turned, periods)).max(axis=(1, 2)) < RULES.xi_met
    return np.asarray(same & ~np.array(robot.tree.prismatic))
