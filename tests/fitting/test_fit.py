"""Fits: idle joints, continuation, determinism, interrupts, limits."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from charts import with_metric
from conftest import robot_data

import orthocas as oc
from orthocas import bases, solvers
from orthocas.errors import Interrupted, InvalidValueError, MemoryNeedError, ShapeError, UnknownNameError
from orthocas.fitting.fit import Fit
from orthocas.solvers.protocol import Objective, SolveResult, Status
from orthocas.tools.progress import UNWATCHED, Progress, Watch


@pytest.mark.slow
def test_default_fit_of_the_iiwa_beats_the_papers_network(iiwa: oc.Problem) -> None:
    """The paper's 535e3-parameter network: task 2.06, mutual 3.44 degrees on its own samples."""
    fit = oc.fit(iiwa)
    report = oc.evaluate(fit.chart, samples=20_000)
    assert fit.status in (Status.CONVERGED, Status.ITERATION_LIMIT)
    assert report.task_angle.std <= 2.05
    assert report.mutual_angle.std <= 3.2
    assert fit.worst is not None
    assert fit.worst.least >= 0.2
    assert report.conditioning.mean >= 0.89
    assert report.conditioning.p01 >= 0.6
    assert abs(report.task_angle.mean - 90) < 0.5


@pytest.mark.slow
def test_idle_joint_is_split_off_as_an_exact_coordinate(iiwa_fit: Fit) -> None:
    assert iiwa_fit.idle_joints == ("A7",)
    chart = iiwa_fit.chart
    q = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 7))
    np.testing.assert_allclose(chart.xi(q)[:, 3], q[:, 6], atol=1e-15)
    np.testing.assert_array_equal(chart.jacobian(q)[:, 3:6, 6], 0)


def test_idle_joint_can_be_left_to_the_fit(iiwa: oc.Problem) -> None:
    """As the paper's network has it: all four coordinates are fitted, and all seven joints enter."""
    solver = solvers.LBFGS(max_iterations=2)
    fit = oc.fit(iiwa, oc.MLP((6, 5), raw=True), solver, samples=100, split_idle=False, weights=(1000, 1))
    assert fit.idle_joints == ()
    assert fit.chart.coordinates.size == 7 * 6 + 6 + 6 * 5 + 5 + 5 * 4 + 4


def test_coordinates_are_shifted_and_scaled(iiwa_fit: Fit) -> None:
    chart = iiwa_fit.chart
    np.testing.assert_allclose(chart.xi(chart.problem.domain.centre), 0, atol=1e-12)
    q = chart.problem.domain.centre + np.random.default_rng(0).uniform(-0.7, 0.7, (2000, 7))
    lengths = np.linalg.norm(chart.jacobian(q)[:, 3:], axis=2).mean(axis=0)
    np.testing.assert_allclose(lengths, 1.0, atol=0.05)  # scaled on other samples


@pytest.mark.slow
def test_same_seed_same_result_and_another_seed_another(planar_x: oc.Problem) -> None:
    first, second, other = (oc.fit(planar_x, oc.Polynomial(3), seed=s).chart.coordinates.theta for s in (4, 4, 5))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


def test_degree_continuation_goes_through_every_degree(iiwa_fit: Fit) -> None:
    assert [stage.label for stage in iiwa_fit.stages[:2]] == ["polynomial:2", "polynomial:3"]
    assert [stage.parameters for stage in iiwa_fit.stages[:2]] == [3 * 27, 3 * 83]
    assert iiwa_fit.stages[1].result.value < iiwa_fit.stages[0].result.value


def test_seeds_may_be_larger_than_a_machine_word(planar_x: oc.Problem, tmp_path: Path) -> None:
    oc.fit(planar_x, oc.Polynomial(1), seed=10**20, samples=30).chart.save(tmp_path / "c")
    assert oc.load(tmp_path / "c").notes["seed"] == 10**20


@pytest.mark.slow
def test_exact_coordinates_of_an_involutive_task_are_found(planar_x: oc.Problem) -> None:
    coarse, fine = (oc.evaluate(oc.fit(planar_x, oc.Polynomial(d)).chart, 5000) for d in (4, 8))
    assert fine.leak.rms <= 0.1 < coarse.leak.rms
    assert fine.task_angle.std < 0.3 < coarse.task_angle.std
    assert fine.conditioning.p01 > 0.9


