"""Examples of what projectors lose: short runs, and the facts they show."""

from pathlib import Path

import cyclic_motion
import hidden_spring
import numpy as np
import passivity
import projected_coordinates
import pytest
import self_motion_on_command

import orthocas as oc
from orthocas.control import Impedance
from orthocas.tools.batch import Batched

pytestmark = pytest.mark.slow

IMPEDANCE = ("impedance, coupled", "impedance, decoupled")
PROJECTORS = ("projector, A = I", "projector, A = M")


def test_energy_never_rises_in_coordinates_and_does_behind_projectors(tmp_path: Path) -> None:
    found = passivity.main(tmp_path, quick=True)
    assert (tmp_path / "passivity.png").stat().st_size > 10_000
    for name in (*IMPEDANCE, *PROJECTORS):
        assert found[f"planar 3R, {name}: runs that stayed"] == 3
    for name in IMPEDANCE:
        assert found[f"planar 3R, {name}: runs with a rise"] == 0
    assert found["planar 3R, projector, A = I: runs with a rise"] == 3
    assert found["planar 3R, projector, A = M: runs with a rise"] >= 1
    assert found["planar 3R, projector, A = I: largest rise"] > 1e-4


@pytest.mark.parametrize("coupling", ["coupled", "decoupled"])
def test_storage_of_impedance_is_the_energy_of_robot_and_springs(coupling: str) -> None:
    """Also where condition (5) does not hold, as with linear coordinates away from their base."""
    problem = oc.problems.get("planar_3r_x")
    chart = oc.fit(problem, oc.Linear(base=problem.domain.centre, normals="paper")).chart
    law = Impedance(chart, (300.0, 40.0, 50.0), coupling=coupling)
    rng = np.random.default_rng(7)
    q, dq = problem.domain.centre + rng.uniform(-0.3, 0.3, (20, 3)), rng.normal(size=(20, 3))
    wanted = rng.normal(size=(20, 3))
    gains = [np.tile(gain, (20, 1)) for gain in law.gains.values()]
    storage = Batched(law.energy)(q, dq, wanted, 0 * wanted, 0 * wanted, *gains)[0][:, 0]
    kinetic = [v @ np.asarray(problem.robot.mass_matrix(p)) @ v / 2 for p, v in zip(q, dq, strict=True)]
    springs = (chart.phi(q) - wanted) ** 2 @ law.stiffness / 2
    assert storage == pytest.approx(kinetic + springs, rel=1e-12)


def test_hidden_spring_stays_loaded_and_discharges(tmp_path: Path) -> None:
    n = hidden_spring.main(tmp_path, quick=True)
    assert (tmp_path / "hidden_spring.png").stat().st_size > 10_000
    assert n["projector_instants_without_command"] == n["impedance_instants_without_command"] == 0
    # stuck: a loaded spring, an arm at rest, at the point that statics predicts
    assert n["projector_energy_before_tip_moves_J"] > 35
    assert n["hidden_torque_Nm"] > 50
    assert n["projected_torque_Nm"] < 0.01
    assert n["projector_speed_before_tip_moves"] < 0.01
    assert n["distance_from_predicted_point_rad"] < 0.01
    # freed by a small motion of the tip, to which the arm would otherwise move slowly
    assert n["projector_energy_at_the_end_J"] < 1
    assert n["projector_peak_speed_after"] > 10 * n["impedance_peak_speed_after"]
    assert n["impedance_energy_before_tip_moves_J"] < 1e-3 < n["impedance_energy_on_the_way_J"]


@pytest.mark.nightly
def test_projected_coordinates_keep_what_joint_springs_lose(tmp_path: Path) -> None:
    n = projected_coordinates.main(tmp_path, quick=True)
    assert (tmp_path / "projected_coordinates.png").stat().st_size > 10_000
    for size in projected_coordinates.SIZES:
        of = f"planar_3r_xy {size}"
        # the projector removes little of the force in xi, less than 1 / 4 of what it removes of joint springs
        assert n[f"{of} fitted: removed"] < n[f"{of} linear: removed"] < 0.25 * n[f"{of} joints: removed"]
        for name in ("linear", "fitted"):
            # what is left disturbs the task, unless the projector removes it
            assert n[f"{of} {name} direct PD+: x <- xi"] > 1e-4
            assert n[f"{of} {name} projected PD+: x <- xi"] < 1e-7
            # energy falls to nothing, directly and behind the projector
            for kind in ("direct", "projected"):
                assert n[f"{of} {name} {kind}, damping 0.7: runs with a rise"] == 0
                assert n[f"{of} {name} {kind}, damping 0.7: V left"] < 1e-6
            # only a law without a projector returns the joints exactly
            assert n[f"{of} {name} direct: drift, feedback 0"] < 1e-5 < n[f"{of} {name} projected: drift, feedback 1"]
            assert n[f"{of} {name} direct, damping 0.1: runs with a rise"] == 0
        joints = f"{of} joints projected, damping 0.7"
        assert n[f"{joints}: runs with a rise"] == n[f"{joints}: runs"]
        assert n[f"{joints}: V left"] > 0.1
    assert n["hidden spring, joints: energy [J]"] > 35
    assert n["hidden spring, fitted: energy [J]"] < 0.1


def test_joints_drift_with_the_pseudo_inverse_only(tmp_path: Path) -> None:
    n = cyclic_motion.main(tmp_path, quick=True)
    assert (tmp_path / "cyclic_motion.png").stat().st_size > 10_000
    for name in ("pseudo-inverse", "pseudo-inverse, loose"):
        assert n[f"{name}: drift of the first cycle [rad]"] == pytest.approx(0.0247, abs=1e-3)
        assert n[f"{name}: drift after 3 cycles [rad]"] == pytest.approx(3 * 0.0247, abs=3e-3)
    loose, tight, held = (n[f"xi constant{more}: drift after 3 cycles [rad]"] for more in (", loose", "", ", feedback"))
    assert loose < 1e-5
    assert tight < loose / 10
    assert held < tight
    assert all(value == 0 for key, value in n.items() if "without command" in key)
    assert all(value < 1e-5 for key, value in n.items() if "tool error" in key)


@pytest.mark.nightly
def test_tool_holds_still_while_the_arm_moves(tmp_path: Path) -> None:
    n = self_motion_on_command.main(tmp_path, quick=True)
    assert (tmp_path / "self_motion_on_command.png").stat().st_size > 10_000
    for name in ("velocity, A = I", "PD+ coupled, A = I"):
        assert n[f"{name}: tool moves [m]"] < 1e-7
        assert n[f"{name}: joints move [rad]"] > 0.4
        assert n[f"{name}: joints at the end [rad]"] < 1e-6
    assert 1e-3 < n["PD+ decoupled, A = I: tool moves [m]"] < 0.1
    assert all(value == 0 for key, value in n.items() if "without command" in key)
