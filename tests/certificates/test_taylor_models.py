"""Taylor models contain the truth: functions, products, determinants, and the Jacobian of charts."""

from collections.abc import Callable
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from certified_charts import chart, fourier
from public_objects import given, network, partly_linear

import orthocas as oc
from orthocas.certificates import taylor
from orthocas.certificates.box_checks import bound_conditioning, compute_pivots, lower_bound, rotate_to_singular_basis
from orthocas.certificates.graph import TaylorGraph
from orthocas.certificates.rows import build_chart_rows, build_joint_models
from orthocas.certificates.taylor import (
    TaylorModel,
    compute_margin,
    evaluate_exponential,
    evaluate_sine_cosine,
    evaluate_tanh,
    list_monomials,
    sum_error,
)
from orthocas.tasks.samples import evaluate_samples
from orthocas.tools.batch import dense_function
from orthocas.tools.checks import Array

ROUNDING = 1e-13  # of numbers of size 1 in the plain evaluation that a model is compared with


def exact_series(x: float, terms: Callable[[int], Fraction], count: int) -> Fraction:
    """sum_k terms(k) x^k in exact arithmetic."""
    total, power = Fraction(0), Fraction(1)
    for k in range(count):
        total += terms(k) * power
        power *= Fraction(x)
    return total


def factorial(k: int) -> int:
    return k * factorial(k - 1) if k else 1


def values_at(model: TaylorModel, t: Array) -> Array:
    """The polynomial of a model at t (boxes, n)."""
    powers = np.stack([t[:, list(m)].prod(axis=1) for m in list_monomials(model.variables)])
    return np.asarray((model.coefficients * powers.reshape(len(powers), *[1] * (model.remainder.ndim - 1), -1)).sum(0))


@pytest.mark.slow
def test_sine_cosine_and_exponential_contain_the_exact_values() -> None:
    points = np.random.default_rng(5).uniform(-9, 9, 60)
    (s, s_error), (c, c_error) = evaluate_sine_cosine(points)
    e, e_error = evaluate_exponential(points)
    for k, x in enumerate(points):
        sine = exact_series(x, lambda j: Fraction((0, 1, 0, -1)[j % 4], factorial(j)), 70)
        cosine = exact_series(x, lambda j: Fraction((1, 0, -1, 0)[j % 4], factorial(j)), 70)
        power = exact_series(x, lambda j: Fraction(1, factorial(j)), 80)
        assert abs(Fraction(s[k]) - sine) < Fraction(s_error[k]) < Fraction(1, 10**14)
        assert abs(Fraction(c[k]) - cosine) < Fraction(c_error[k])
        assert abs(Fraction(e[k]) - power) < Fraction(e_error[k])


def test_sines_of_large_numbers_contain_the_values_of_the_sum_formula() -> None:
    half = np.random.default_rng(5).uniform(1e3, 4e5, 1000)
    (s, error), (c, _) = evaluate_sine_cosine(half)
    (double, double_error), _ = evaluate_sine_cosine(2 * half)
    assert (np.abs(double - 2 * s * c) <= double_error + 4 * error + 1e-15).all()


def test_tanh_is_within_its_error_of_the_library() -> None:
    points = np.random.default_rng(5).uniform(-25, 25, 1000)
    value, error = evaluate_tanh(points)
    assert (np.abs(value - np.tanh(points)) <= error + 2e-16).all()
    assert error.max() < 1e-13


@pytest.mark.parametrize("x", [1e7, np.inf, np.nan])
def test_nothing_is_known_outside_the_range_of_the_proof(x: float) -> None:
    assert np.isinf(evaluate_sine_cosine(np.array([x]))[0][1]).all()
    assert np.isinf(evaluate_exponential(np.array([x]))[1]).all()


