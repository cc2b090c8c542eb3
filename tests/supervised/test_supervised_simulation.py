"""`simulate` with the supervised law of the generated C: caught, held, brought back, and told so."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from baselines import Projector
from programs import Run, needs_c

import orthocas as oc
from orthocas.control import ControlStatus, Kinematic, PDPlus, Reference, Safety, matched_stiffness
from orthocas.errors import CompileError, InvalidValueError, ShapeError
from orthocas.native import libraries
from orthocas.simulation import Outcome, Push, Trajectory, simulate
from orthocas.simulation.figure import trajectory_figure
from orthocas.tools.checks import Array

pytestmark = [needs_c, pytest.mark.slow]

RATE = 500.0


@pytest.fixture(scope="module")
def chart(planar_for_control: oc.Chart) -> oc.Chart:
    return planar_for_control


@pytest.fixture(scope="module")
def law(chart: oc.Chart) -> PDPlus:
    return PDPlus(chart, matched_stiffness(chart, 8 * np.pi), limit=120.0)


@pytest.fixture(scope="module")
def q0(chart: oc.Chart) -> Array:
    return np.asarray(chart.problem.domain.centre + 0.8 * chart.problem.domain.half_width)


def still(law: PDPlus | Kinematic, q: Array, duration: float) -> Reference:
    return Reference.steps(law.labels, law.chart.phi(q), [], duration)


@pytest.fixture(scope="module")
def pushed(law: PDPlus, q0: Array) -> Trajectory:
    """Pushed out of the domain at 0.5 s; the law is asked for again 1 s after the catch."""
    push = Push(0.5, 0.3, torque=[0.0, 60.0, 0.0])
    return simulate(law, still(law, q0, 8.0), q0, control_rate=RATE, pushes=[push], safety=Safety.of(law))


def test_a_push_after_which_the_law_alone_never_recovers_is_caught_and_comes_back(
    law: PDPlus, q0: Array, pushed: Trajectory
) -> None:
    domain = law.problem.domain
    push = Push(0.5, 0.3, torque=[0.0, 60.0, 0.0])
    alone = simulate(law, still(law, q0, 3.0), q0, control_rate=RATE, pushes=[push])
    assert alone.status[-1] == ControlStatus.OUTSIDE_DOMAIN
    assert np.abs(alone.dq[-1]).max() > 1.0
    assert not domain.contains(pushed.q).all()
    assert domain.contains(pushed.q[-1])
    assert pushed.status[-1] == ControlStatus.OK
    assert np.abs(pushed.dq[-1]).max() < 0.01
    assert [cause for _, cause in pushed.catches] == [ControlStatus.OUTSIDE_DOMAIN]
    assert np.abs(np.diff(pushed.command, axis=0)).max() <= 1000.0 / RATE + 1e-9  # the rate limit


def test_statuses_follow_one_another_and_their_times_add_up(pushed: Trajectory) -> None:
    order = [status for k, status in enumerate(pushed.status) if k == 0 or pushed.status[k - 1] != status]
    names = [
        ControlStatus(int(s)).name for s in order if s not in (ControlStatus.SATURATED, ControlStatus.NEAR_BOUNDARY)
    ]
    assert [a for a, b in zip(names, ["", *names], strict=False) if a != b] == ["OK", "CAUGHT", "RETURNING", "OK"]
    lasting = pushed.seconds_in_status
    assert sum(lasting.values()) == pytest.approx(8.0)
    assert lasting[ControlStatus.CAUGHT] == pytest.approx(1.0, abs=2 / RATE)
    assert pushed.catches[0][0] == pytest.approx(pushed.times[np.argmax(pushed.status == ControlStatus.CAUGHT)])


def test_the_run_in_mujoco_is_the_one_in_cvodes(law: PDPlus, q0: Array, pushed: Trajectory) -> None:
    """Both plants agree to the tolerance of CVODES, amplified by the fall into the catcher and the way back."""
    pytest.importorskip("mujoco", reason="the extra sim is not installed")
    push = Push(0.5, 0.3, torque=[0.0, 60.0, 0.0])
    settings = {"control_rate": RATE, "pushes": [push], "safety": Safety.of(law)}
    other = simulate(law, still(law, q0, 8.0), q0, plant="mujoco", **settings)  # type: ignore[arg-type]
    np.testing.assert_allclose(other.q, pushed.q, atol=1e-4)
    assert (other.status != pushed.status).mean() < 1e-3


def test_never_asked_the_catcher_holds_to_the_end(law: PDPlus, q0: Array) -> None:
    push = Push(0.1, 0.3, torque=[0.0, 60.0, 0.0])
    safety = Safety.of(law)
    run = simulate(law, still(law, q0, 3.0), q0, control_rate=RATE, pushes=[push], safety=safety, resume_after=np.inf)
    assert run.status[-1] == ControlStatus.CAUGHT
    assert np.abs(run.dq[-1]).max() < 0.05


def test_started_outside_the_domain_it_comes_in(law: PDPlus, chart: oc.Chart) -> None:
    domain = chart.problem.domain
    q = domain.centre + 1.3 * domain.half_width
    reference = still(law, domain.centre, 6.0)
    run = simulate(
        law, reference, q, control_rate=RATE, safety=Safety.of(law), must_be_reachable=False, resume_after=0.1
    )
    assert run.status[0] == ControlStatus.CAUGHT
    assert run.catches[0] == (0.0, ControlStatus.OK)
    assert domain.contains(run.q[-1])
    assert run.status[-1] in (ControlStatus.OK, ControlStatus.SATURATED)


def test_undisturbed_it_follows_like_the_law_alone(law: PDPlus, chart: oc.Chart) -> None:
    q = chart.problem.domain.centre
    start = chart.phi(q)
    reference = Reference.steps(law.labels, start, [(0.5, {"x": start[0] + 0.03})], 2.5)
    run = simulate(law, reference, q, control_rate=RATE, safety=Safety.of(law))
    alone = simulate(law, reference, q, control_rate=RATE)
    np.testing.assert_allclose(run.q, alone.q, atol=2e-4)  # apart from the first 0.02 s, in which the law fades in
    assert {*run.status} <= {ControlStatus.OK, ControlStatus.SATURATED}


def test_velocity_laws_run_supervised(chart: oc.Chart) -> None:
    law, q = Kinematic(chart, 2.0), chart.problem.domain.centre
    start = chart.phi(q)
    reference = Reference.steps(law.labels, start, [(0.3, {"x": start[0] + 0.05})], 2.0)
    run = simulate(law, reference, q, control_rate=RATE, safety=Safety.of(law))
    assert run.outcome is Outcome.COMPLETE
    assert {*run.status} <= {ControlStatus.OK, ControlStatus.SATURATED}
    assert run.tracking_error[0] < 1e-3
    assert np.abs(np.diff(run.command, axis=0)).max() <= 20.0 / RATE + 1e-9


def test_statuses_and_causes_travel_in_files(pushed: Trajectory, tmp_path: Path) -> None:
    pushed.save(tmp_path / "run.npz")
    found = Trajectory.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(found.status, pushed.status)
    np.testing.assert_array_equal(found.cause, pushed.cause)
    assert found.catches == pushed.catches


def test_files_of_runs_without_causes_still_load(pushed: Trajectory, tmp_path: Path) -> None:
    path = tmp_path / "old.npz"
    pushed.save(path)
    with np.load(path) as stored:
        np.savez_compressed(path, **{name: stored[name] for name in stored.files if name != "cause"})
    found = Trajectory.load(path)
    np.testing.assert_array_equal(found.status, pushed.status)
    assert not found.cause.any()
    pushed.save(path)  # replaces it


def test_reports_and_pictures_name_the_times(pushed: Trajectory) -> None:
    assert "caught" in pushed.facts()
    title = trajectory_figure(pushed).get_suptitle()
    assert "catcher, caught 1 s, returning" in title
    assert "catcher" not in trajectory_figure(replace(pushed, status=0 * pushed.status)).get_suptitle()


def test_arguments_that_do_not_fit_are_named(law: PDPlus, chart: oc.Chart, monkeypatch: pytest.MonkeyPatch) -> None:
    q, safety = chart.problem.domain.centre, Safety.of(law)
    reference = still(law, q, 0.2)
    with pytest.raises(InvalidValueError, match="control_rate is None"):
        simulate(law, reference, q, safety=safety)
    with pytest.raises(InvalidValueError, match="control_rate is 20"):
        simulate(law, reference, q, control_rate=20.0, safety=safety)
    with pytest.raises(InvalidValueError, match="resume_after"):
        simulate(law, reference, q, control_rate=RATE, safety=safety, resume_after=-1.0)
    with pytest.raises(InvalidValueError, match="safety"):
        simulate(law, reference, q, control_rate=RATE, safety=law)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="rest_speed"):
        simulate(law, reference, q, control_rate=RATE, safety=replace(safety, rest_speed=[0.5, 0.5]))
    projector = Projector(chart.problem, 100.0, 10.0)
    posture = Reference.steps(projector.labels, projector.measured(q).full().ravel(), [], 0.2)
    with pytest.raises(InvalidValueError, match="has no chart"):
        simulate(projector, posture, q, control_rate=RATE, safety=Safety.of(projector))
    monkeypatch.setattr(libraries.shutil, "which", lambda name: None)
    with pytest.raises(CompileError, match="no C compiler"):
        simulate(law, reference, q, control_rate=RATE, safety=safety)


def test_command_line_reports_catches(run: Run, chart: oc.Chart, q0: Array, tmp_path: Path) -> None:
    chart.save(tmp_path / "chart.orthocas")
    push = {"start": 0.5, "duration": 0.3, "torque": [0, 60, 0]}
    steps = {"duration": 3.0, "start": q0.tolist(), "steps": [], "pushes": [push]}
    (tmp_path / "steps.json").write_text(json.dumps(steps))
    words = ("simulate", "chart.orthocas", "--controller", "pd_plus", "--steps", "steps.json", "--out", "out")
    words = (*words, "--animation", "none", "--limit", "120", "--json", "--supervised")
    code, _, err = run(*words)
    assert code == 2
    assert "--rate" in err
    code, out, err = run(*words, "--rate", "500")
    report = json.loads(out)
    assert code == 0
    assert [catch["cause"] for catch in report["catches"]] == ["OUTSIDE_DOMAIN"]
    assert report["seconds_in_status"]["CAUGHT"] == pytest.approx(1.0, abs=0.01)
    assert "the arm left the domain: the catcher took over, once in all" in err
