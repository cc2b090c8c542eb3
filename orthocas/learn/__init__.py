"""Coordinates (x, xi) for robot learning: as actions of Gymnasium environments, and for recorded joint trajectories."""

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
    """Wraps an environment whose actions are joint positions (n,), so that its actions are changes of (x, xi).

    An action a in [-1, 1]^n changes phi by a * step, with orientations in the tip's axes. A tracker with `nearest=True`
    converts this to joint positions, in up to 20 steps. They never leave the domain, so joint limits hold. If an action
    leads out of the domain, x goes as near as possible, and xi gives way. The next action starts from the position
    reached. Observations are extended by xi (r,) and the distance to the nearest face of the domain, [rad] or [m].

    Args:
        env: the environment; its actions and observations are boxes (gymnasium.spaces.Box).
        chart: a chart of its arm.
        step: change of each component of phi for an action of 1, one number or (n,), > 0.
        joints: indices of the chart's joints in the environment's positions; default: the first n.
        positions: function that returns the environment's joint positions; default: `env.unwrapped.data.qpos` of
            MuJoCo.

    Raises:
        MissingExtraError: if gymnasium is missing when `orthocas.learn` is imported (extra `learn`).
        InvalidValueError: if an argument is invalid, or actions are not n numbers; in `reset`, if the arm starts
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
        # The environment must take joint positions, and observe a vector.
        inner, outer = env.action_space, cast(Any, env.observation_space)
        if getattr(inner, "shape", None) != (chart.n,):
            raise InvalidValueError("actions of env", str(inner)[:80], f"{chart.n} joint positions")
        if len(getattr(outer, "shape", None) or ()) != 1:
            raise InvalidValueError("observations of env", str(outer)[:80], "a vector of numbers")
        if not callable(positions):
            raise InvalidValueError("positions", repr(positions)[:80], "a function of an environment")
        # Indices of the joints, and the step of one action.
        self.chart, self._positions = chart, positions
        places = range(chart.n) if joints is None else joints
        self._joints = freeze_indices("joints", places, (chart.n,), 2**31)
        sizes = as_float_array("step", step)
        if sizes.shape not in ((), (chart.n,)) or not ((sizes > 0) & np.isfinite(sizes)).all():
            raise InvalidValueError("step", sizes.tolist(), f"one finite number or {chart.n}, > 0")
        self._step = np.broadcast_to(sizes, chart.n)
        self._tracker: Tracker | None = None
        # Actions change phi. Observations are extended by xi and the distance to the boundary.
        more = np.full(chart.r + 1, np.inf)
        low, high = (np.asarray(end, dtype=float) for end in (outer.low, outer.high))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (chart.n,), np.float64)
        self.observation_space = gymnasium.spaces.Box(np.append(low, -more), np.append(high, more), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Reset the environment, with its own seed and options."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._tracker = self.chart.tracker(self._read_joints(), nearest=True)
        return self._extend(observation), info

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Move phi. `info["tracker"]` has the status of the tracker: OK, NEAREST, or NEARER after 20 steps.

        The status is BAD_INPUT if a number of the action is NaN. The arm then stays where it is.
        """
        if self._tracker is None:
            raise gymnasium.error.ResetNeeded("step before reset, expected reset first")
        change = as_float_array("action", action)
        require_shape("action", change.shape, (self.chart.n,))
        # Compute phi after the change; orientations turn in the tip's axes.
        chart, m, change = self.chart, self.chart.m, self._step * np.clip(change, -1.0, 1.0)
        phi = chart.phi(self._tracker.q)
        target = np.array(phi + change)
        if chart.parts.relative.turned:
            none = np.zeros(m)
            target[:m] = np.array(chart.parts.relative.moved(phi[:m], change[:m], phi[:m], none, none)[0]).ravel()
        # The tracker may need several calls for a large change.
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
                "positions", f"of shape {positions.shape}", f"a vector longer than {self._joints.max()}"
            )
        return np.asarray(positions[self._joints])

    def _extend(self, observation: Array) -> Array:
        """The observation, extended by xi and the distance to the boundary."""
        q = self._read_joints()
        low, high = self.chart.problem.domain.bounds
        distance = np.minimum(q - low, high - q).min()
        return np.asarray(np.concatenate([observation, self.chart.xi(q), [distance]]))


def coordinates_of(chart: Chart, q: ArrayLike) -> Array:
    """phi = (x, xi), (T, n), of a trajectory q (T, n), such as the states or actions of an episode.

    It equals `chart.phi`, but refuses positions outside the domain, where `joints_of` may not lead back to the same q.

    Raises:
        DomainError: if a row lies outside the domain. The message names the first such row.

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
        raise DomainError(
            f"row {outside[0]} of {len(points)} lies outside the domain, where q may not be recovered from phi"
        )
    return chart.phi(points)


def joints_of(chart: Chart, phi: ArrayLike, q_start: ArrayLike) -> Array:
    """The trajectory q (T, n) with phi(q) = phi (T, n), starting near q_start (n,), each row near the previous one.

    phi alone does not distinguish several solutions, so store the first row of q with an episode.

    Raises:
        InverseError: if a row has no solution near the previous one inside the domain. The message names the row.
        InvalidValueError: if q_start lies outside the domain.
    """
    require_kind("chart", chart, Chart)
    targets, _ = as_point_set("phi", phi, chart.n)
    tracker, q = chart.tracker(as_point("q_start", q_start, chart.n), largest_step=np.inf), np.empty(targets.shape)
    for k, target in enumerate(targets):
        q[k] = tracker.step(target)
        if tracker.status != TrackerStatus.OK:
            raise InverseError(
                f"row {k} of {len(targets)} has no solution near the previous one: {tracker.status.name}"
            )
    return q
