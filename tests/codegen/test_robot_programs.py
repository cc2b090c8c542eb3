"""Programs for robots: the one in C around MuJoCo."""

from pathlib import Path

import arm_film
import arm_in_mujoco
import numpy as np
import pytest
from arm_log import Log
from arm_scene import write_scene
from PIL import Image
from programs import needs_c, needs_cmake

import orthocas as oc
from orthocas.fitting.fit import Fit

mujoco = pytest.importorskip("mujoco", minversion="4", reason="the extra orthocas[mujoco] is not installed")


@pytest.mark.nightly
@needs_c
@needs_cmake
@pytest.mark.usefixtures("unoptimised")
def test_program_in_c_is_pushed_out_of_the_domain_and_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Start, hold, move, a push of 120 N at the elbow, return, a wall, home; 23 s at 1 kHz."""
    monkeypatch.setenv("CFLAGS", "-O1")  # it runs for long enough
    found = arm_in_mujoco.main(tmp_path, quick=True)
    assert found["largest_change"] <= 1.0 + 1e-7  # 1000 N m/s; the log has nine digits of torques below 100 N m
    assert found["left_domain"] == found["caught"] == found["returning"] == 1
    assert found["settled_s"] < 0.5
    assert found["back_s"] < 8
    assert found["flange_mm"] < 0.05
    assert 30 < found["wall_N"] < 60  # the stream stops where its posture comes near the boundary
    assert found["end_inside"] == 1
    assert found["end_speed"] < 0.01
    assert found["end_error"] < 1e-4
    assert (tmp_path / "arm_in_mujoco.png").stat().st_size > 20_000


def test_scene_has_the_dynamics_of_the_robot(tmp_path: Path, iiwa: oc.Problem) -> None:
    """To rounding: MJCF is written with all digits."""
    write_scene(iiwa.robot.tree, tmp_path / "scene.xml", 0.8, 0.6)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    q, dq, M = *np.random.default_rng(7).uniform(-1, 1, (2, 7)), np.zeros((7, 7))
    data.qpos[:], data.qvel[:] = q, dq
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    np.testing.assert_allclose(M, iiwa.robot.mass_matrix(q), atol=1e-12)
    np.testing.assert_allclose(data.qfrc_bias, iiwa.robot.bias(q, dq), atol=1e-11)
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], iiwa.robot.effort_limits)


@pytest.mark.slow
def test_film_of_lines_takes_the_place_of_a_renderer(
    tmp_path: Path, iiwa_fit: Fit, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On machines without EGL."""
    chart, ticks = iiwa_fit.chart, 401
    time, q = np.linspace(0, 0.4, ticks), np.tile(iiwa_fit.chart.problem.domain.centre, (ticks, 1))
    phi = np.tile(chart.phi(q[0]), (ticks, 1))
    log = Log(time, np.zeros(ticks, int), 0 * time, 0 * time, q, 0 * q, 0 * q, phi, phi)

    def no_renderer(*_: object) -> None:
        raise RuntimeError("no EGL")

    monkeypatch.setattr(arm_film, "_pictures", no_renderer)
    arm_in_mujoco.draw_film(log, chart, tmp_path)
    assert "MuJoCo cannot draw here (no EGL)" in capsys.readouterr().err
    with Image.open(tmp_path / "arm_in_mujoco.gif") as film:
        assert film.n_frames > 1
