"""Corridors: the surroundings of a path of postures, and one chart for a long motion there."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from programs import Run

import orthocas as oc
from orthocas import codegen, problems
from orthocas.certificates import check_certificate
from orthocas.certificates.outside import choose_check
from orthocas.certificates.rows import build_chart_rows
from orthocas.control import ControlStatus
from orthocas.errors import DomainError, InvalidValueError, ShapeError, UnreachableReferenceError
from orthocas.paths import corridor_problem
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.samples import sample_boundary_weighted, sample_uniform
from orthocas.tools.checks import Array

PATH = np.array([[0.0, 0.6, 0.8], [0.7, 0.9, 1.2], [0.9, 1.7, 1.2]])
RADIUS = 0.3


def corridor(radius: Any = RADIUS) -> Corridor:
    low, high = PATH.min(axis=0) - 0.3, PATH.max(axis=0) + 0.25
    return Corridor(oc.Box.from_limits(low, high), PATH, radius)


def circle(problem: oc.Problem, q: Array, size: float, steps: int = 60) -> Array:
    """A closed circle of the tool that begins at a posture."""
    turn = np.linspace(0, 2 * np.pi, steps)
    x = problem.task.batched(q[None])[0][0]
    return np.asarray(x + size * np.column_stack([np.cos(turn) - 1, np.sin(turn)]))


def pseudo_inverse(problem: oc.Problem, q: Array, x: Array) -> Array:
    """Postures along task values, by steps of least norm."""
    found = []
    for wanted in x:
        for _ in range(4):
            J = problem.task.batched_jacobian(q[None])[0].reshape(problem.m, problem.n)
            q = q + np.linalg.pinv(J) @ (wanted - problem.task.batched(q[None])[0][0])
        found.append(q)
    return np.array(found)


@pytest.fixture(scope="module")
def loop() -> tuple[oc.Problem, Array, Array]:
    """A problem, a circle of the tool of 0.5 m radius, and the postures of the pseudo-inverse along it."""
    known = problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, domain=known.domain)
    q = np.array([0.3, 0.5, 1.4])
    x = circle(problem, q, 0.5)
    return problem, x, pseudo_inverse(problem, q, x)


@pytest.fixture(scope="module")
def chart(loop: tuple[oc.Problem, Array, Array]) -> oc.Chart:
    problem, _, postures = loop
    return oc.fit(corridor_problem(problem, postures, 0.3), oc.Polynomial(3, "auto"), samples=400).chart


def test_positions_inside_are_those_near_the_lines_between_postures() -> None:
    domain, q = corridor(), np.random.default_rng(7).uniform(-0.5, 2.0, (2000, 3))
    dense = np.vstack([a + np.linspace(0, 1, 400)[:, None] * (b - a) for a, b in pairwise(PATH)])
    distance = np.linalg.norm(q[:, None] - dense, axis=2).min(axis=1)
    sure = np.abs(distance - RADIUS) > 1e-3
    in_box = oc.Box(domain.centre, domain.half_width).contains(q)
    assert np.array_equal(domain.contains(q)[sure], ((distance < RADIUS) & in_box)[sure])
    assert 50 < domain.contains(q).sum() < 500
    pivots = np.array([float(domain.pivots(point)) for point in q])
    assert np.array_equal(pivots > 0, domain.contains(q) | ~in_box & (pivots > 0))


def test_joints_with_an_infinite_radius_do_not_count() -> None:
    domain = corridor([np.inf, RADIUS, RADIUS])
    assert domain.contains([-0.2, 1.7, 1.2])
    assert not corridor().contains([-0.2, 1.7, 1.2])


def test_samples_are_uniform() -> None:
    domain, rng = corridor(), np.random.default_rng(7)
    drawn = sample_uniform(domain, 20_000, 1)
    box = domain.centre + domain.half_width * rng.uniform(-1, 1, (200_000, 3))
    kept = box[domain.contains(box)]
    assert domain.contains(drawn).all()
    for k in range(3):  # Kolmogorov and Smirnov: 1.95 sqrt(1/N + 1/M) is exceeded by one of a thousand
        a, b = np.sort(drawn[:, k]), np.sort(kept[:, k])
        places = np.concatenate([a, b])
        gap = np.abs(np.searchsorted(a, places) / len(a) - np.searchsorted(b, places) / len(b)).max()
        assert gap < 1.95 * np.sqrt(1 / len(a) + 1 / len(b))
    assert domain.contains(sample_boundary_weighted(domain, 300, 2)).all()


@pytest.mark.slow
def test_loop_closes_where_the_pseudo_inverse_drifts(loop: tuple[oc.Problem, Array, Array], chart: oc.Chart) -> None:
    _, x, postures = loop
    drift = np.abs(postures[-1] - postures[0]).max()
    q, xi = postures[0], chart.xi(postures[0])
    for wanted in x:
        q = chart.inverse(np.concatenate([wanted, xi]), q_start=q)
        assert chart.problem.domain.contains(q)
    assert drift > 0.01
    assert np.abs(q - postures[0]).max() < 1e-6 * drift
    assert oc.evaluate(chart, 1000).conditioning.min > 0.5


@pytest.mark.slow
def test_certificate_covers_the_corridor_and_leaves_out_nothing_of_it(chart: oc.Chart) -> None:
    domain = chart.problem.domain
    certificate = oc.certify(chart)
    assert certificate.proved
    assert check_certificate(chart, certificate)
    judge = choose_check(chart, build_chart_rows(chart), 0.0)
    rng = np.random.default_rng(7)
    middle = rng.uniform(-1, 1, (200, 3))
    corners = [domain.centre + domain.half_width * (middle + side) for side in (-0.1, 0.1)]
    verdicts = judge(*corners)
    outside = verdicts.sign == 0
    assert 5 < outside.sum() < 195
    for low, high in zip(corners[0][outside], corners[1][outside], strict=True):
        assert not domain.contains(rng.uniform(low, high, (200, 3))).any()


@pytest.mark.slow
def test_laws_and_generated_c_fall_back_outside(
    loop: tuple[oc.Problem, Array, Array], chart: oc.Chart, tmp_path: Path
) -> None:
    inside, domain = loop[2][20], chart.problem.domain
    q = domain.centre + domain.half_width * np.random.default_rng(7).uniform(-1, 1, (50, 3))
    outside = q[~domain.contains(q)][0]
    law = oc.control.Impedance(chart, 50.0)
    rest = [np.zeros(3)] * 2
    generated = oc.generate_c(chart, tmp_path / "c", law, name="arm")
    library = codegen.CompiledLibrary(codegen.compile_shared(generated, generated.folder), "arm", 3)
    gains = np.concatenate(list(law.gains.values()))
    for q, wanted in ((inside, ControlStatus.OK), (outside, ControlStatus.OUTSIDE_DOMAIN)):
        assert int(law.function(q, rest[0], chart.phi(q), *rest, *law.gains.values())[1]) == wanted
        assert library.control(q, rest[0], np.concatenate([chart.phi(q), *rest]), gains)[1] == wanted
    start = chart.phi(inside)
    reference = oc.control.Reference.steps(chart.labels, start, [(0.1, {"xi1": start[2] + 2.0})], duration=3.0)
    with pytest.raises(UnreachableReferenceError):
        oc.simulate(law, reference, inside)


def test_file_holds_the_corridor(chart: oc.Chart, tmp_path: Path) -> None:
    chart.save(tmp_path / "arm.orthocas")
    again = oc.load(tmp_path / "arm.orthocas")
    q = sample_uniform(chart.problem.domain, 50, 3)
    domain = again.problem.domain
    assert isinstance(domain, Corridor)
    assert domain.contains(q).all()
    assert not domain.contains(q[0] + [0.0, 0.8, 0.0])
    assert np.array_equal(again.xi(q), chart.xi(q))


def test_cyclic_and_idle_joints_take_all_positions() -> None:
    iiwa = problems.get("iiwa")
    found = corridor_problem(iiwa, iiwa.domain.centre[None], 0.2).domain
    assert isinstance(found, Corridor)
    assert np.isinf(found.radius).tolist() == [True, False, False, False, False, False, True]
    assert found.half_width[[0, 6]].min() > 2.9


def test_wrong_corridors_are_refused() -> None:
    box = oc.Box([0.0, 0.0], 1.0)
    for postures, radius, error in (
        ([[0.0, 0.0, 0.0]], 0.1, ShapeError),
        ([[0.0, 0.0]], -0.1, InvalidValueError),
        ([[0.0, 0.0]], [0.1, 0.1, 0.1], ShapeError),
        ([[0.0, 0.0]], np.inf, InvalidValueError),
        ([[3.0, 3.0]], 0.1, InvalidValueError),
        ([[np.nan, 3.0]], 0.1, InvalidValueError),
        *(([[0.0, 0.0]], size, InvalidValueError) for size in (np.nan, 0.0, 1e-300, 1e300, [1e300, 0.1])),
        *(([[0.0, 0.0], [0.0, far]], 0.1, InvalidValueError) for far in (1e7, 1e160, -1e300)),
    ):
        with pytest.raises(error):
            Corridor(box, postures, radius)
    known = problems.get("planar_3r_xy")
    with pytest.raises(InvalidValueError, match="least_singular_value"):
        oc.Problem(known.robot, known.task, domain=corridor(), least_singular_value=0.1)
    iiwa = problems.get("iiwa")
    with pytest.raises(DomainError, match="range of joint"):
        corridor_problem(iiwa, iiwa.domain.centre[None] + 10.0)


@pytest.mark.slow
def test_command_line_fits_along_postures(run: Run) -> None:
    np.savetxt("path.csv", PATH, delimiter=",", header="q1,q2,q3", comments="")
    words = ("fit", "planar_3r_xy", "--corridor", "path.csv", "--samples", "200", "--out", "a.orthocas", "--json")
    code, out, err = run(*words, "--half-width", "0.25")
    assert (code, err) == (0, "")
    assert json.loads(out)["parametrisation"] == "polynomial:3:cyclic=q1"
    domain = oc.load("a.orthocas").problem.domain
    assert isinstance(domain, Corridor)
    assert domain.radius.tolist() == [np.inf, 0.25, 0.25]
    assert domain.contains(PATH).all()
    for others, word in (
        (("--centre", "0,0,0"), "--corridor defines the domain: leave out --centre"),
        (("--domain", "auto"), "--corridor defines the domain: leave out"),
        (("--half-width", "-1"), "radius"),
        (("--half-width", "1,1,1"), "expected one number, which is the radius of the corridor"),
    ):
        code, out, err = run(*words, "--force", *others)
        assert (code, out) == (2, "")
        assert word in err
    code, _, err = run("fit", "planar_3r_xy", "--radius", "0.2")
    assert (code, err) == (2, "orthocas: no such option: --radius; the radius of a corridor is --half-width\n")


@pytest.mark.slow
def test_one_chart_along_a_path_closes_a_loop_that_the_pseudo_inverse_leaves_open() -> None:
    known, start = problems.get("planar_3r_xy"), np.array([0.6, 0.8, 0.8])
    problem = oc.Problem(known.robot, known.task, domain=known.domain)  # A = I, so least-norm steps are horizontal
    task, turn = problem.task, np.linspace(0, 2 * np.pi, 200)
    path = task.batched(start[None])[0][0] + 0.4 * np.column_stack([np.cos(turn) - 1, np.sin(turn)])
    postures = [start]
    for x in path[1:]:  # the path of least-norm steps
        q = postures[-1]
        for _ in range(5):
            J = task.batched_jacobian(q[None])[0].reshape(2, 3)
            q = q + np.linalg.pinv(J) @ (x - task.batched(q[None])[0][0])
        postures.append(q)
    assert np.abs(postures[-1] - start).max() > 1e-3
    chart = oc.chart_along(problem, postures, radius=0.3)
    q, xi = start, chart.xi(start)
    for x in path:
        q = chart.inverse(np.concatenate([x, xi]), q_start=q)
    assert np.abs(q - start).max() < 1e-9
    assert chart.problem.domain.contains(np.array(postures)).all()
    assert oc.evaluate(chart, samples=2000).leak.rms < 2.0  # degrees
