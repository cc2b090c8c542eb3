"""Arms that their motors cannot hold: laws, C and simulations say so, with numbers of Pinocchio."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from conftest import Run, robot_data
from programs import needs_c

import orthocas as oc
from orthocas.control import Impedance, PDPlus, Reference, RunTimeModel, Safety
from orthocas.errors import LawWarning
from orthocas.simulation import Outcome, Push, Trajectory, simulate
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

SHOULDER = "l_shoulder_lift_joint"


@pytest.fixture(scope="module")
def chart() -> oc.Chart:
    """A PR2's left arm, whose springs its file does not have: gravity exceeds what the file lets the motors do."""
    return oc.charts.load("pr2-left-position")


def quietly(law: Any, *arguments: Any, **settings: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LawWarning)
        return law(*arguments, **settings)


def gravity_of_pinocchio(chart: oc.Chart, points: Array) -> Array:
    model = pin.buildModelFromUrdf(str(robot_data("pr2_description/urdf/pr2.urdf")))
    data, robot = model.createData(), chart.problem.robot
    joints = [model.joints[model.getJointId(name)] for name in robot.joint_names]
    found = []
    for q in points:
        whole = pin.neutral(model)
        for joint, value in zip(joints, q, strict=True):
            if joint.nq == 1:
                whole[joint.idx_q] = value
            else:
                whole[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
        torques = pin.computeGeneralizedGravity(model, data, whole)
        found.append([torques[joint.idx_v] for joint in joints])
    return np.array(found)


@pytest.mark.slow
def test_laws_warn_with_the_torque_of_pinocchio_and_the_share_of_the_domain(chart: oc.Chart) -> None:
    domain, robot = chart.problem.domain, chart.problem.robot
    joint = robot.joint_names.index(SHOULDER)
    needed = abs(gravity_of_pinocchio(chart, domain.centre[None])[0, joint])
    assert needed > 1.2 * robot.effort_limits[joint] == 36.0
    with pytest.warns(LawWarning, match=f"gravity needs {needed:.4g} N m at joint '{SHOULDER}', the limit is 30 N m"):
        law = PDPlus(chart, 50.0)
    (remark,) = [text for text in law.remarks() if "cannot hold" in text]
    torques = np.abs(gravity_of_pinocchio(chart, sample_uniform(domain, 4000, 3)))
    share = 100 * (torques > robot.effort_limits).any(axis=1).mean()
    said = float(remark.split("% of")[0].rpartition(" ")[2])
    assert said == pytest.approx(share, abs=3.0)  # three standard deviations of 512 samples are below 2.9 %
    with pytest.warns(LawWarning, match="cannot hold the arm at the centre of the domain"):
        Impedance(chart, 50.0)


def test_laws_that_can_hold_or_need_not_are_silent(chart: oc.Chart) -> None:
    """More torque, or a robot that compensates gravity itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not any("hold" in text for text in PDPlus(chart, 50.0, limit=2000.0).remarks())
        PDPlus(chart, 50.0, model=RunTimeModel(gravity="robot"))
        PDPlus(oc.charts.load("panda-position"), 50.0)


def test_a_payload_counts() -> None:
    chart = oc.charts.load("panda-position")
    with pytest.warns(LawWarning, match="cannot hold"):
        PDPlus(chart, 50.0, model=RunTimeModel(payload=[30.0, 0.0, 0.0, 0.0]))


def test_a_fit_says_what_its_motors_cannot_hold(run: Run) -> None:
    """A link of 1 m and 1 kg needs 9.81 x 0.5 N m where it is level, as it is at home."""
    weak = """<robot name="weak"><link name="base"/>
      <link name="l1"><inertial><mass value="1"/><origin xyz="0.5 0 0"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <link name="l2"><inertial><mass value="1e-9"/>
        <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <link name="tip"/>
      <joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="EFFORT" velocity="1"/></joint>
      <joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="1 0 0"/><axis xyz="0 1 0"/>
        <limit lower="0.2" upper="1.2" effort="1" velocity="1"/></joint>
      <joint name="j3" type="fixed"><parent link="l2"/><child link="tip"/><origin xyz="1 0 0"/></joint></robot>"""
    words = ("fit", "weak.urdf", "--tip", "tip", "--task", "position:x", "--param", "linear", "--samples", "200")
    for effort, lines in ((0.5, 1), (10.0, 0)):
        Path("weak.urdf").write_text(weak.replace("EFFORT", str(effort)))
        code, _, err = run(*words, "--out", f"{effort}.orthocas", "--json")
        assert code == 0
        assert len(err.splitlines()) == lines
        assert (
            not lines or "the motors cannot hold the arm at the centre of the domain: gravity needs 4.905 N m at" in err
        )


def at_rest(chart: oc.Chart, duration: float) -> Reference:
    return Reference.steps(chart.labels, chart.phi(chart.problem.domain.centre), [], duration)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{}, {"plant": "mujoco", "control_rate": 500.0}], ids=["cvodes", "mujoco"])
def test_a_run_in_which_the_arm_falls_is_not_complete(chart: oc.Chart, settings: dict[str, Any]) -> None:
    law, centre = quietly(PDPlus.on_chart, chart), chart.problem.domain.centre
    run = simulate(law, at_rest(chart, 1.5), centre, **settings)
    assert not chart.problem.domain.contains(run.q[-1])
    assert run.outcome is Outcome.LOST
    assert run.reason.startswith("the arm left the domain of the chart at t = 0.")
    assert "lost, the arm left the domain" in str(run)


@pytest.mark.slow
def test_an_arm_that_sinks_within_its_domain_is_lost_too(planar_chart: oc.Chart, planar_q0: Array) -> None:
    """The planar arm stands in gravity: with most of the torque that it needs, it sinks, not yet out of its domain."""
    robot = planar_chart.problem.robot
    limit = 0.9 * np.abs(robot.gravity(planar_q0)).clip(1e-3)
    law = quietly(PDPlus, planar_chart, 50.0, limit=limit)
    run = simulate(law, at_rest(planar_chart, 0.3), planar_q0)
    assert planar_chart.problem.domain.contains(run.q).all()
    assert run.outcome is Outcome.LOST
    assert run.reason.startswith("from t = 0 s to 0.3 s joint ")


@pytest.mark.slow
@needs_c
def test_a_supervised_law_too_weak_for_the_arm_falls_into_its_catcher_and_is_lost(
    planar_for_control: oc.Chart, planar_q0: Array
) -> None:
    limit = 0.6 * np.abs(planar_for_control.problem.robot.gravity(planar_q0))
    law = quietly(PDPlus.on_chart, planar_for_control, limit=limit)
    run = simulate(law, at_rest(planar_for_control, 0.5), planar_q0, control_rate=500.0, safety=Safety.of(law))
    assert run.catches
    assert run.outcome is Outcome.LOST
    assert "joint 'q1' was at its limit" in run.reason


@pytest.mark.nightly
def test_a_supervised_law_that_falls_into_its_catcher_is_lost() -> None:
    chart = oc.charts.load("pr2-left-wide")
    law, centre = quietly(PDPlus.on_chart, chart), chart.problem.domain.centre
    run = simulate(law, at_rest(chart, 2.0), centre, plant="mujoco", control_rate=500.0, safety=Safety.of(law))
    assert run.catches
    assert run.outcome is Outcome.LOST
    assert f"joint '{SHOULDER}' was at its limit" in run.reason


@pytest.mark.slow
def test_a_push_that_saturates_motors_for_a_while_is_borne(planar_chart: oc.Chart, planar_q0: Array) -> None:
    gravity = np.abs(planar_chart.problem.robot.gravity(planar_q0))
    law = quietly(PDPlus.on_chart, planar_chart, 1.5 * gravity + 3.0)
    run = simulate(law, at_rest(planar_chart, 4.0), planar_q0, pushes=[Push(0.2, 0.1, (0.0, -12.0, 0.0))])
    assert run.saturated.any()
    assert (run.outcome, run.reason) == (Outcome.COMPLETE, "")


@pytest.mark.slow
def test_the_reason_travels_in_files(planar_chart: oc.Chart, planar_q0: Array, tmp_path: Path) -> None:
    kept = simulate(PDPlus(planar_chart, 50.0), at_rest(planar_chart, 0.1), planar_q0)
    lost = replace(kept, outcome=Outcome.LOST, reason="the arm left the domain of the chart at t = 1 s")
    lost.save(tmp_path / "run.npz")
    found = Trajectory.load(tmp_path / "run.npz")
    assert (found.outcome, found.reason) == (lost.outcome, lost.reason)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_generated_c_and_commands_say_it(chart: oc.Chart, run: Run) -> None:
    chart.save("arm.orthocas")
    Path("still.json").write_text(json.dumps({"duration": 1.0, "steps": []}))
    said = f"at joint '{SHOULDER}', the limit is 30 N m"
    code, _, err = run("codegen", "arm.orthocas", "--controller", "pd_plus", "--out", "c")
    assert code == 0
    assert said in " ".join(err.split())
    assert said in Path("c/README.md").read_text()
    assert any(said in header.read_text() for header in Path("c").glob("*.h"))
    words = ("--controller", "pd_plus", "--steps", "still.json", "--animation", "none", "--out", "run")
    code, out, err = run("simulate", "arm.orthocas", *words)
    assert code == 1
    assert "lost" in out
    assert said in " ".join(err.split())
    assert "the law lost the arm: the arm left the domain" in err
