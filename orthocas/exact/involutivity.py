"""Involutivity: whether a task has exact orthogonal coordinates, and how large the leak is otherwise."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import casadi as ca
import numpy as np

from orthocas.errors import SingularTaskError
from orthocas.robots.tree import require_driven
from orthocas.tasks.problem import Problem, check, is_regular
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array, require_count, require_kind, require_memory
from orthocas.tools.display import Shown, number_list
from orthocas.tools.json import collect_attributes


@dataclass(frozen=True, slots=True)
class InvolutivityRules:
    """Thresholds of zero defects and of useful estimates."""

    rounding: float = 1e-7  #: defects below this count as zero, relative to the terms that cancel in them
    straight: float = 1e-12  #: [rad]; task gradients that turn less over the domain count as constant
    large: float = 20.0  #: [deg]; above this, the expected leak is beyond the first-order estimate


RULES = InvolutivityRules()


@dataclass(frozen=True, eq=False, repr=False)
class Involutivity(Shown):
    """Involutivity defect d(q) of a task on uniform samples of its domain; see `involutivity`."""

    function: ca.Function  #: q (n, 1) -> d (1, 1); NaN where J_x loses rank
    mean: float
    std: float
    p99: float  #: 99 % quantile
    max: float
    worst_point: tuple[float, ...]  #: the sampled joint position with the largest d [rad] or [m]
    expected_leak_deg: float  #: estimated root mean square leak of good coordinates; compare `Report.leak`
    expected_angle_deg: float  #: this leak per component of an A-orthonormal task basis: expected leak / sqrt(m)
    exact: bool  #: whether d = 0 up to rounding at all samples, so that exact coordinates exist near regular points
    samples: int
    seed: int
    singular_samples: int  #: samples left out: relative singular value of J_x below NEAR_SINGULAR

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        if self.exact:
            return "exact orthogonal coordinates exist locally: the task gradients span an involutive distribution"
        leak = (
            f"about {self.expected_leak_deg:.2g}"
            if self.expected_leak_deg < RULES.large
            else f"more than {RULES.large:g}"
        )
        return (
            f"no exact orthogonal coordinates exist: the mean involutivity defect is {self.mean:.3g}, "
            f"expect coordinates with a leak of {leak} degrees on this domain (rms, in the metric)"
        )

    def facts(self) -> dict[str, str]:
        """The verdict and the numbers behind it."""
        return {
            "involutivity": "exact coordinates exist" if self.exact else "no exact coordinates",
            "verdict": self.verdict,
            "defect": f"mean {self.mean:.3g}, std {self.std:.3g}, 99 % {self.p99:.3g}, max {self.max:.3g}",
            "worst at": number_list(self.worst_point),
            "expected leak": f"{self.expected_leak_deg:.3g} deg rms, in the metric",
            "samples": f"{self.samples}, seed {self.seed}, {self.singular_samples} left out",
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, without the function."""
        return collect_attributes(self, *(part.name for part in fields(self) if part.name != "function"), "verdict")


def involutivity(problem: Problem, samples: int = 2000, seed: int = 1) -> Involutivity:
    """Whether span{grad_A h_i} is involutive, which decides whether exact coordinates exist ([AS2023] Theorem 1).

    The defect is d(q) = sqrt(sum_{a<b} |P [e_a, e_b]|_A^2) for an A-orthonormal basis e_1..e_m of the span and P = I -
    J^#A J_x. It does not depend on the choice of task coordinates, and is 0 for m = 1. Its unit is the inverse of a
    length in the metric: 1/rad for A = I and revolute joints, 1/(sqrt(kg) m) for A = M. A defect below 1e-7 of the
    terms that cancel in it counts as zero.

    The expected leak is d times the size of the domain along the span; no constant is fitted. To first order in that
    size, it is the root mean square leak of quadratic coordinates that `evaluate` reports, which is an angle in the
    metric. The paper's task angles use Euclidean norms and can be several times smaller. Rich families come within a
    factor of two of the estimate (examples/involutivity.py). Exact coordinates exist only locally: none covers a closed
    self-motion manifold.

    Args:
        problem: robot, task, metric and domain.
        samples: number of uniform samples of the domain.
        seed: seed of the samples.

    Raises:
        SingularTaskError: if the task is singular at all samples, or not twice differentiable at one.
        MetricError: if A is not symmetric positive definite at a sample.

    Source:
        Theorem: [AS2023] Sec. 3. Defect and expected leak: ours, docs/explanation/derivations_exact.md#involutivity.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> oc.involutivity(problems.get("planar_3r_x"), samples=200).exact
        True
        >>> oc.involutivity(problems.get("planar_3r_xy"), samples=200).exact
        False
    """
    samples, seed = require_count("samples", samples), require_count("seed", seed, least=0)
    require_kind("problem", problem, Problem)
    require_driven("involutivity", problem.robot.tree)
    require_memory(f"{samples} samples of the defect", 32.0 * samples * problem.n * problem.m**2)
    # Take uniform samples of the domain except the near-singular ones.
    check(problem, samples, seed)
    points = sample_uniform(problem.domain, samples, seed)
    points = points[is_regular(problem, points)]
    if not len(points):
        raise SingularTaskError(f"task '{problem.task.name}' is near-singular at all {samples} samples of the domain")
    # Evaluate brackets across the span at all samples, and the scale of the terms that cancel in them.
    brackets = TaskBrackets.build(problem)
    across, size, basis = Batched(brackets.build_tensor_function())(points)
    T = across.reshape(-1, problem.n, problem.m, problem.m)
    d = np.sqrt((T**2).sum(axis=(1, 2, 3)) / 2)
    if not np.isfinite(d).all():
        at = np.round(points[np.flatnonzero(~np.isfinite(d))[0]], 4).tolist()
        raise SingularTaskError(f"the second derivative of task '{problem.task.name}' is not finite at q = {at}")
    # Convert the defect over the domain to an angle.
    turns = _compute_squared_turns(T, basis.reshape(-1, problem.n, problem.m), problem.domain.half_width)
    leak = float(np.degrees(np.sqrt(turns.mean() / problem.r)))
    worst = int(np.argmax(d))
    return Involutivity(
        function=brackets.build_defect_function(),
        mean=float(d.mean()),
        std=float(d.std()),
        p99=float(np.quantile(d, 0.99)),
        max=float(d[worst]),
        worst_point=tuple(points[worst].tolist()),
        expected_leak_deg=leak,
        expected_angle_deg=leak / problem.m**0.5,
        exact=bool(np.all((d <= RULES.rounding * size[:, 0]) | (turns <= RULES.straight**2))),
        samples=samples,
        seed=seed,
        singular_samples=samples - len(points),
    )


