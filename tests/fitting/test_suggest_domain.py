"""Suggested domains: the quality that was asked for is kept, and one joint wider breaks it."""

import dataclasses
import json

import casadi as ca
import numpy as np
import pytest
from conftest import robot_of
from programs import Run
from public_objects import suggestion

import orthocas as oc
from orthocas import problems
from orthocas.bases.family import JointSpace
from orthocas.charts.quality import evaluate
from orthocas.errors import DomainError, InvalidValueError, NotRedundantError, SingularTaskError, UnknownNameError
from orthocas.fitting.probe import Prober, compute_leak_and_conditioning, evaluate_chart
from orthocas.tasks.metric import Metric
from orthocas.tasks.regular_box import find_home
from orthocas.tasks.samples import evaluate_samples, sample_boundary_weighted
from orthocas.tools.progress import Progress

HOME = (0.6, 0.8, 0.8)


def planar() -> tuple[oc.Robot, oc.Task]:
    known = problems.get("planar_3r_xy")
    return known.robot, known.task


def suggested(**asked: object) -> object:
    return oc.suggest_domain(*planar(), HOME, **{"parametrisation": oc.Polynomial(2, cyclic="auto"), **asked})


@pytest.mark.slow
def test_domains_are_suggested_for_linear_coordinates() -> None:
    """Trials are quadratic, which linear coordinates cannot begin from."""
    known = problems.get("planar_3r_x")
    found = oc.suggest_domain(known.robot, known.task, parametrisation=oc.Polynomial(1))
    worst = oc.fit(found.problem, oc.Polynomial(1)).worst
    assert worst is not None
    assert worst.least > 0


def test_leak_and_conditioning_are_those_of_their_definitions() -> None:
    """Against principal angles and singular values in coordinates where A is the identity."""
    known = problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, "inertia", known.domain)
    samples = evaluate_samples(problem, sample_boundary_weighted(known.domain, 20, 3))
    J = np.random.default_rng(1).normal(size=(20, 1, 3))
    leaks, conditioning = compute_leak_and_conditioning(samples, J)
    for k, q in enumerate(samples.points):
        L = np.linalg.cholesky(np.linalg.inv(known.robot.mass_matrix(q)))
        task = np.linalg.qr((samples.task_jacobian[k] @ L).T)[0].T
        own = J[k] @ L / np.linalg.norm(J[k] @ L)
        np.testing.assert_allclose(np.sin(leaks[k, 0]), np.linalg.norm(task @ own.T), atol=1e-9)
        np.testing.assert_allclose(
            abs(conditioning[k]), np.linalg.svd(np.vstack([task, own]), compute_uv=False)[-1], atol=1e-7
        )


def test_two_thirds_of_heavy_samples_lie_near_faces_and_corners() -> None:
    box = oc.Box(np.full(5, 0.3), [0.1, 0.2, 0.3, 0.4, 0.5])
    distances = np.abs(sample_boundary_weighted(box, 9000, 2) - box.centre) / box.half_width
    assert distances.max() <= 1
    means = distances.reshape(3, 3000, 5).mean(axis=(1, 2))
    np.testing.assert_allclose(means, [1 / 2, 2 / 3, 4 / 5], atol=0.01)  # of |u|^p: 1 / (1 + p)


@pytest.mark.slow
def test_a_chart_on_the_suggested_domain_has_the_quality_that_was_asked() -> None:
    """Measured again with other samples, by other code."""
    found = suggestion()
    report = evaluate(found.fit.chart, 50_000, seed=77)
    assert report.folded_samples == 0
    assert report.conditioning.min >= 0.2
    assert found.leak_deg <= 8.0
    assert 90 - report.task_angle.max < 90
    assert found.conditioning <= report.conditioning.min + 0.02  # corners are where the conditioning is smallest
    np.testing.assert_array_equal(found.domain.centre, HOME)


