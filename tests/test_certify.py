"""Certificates hold: the arithmetic contains the truth, folds are never certified, and a changed chart has no proof."""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from public_objects import fitted, given, network, planar
from typer.testing import CliRunner

import orthocas as oc
from orthocas import problems
from orthocas.casadi_tools.batch import dense_function
from orthocas.certificates import Subdivision
from orthocas.certificates.subdivision import OPEN, PROVED
from orthocas.certifying import functions
from orthocas.certifying.chart_rows import chart_rows, joint_models
from orthocas.certifying.elementary import exponential, hyperbolic_tangent, sine_and_cosine
from orthocas.certifying.elimination import in_singular_basis, lower_bound, pivots
from orthocas.certifying.graph import TaylorGraph
from orthocas.certifying.monomials import monomials
from orthocas.certifying.taylor import TaylorModel
from orthocas.certifying.volume import conditioning_bound
from orthocas.checks import Array
from orthocas.cli.commands import app_for
from orthocas.coordinates.fitted import Coordinates
from orthocas.errors import CertifyError, ChartFileError, Interrupted, InvalidValueError, SchedulerError
from orthocas.minimising.watch import Progress
from orthocas.samples import samples_at

RNG = 5
ROUNDING = 1e-13  # of numbers of size 1 in the plain evaluation that a model is compared with


@cache
def chart(width: float = 0.2) -> oc.Chart:
    """The 7-DoF arm on a small cube."""
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, known.task, domain=oc.Box(known.domain.centre, width))
    return oc.fit(problem, oc.Polynomial(2), samples=300).chart


@cache
def certified(width: float = 0.2) -> oc.Certificate:
    return oc.certify(chart(width), time_limit=100)


def fourier() -> oc.Chart:
    return oc.fit(planar("euclidean"), oc.Fourier(2), samples=300).chart


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
    powers = np.stack([t[:, list(m)].prod(axis=1) for m in monomials(model.variables)])
    return np.asarray((model.coefficients * powers.reshape(len(powers), *[1] * (model.remainder.ndim - 1), -1)).sum(0))


# --- the arithmetic


def test_sine_cosine_and_exponential_contain_the_exact_values() -> None:
    points = np.random.default_rng(RNG).uniform(-9, 9, 60)
    (s, s_error), (c, c_error) = sine_and_cosine(points)
    e, e_error = exponential(points)
    for k, x in enumerate(points):
        sine = exact_series(x, lambda j: Fraction((0, 1, 0, -1)[j % 4], factorial(j)), 70)
        cosine = exact_series(x, lambda j: Fraction((1, 0, -1, 0)[j % 4], factorial(j)), 70)
        power = exact_series(x, lambda j: Fraction(1, factorial(j)), 80)
        assert abs(Fraction(s[k]) - sine) < Fraction(s_error[k]) < Fraction(1, 10**14)
        assert abs(Fraction(c[k]) - cosine) < Fraction(c_error[k])
        assert abs(Fraction(e[k]) - power) < Fraction(e_error[k])


def test_sines_of_large_numbers_contain_the_values_of_the_sum_formula() -> None:
    half = np.random.default_rng(RNG).uniform(1e3, 4e5, 1000)
    (s, error), (c, _) = sine_and_cosine(half)
    (double, double_error), _ = sine_and_cosine(2 * half)
    assert (np.abs(double - 2 * s * c) <= double_error + 4 * error + 1e-15).all()


def test_tanh_is_within_its_error_of_the_library() -> None:
    points = np.random.default_rng(RNG).uniform(-25, 25, 1000)
    value, error = hyperbolic_tangent(points)
    assert (np.abs(value - np.tanh(points)) <= error + 2e-16).all()
    assert error.max() < 1e-13


@pytest.mark.parametrize("x", [1e7, np.inf, np.nan])
def test_nothing_is_known_outside_the_range_of_the_proof(x: float) -> None:
    assert np.isinf(sine_and_cosine(np.array([x]))[0][1]).all()
    assert np.isinf(exponential(np.array([x]))[1]).all()


