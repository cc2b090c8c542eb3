"""Self-motion curves of three joints under a task with m = 2: level curves of h on the 3-torus."""

import numpy as np

from orthocas.errors import SolveError
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .style import TURN

_CORRECTIONS = 3
_SAME = 1e-9  # points closer than this are equal [rad]


def trace(task: Task, starts: Array, step: float = 0.05, most: int = 2000) -> list[Array]:
    """Follow dq/ds = J_1 x J_2 / |J_1 x J_2| by Runge-Kutta steps, each corrected by Newton's method, until it closes.

    Args:
        task: task with m = 2 of a robot with n = 3 revolute joints.
        starts: one point of each curve, (N, 3) [rad].
        step: length of a step [rad].
        most: number of steps after which a curve counts as open.

    Returns:
        One curve per start, (P, 3), not wrapped. The last point equals the first up to whole turns.

    Raises:
        SolveError: if a curve does not close, for example because it runs into a singular configuration.
    """
    goal, direction = task.batched(starts)[0], _tangents(task, starts)
    path, ahead = [starts], np.zeros(len(starts))
    closing = np.zeros(len(starts), dtype=int)
    while not closing.all():
        if len(path) > most:
            raise SolveError(f"self-motion curves from {starts[closing == 0].tolist()} do not close in {most} steps")
        path.append(_advance(task, path[-1], goal, np.full(len(starts), step)))
        gap = wrapped(path[-1] - starts)
        before, ahead = ahead, np.einsum("ij,ij->i", gap, direction)
        passed = (before < 0) & (ahead >= 0) & (np.linalg.norm(gap, axis=1) < 1.5 * step) & (closing == 0)
        closing[passed] = len(path) - 1
    points = np.array(path)
    last, length = points[closing - 1, np.arange(len(starts))], np.full(len(starts), step)
    for _ in range(_CORRECTIONS + 1):
        end = _advance(task, last, goal, length)
        length = length - np.einsum("ij,ij->i", wrapped(end - starts), direction)
    return [np.vstack([points[:k, i], end[i]]) for i, k in enumerate(closing)]


def wrapped(angles: Array) -> Array:
    """The same angles in [-pi, pi)."""
    turned: Array = (angles + np.pi) % TURN - np.pi
    return turned


def pieces_in_cube(curve: Array) -> list[Array]:
    """Pieces of a curve (P, 3), cut where it leaves the cube |q_i| <= pi and shifted back into the cube."""
    cells = np.floor((curve + np.pi) / TURN)
    pieces, piece = [], [curve[0] - TURN * cells[0]]
    for k in range(len(curve) - 1):
        rise = curve[k + 1] - curve[k]
        cell = cells[k].copy()
        faces = -np.pi + TURN * np.maximum(cells[k], cells[k + 1])
        crossed = np.flatnonzero(cells[k] != cells[k + 1])
        for share, j in sorted(((faces[j] - curve[k, j]) / rise[j], j) for j in crossed):
            point = curve[k] + share * rise
            pieces.append([*piece, point - TURN * cell])
            cell[j] = cells[k + 1, j]
            piece = [point - TURN * cell]
        piece.append(curve[k + 1] - TURN * cell)
    return [part for points in (*pieces, piece) if len(part := _without_repeats(np.array(points))) > 1]


def _without_repeats(points: Array) -> Array:
    """A polyline without consecutive equal points, which occur where it crosses an edge of the cube."""
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > _SAME
    kept: Array = points[np.concatenate([[True], moved])]
    return kept


def _tangents(task: Task, q: Array) -> Array:
    """Unit null vectors of J_x, (N, 3). Their orientation changes only where J_x loses rank."""
    J = task.batched_jacobian(q)[0]
    null = np.cross(J[:, 0], J[:, 1])
    unit: Array = null / np.linalg.norm(null, axis=1, keepdims=True)
    return unit


def _advance(task: Task, q: Array, goal: Array, length: Array) -> Array:
    """One step of each curve."""
    s = length[:, None]
    k1 = _tangents(task, q)
    k2 = _tangents(task, q + s / 2 * k1)
    k3 = _tangents(task, q + s / 2 * k2)
    k4 = _tangents(task, q + s * k3)
    q = q + s / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    for _ in range(_CORRECTIONS):
        off = task.batched(q)[0] - goal
        q = q - (np.linalg.pinv(task.batched_jacobian(q)[0]) @ off[..., None])[..., 0]
    return q
