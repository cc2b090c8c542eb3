"""Samples: random points of a domain with a seed, and the data of the loss that do not depend on the coordinates."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from orthocas.tasks.domains import Domain, keep_inside, make_generator
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array

if TYPE_CHECKING:
    from orthocas.tasks.problem import Problem

#: Relative to the largest entry of J_x. A joint with a smaller column does not move the task. Robot files round angles
#: to about nine decimals, which tilts the axes of such joints by this order of magnitude.
NEGLIGIBLE = 1e-8


POWERS = (1.0, 0.5, 0.25)  #: exponents of the distance from the centre: uniform, near faces, near corners


def sample_uniform(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points uniformly from the domain, (samples, n)."""
    return domain.sample(samples, seed)


def sample_boundary_weighted(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points: one third uniform, one third near faces, and one third near corners, (samples, n).

    Charts fail near boundaries first. Distances from the centre are |u|^p half-widths, with uniform u and p = 1, 1/2,
    1/4.

    Source:
        ours.
    """
    rng, third = make_generator(domain, samples, seed), samples // 3
    sizes = (samples - 2 * third, third, third)
    parts = [
        keep_inside(domain, size, partial(domain.draw, rng, power=power))
        for size, power in zip(sizes, POWERS, strict=True)
    ]
    return np.vstack(parts)


def sample_evenly(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points that fill the domain more evenly than random points, (samples, n).

    They follow the additive recurrence frac(shift + k alpha) with a random shift, alpha_j = g^-j, and the root g of
    g^(n+1) = g + 1. Each point is uniformly distributed, and every part of the sequence is even, so means over the
    domain converge faster than with independent points. Domains with their own sampler get independent points.

    Source:
        M. Roberts, docs/reference/references.md [R2018]. The use for training is ours.
    """
    if domain.draws_itself:
        return sample_uniform(domain, samples, seed)
    rng, n = make_generator(domain, samples, seed), len(domain.centre)
    # Find the generalised golden ratio by fixed-point iteration.
    g = 1.5
    for _ in range(64):
        g = (1 + g) ** (1 / (n + 1))
    shift, done = rng.uniform(size=n), 0

    def draw(count: int) -> Array:
        nonlocal done
        k = np.arange(done + 1, done + count + 1)[:, None]
        done += count
        u = 2 * ((shift + k * g ** -np.arange(1.0, n + 1)) % 1.0) - 1
        return np.asarray(domain.centre + domain.half_width * u)

    return keep_inside(domain, samples, draw)


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """N joint positions with task gradients and metrics. Positions where a task gradient vanishes are left out."""

    points: Array  #: q, (N, n)
    task_jacobian: Array  #: J_x, (N, m, n)
    metric_inverse: Array | None  #: A^-1, (N, n, n); None for the identity

    def __repr__(self) -> str:
        N, m, n = self.task_jacobian.shape
        return f"Samples({N} joint positions, n = {n}, m = {m})"

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, part: slice | NDArray[np.bool_]) -> "Samples":
        inverse = None if self.metric_inverse is None else self.metric_inverse[part]
        return Samples(self.points[part], self.task_jacobian[part], inverse)

    def restricted_to(self, joints: list[int]) -> "Samples":
        """The samples restricted to some joints. The metric must not couple these to the others."""
        inverse = None if self.metric_inverse is None else self.metric_inverse[:, joints][:, :, joints]
        return Samples(self.points[:, joints], self.task_jacobian[:, :, joints], inverse)

    def project_to_zero_momentum(self, base: Sequence[int]) -> "Samples":
        """The samples of a robot with a floating base, for velocities with zero momentum.

        For A = M, let a be the joints of the arms and b those of the base. J_x becomes the generalised Jacobian J_a -
        J_b M_bb^-1 M_ba = (J_x M^-1)_a ((M^-1)_aa)^-1, and M becomes the generalised inertia, whose inverse is
        (M^-1)_aa. Then the base's joints neither move the task nor couple to the others, so they count as idle.

        Source:
            [UY1989]; the metric is ours.
        """
        assert self.metric_inverse is not None
        n, k = self.task_jacobian.shape[2], len(base)
        arms = self.metric_inverse[:, k:, k:]
        J, inverse = np.zeros_like(self.task_jacobian), np.repeat(np.eye(n)[None], len(self), axis=0)
        gradients = self.compute_metric_gradients(self.task_jacobian)[:, :, k:]
        J[:, :, k:] = np.linalg.solve(arms, gradients.transpose(0, 2, 1)).transpose(0, 2, 1)
        inverse[:, k:, k:] = arms
        return Samples(self.points, J, inverse)

    def compute_metric_gradients(self, covectors: Array) -> Array:
        """A^-1 v for covectors v (N, k, n): gradients in the metric ([AS2023] eq. (16))."""
        gradients: Array = covectors if self.metric_inverse is None else covectors @ self.metric_inverse
        return gradients

    @property
    def unit_task_gradients(self) -> Array:
        """A^-1 v_x,i / |A^-1 v_x,i| with Euclidean norms, as in [AS2023] eq. (24), (N, m, n)."""
        gradients = self.compute_metric_gradients(self.task_jacobian)
        unit: Array = gradients / np.linalg.norm(gradients, axis=2, keepdims=True)
        return unit

    @property
    def task_basis(self) -> Array:
        """An A-orthonormal basis e_1..e_m of span{grad_A h_i}, (N, m, n)."""
        gradients = self.compute_metric_gradients(self.task_jacobian)
        gram = gradients @ self.task_jacobian.transpose(0, 2, 1)
        # Normalise rows first, so that units do not matter.
        scale = np.sqrt(np.einsum("sii->si", gram))
        gram = gram / scale[:, :, None] / scale[:, None, :]
        # A lower bound on the eigenvalues keeps singular samples finite.
        values, vectors = np.linalg.eigh(gram)
        values = np.maximum(values, 1e-14)
        whitening = (vectors / np.sqrt(values)[:, None, :]).transpose(0, 2, 1)
        basis: Array = whitening @ (gradients / scale[:, :, None])
        return basis

    @cached_property
    def null_basis(self) -> Array:
        """An A-orthonormal basis z_1..z_r of ker J_x, (N, n, r), oriented so that det [J_x; Z^T] > 0."""
        m = self.task_jacobian.shape[1]
        Z = np.linalg.qr(self.task_jacobian.transpose(0, 2, 1), mode="complete")[0][:, :, m:]
        if self.metric_inverse is not None:
            gram = Z.transpose(0, 2, 1) @ np.linalg.solve(self.metric_inverse, Z)
            Z = Z @ np.linalg.inv(np.linalg.cholesky(gram)).transpose(0, 2, 1)
        stacked = np.concatenate([self.task_jacobian, Z.transpose(0, 2, 1)], axis=1)
        Z[:, :, -1] *= np.where(np.linalg.det(stacked) < 0, -1.0, 1.0)[:, None]
        return Z

    def orientation(self, coordinate_jacobians: Array) -> float:
        """Sign (+1 or -1) of the volume that J_xi (N, r, n) spans across the task, at most of the samples."""
        return 1.0 if np.median(np.linalg.det(coordinate_jacobians @ self.null_basis)) >= 0 else -1.0

    def collect_data(self, names: Iterable[str], orientation: float | None) -> list[Array]:
        """The data of every sample that a loss needs, by name: arrays (N, rows, columns) or (N, rows).

        Args:
            names: see `orthocas.fitting.terms.SAMPLE_DATA`.
            orientation: result of `orientation` for the initial coordinates of a fit. The null basis gets the same
                orientation, so that the volume of their gradients is positive.
        """
        data: dict[str, Array] = {name: getattr(self, name) for name in names}
        if "null_basis" in data:
            oriented = data["null_basis"].copy()
            oriented[:, :, -1] *= orientation or 1.0
            data["null_basis"] = oriented
        return list(data.values())


