"""A tracker of task values and coordinates that is never lost: exact in charts; elsewhere x has priority."""

from __future__ import annotations

import ctypes
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.arms.chart_kernel import RULES, ChartKernel, tracker_type
from orthocas.charts.walls import Clearance
from orthocas.errors import InvalidValueError, degrees_hint
from orthocas.native.libraries import pointer
from orthocas.tools.checks import Array, as_float_array, as_number, as_point, require_kind, require_shape
from orthocas.tools.display import Shown, number_list


class TrackStatus(IntEnum):
    """How the last call of an arm's tracker ended."""

    OK = 0  #: x is met, and xi if one was given
    YIELDING = 1  #: x is met, xi is not: a joint limit, a border of the chart or the joint speed prevents it
    BEHIND = 2  #: x is not met: the arm moves towards it as fast as its joints may, or goes another way to it
    NEAREST = 3  #: x is out of reach from here: a local minimum of its error within the limits, at rest
    BAD_INPUT = 4  #: a number of x or xi is not finite, or x no orientation (beyond half a turn); the arm stays
    BRAKED = 5  #: the arm took part of the step, or none: the whole step would come nearer to a contact than `margin`


class ArmTracker(Shown):
    """Follows a stream of x and xi from posture to posture; `Arm.tracker` makes it, and it belongs to one thread.

    A call moves no joint by more than its velocity limit times the period, and none beyond its position limit; with
    limits of acceleration, the joints can always stop before their limits; after a jump, x swings about its target by
    some per cent of it before it is met. In the domain of the chart that it began in,
    x and xi are met exactly, as by `Chart.tracker`. Where xi cannot be had, x has priority: the joint step d solves

        min |J d - e|^2 + w^2 |g d - e_xi|^2 + damping |d|^2,  with bounds of position and velocity,

    with the errors e of x and e_xi of xi, their rates J and g, and w = 1e-3. A posture given instead of xi takes its
    place: joints go as near to it as x lets them. Where there is no chart, the last posture that had one does. Then
    Gauss-Newton steps within the same bounds bring the error of x to zero, or to a minimum, at which the arm rests. As
    damping grows where a step does not lower the error, the error of a target at rest never rises.

    Next to a saddle of the error, where x alone does not say which way to take, a moving arm goes on as it moves, as
    through a fold beside a singular posture; one at rest goes back to the side of its last posture with a chart, as an
    elbow from the border of reach; and one that stands in a plane of symmetry leaves it.

    xi is that of the chart in whose domain the tracker began, or came to be first. When the arm comes back to the
    domain, xi goes from the value that it has there to what is asked as fast as the joints may. Where it does not come
    nearer for a quarter of a second, stored postures are tried, one a call, for one that has x and xi; the arm goes
    there, with x kept as long as that leads nearer. From a target at rest it then goes straight, and leaves x for a
    while; so it does where it is stuck without x. `detours=False` forbids both.

    With a collision model it brakes as `orthocas.charts.trackers.Tracker` does, on detours too, whatever the limits of
    acceleration. With `avoid`, pairs that a step would bring nearer join the program above with the weight of x, as
    rows that keep them at that distance, and the step is made again: xi yields.

    A call is one call of compiled C, and of a few with `avoid`; each takes a bounded time.

    Source:
        Levenberg and Marquardt's method with an active set on a box; ours.
    """

    def __init__(
        self,
        kernel: ChartKernel,
        q: ArrayLike,
        period: float,
        velocity_limits: ArrayLike | None = None,
        acceleration_limits: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        detours: bool = True,
        clearance: Clearance | None = None,
    ) -> None:
        robot, m, span = kernel.maps.robot, kernel.maps.task.m, as_number("period", period)
        # C takes the limits as steps of one call.
        if not 1e-5 <= span <= 10:
            raise InvalidValueError("period", period, "a time from 1e-5 to 10 s")
        require_kind("detours", detours, bool)
        speed = _read_limits("velocity_limits", velocity_limits, robot.velocity_limits)
        speed = np.where(np.isfinite(speed), speed, RULES.speed)
        change = _read_limits("acceleration_limits", acceleration_limits, np.full(robot.n, np.inf))
        weight = _read_limits("weights", weights, np.ones(robot.n))
        self._kernel, self._clearance, self._r = kernel, clearance, robot.n - m
        # The state between calls is one record of C: `NAME_tracker` of templates/arm_track.h.jinja.
        self._state = np.zeros(1, tracker_type(robot.n, self._r, kernel.target_size))
        self._state["most"], self._state["change"] = speed * span, change * span**2
        self._state["weight"] = weight / weight.max()
        self._state["detours"], self._state["patience"] = detours, max(2, int(RULES.window / span))
        self._connect()
        self.reset(q)

    def _connect(self) -> None:
        """Pointers for C to the state and to the arguments of a call."""
        self._x, self._target = np.empty(self._kernel.maps.task.m), np.empty(self._kernel.target_size)
        self._wish: Array = np.empty(self._r)
        places = (pointer(part) for part in (self._state, self._x, self._target, self._wish))
        self._at, self._x_at, self._target_at, self._wish_at = places
        self._postures_at = ctypes.byref(self._kernel.postures.in_c)
        self._q: Array = self._state["q"][0]

    def __getstate__(self) -> dict[str, Any]:
        """State without scratch memory."""
        return {"kernel": self._kernel, "memory": self._state.tobytes(), "clearance": self._clearance, "r": self._r}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._kernel, self._clearance, self._r = state["kernel"], state["clearance"], state["r"]
        kind = tracker_type(self._kernel.maps.robot.n, self._r, self._kernel.target_size)
        self._state = np.frombuffer(state["memory"], kind).copy()
        self._connect()
        if self._clearance is not None:
            self._clearance.start(self.q)

    @property
    def q(self) -> Array:
        """The last posture, (n,)."""
        return np.array(self._q)

    @property
    def status(self) -> TrackStatus:
        """How the last call ended."""
        return TrackStatus(int(self._state["status"][0]))

    @property
    def xi(self) -> Any:
        """xi of the last posture, a number, or (r,) of several; NaN outside the domain of the tracker's chart."""
        # Outside the domain of its chart, the arm has no xi.
        if not self._state["inside"][0]:
            return float("nan") if self._r == 1 else np.full(self._r, np.nan)
        value = np.asarray(self._kernel.charts[int(self._state["chart"][0])].xi(self.q))
        return float(value[0]) if self._r == 1 else value

    @property
    def branch(self) -> str:
        """Name of the branch whose chart gives xi; "" before there is one."""
        if self._state["chart"][0] < 0:
            return ""
        chart = self._kernel.charts[int(self._state["chart"][0])]
        return str(chart.notes.get("branch", chart.problem.name))

    def facts(self) -> dict[str, str]:
        """Status, posture and branch."""
        return {
            "tracker": f"status {self.status.name}",
            "q": number_list(self.q),
            "branch": self.branch or "none",
        }

    def reset(self, q: ArrayLike) -> None:
        """Continue from another posture (n,) within the joint limits, at rest.

        Raises:
            InvalidValueError: if q is outside the limits, or a pair touches there.
        """
        robot = self._kernel.maps.robot
        point = as_point("q", q, robot.n)
        if not ((point >= robot.lower) & (point <= robot.upper)).all():
            hint = degrees_hint(*point[np.isfinite(robot.lower)])
            raise InvalidValueError("q", point.tolist(), f"a posture within the joint limits{hint}")
        if self._clearance is not None:
            self._clearance.start(point)
        self._kernel.library.arm_track_reset(self._at, pointer(np.ascontiguousarray(point)))

    def step(self, x: Any, xi: ArrayLike | None = None, posture: ArrayLike | None = None) -> Array:
        """The next posture (n,); see `status`.

        Args:
            x: one task value.
            xi: target in the tracker's chart, a number or (r,). Default: the last target, at first xi at the start.
            posture: (n,), a target in place of xi: among the postures with x, the tracker goes to the one with the
                least weighted distance |q - posture|. It holds until xi or another posture is given.

        Raises:
            InvalidValueError: if x is no task value of this task, or xi and a posture are given.
        """
        maps, wished = self._kernel.maps, xi is not None
        if wished:
            self._read_wish(xi)
        if posture is not None:
            if wished:
                raise InvalidValueError("posture", "given with xi", "one of the two")
            near = as_float_array("posture", posture)
            require_shape("posture", near.shape, (maps.robot.n,))
            if np.isfinite(near).all():
                self._state["near"] = near
            else:
                self._wish[:], wished = np.nan, True  # BAD_INPUT
        # Read a plain vector in C, because reading takes most of the time of a call.
        if type(x) is np.ndarray and x.dtype == np.float64 and x.shape == (maps.task.m,):
            self._x[:] = x
            return self._move(self._kernel.library.track_value, self._x_at, wished)
        targets, single = maps.targets.read(x)
        if not single:
            raise InvalidValueError("x", f"{len(targets)} values", "one task value")
        self._target[:] = targets[0]
        return self._move(self._kernel.library.arm_track, self._target_at, wished)

    def step_to(self, target: Array, xi: ArrayLike | None) -> Array:
        """As `step`, for a target as `orthocas.arms.kernel.build_equations` takes it."""
        if xi is not None:
            self._read_wish(xi)
        self._target[:] = target
        return self._move(self._kernel.library.arm_track, self._target_at, xi is not None)

    def _read_wish(self, xi: ArrayLike | None) -> None:
        if not self._kernel.charts:
            raise InvalidValueError("xi", xi, "None, for an arm without charts")
        if self._r == 1:
            self._wish[0] = as_number("xi", xi)
            return
        values = as_float_array("xi", xi)
        require_shape("xi", values.shape, (self._r,))
        self._wish[:] = values

    def _move(self, track: Any, at: Any, wished: bool) -> Array:
        """One call of C, repeated to avoid contacts and shortened by the margin."""
        wish = self._wish_at if wished else None
        if self._clearance is None:
            track(self._at, self._postures_at, at, wish)
            return self.q
        before, memory = self.q, self._state.copy()
        track(self._at, self._postures_at, at, wish)
        for _ in range(RULES.turns if self._clearance.avoid is not None else 0):
            if not self._push(self._clearance, memory):
                break
            track(self._at, self._postures_at, at, wish)
        self._state["pushes"] = 0
        # Take only part of a step that still comes nearer than the margin.
        q, fraction = self._clearance.limit(before, self.q)
        if fraction < 1:
            self._kernel.library.arm_track_hold(self._at, pointer(np.ascontiguousarray(q)), int(TrackStatus.BRAKED))
        return self.q

    def _push(self, clearance: Clearance, memory: NDArray[np.void]) -> bool:
        """Undo the call, and add a row for each pair that it brought nearer than `avoid`; False if there is none.

        grad d . (q + step - q_1) + d_1 = avoid, with the distance d_1 at q_1, where the call ended.
        """
        assert clearance.avoid is not None
        end = self.q
        # A motion that keeps its distance needs no rows.
        near = clearance.collisions.find_near(end, clearance.avoid - RULES.kept)
        if not len(near.distance):
            return False
        count = int(self._state["pushes"][0])
        known = [(self._state["push"][0, k].copy(), float(self._state["room"][0, k])) for k in range(count)]
        self._state[:] = memory
        rows = [
            (slope, clearance.avoid - distance + float(slope @ (end - memory["q"][0])))
            for distance, slope in zip(near.distance.tolist(), near.gradient, strict=True)
        ]
        fresh = len(rows)
        # Keep rows of earlier turns, unless a new row has nearly the same direction.
        for slope, room in known:
            least = RULES.aligned * float(np.linalg.norm(slope))
            if not any(float(slope @ other) > least * float(np.linalg.norm(other)) for other, _ in rows[:fresh]):
                rows.append((slope, room))
        rows = rows[: RULES.pushes]
        for k, (slope, room) in enumerate(rows):
            self._state["push"][0, k], self._state["room"][0, k] = slope, room
        self._state["pushes"] = len(rows)
        return True


def _read_limits(name: str, limits: ArrayLike | None, default: Array) -> Array:
    """Positive numbers (n,), or one for all joints."""
    values = default if limits is None else as_float_array(name, limits)
    if values.ndim:
        require_shape(name, values.shape, default.shape)
    if not (values > 0).all():
        raise InvalidValueError(name, values.tolist(), "positive numbers")
    return np.array(np.broadcast_to(values, default.shape))