@pytest.mark.parametrize("name", [*functions.UNARY])
def test_functions_of_models_contain_sampled_values(name: str) -> None:
    rng = np.random.default_rng(RNG)
    low = rng.uniform(0.3, 0.6, (200, 2))
    (x, y), _ = joint_models(low, low + rng.uniform(0, 0.2, (200, 2)), (0, 1))
    t = rng.uniform(-1, 1, (200, 2))
    inner = x * y + x
    model = functions.UNARY[name](inner)
    q = [x.centre + x.coefficients[1] * t[:, 0], y.centre + y.coefficients[1] * t[:, 1]]
    v = ca.SX.sym("v")
    made = {"assign": v, "neg": -v, "twice": 2 * v, "sq": v * v, "inv": 1 / v}
    f = ca.Function("f", [v], [made[name] if name in made else getattr(ca, name)(v)])
    true = np.array(f((q[0] * q[1] + q[0])[None])).ravel()
    error = np.abs(values_at(model, t) - true)
    assert (error <= model.remainder + ROUNDING * (1 + np.abs(true))).all()
    assert np.isfinite(model.remainder).mean() > 0.9


def test_reciprocals_and_roots_give_up_where_they_may_be_undefined() -> None:
    (x,), _ = joint_models(np.array([[-0.1]]), np.array([[0.2]]), (0,))
    for function in (functions.reciprocal, functions.square_root, functions.reciprocal_square_root):
        assert not np.isfinite(function(x).remainder).any()
        assert not (lower_bound(function(x)) > -np.inf).any()


def test_exact_products_lie_within_the_remainder() -> None:
    rng = np.random.default_rng(RNG)
    a, b = (
        TaylorModel((0, 1), np.concatenate([rng.normal(size=(10, 20))]), rng.uniform(0, 1e-3, 20)) for _ in range(2)
    )
    product = a * b
    t = [Fraction(1, 3), Fraction(-5, 7)]
    for box in range(20):
        exact = []
        for model in (a, b, product):
            powers = [Fraction(1) * np.prod([t[v] for v in m] or [Fraction(1)]) for m in monomials((0, 1))]
            exact.append(sum(Fraction(c) * p for c, p in zip(model.coefficients[:, box], powers, strict=True)))
        ends = [
            (exact[0] + Fraction(a.remainder[box]) * i) * (exact[1] + Fraction(b.remainder[box]) * j)
            for i in (-1, 1)
            for j in (-1, 1)
        ]
        assert all(abs(end - exact[2]) <= Fraction(product.remainder[box]) for end in ends)


def test_lower_bounds_lie_below_all_values_and_are_sharp_for_parabolas() -> None:
    rng = np.random.default_rng(RNG)
    model = TaylorModel((0, 1), rng.normal(size=(10, 50)), rng.uniform(0, 0.1, 50))
    bound = lower_bound(model)
    for _ in range(200):
        assert (values_at(model, rng.uniform(-1, 1, (50, 2))) - model.remainder >= bound).all()
    (x,), _ = joint_models(np.array([[-1.0]]), np.array([[2.0]]), (0,))
    assert lower_bound(x * x)[0] == pytest.approx(0, abs=1e-12)


# --- the Jacobian


@pytest.mark.parametrize("build", [chart, network, given, fourier])
def test_models_of_the_jacobian_contain_it(build: Callable[[], oc.Chart]) -> None:
    known = build()
    rng = np.random.default_rng(RNG)
    domain, rows = known.problem.domain, chart_rows(known)
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
    known, rng = chart(), np.random.default_rng(RNG)
    domain, rows = known.problem.domain, chart_rows(known)
    half = np.full((50, 7), 0.02)
    middle = domain.centre + 0.18 * rng.uniform(-1, 1, (50, 7))
    turned, signs = in_singular_basis(rows(middle - half, middle + half))
    found = np.prod([p.centre for p in pivots(turned)], axis=0) * signs
    true = np.linalg.det(known.jacobian(middle)) / known.coordinates.scale.prod()
    assert np.allclose(found, true, rtol=1e-9)


def test_bounds_of_the_conditioning_lie_below_it() -> None:
    known, rng = chart(), np.random.default_rng(RNG)
    domain, rows = known.problem.domain, chart_rows(known)
    half = np.full((40, 7), 0.05)
    middle = domain.centre + 0.15 * rng.uniform(-1, 1, (40, 7))
    bound = conditioning_bound(rows(middle - half, middle + half), known.m)
    assert (bound > 0.2).all()
    for _ in range(50):
        q = middle + half * rng.uniform(-1, 1, middle.shape)
        samples = samples_at(known.problem, q)
        unit = known.coordinates.jacobian(q)
        unit /= np.linalg.norm(unit, axis=2, keepdims=True)
        smallest = np.linalg.svd(np.concatenate([samples.task_basis, unit], axis=1), compute_uv=False)[:, -1]
        assert (smallest >= bound).all()


