"""Bases of products of one-joint functions: polynomials, Fourier terms, and linear coordinates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from math import comb, sqrt
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.bases.cyclic import resolved
from orthocas.bases.family import BasisFamily, ClosedForm, Cyclic, JointSpace, check_joint_names, indices, suffix
from orthocas.errors import InvalidValueError, SingularTaskError
from orthocas.tasks.problem import Problem
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, freeze_array, require_count, require_known

JOINTS = "joints"  #: word in labels for the largest number of joints in a product
Term = tuple[int, ...]  #: for each joint, the index of its one-joint function; 0 is the constant 1


@dataclass(frozen=True, eq=False, kw_only=True)
class ProductFamily(BasisFamily):
    """psi_k(q) = prod_i f_i,k_i(q_i) over the joints. Use `build_product_family` to build one.

    Derivatives of terms are sums of terms. So for each term, the family also contains the terms of its derivatives.
    """

    terms: tuple[Term, ...]
    one_joint_derivatives: Callable[[int], Array]  #: joint i -> D with f_i,a' = sum_b D_ab f_i,b

    @property
    def width(self) -> int:
        """Number of terms K."""
        return len(self.terms)

    def initial(self, seed: int) -> Array:
        """Random coefficients that decrease with the degree, (size,)."""
        order = np.array([np.count_nonzero(term) for term in self.terms])
        C = np.random.default_rng(seed).normal(size=(self.outputs, len(self.terms))) * 0.3**order
        return C.ravel()

    def embed(self, theta: Array, coarser: ProductFamily) -> Array:
        """Convert coefficients of a smaller basis to this one, (size,)."""
        place = {term: k for k, term in enumerate(self.terms)}
        wide = np.zeros((self.outputs, self.width))
        wide[:, [place[term] for term in coarser.terms]] = theta.reshape(self.outputs, coarser.width)
        return wide.ravel()

    @cached_property
    def derivatives(self) -> list[tuple[Array, NDArray[np.int_], NDArray[np.int_]]]:
        """Entries of D_i with d (1, psi) / d q_i = D_i (1, psi): values, rows and columns for every joint."""
        # The derivative of a term replaces one factor, so it is a sum of terms.
        terms = ((0,) * self.space.n, *self.terms)
        places = {term: k for k, term in enumerate(terms)}
        found = []
        for i in range(self.space.n):
            D = self.one_joint_derivatives(i)
            parts = [np.flatnonzero(row).tolist() for row in D]
            entries = [
                (k, places[(*term[:i], b, *term[i + 1 :])], D[term[i], b])
                for k, term in enumerate(terms)
                for b in parts[term[i]]
            ]
            rows, columns, values = np.array(entries, dtype=float).reshape(-1, 3).T
            found.append((values, rows.astype(int), columns.astype(int)))
        return found

    def build_derivative_matrix(self, joint: int) -> Any:
        """D_i as a sparse matrix, (1 + K, 1 + K)."""
        values, rows, columns = self.derivatives[joint]
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(1 + self.width,) * 2)

    def derivative_tables(self, theta: Array) -> Array:
        """C_i with d xi / d q_i = C_i (1, psi), (n, r, 1 + K)."""
        C = np.hstack([np.zeros((self.outputs, 1)), theta.reshape(self.outputs, self.width)])
        tables = np.zeros((self.space.n, self.outputs, 1 + self.width))
        for table, (values, rows, columns) in zip(tables, self.derivatives, strict=True):
            np.add.at(table.T, columns, (C[:, rows] * values).T)
        return tables


def build_product_family(
    space: JointSpace,
    outputs: int,
    terms: tuple[Term, ...],
    one_joint_functions: Callable[[Any], list[Any]],
    one_joint_derivatives: Callable[[int], Array],
) -> ProductFamily:
    """Build the family of the given terms.

    Args:
        space: the joints.
        outputs: number of components.
        terms: the terms. None is constant, and the terms of their derivatives are included.
        one_joint_functions: f_1, f_2, ... of all joints at once, (n, N) each, for q (n, N).
        one_joint_derivatives: D of joint i, with f_i,a' = sum_b D_ab f_i,b.
    """

    def basis(q: Any) -> Any:
        # The terms and their leading parts, grouped by number of factors.
        by_factors: dict[int, list[Term]] = {}
        for term in sorted(with_parts(terms)):
            by_factors.setdefault(len(term) - term.count(0), []).append(term)
        # Compute all terms with equally many factors in one product of columns. One by one, CasADi takes ten times as
        # long.
        factors, n = ca.vertcat(*one_joint_functions(q)), len(terms[0])
        levels: list[Any] = []
        rows: list[dict[Term, int]] = []
        for _, level in sorted(by_factors.items()):
            parts = [split(term) for term in level]
            values = factors[[n * (index - 1) + joint for _, joint, index in parts], :]
            levels.append(levels[-1][[rows[-1][rest] for rest, *_ in parts], :] * values if levels else values)
            rows.append({term: k for k, term in enumerate(level)})
        places = {term: k for k, term in enumerate(term for level in rows for term in level)}
        return ca.vertcat(*levels)[[places[term] for term in terms], :]

    return ProductFamily(space, outputs, basis, terms=terms, one_joint_derivatives=one_joint_derivatives)


def with_parts(terms: Iterable[Term]) -> set[Term]:
    """The terms, and the shorter products that remain after removing last factors."""
    found: set[Term] = set()
    waiting = list(terms)
    while waiting:
        term = waiting.pop()
        if any(term) and term not in found:
            found.add(term)
            waiting.append(split(term)[0])
    return found


def split(term: Term) -> tuple[Term, int, int]:
    """A term without its last factor, the joint of this factor, and the index of its function."""
    joint = len(term) - 1
    while not term[joint]:
        joint -= 1
    return (*term[:joint], 0, *term[joint + 1 :]), joint, term[joint]


def reduce_terms(
    degrees: list[list[int]], total: int, linear: list[int], joints: int | None = None
) -> tuple[Term, ...]:
    """Terms of `list_terms` without the joints `linear`, then a linear term for each of these joints."""
    kept = [[0] if k in linear else own for k, own in enumerate(degrees)]
    return (*list_terms(kept, total, joints), *(tuple(int(i == k) for i in range(len(degrees))) for k in linear))


def list_terms(degrees: list[list[int]], total: int, joints: int | None = None) -> Iterator[Term]:
    """All non-constant choices of one function per joint whose degrees add up to at most `total`.

    Args:
        degrees: the degrees of the functions of every joint. The first is 0.
        total: largest sum of degrees.
        joints: largest number of joints in a term. Default: all.
    """

    def extend(prefix: Term, left: int, others: int) -> Iterator[Term]:
        if len(prefix) == len(degrees):
            if any(prefix):
                yield prefix
            return
        # Go joint by joint, with the remaining degree and number of factors.
        for k, degree in enumerate(degrees[len(prefix)]):
            if degree <= left and (others or not k):
                yield from extend((*prefix, k), left - degree, others - (k > 0))

    return extend((), total, len(degrees) if joints is None else joints)


@dataclass(frozen=True)
class Products:
    """The common part of `Polynomial` and `Fourier`: products of one-joint functions of a total degree."""

    degree: int
    cyclic: Cyclic = ()
    # Charts without these settings keep their fingerprints.
    joints: int | None = field(default=None, metadata={"stored": "if given"})
    without: tuple[str, ...] = field(default=(), metadata={"stored": "if given"})
    linear = True
    closed_form = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", require_count("degree", self.degree))
        cyclic, without = check_joint_names(self.cyclic, self.without)
        object.__setattr__(self, "cyclic", cyclic)
        object.__setattr__(self, "without", without)
        if self.joints is not None:
            object.__setattr__(self, "joints", require_count("joints", self.joints))

    def for_problem(self, problem: Problem) -> Self:
        """The parametrisation with `cyclic="auto"` replaced by the names of the problem's cyclic joints."""
        return replace(self, cyclic=resolved(self.cyclic, problem)) if self.cyclic else self

    def of_degree(self, degree: int) -> Self:
        """The same parametrisation with another degree."""
        return replace(self, degree=degree)

    @property
    def _settings(self) -> str:
        """The label after its name: 'DEGREE', with the largest number of joints and the special joints if given."""
        most = "" if self.joints is None else f":{JOINTS}={self.joints}"
        return f"{self.degree}{most}{suffix(self.cyclic, self.without)}"

    def _count_terms(self, n: int, functions: int) -> int:
        """Sum over j of C(n, j) C(d, j) f^j without the constant, with f functions per degree and joint."""
        n -= len(self.without)
        # "auto" counts as no joint until it is resolved.
        linear = 0 if self.cyclic == "auto" else min(n, len(self.cyclic))
        most = min(n - linear, self.degree, self.degree if self.joints is None else self.joints)
        terms: int = sum(comb(n - linear, j) * comb(self.degree, j) * functions**j for j in range(1, most + 1))
        return terms + linear


