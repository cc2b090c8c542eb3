"""Values of many charts of an atlas at once."""

from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import numpy as np

from orthocas.atlas.atlas_file import Turns
from orthocas.atlas.box_fit import CubeBasis
from orthocas.atlas.index import Index
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, Indices

_PIECE = 4096  # joint positions at once


@dataclass(frozen=True, eq=False)
class Evaluation:
    """xi and J_xi of joint positions in given charts; numbers of charts are read from the file when they are needed."""

    index: Index
    turns: Turns | None
    _lock: Any = field(default_factory=Lock, repr=False)

    def xi(self, q: Array, charts: Indices) -> Array:
        """Coordinates (N, r) of positions (N, n) in charts (N,)."""
        plan = self.index.plan
        found = np.empty((len(q), plan.problem.r))
        for start in range(0, len(q), _PIECE):
            part = slice(start, start + _PIECE)
            u, numbers, _ = self._on_cube(q[part], charts[part])
            values = np.einsum("njk,nk->nj", numbers[:, :, 1:], self.basis.values(u)) + numbers[:, :, 0]
            found[part, : plan.fitted] = self.turned(values, charts[part], constants=True)
        idle = list(plan.idle)
        found[:, plan.fitted :] = q[:, idle] - plan.problem.domain.centre[idle]
        return found

    def jacobian(self, q: Array, charts: Indices) -> Array:
        """J_xi (N, r, n) of positions (N, n) in charts (N,)."""
        plan = self.index.plan
        active = list(plan.active)
        found = np.zeros((len(q), plan.problem.r, plan.problem.n))
        for start in range(0, len(q), _PIECE):
            part = slice(start, start + _PIECE)
            u, numbers, scale = self._on_cube(q[part], charts[part])
            slopes = self.basis.slopes(u) * scale[:, :, None]  # (N, n, K)
            J = (slopes @ numbers[:, :, 1:].transpose(0, 2, 1)).transpose(0, 2, 1)
            found[part, : plan.fitted, active] = self.turned(J, charts[part])
        for row, joint in enumerate(plan.idle):
            found[:, plan.fitted + row, joint] = 1.0
        return found

    def turned(self, values: Array, charts: Indices, constants: bool = False) -> Array:
        """Values (N, fitted, ...) of a chart's own coordinates, in the common order and signs."""
        if self.turns is None:
            return values
        shape = (*values.shape[:2], *(1,) * (values.ndim - 2))
        order, signs = self.turns.order[charts].reshape(shape), self.turns.signs[charts].reshape(shape)
        turned = np.take_along_axis(values, order, axis=1) * signs
        return turned + self.turns.constants[charts] if constants else turned

    def numbers(self, fitted: Indices) -> Array:
        """Numbers of fitted charts, (N, fitted coordinates, 1 + K)."""
        store, known = self._store
        with self._lock:
            missing = np.unique(fitted[~known[fitted]])
            if missing.size:
                store[missing] = self.index.stock.numbers(missing)
                known[missing] = True
        return np.asarray(store[fitted])

    @cached_property
    def basis(self) -> CubeBasis:
        """The polynomials."""
        plan = self.index.plan
        names = tuple(plan.problem.robot.joint_names[i] for i in plan.active)
        return CubeBasis(plan.settings.degree, names, plan.cyclic_names, plan.fitted)

    def _on_cube(self, q: Array, charts: Indices) -> tuple[Array, Array, Array]:
        """u in the charts' boxes, their numbers, and du/dq, for all active joints."""
        index, plan = self.index, self.index.plan
        fitted = index.rows(charts)[1]
        signs, domain = index.map_signs(charts), plan.problem.domain
        u, scale = np.empty((len(q), len(plan.active))), np.empty((len(q), len(plan.active)))
        divided, cyclic = ([plan.active.index(i) for i in joints] for joints in (plan.joints, plan.cyclic))
        u[:, divided] = index.on_cube(q[:, list(plan.joints)], charts)
        scale[:, divided] = signs[:, divided] / index.box_half_widths[fitted]
        joints = list(plan.cyclic)
        u[:, cyclic] = signs[:, cyclic] * (q[:, joints] - domain.centre[joints]) / domain.half_width[joints]
        scale[:, cyclic] = signs[:, cyclic] / domain.half_width[joints]
        return u, self.numbers(fitted), scale

    @cached_property
    def _store(self) -> tuple[Array, Any]:
        """Numbers of all fitted charts, of which those are valid that are known; memory is taken when it is filled."""
        plan, count = self.index.plan, len(self.index.stock.charts)
        return np.empty((count, plan.fitted, 1 + self.basis.width)), np.zeros(count, dtype=bool)
