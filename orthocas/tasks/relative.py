"""Errors and rates of task values relative to a target, without a discontinuity half a turn from the reference."""

from typing import Any

import casadi as ca
import numpy as np

from orthocas.robots.spatial import conjugate, multiply_quaternions, skew
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array
from orthocas.tools.columns import BlockedFunction


class Relative:
    """A task value x relative to a target x_d.

    For most tasks, the error is e = x - x_d. For orientation and pose tasks, let R be the tip's orientation and R_d the
    target orientation. The orientation rows of e are 2 sin(angle / 2) axis of R_d^T R, so they do not depend on the
    reference of the task. With an AXIS, these rows are put into its order: tilt, tilt, turn. The error is continuous
    except where R is half a turn from R_d. J(q) are the rates of the error: d(e)/dt = J dq at e = 0, so its orientation
    rows are the angular velocity in the tip's axes.

    Args:
        task: the task.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        turn = task.turn
        self.turned = turn is not None and turn.whole  #: whether x holds a whole orientation
        self.first = task.m - 3 if self.turned else task.m  #: number of rows before those of the orientation

    @property
    def turns(self) -> tuple[int, int]:
        """First row and end row of the rotation vector or tilt in x; both are equal if there is none."""
        turn = self.task.turn
        if turn is None or not turn.whole:
            return 0, 0
        return self.first, self.first + (3 if turn.axis is None else 2)

    def difference(self, x_d: Any, x: Any) -> Any:
        """-e, the step from x to x_d, as NumPy rows (..., m) or CasADi columns (m, 1)."""
        if not self.turned:
            return x_d - x
        if isinstance(x, ca.SX | ca.MX | ca.DM) or isinstance(x_d, ca.SX | ca.MX | ca.DM):
            return -self._error(x, x_d)[0]
        target, here = np.broadcast_arrays(x_d, x)
        rows = self._batched_error(here.reshape(-1, self.task.m), target.reshape(-1, self.task.m))[0]
        return -rows.reshape(target.shape)

    @property
    def rates(self) -> ca.Function:
        """q (n, 1) -> J (m, n)."""
        return self.task.rates_function

    @cached_property
    def batched_rates(self) -> BlockedFunction:
        """Evaluates J at many points."""
        return BlockedFunction(self.rates) if self.turned else self.task.batched_jacobian

    def embed(self, x: Array) -> Array:
        """Map orientations of x (N, m) to vectors (N, 16) without a seam, whose distances approximate small errors.

        The entries are products of two entries of the unit quaternion, times sqrt(2), so that both signs of a
        quaternion give the same vector. For tasks of a whole orientation only.
        """
        p = self._batched_quaternion(x)[0]
        return np.asarray(np.sqrt(2) * (p[:, :, None] * p[:, None]).reshape(len(p), -1))

    @cached_property
    def _batched_quaternion(self) -> Batched:
        return Batched(self.task.quaternion_function)

    def error(self, q: ca.MX, x_d: ca.MX) -> tuple[ca.MX, ca.MX]:
        """The error e (m, 1), and de/dq (m, n) while x_d is at rest."""
        J = self.rates(q)
        if not self.turned:
            return self.task.function(q) - x_d, J
        e, slope = self._error(self.task.function(q), x_d)
        return e, slope @ J

    def compute_drift(self, q: ca.MX, x_d: ca.MX, dx_d: ca.MX) -> ca.MX:
        """-de/dt of an arm at rest, (m, 1): the value of (de/dq) dq that follows the moving target."""
        return -self._drift(self.task.function(q), x_d, dx_d) if self.turned else dx_d

    def compute_bias(self, q: ca.MX, dq: ca.MX, w: ca.MX, target: tuple[ca.MX, ca.MX, ca.MX]) -> ca.MX:
        """d/dt (de/dq w - drift) for constant w (n, 1), (m, 1); `target` holds x_d and its two derivatives."""
        bend = self.task.rates_derivative_function(q, dq, w)
        if not self.turned:
            return bend - target[2]
        J = self.rates(q)
        return self._bend(self.task.function(q), *target, J @ dq, J @ w, bend)

    @cached_property
    def moved(self) -> ca.Function:
        """x, e, x_d, dx_d, ddx_d -> x moved by an error e, and its two derivatives.

        The derivatives are those of an orientation with the angular velocity and acceleration of x_d in its own axes.
        For tasks of a whole orientation only.
        """
        x, e, x_d, dx_d, ddx_d = symbols = self._make_symbols("x", "e", "x_d", "dx_d", "ddx_d")
        return dense_function("moved", symbols, list(self.turned_by(x, e, *self._turning(x_d, dx_d, ddx_d))))

    @cached_property
    def turned_by(self) -> ca.Function:
        """x, e, rates, changes -> x moved by an error e, and its derivatives, from rates of e and their changes.

        For tasks of a whole orientation only.
        """
        x, e, rates, changes = symbols = self._make_symbols("x", "e", "rates", "changes")
        turn, first = self.task.turn, self.first
        assert turn is not None
        # Write the error as a quaternion step, and differentiate the product.
        half, omega, alpha = (self._order.T @ part[first:] for part in (e / 2, rates, changes))
        step = ca.vertcat(ca.sqrt(ca.fmax(1 - ca.sumsqr(half), 0)), half)
        p = multiply_quaternions(self._compute_quaternion(x), step)
        dp = multiply_quaternions(p, ca.vertcat(0, omega)) / 2
        ddp = (multiply_quaternions(dp, ca.vertcat(0, omega)) + multiply_quaternions(p, ca.vertcat(0, alpha))) / 2
        # Components of the product, and their derivatives.
        at = ca.SX.sym("p", 4)
        value = turn.of_quaternion(at)
        rate = ca.jtimes(value, at, dp)
        turned = [value, rate, ca.jtimes(rate, at, dp) + ca.jtimes(value, at, ddp)]
        turned = ca.substitute(turned, [at], [p])
        straight = (x[:first] + e[:first], rates[:first], changes[:first])
        whole = [ca.vertcat(a, b) for a, b in zip(straight, turned, strict=True)]
        return dense_function("turned_by", symbols, [ca.cse(part) for part in whole])

    def convert_rates(self, x_d: ca.MX, dx_d: ca.MX, ddx_d: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Convert rates of a target value to rates of the error (m, 1), about the target's axes, and derivatives."""
        if not self.turned:
            return dx_d, ddx_d
        rate, change = self._turning(x_d, dx_d, ddx_d)
        return rate, change

    @cached_property
    def _turning(self) -> ca.Function:
        x_d, dx_d, ddx_d = symbols = self._make_symbols("x_d", "dx_d", "ddx_d")
        _, omega, alpha = self._differentiate_target(x_d, dx_d, ddx_d)
        parts = ((dx_d, omega), (ddx_d, alpha))
        rates = [ca.vertcat(straight[: self.first], self._order @ turning) for straight, turning in parts]
        return dense_function("turning", symbols, rates)

    @cached_property
    def _batched_error(self) -> Batched:
        return Batched(self._error)

    @cached_property
    def _error(self) -> ca.Function:
        """x, x_d -> e, and the matrix E with de/dq = E J."""
        x, x_d = self._make_symbols("x", "x_d")
        w, v = self._compute_turn(x, self._compute_quaternion(x_d))
        slope = ca.SX.eye(self.task.m)
        slope[self.first :, self.first :] = self._order @ (w * ca.SX.eye(3) + skew(v)) @ self._order.T
        e = ca.vertcat(x[: self.first] - x_d[: self.first], self._order @ (2 * v))
        return dense_function("relative", [x, x_d], [e, slope], ["x", "x_d"])

    @cached_property
    def _drift(self) -> ca.Function:
        """x, x_d, dx_d -> de/dt of an arm at rest."""
        x, x_d, dx_d = self._make_symbols("x", "x_d", "dx_d")
        p, omega = self._differentiate_target(x_d, dx_d, ca.SX.zeros(self.task.m))[:2]
        w, v = self._compute_turn(x, p)
        turning = self._order @ (w * omega - ca.cross(v, omega))
        return dense_function("drift", [x, x_d, dx_d], [-ca.vertcat(dx_d[: self.first], turning)], ["x", "x_d", "v"])

    @cached_property
    def _bend(self) -> ca.Function:
        """x, x_d, dx_d, ddx_d, J dq, J w, dJ/dt w -> d/dt (E J w + de/dt of an arm at rest)."""
        names = ("x", "x_d", "dx_d", "ddx_d", "here", "there", "change")
        x, x_d, dx_d, ddx_d, here, there, change = symbols = self._make_symbols(*names)
        # Rotation from the target as a unit quaternion (w, v), and its rates.
        p, omega, alpha = self._differentiate_target(x_d, dx_d, ddx_d)
        w, v = self._compute_turn(x, p)
        turning, along, changing = (self._order.T @ rate[self.first :] for rate in (here, there, change))
        dv = (w * (turning - omega) + ca.cross(v, turning + omega)) / 2
        dw = -ca.dot(v, turning - omega) / 2
        # Rate of E times the velocity, and rate of the term that the moving target adds.
        moved = dw * along + ca.cross(dv, along) + w * changing + ca.cross(v, changing)
        left = dw * omega + w * alpha - ca.cross(dv, omega) - ca.cross(v, alpha)
        straight = change[: self.first] - ddx_d[: self.first]
        return dense_function("bend", symbols, [ca.cse(ca.vertcat(straight, self._order @ (moved - left)))], names)

    def _make_symbols(self, *names: str) -> list[ca.SX]:
        return [ca.SX.sym(name, self.task.m) for name in names]

    @property
    def _order(self) -> ca.SX:
        assert self.task.turn is not None
        return ca.SX(ca.sparsify(ca.DM(self.task.turn.order)))

    def _compute_quaternion(self, x: ca.SX) -> ca.SX:
        quaternion: ca.SX = self.task.quaternion_function(x)
        return quaternion

    def _compute_turn(self, x: ca.SX, target: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Quaternion (w, v), w >= 0, of the rotation from the target orientation to the orientation of x."""
        turn = multiply_quaternions(conjugate(target), self._compute_quaternion(x))
        turn = turn * ca.if_else(turn[0] < 0, -1, 1)
        return turn[0], turn[1:]

    def _differentiate_target(self, x_d: ca.SX, dx_d: ca.SX, ddx_d: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The target orientation, and its angular velocity and acceleration in its own axes."""
        p = self._compute_quaternion(x_d)
        dp = ca.jtimes(p, x_d, dx_d)
        ddp = ca.jtimes(dp, x_d, dx_d) + ca.jtimes(p, x_d, ddx_d)
        back = conjugate(p)
        return p, 2 * multiply_quaternions(back, dp)[1:], 2 * multiply_quaternions(back, ddp)[1:]
