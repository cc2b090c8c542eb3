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
from orthocas.coordinates.turns import shortest
from orthocas.inverting.newton import GOAL, SUSPICIOUS, Attempt, LocalSolver
from orthocas.inverting.phi_map import ROUNDING, PhiMap

_FEW = 4  # rows that are solved one by one
STEPS = 3  #: with the same Jacobian
REFRESHES = 4


@dataclass(frozen=True)
class PointFunctions:
    """The two functions of a chart that `PointSolver` calls."""

    inverted: ca.Function  #: q -> phi, H = J^-1, and |D^-1 J| |H D| with the sizes D of the components
    chord: ca.Function  #: q, phi, H, target -> q and phi after 3 steps, and |residual| at each of the 4 points

    @classmethod
    def of(cls, phi: ca.Function, jacobian: ca.Function, sizes: Array, turns: Array) -> "PointFunctions":
        """For phi and J of a column q (n, 1), and the sizes and periods of the components of phi."""
        n = len(sizes)
        q, known, target = (ca.MX.sym(name, n) for name in ("q", "phi", "target"))
        H = ca.MX.sym("H", n, n)
        inverted = dense_function("inverted", [q], [phi(q), *_inversion(sizes).call([jacobian(q)])])
        scale = ca.DM(sizes) + ROUNDING * ca.fabs(target)
        now, value, left = q, known, shortest(target - known, turns)
        errors = [ca.norm_2(left / scale)]  # norm_inf drops NaN
        for _ in range(STEPS):
            now = now + H @ left
            value = phi(now)
            left = shortest(target - value, turns)
            errors.append(ca.norm_2(left / scale))
        chord = dense_function("chord", [q, known, H, target], [now, value, ca.vertcat(*errors)])
        return cls(inverted, chord)


class PointSolver:
    """Solves phi(q) = target near a start; each solver has its own scratch memory, and belongs to one thread.

    `q` and `target` are its inputs, (n,), and `phi` is that of q. After steps, `reached` and `errors` tell where they
    ended.
    """

    def __init__(self, functions: PointFunctions) -> None:
        n = functions.chord.numel_out(0)
        self.q, self.phi, self.target, self.reached, self._phi_reached = np.empty((5, n))
        self.errors, self.condition = np.empty(STEPS + 1), np.empty(1)
        self.iterations = 0  #: of the last solution
        H = np.empty(n * n)
        self._refresh = Bound(functions.inverted, [self.q], [self.phi, H, self.condition])
        results = [self.reached, self._phi_reached, self.errors]
        self._step = Bound(functions.chord, [self.q, self.phi, H, self.target], results)

    def refresh(self) -> bool:
        """Evaluate phi and J at q. Returns whether J is regular."""
        self._refresh.run()
        return bool(self.condition[0] < SUSPICIOUS)

    def step(self) -> bool:
        """Take steps from q with the last J. Returns whether all of them reduced the error; q stays."""
        self._step.run()
        return decreasing(self.errors.tolist())

    def accept(self) -> None:
        """Move q to where the last steps ended."""
        self.q[:], self.phi[:] = self.reached, self._phi_reached

    def solve(self) -> bool:
        """Solve for the target from q. Returns whether the error fell to rounding; then q is the solution."""
        self.iterations = 0
        for _ in range(REFRESHES):
            if not self.refresh() or not self.step():
                return False
            self.accept()
            self.iterations += STEPS
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
            solver = PointSolver(self._functions)
            done = [_solved(solver, attempt, k, targets[k], starts[k]) for k in range(len(targets))]
        attempt.residual[:] = self._map.difference(targets, attempt.residual) / self._map.scale(targets)
        failed = np.flatnonzero(~np.array(done, dtype=bool))
        if failed.size:
            attempt.replace(failed, self._other(targets[failed], starts[failed]))
        return attempt


def decreasing(errors: list[float]) -> bool:
    """Whether errors fall until they are rounding."""
    return all(after < before or after <= GOAL for before, after in pairwise(errors))


class Bound:
    """A function on arrays that stay in place: `run()` evaluates it."""

    def __init__(self, function: ca.Function, inputs: list[Array], outputs: list[Array]) -> None:
        buffer: Any  # the stubs of set_arg and set_res ask for a size, the methods take none
        buffer, run = function.buffer()
        for i, array in enumerate(inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(outputs):
            buffer.set_res(i, array.data)
        self.run: Callable[[], Any] = run
        self._alive = buffer, inputs, outputs


def _solved(solver: PointSolver, attempt: Attempt, k: int, target: Array, start: Array) -> bool:
    """Put q and phi for row k into `attempt`. Returns whether that succeeded, which it does not near singular J."""
    solver.q[:], solver.target[:] = start, target
    done = solver.solve()
    attempt.q[k], attempt.residual[k], attempt.iterations[k] = solver.q, solver.phi, solver.iterations
    return done


def _inversion(sizes: Array) -> ca.Function:
    """J -> J^-1, and the product of the norms of D^-1 J and its inverse; by QR, so NaN for singular J."""
    n = len(sizes)
    J, D = ca.SX.sym("J", n, n), ca.repmat(ca.DM(sizes), 1, n)
    inverse = ca.solve(J, ca.SX.eye(n))
    return ca.Function("inversion", [J], [inverse, ca.norm_fro(J / D) * ca.norm_fro(inverse * D.T)])