# --- proofs


@pytest.mark.parametrize("build", [chart, network, given, fourier, lambda: fitted().chart])
def test_regular_charts_are_certified_and_checked(build: Callable[[], oc.Chart]) -> None:
    known = build()
    certificate = oc.certify(known)
    assert certificate.proved
    assert certificate.share == 1.0
    assert oc.check_certificate(known, certificate)


@pytest.mark.parametrize(("build", "rounds"), [(lambda: fitted().chart, 10), (lambda: chart(0.4), 1)])
def test_a_million_points_near_the_worst_corners_do_not_refute_a_proof(
    build: Callable[[], oc.Chart], rounds: int
) -> None:
    known = build()
    certificate = certified(0.4) if known is chart(0.4) else oc.certify(known)
    assert certificate.proved
    rng = np.random.default_rng(RNG)
    low, high = certificate.regular.leaves(PROVED)
    ends = (parts[rng.integers(0, len(low), 5000)] for parts in (low, high))
    corners = np.where(rng.integers(0, 2, (5000, known.n)), *ends)
    sign = np.sign(np.linalg.det(known.jacobian(known.problem.domain.centre)))
    worst = corners[np.argsort(np.linalg.det(known.jacobian(corners)) * sign)[:1000]]
    domain = known.problem.domain
    for _ in range(rounds):
        near = np.repeat(worst, 100, axis=0) + rng.normal(size=(100_000, known.n)) * 0.01
        near = np.clip(near, domain.centre - domain.half_width, domain.centre + domain.half_width)
        assert (np.linalg.det(known.jacobian(near)) * sign > 0).all()


def test_the_default_chart_of_the_arm_folds_and_is_never_certified() -> None:
    folding = oc.fit(problems.get("iiwa"), oc.Polynomial(3)).chart
    certificate = oc.certify(folding, time_limit=5)
    assert not certificate.proved
    if certificate.fold:
        signs = np.sign(np.linalg.det(folding.jacobian(np.array(certificate.fold))))
        assert signs[0] != signs[1]
        assert certificate.share == 0


def dipped(depth: float, width: float = 1e-8) -> oc.Chart:
    """xi = q1 + q2 + q3 with a dip: its slope along q3 falls by `depth` on a part of the width of a hair."""
    arm = problems.get("planar_3r_xy")
    place = float(arm.domain.centre[2]) + 0.1234567

    def xi(q: ca.SX) -> ca.SX:
        return q[0] + q[1] + q[2] - depth * width * ca.tanh((q[2] - place) / width)

    return oc.fit(arm, oc.Given.from_function("dip", 3, xi)).chart


def test_a_fold_smaller_than_any_sampling_sees_is_never_certified() -> None:
    folding = dipped(30.0)
    q = folding.problem.domain.centre + np.array([0, 0, 0.1234567])
    signs = np.sign(np.linalg.det(folding.jacobian(np.array([q, folding.problem.domain.centre]))))
    assert signs[0] != signs[1]  # it folds
    assert oc.evaluate(folding, samples=20_000).folded_samples == 0  # and nobody sees it
    assert not oc.certify(folding, time_limit=1).proved


def test_a_dip_that_is_no_fold_is_certified() -> None:
    assert oc.certify(dipped(0.1, 0.1)).proved


def test_a_chart_for_all_positions_of_a_cyclic_joint_is_certified() -> None:
    known = problems.get("iiwa")
    problem = oc.Problem(known.robot, known.task, domain=oc.Box(known.domain.centre, 0.15))
    cyclic = oc.fit(problem, oc.Polynomial(2, cyclic=["A1"]), samples=300).chart
    certificate = oc.certify(cyclic, time_limit=60)
    assert certificate.proved
    assert certificate.boxes < 500  # A1 is never halved: J does not depend on it


def test_a_certified_box_of_a_folding_chart_holds_no_fold() -> None:
    arm = problems.get("planar_3r_xy")
    domain = oc.Box([0.6, 0.8, 0.8], 0.9)
    folding = oc.fit(oc.Problem(arm.robot, arm.task, domain=domain), oc.Linear()).chart
    assert oc.evaluate(folding, samples=20_000).folded_samples > 0
    box = oc.certified_box(folding, time_limit=20)
    assert 0.1 < box.half_width[0] < 0.9
    inside = box.centre + box.half_width * np.random.default_rng(RNG).uniform(-1, 1, (100_000, 3))
    signs = np.sign(np.linalg.det(folding.jacobian(inside)))
    assert len(np.unique(signs)) == 1


