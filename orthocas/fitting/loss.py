"""The loss of a fit on its samples as one CasADi expression of the parameters."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.bases.family import JointSpace, LinearFamily, Parametrisation, require_parametrisation
from orthocas.fitting.sample_loss import Loss, build_sample_loss
from orthocas.fitting.starts import find_spectral_start
from orthocas.fitting.terms import (
    DEFAULT_WEIGHTS,
    Sizes,
    WeightNumbers,
    Weights,
)
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import evaluate_samples, sample_evenly
from orthocas.tools.checks import as_point_set, freeze_array, require_count, require_kind


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
        >>> from orthocas.fitting.loss import loss
        >>> L = loss(problems.get("planar_3r_xy"), oc.Polynomial(2), samples=50)
        >>> theta = ca.MX.sym("theta", L.size1_in(0))
        >>> H = ca.hessian(L(theta), theta)[0]
        >>> H.shape
        (9, 9)
    """
    require_kind("problem", problem, Problem)
    require_parametrisation(parametrisation)
    family = parametrisation.for_problem(problem).family(JointSpace.of(problem), problem.r)
    # Samples that are drawn evenly, or given
    if isinstance(samples, int | np.integer):
        count, seed = require_count("samples", int(samples)), require_count("seed", seed, least=0)
        points = sample_evenly(problem.domain, count, seed)
    else:
        points = as_point_set("samples", samples, problem.n)[0]
    drawn = evaluate_samples(problem, points)
    # Parameters whose orientation the regularity term keeps: those that are given, or where a fit starts
    if start is not None:
        theta0 = freeze_array("start", start, (family.size,))
    elif isinstance(family, LinearFamily):
        theta0 = find_spectral_start(family, drawn)
    else:
        theta0 = family.initial(seed)
    # J_xi of all samples as expressions of theta, (r n, N): the entries of each matrix, column by column, are a column
    theta, (N, n) = ca.MX.sym("theta", family.size), drawn.points.shape
    J: ca.MX
    if isinstance(family, LinearFamily):
        # Bases are linear in theta: J_xi = C G with constant gradients G at the samples
        q = ca.SX.sym("q", n)
        slopes = ca.Function("slopes", [q], [ca.densify(ca.jacobian(family.basis(q), q))])  # (K, n)
        G = slopes.map(N)(ca.DM(drawn.points.T))  # (K, n N)
        C = ca.reshape(theta, family.width, family.outputs).T
        J = ca.reshape(C @ G, family.outputs * n, N)
    else:
        place = ca.MX.sym("q", n, N)
        by_coordinate = ca.Function("gradients", [place, theta], family.jacobian(place, theta))
        parts: list[Any] = by_coordinate.call([ca.MX(ca.DM(drawn.points.T)), theta])
        J = ca.vertcat(*(gradient[i, :] for i in range(n) for gradient in parts))
    gradients = ca.Function("J", [theta], [J])(theta0).full().T.reshape(len(drawn), -1, problem.r)
    orientation = drawn.orientation(gradients.transpose(0, 2, 1))
    # Map the loss of one sample over all samples
    sizes = Sizes(problem.n, problem.m, problem.r, drawn.metric_inverse is None)
    of_sample = Loss.of(sizes, Weights.of(weights).for_problem(problem).by_name)
    one, column = build_sample_loss(of_sample), ca.SX.sym("J", problem.r * problem.n)
    symbols = [ca.SX.sym(name, one.numel_in(1 + k)) for k, name in enumerate(of_sample.data)]
    shaped = [ca.reshape(symbol, *one.size_in(1 + k)) for k, symbol in enumerate(symbols)]
    value = one(ca.reshape(column, problem.r, problem.n), *shaped)
    losses = ca.Function("losses", [column, *symbols], [value]).map(len(drawn))
    # The mean loss. The data of the samples are columns (entries, N), with the entries of matrices column by column
    data = drawn.collect_data(of_sample.data, orientation)
    flat = [(part.transpose(0, 2, 1) if part.ndim == 3 else part).reshape(len(part), -1).T for part in data]
    mean = ca.sum2(losses(J, *map(ca.DM, flat))) / len(drawn)
    return ca.Function("loss", [theta], [mean], ["theta"], ["loss"])