def test_every_joint_has_a_reason_and_one_fifth_more_breaks_the_bound() -> None:
    found = suggestion()
    assert [joint.reason for joint in found.joints] == ["cyclic", "conditioning", "conditioning"]
    prober = Prober(found.problem, [0, 1, 2], ("q1",))
    here = prober.evaluate(oc.Box(HOME, found.domain.half_width))
    assert max(here.excess(dataclasses.replace(found.asked, conditioning=0.25)).values()) <= 1
    for k in (1, 2):
        wider = found.domain.half_width.copy()
        wider[k] *= 1.2
        assert prober.evaluate(oc.Box(HOME, wider)).excess(found.asked)["conditioning"] > 1


def test_cyclic_joint_takes_its_whole_range() -> None:
    found = suggestion()
    assert found.domain.unbounded == (0,)
    assert found.fit.cyclic_joints == ("q1",)


@pytest.mark.slow
def test_a_stricter_leak_gives_a_smaller_box_ended_by_the_leak() -> None:
    strict = suggested(leak_deg=2.0)
    assert (strict.domain.half_width[1:] < suggestion().domain.half_width[1:]).all()
    assert [joint.reason for joint in strict.joints] == ["cyclic", "leak", "leak"]
    assert strict.leak_deg <= 2.0


@pytest.mark.slow
def test_the_same_call_gives_the_same_box() -> None:
    np.testing.assert_array_equal(suggested().domain.half_width, suggestion().domain.half_width)


def test_joint_limits_end_the_box() -> None:
    robot, _ = planar()
    limits = {"lower": np.array([-1.0, 0.5, 0.5]), "upper": np.array([2.0, 1.0, 1.05])}
    limited = oc.Robot(dataclasses.replace(robot.tree, **limits))
    task = oc.Task.position(limited, "xy")
    found = oc.suggest_domain(limited, task, HOME, parametrisation=oc.Polynomial(2))
    np.testing.assert_allclose(found.domain.half_width, [1.4, 0.2, 0.25])
    assert [joint.reason for joint in found.joints] == ["cyclic", "joint limit", "joint limit"]
    assert "to the joint limit" in repr(found)


def test_home_comes_from_the_files_or_is_a_bent_posture() -> None:
    panda, xarm, ur10 = robot_of("panda"), robot_of("xarm7"), robot_of("ur10")
    assert "default" in find_home(panda, oc.Task.position(panda)).source
    for robot in (xarm, ur10):  # the postures of the xarm7 lie at limits, and the middle of the ur10 is stretched out
        home = find_home(robot, oc.Task.position(robot))
        assert home.source.startswith("bent posture")
        J = robot.tip_jacobian(home.q)[:3]
        assert np.linalg.svd(J, compute_uv=False)[-1] > 0.15
    np.testing.assert_array_equal(find_home(xarm, oc.Task.position(xarm), "hold-up").q, xarm.homes["hold-up"])


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_trial_charts_are_as_good_as_fits_of_their_degree(metric: str) -> None:
    """With Euclidean cosines, the loss of the other metric, the trial for A = M folds and leaks 1.5 times as much."""
    robot = robot_of("ur10")
    task = oc.Task.position(robot)
    box = oc.Box(find_home(robot, task).q, [0.5, *[0.25] * 5])
    problem = oc.Problem(robot, task, metric, box)
    trial = Prober(problem, list(range(6))).evaluate(box)
    fitted = evaluate_chart(oc.fit(problem, oc.Polynomial(2), split_idle=False).chart, 3000, 0)
    assert trial.leak_deg < 1.15 * fitted.leak_deg
    assert trial.conditioning > 0.5 * fitted.conditioning


