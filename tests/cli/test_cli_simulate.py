"""`orthocas simulate`: files, numbers, plants, remarks."""

import json
from pathlib import Path

import numpy as np
import pytest
from charts import with_metric
from PIL import Image
from programs import Run
from scipy.linalg import eigvalsh
from simulate_command import FILES, report_of, written

import orthocas as oc
from orthocas.cli.codegen import build_controller
from orthocas.control import ControlStatus
from orthocas.control.gains import tracking_gains
from orthocas.fitting.fit import Fit
from orthocas.simulation import Trajectory
from orthocas.tasks.samples import sample_uniform

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def chart(planar_fit: Fit) -> oc.Chart:
    return planar_fit.chart


@pytest.mark.slow
def test_example_of_the_docs_end_to_end(run_simulate: Run, chart: oc.Chart) -> None:
    code, out, err = run_simulate("pd_plus", "--json", steps=str(EXAMPLES / "steps_planar_3r_x.json"))
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert json.loads(Path("out/report.json").read_text()) == report
    assert written() == FILES | {"animation.gif"}
    assert (report["controller"], report["outcome"], report["duration"]) == ("pd_plus", "complete", 10)
    assert set(report["tracking_error"]) == {"x", "xi1", "xi2"}
    assert max(report["tracking_error"].values()) < 1e-6  # CVODES at 1e-8; the full M_phi tracks exactly
    assert set(report["coupling_index"]) == {"x", "xi1"}  # only these are commanded
    assert report["coupling_index"]["xi1"]["x"] < 1e-6
    assert report["fallback"] == {"share": 0, "since": None, "reason": None}
    assert report["share_inside_domain"] == 1
    assert report["energy"]["storage_largest"] < 1e-9
    trajectory = Trajectory.load("out/trajectory.npz")
    assert trajectory.times[-1] == 10
    np.testing.assert_allclose(trajectory.q[0], chart.problem.domain.centre)
    largest = np.abs(trajectory.command).max(axis=0)
    assert report["largest_command"] == dict(zip(["q1", "q2", "q3"], largest.tolist(), strict=True))
    with Image.open("out/coordinates.png") as picture:
        assert min(picture.size) > 500
    with Image.open("out/animation.gif") as film:
        assert film.n_frames > 150  # type: ignore[attr-defined]
    assert Path("out/animation.gif").stat().st_size < 3e6


@pytest.mark.slow
def test_rows_name_units_angles_and_the_folder(run_simulate: Run, chart: oc.Chart) -> None:
    code, out, err = run_simulate("impedance", "--animation", "none")
    assert (code, err) == (0, "")
    rows = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert rows["run"] == "impedance, 1 s: complete"
    assert " m, xi1 " in rows["largest"]
    assert "task <- extra" in rows["coupling"]
    assert rows["command"].endswith("N m, q1")
    leak = oc.evaluate(chart, points=Trajectory.load("out/trajectory.npz").q).leak
    assert rows["angles"].startswith(f"on path  leak rms {leak.rms:.2f}, largest {leak.max:.1f} deg (in the metric)")
    assert "J dissipated" in rows["energy"]
    assert rows["files"] == "out"


@pytest.mark.usefixtures("blank_pictures")
def test_a_velocity_law_follows_the_same_file(run_simulate: Run) -> None:
    report = report_of(run_simulate, "kinematic")
    assert set(report["tracking_error"]) == {"x", "xi1", "xi2"}
    assert report["tracking_error"]["x"] < 1e-3
    assert report["energy"] is None
    trajectory = Trajectory.load("out/trajectory.npz")
    assert (trajectory.labels, trajectory.kind) == (("x", "xi1", "xi2"), "velocity")


