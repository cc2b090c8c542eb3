"""Boxes that are proved one-to-one hold no two points with the same phi; the bounds behind the proofs hold as well."""

import importlib
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from certified_charts import certified, chart
from programs import nightly
from public_objects import network, planar
from random_arms import random_arm, second_solutions

import orthocas as oc
from orthocas.certificates import check_certificate
from orthocas.certificates.jets import Jets
from orthocas.certificates.one_to_one import OneToOneCheck, choose_one_to_one_check
from orthocas.certificates.rows import build_chart_rows
from orthocas.certificates.search import Limits, Search
from orthocas.charts.certificate import PROVED, Subdivision

certifying = importlib.import_module("orthocas.certificates.certify")  # a function has the name of the module


def judge_on(known: oc.Chart, half: np.ndarray) -> tuple[OneToOneCheck, Subdivision]:
    centre = known.problem.domain.centre
    box = Subdivision.whole(centre - half, centre + half)
    return choose_one_to_one_check(known, build_chart_rows(known), box), box


def proved(known: oc.Chart, half: np.ndarray, boxes: int) -> bool:
    judge, box = judge_on(known, half)
    search = Search(judge, box, Limits(boxes=boxes))
    search.run(lambda _: None)
    return search.finished


def arm_chart(seed: int, task: str, width: float = 0.3, degree: int = 2) -> oc.Chart:
    """A fit of a random arm with more joints than its task has components."""
    rng = np.random.default_rng(seed)
    small = task in ("axis", "axis:y", "position:xy")
    robot = random_arm(rng, int(rng.integers(4, 6)) if small else 5 if task in ("position", "orientation") else 7)
    box = oc.Box(rng.uniform(-1.5, 1.5, robot.n), width * rng.uniform(0.5, 1.0, robot.n))
    problem = oc.Problem(robot, oc.Task.named(robot, task, box.centre), domain=box)
    return oc.fit(problem, oc.Polynomial(degree), samples=200, seed=seed).chart


def differences(known: oc.Chart, q: np.ndarray, p: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """What the rows stand for, at q less at p, from the robot's own functions: position, rotation or axis, and xi."""
    robot, kind = known.problem.robot, known.problem.task.recipe["kind"]
    R_q, R_p, R = robot.tip_rotation(q), robot.tip_rotation(p), robot.tip_rotation(middle)
    parts = [robot.tip_position(q) - robot.tip_position(p)] if kind.startswith("po") else []
    if "axis" in kind:
        axis = "xyz".index(known.problem.task.recipe["kind"][-1]) if ":" in kind else 2
        parts.append(R[:, [k for k in range(3) if k != axis]].T @ (R_q - R_p)[:, axis])
    elif kind.startswith(("orientation", "pose")):
        turned = (R_q - R_p) @ R.T
        parts.append(
            np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
        )
    scaled = known.xi(q) - known.xi(p)
    fitted = len(known.coordinates.offset)
    return np.concatenate([*parts, scaled[:fitted] / known.coordinates.scale])


@pytest.mark.slow
@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.parametrize("task", ["position", "orientation", "axis:y", "pose", "position+axis"])
def test_finite_differences_of_phi_lie_within_their_bounds(task: str, order: int) -> None:
    known = arm_chart(3, task)
    half = known.problem.domain.half_width
    judge = judge_on(known, half)[0]
    rng = np.random.default_rng(5)
    parts = 6
    width = half * rng.choice([0.01, 0.1, 0.4], (parts, 1))
    middle = known.problem.domain.centre + (half - width) * rng.uniform(-1, 1, (parts, known.n))
    low, high = middle - width, middle + width
    active = list(judge.active)
    around = replace(judge._build_around(low, high), order=order)
    assert judge.coordinates is not None
    jets = Jets.join([judge.task(middle.T, around), judge.coordinates.build_jets(around)])
    model, terms = jets.average(around, judge.active)
    for k in range(parts):
        for _ in range(20):
            c = rng.uniform(low[k], high[k])
            d = (half - np.abs(c - known.problem.domain.centre)) * rng.choice([-1, 1], known.n)
            d[[i for i in range(known.n) if i not in active]] = 0
            c[active] = np.where(np.isin(np.arange(len(active)), judge.still), middle[k, active], c[active])
            t = ((c - middle[k]) / width[k])[active]
            values = polynomial(model.coefficients[..., k], t)
            allowed = np.abs(terms[..., k]).sum(axis=2) + jets.rest[..., k] + model.remainder[..., k]
            found = differences(known, c + d, c - d, middle[k]) / 2
            error = np.abs(found - values @ d[active])
            assert (error <= allowed @ np.abs(d[active]) + 1e-12).all()


def polynomial(coefficients: np.ndarray, t: np.ndarray) -> np.ndarray:
    """A Taylor model's polynomial (monomials, rows, columns) at t in [-1, 1]^n."""
    n = len(t)
    total, place = coefficients[0].copy(), 1
    for i in range(n):
        total += coefficients[place] * t[i]
        place += 1
    for i in range(n):
        for j in range(i, n):
            total += coefficients[place] * t[i] * t[j]
            place += 1
    for i in range(n):
        for j in range(i, n):
            for k in range(j, n):
                total += coefficients[place] * t[i] * t[j] * t[k]
                place += 1
    return total


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", ["position", "orientation", *nightly("axis", "pose:z", "position:xy", "position+axis")]
)
def test_no_second_solution_is_found_in_a_proved_box_of_a_random_arm(task: str) -> None:
    held = 0
    for seed in range(2):
        known = arm_chart(seed, task)
        base = certifying.cover_domain(known.problem.domain)
        for scale in (1.0, 0.6, 0.3):
            if proved(known, known.problem.domain.half_width * scale, 50):
                middle, half = known.problem.domain.centre, known.problem.domain.half_width * scale
                assert not len(second_solutions(known, middle - half, middle + half, 1000, seed))
                held += 1
                break
        assert base.open_count == 1
    assert held  # some are proved


