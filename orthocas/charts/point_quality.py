"""Quality of a chart at single joint positions, and the search for the worst of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocas.charts.coordinates import CoordinateMap
from orthocas.errors import SingularTaskError
from orthocas.tasks.domains import Domain
from orthocas.tasks.problem import Problem, measure_half_turn_distance
from orthocas.tasks.samples import Samples, evaluate_samples, sample_boundary_weighted
from orthocas.tools.batch import run_in_threads
from orthocas.tools.checks import Array
from orthocas.tools.columns import MANY, BlockFunction, ColumnFunction, fill
from orthocas.tools.display import Shown, number_list
from orthocas.tools.json import collect_attributes


@dataclass(frozen=True, slots=True)
class WorstRules:
    """Numbers of the quality at points, and of the search for the worst points (`descended`)."""

    chunk: int = 500_000  #: matrix entries (positions times n^2) evaluated at once, to bound memory
    near_the_end: float = 0.1  #: cos(angle / 2) of an orientation below which J_x is inaccurate, near half a turn
    longest: float = 1e100  #: longer gradients count as undefined, because their squares overflow
    candidates: int = 6000  #: number of candidate points
    descents: int = 300  #: number of descents, from the worst candidates
    steps: int = 15  #: steps of each descent
    kept: int = 60  #: number of the best descents that continue together
    most_pairs: int = 100  #: largest number of rounds of those, each a random step and an exchange
    quiet_pairs: int = 20  #: rounds within which the least value must fall by `gain`
    gain: float = 1e-4  #: that decrease
    first_step: float = 0.3  #: [half-widths] size of the first step
    last_step: float = 1e-4  #: [half-widths] smallest step
    moved: float = 0.4  #: probability that a joint moves in a random step
    leaders: float = 0.2  #: fraction of the best descents towards which others step in an exchange
    scale: tuple[float, float] = (0.4, 1.0)  #: least and largest factor of these steps
    exchanged: tuple[float, ...] = (0.2, 0.5, 0.9)  #: probabilities, one drawn for each descent, that a joint exchanges

    velocities: int = 3  #: seed tag of the random task velocities


WORST = WorstRules()

Value = Callable[[Array], Array]  #: u (N, n) -> (N,), NaN where there is no value


@dataclass(frozen=True, eq=False)
class Judged:
    """Quality at N joint positions. Positions where a gradient vanishes or is undefined are left out."""

    kept: NDArray[np.bool_]  #: whether each given position is not left out, (given,)
    points: Array  #: q, (N, n)
    jacobian: Array  #: J_xi, (N, r, n)
    task_cosines: Array  #: of [AS2023] eq. (24), Euclidean norms, (N, m, r)
    mutual_cosines: Array  #: of [AS2023] eq. (24), Euclidean norms, (N, pairs)
    leak_sines: Array  #: sin(leak_j) = |Pi_x grad_A xi_j|_A / |grad_A xi_j|_A, (N, r)
    metric_mutual_cosines: Array  #: cosines between coordinate gradients in the metric, (N, pairs)
    conditioning: Array  #: smallest singular value of [A-orthonormal task basis; unit coordinate gradients], (N,)
    signs: Array  #: of det J, (N,)

    @classmethod
    def at(cls, problem: Problem, coordinates: CoordinateMap, points: Array) -> Self:
        """Evaluate the quality of coordinates at joint positions (given, n), in parts that fit into memory."""
        size = max(1, WORST.chunk // problem.n**2)
        starts = range(0, max(len(points), 1), size)
        parts = [_judged(problem, coordinates, points[start : start + size]) for start in starts]
        found: dict[str, Any] = parts[0]
        if len(parts) > 1:
            together = run_in_threads(lambda name: np.concatenate([part[name] for part in parts]), list(found))
            found = dict(zip(found, together, strict=True))
        return cls(**{"metric_mutual_cosines": found["mutual_cosines"], **found})


def _judged(problem: Problem, coordinates: CoordinateMap, points: Array) -> dict[str, Array]:
    """The fields of `Judged` by name, at so few joint positions that intermediate values fit into memory."""
    samples = evaluate_samples(problem, points)
    kept = np.ones(len(points), dtype=bool)
    if len(samples) < len(points):
        kept = np.asarray((problem.task.evaluate_jacobian(points) != 0).any(axis=2).all(axis=1))
    J = coordinates.jacobian(samples.points)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        squares = np.einsum("sij,sij->si", J, J)
    # False for NaN, which grown coordinates may have
    alive = ((squares > 0) & (squares < WORST.longest**2)).all(axis=1)
    kept[kept] = alive
    if not alive.all():
        samples, J = samples[alive], J[alive]
    found = judge(samples, J)
    ends = measure_half_turn_distance(problem, samples.points) < WORST.near_the_end
    if ends.any():
        # near half a turn, use the frame Jacobian: its rows span the same space as those of J_x, which loses rank
        rows = problem.task.batched_frame_jacobian(samples.points[ends])[0].reshape(-1, problem.m, problem.n)
        values = in_the_metric(replace(samples[ends], task_jacobian=rows), J[ends])
        for name, part in zip(("leak_sines", "conditioning", "signs"), values, strict=True):
            found[name][ends] = part
    return {"kept": kept, "points": samples.points, "jacobian": J, **found}


def judge(samples: Samples, J: Array) -> dict[str, Array]:
    """Angles and conditioning of nonzero gradients J (N, r, n) at N samples.

    Returns:
        task_cosines, mutual_cosines, metric_mutual_cosines, leak_sines, conditioning and signs, see `Judged`. If A is
        the identity, metric_mutual_cosines may be missing; they equal mutual_cosines.
    """
    few = len(J) < MANY or J.shape[2] > MOST_JOINTS
    return judge_by_lapack(samples, J) if few else judge_by_columns(samples, J)


def in_the_metric(samples: Samples, J: Array) -> tuple[Array, Array, Array]:
    """Sines of the leaks (N, r), conditioning (N,) and signs of det J (N,), for nonzero gradients J (N, r, n)."""
    found = judge(samples, J)
    return found["leak_sines"], found["conditioning"], found["signs"]


def measure_held_speeds(problem: Problem, points: Array, J: Array, seed: int) -> Array:
    """Joint speed needed to hold xi, relative to the least-norm joint speed, for random task velocities u, (N,).

    The ratio at each q is |J_phi^-1 [u; 0]|_A / |J_x^+ u|_A, with a random unit velocity u (of positions and twists,
    SI) and the pseudo-inverse J_x^+ in the metric. For r = 1 with the unit self-motion z, it equals
    sqrt(1 + (d xi J_x^+ u)^2 / ((d xi z)^2 |J_x^+ u|_A^2)), and is at most 1 / cos(leak).

    Args:
        problem: problem of the coordinates.
        points: q, (N, n).
        J: J_xi there, (N, r, n), with nonzero gradients.
        seed: seed of the velocities.

    Returns:
        Ratios >= 1, (N,); inf where det J_phi = 0.

    Source:
        ours, docs/explanation/angles.md.
    """
    (N, r, n), inverse = J.shape, evaluate_samples(problem, points).metric_inverse
    rows = problem.task.batched_frame_jacobian(points)[0].reshape(N, n - r, n)
    whole = np.concatenate([rows, J], axis=1)
    if inverse is not None:
        # change variables so that the metric is Euclidean: A^-1 = W W^T and |dq|_A = |W^-1 dq|
        whole = whole @ np.linalg.cholesky(inverse)
    u = np.random.default_rng((seed, WORST.velocities)).normal(size=(N, n - r))
    velocity = np.concatenate([u / np.linalg.norm(u, axis=1, keepdims=True), np.zeros((N, r))], axis=1)
    regular, speeds = np.linalg.det(whole) != 0, np.full(N, np.inf)
    held = np.linalg.solve(whole[regular], velocity[regular, :, None])
    # the least-norm motion is the projection of the held one onto the span of the task gradients
    span = np.linalg.qr(whole[regular, : n - r].transpose(0, 2, 1))[0]
    least = span.transpose(0, 2, 1) @ held
    speeds[regular] = np.linalg.norm(held, axis=(1, 2)) / np.linalg.norm(least, axis=(1, 2))
    return speeds


@dataclass(frozen=True, eq=False, repr=False)
class PointQuality(Shown):
    """Quality of a chart at one joint position, or at each of N. NaN where a gradient vanishes or is undefined."""

    leak_deg: Array  #: leak of each coordinate [deg], (r,) or (N, r); 0 is perfect
    conditioning: Array  #: smallest singular value of the normalised gradients, () or (N,); 1 perfect, 0 singular
    boundary_distance: (
        Array  #: to the nearest face of the domain, () or (N,), <= 0 outside, inf for a torus [rad] or [m]
    )

    def facts(self) -> dict[str, str]:
        """The values at the one position, or the worst values of the set."""
        leak, conditioning, distance = np.atleast_2d(self.leak_deg), np.ravel(self.conditioning), self.boundary_distance
        # positions at which the quality is defined
        known = np.isfinite(conditioning)
        single = np.ndim(self.conditioning) == 0
        facts = {"quality": "at one joint position" if single else f"at {len(leak)} joint positions"}
        if known.any():
            facts["leak"] = f"{'' if single else 'at most '}{number_list(leak[known].max(axis=0))} deg"
            facts["conditioning"] = f"{'' if single else 'at least '}{conditioning[known].min():.3g}"
        if np.size(distance):
            facts["boundary"] = f"{'' if single else 'at least '}{np.min(distance):.3g} away, in rad or m; < 0 outside"
        if not known.all():
            facts["left out"] = f"{int((~known).sum())}, where a gradient vanishes or has no value"
        return facts

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return collect_attributes(self, "leak_deg", "conditioning", "boundary_distance")


def point_quality(problem: Problem, coordinates: CoordinateMap, points: Array) -> PointQuality:
    """Quality at each joint position (N, n)."""
    judged = Judged.at(problem, coordinates, points)
    leak, conditioning = np.full((len(points), coordinates.r), np.nan), np.full(len(points), np.nan)
    leak[judged.kept] = np.degrees(np.arcsin(np.clip(judged.leak_sines, 0.0, 1.0)))
    conditioning[judged.kept] = judged.conditioning
    lower, upper = problem.domain.bounds
    distance = np.minimum(points - lower, upper - points).min(axis=1)
    # positions of the box that violate a condition of the domain lie outside: no positive distance
    distance = np.where(problem.domain.contains(points), distance, np.minimum(distance, 0.0))
    return PointQuality(leak, conditioning, distance)


@dataclass(frozen=True, eq=False)
class WorstPoints:
    """Points with the least conditioning that a search found, the worst one first."""

    points: Array  #: q, (k, n)
    conditioning: Array  #: (k,); < 0 where det J has the opposite sign to that at most candidates: the chart folds over

    @property
    def least(self) -> float:
        """Least conditioning found; NaN if it is undefined everywhere."""
        return float(self.conditioning[0]) if len(self.conditioning) else float("nan")

    @property
    def explained(self) -> str:
        """The least conditioning and how it was searched."""
        found = f"{self.least:.3f}" if self.least >= 0 else "0, the chart FOLDS OVER"
        descents = min(len(self.points), WORST.descents)
        return f"{found} ({descents} descents from {WORST.candidates} points, many in corners)"

    def below(self, bound: float) -> Array:
        """The points with a conditioning below a bound, (l, n)."""
        return self.points[self.conditioning < bound]


def worst_points(problem: Problem, coordinates: CoordinateMap, seed: int = 0) -> WorstPoints:
    """Search the domain for the points of least conditioning.

    Candidates are uniform points and points near faces and corners. Descents (`descended`) start at the worst of them.
    Folds of charts lie in corners and thin wedges, which uniform samples miss. Points where a gradient vanishes or is
    undefined are left out.

    Args:
        problem: problem of the coordinates.
        coordinates: the coordinates.
        seed: seed of candidates and steps.
    """
    points = sample_boundary_weighted(problem.domain, WORST.candidates, (seed, WORST.candidates, 1))
    u = (points - problem.domain.centre) / problem.domain.half_width
    found = _signed_conditioning(problem, coordinates, u)
    orientation = 1.0 if np.sum(found >= 0) >= np.isfinite(found).sum() / 2 else -1.0
    u, found = descended(
        lambda u: orientation * _signed_conditioning(problem, coordinates, u), u, orientation * found, seed
    )
    return WorstPoints(_joint_positions(problem, u), found)


def least_in_domain(value: Value, domain: Domain, seed: int = 0) -> Array:
    """Search the domain for the joint position q (n,) at which a function is least.

    It uses candidates and descents as `worst_points`, and finds a local minimum that need not be the global one.

    Args:
        value: the function, q (N, n) -> (N,); NaN where it is undefined.
        domain: the domain.
        seed: seed of candidates and steps.

    Source:
        ours.
    """
    points = sample_boundary_weighted(domain, WORST.candidates, (seed, WORST.candidates, 1))

    def inside(u: Array) -> Array:
        q = domain.centre + domain.half_width * u
        return np.where(domain.contains(q), value(q), np.nan)

    u, _ = descended(inside, (points - domain.centre) / domain.half_width, value(points), seed)
    best: Array = domain.centre + domain.half_width * u[0]
    return best


def descended(value: Value, u: Array, found: Array, seed: int) -> tuple[Array, Array]:
    """Minimise a function over the cube [-1, 1]^n by random descents from the best of many points.

    Each descent takes random steps and keeps those with a lower value. A step moves only some joints, so that faces and
    corners are reached; its size grows after success and shrinks after failure. Already with 8 joints, gradients by
    finite differences would cost more. The best descents then continue together, with such steps and with steps of
    differential evolution in turn. Alone, each would end in its own corner, and a box of 16 joints has 65,000 corners.

    Args:
        value: the function, u (N, n) -> (N,); NaN where it is undefined.
        u: start points (N, n).
        found: values of the function there, (N,).
        seed: seed of the steps.

    Returns:
        Points (k, n) and their values (k,), the least first.

    Source:
        differential evolution [SP1997], with steps towards one of the best as in [ZS2009].
    """
    rng = np.random.default_rng((seed, WORST.candidates))
    order = np.argsort(found)[: min(WORST.descents, int(np.isfinite(found).sum()))]
    u, found, step = u[order], found[order], np.full(len(order), WORST.first_step)
    if not len(u):
        return u, found
    # short descents from many points
    for _ in range(WORST.steps):
        _step(value, u, found, step, rng)
    order = np.argsort(found)
    u, found, step = u[order], found[order], step[order]
    # The best of them continue together, until they gain no more. Their starts stay among the results.
    best, least, own = (part[: WORST.kept].copy() for part in (u, found, step))
    before = [np.inf] * WORST.quiet_pairs
    for _ in range(WORST.most_pairs):
        _step(value, best, least, own, rng)
        # differential evolution: each point steps towards one of the best, and along a difference of two others
        K = len(best)
        one, other = best[rng.integers(K, size=(2, K))]
        leaders = best[rng.choice(np.argsort(least)[: max(1, int(WORST.leaders * K))], K)]
        scale, share = rng.uniform(*WORST.scale, (K, 1)), rng.choice(WORST.exchanged, (K, 1))
        moved = rng.uniform(size=best.shape) < share
        _take_less(value, best, least, best + scale * (leaders - best + one - other) * moved)
        before.append(least.min())
        if before[-1] > before[-1 - WORST.quiet_pairs] - WORST.gain:
            break
    u, found = np.vstack([u, best]), np.concatenate([found, least])
    order = np.argsort(found)
    return u[order], found[order]


def _step(value: Value, u: Array, found: Array, step: Array, rng: np.random.Generator) -> None:
    """One random step of all descents, in place: u (N, n), values `found` (N,), and step sizes `step` (N,)."""
    moves = rng.normal(size=u.shape) * (rng.uniform(size=u.shape) < WORST.moved)
    less = _take_less(value, u, found, u + step[:, None] * moves)
    step[:] = np.maximum(WORST.last_step, step * np.where(less, 1.5, 0.8))


def _take_less(value: Value, u: Array, found: Array, tried: Array) -> NDArray[np.bool_]:
    """Replace points u (N, n) by those tried, clipped to the cube, whose value is less; return which, (N,)."""
    tried = np.clip(tried, -1, 1)
    values = value(tried)
    less: NDArray[np.bool_] = values < found
    u[less], found[less] = tried[less], values[less]
    return less


def _signed_conditioning(problem: Problem, coordinates: CoordinateMap, u: Array) -> Array:
    """Conditioning times the sign of det J at points u (N, n) of the cube, (N,); NaN outside the domain."""
    points, values = _joint_positions(problem, u), np.full(len(u), np.nan)
    inside = np.flatnonzero(problem.domain.contains(points))
    try:
        judged = Judged.at(problem, coordinates, points[inside])
    except SingularTaskError:
        # leave out points at which the Jacobian of the task is undefined, for example at half a turn
        J = problem.task.batched_jacobian(points[inside])[0]
        inside = inside[np.isfinite(J.reshape(len(inside), problem.m * problem.n)).all(axis=1)]
        judged = Judged.at(problem, coordinates, points[inside])
    values[inside[judged.kept]] = judged.signs * judged.conditioning
    return values


def _joint_positions(problem: Problem, u: Array) -> Array:
    """q of points u (N, n) of the cube [-1, 1]^n: centre + half_width u."""
    q: Array = problem.domain.centre + problem.domain.half_width * u
    return q


_ROUNDING = 1e-15  # rounding error of eigenvalues of matrices whose entries are at most 1
MOST_JOINTS = 10  #: number of joints above which the formulas take longer to build than they save
_SMALLEST_PIVOT = 1e-14  # lower bound of pivots, which keeps singular samples finite
_STEPS = 5  # steps towards the smallest eigenvalue in a round; few samples need more than one round
_MOST_ROUNDS = 20  # largest number of rounds; a double smallest eigenvalue takes 25 steps, or 5 rounds


def pairs(r: int) -> list[tuple[int, int]]:
    """The pairs (i, j), i > j, of r coordinates, in the order of the mutual cosines."""
    return [(i, j) for j, i in combinations(range(r), 2)]


def whitened(gram: ca.SX, columns: ca.SX, least: float) -> ca.SX:
    """L^-1 c for columns c (m, r), with the Cholesky factor L of a Gram matrix (m, m).

    Squared diagonal entries of L below `least` are replaced by it.
    """
    m = gram.size1()
    L, found = ca.SX.zeros(m, m), ca.SX(columns)
    for j in range(m):
        pivot = ca.sqrt(ca.fmax(gram[j, j] - ca.sumsqr(L[j, :j]), least))
        for i in range(j + 1, m):
            L[i, j] = (gram[i, j] - ca.dot(L[i, :j], L[j, :j])) / pivot
        found[j, :] = (found[j, :] - L[j, :j] @ found[:j, :]) / pivot
    return found


def triangle(matrix: ca.SX) -> list[ca.SX]:
    """The diagonal of a triangular form of a square matrix, by Householder reflections; its product is the determinant.

    The first k numbers are, up to sign, the diagonal of the Cholesky factor of the Gram matrix of the first k rows.
    """
    A, n = ca.SX(matrix), matrix.size1()
    found = []
    for k in range(n - 1):
        v, norm, half = _reflection(A[k, k:].T)
        # The entry becomes -norm with the sign of A[k, k], and a reflection has determinant -1: both signs cancel.
        found.append(ca.if_else(A[k, k] >= 0, norm, -norm))
        shares = A[k + 1 :, k:] @ v / _or_one(half)
        A[k + 1 :, k + 1 :] -= shares @ v[1:].T
    return [*found, A[n - 1, n - 1]]


def tridiagonal(matrix: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Tridiagonal form of a symmetric matrix (n, n): diagonal (n, 1), and squares of the off-diagonal (n - 1, 1)."""
    A, n = ca.SX(matrix), matrix.size1()
    squares = []
    for k in range(n - 2):
        # apply the Householder reflection of column k from both sides
        v, norm, half = _reflection(A[k + 1 :, k])
        squares.append(norm * norm)
        w = A[k + 1 :, k + 1 :] @ v / _or_one(half)
        w -= v * (ca.dot(w, v) / (2 * _or_one(half)))
        update = v @ w.T
        A[k + 1 :, k + 1 :] = ca.tril2symm(ca.tril(A[k + 1 :, k + 1 :] - update - update.T))
    if n > 1:
        squares.append(A[n - 1, n - 2] ** 2)
    return ca.diag(A), ca.vertcat(*squares)