@dataclass(frozen=True)
class Polynomial(Products):
    """Products of Legendre polynomials of total degree <= degree, orthonormal for the uniform density on the box.

    Args:
        degree: total degree, >= 1.
        cyclic: names of joints with one linear term each, or "auto" for all cyclic joints of the problem. Charts are
            then valid for all positions of these joints; see `orthocas.bases.cyclic_joints`.
        joints: largest number of joints in one product, >= 1. Default: all. With 2, terms of three or more joints are
            left out. For many joints these are most of the terms, and they gain little.
        without: names of joints that coordinates do not depend on, such as the last joint under a pose: xi then stays
            the same while the tool turns about its own axis.

    Example:
        >>> import orthocas as oc
        >>> polynomial = oc.Polynomial(degree=4)
        >>> polynomial.label, polynomial.term_count(7)
        ('polynomial:4', 329)
        >>> oc.Polynomial(degree=4, cyclic=["A1"]).term_count(7)
        210
        >>> oc.Polynomial(degree=4, joints=2).term_count(7)
        154
    """

    @property
    def label(self) -> str:
        """'polynomial:DEGREE', with most joints of a product and cyclic joints if there are any."""
        return f"polynomial:{self._settings}"

    def term_count(self, n: int) -> int:
        """C(n + d, d) - 1 for the n joints that are not cyclic, plus one term per cyclic joint."""
        return self._count_terms(n, 1)

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Polynomials in u_i = (q_i - centre_i) / half_width_i."""

        # Legendre polynomials by recursion, of length 1 over the domain.
        def legendre(q: Any) -> list[Any]:
            centre, half_width = (ca.repmat(ca.DM(v), 1, q.shape[1]) for v in (space.centre, space.half_width))
            u = (q - centre) / half_width
            P = [1 + 0 * u, u]
            for k in range(2, self.degree + 1):
                P.append(((2 * k - 1) * u * P[k - 1] - (k - 1) * P[k - 2]) / k)
            return [sqrt(2 * k + 1) * P[k] for k in range(1, self.degree + 1)]

        def derivatives(i: int) -> Array:
            """P_a' = sum of (2 b + 1) P_b over b = a - 1, a - 3, ..., converted to normalised polynomials."""
            a, b = np.indices((self.degree + 1, self.degree + 1))
            values: Array = np.sqrt((2 * a + 1) * (2 * b + 1)) * ((a > b) & ((a - b) % 2 == 1)) / space.half_width[i]
            return values

        # Degrees of the functions of each joint, then all products up to the total degree.
        none = indices(self.without, space)
        degrees = [[0] if i in none else list(range(self.degree + 1)) for i in range(space.n)]
        terms = reduce_terms(degrees, self.degree, indices(self.cyclic, space), self.joints)
        return build_product_family(space, outputs, terms, legendre, derivatives)