@pytest.mark.slow
def test_box_of_an_arm_with_two_solutions_is_refused() -> None:
    """Method taylor-3/1 certified this box, by rows in a body's frame that are the derivative of nothing."""
    ready = oc.charts.load("ur5-position")
    half = np.array([6.28, 0.31, 0.31, 0.59, 0.59, 1.41])
    problem = oc.Problem(ready.problem.robot, ready.problem.task, domain=oc.Box(ready.problem.domain.centre, half))
    known = oc.fit(problem, oc.Polynomial(3), samples=1000).chart
    pairs = second_solutions(known, problem.domain.centre - half, problem.domain.centre + half, 2000, 0)
    assert len(pairs) > 100  # they exist
    assert np.abs(known.phi(pairs[:, 0]) - known.phi(pairs[:, 1])).max() < 1e-9
    assert not proved(known, half, 2000)


@pytest.mark.slow
def test_wide_range_of_a_turning_base_is_kept_where_the_coordinates_bound_it() -> None:
    known = oc.charts.load("panda-position")
    half = known.problem.domain.half_width * np.array([1, 0.3, 0.3, 0.3, 0.3, 0.3, 1])
    assert proved(known, half, 100)
    centre = known.problem.domain.centre
    assert not len(second_solutions(known, centre - half, centre + half, 2000, 1))


@pytest.mark.slow
def test_one_to_one_boxes_of_networks_and_planar_arms_are_checked() -> None:
    for known in (network(), oc.fit(planar("euclidean"), oc.Fourier(2), samples=300).chart):
        certificate = oc.certify(known)
        assert certificate.injective is not None
        assert check_certificate(known, certificate)
        pairs = second_solutions(known, certificate.injective.low, certificate.injective.high, 2000, 2)
        assert not len(pairs)


@pytest.mark.slow
def test_one_to_one_part_of_an_older_method_is_void() -> None:
    old = replace(certified(), method="taylor-3/1")
    assert old.injective is None
    assert "certify the chart again" in old.facts()["one-to-one"]
    with pytest.raises(oc.errors.CertifyError, match="taylor-3/1, expected taylor-3/2 or .*: certify it again"):
        check_certificate(chart(), old)


@pytest.mark.slow
def test_forged_one_to_one_box_in_one_part_does_not_pass_the_check() -> None:
    regular = certified(0.4).regular
    box = Subdivision(regular.low, regular.high, np.array([PROVED], dtype=np.uint8))
    assert not check_certificate(chart(0.4), replace(certified(0.4), injective=box).seal())


def test_angle_of_a_whole_turn_is_no_difference() -> None:
    """The angle of a polar task is the same after a turn of the base, though its derivative never vanishes."""
    arm = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[1.0, 1.0, 1.0])
    half, centre = np.array([3.5, 0.1, 0.1]), np.array([0.0, 1.0, 0.8])
    polar = oc.Problem(arm, oc.Task.polar(arm), domain=oc.Box(centre, half))
    known = oc.fit(polar, oc.Linear(), samples=200).chart
    still = replace(known.coordinates, theta=np.array([0.0, -0.3, 1.0]))  # xi does not turn with the base
    known = replace(known, coordinates=still)
    turned = centre + np.array([[-np.pi, 0, 0], [np.pi, 0, 0]])
    assert np.abs(np.diff(known.phi(turned), axis=0)).max() < 1e-9  # one and the same phi
    assert not proved(known, half, 500)
    assert proved(known, half * [0.2, 1, 1], 100)

    def angle(q: ca.SX) -> ca.SX:
        return ca.vertcat(q[1], ca.atan2(ca.sin(q[0]), ca.cos(q[0])))

    jumping = oc.Problem(arm, oc.Task.custom(arm, "angle", angle), domain=oc.Box(centre, half))
    chart_ = oc.fit(jumping, oc.Linear(), samples=200).chart
    assert choose_one_to_one_check(chart_, build_chart_rows(chart_), judge_on(known, half)[1]) is None