def test_a_bound_of_the_conditioning_is_proved_below_the_sampled_minimum() -> None:
    certificate = oc.certify(chart(), 0.5)
    assert certificate.proved
    assert 0.5 <= certificate.conditioning <= oc.evaluate(chart(), samples=5000).conditioning.min
    assert oc.check_certificate(chart(), certificate)
    with pytest.raises(InvalidValueError, match="bound is 1.5, expected a number from 0 to below 1"):
        oc.certify(chart(), 1.5)
    with pytest.raises(CertifyError, match="metric inertia"):
        oc.certify(oc.fit(planar(), oc.Linear()).chart, 0.1)


def test_two_points_of_the_one_to_one_box_never_share_phi() -> None:
    part = certified().injective
    assert part is not None
    rng = np.random.default_rng(RNG)
    J = np.linalg.inv(chart().jacobian(chart().problem.domain.centre))
    q = rng.uniform(part.low, part.high, (20_000, 7))
    p = rng.uniform(part.low, part.high, (20_000, 7))
    change = (chart().phi(q) - chart().phi(p)) @ J.T
    assert (((q - p) * change).sum(axis=1) > 0).all()


# --- certificates


def test_a_certificate_is_void_when_one_coefficient_changes(tmp_path: Path) -> None:
    known = replace(chart(), certificate=certified())
    coordinates = known.coordinates
    assert isinstance(coordinates, Coordinates)
    theta = coordinates.theta.copy()
    theta[3] = np.nextafter(theta[3], np.inf)
    with pytest.raises(CertifyError, match="void"):
        replace(known, coordinates=replace(coordinates, theta=theta))
    changed = replace(known, coordinates=replace(coordinates, theta=theta), certificate=None)
    with pytest.raises(CertifyError, match="void"):
        oc.check_certificate(changed, certified())
    replace(known, notes={"new": "note"}).save(tmp_path / "a.chart")  # notes are no part of the proof
    assert oc.load(tmp_path / "a.chart").certificate is not None


def test_files_keep_certificates(tmp_path: Path) -> None:
    replace(chart(), certificate=certified()).save(tmp_path / "a.chart")
    again = oc.load(tmp_path / "a.chart")
    assert again.certificate is not None
    assert again.certificate.facts() == certified().facts()
    assert oc.check_certificate(again)


def test_a_forged_certificate_does_not_hold() -> None:
    known = certified()
    whole = Subdivision(known.regular.low, known.regular.high, np.array([PROVED], dtype=np.uint8))
    wide = chart(0.4)
    honest = certified(0.4)
    forged = replace(honest, regular=Subdivision(honest.regular.low, honest.regular.high, whole.codes))
    assert not oc.check_certificate(wide, forged)
    other = replace(honest, regular=known.regular)
    with pytest.raises(CertifyError, match="another domain"):
        oc.check_certificate(wide, other)
    with pytest.raises(CertifyError, match="method"):
        oc.check_certificate(wide, replace(honest, method="guess/1"))
    too_good = replace(honest, conditioning=0.99)
    assert not oc.check_certificate(wide, too_good)


@pytest.mark.parametrize("codes", [[0], [0, PROVED], [PROVED, PROVED], [7, PROVED, PROVED], []])
def test_bytes_that_are_no_tree_are_refused(codes: list[int]) -> None:
    with pytest.raises(InvalidValueError, match="codes"):
        Subdivision(np.zeros(2), np.ones(2), np.array(codes, dtype=np.uint8))


def test_parts_cover_the_box_exactly() -> None:
    parts = certified().regular
    low, high = parts.leaves(PROVED)
    assert ((high - low) / (parts.high - parts.low)).prod(axis=1).sum() == pytest.approx(1, abs=1e-12)
    tree = Subdivision(np.zeros(2), np.ones(2), np.array([0, PROVED, 1, OPEN, PROVED], dtype=np.uint8))
    assert tree.share == 0.75
    assert tree.leaves(OPEN)[0].tolist() == [[0.5, 0.0]]
    assert tree.leaves(OPEN)[1].tolist() == [[1.0, 0.5]]


