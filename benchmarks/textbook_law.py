"""The textbook's operational space controller with a posture, in plain NumPy, as a peer of the laws of `orthocas`."""

import numpy as np

from orthocas.codegen import CompiledLibrary
from orthocas.tools.checks import Array


class TextbookLaw:
    """Computed torque in the task, a posture in its null space, with all Coriolis terms ([Kha1987]).

    tau = J^T Lambda (ddx_d + k_d de + k_p e - dJ/dt dq) + (I - J^T Jbar^T) M (k_d de_q + k_p e_q) + C dq + g,
    Lambda = (J M^-1 J^T)^-1, Jbar = M^-1 J^T Lambda, e = x_d - x, e_q = q_d - q. C dq is compensated as a whole, in the
    task and in its null space. With k_p = omega^2 and k_d = 2 zeta omega, every mode of task and posture has the
    frequency omega and the damping ratio zeta, so no direction has a harder or softer spring than another.

    Args:
        library: compiled C of a law on the same robot and task; only its kinematics and dynamics are used.
        m: number of task components.
        omega: [rad/s].
        zeta: damping ratio.
        posture: whether the posture has a spring. Otherwise, it is only damped.
    """

    def __init__(self, library: CompiledLibrary, m: int, omega: float, zeta: float, posture: bool = True) -> None:
        self.library, self.m = library, m
        self.stiffness, self.damping = omega**2, 2 * zeta * omega
        self.posture_stiffness = self.stiffness if posture else 0.0

    def command(self, q: Array, dq: Array, task: Array, posture: Array) -> Array:
        """Torque for x_d and two derivatives (3, m), and q_d and its derivative (2, n)."""
        m = self.m
        M, bias, _, _ = self.library.dynamics(q, dq)
        phi, jacobian, _ = self.library.chart(q)
        curvature, _ = self.library.curvature(q, dq, dq)
        J = jacobian[:m]
        dual = np.linalg.solve(M, J.T)
        inertia = np.linalg.inv(J @ dual)
        acceleration = task[2] + self.damping * (task[1] - J @ dq) + self.stiffness * (task[0] - phi[:m])
        wanted = self.damping * (posture[1] - dq) + self.posture_stiffness * (posture[0] - q)
        force = M @ wanted
        in_null_space = force - J.T @ (inertia @ (dual.T @ force))
        return np.asarray(J.T @ (inertia @ (acceleration - curvature[:m])) + in_null_space + bias)

    def spring_energy(self, q: Array, posture: Array) -> float:
        """Energy of the springs of the posture, 1/2 k_p e_q^T M e_q [J]."""
        e = posture - q
        return float(self.posture_stiffness * e @ self.library.dynamics(q, 0 * q)[0] @ e / 2)