@pytest.mark.slow
def test_bad_arguments_are_refused() -> None:
    robot, task = planar()
    panda = robot_of("panda")
    position = oc.Task.position(panda)
    with pytest.raises(UnknownNameError, match="home 'nowhere'"):
        oc.suggest_domain(panda, position, "nowhere")
    with pytest.raises(DomainError, match="home of joint 'panda_joint4' is 0, expected inside its limits"):
        oc.suggest_domain(panda, position, np.zeros(7))
    with pytest.raises(
        DomainError, match=r"no box around the home \[.*\] keeps the bounds: .* --centre .* --metric.*--leak-deg"
    ):
        oc.suggest_domain(robot, task, [0.5, 0.0, 0.0])  # stretched out
    with pytest.raises(InvalidValueError, match="leak_deg is 90"):
        oc.suggest_domain(robot, task, HOME, leak_deg=90)
    with pytest.raises(InvalidValueError, match="conditioning is 1, expected a number between 0 and 1"):
        oc.suggest_domain(robot, task, HOME, conditioning=1)
    with pytest.raises(NotRedundantError):
        oc.suggest_domain(robot, oc.Task.custom(robot, "all", lambda q: q))


def test_task_that_no_joint_changes_is_refused() -> None:
    """The axis of a planar arm always stands upright."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    with pytest.raises(SingularTaskError, match="task component 'tilt_x' does not depend on any joint"):
        oc.suggest_domain(robot, oc.Task.axis(robot, "z"))


def test_progress_is_reported_and_ctrl_c_ends_the_search() -> None:
    seen: list[Progress] = []

    def stop(progress: Progress) -> None:
        seen.append(progress)
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        suggested(monitor=stop)
    assert [progress.stage for progress in seen] == ["suggest a domain"] * 3
    assert 0 < seen[0].fraction < seen[2].fraction < 1


@pytest.mark.nightly
@pytest.mark.parametrize("joints", [6, 10])
def test_progress_rises_to_the_end_of_the_search_and_waits_nowhere(joints: int) -> None:
    seen: list[Progress] = []
    robot = oc.Robot.planar([3.0 / joints] * joints, [1.0] * joints)
    oc.suggest_domain(
        robot,
        oc.Task.position(robot, "xy"),
        np.full(joints, 0.3),
        parametrisation=oc.Polynomial(2),
        monitor=seen.append,
    )
    fractions = np.array([progress.fraction for progress in seen if progress.stage == "suggest a domain"])
    assert (np.diff(fractions) > 0).all()
    assert 0.9 < fractions[-1] < 1
    assert np.abs(fractions - np.arange(1, len(fractions) + 1) / len(fractions)).max() < 0.35


@pytest.mark.nightly
def test_boxes_of_light_wrists_do_not_depend_on_the_luck_of_single_trials() -> None:
    """With a start of its own for every trial, the box of the ur10 with A = M had a mean half-width of 0.21 rad."""
    robot = robot_of("ur10")
    found = oc.suggest_domain(
        robot, oc.Task.position(robot), metric="inertia", parametrisation=oc.Polynomial(2, "auto")
    )
    free = [joint.half_width for joint in found.joints if joint.reason != "cyclic"]
    assert np.exp(np.mean(np.log(free))) > 0.35
    assert evaluate_chart(found.fit.chart, 50_000, 11).conditioning > 0.15


@pytest.mark.slow
def test_coordinates_are_continued_to_another_box() -> None:
    """They are the same functions, up to constants, outside of the first box as well."""
    robot = oc.Robot.planar([0.3] * 8, [1.0] * 8)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.3] * 8, 0.1))
    prober = Prober(problem, list(range(8)), ("q1",))
    assert prober.start_on(family_of(problem, 0.1)) is None
    prober.evaluate(problem.domain)
    widths = np.linspace(0.05, 0.4, 8)
    small, large = family_of(problem, 0.1), family_of(problem, widths)
    q = sample_boundary_weighted(oc.Box([0.3] * 8, 0.5), 30, 1).T
    gradients = []
    for family in (small, large):
        theta = prober.start_on(family)
        assert theta is not None
        q_symbol = ca.SX.sym("q", 8)
        xi = theta.reshape(6, -1) @ family.basis(q_symbol)
        gradients.append(np.array(ca.Function("J", [q_symbol], [ca.jacobian(xi, q_symbol)])(q)))
    np.testing.assert_allclose(*gradients, atol=1e-9)


def family_of(problem: oc.Problem, widths: object) -> object:
    """Quadratic functions of a box around the problem's centre."""
    box = oc.Box(problem.domain.centre, widths)
    return oc.Polynomial(2).family(JointSpace.of(dataclasses.replace(problem, domain=box)), 6)