@pytest.mark.slow
def test_length_term_keeps_gradients_even(planar_x: oc.Problem) -> None:
    """Held out: angles leave lengths free by a factor of thousands, and a controller's gains with them."""
    plain, even = (
        oc.evaluate(oc.fit(planar_x, oc.Polynomial(6), weights=weights).chart, 4000, seed=5)
        for weights in ((1000.0, 30.0, 150.0), (1000.0, 30.0, 150.0, 1.0))
    )
    assert plain.length_ratio > 500
    assert even.length_ratio < 20
    assert even.leak.rms < 1.0


def test_linear_coordinates_are_exact_at_their_base_only(planar_x: oc.Problem) -> None:
    base = (0.7, 0.75, 0.9)
    chart = oc.fit(planar_x, oc.Linear(base=base, normals="paper")).chart
    J = chart.jacobian(np.array(base))
    B = np.linalg.inv(planar_x.robot.mass_matrix(np.array(base)))
    np.testing.assert_allclose(J[:1] @ B @ J[1:].T, 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(J[1:], axis=1), 1, atol=1e-12)  # unit normals, not rescaled
    away = chart.jacobian(np.array([0.3, 1.1, 0.5]))
    B = np.linalg.inv(planar_x.robot.mass_matrix(np.array([0.3, 1.1, 0.5])))
    assert np.abs(away[:1] @ B @ away[1:].T).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parametrisation", "solver"),
    [
        (oc.Polynomial(2), None),
        (oc.Polynomial(2), solvers.LBFGS()),
        (oc.Fourier(1), None),
        (oc.Fourier(2), solvers.LBFGS()),
        (oc.MLP((12, 12)), solvers.LBFGS(max_iterations=60)),
        (oc.Linear(), None),
    ],
    ids=lambda value: getattr(value, "label", getattr(value, "name", "default")),
)
def test_every_sensible_pair_fits_and_beats_linear_coordinates(
    planar_xy: oc.Problem, parametrisation: object, solver: solvers.LBFGS | None
) -> None:
    linear = oc.evaluate(oc.fit(planar_xy, oc.Linear()).chart, 2000)
    report = oc.evaluate(oc.fit(planar_xy, parametrisation, solver, samples=400).chart, 2000)
    assert report.leak.rms <= linear.leak.rms + 1e-9  # what the fit minimises for A = M
    assert np.isnan(report.mutual_angle.std)


@pytest.mark.slow
def test_panda_and_ur10_fit_without_tuning_straight_from_their_urdfs() -> None:
    for file, tip, idle in (
        ("panda_description/urdf/panda.urdf", "panda_hand", "panda_joint7"),
        ("ur_description/urdf/ur10_robot.urdf", None, "wrist_3_joint"),
    ):
        robot = oc.Robot.from_urdf(robot_data(file), tip)
        fit = oc.fit(oc.Problem(robot, oc.Task.position(robot)), oc.Polynomial(3))
        report = oc.evaluate(fit.chart, samples=5000)
        assert fit.idle_joints == (idle,)
        assert not report.degenerate
        assert report.task_angle.std < 5


@pytest.mark.slow
def test_all_coordinates_may_be_idle() -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    task = oc.Task.custom(robot, "first joint", lambda q: q[0])
    fit = oc.fit(oc.Problem(robot, task))
    assert fit.idle_joints == ("q2",)
    assert fit.stages == ()
    assert oc.evaluate(fit.chart, 100).task_angle.std == 0


@pytest.mark.slow
def test_joint_that_the_metric_depends_on_is_not_split_off() -> None:
    """A decouples q3 but depends on it: exact coordinates exist (m = 1), and they are functions of q3 too."""
    robot = oc.Robot.planar([1.0] * 3, [1.0] * 3)

    def metric(q: ca.SX) -> ca.SX:
        s = ca.sin(q[2])
        return ca.vertcat(ca.horzcat(1, s, 0), ca.horzcat(s, 2, 0), ca.horzcat(0, 0, 1))

    task = oc.Task.custom(robot, "q1", lambda q: q[0])
    fit = oc.fit(oc.Problem(robot, task, metric, oc.Box(np.zeros(3), 0.7)), oc.Polynomial(4))
    assert fit.idle_joints == ()
    assert oc.evaluate(fit.chart, 2000).task_angle.std < 0.2


