"""Families xi = C psi(q) of any basis psi. Gauss-Newton can fit a basis of your own with it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array, require_shape
from orthocas.parametrisations.family import Expression, JointSpace, component_gradients


@dataclass(frozen=True, eq=False)
class BasisFamily:
    """xi_theta(q) = C psi(q), where theta holds the rows of C (r, K) one after the other.

    Args:
        space: the joints.
        outputs: number r of components.
        functions: psi, a map of SX or MX columns q (n, N) to (K, N), column by column. No function may be constant.
    """

    space: JointSpace
    outputs: int
    functions: Callable[[Any], Any]
    as_matrices: bool = False

    @cached_property
    def width(self) -> int:
        """Number of basis functions K."""
        psi = self.functions(ca.SX.sym("q", self.space.n))
        require_shape("the basis psi(q)", psi.shape, (None, 1))
        return int(psi.shape[0])

    @property
    def size(self) -> int:
        """Number of coefficients r K."""
        return self.outputs * self.width

    def basis(self, q: Expression) -> Expression:
        """psi(q), (K, N), for q (n, N)."""
        if isinstance(q, ca.SX) and q.shape[1] == 1:
            return self._of_one(q)
        values: Expression = self.functions(q)
        return values

    @cached_property
    def _of_one(self) -> ca.Function:
        """psi for one joint position: built once, since expressions take longer to build than to copy."""
        q = ca.SX.sym("q", self.space.n)
        return ca.Function("basis", [q], [self.functions(q)])

    def expression(self, q: Expression, theta: Expression) -> Expression:
        """xi_theta(q), (r, N), for q (n, N)."""
        return ca.reshape(theta, self.width, self.outputs).T @ self.basis(q)

    def jacobian(self, q: Expression, theta: Expression) -> list[Expression]:
        """Gradients of the components, r matrices (n, N)."""
        return component_gradients(self.expression(q, theta), q)

    def initial(self, seed: int) -> Array:
        """Random coefficients, (size,)."""
        return np.random.default_rng(seed).normal(size=self.size)

    def reordered(self, theta: Array, order: Sequence[int]) -> Array:
        """The rows of C in another order, (size,)."""
        return theta.reshape(self.outputs, self.width)[list(order)].ravel()

    def combined(self, theta: Array, B: Array) -> Array:
        """Coefficients of B xi, (size,), for a matrix B (r, r)."""
        coefficients: Array = (B @ theta.reshape(self.outputs, self.width)).ravel()
        return coefficients
