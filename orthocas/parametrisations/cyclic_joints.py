"""Cyclic joints turn or shift the whole task: coordinates linear in them hold at all their positions (ours)."""

import numpy as np

from orthocas.checks import Array, require_kind
from orthocas.domains import Box, Conditioned, sample_uniform
from orthocas.problem import Problem, is_regular

_SAMPLES, _POSITIONS = 24, 6  # joint positions, and other positions of one joint at each of them
_SEED = 0
_NEGLIGIBLE = 1e-8  # relative; near-singular samples lose four digits
_LARGEST_SLIDE = 10.0  # [m]; other positions of a prismatic joint without limits lie within


def cyclic_joints(problem: Problem) -> tuple[str, ...]:
    """Names of the joints that only turn or shift the whole task, for example the base rotation of a position task.

    Joint k is cyclic if h(q + t e_k) = g_t(h(q)) with isometries g_t, and A does not depend on q_k. Then neither does
    span{grad_A h_i}, so coordinates xi = a q_k + f(other joints) are as good at every q_k as at one. The function tests
    this at samples: A, the A-orthogonal projector on the span and the eigenvalues of J_x A^-1 J_x^T must not change
    when joint k moves through its limits, or a full turn. Joints that do not move the task do not count.

    Args:
        problem: robot, task, metric and domain.

    Source:
        ours, docs/domains.md.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> oc.cyclic_joints(problems.get("planar_3r_xy")), oc.cyclic_joints(problems.get("planar_3r_x"))
        (('q1',), ())
    """
    require_kind("problem", problem, Problem)
    return _cyclic(problem, 2)


def leaf_cyclic_joints(problem: Problem) -> tuple[str, ...]:
    """Names of the joints at whose position A and the leaves do not depend, also if the size of task gradients does.

    Such as the first and the last joint for the pose of a tool, with gradients as in `atlases.local_task.LocalTask`.
    """
    return _cyclic(problem, 1)


def _cyclic(problem: Problem, invariants: int) -> tuple[str, ...]:
    """Joints at whose position A and the first of `_invariants` do not depend."""
    points = sample_uniform(problem.domain, _SAMPLES, _SEED)
    points = points[is_regular(problem, points)]
    names = problem.robot.joint_names
    return tuple(name for k, name in enumerate(names) if len(points) and _is_cyclic(problem, points, k, invariants))


def over_cyclic_joints(problem: Problem, names: tuple[str, ...]) -> Problem:
    """The problem on a box that covers all positions of the cyclic joints; the problem itself if there is none.

    The box reaches from limit to limit. A joint without limits becomes unbounded: every position of it lies inside.
    """
    require_kind("problem", problem, Problem)
    robot, domain = problem.robot, problem.domain
    if not names or not isinstance(domain, Box):
        return problem
    centre, half_width, unbounded = domain.centre.copy(), domain.half_width.copy(), set(domain.unbounded)
    for k in map(robot.joint_names.index, names):
        low, high = _range(problem, k)
        half_width[k] = (high - low) / 2
        if np.isinf(robot.lower[k]) and np.isinf(robot.upper[k]):
            unbounded.add(k)
        else:
            centre[k] = (low + high) / 2
    wider = Box(centre, half_width, sorted(unbounded))
    wider = domain.within(wider) if isinstance(domain, Conditioned) else wider
    return Problem(robot, problem.task, problem.metric, wider, problem.name)


def _range(problem: Problem, k: int) -> tuple[float, float]:
    """Limits of joint k. Where it has none: a turn around the domain's centre, or the domain of a prismatic joint."""
    robot, domain = problem.robot, problem.domain
    reach = domain.half_width[k] if robot.tree.prismatic[k] else max(np.pi, domain.half_width[k])
    low = domain.centre[k] - reach if np.isinf(robot.lower[k]) else robot.lower[k]
    high = domain.centre[k] + reach if np.isinf(robot.upper[k]) else robot.upper[k]
    return float(low), float(high)


def _is_cyclic(problem: Problem, points: Array, k: int, invariants: int) -> bool:
    """Whether nothing that matters changes when joint k moves."""
    robot, (low, high) = problem.robot, _range(problem, k)
    if robot.tree.prismatic[k] and np.isinf([robot.lower[k], robot.upper[k]]).any():
        low, high = -_LARGEST_SLIDE, _LARGEST_SLIDE
    places = low + (high - low) * np.random.default_rng((_SEED, k)).uniform(size=(_POSITIONS, len(points)))
    moved = np.repeat(points[None], _POSITIONS, axis=0)
    moved[:, :, k] = places
    J, A = _task_and_metric(problem, points)
    if not np.abs(J[:, :, k]).max() > _NEGLIGIBLE * np.abs(J).max():
        return False
    J_there, A_there = _task_and_metric(problem, moved.reshape(-1, problem.n))
    if not (np.isfinite(J_there).all() and np.isfinite(A_there).all() and _same(A, A_there)):
        return False
    try:
        pairs = zip(_invariants(J, A)[:invariants], _invariants(J_there, A_there)[:invariants], strict=True)
        return all(_same(*pair) for pair in pairs)
    except np.linalg.LinAlgError:  # the task loses rank where the joint moves
        return False


def _task_and_metric(problem: Problem, points: Array) -> tuple[Array, Array]:
    """J_x (N, m, n) and A (N, n, n), unchecked: they may be singular or not finite."""
    n = problem.n
    J = problem.task.batched_jacobian(points)[0].reshape(-1, problem.m, n)
    return J, problem.metric.batched(points)[0].reshape(-1, n, n)


def _invariants(J: Array, A: Array) -> tuple[Array, Array]:
    """The A-orthogonal projector on the span of the task gradients (N, n, n), and the eigenvalues of J A^-1 J^T."""
    gradients = np.linalg.solve(A, J.transpose(0, 2, 1))
    gram = J @ gradients
    return gradients @ np.linalg.solve(gram, J), np.linalg.eigvalsh(gram)


def _same(here: Array, there: Array) -> bool:
    """Whether values at the points (N, ...) equal those at the other positions (positions N, ...)."""
    differences = there.reshape(_POSITIONS, *here.shape) - here
    return bool(np.abs(differences).max() <= _NEGLIGIBLE * np.abs(here).max())
