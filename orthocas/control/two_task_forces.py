"""Forces of springs, dampers and feed-forward in a task x and a second task x_2, each with its own inertia."""

import casadi as ca

from orthocas.control.damping import damping_matrix
from orthocas.control.inertia import block_inertia
from orthocas.control.second_task import SecondTask
from orthocas.problem import Problem

Inputs = dict[str, ca.MX]


def two_task_forces(problem: Problem, second: SecondTask, inputs: Inputs, feed_forward: bool) -> tuple[ca.MX, ca.MX]:
    """f = -K (y - y_d) - D J dq for y = x, (m, 1), and for y = x_2, (k_2, 1), with an input `second_force` added.

    The feed-forward adds M_y (dd_y_d - dJ/dt dq + J M^-1 C dq) + D d_y_d with M_y = (J M^-1 J^T)^-1. A force J_x^T f_x
    alone then gives Lambda_x (dd_x - dd_x_d) + D_x (d_x - d_x_d) + K_x (x - x_d) = 0, Lambda_x = M_x.
    """
    m, K = problem.m, inputs["stiffness"]
    q, dq = inputs["q"], inputs["dq"]
    J, J_2 = problem.task.jacobian_function(q), second.jacobian(q)
    e, D_x, D_2 = errors_and_damping(problem, second, inputs)
    f_x = -K[:m] * e[:m] - D_x @ (J @ dq)
    f_2 = -K[m:] * e[m:] - D_2 @ (J_2 @ dq) + inputs.get("second_force", 0)
    if not feed_forward:
        return f_x, f_2
    M, C_dq = problem.robot.mass_matrix(q), problem.robot.coriolis_product(q, dq, dq)
    B, M_x, _ = block_inertia(problem.n, (m,))(J, M)
    sharp, M_2, _ = second.weighted(q, M)
    rate, acceleration = inputs["reference_velocity"], inputs["reference_acceleration"]
    bend = problem.task.second_derivative_function(q, dq, dq)
    f_x += M_x @ (acceleration[:m] - bend + B.T @ C_dq) + D_x @ rate[:m]
    f_2 += M_2 @ (acceleration[m:] - second.curvature(q, dq)) + sharp.T @ C_dq + D_2 @ rate[m:]
    return f_x, f_2


def errors_and_damping(problem: Problem, second: SecondTask, inputs: Inputs) -> tuple[ca.MX, ca.MX, ca.MX]:
    """e = [x - x_d; x_2 - x_2d], and D_x with the inertia M_x and D_2 with M_2 by [AS2023] eq. (29)."""
    q, K, Z, m = inputs["q"], inputs["stiffness"], inputs["damping_ratio"], problem.m
    M = problem.robot.mass_matrix(q)
    M_x = block_inertia(problem.n, (m,))(problem.task.jacobian_function(q), M)[1]
    M_2 = second.weighted(q, M)[1]
    D_x, D_2 = _damping(m)(M_x, K[:m], Z[:m]), _damping(M_2.shape[0])(M_2, K[m:], Z[m:])
    return second.shortest(second.measured(q) - inputs["reference"]), D_x, D_2


def _damping(size: int) -> ca.Function:
    inertia, K, Z = ca.MX.sym("M", size, size), ca.MX.sym("K", size), ca.MX.sym("Z", size)
    return ca.Function("damping", [inertia, K, Z], [ca.densify(damping_matrix("square_root", inertia, K, Z))])