@pytest.mark.parametrize("name", [*taylor.UNARY])
def test_functions_of_models_contain_sampled_values(name: str) -> None:
    rng = np.random.default_rng(5)
    low = rng.uniform(0.3, 0.6, (200, 2))
    (x, y), _ = build_joint_models(low, low + rng.uniform(0, 0.2, (200, 2)), (0, 1))
    t = rng.uniform(-1, 1, (200, 2))
    inner = x * y + x
    model = taylor.UNARY[name](inner)
    q = [x.centre + x.coefficients[1] * t[:, 0], y.centre + y.coefficients[1] * t[:, 1]]
    v = ca.SX.sym("v")
    made = {"assign": v, "neg": -v, "twice": 2 * v, "sq": v * v, "inv": 1 / v}
    f = ca.Function("f", [v], [made[name] if name in made else getattr(ca, name)(v)])
    true = np.array(f((q[0] * q[1] + q[0])[None])).ravel()
    error = np.abs(values_at(model, t) - true)
    assert (error <= model.remainder + ROUNDING * (1 + np.abs(true))).all()
    assert np.isfinite(model.remainder).mean() > 0.9


def test_reciprocals_and_roots_give_up_where_they_may_be_undefined() -> None:
    (x,), _ = build_joint_models(np.array([[-0.1]]), np.array([[0.2]]), (0,))
    for function in (taylor.reciprocal, taylor.square_root, taylor.reciprocal_square_root):
        assert not np.isfinite(function(x).remainder).any()
        assert not (lower_bound(function(x)) > -np.inf).any()


def test_exact_products_lie_within_the_remainder() -> None:
    rng = np.random.default_rng(5)
    a, b = (
        TaylorModel((0, 1), np.concatenate([rng.normal(size=(10, 20))]), rng.uniform(0, 1e-3, 20)) for _ in range(2)
    )
    product = a * b
    t = [Fraction(1, 3), Fraction(-5, 7)]
    for box in range(20):
        exact = []
        for model in (a, b, product):
            powers = [Fraction(1) * np.prod([t[v] for v in m] or [Fraction(1)]) for m in list_monomials((0, 1))]
            exact.append(sum(Fraction(c) * p for c, p in zip(model.coefficients[:, box], powers, strict=True)))
        ends = [
            (exact[0] + Fraction(a.remainder[box]) * i) * (exact[1] + Fraction(b.remainder[box]) * j)
            for i in (-1, 1)
            for j in (-1, 1)
        ]
        assert all(abs(end - exact[2]) <= Fraction(product.remainder[box]) for end in ends)


