"""Coordinates (x, xi) in robot learning: actions of Gymnasium environments, and episodes of recorded joints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.trackers import Tracker, TrackerStatus
from orthocas.errors import DomainError, InvalidValueError, InverseError, MissingExtraError
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_point,
    as_point_set,
    freeze_indices,
    require_kind,
    require_shape,
)

try:
    import gymnasium
except ImportError:
    raise MissingExtraError("orthocas.learn", "gymnasium", "learn") from None


__all__ = ["PhiActions", "coordinates_of", "joints_of"]


def _read_positions(env: Any) -> Array:
    """Joint positions of a MuJoCo environment."""
    return np.array(env.unwrapped.data.qpos)


class PhiActions(gymnasium.Wrapper[Array, Array, Array, Array]):
    """An environment whose actions are joint positions (n,), with actions in (x, xi) instead.

    An action a in [-1, 1]^n moves phi from where it is by a * step, orientations in the tip's axes. A tracker with
    `nearest=True` turns that into joint positions, in as many steps as it takes, up to 20. They never leave the domain,
    and so the joint limits. Where an action leads out, x goes as near as the domain lets it, and xi gives way; the next
    action counts from there. Observations get xi (r,) and the distance to the nearest face of the domain at their end,
    [rad] or [m].

    Args:
        env: the environment; its actions and observations are boxes (gymnasium.spaces.Box).
        chart: a chart of its arm.
        step: change of each component of phi by an action of 1, one number or (n,), > 0.
        joints: places of the chart's joints in the environment's positions; default: the first n.
        positions: joint positions of the environment; default: `env.unwrapped.data.qpos`, as MuJoCo's have.

    Raises:
        MissingExtraError: without gymnasium, when `orthocas.learn` is imported: extra `learn`.
        InvalidValueError: if an argument is invalid, or actions are not n numbers; at `reset`, if the arm starts
            outside the domain.
    """

    def __init__(
        self,
        env: gymnasium.Env[Array, Array],
        chart: Chart,
        step: ArrayLike,
        joints: ArrayLike | None = None,
        positions: Callable[[Any], Array] = _read_positions,
    ) -> None:
        require_kind("env", env, gymnasium.Env)
        super().__init__(env)
        require_kind("chart", chart, Chart)
        # The environment takes joint positions, and observes a row of numbers.
        inner, outer = env.action_space, cast(Any, env.observation_space)
        if getattr(inner, "shape", None) != (chart.n,):
            raise InvalidValueError("actions of env", str(inner)[:80], f"{chart.n} joint positions")
        if len(getattr(outer, "shape", None) or ()) != 1:
            raise InvalidValueError("observations of env", str(outer)[:80], "a row of numbers")
        if not callable(positions):
            raise InvalidValueError("positions", repr(positions)[:80], "a function of an environment")
        # Which observations are joints, and how far one action moves each.
        self.chart, self._positions = chart, positions
        places = range(chart.n) if joints is None else joints
        self._joints = freeze_indices("joints", places, (chart.n,), 2**31)
        sizes = as_float_array("step", step)
        if sizes.shape not in ((), (chart.n,)) or not ((sizes > 0) & np.isfinite(sizes)).all():
            raise InvalidValueError("step", sizes.tolist(), f"one finite number or {chart.n}, > 0")
        self._step = np.broadcast_to(sizes, chart.n)
        self._tracker: Tracker | None = None
        # Actions are changes of phi; observations get xi and the distance to the boundary.
        more = np.full(chart.r + 1, np.inf)
        low, high = (np.asarray(end, dtype=float) for end in (outer.low, outer.high))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (chart.n,), np.float64)
        self.observation_space = gymnasium.spaces.Box(np.append(low, -more), np.append(high, more), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start again, where the environment puts the arm; seed and options are for that."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._tracker = self.chart.tracker(self._read_joints(), nearest=True)
        return self._extend(observation), info

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Move phi. `info["tracker"]` has the status of the tracker: OK, NEAREST, or NEARER after 20 steps.

        BAD_INPUT: a number of the action is NaN; the arm stays.
        """
        if self._tracker is None:
            raise gymnasium.error.ResetNeeded("step before reset, expected reset first")
        change = as_float_array("action", action)
        require_shape("action", change.shape, (self.chart.n,))
        # phi at a change from q, by turns in the tip's axes for orientations.
        chart, m, change = self.chart, self.chart.m, self._step * np.clip(change, -1.0, 1.0)
        phi = chart.phi(self._tracker.q)
        target = np.array(phi + change)
        if chart.parts.relative.turned:
            none = np.zeros(m)
            target[:m] = np.array(chart.parts.relative.moved(phi[:m], change[:m], phi[:m], none, none)[0]).ravel()
        # the tracker takes several calls for a large change
        for _ in range(20):
            self._tracker.step(target)
            if self._tracker.status != TrackerStatus.NEARER:
                break
        status = self._tracker.status
        observation, reward, terminated, truncated, info = self.env.step(self._tracker.q)
        return self._extend(observation), reward, terminated, truncated, info | {"tracker": status}

    def _read_joints(self) -> Array:
        positions = as_float_array("positions", self._positions(self.env))
        if positions.ndim != 1 or len(positions) <= self._joints.max():
            raise InvalidValueError(
                "positions", f"of shape {positions.shape}", f"a row with place {self._joints.max()}"
            )
        return np.asarray(positions[self._joints])

    def _extend(self, observation: Array) -> Array:
        """An observation with xi and the distance to the boundary."""
        q = self._read_joints()
        low, high = self.chart.problem.domain.bounds
        distance = np.minimum(q - low, high - q).min()
        return np.asarray(np.concatenate([observation, self.chart.xi(q), [distance]]))


