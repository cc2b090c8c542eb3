"""Symmetries of a task in joint space: reflections and half turns of joints that keep its directions (ours)."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from orthocas.checks import Array
from orthocas.problem import Problem
from orthocas.samples import samples_at

_TOLERANCE = 1e-6  # robot files give angles with ten decimals
_POINTS = 16
_MOST_CANDIDATES = 2**17
_SEED = 0


@dataclass(frozen=True, eq=False)
class Symmetries:
    """Maps g(q) = S q + t of the joints, S = diag(s), with Pi(g(q)) = S Pi(q) S and A(g(q)) = S A(q) S.

    Pi is the A-orthogonal projector on the task gradients. If xi are coordinates near g(q), then xi(g(.)) are
    coordinates near q with the same leak and conditioning. Signs s are +1 or -1, shifts t are 0 or pi. The first map is
    the identity. For an arm with a spherical shoulder, elbow and wrist and a position task there are 16: the mirror,
    and for each of the three bent joints the two postures with the same links.
    """

    joints: tuple[int, ...]  #: all that are not idle
    signs: Array  #: s, (maps, joints)
    shifts: Array  #: t, (maps, joints)

    def __len__(self) -> int:
        return len(self.signs)

    def of(self, joints: tuple[int, ...]) -> "Symmetries":
        """The same maps on some of the joints."""
        columns = [self.joints.index(joint) for joint in joints]
        return Symmetries(joints, self.signs[:, columns], self.shifts[:, columns])


def find_symmetries(problem: Problem, joints: tuple[int, ...], cyclic: tuple[int, ...]) -> Symmetries:
    """All such maps of a problem.

    Args:
        problem: robot, task, metric; the centre of its domain is where idle joints stay.
        joints: the joints that are not idle. The others stay as they are.
        cyclic: those among them at whose position nothing depends; they are not shifted.
    """
    turning = [i for i, joint in enumerate(joints) if joint not in cyclic and not problem.robot.tree.prismatic[joint]]
    signs, shifts = _candidates(len(joints), turning)
    q = np.random.default_rng(_SEED).uniform(-1.5, 1.5, (_POINTS, len(joints)))
    for points in (q[:1], q):
        kept = _symmetric(problem, joints, points, signs, shifts)
        signs, shifts = signs[kept], shifts[kept]
    return Symmetries(joints, signs, shifts)


def identity_only(joints: tuple[int, ...]) -> Symmetries:
    """No symmetry but the identity."""
    return Symmetries(joints, np.ones((1, len(joints))), np.zeros((1, len(joints))))


def _candidates(n: int, turning: list[int]) -> tuple[Array, Array]:
    """All signs with all half turns; signs alone for many joints, and the identity alone for even more."""
    if 2 ** (n + len(turning)) > _MOST_CANDIDATES:
        turning = []
    if 2**n > _MOST_CANDIDATES:
        return np.ones((1, n)), np.zeros((1, n))
    all_signs = np.array(list(product((1.0, -1.0), repeat=n)))
    all_shifts = np.zeros((2 ** len(turning), n))
    all_shifts[:, turning] = np.array(list(product((0.0, np.pi), repeat=len(turning))))
    signs = np.repeat(all_signs, len(all_shifts), axis=0)
    return signs, np.tile(all_shifts, (len(all_signs), 1))


def _symmetric(problem: Problem, joints: tuple[int, ...], points: Array, signs: Array, shifts: Array) -> Array:
    """For which maps the tensors at the images of the points are the images of those at the points, (maps,)."""
    here = _tensors(problem, joints, points)
    images = signs[:, None] * points + shifts[:, None]  # (maps, points, k)
    there = _tensors(problem, joints, images.reshape(-1, len(joints))).reshape(len(signs), *here.shape)
    wanted = signs[:, None, None, :, None] * here * signs[:, None, None, None, :]
    return np.asarray(np.abs(there - wanted).max(axis=(1, 2, 3, 4)) <= _TOLERANCE)


def _tensors(problem: Problem, joints: tuple[int, ...], points: Array) -> Array:
    """A^-1 and Pi with its second index raised, both of size 1, (N, 2, k, k); NaN where a gradient vanishes."""
    q = np.repeat(problem.domain.centre[None], len(points), axis=0)
    q[:, list(joints)] = points
    samples = samples_at(problem, q).restricted_to(list(joints))
    if len(samples) < len(points):
        return np.full((len(points), 2, len(joints), len(joints)), np.nan)
    basis = samples.task_basis
    projector = basis.transpose(0, 2, 1) @ basis
    inverse = samples.metric_inverse
    inverse = np.broadcast_to(np.eye(len(joints)), projector.shape) if inverse is None else inverse
    both = np.stack([inverse, projector], axis=1)
    return np.asarray(both / np.abs(both).max(axis=(2, 3), keepdims=True))