Draw = Callable[[int, tuple[int, ...]], Samples]  #: number and seed -> fresh samples of a problem


def split_samples(samples: Samples, count: int) -> Iterator[Samples]:
    """Split samples into `count` parts of nearly equal size. Sizes differ if samples were left out."""
    edges = np.linspace(0, len(samples), count + 1).astype(int)
    for start, stop in pairwise(edges):
        yield samples[int(start) : int(stop)]


def sample_problem(problem: "Problem", samples: int, seed: int | tuple[int, ...]) -> Samples:
    """Draw samples uniformly from the problem's domain."""
    return evaluate_samples(problem, sample_uniform(problem.domain, samples, seed))


def evaluate_samples(problem: "Problem", points: Array) -> Samples:
    """Samples at given joint positions (N, n)."""
    # Leave out samples where a task gradient vanishes.
    J = problem.task.evaluate_jacobian(points)
    kept = np.all(np.einsum("sij,sij->si", J, J) > 0, axis=1)
    if not kept.all():
        points, J = points[kept], J[kept]
    inverse: Array | None = None
    if not problem.metric.is_identity:
        inverse = np.asarray(np.linalg.inv(problem.metric.evaluate(points)), dtype=float)
    samples = Samples(points, J, inverse)
    return samples.project_to_zero_momentum(problem.robot.tree.floating) if problem.robot.tree.floating else samples


