"""A tracker of task values and coordinates that is never lost: exact in charts, and x first everywhere else."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.arms.chart_kernel import RULES, ChartKernel, tracker_type
from orthocas.arms.maps import ArmMaps
from orthocas.arms.numpy_tracker import NumpyTracker, TrackStatus
from orthocas.charts.chart import Chart
from orthocas.charts.clearance import Clearance
from orthocas.codegen.library import pointer
from orthocas.errors import CompileError, InvalidValueError, degrees_hint
from orthocas.tools.checks import Array, as_float_array, as_number, as_point, require_kind, require_shape
from orthocas.tools.display import Shown, number_list


class ArmTracker(Shown):
    """Follows a stream of x and xi from posture to posture; `Arm.tracker` makes it, and it belongs to one thread.

    A call moves no joint by more than its velocity limit times the period, and none beyond its position limit; with
    limits of acceleration, the joints can always stop before their limits. In the domain of the chart that it began in,
    x and xi are met exactly, as by `Chart.tracker`. Where xi cannot be had, x has priority: the joint step d solves

        min |J d - e|^2 + w^2 |g d - e_xi|^2 + damping |d|^2,  with bounds of position and velocity,

    with the errors e of x and e_xi of xi, their rates J and g, and w = 1e-3. A posture given instead of xi takes its
    place: joints go as near to it as x lets them. Where there is no chart, the last posture that had one does. Then
    Gauss-Newton steps within the same bounds bring the error of x to zero, or to a minimum, at which the arm rests. As
    damping grows where a step does not lower the error, the error of a target at rest never rises.

    xi is that of the chart in whose domain the tracker began, or came to be first. When the arm comes back to the
    domain, xi goes from the value that it has there to what is asked as fast as the joints may. Where it does not come
    nearer for a quarter of a second, stored postures are tried, one a call, for one that has x and xi; the arm goes
    there, with x kept as long as that leads nearer. From a target at rest it then goes straight, and leaves x for a
    while; so it does where it is stuck without x. `detours=False` forbids both.

    With a collision model it brakes as `orthocas.charts.trackers.Tracker` does, on detours too, whatever the limits of
    acceleration; with `avoid` it gives way, in NumPy.

    With a C compiler, a call is one call of C that takes a bounded time. Without one, NumPy does the same, slower,
    without limits of acceleration, with one joint more than the task needs, and does not look for xi elsewhere.

    Source:
        Levenberg and Marquardt's method with an active set on a box; ours.
    """

    def __init__(
        self,
        maps: ArmMaps,
        charts: Sequence[Chart],
        kernel: ChartKernel | None,
        q: ArrayLike,
        period: float,
        velocity_limits: ArrayLike | None = None,
        acceleration_limits: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        detours: bool = True,
        clearance: Clearance | None = None,
    ) -> None:
        robot, span = maps.robot, as_number("period", period)
        if not 1e-5 <= span <= 10:
            raise InvalidValueError("period", period, "a time from 1e-5 to 10 s")
        require_kind("detours", detours, bool)
        speed = _read_limits("velocity_limits", velocity_limits, robot.velocity_limits)
        speed = np.where(np.isfinite(speed), speed, RULES.speed)
        self._rules: dict[str, Any] = {
            "period": span,
            "velocity_limits": speed,
            "acceleration_limits": _read_limits("acceleration_limits", acceleration_limits, np.full(robot.n, np.inf)),
            "weights": _read_limits("weights", weights, np.ones(robot.n)),  # only their ratios count
            "detours": detours,
        }
        self._maps, self._charts, self._kernel, self._clearance = maps, tuple(charts), kernel, clearance
        self._r = robot.n - maps.task.m
        point = self._read_posture(q)
        self._engine: NumpyTracker | _Compiled
        gives_way = clearance is not None and clearance.avoid is not None
        if kernel is not None and not gives_way:
            self._engine = _Compiled(kernel, self._rules, clearance)
            self._engine.reset(point)
        elif self._r > 1 or acceleration_limits is not None:
            what = "limits of acceleration, and more than one joint too many,"
            raise CompileError(f"{what} need a C compiler, and a tracker without `avoid`")
        else:
            self._engine = NumpyTracker(maps, self._charts, point, span, speed, detours, clearance)

    def __getstate__(self) -> dict[str, Any]:
        """Without scratch memory."""
        parts = {"maps": self._maps, "charts": self._charts, "kernel": self._kernel, "q": self.q}
        return {**parts, "rules": {**self._rules, "clearance": self._clearance}, "memory": self._engine.memory}

    def __setstate__(self, state: dict[str, Any]) -> None:
        rules = dict(state["rules"])
        if not np.isfinite(rules["acceleration_limits"]).any():
            rules["acceleration_limits"] = None
        self.__init__(state["maps"], state["charts"], state["kernel"], state["q"], **rules)  # type: ignore[misc]
        self._engine.memory = state["memory"]

    @property
    def q(self) -> Array:
        """The last posture, (n,)."""
        return self._engine.q

    @property
    def status(self) -> TrackStatus:
        """How the last call ended."""
        return self._engine.status

    @property
    def xi(self) -> Any:
        """xi of the last posture, a number, or (r,) of several; NaN outside the domain of the tracker's chart."""
        return self._engine.xi

    @property
    def branch(self) -> str:
        """Name of the branch whose chart gives xi; "" before there is one."""
        if self._engine.chart < 0:
            return ""
        chart = self._charts[self._engine.chart]
        return str(chart.notes.get("branch", chart.problem.name))

    def facts(self) -> dict[str, str]:
        """Where it is."""
        return {
            "tracker": f"status {self.status.name}",
            "q": number_list(self.q),
            "branch": self.branch or "none",
        }

    def reset(self, q: ArrayLike) -> None:
        """Continue from another posture (n,) within the joint limits, at rest.

        Raises:
            InvalidValueError: if it is not within them, or a pair touches there.
        """
        self._engine.reset(self._read_posture(q))

    def step(self, x: Any, xi: ArrayLike | None = None, posture: ArrayLike | None = None) -> Array:
        """The next posture (n,); see `status`.

        Args:
            x: one task value.
            xi: wished value in the tracker's chart, a number, or (r,); None holds the last one, at first that of the
                begin.
            posture: to stay near to instead of holding xi, (n,): of the postures with x, the one at which
                |q - posture|, with weights, is least. It counts until xi or another posture is given.

        Raises:
            InvalidValueError: if x is no task value of this task, or xi and a posture are given.
        """
        wish = None if xi is None else self._read_wish(xi)
        if posture is not None:
            if xi is not None:
                raise InvalidValueError("posture", "given with xi", "one of the two")
            near = as_float_array("posture", posture)
            require_shape("posture", near.shape, (self._maps.robot.n,))
            if np.isfinite(near).all():
                self._engine.stay_near(near)
            else:
                wish = np.nan  # BAD_INPUT
        if type(x) is np.ndarray and x.dtype == np.float64 and x.shape == (self._maps.task.m,):
            return self._engine.step(x, None, wish)
        targets, single = self._maps.targets.read(x)
        if not single:
            raise InvalidValueError("x", f"{len(targets)} values", "one task value")
        return self._engine.step(None, targets[0], wish)

    def step_to(self, target: Array, xi: ArrayLike | None) -> Array:
        """As `step`, for x as `orthocas.arms.kernel.build_equations` takes it."""
        return self._engine.step(None, target, None if xi is None else self._read_wish(xi))

    def _read_wish(self, xi: ArrayLike) -> Any:
        if not self._charts:
            raise InvalidValueError("xi", xi, "None, for an arm without charts")
        if self._r == 1:
            return as_number("xi", xi)
        values = as_float_array("xi", xi)
        require_shape("xi", values.shape, (self._r,))
        return values

    def _read_posture(self, q: ArrayLike) -> Array:
        robot = self._maps.robot
        point = as_point("q", q, robot.n)
        if not ((point >= robot.lower) & (point <= robot.upper)).all():
            hint = degrees_hint(*point[np.isfinite(robot.lower)])
            raise InvalidValueError("q", point.tolist(), f"a posture within the joint limits{hint}")
        return point


