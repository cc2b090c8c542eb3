"""Coordinates with their own inverse map, as local solvers."""

from dataclasses import dataclass

import numpy as np

from orthocas.checks import Array
from orthocas.coordinates.map import InvertibleMap
from orthocas.inverting.newton import Attempt
from orthocas.inverting.phi_map import PhiMap


@dataclass(frozen=True)
class OwnInverse:
    """The inverse map that belongs to the coordinates; the start selects turns and sheets."""

    coordinates: InvertibleMap
    phi_map: PhiMap

    def __call__(self, targets: Array, starts: Array) -> Attempt:
        """Search from starts (N, n)."""
        q = self.coordinates.inverse(targets, starts).reshape(targets.shape)
        known = np.asarray(np.isfinite(q).all(axis=1))
        q = np.where(known[:, None], q, starts)
        residual = self.phi_map.residual(targets, q)
        residual[~known] = np.inf
        return Attempt(q, residual, np.zeros(len(q), dtype=np.int64), known)
