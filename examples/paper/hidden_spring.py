"""A posture spring that a projector hides: the planar arm with three joints, task (x, y), as in [AS2023] Fig. 2.

The tip is less than 1 m away from the base. Along a self-motion curve, the first joint then makes whole turns while the
other two circle around q2 = q3 = 2 pi/3 (Fig. 8). The goal lies half a turn away from the start, where q2 and q3 differ
most from it. A spring that mainly holds these two joints then has a second minimum near the start: there it pulls only
across the curve, and the projector cancels its torque.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import root

from orthocas import problems
from orthocas.bases import Polynomial
from orthocas.charts.chart import Chart
from orthocas.errors import SolveError
from orthocas.fitting.fit import fit
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tools.checks import Array

from .paper_loss import PAPER_LOSS
from .self_motion import trace
from .style import TURN

RADIUS = 0.6  #: distance of the tip from the base [m]
POSTURE_STIFFNESS = (5.0, 50.0, 50.0)  #: of the joint springs [N m/rad]
XI_STIFFNESS = 20.0  #: of the geodetic spring [J]
_BOX = Box((-0.55, 2.0, 2.0), (1.6, 0.9, 0.9))  # contains the path from start to goal [rad]
_DEGREE = 4


@dataclass(frozen=True, eq=False)
class HiddenSpring:
    """The arm, its start and goal on a self-motion curve, and both springs.

    Args:
        radius: distance of the tip from the base, below 1 [m]; the tip lies on the x axis.
    """

    radius: float = RADIUS

    @cached_property
    def problem(self) -> Problem:
        """Task (x, y), A = M, on a box around the path."""
        known = problems.get("planar_3r_xy")
        return Problem(known.robot, known.task, "inertia", _BOX)

    @cached_property
    def chart(self) -> Chart:
        """Fitted coordinates."""
        return fit(self.problem, Polynomial(_DEGREE), weights=PAPER_LOSS).chart

    @cached_property
    def start(self) -> Array:
        """Start of the arm, (3,) [rad]: q2 = q3, with the tip at 1 + 2 cos q2 = radius in direction q1 + q2."""
        bend = np.arccos((self.radius - 1) / 2)
        return np.array([-bend, bend, bend])

    @cached_property
    def goal(self) -> Array:
        """Target of the springs, (3,) [rad]: q2 = q3 again, with the tip behind the base."""
        bend = np.arccos((-self.radius - 1) / 2)
        return np.array([np.pi - bend, bend, bend])

    @cached_property
    def curve(self) -> Array:
        """One turn of the self-motion curve, (P, 3), with the path from start to goal in its middle."""
        turn = trace(self.problem.task, self.start[None], 0.02)[0][:-1]
        period = np.array([TURN, 0.0, 0.0]) * np.sign(turn[-1, 0] - turn[0, 0])
        turns = np.concatenate([turn - period, turn, turn + period])
        turns = turns[np.argsort(turns[:, 0])]  # the first joint always turns in the same direction
        middle = (self.start[0] + self.goal[0]) / 2
        return np.asarray(turns[np.abs(turns[:, 0] - middle) <= np.pi])

    @cached_property
    def stuck(self) -> Array:
        """The point of the curve between start and goal where the projected spring has a minimum, (3,) [rad].

        Raises:
            SolveError: if there is no such minimum.
        """
        between = self.curve[(self.curve[:, 0] > self.start[0]) & (self.curve[:, 0] < self.goal[0])]
        energy = self.posture_energy(between)
        minima = np.flatnonzero((energy[1:-1] < energy[:-2]) & (energy[1:-1] < energy[2:])) + 1
        if not minima.size:
            raise SolveError(f"the posture spring has no minimum between start and goal at radius {self.radius}")
        task = self.problem.task
        wanted = task.batched(self.start[None])[0][0]

        def residual(q: Array) -> Array:
            return np.append(task.batched(q[None])[0][0] - wanted, self.projected_torque(q))

        solution = root(residual, between[minima[0]], tol=1e-12)
        return np.asarray(solution.x)

    def posture_torque(self, q: Array) -> Array:
        """Torque of the posture spring, (3,) [N m]."""
        return np.asarray(POSTURE_STIFFNESS) * (self.goal - q)

    def projected_torque(self, q: Array) -> float:
        """Torque along the self-motion curve, tau . u with the unit tangent u [N m]; it determines P^T tau."""
        J = self.problem.task.batched_jacobian(q[None])[0][0]
        tangent = np.cross(J[0], J[1])
        return float(self.posture_torque(q) @ tangent / np.linalg.norm(tangent))

    def posture_energy(self, q: Array) -> Array:
        """Energy in the posture spring at points (N, 3), (N,) [J]."""
        return np.asarray((q - self.goal) ** 2 @ np.asarray(POSTURE_STIFFNESS) / 2)

    def geodetic_energy(self, q: Array) -> Array:
        """Energy in the spring between xi and xi at the goal, at points (N, 3), (N,) [J]."""
        return np.asarray(XI_STIFFNESS * (self.chart.xi(q)[:, 0] - self.chart.xi(self.goal)[0]) ** 2 / 2)