def _compute_squared_turns(T: Array, basis: Array, half_width: Array) -> Array:
    """Sum over pairs of |T(e_a, e_b)|_A^2 / (k_a + k_b) [rad^2], (N,).

    The basis is rotated within the span so that it also diagonalises C^-1, where C = diag(half_width^2 / 3) is the
    covariance of the domain, and k_a = e_a^T C^-1 e_a.

    Args:
        T: P [e_a, e_b] in coordinates where A = I, (N, n, m, m).
        basis: columns e_1..e_m, (N, n, m).
        half_width: half-widths of the domain, (n,).
    """
    # In the rotated basis, both the metric and C^-1 are diagonal.
    k, V = np.linalg.eigh(basis.transpose(0, 2, 1) @ (3 / half_width[:, None] ** 2 * basis))
    turned = V.transpose(0, 2, 1)[:, None] @ T @ V[:, None]
    squared = (turned**2).sum(axis=1) / (k[:, :, None] + k[:, None, :])
    return np.asarray(squared.sum(axis=(1, 2)) / 2)


@dataclass(frozen=True, eq=False)
class TaskBrackets:
    """Brackets of an A-orthonormal basis e_1..e_m of span{grad_A h_i}; U is the Cholesky factor of A = U^T U.

    Source:
        ours, docs/explanation/derivations_exact.md#involutivity.
    """

    q: ca.SX  #: the symbol, (n, 1)
    basis: ca.SX  #: columns e_1..e_m, (n, m)
    across: ca.SX  #: U T(e_a, e_b) with T(e_a, e_b) = P [e_a, e_b] in column a m + b, (n, m m)
    defect: ca.SX  #: d = sqrt(sum_{a<b} |T(e_a, e_b)|_A^2)
    size: ca.SX  #: root sum of squares of the terms that cancel in the brackets, which sets the rounding error of d

    @classmethod
    def build(cls, problem: Problem) -> TaskBrackets:
        """Build the expressions, which are NaN where J_x loses rank.

        With A = U^T U and the QR factors U^-T J_x^T = O R, the basis is E = U^-1 O = G R^-1, G = A^-1 J_x^T. Brackets
        across the span depend only on the values of the fields, so R can be treated as constant: the derivative of e_b
        along e_a is that of G along e_a, times column b of R^-1. In these terms P v is (I - O O^T) U v.
        """
        q, m = ca.SX.sym("q", problem.n), problem.m
        # Gradients G = A^-1 J^T, and an orthonormal basis of their span from U^-T J^T = O R.
        J = problem.task.jacobian_function(q)
        U = ca.chol(ca.sparsify(problem.metric.function(q)))
        duals = ca.solve(U.T, J.T)
        gradients = ca.solve(U, duals)
        unit, R = ca.qr(duals)
        basis, weights = ca.solve(U, unit), ca.inv(R)
        # Derivatives of the fields along each other, their brackets, and the components across the span.
        along = [U @ ca.jtimes(gradients, q, basis[:, a]) @ weights for a in range(m)]
        brackets = [along[a][:, b] - along[b][:, a] for a in range(m) for b in range(m)]
        across = ca.horzcat(*[v - unit @ (unit.T @ v) for v in brackets])
        terms = [ca.sumsqr(along[a][:, b]) for a in range(m) for b in range(m) if a != b]
        return cls(q, basis, across, ca.sqrt(ca.sumsqr(across) / 2), ca.sqrt(sum(terms, ca.SX(0))))

    def build_defect_function(self) -> ca.Function:
        """q (n, 1) -> d (1, 1)."""
        return dense_function("involutivity_defect", [self.q], [self.defect])

    def build_tensor_function(self) -> ca.Function:
        """q (n, 1) -> across (n, m m), size (1, 1), basis (n, m)."""
        return dense_function("task_brackets", [self.q], [self.across, self.size, self.basis])
