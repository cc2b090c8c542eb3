"""The loss of a fit as one CasADi expression of the parameters, which CasADi can differentiate."""

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.bases.family import Family, JointSpace, LinearFamily, Parametrisation
from orthocas.fitting.residuals import Loss, sample_loss
from orthocas.fitting.settings import require_parametrisation
from orthocas.fitting.starts import spectral_start
from orthocas.fitting.terms import DEFAULT_WEIGHTS, Sizes, WeightNumbers, Weights
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import Samples, evaluate_samples, sample_evenly
from orthocas.tools.checks import Array, as_point_set, freeze_array, require_count, require_kind


def loss(
    problem: Problem,
    parametrisation: Parametrisation,
    *,
    weights: Weights | WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | ArrayLike = 500,
    seed: int = 0,
    start: ArrayLike | None = None,
) -> ca.Function:
    """L(theta), the mean loss (25) of [AS2023] on given samples, for `ca.nlpsol`, `ca.gradient` and `ca.hessian`.

    The function is a graph of plain operations without callbacks, so it can be differentiated any number of times.
    `fit` evaluates the same numbers faster. All r coordinates depend on all joints: idle joints are not split off,
    and no mirror symmetry is used. The fold term is left out, because it acts at points that only a fit searches.

    Args:
        problem: robot, task, metric and domain.
        parametrisation: the family with parameters theta (size, 1). For bases they are the coefficients row by row.
        weights: weights of the terms, and the kind of angles; see `Weights`.
        samples: number of samples to draw, or joint positions (N, n) [rad] or [m].
        seed: seed of drawn samples, and of the start of a network.
        start: parameters (size,) whose orientation the regularity term keeps. Default: where `fit` starts.

    Returns:
        A function `loss` with input `theta` (size, 1) and output `loss` (1, 1).

    Raises:
        InvalidValueError, ShapeError: if an argument is invalid.

    Example:
        >>> import casadi as ca
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> L = oc.loss(problems.get("planar_3r_xy"), oc.Polynomial(2), samples=50)
        >>> theta = ca.MX.sym("theta", L.size1_in(0))
        >>> H = ca.hessian(L(theta), theta)[0]
        >>> H.shape
        (9, 9)
    """
    require_kind("problem", problem, Problem)
    require_parametrisation(parametrisation)
    family = parametrisation.for_problem(problem).family(JointSpace.of(problem), problem.r)
    drawn = _drawn(problem, samples, seed)
    theta0 = _start(family, drawn, seed) if start is None else freeze_array("start", start, (family.size,))
    theta = ca.MX.sym("theta", family.size)
    J = _jacobians(family, drawn.points, theta)  # (r n, N), each J_xi column by column
    identity = drawn.metric_inverse is None
    known = Weights.of(weights).for_problem(problem)
    of_sample = Loss.of(Sizes(problem.n, problem.m, problem.r, identity), known.by_name)
    orientation = _orientation(drawn, ca.Function("J", [theta], [J])(theta0).full(), problem.r)
    data = [_columns(part) for part in drawn.collect_data(of_sample.data, orientation)]
    mean = ca.sum2(_mapped(of_sample, len(drawn))(J, *data)) / len(drawn)
    return ca.Function("loss", [theta], [mean], ["theta"], ["loss"])


def _drawn(problem: Problem, samples: int | ArrayLike, seed: int) -> Samples:
    if isinstance(samples, int | np.integer):
        count = require_count("samples", int(samples))
        return evaluate_samples(problem, sample_evenly(problem.domain, count, require_count("seed", seed, least=0)))
    return evaluate_samples(problem, as_point_set("samples", samples, problem.n)[0])


def _start(family: Family, samples: Samples, seed: int) -> Array:
    return spectral_start(family, samples) if isinstance(family, LinearFamily) else family.initial(seed)


def _jacobians(family: Family, points: Array, theta: ca.MX) -> ca.MX:
    """J_xi of every sample column by column, (r n, N)."""
    N, n = points.shape
    if isinstance(family, LinearFamily):
        q = ca.SX.sym("q", n)
        slopes = ca.Function("slopes", [q], [ca.densify(ca.jacobian(family.basis(q), q))])  # (K, n)
        G = slopes.map(N)(ca.DM(points.T))  # (K, n N)
        C = ca.reshape(theta, family.width, family.outputs).T
        linear: ca.MX = ca.reshape(C @ G, family.outputs * n, N)
        return linear
    place = ca.MX.sym("q", n, N)
    gradients = ca.Function("gradients", [place, theta], family.jacobian(place, theta))
    by_component: list[Any] = gradients.call([ca.MX(ca.DM(points.T)), theta])
    stacked: ca.MX = ca.vertcat(*(gradient[i, :] for i in range(n) for gradient in by_component))
    return stacked


def _mapped(loss_of: Loss, count: int) -> ca.Function:
    """The loss of `count` samples side by side: J_xi (r n, N) and data as columns -> (1, N)."""
    one = sample_loss(loss_of)
    J = ca.SX.sym("J", loss_of.sizes.r * loss_of.sizes.n)
    data = [ca.SX.sym(name, one.numel_in(1 + k)) for k, name in enumerate(loss_of.data)]
    shaped = [ca.reshape(part, *one.size_in(1 + k)) for k, part in enumerate(data)]
    value = one(ca.reshape(J, loss_of.sizes.r, loss_of.sizes.n), *shaped)
    return ca.Function("losses", [J, *data], [value]).map(count)


def _columns(part: Array) -> ca.DM:
    """Data of samples (N, rows, columns) or (N, rows) as columns (entries, N), matrices column by column."""
    flat = (part.transpose(0, 2, 1) if part.ndim == 3 else part).reshape(len(part), -1)
    return ca.DM(flat.T)


def _orientation(samples: Samples, J: Array, r: int) -> float:
    """Orientation of coordinates with gradients J_xi, (r n, N)."""
    return samples.orientation(J.T.reshape(len(samples), -1, r).transpose(0, 2, 1))