def find_idle_joints(problem: "Problem", samples: Samples) -> list[int]:
    """Find joints on which the task does not depend, and which the metric does not couple to the others.

    At every sample, column k of J_x vanishes (up to `NEGLIGIBLE`), row k of A^-1 is zero off the diagonal, and A does
    not depend on q_k. Then J_x A^-1 e_k = 0, so xi = q_k is exact and orthogonal to every coordinate of the other
    joints, and the rest of the problem does not depend on joint k. The joints of a floating base are idle after
    `Samples.project_to_zero_momentum`, because the generalised inertia does not depend on the pose of the base.
    """
    # Find joints that no component of the task depends on.
    J = samples.task_jacobian
    size = np.abs(J).max(axis=(0, 1))
    idle = size <= NEGLIGIBLE * size.max()
    # Exclude joints that the metric couples to others or depends on.
    if samples.metric_inverse is not None:
        B = np.abs(samples.metric_inverse).max(axis=0)
        off_diagonal = (B - np.diag(B.diagonal())).max(axis=1)
        idle &= off_diagonal <= NEGLIGIBLE * B.diagonal()
        felt_by_metric = {*problem.metric.function.jac_sparsity(0, 0).get_col()} - {*problem.robot.tree.floating}
        idle[list(felt_by_metric)] = False
    return [int(k) for k in np.flatnonzero(idle)]


def compute_row_scale(J: Array, units: tuple[str, ...]) -> Array:
    """Root mean square length of the rows of each unit, (m,), independent of the directions of axes; 1 if it is zero.

    Args:
        J: task Jacobians at samples, (N, m, n).
        units: units of the task components; rows with the same unit share one scale, and each row of unknown unit has
            its own.
    """
    squares = (J**2).sum(axis=2).mean(axis=0)
    groups = np.array([unit or f"own {i}" for i, unit in enumerate(units)])
    means = np.array([squares[groups == mine].mean() for mine in groups])
    return np.sqrt(np.where(means > 0, means, 1.0))


def compute_directions(problem: "Problem", joints: Sequence[int], points: Array) -> Array:
    """Compute the matrices that a symmetry of the joints preserves: A^-1, and the projector on the task gradients.

    The second index of the projector is raised by the metric.

    Args:
        problem: robot, task and metric; all other joints stay at the home of its domain.
        joints: indices of the k joints.
        points: positions of these joints, (N, k).

    Returns:
        Both matrices, each divided by its largest entry, (N, 2, k, k); NaN everywhere if a gradient vanishes at any
        point.
    """
    q = np.repeat(problem.domain.home[None], len(points), axis=0)
    q[:, list(joints)] = points
    samples = evaluate_samples(problem, q).restricted_to(list(joints))
    if len(samples) < len(points):
        return np.full((len(points), 2, len(joints), len(joints)), np.nan)
    # Compute A^-1 and the projector on the span of the task gradients, each over its largest entry.
    basis = samples.task_basis
    projector = basis.transpose(0, 2, 1) @ basis
    inverse = samples.metric_inverse
    inverse = np.broadcast_to(np.eye(len(joints)), projector.shape) if inverse is None else inverse
    both = np.stack([inverse, projector], axis=1)
    return np.asarray(both / np.abs(both).max(axis=(1, 2, 3), keepdims=True))