@pytest.mark.slow
def test_inertia_couples_joints_so_none_is_idle(iiwa: oc.Problem) -> None:
    problem = with_metric(iiwa, "inertia")
    assert oc.fit(problem, oc.Polynomial(1), samples=300).idle_joints == ()


class StopsAfterFirstStage:
    """Behaves like Ctrl-C in the second stage."""

    name = "stops"

    def __init__(self) -> None:
        self.stages = 0

    def coarser(self) -> "StopsAfterFirstStage":
        return self

    def minimise(self, objective: Objective, theta0: np.ndarray, watch: Watch = UNWATCHED) -> SolveResult:
        self.stages += 1
        result = solvers.GaussNewton().minimise(objective, theta0)
        status = Status.INTERRUPTED if self.stages == 2 else result.status
        return SolveResult(result.theta, result.value, status, 1, 1, 0.0)


@pytest.mark.slow
def test_interrupted_fit_raises_with_the_best_chart_so_far(planar_x: oc.Problem) -> None:
    with pytest.raises(Interrupted, match="the Fit found so far") as stop:
        oc.fit(planar_x, oc.Polynomial(5), StopsAfterFirstStage())
    fit = stop.value.result
    assert fit.status is Status.INTERRUPTED
    assert fit.chart.coordinates.parametrisation.label == "polynomial:3"
    assert oc.evaluate(fit.chart, 500).task_angle.std < 10


def test_ctrl_c_before_anything_is_found_is_passed_on(planar_x: oc.Problem) -> None:
    def press(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        oc.fit(planar_x, oc.Polynomial(5), monitor=press)


def test_ctrl_c_inside_the_solver_keeps_the_chart(planar_x: oc.Problem) -> None:
    def press(progress: Progress) -> None:
        if progress.stage == "polynomial:3" and progress.fraction > 0:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stop:
        oc.fit(planar_x, oc.Polynomial(5), monitor=press)
    fit = stop.value.result
    assert fit.status is Status.INTERRUPTED
    assert fit.chart.notes["status"] == "interrupted"


def test_degree_too_large_for_memory_says_how_much_it_needs(iiwa: oc.Problem) -> None:
    with pytest.raises(
        MemoryNeedError, match=r"polynomial:20 on 6 joints with 230229 basis functions would need .* GiB"
    ):
        oc.fit(iiwa, oc.Polynomial(20))


def test_bad_settings_are_refused(planar_x: oc.Problem) -> None:
    with pytest.raises(UnknownNameError, match="unknown precision 'half'"):
        oc.fit(planar_x, precision="half")
    with pytest.raises(InvalidValueError, match="precision is 'single' with max_mutual_deg"):
        oc.fit(planar_x, max_mutual_deg=3.0, precision="single")
    with pytest.raises(InvalidValueError, match="precision is 'single' with circle:mlp:3"):
        oc.fit(planar_x, bases.Circle(oc.MLP((3,))), samples=50, precision="single")
    with pytest.raises(InvalidValueError, match="samples is 0"):
        oc.fit(planar_x, samples=0)
    with pytest.raises(InvalidValueError, match="parametrisation is 'polynomial:3'"):
        oc.fit(planar_x, "polynomial:3")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="solver is 'lbfgs'"):
        oc.fit(planar_x, solver="lbfgs")  # type: ignore[arg-type]
    for weights in ((1.0,), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)):
        with pytest.raises(ShapeError, match="weights"):
            oc.fit(planar_x, weights=weights)  # type: ignore[arg-type]
    for base in ((0.0,) * 5, (0.0,) * 2):
        with pytest.raises(ShapeError, match="base has shape"):
            oc.fit(planar_x, oc.Linear(base))
    with pytest.raises(InvalidValueError, match="base"):
        oc.Linear((0.0, float("nan"), 0.0))
    with pytest.raises(InvalidValueError, match="hidden is 64"):
        oc.MLP(64)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="max_iterations"):
        solvers.LBFGS(max_iterations=0)
    with pytest.raises(InvalidValueError, match="degree is 0"):
        oc.Polynomial(0)
    with pytest.raises(InvalidValueError, match="degree"):
        oc.Fourier(1.5)  # type: ignore[arg-type]
