"""Joint positions for task values and coordinates, each in its own chart of an atlas (ours)."""

import numpy as np

from orthocas.atlases.evaluation import Evaluation
from orthocas.checks import Array, Indices
from orthocas.inverting.newton import Newton
from orthocas.inverting.phi_map import PhiMap, largest

_ACCEPTED = 1e-10  # [m], [rad] and units of xi


def inverse_in_charts(evaluation: Evaluation, phi: Array, charts: Indices, starts: Array) -> Array:
    """Solve (h, xi_k)(q) = phi near given joint positions, in chart k of each row.

    Args:
        evaluation: coordinates of the atlas.
        phi: task values and coordinates, (N, n).
        charts: the chart of each row, (N,); -1 for none.
        starts: joint positions, (N, n).

    Returns:
        q, (N, n); NaN where Newton's method fails, or leads out of the box of the chart.
    """
    index, found = evaluation.index, np.full_like(starts, np.nan)
    good = (charts >= 0) & np.isfinite(phi).all(axis=1) & np.isfinite(starts).all(axis=1)
    for chart in np.unique(charts[good]).tolist():
        rows = np.flatnonzero(good & (charts == chart))
        search = Newton(_phi_map(evaluation, chart))(phi[rows], starts[rows])
        found[rows] = np.where((largest(search.residual) < _ACCEPTED)[:, None], search.q, np.nan)
    solved = np.flatnonzero(np.isfinite(found).all(axis=1))
    inside = index.in_boxes(found[solved][:, list(index.plan.joints)], charts[solved])
    found[solved[~inside]] = np.nan
    return found


def _phi_map(evaluation: Evaluation, chart: int) -> PhiMap:
    """(h, xi) in one chart."""
    task = evaluation.index.plan.problem.task

    def charts(q: Array) -> Indices:
        return np.full(len(q), chart)

    def phi(q: Array) -> Array:
        return np.hstack([task.batched(q)[0], evaluation.xi(q, charts(q))])

    def jacobian(q: Array) -> Array:
        J_x = task.batched_jacobian(q)[0].reshape(len(q), task.m, -1)
        return np.concatenate([J_x, evaluation.jacobian(q, charts(q))], axis=1)

    n = evaluation.index.plan.problem.n
    return PhiMap(phi, jacobian, np.ones(n), np.zeros(n))
