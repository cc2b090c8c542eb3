"""The polynomials of all charts of an atlas, on the cube [-1, 1]^n that every box is scaled to (ours)."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from orthocas.casadi_tools.blocks import BlockFunction, fill
from orthocas.casadi_tools.cached import cached_property
from orthocas.casadi_tools.columns import ColumnFunction
from orthocas.checks import Array
from orthocas.fitting.product_gradients import ProductGradients
from orthocas.parametrisations import JointSpace, Polynomial, ProductFamily


@dataclass(frozen=True, eq=False)
class CubeBasis:
    """psi(u) on the cube. Compiled once, it serves all boxes: dpsi/dq_i = dpsi/du_i / half_width_i."""

    degree: int
    names: tuple[str, ...]  #: of the joints
    cyclic: tuple[str, ...]  #: names of joints with a linear term only
    outputs: int

    @cached_property
    def family(self) -> ProductFamily:
        """The family of polynomials on the cube."""
        n = len(self.names)
        space = JointSpace(np.zeros(n), np.ones(n), (False,) * n, self.names)
        return Polynomial(self.degree, self.cyclic).family(space, self.outputs)

    @property
    def width(self) -> int:
        """Number of terms K."""
        return self.family.width

    @cached_property
    def gradients(self) -> ProductGradients:
        """dpsi/du."""
        return ProductGradients(self.family, len(self.names))

    def values(self, u: Array) -> Array:
        """psi(u), (N, K), at points (N, n)."""
        results = np.empty((len(u), self.width))
        fill(results, u, self._make_values)
        return results

    def slopes(self, u: Array) -> Array:
        """dpsi/du, (N, n, K), at points (N, n)."""
        return self.gradients.dense(self.gradients.at(u), len(u))

    @cached_property
    def exponents(self) -> Array:
        """Degree of every term in every joint, (K, n)."""
        return np.array(self.family.terms, dtype=float)

    @cached_property
    def linear_terms(self) -> list[int]:
        """Places of the terms sqrt(3) u_i, (n,)."""
        n = len(self.names)
        return [self.family.terms.index(tuple(int(i == k) for i in range(n))) for k in range(n)]

    @cached_property
    def _columns(self) -> ColumnFunction:
        u = ca.SX.sym("u", len(self.names))
        return ColumnFunction(ca.Function("cube_basis", [u], [ca.densify(self.family.basis(u))]))

    def _make_values(self) -> BlockFunction:
        run = self._columns.on_one_block()
        return lambda columns: run(columns)[0]
