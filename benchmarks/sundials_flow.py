"""Flows along the task gradient by CVODES, with the paper's stopping rule: a second opinion on `TaskFlow`."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.errors import GrowError
from orthocas.exact.flow import Arrival, Moved, TaskFlow
from orthocas.tasks.problem import Problem
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

CHANGE = 1e-6  #: the paper's stopping rule: change of q between two steps [rad] or [m]
_STEPS = 2000  # largest number of steps of the gradient flow
_ON_LEAF = 1e-4  # largest |h - x0|, relative to the start, of a trajectory that stopped on the leaf
_NEARLY_SINGULAR = 1e-6  # J A^-1 J^T, relative to its mean over the batch, below which the flow is slowed down


@dataclass(frozen=True, eq=False)
class SundialsFlow:
    """Batched flows of a problem with m = 1 to a leaf h(q) = x0, by CVODES (Adams, functional iteration).

    Args:
        problem: a problem with m = 1.
        tolerance: relative and absolute tolerance of CVODES.

    Raises:
        GrowError: if m > 1.
    """

    problem: Problem
    tolerance: float = 1e-10

    def __post_init__(self) -> None:
        if self.problem.m != 1:
            raise GrowError(f"the task has m = {self.problem.m} components, expected m = 1 for this flow")

    def gradient_flow(self, points: Array, level: float, change: float = CHANGE) -> Moved:
        """Follow dq/dt = (x0 - h(q)) grad_A h(q), [AS2023] eq. (23), until q changes by less than `change` in a step.

        A step lasts 1 / (mean J A^-1 J^T), about the time in which the distance to the leaf falls by a factor of e. A
        trajectory that comes to rest away from the leaf has run into a singularity.

        Args:
            points: (N, n).
            level: x0.
            change: stopping rule [rad] or [m].
        """
        q, status = points.copy(), np.full(len(points), Arrival.SINGULAR)
        duration = 1.0 / float(self._strength(points)[0].mean())
        way = np.abs(level - self.problem.task.batched(points)[0][:, 0])
        running = np.arange(len(points))
        for _ in range(_STEPS):
            if not running.size:
                break
            parameters = np.tile([level, duration], (len(running), 1))
            moved = self._gradient_step(q[running], parameters)[0]
            rested = np.abs(moved - q[running]).max(axis=1) < change
            q[running] = moved
            running = running[~rested]
        left = np.abs(level - self.problem.task.batched(q)[0][:, 0])
        status[left <= _ON_LEAF * np.maximum(way, 1e-3)] = Arrival.REACHED
        return Moved(q, status)

    def pull(self, points: Array, level: float) -> Moved:
        """Follow dq/ds = (x0 - h(q_1)) grad_A h / (dh(grad_A h)), s in [0, 1].

        Near singularities a lower bound keeps the denominator from vanishing, so that CVODES continues. Such a
        trajectory ends off the leaf, with status SINGULAR.

        Args:
            points: (N, n).
            level: x0.
        """
        dx = level - self.problem.task.batched(points)[0]
        floor = _NEARLY_SINGULAR * float(self._strength(points)[0].mean())
        ends = self._task_step(points, np.concatenate([dx, np.full_like(dx, floor)], axis=1))[0]
        left = np.abs(level - self.problem.task.batched(ends)[0][:, 0])
        reached = left <= 1e3 * self.tolerance * (1 + np.abs(dx[:, 0]))
        return Moved(ends, np.where(reached, Arrival.REACHED, Arrival.SINGULAR))

    @cached_property
    def _strength(self) -> Batched:
        """J_x A^-1 J_x^T, (1, 1)."""
        q = ca.SX.sym("q", self.problem.n)
        J = self.problem.task.jacobian_function(q)
        return Batched(dense_function("strength", [q], [J @ TaskFlow(self.problem).build_gradients(q)]))

    @cached_property
    def _gradient_step(self) -> Batched:
        q, p = ca.SX.sym("q", self.problem.n), ca.SX.sym("p", 2)
        gradient = TaskFlow(self.problem).build_gradients(q)
        return self._integrator(q, p, p[1] * (p[0] - self.problem.task.function(q)) * gradient)

    @cached_property
    def _task_step(self) -> Batched:
        q, p = ca.SX.sym("q", self.problem.n), ca.SX.sym("p", 2)
        gradient = TaskFlow(self.problem).build_gradients(q)
        strength = self.problem.task.jacobian_function(q) @ gradient
        return self._integrator(q, p, p[0] * gradient / ca.fmax(strength, p[1]))

    def _integrator(self, q: ca.SX, p: ca.SX, rate: ca.SX) -> Batched:
        """start, p -> end after a unit of time."""
        options: dict[str, Any] = {
            "linear_multistep_method": "adams",
            "nonlinear_solver_iteration": "functional",
            "abstol": self.tolerance,
            "reltol": self.tolerance,
            "max_num_steps": 1_000_000,
            "disable_internal_warnings": True,
        }
        solver = ca.integrator("flow", "cvodes", {"x": q, "p": p, "ode": ca.densify(rate)}, 0.0, 1.0, options)
        start, parameters = ca.MX.sym("start", q.shape[0]), ca.MX.sym("p", p.shape[0])
        end = solver(x0=start, p=parameters)["xf"]
        return Batched(dense_function("flow", [start, parameters], [end]))
