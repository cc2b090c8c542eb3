"""Lie brackets of the task gradients as CasADi expressions: what keeps the task from having exact coordinates."""

from dataclasses import dataclass

import casadi as ca

from orthocas.batch import dense_function
from orthocas.checks import require_shape
from orthocas.problem import Problem


def lie_bracket(f: ca.SX, g: ca.SX, q: ca.SX) -> ca.SX:
    """Lie bracket [f, g] = (dg/dq) f - (df/dq) g of two vector fields, (n, 1).

    Flowing along f, g, -f, -g for a short time t each ends at q + t^2 [f, g] + O(t^3).

    Args:
        f: vector field, an expression in q, (n, 1).
        g: vector field, an expression in q, (n, 1).
        q: the symbol, (n, 1).

    Raises:
        ShapeError: if a field does not have the shape of q.

    Source:
        Standard; sign as in [L2012].
    """
    require_shape("q", q.shape, (None, 1))
    require_shape("f", f.shape, q.shape)
    require_shape("g", g.shape, q.shape)
    return ca.jtimes(g, q, f) - ca.jtimes(f, q, g)


@dataclass(frozen=True, eq=False)
class TaskBrackets:
    """Brackets of an A-orthonormal basis e_1..e_m of span{grad_A h_i}; U is the Cholesky factor of A = U^T U.

    Source:
        ours, docs/derivations.md#involutivity.
    """

    q: ca.SX  #: the symbol, (n, 1)
    basis: ca.SX  #: columns e_1..e_m, (n, m)
    across: ca.SX  #: U T(e_a, e_b) with T(e_a, e_b) = P [e_a, e_b] in column a m + b, (n, m m)
    defect: ca.SX  #: d = sqrt(sum_{a<b} |T(e_a, e_b)|_A^2)
    size: ca.SX  #: root sum of squares of the terms whose differences are the brackets: what rounding of d scales with

    @classmethod
    def of(cls, problem: Problem) -> "TaskBrackets":
        """Build the expressions; they are NaN where J_x loses rank.

        With A = U^T U and the QR factors U^-T J_x^T = O R, the basis is E = U^-1 O = G R^-1, G = A^-1 J_x^T. Brackets
        across the span depend on the values of the fields only, so R counts as constant: the derivative of e_b along
        e_a is that of G along e_a, times column b of R^-1. P v becomes (I - O O^T) U v.
        """
        q, m = ca.SX.sym("q", problem.n), problem.m
        J = problem.task.jacobian_function(q)
        U = ca.chol(ca.sparsify(problem.metric.function(q)))
        raised = ca.solve(U.T, J.T)
        gradients = ca.solve(U, raised)
        unit, R = ca.qr(raised)
        basis, weights = ca.solve(U, unit), ca.inv(R)
        along = [U @ ca.jtimes(gradients, q, basis[:, a]) @ weights for a in range(m)]
        brackets = [along[a][:, b] - along[b][:, a] for a in range(m) for b in range(m)]
        across = ca.horzcat(*[v - unit @ (unit.T @ v) for v in brackets])
        terms = [ca.sumsqr(along[a][:, b]) for a in range(m) for b in range(m) if a != b]
        return cls(q, basis, across, ca.sqrt(ca.sumsqr(across) / 2), ca.sqrt(sum(terms, ca.SX(0))))

    def defect_function(self) -> ca.Function:
        """Q (n, 1) -> d (1, 1)."""
        return dense_function("involutivity_defect", [self.q], [self.defect])

    def tensor_function(self) -> ca.Function:
        """Q (n, 1) -> across (n, m m), size (1, 1), basis (n, m)."""
        return dense_function("task_brackets", [self.q], [self.across, self.size, self.basis])