@dataclass(frozen=True)
class Fourier(Products):
    """Products of sqrt(2) cos(k q_i) and sqrt(2) sin(k q_i) of total degree <= degree, periodic in every joint.

    Args:
        degree: total degree, >= 1.
        cyclic: names of joints with one linear term each instead of sines and cosines, or "auto" for all cyclic joints
            of the problem; see `orthocas.bases.cyclic_joints`.
        joints: largest number of joints in one product, >= 1. Default: all.
        without: names of joints that coordinates do not depend on.

    Example:
        >>> import orthocas as oc
        >>> fourier = oc.Fourier(degree=2)
        >>> fourier.label, fourier.term_count(3)
        ('fourier:2', 24)
    """

    @property
    def label(self) -> str:
        """'fourier:DEGREE', with most joints of a product and cyclic joints if there are any."""
        return f"fourier:{self._settings}"

    def term_count(self, n: int) -> int:
        """Sum over j of C(n, j) C(d, j) 2^j without the constant, n joints not cyclic; plus one per cyclic joint."""
        return self._count_terms(n, 2)

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Fourier terms of the joint angles.

        Raises:
            InvalidValueError: if a joint is prismatic. The message names it.
        """
        if any(space.prismatic):
            name = space.joint_names[space.prismatic.index(True)]
            raise InvalidValueError(
                f"joint '{name}' of a Fourier basis", "prismatic", "a revolute joint; use polynomial instead"
            )
        linear = indices(self.cyclic, space)

        # Waves of length 1; a cyclic joint has a linear function as its first one.
        def waves(q: Any) -> list[Any]:
            out = [sqrt(2) * wave(k * q) for k in range(1, self.degree + 1) for wave in (ca.cos, ca.sin)]
            rows = (q[i, :] - space.centre[i] if i in linear else out[0][i, :] for i in range(space.n))
            return [ca.vertcat(*rows), *out[1:]]

        def derivatives(i: int) -> Array:
            """cos(k q)' = -k sin(k q), sin(k q)' = k cos(k q); a linear function has the derivative 1."""
            if i in linear:
                return np.array([[0.0, 0.0], [1.0, 0.0]])
            D = np.zeros((2 * self.degree + 1,) * 2)
            for k in range(1, self.degree + 1):
                D[2 * k - 1, 2 * k], D[2 * k, 2 * k - 1] = -k, k
            return D

        # Degrees of the functions of each joint, then all products up to the total degree.
        none = indices(self.without, space)
        of_joint = [0, *(k for k in range(1, self.degree + 1) for _ in range(2))]
        degrees = [[0] if i in none else of_joint for i in range(space.n)]
        terms = reduce_terms(degrees, self.degree, linear, self.joints)
        return build_product_family(space, outputs, terms, waves, derivatives)


Normals = Literal["orthonormal", "paper"]


@dataclass(frozen=True)
class Linear:
    """xi(q) = N^T (q - q0), which is exact only at the base q0 ([AS2023] eq. (21)).

    Args:
        base: q0, (n,) [rad] or [m]. Default: the centre of the domain.
        normals: "orthonormal" for an orthonormal basis of the null space of J_x A^-1, or "paper" for the vectors of
            (37) with n = 3, m = 1 and of (39) with n = 3, m = 2.
    """

    base: tuple[float, ...] | None = None
    normals: Normals = "orthonormal"
    linear = True

    def __post_init__(self) -> None:
        require_known("normals", self.normals, ("orthonormal", "paper"))
        if self.base is not None:
            object.__setattr__(self, "base", tuple(freeze_array("base", self.base, (None,)).tolist()))

    @property
    def label(self) -> str:
        """'linear'."""
        return "linear"

    def for_problem(self, problem: Problem) -> Linear:
        """The same object: it does not depend on the problem."""
        return self

    def closed_form(self, problem: Problem) -> ClosedForm:
        """The normals at the base as parameters. The coordinates are zero at the base, and are not rescaled.

        Raises:
            ShapeError: if the base does not have n entries.
            InvalidValueError, SingularTaskError: if the task is singular at the base.
        """
        base = freeze_array("base", problem.domain.centre if self.base is None else self.base, (problem.n,))
        J, A = problem.task.evaluate_jacobian(base[None])[0], problem.metric.evaluate(base[None])[0]
        if not (J**2).sum(axis=1).all():
            raise InvalidValueError("base", base.tolist(), "a joint position where no task gradient vanishes")
        theta = self.normal_vectors(np.linalg.solve(A, J.T).T).ravel()
        return ClosedForm(theta, base, scaled=False)

    def family(self, space: JointSpace, outputs: int) -> ProductFamily:
        """Linear functions of q. The parameters are the normals, row by row."""
        terms = tuple(tuple(int(i == k) for i in range(space.n)) for k in range(space.n))

        def displacement(q: Any) -> list[Any]:
            return [q - ca.repmat(ca.DM(space.centre), 1, q.shape[1])]

        return build_product_family(space, outputs, terms, displacement, lambda i: np.array([[0.0, 0.0], [1.0, 0.0]]))

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
        # The paper's vectors are not orthonormal, and exist for three joints only.
        if n != 3:
            raise InvalidValueError("n", n, "3 joints for the paper's normal vectors")
        if m == 2:
            normal = np.cross(gradients[0], gradients[1])  # (39)
            return np.asarray(normal / np.linalg.norm(normal), dtype=float)[None, :]
        v = gradients[0]
        if np.hypot(v[0], v[1]) < 1e-9 * np.linalg.norm(v):
            raise SingularTaskError(
                "the paper's normals (37) require a task gradient with a component along joint 1 or 2"
            )
        n1 = np.array([v[1], -v[0], 0.0]) / np.hypot(v[0], v[1])  # (37a)
        n2 = np.cross(n1, v)  # (37b)
        return np.array([n1, n2 / np.linalg.norm(n2)])