def coordinates_of(chart: Chart, q: ArrayLike) -> Array:
    """phi = (x, xi) of a trajectory q (T, n), such as the states or the actions of an episode; (T, n).

    It equals `chart.phi`, but refuses positions outside the domain, from which `joints_of` may not lead back.

    Raises:
        DomainError: if a row lies outside the domain; the message names the first.

    Example:
        >>> import numpy as np
        >>> import orthocas as oc
        >>> from orthocas import learn, problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> q = np.linspace([0.6, 0.8, 0.8], [0.8, 0.7, 0.9], 50)
        >>> again = learn.joints_of(chart, learn.coordinates_of(chart, q), q[0])
        >>> bool(abs(again - q).max() < 1e-9)
        True
    """
    require_kind("chart", chart, Chart)
    points, _ = as_point_set("q", q, chart.n)
    outside = np.flatnonzero(~chart.problem.domain.contains(points))
    if outside.size:
        raise DomainError(f"row {outside[0]} of {len(points)} lies outside the domain, where phi may have no way back")
    return chart.phi(points)


def joints_of(chart: Chart, phi: ArrayLike, q_start: ArrayLike) -> Array:
    """The trajectory q (T, n) with phi(q) = phi (T, n) that begins next to q_start (n,), each row next to the last.

    phi alone does not tell which of several solutions was meant, so keep the first row of q with an episode.

    Raises:
        InverseError: if a row has no solution near the last one, inside the domain; the message names it.
        InvalidValueError: if q_start lies outside the domain.
    """
    require_kind("chart", chart, Chart)
    targets, _ = as_point_set("phi", phi, chart.n)
    tracker, q = chart.tracker(as_point("q_start", q_start, chart.n), largest_step=np.inf), np.empty(targets.shape)
    for k, target in enumerate(targets):
        q[k] = tracker.step(target)
        if tracker.status != TrackerStatus.OK:
            raise InverseError(f"row {k} of {len(targets)} has no q near the last one: {tracker.status.name}")
    return q