@pytest.mark.nightly
def test_many_joints_get_a_box_without_folds() -> None:
    """Judged by determinants in corners, with other samples, by other code."""
    robot = oc.Robot.planar([0.3] * 9, [1.0] * 9)
    found = oc.suggest_domain(robot, oc.Task.position(robot, "xy"), [0.3] * 9, parametrisation=oc.Polynomial(2))
    assert found.conditioning >= 0.2
    assert found.leak_deg <= 8.0
    domain, chart = found.domain, found.fit.chart
    corners = domain.centre + domain.half_width * np.random.default_rng(5).choice([-1.0, 1.0], (3000, 9))
    signs = {float(np.linalg.slogdet(chart.jacobian(q))[0]) for q in corners}
    assert len(signs) == 1
    assert np.log(found.domain.half_width[1:]).mean() > np.log(0.2)


@pytest.mark.slow
def test_fit_with_automatic_domain(run: Run) -> None:
    words = ("--metric", "euclidean", "--param", "polynomial:2", "--json")
    code, out, err = run("fit", "planar_3r_xy", "--domain", "auto", *words)
    data = json.loads(out)
    assert (code, err) == (0, "")
    assert data["conditioning"]["min"] >= 0.2
    reasons = [joint["reason"] for joint in data["suggested_domain"]["joints"]]
    assert reasons == ["cyclic", "conditioning", "conditioning"]
    assert oc.load("planar_3r_xy.orthocas").problem.domain.half_width[0] == np.pi


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--domain", "auto", "--half-width", "0.3"), "--domain auto finds the half-width: leave out --half-width"),
        (("--domain", "wide"), "--domain is 'wide', expected auto"),
        (("--leak-deg", "3"), "--leak-deg requires --domain auto"),
        (("--domain", "auto", "--leak-deg", "120"), "leak_deg is 120.0, expected an angle between 0 and 90"),
        (("--domain", "auto", "--centre", "0,0,0"), "a larger leak_deg (--leak-deg)"),
    ],
)
def test_contradictory_options_are_refused(run: Run, words: tuple[str, ...], complaint: str) -> None:
    code, _, err = run("fit", "planar_3r_xy", *words)
    assert code == 2
    assert complaint in err


@pytest.mark.slow
def test_box_is_searched_with_the_weights_of_the_fit(planar_xy: oc.Problem) -> None:
    boxes = {}
    for angles in ("paper", "metric"):
        found = oc.suggest_domain(
            planar_xy.robot, planar_xy.task, [0.6, 0.8, 0.8], "inertia", weights=oc.Weights(angles=angles)
        )
        assert found.fit.chart.notes["angles"] == angles
        boxes[angles] = found.domain.half_width[1:].prod()
    assert boxes["metric"] > 1.1 * boxes["paper"]  # it asks for the leak, which the box is bounded by


@pytest.mark.slow
def test_box_ends_where_the_metric_is_no_longer_positive() -> None:
    """Just beyond the box that the search begins with, as where links without mass turn freely."""
    robot, task = planar()
    end = 1.59
    metric = Metric.custom(robot, "ends", lambda q: ca.diag(ca.vertcat(1, 1, ca.if_else(q[2] < end, 1, -1))))
    found = oc.suggest_domain(robot, task, HOME, metric, parametrisation=oc.Polynomial(2))
    assert found.joints[2].reason == "singularity"
    assert found.problem.domain.half_width[2] < end - HOME[2]
