"""Newton's method for one target at a time, without the overhead of arrays of rows (ours).

A few chord steps with one Jacobian run inside one CasADi function, whose inputs and outputs are arrays that stay in
place. It gives up as soon as the error does not decrease; the caller then searches with more care.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.batch import dense_function
from orthocas.casadi_tools.interrupts import deferred
from orthocas.checks import Array
from orthocas.inverting.newton import GOAL, SUSPICIOUS, Attempt, LocalSolver, PhiMap

_FEW = 4  # rows that are solved one by one
_STEPS = 3  # with the same Jacobian
_REFRESHES = 4


@dataclass(frozen=True)
class PointFunctions:
    """The two functions of a chart that `PointSolver` calls."""

    inverted: ca.Function  #: q, scale -> the inverse H of J / scale, and |J| |H|
    chord: ca.Function  #: q, H, target, scale -> q after 3 steps, its residual, and |residual| at each of the 4 points

    @classmethod
    def of(cls, phi: ca.Function, jacobian: ca.Function) -> "PointFunctions":
        """For phi and J of a column q (n, 1)."""
        n = phi.numel_out(0)
        A = ca.SX.sym("A", n, n)
        inverse = ca.solve(A, ca.SX.eye(n))
        invert = ca.Function("invert", [A], [inverse, ca.norm_fro(A) * ca.norm_fro(inverse)])
        q, target, scale = (ca.MX.sym(name, n) for name in ("q", "target", "scale"))
        H = ca.MX.sym("H", n, n)
        inverted = dense_function("inverted", [q, scale], invert.call([jacobian(q) / ca.repmat(scale, 1, n)]))
        now, residual = q, (target - phi(q)) / scale
        errors = [ca.norm_2(residual)]  # norm_inf drops NaN
        for _ in range(_STEPS):
            now = now + H @ residual
            residual = (target - phi(now)) / scale
            errors.append(ca.norm_2(residual))
        return cls(inverted, dense_function("chord", [q, H, target, scale], [now, residual, ca.vertcat(*errors)]))


class PointSolver:
    """Solves phi(q) = target near a start; each solver has its own scratch memory, and belongs to one thread.

    `q`, `target`, `scale` are its inputs, (n,). After a step, `reached`, `residual` and `errors` tell where it ended.
    """

    def __init__(self, functions: PointFunctions) -> None:
        n = functions.chord.numel_out(0)
        self.q, self.target, self.scale, self.reached, self.residual = np.empty((5, n))
        self.errors, self.condition = np.empty(_STEPS + 1), np.empty(1)
        self.iterations = 0  #: of the last solution
        inverse = np.empty(n * n)
        self._refresh, self._keep = _bound(functions.inverted, [self.q, self.scale], [inverse, self.condition])
        self._step, self._keep_too = _bound(
            functions.chord, [self.q, inverse, self.target, self.scale], [self.reached, self.residual, self.errors]
        )

    def refresh(self) -> None:
        """Evaluate J at q."""
        self._refresh()

    def step(self) -> bool:
        """Take steps from q with the last J. Returns whether all of them reduced the error; q stays."""
        self._step()
        errors = self.errors.tolist()
        return all(after < before or after <= GOAL for before, after in pairwise(errors))

    def solve(self) -> bool:
        """Solve for the target from q. Returns whether the error fell to rounding; then q is the solution."""
        self.iterations = 0
        for _ in range(_REFRESHES):
            self._refresh()
            if not self.condition[0] < SUSPICIOUS or not self.step():
                return False
            self.q[:] = self.reached
            self.iterations += _STEPS
            if self.errors[-1] <= GOAL:
                return True
        return False


class FewRows:
    """A local solver that takes few rows one by one, and the others, or those that fail, to another solver."""

    def __init__(self, phi_map: PhiMap, functions: PointFunctions, other: LocalSolver) -> None:
        self._map, self._functions, self._other = phi_map, functions, other

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        if len(targets) > _FEW:
            return self._other(targets, starts)
        attempt = Attempt.empty(*targets.shape)
        with deferred():  # otherwise CasADi turns Ctrl-C into a RuntimeError, or swallows it
            solver, scale = PointSolver(self._functions), self._map.scale(targets)
            done = [self._row(solver, attempt, k, (starts[k], targets[k], scale[k])) for k in range(len(targets))]
        failed = np.flatnonzero(~np.array(done, dtype=bool))
        if failed.size:
            attempt.replace(failed, self._other(targets[failed], starts[failed]))
        return attempt

    @staticmethod
    def _row(solver: PointSolver, attempt: Attempt, k: int, given: tuple[Array, Array, Array]) -> bool:
        """Solve a row; returns whether that succeeded, which it does not near singular J."""
        solver.q[:], solver.target[:], solver.scale[:] = given
        done = solver.solve()
        attempt.q[k], attempt.residual[k] = solver.q, solver.residual
        attempt.iterations[k] = solver.iterations
        return done


def _bound(function: ca.Function, inputs: list[Array], outputs: list[Array]) -> tuple[Callable[[], Any], Any]:
    """A call of a function on arrays that stay in place, and what has to live as long as it."""
    buffer: Any  # the stubs of set_arg and set_res ask for a size, the methods take none
    buffer, run = function.buffer()
    for i, array in enumerate(inputs):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(outputs):
        buffer.set_res(i, array.data)
    return run, (buffer, inputs, outputs)
