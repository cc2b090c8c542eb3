"""Joint positions of a task value by many starts, without the inverse of the package."""

import numpy as np

import orthocas as oc

STARTS = 4000


def positions_at(chart: oc.Chart, x: np.ndarray, pool: np.ndarray) -> np.ndarray:
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
    q = low + (q - low) % (2 * np.pi)
    q = q[(np.abs(e).max(axis=1) < 1e-9) & (q <= high).all(axis=1)]
    return np.asarray(q[chart.problem.domain.contains(q)])