def _reflection(column: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Householder vector v that reflects a column onto the first axis; the column's norm; and |v|^2 / 2."""
    norm = ca.norm_2(column)
    half = norm * (norm + ca.fabs(column[0]))
    return ca.vertcat(column[0] + ca.if_else(column[0] >= 0, norm, -norm), column[1:]), norm, half


def _or_one(x: ca.SX) -> ca.SX:
    """x if x > 0, else 1, as a divisor."""
    return ca.if_else(x > 0, x, 1.0)


def laguerre(diagonal: ca.SX, squares: ca.SX, at: ca.SX, steps: int) -> tuple[ca.SX, ca.SX]:
    """Laguerre steps from `at` up to the smallest eigenvalue of a tridiagonal matrix T, where `at` is a lower bound.

    The characteristic polynomial is the product of the pivots q_i of T - at I. Laguerre's step needs the sums of
    1 / (lambda_i - at) and of its square; they follow from the q_i and their first two derivatives. In exact arithmetic
    steps from below never pass the eigenvalue. If rounding makes a pivot negative, the step is 0.

    Returns:
        The place after `steps` steps, and the length of the last step.
    """
    n, step = diagonal.size1(), ca.SX(0)
    for _ in range(steps):
        q, slope, bend = diagonal[0] - at, ca.SX(-1), ca.SX(0)
        inverse, least = 1 / q, q
        first, second = inverse, inverse * inverse
        for i in range(1, n):
            ratio, share = squares[i - 1] * inverse, slope * inverse
            bend = ratio * (bend * inverse - 2 * share * share)
            q, slope = diagonal[i] - at - ratio, ratio * share - 1
            inverse, least = 1 / q, ca.fmin(least, q)
            share = slope * inverse
            first -= share
            second += share * share - bend * inverse
        ahead = n / (first + ca.sqrt(ca.fmax((n - 1) * (n * second - first * first), 0.0)))
        # all pivots are positive exactly if the smallest eigenvalue is still ahead
        step = ca.if_else(least > 0, ahead, 0.0)
        at = at + step
    return at, step


def judge_by_columns(samples: Samples, J: Array) -> dict[str, Array]:
    """As `judge`, by scalar formulas on blocks of samples as columns, for many samples.

    metric_mutual_cosines are missing if A is the identity.
    """
    (N, r, n), inverse = J.shape, samples.metric_inverse
    data = [samples.task_jacobian.reshape(N, -1), J.reshape(N, -1), np.zeros((N, 1))]
    if inverse is not None:
        data.append(inverse.reshape(N, -1))
    function, sizes = _function(n - r, n, inverse is None)
    rows = _evaluated(function, sum(sizes.values()), data)
    # samples whose last Laguerre step was more than rounding continue from the place reached
    left = np.flatnonzero(rows[:, -1] > _ROUNDING)
    for _ in range(_MOST_ROUNDS):
        if not left.size:
            break
        some = [array[left] for array in data]
        some[2] = rows[left, -2:-1]
        rows[left] = _evaluated(function, rows.shape[1], some)
        left = left[rows[left, -1] > _ROUNDING]
    found = dict(zip(sizes, np.split(rows, np.cumsum(list(sizes.values()))[:-1], axis=1), strict=True))
    del found["last_step"]
    conditioning = np.sqrt(found.pop("eigenvalue")[:, 0])
    shaped = {"task_cosines": found["task_cosines"].reshape(N, n - r, r), "signs": found["signs"][:, 0]}
    return {**found, **shaped, "conditioning": conditioning}


def _evaluated(function: ColumnFunction, size: int, data: list[Array]) -> Array:
    """Evaluate a function at N samples; `data` are its inputs, (N, ...) each. Returns (N, size)."""

    def build_block_function() -> BlockFunction:
        run = function.build_block_function()
        return lambda *columns: run(*columns)[0]

    results = np.empty((len(data[0]), size))
    fill(results, data[0], build_block_function, *data[1:])
    return results


@cache
def _function(m: int, n: int, euclidean: bool) -> tuple[ColumnFunction, dict[str, int]]:
    """The formulas as a function of J_x and J_xi row by row, a lower bound of the eigenvalues, and A^-1.

    Returns:
        The function, which stacks its results in a column, and their sizes by name.
    """
    J, at, inverse = ca.SX.sym("J", n, n), ca.SX.sym("at"), ca.SX.sym("inverse", n, n)
    found = _formulas(J[:, :m].T, J[:, m:].T, None if euclidean else inverse, at)
    inputs = [ca.SX.sym("task", n * m), ca.SX.sym("covectors", n * (n - m)), at]
    stacked = ca.substitute(ca.vertcat(*found.values()), ca.vec(J), ca.vertcat(*inputs[:2]))
    inputs += [] if euclidean else [ca.vec(inverse)]
    function = ca.Function("judgement", inputs, [ca.cse(ca.densify(stacked))])
    return ColumnFunction(function), {name: part.numel() for name, part in found.items()}


def _formulas(task: ca.SX, covectors: ca.SX, inverse: ca.SX | None, at: ca.SX) -> dict[str, ca.SX]:
    """Expressions of the results of `judge` by name, from rows of J_x (m, n) and J_xi (r, n), and A^-1 (None: I).

    In place of the conditioning, they include its square, which is the smallest eigenvalue of a Gram matrix, and the
    last Laguerre step towards that eigenvalue from `at`.
    """
    m, r = task.size1(), covectors.size1()
    raised, gradients = (rows if inverse is None else rows @ inverse for rows in (task, covectors))
    products, shares = gradients @ covectors.T, raised @ covectors.T
    euclidean, own = _lengths(covectors), ca.sqrt(ca.diag(products))
    # normalise the rows first, so that units do not matter
    scale = ca.sqrt(ca.sum2(raised * task))
    along = whitened(raised @ task.T / (scale @ scale.T), shares / (scale @ own.T), _SMALLEST_PIVOT)
    unit = products / (own @ own.T)
    gram = ca.vertcat(ca.horzcat(ca.SX.eye(m), along), ca.horzcat(along.T, ca.tril2symm(ca.tril(unit))))

    def of_pairs(matrix: ca.SX) -> ca.SX:
        return ca.vertcat(ca.SX(0, 1), *(matrix[i, j] for i, j in pairs(r)))

    eigenvalue, last_step = laguerre(*tridiagonal(gram), at, _STEPS)
    # sign of the determinant; 0 if a pivot is exactly 0
    sign = ca.SX(1)
    for pivot in triangle(ca.vertcat(task, covectors)):
        sign *= ca.sign(pivot)
    return {
        "task_cosines": ca.vec((shares / (_lengths(raised) @ euclidean.T)).T),
        "mutual_cosines": of_pairs(products / (_lengths(gradients) @ euclidean.T)),
        **({} if inverse is None else {"metric_mutual_cosines": of_pairs(unit)}),
        "leak_sines": ca.sqrt(ca.sum1(along * along)).T,
        "signs": sign,
        "eigenvalue": eigenvalue,
        "last_step": last_step,
    }


def _lengths(rows: ca.SX) -> ca.SX:
    """Euclidean norms of the rows of a matrix, as a column."""
    return ca.sqrt(ca.sum2(rows * rows))


def judge_by_lapack(samples: Samples, J: Array) -> dict[str, Array]:
    """As `judge`, by LAPACK, for few samples or many joints."""
    gradients, covectors, unit = samples.compute_metric_gradients(J), J.transpose(0, 2, 1), _unit(J)
    own = np.sqrt(np.einsum("sij,sij->si", gradients, J))
    first, second = (np.array([pair[k] for pair in pairs(J.shape[1])], dtype=int) for k in (0, 1))
    in_metric = gradients @ covectors / own[:, :, None] / own[:, None, :]
    along = samples.task_basis @ covectors / own[:, None]
    m = along.shape[1]
    gram = np.block([[np.broadcast_to(np.eye(m), (len(along), m, m)), along], [along.transpose(0, 2, 1), in_metric]])
    mutual = in_metric if samples.metric_inverse is None else _unit(gradients) @ unit.transpose(0, 2, 1)
    return {
        "task_cosines": samples.unit_task_gradients @ unit.transpose(0, 2, 1),
        "mutual_cosines": mutual[:, first, second],
        "metric_mutual_cosines": in_metric[:, first, second],
        "leak_sines": np.linalg.norm(along, axis=1),
        "conditioning": np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[:, 0], 0.0))),
        "signs": np.sign(np.linalg.det(np.concatenate([samples.task_jacobian, J], axis=1))),
    }


def _unit(rows: Array) -> Array:
    """Rows (N, k, n) scaled to Euclidean length 1."""
    unit: Array = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    return unit