def test_springs_that_are_not_given_are_matched(chart: oc.Chart) -> None:
    """Those of PD+ in series with inertia and joints, so that no mode is faster than 18 Hz."""
    points = sample_uniform(chart.problem.domain, 256, 0)
    J, M = chart.jacobian(points), np.array([chart.problem.robot.mass_matrix(q) for q in points])
    half = np.linalg.inv(J)
    gains = build_controller("pd_plus", chart, {}, None).gains
    stiffness, fastest, compliance = tracking_gains(chart)
    np.testing.assert_array_equal(gains["stiffness"], stiffness)
    np.testing.assert_array_equal(gains["compliance"], compliance)
    assert gains["fastest"] == pytest.approx(36 * np.pi)
    inertias = half.transpose(0, 2, 1) @ M @ half
    springs = np.linalg.inv(
        np.diag(1 / stiffness) + np.linalg.inv(inertias) / fastest**2 + (J * compliance) @ J.transpose(0, 2, 1)
    )
    squares = [eigvalsh(spring, inertia) for spring, inertia in zip(springs, inertias, strict=True)]
    assert 15 < np.sqrt(np.max(squares)) / (2 * np.pi) < 18


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_gains_and_limits_are_those_given(run_simulate: Run, chart: oc.Chart) -> None:
    words = ("--stiffness", "100,2000,3000", "--damping-ratio", "0.9", "--limit", "400", "--coupling", "decoupled")
    report = report_of(run_simulate, "impedance", *words)
    assert report["gains"] == {"stiffness": [100, 2000, 3000], "damping_ratio": [0.9] * 3, "limit": [400] * 3}
    assert report["coupling"] == "decoupled"
    assert build_controller("impedance", chart, {}, "50,60,70").gains["limit"].tolist() == [50, 60, 70]
    assert build_controller("kinematic", chart, {"feedback": "1,2,3"}, None).gains["feedback"].tolist() == [1, 2, 3]
    assert build_controller("kinematic", chart, {"feedback": "5"}, None).gains["feedback"].tolist() == [5, 5, 5]


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_a_wrong_model_friction_and_noise_cost_accuracy(run_simulate: Run) -> None:
    exact = report_of(run_simulate, "pd_plus")["tracking_error"]["x"]
    for words in (("--mass-factor", "1.1"), ("--friction", "0.5,0.2")):
        assert report_of(run_simulate, "pd_plus", *words)["tracking_error"]["x"] > 1e3 * exact
    noisy = (("--rate", "100", "--noise", f"1e-4,1e-3{seed}") for seed in ("", ",0", ",1"))
    first, same, other = (report_of(run_simulate, "pd_plus", *words)["tracking_error"]["x"] for words in noisy)
    assert first == same
    assert first != other
    assert first > 1e3 * exact


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_points_and_pushes(run_simulate: Run) -> None:
    points = {"points": [{"time": 1, "move": {"x": 0.1}}, {"time": 2, "move": {"xi1": 0.05}}]}
    Path("points.json").write_text(json.dumps(points))
    report = report_of(run_simulate, "pd_plus", steps="points.json")
    assert (report["duration"], report["coupling_index"]) == (2, None)
    assert report["tracking_error"]["x"] < 1e-6
    pushed = {**points, "pushes": [{"start": 0.5, "duration": 0.1, "force": [40, 0, 0]}]}
    Path("points.json").write_text(json.dumps(pushed))
    assert report_of(run_simulate, "pd_plus", steps="points.json")["tracking_error"]["x"] > 1e-2
    code, _, err = run_simulate("kinematic", steps="points.json")
    assert code == 2
    assert "forces do not affect a velocity controller" in err


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_mujoco_is_another_plant(run_simulate: Run) -> None:
    """The same run, up to the tolerance of CVODES, which adds up over 600 ticks; a push at a link reaches both."""
    pytest.importorskip("mujoco", reason="the extra orthocas[mujoco] is not installed")
    push = {"start": 0.1, "duration": 0.1, "force": [20, 0, 0], "link": "q2", "point": [0.5, 0, 0]}
    points = {"points": [{"time": 0.5, "move": {"x": 0.02}}], "pushes": [push]}
    Path("pushed.json").write_text(json.dumps(points))
    words = ("--rate", "1000", "--mass-factor", "1.1", "--friction", "0.5,0")
    cvodes, ours = (
        report_of(run_simulate, "pd_plus", *words, *more, steps="pushed.json") for more in ((), ("--plant", "mujoco"))
    )
    assert ours["tracking_error"]["x"] == pytest.approx(cvodes["tracking_error"]["x"], abs=1e-6)
    Path("pushed.json").write_text(json.dumps(points | {"pushes": []}))
    still = report_of(run_simulate, "pd_plus", *words, steps="pushed.json")["tracking_error"]["x"]
    assert ours["tracking_error"]["x"] > still + 1e-4


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_a_run_that_diverges_is_written_and_said(run_simulate: Run) -> None:
    code, out, err = run_simulate("impedance", "--stiffness", "1e14", "--animation", "none")
    assert code == 1
    assert "diverged" in out
    assert "the integrator gave up at t = 0.1 s, the run so far is saved" in err
    assert written() == FILES


@pytest.mark.usefixtures("blank_pictures")
def test_a_fallback_is_said_with_time_and_reason(run_simulate: Run) -> None:
    code, out, err = run_simulate("pd_plus", "--limit", "40", "--animation", "none")
    assert code == 1
    assert "coupling" not in out  # coordinates mean nothing outside the domain
    report = json.loads(Path("out/report.json").read_text())
    fallback, trajectory = report["fallback"], Trajectory.load("out/trajectory.npz")
    first = int(np.argmax(trajectory.fell_back))
    assert fallback["since"] == trajectory.times[first] > 0
    assert fallback["share"] == np.mean(trajectory.fell_back)
    assert report["saturated_share"] == np.mean(trajectory.status == ControlStatus.SATURATED) > 0
    assert "limit " in out
    assert (
        f"at t = {fallback['since']:.4g} s the arm left the domain: the controller commanded only the gravity torque"
        in err
    )
    assert (report["energy"], report["coupling_index"]) == (None, None)
    assert report["outcome"] == "lost"
    assert report["reason"] == f"the arm left the domain of the chart at t = {fallback['since']:.4g} s"
    assert f"the law lost the arm: {report['reason']}" in err


@pytest.mark.usefixtures("blank_pictures")
def test_a_metric_other_than_inertia_is_noted(run_simulate: Run, planar_x: oc.Problem) -> None:
    problem = with_metric(planar_x, "euclidean")
    oc.fit(problem, oc.Linear()).chart.save("plain.orthocas")
    Path("still.json").write_text('{"duration": 0.1, "steps": []}')
    code, _, err = run_simulate("impedance", "--animation", "none", chart="plain.orthocas", steps="still.json")
    assert code == 0
    assert err.startswith("note: the metric of this chart is euclidean")
    assert "A = M" in err
    assert run_simulate("kinematic", "--animation", "none", chart="plain.orthocas", steps="still.json")[2] == ""
