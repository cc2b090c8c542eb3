"""Linear coordinates: stacks of parallel planes ([AS2023] Sec. 4)."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import casadi as ca
import numpy as np

from orthocas.checks import Array, frozen_array, require_known
from orthocas.errors import InvalidValueError, SingularTaskError
from orthocas.metrics import metric_matrices
from orthocas.parametrisations.family import ClosedForm, JointSpace
from orthocas.parametrisations.product_basis import ProductFamily, product_family
from orthocas.problem import Problem, task_jacobians

Normals = Literal["orthonormal", "paper"]


@dataclass(frozen=True)
class Linear:
    """xi(q) = N^T (q - q0), which is exact only at the base q0 ([AS2023] eq. (21)).

    Args:
        base: q0, (n,) [rad] or [m]. Default: the centre of the domain.
        normals: "orthonormal" for an orthonormal basis of the null space of J_x A^-1, or "paper" for (37) with n = 3,
            m = 1 and (39) with n = 3, m = 2.
    """

    base: tuple[float, ...] | None = None
    normals: Normals = "orthonormal"
    linear: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_known("normals", self.normals, ("orthonormal", "paper"))
        if self.base is not None:
            object.__setattr__(self, "base", tuple(frozen_array("base", self.base, (None,)).tolist()))

    @property
    def label(self) -> str:
        """'linear'."""
        return "linear"

    def for_problem(self, problem: Problem) -> "Linear":
        """The object itself: it does not depend on the problem."""
        return self

    def closed_form(self, problem: Problem) -> ClosedForm:
        """The normals at the base. The coordinates vanish at the base, and keep their unit normals.

        Raises:
            ShapeError: if the base does not have n entries.
            InvalidValueError, SingularTaskError: if the task is singular at the base.
        """
        base = frozen_array("base", problem.domain.centre if self.base is None else self.base, (problem.n,))
        J, A = task_jacobians(problem, base[None])[0], metric_matrices(problem.metric, base[None])[0]
        if not (J**2).sum(axis=1).all():
            raise InvalidValueError("base", base.tolist(), "a joint position where no task gradient vanishes")
        theta = self.normal_vectors(np.linalg.solve(A, J.T).T).ravel()
        return ClosedForm(theta, base, scaled=False)

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Linear functions of q. The parameters are the normals, row by row."""
        terms = tuple(tuple(int(i == k) for i in range(space.n)) for k in range(space.n))

        def displacement(q: Any) -> list[Any]:
            return [q - ca.repmat(ca.DM(space.centre), 1, q.shape[1])]

        return product_family(space, outputs, terms, displacement, lambda i: np.array([[0.0, 0.0], [1.0, 0.0]]))

    def normal_vectors(self, gradients: Array) -> Array:
        """Rows n_j of unit length with n_j . grad_A h_i = 0, (r, n).

        Args:
            gradients: grad_A h_i at the base, (m, n).

        Raises:
            SingularTaskError: if the gradients are linearly dependent at the base.
            InvalidValueError: if normals is "paper" and n is not 3.
        """
        m, n = gradients.shape
        values, vectors = np.linalg.svd(gradients)[1:]
        normals = vectors[m:]
        if values[-1] <= 1e-9 * values[0]:
            raise SingularTaskError("the task is singular at the base of linear coordinates, expected a regular base")
        if self.normals == "orthonormal":
            return normals
        if n != 3:
            raise InvalidValueError("n", n, "3 joints for the paper's normal vectors")
        if m == 2:
            normal = np.cross(gradients[0], gradients[1])  # (39)
            return np.asarray(normal / np.linalg.norm(normal), dtype=float)[None, :]
        v = gradients[0]
        if np.hypot(v[0], v[1]) < 1e-9 * np.linalg.norm(v):
            raise SingularTaskError("the paper's normals (37) need a task gradient with a component along joint 1 or 2")
        n1 = np.array([v[1], -v[0], 0.0]) / np.hypot(v[0], v[1])  # (37a)
        n2 = np.cross(n1, v)  # (37b)
        return np.array([n1, n2 / np.linalg.norm(n2)])