def test_an_unfinished_proof_is_resumed() -> None:
    wide = chart(0.3)
    begun = oc.certify(wide, time_limit=0)
    assert not begun.proved
    assert begun.regular.open_count > 0
    assert oc.certify(wide, resume=begun).proved
    with pytest.raises(CertifyError, match="resume"):
        oc.certify(wide, 0.1, resume=begun)


def test_ctrl_c_returns_what_is_proved_so_far() -> None:
    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        oc.certify(chart(0.3), monitor=stop)
    result = stopped.value.result
    assert isinstance(result, oc.Certificate)
    assert oc.certify(chart(0.3), resume=result).proved


def test_an_executor_finds_the_same_parts() -> None:
    with ThreadPoolExecutor(2) as executor:
        shared = oc.certify(chart(), executor=executor)
        assert oc.check_certificate(chart(), shared, executor=executor)
    assert shared.regular.codes.tolist() == certified().regular.codes.tolist()


def test_what_cannot_be_certified_is_refused() -> None:
    grown = oc.grow(problems.get("planar_2r"), 1.0, origin=[np.pi / 3, 0.0])
    with pytest.raises(CertifyError, match="expected a fitted chart"):
        oc.certify(grown)
    arm = planar("euclidean")
    bent = oc.Task.custom(arm.robot, "kinked", lambda q: ca.fabs(q[0]) + q[1] ** 1.5)
    kinked = oc.fit(oc.Problem(arm.robot, bent, domain=oc.Box([0.6, 0.8, 0.8], 0.1)), oc.Linear()).chart
    with pytest.raises(CertifyError, match="cannot be certified"):
        oc.certify(kinked)
    with pytest.raises(CertifyError, match="no certificate"):
        oc.check_certificate(chart())


def test_graphs_with_whole_powers_are_bounded() -> None:
    q = ca.SX.sym("q", 2)
    f = dense_function("f", [q], [ca.vertcat(q[0] ** 5 / q[1], q[1] ** -3)])
    joints, _ = joint_models(np.array([[1.0, 2.0]]), np.array([[1.1, 2.2]]), (0, 1))
    for k, model in enumerate(TaylorGraph.of(f, "it")(joints)):
        true = float(f([1.1, 2.2])[k])
        assert abs(values_at(model, np.ones((1, 2)))[0] - true) <= model.remainder[0] + 1e-14


# --- the command


def command(*words: Any) -> Any:
    return CliRunner().invoke(app_for(list(map(str, words))), [str(word) for word in words])


def test_the_command_certifies_checks_and_shows(tmp_path: Path) -> None:
    path = tmp_path / "a.chart"
    chart().save(path)
    done = command("certify", path, "--json")
    assert done.exit_code == 0
    found = json.loads(done.stdout)
    assert found["proved"] is True
    assert found["share"] == 1
    assert {"bound", "boxes", "seconds", "conditioning"} <= found.keys()
    assert command("certify", path, "--check").exit_code == 0
    assert "no fold everywhere" in command("certify", path, "--check").stdout
    assert json.loads(command("info", path, "--json").stdout)["certificate"]["proved"] is True
    oc.generate_c(oc.load(path), tmp_path / "c", name="arm")
    assert "no fold everywhere on the domain (taylor-3/1" in (tmp_path / "c" / "arm.h").read_text()


def test_the_command_fails_for_a_chart_that_folds(tmp_path: Path) -> None:
    path = tmp_path / "a.chart"
    oc.fit(planar(), oc.Linear()).chart.save(path)
    done = command("certify", path)
    assert done.exit_code == 1
    assert "refuted, the chart folds" in done.stdout


def test_a_damaged_certificate_is_a_damaged_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = replace(chart(), certificate=certified())
    monkeypatch.setitem(certified().regular.__dict__, "codes", np.array([3, PROVED], dtype=np.uint8))
    known.save(tmp_path / "a.chart")
    with pytest.raises(ChartFileError, match="codes"):
        oc.load(tmp_path / "a.chart")


def test_dask_shares_the_work() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client,
        client.get_executor() as executor,
    ):
        assert oc.certify(chart(), executor=executor).regular.codes.tolist() == certified().regular.codes.tolist()


def test_the_command_names_a_missing_scheduler(tmp_path: Path) -> None:
    chart().save(tmp_path / "a.chart")
    done = command("certify", tmp_path / "a.chart", "--scheduler", "tcp://127.0.0.1:1")
    assert done.exit_code != 0
    assert isinstance(done.exception, SchedulerError)
