"""Where fits begin: the spectral start of bases, and mirror symmetries, which halve the coefficients."""

from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.bases.family import JointSpace, LinearFamily
from orthocas.fitting.basis_objective import BasisGradients, build_gradients
from orthocas.fitting.terms import Pairs, coordinates_of
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, compute_directions
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array


@dataclass(frozen=True, slots=True)
class StartRules:
    """Numbers of starts and of the search for a mirror."""

    mutual_weight: float = 1.0  #: of gradients along coordinates that are found already, relative to those of the task
    mixing_angle: float = float(np.radians(10))  #: by which neighbours are mixed [rad]
    exact: float = 1e-12  #: squared sine of a leak; functions of an exact coordinate are exact, too
    ridge: float = 1e-10  #: relative; keeps the pencil definite if basis functions coincide on the samples
    tolerance: float = 1e-6  #: robot files give angles with ten decimals; a symmetry broken by less costs nothing
    most_joints: int = 12  #: 4,096 choices of the joints that turn round
    points: int = 16  #: at which a symmetry is tested
    most_choices: int = 8  #: of what changes places in a mirror
    seed: int = 0


RULES = StartRules()


def find_spectral_start(
    family: LinearFamily,
    samples: Samples,
    kept: NDArray[np.bool_] | None = None,
    gradients: BasisGradients | None = None,
) -> Array:
    """Coefficients (r K,) of coordinates, found one after the other from generalised eigenproblems.

    Each coordinate minimises E |Pi_x grad xi|^2 subject to E |grad xi|^2 = 1, with the A-orthogonal projector Pi_x on
    the task gradients. A function of a coordinate xi_j that is already found would be a minimiser too, so each xi_j
    adds the term E (grad xi_j . grad xi)^2 / |grad xi_j|^2. All products are taken in the metric A^-1. Where several
    minima are zero, as for xi and xi^2 of an exact coordinate, the gradient with the smallest variance is chosen.

    Args:
        family: the coordinates.
        samples: samples of the family's joints.
        kept: the coefficients (r, K) that may differ from zero. Default: all.
        gradients: gradients of the basis, if there are some already. Default: those of the family.

    Source:
        ours, docs/explanation/derivations_fits.md#spectral-start.
    """
    # The pencil: S is the mean square along the task, T the mean square of the gradient, both in the metric
    basis = build_gradients(family, samples.points.shape[1]) if gradients is None else gradients
    G = basis.expand(basis.at(samples.points), len(samples)).astype(np.float64, copy=False)  # (N, n, K)
    N, _, K = G.shape
    # Components e_i^T d psi along the task gradients
    along_task = (samples.task_basis @ G).reshape(-1, K)
    S = along_task.T @ along_task / N
    raised = G if samples.metric_inverse is None else samples.metric_inverse @ G
    T = G.reshape(-1, K).T @ raised.reshape(-1, K) / N
    T += RULES.ridge * np.trace(T) / K * np.eye(K)
    middle = G.mean(axis=0)
    # Variance of the gradients
    V = G.reshape(-1, K).T @ G.reshape(-1, K) / N - middle.T @ middle
    allowed = np.ones((family.outputs, K), dtype=bool) if kept is None else kept
    C, left = np.zeros(allowed.shape), list(range(family.outputs))
    while left:
        # Coordinates that may have the same coefficients have the same minimum: solve one problem for each such class
        classes = {allowed[j].tobytes(): j for j in reversed(left)}.values()
        j, c = min(((j, _find_smallest(S, T, V, allowed[j])) for j in classes), key=lambda pair: pair[1] @ S @ pair[1])
        left.remove(j)
        C[j] = c
        # From now on, gradients along this coordinate count like gradients along the task
        gradient = raised @ c  # (N, n)
        length = np.sqrt(np.maximum(np.einsum("sn,sn->s", gradient, G @ c), 1e-300))
        along = np.einsum("sn,snk->sk", gradient / length[:, None], G)
        S = S + RULES.mutual_weight * along.T @ along / N
    # Scale the coordinates to a mean gradient length of 1. The spectral solution inherits the symmetries of the
    # problem, and a symmetric point is often a saddle of the loss: mix neighbours of the same class slightly
    C = C / np.linalg.norm(G @ C.T, axis=1).mean(axis=0)[:, None]
    cos, sin = np.cos(RULES.mixing_angle), np.sin(RULES.mixing_angle)
    for k in np.flatnonzero((allowed[1:] == allowed[:-1]).all(axis=1)):
        C[k], C[k + 1] = cos * C[k] + sin * C[k + 1], cos * C[k + 1] - sin * C[k]
    return np.asarray(C.ravel())


def _find_smallest(S: Array, T: Array, V: Array, free: NDArray[np.bool_]) -> Array:
    """The c (K,) with c^T T c = 1 and the smallest c^T S c, and zeros where it is not free.

    If c^T S c is zero for several c, the one with the smallest c^T V c is taken.
    """
    block = np.ix_(free, free)
    # W with W^T T W = I turns the problem into an ordinary eigenproblem
    whitening = np.linalg.inv(np.linalg.cholesky(T[block])).T
    values, vectors = np.linalg.eigh(whitening.T @ S[block] @ whitening)
    equal = whitening @ vectors[:, : max(1, np.count_nonzero(values < RULES.exact))]
    c = np.zeros(len(free))
    c[free] = equal @ np.linalg.eigh(equal.T @ V[block] @ equal)[1][:, 0]
    return c