class _Compiled:
    """The tracker in C: templates/arm_track.c.jinja, and its state."""

    def __init__(self, kernel: ChartKernel, rules: dict[str, Any], clearance: Clearance | None) -> None:
        robot, m = kernel.maps.robot, kernel.maps.task.m
        period, self._r = rules["period"], robot.n - m
        self._kernel, self._clearance = kernel, clearance
        self._state = np.zeros(1, tracker_type(robot.n, self._r, kernel.target_size))
        self._state["most"], self._state["weight"] = (
            rules["velocity_limits"] * period,
            rules["weights"] / rules["weights"].max(),
        )
        self._state["change"] = rules["acceleration_limits"] * period**2
        self._state["detours"], self._state["patience"] = rules["detours"], max(2, int(RULES.window / period))
        self._x, self._target, self._wish = np.empty(m), np.empty(kernel.target_size), np.empty(self._r)
        self._q: Array = self._state["q"][0]
        self._status = self._state["status"]
        places = (pointer(part) for part in (self._state, self._x, self._target, self._wish))
        self._at, self._x_at, self._target_at, self._wish_at = places
        self._postures = kernel.postures
        self._postures_at = ctypes.byref(self._postures.in_c)
        self._track, self._track_value = kernel.track, kernel.track_value

    def step(self, vector: Array | None, target: Array | None, xi: Any) -> Array:
        """The next posture for x as the task's vector or as a target."""
        before = None if self._clearance is None else self.q
        wish = None
        if xi is not None:
            self._wish[:] = xi
            wish = self._wish_at
        if vector is not None:
            self._x[:] = vector
            self._track_value(self._at, self._postures_at, self._x_at, wish)
        else:
            self._target[:] = target
            self._track(self._at, self._postures_at, self._target_at, wish)
        if self._clearance is not None and before is not None:
            q, fraction = self._clearance.limit(before, self.q)
            if fraction < 1:
                self._kernel.hold(self._at, pointer(np.ascontiguousarray(q)), int(TrackStatus.BRAKED))
        return np.array(self._q)

    def stay_near(self, posture: Array) -> None:
        """Instead of holding xi."""
        self._state["near"] = posture

    def reset(self, q: Array) -> None:
        """Continue from another posture (n,)."""
        point = np.array(q, dtype=float)
        if self._clearance is not None:
            self._clearance.start(point)
        self._kernel.reset(self._at, pointer(point))

    @property
    def q(self) -> Array:
        return np.array(self._q)

    @property
    def status(self) -> TrackStatus:
        return TrackStatus(int(self._status[0]))

    @property
    def chart(self) -> int:
        return int(self._state["chart"][0])

    @property
    def xi(self) -> Any:
        if not self._state["inside"][0]:
            return float("nan") if self._r == 1 else np.full(self._r, np.nan)
        value = np.asarray(self._kernel.charts[self.chart].xi(self.q))
        return float(value[0]) if self._r == 1 else value

    @property
    def memory(self) -> bytes:
        return self._state.tobytes()

    @memory.setter
    def memory(self, memory: bytes) -> None:
        self._state[:] = np.frombuffer(memory, self._state.dtype)
        if self._clearance is not None:
            self._clearance.start(self.q)


def _read_limits(name: str, limits: ArrayLike | None, default: Array) -> Array:
    """Positive numbers (n,), or one for all joints."""
    values = default if limits is None else as_float_array(name, limits)
    if values.ndim:
        require_shape(name, values.shape, default.shape)
    if not (values > 0).all():
        raise InvalidValueError(name, values.tolist(), "positive numbers")
    return np.array(np.broadcast_to(values, default.shape))
