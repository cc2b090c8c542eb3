"""Smooth weights of the charts around a joint position: a partition of unity over overlapping boxes (ours)."""

from dataclasses import dataclass, field

import numpy as np

from orthocas.atlases.index import Index
from orthocas.casadi_tools.cached import building, cached_property
from orthocas.checks import Array, Indices

_KEPT = 64  # lists of neighbours


@dataclass(frozen=True, eq=False)
class Blend:
    """w_k(q) = b_k / sum_j b_j, b_k = prod_i s((1 - |u_i|) / (1 - u_0)), with u on the cube of the box of chart k.

    s rises from s(0) = 0 to s(1) = 1 with two continuous derivatives, s(t) = 6 t^5 - 15 t^4 + 10 t^3. It is 1 where the
    box does not reach into its neighbours of the same size: |u| <= u_0 = (1 - overlap) / (1 + overlap). So w_k is twice
    continuously differentiable inside the union of the boxes, away from its border.
    """

    index: Index
    _neighbours: dict[int, Indices] = field(default_factory=dict)

    def at(self, q: Array, near: int) -> tuple[Indices, Array, Array]:
        """Charts whose boxes hold a position (n,), their weights (K,), and the gradients of the weights (K, n).

        Args:
            q: the position.
            near: one of these charts.
        """
        index, joints = self.index, list(self.index.plan.joints)
        charts = self._around(near)
        points = np.repeat(q[None, joints], len(charts), axis=0)
        u = index.on_cube(points, charts)
        inside = np.flatnonzero((np.abs(u) < 1).all(axis=1))
        if not inside.size:
            return np.array([near]), np.ones(1), np.zeros((1, len(q)))
        charts, u = charts[inside], u[inside]
        values, slopes = self._bumps(u)
        bumps = values.prod(axis=1)
        rising = bumps[:, None] * slopes / np.maximum(values, 1e-300)
        rising *= np.sign(u) * self._signs[charts] / index.box_half_widths[index.rows(charts)[1]]
        gradients = np.zeros((len(charts), len(q)))
        gradients[:, joints] = rising
        total = bumps.sum()
        weights = bumps / total
        return charts, weights, (gradients - weights[:, None] * gradients.sum(axis=0)) / total

    def _bumps(self, u: Array) -> tuple[Array, Array]:
        """s and ds/d|u| for each joint."""
        overlap = self.index.plan.settings.overlap
        width = 2 * overlap / (1 + overlap)
        t = np.minimum((1 - np.abs(u)) / width, 1.0)
        return t**3 * (t * (6 * t - 15) + 10), -30 * t**2 * (t - 1) ** 2 / width

    def _around(self, near: int) -> Indices:
        """Charts whose boxes meet that of a chart, itself included."""
        known = self._neighbours.get(near)
        if known is None:
            lattice = self.index.plan.lattice
            apart = self._centres - self._centres[near]
            apart -= np.where(lattice.endless, 2 * np.pi * np.round(apart / (2 * np.pi)), 0.0)
            known = np.flatnonzero((np.abs(apart) <= self._half_widths + self._half_widths[near]).all(axis=1))
            with building:  # threads may share the blend
                while len(self._neighbours) >= _KEPT:
                    self._neighbours.pop(next(iter(self._neighbours)))
                self._neighbours[near] = known
        return known

    @cached_property
    def _centres(self) -> Array:
        return self.index.image_centres(np.arange(self.index.count))[0]

    @cached_property
    def _signs(self) -> Array:
        return self.index.image_centres(np.arange(self.index.count))[1]

    @cached_property
    def _half_widths(self) -> Array:
        return np.asarray(self.index.box_half_widths[self.index.rows(np.arange(self.index.count))[1]])