@dataclass(frozen=True, eq=False)
class Mirror:
    """A reflection S = diag(s) of the joints about the centre of the domain that keeps task directions and metric.

    With q measured from the centre, the projector on the task gradients fulfils Pi(S q) = S Pi(q) S, and the metric
    A(S q) = S A(q) S. So coordinates with xi_j(S q) = p_j xi_j(q), p_j = +1 or -1, have the same angles at q and at
    S q. The same holds if S exchanges two coordinates, xi_i(S q) = xi_j(q): then (xi_i + xi_j) / sqrt 2 is even and
    (xi_i - xi_j) / sqrt 2 is odd. In both cases the coordinates are built from even and odd components, each of which
    has about half of the coefficients.
    """

    space: JointSpace
    signs: Array  #: s, (n,), +1 or -1
    parities: Array  #: p of the components, (r,): as many +1 and -1 as the null space has on the mirror, where S q = q
    exchanged: Pairs = ()  #: pairs of an odd and an even component, from which two coordinates are made

    def list_choices(self) -> list["Mirror"]:
        """Mirrors with the same reflection, one for each choice of exchanged pairs, at most eight."""
        odd, even = (np.flatnonzero(self.parities == sign).tolist() for sign in (-1, 1))
        most = min(len(odd), len(even))
        pairs = [
            tuple(zip(some, others, strict=True))
            for count in range(most + 1)
            for some in combinations(odd, count)
            for others in permutations(even, count)
        ]
        return [replace(self, exchanged=chosen) for chosen in pairs[: RULES.most_choices]]

    def coordinates(self, theta: Array) -> Array:
        """Coefficients of the coordinates, (r K,), from those of the components."""
        rows = theta.reshape(len(self.parities), -1)
        return np.concatenate(coordinates_of(list(rows), self.exchanged))

    def components(self, theta: Array) -> Array:
        """Coefficients of the even and odd components, (r K,), from those of the coordinates."""
        rows = theta.reshape(len(self.parities), -1)
        back = tuple((j, i) for i, j in self.exchanged)
        return np.concatenate(coordinates_of(list(rows), back))

    def kept(self, family: LinearFamily) -> NDArray[np.bool_] | None:
        """The coefficients (r, K) that the components may have; None if a basis function is neither even nor odd."""
        if family not in self._kept:
            q = ca.SX.sym("q", self.space.n)
            basis = ca.Function("basis", [q], [ca.densify(family.basis(q))])
            u = np.random.default_rng(RULES.seed).uniform(-1.0, 1.0, (self.space.n, RULES.points))
            here, there = (
                np.array(basis(self.space.centre[:, None] + self.space.half_width[:, None] * side))
                for side in (u, self.signs[:, None] * u)
            )
            # Find which functions are even and which are odd
            size = np.abs(here).max(axis=1)
            even, odd = (np.abs(there - sign * here).max(axis=1) <= RULES.tolerance * size for sign in (1, -1))
            allowed: NDArray[np.bool_] = np.where(even, 1, -1) == self.parities[:, None]
            self._kept[family] = allowed if (even | odd).all() else None
        return self._kept[family]

    @cached_property
    def _kept(self) -> dict[LinearFamily, NDArray[np.bool_] | None]:
        """Results of `kept` by family, filled on use."""
        return {}


def find_mirror(problem: Problem, active: list[int]) -> Mirror | None:
    """The first mirror symmetry of a problem in its active joints; None if there is none, or for more than 12 joints.

    A symmetry is tested at 16 random points.
    """
    space = JointSpace.of(problem).restricted_to(active)
    if space.n > RULES.most_joints:
        return None
    # The first point excludes most choices of signs, so that few are left to be tested at the other points
    u = np.random.default_rng(RULES.seed).uniform(-1.0, 1.0, (RULES.points, space.n))
    left = [np.array(signs) for signs in product((1.0, -1.0), repeat=space.n)][1:]
    for points in (u[:1], u[1:]):
        # Task directions and metric at S u must be the mirror images of those at u
        tensors = _evaluate_tensors(problem, active, np.concatenate([points, *(signs * points for signs in left)]))
        here, *there = tensors.reshape(1 + len(left), len(points), *tensors.shape[1:])
        left = [
            signs
            for signs, image in zip(left, there, strict=True)
            if np.abs(image - signs[:, None] * here * signs).max() <= RULES.tolerance
        ]
    for signs in left:
        parities = _find_parities(problem, active, signs, u)
        if parities is not None:
            return Mirror(space, signs, parities)
    return None


def _evaluate_tensors(problem: Problem, active: list[int], u: Array) -> Array:
    """Result of `compute_directions` at points (N, n) of the cube [-1, 1]^n, scaled to the domain."""
    domain = problem.domain
    return compute_directions(problem, active, domain.centre[active] + domain.half_width[active] * u)


def _find_parities(problem: Problem, active: list[int], signs: Array, u: Array) -> Array | None:
    """Parities of the r components, odd ones first; None if they differ between points of the mirror S q = q.

    At such points S maps the null space of J_x to itself, and its trace there is the number of even components minus
    that of odd ones.
    """
    # trace(S) on the null space is trace(S) minus the trace along the task
    tensors = _evaluate_tensors(problem, active, np.where(signs > 0, u, 0.0))
    inverse, projector = tensors[:, 0], tensors[:, 1]
    along_task = np.einsum("sii,i->s", np.linalg.solve(inverse, projector.transpose(0, 2, 1)), signs)
    differences = signs.sum() - along_task
    r = len(active) - problem.m
    # The number of even components must be whole, and the same at all points
    even = np.round((r + differences.mean()) / 2)
    if np.abs(2 * even - r - differences).max() > 0.01 or not 0 <= even <= r:
        return None
    return np.where(np.arange(r) < r - even, -1.0, 1.0)
