"""Joint positions of a task value, and the nearest xi there, by many starts, without the inverse of the package."""

import casadi as ca
import numpy as np
from scipy.optimize import minimize

import orthocas as oc
from orthocas.charts.descent import rooms_of
from orthocas.tools.checks import Array
from orthocas.tools.expressions import wrap_shortest

STARTS, BEST, APART = 4000, 8, 0.25


def positions_at(chart: oc.Chart, x: Array, pool: Array) -> Array:
    """Positions of the domain with the task value x (m,) to which damped least squares lead from a pool (S, n)."""
    m, sizes, (low, high) = chart.m, chart.parts.phi_sizes[: chart.m], chart.problem.domain.bounds
    q, wanted = pool.copy(), np.broadcast_to(x, (len(pool), m))
    for _ in range(15):
        e = chart.parts.relative.difference(wanted, chart.x(q)) / sizes
        J = chart.parts.relative.batched_rates(q)[0].reshape(-1, m, chart.n) / sizes[:, None]
        damping = np.where(np.abs(e).max(axis=1) > 0.1, 1e-3, 1e-13)
        gram = J @ J.transpose(0, 2, 1) + damping[:, None, None] * np.eye(m)
        step = (J.transpose(0, 2, 1) @ np.linalg.solve(gram, e[:, :, None]))[:, :, 0]
        q += step * np.minimum(1.0, 0.7 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-300))
    e = chart.parts.relative.difference(wanted, chart.x(q)) / sizes
    turning = ~np.array(chart.problem.robot.tree.prismatic) & np.isfinite(low)
    q[:, turning] = low[turning] + (q[:, turning] - low[turning]) % (2 * np.pi)
    q = q[(np.abs(e).max(axis=1) < 1e-9) & (q >= low).all(axis=1) & (q <= high).all(axis=1)]
    return np.asarray(q[chart.problem.domain.contains(q)])


def least_distance(chart: oc.Chart, wish: Array, x: Array, pool: Array) -> float:
    """The least |xi - xi(wish)| at x (m,) that SciPy's SLSQP finds from the best positions that lie apart.

    Joints without boundaries are also tried a turn to either side of those nearest to the wish.
    """
    m, domain, relative, turns = chart.m, chart.problem.domain, chart.parts.relative, chart.parts.turns[chart.m :]
    xi, q = chart.xi(wish), positions_at(chart, x, pool)
    for joint in np.flatnonzero(~np.isfinite(domain.bounds[0])):
        q[:, joint] = wish[joint] + wrap_shortest(q[:, joint] - wish[joint], np.array(2 * np.pi))
        q = np.concatenate([q + k * 2 * np.pi * np.eye(chart.n)[joint] for k in (-1, 0, 1)])
    q = q[domain.contains(q)] if len(q) else q
    q = q[np.argsort(np.linalg.norm(wrap_shortest(xi - chart.xi(q), turns), axis=1))] if len(q) else q
    symbol = ca.MX.sym("q", chart.n)
    rooms = rooms_of(domain, symbol)
    room, slope = (ca.Function("rooms", [symbol], [part]) for part in (rooms, ca.jacobian(rooms, symbol)))
    sizes, least, chosen = chart.parts.phi_sizes[:m], np.inf, np.zeros((0, chart.n))

    def cost(q: Array) -> tuple[float, Array]:
        left = wrap_shortest(xi - chart.xi(q), turns)
        return left @ left, -2 * chart.jacobian(q)[m:].T @ left

    rules = [
        {
            "type": "eq",
            "fun": lambda q: relative.difference(x[None], chart.x(q)[None])[0] / sizes,
            "jac": lambda q: -relative.batched_rates(q[None])[0].reshape(m, -1) / sizes[:, None],
        },
        {"type": "ineq", "fun": lambda q: np.array(room(q))[:, 0] - 1e-9, "jac": lambda q: np.array(slope(q))},
    ]
    for start in q[:400]:
        if len(chosen) == BEST or least < 1e-7:
            break
        if (np.abs(chosen - start).max(axis=1) > APART).all():
            chosen = np.vstack([chosen, start])
            least = min(least, np.sqrt(cost(start)[0]))
            end = minimize(
                cost,
                start,
                jac=True,
                method="SLSQP",
                bounds=list(zip(*domain.bounds, strict=True)),
                constraints=rules[: 1 + (rooms.numel() > 0)],
                options={"maxiter": 60, "ftol": 1e-14},
            ).x
            end = np.clip(end, *domain.bounds)
            if np.isfinite(end).all() and np.abs(rules[0]["fun"](end)).max() < 1e-8 and domain.contains(end):
                least = min(least, np.sqrt(cost(end)[0]))
    return float(least)