def test_lower_bounds_lie_below_all_values_and_are_sharp_for_parabolas() -> None:
    rng = np.random.default_rng(5)
    model = TaylorModel((0, 1), rng.normal(size=(10, 50)), rng.uniform(0, 0.1, 50))
    bound = lower_bound(model)
    for _ in range(200):
        assert (values_at(model, rng.uniform(-1, 1, (50, 2))) - model.remainder >= bound).all()
    (x,), _ = build_joint_models(np.array([[-1.0]]), np.array([[2.0]]), (0,))
    assert lower_bound(x * x)[0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("build", [chart, network, partly_linear, given, fourier])
def test_models_of_the_jacobian_contain_it(build: Callable[[], oc.Chart]) -> None:
    known = build()
    rng = np.random.default_rng(5)
    domain, rows = known.problem.domain, build_chart_rows(known)
    half = domain.half_width / 3
    middle = domain.centre + (domain.half_width - half) * rng.uniform(-1, 1, (300, known.n))
    t = rng.uniform(-1, 1, (300, known.n))
    J = rows(middle - half, middle + half)
    q = middle + half * t
    true = known.coordinates.jacobian(q)[:, :, list(rows.active)][:, : len(rows.active) - known.m]
    true = np.moveaxis(true / known.coordinates.scale[:, None], 0, -1)
    found = values_at(J, t)[known.m :]
    size = np.abs(true).max()
    assert (np.abs(found - true) <= J.remainder[known.m :] + ROUNDING * size).all()
    J_x = np.moveaxis(known.problem.task.batched_jacobian(q)[0].reshape(-1, known.m, known.n), 0, -1)[
        :, list(rows.active)
    ]
    gram = np.einsum("mib,mjb->ijb", J_x, J_x)
    rotated = values_at(J, t)[: known.m]
    slack = 3 * (J.remainder[: known.m] * np.abs(rotated).max()).sum(axis=(0, 1)) + 1e-12
    assert (np.abs(np.einsum("mib,mjb->ijb", rotated, rotated) - gram) <= slack).all()  # J_x up to a rotation


def test_products_of_pivots_are_the_determinant() -> None:
    known, rng = chart(), np.random.default_rng(5)
    domain, rows = known.problem.domain, build_chart_rows(known)
    half = np.full((50, 7), 0.02)
    middle = domain.centre + 0.18 * rng.uniform(-1, 1, (50, 7))
    turned, signs = rotate_to_singular_basis(rows(middle - half, middle + half))
    found = np.prod([p.centre for p in compute_pivots(turned)], axis=0) * signs
    true = np.linalg.det(known.jacobian(middle)) / known.coordinates.scale.prod()
    assert np.allclose(found, true, rtol=1e-9)


def test_bounds_of_the_conditioning_lie_below_it() -> None:
    known, rng = chart(), np.random.default_rng(5)
    domain, rows = known.problem.domain, build_chart_rows(known)
    half = np.full((40, 7), 0.05)
    middle = domain.centre + 0.15 * rng.uniform(-1, 1, (40, 7))
    bound = bound_conditioning(rows(middle - half, middle + half), known.m)
    assert (bound > 0.2).all()
    for _ in range(50):
        q = middle + half * rng.uniform(-1, 1, middle.shape)
        samples = evaluate_samples(known.problem, q)
        unit = known.coordinates.jacobian(q)
        unit /= np.linalg.norm(unit, axis=2, keepdims=True)
        smallest = np.linalg.svd(np.concatenate([samples.task_basis, unit], axis=1), compute_uv=False)[:, -1]
        assert (smallest >= bound).all()


def test_graphs_with_whole_powers_are_bounded() -> None:
    q = ca.SX.sym("q", 2)
    f = dense_function("f", [q], [ca.vertcat(q[0] ** 5 / q[1], q[1] ** -3)])
    joints, _ = build_joint_models(np.array([[1.0, 2.0]]), np.array([[1.1, 2.2]]), (0, 1))
    for k, model in enumerate(TaylorGraph.build(f, "it")(joints)):
        true = float(f([1.1, 2.2])[k])
        assert abs(values_at(model, np.ones((1, 2)))[0] - true) <= model.remainder[0] + 1e-14


@pytest.mark.parametrize("count", [3, 10, 20])
def test_lower_bounds_of_long_sums_lie_below_the_exact_ones(count: int) -> None:
    """1 + many numbers below half of its spacing: each of them is lost, and all roundings go the same way."""
    variables = tuple(range(count))
    coefficients = np.full((len(list_monomials(variables)), 2), 2**-53 * 0.9999)  # two boxes: NumPy adds row by row
    coefficients[
        [list_monomials(variables).index((v, v)) for v in variables]
    ] *= -1  # least at the ends of the interval
    coefficients[1 + count + 1] = 1.0
    exact = [Fraction(float(value)) for value in coefficients[:, 0]]
    bound = lower_bound(TaylorModel(variables, coefficients, np.zeros(2)))[0]
    assert Fraction(float(bound)) <= exact[0] - sum(map(abs, exact[1:]))


def test_the_error_of_a_sum_grows_with_its_terms() -> None:
    for terms in (1, 250, 286, 1771, 10**6):
        exact = Fraction(terms, 2**53) / (1 - Fraction(terms, 2**53))
        assert exact < Fraction(sum_error(terms)) < exact + Fraction(1, 2**53) * (9 + terms // 50)
        assert Fraction(compute_margin(terms)) > 1 + exact
