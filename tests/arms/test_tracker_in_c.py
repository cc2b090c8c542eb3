"""The arm's tracker as C99: no warnings, no memory of its own, and each tick that of Python."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
from programs import nightly

import orthocas as oc
from orthocas.arms import TrackStatus
from orthocas.arms.chart_kernel import RULES, PosturesInC, tracker_type
from orthocas.errors import InvalidValueError
from orthocas.native.libraries import find_compilers

WARNINGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-wide", *nightly("iiwa7-wide")])
def test_generated_ticks_are_those_of_python(name: str, tmp_path: Path) -> None:
    """On a motion in the chart, jumps, NaN, and the way back to x and xi."""
    chart, rng = oc.load(name), np.random.default_rng(1)
    arm, q = oc.Arm(chart.task, (chart,)), np.array(chart.domain.centre)
    header, source = arm.generate_c(tmp_path / "c", "robot", RULES.postures)
    assert header.exists()
    for compiler in find_compilers():
        library = tmp_path / f"{Path(compiler).name}.so"
        subprocess.run([compiler, *WARNINGS, "-fPIC", "-shared", "-o", library, source, "-lm"], check=True)
    symbols = subprocess.run(["nm", "-u", library], capture_output=True, text=True, check=True).stdout
    assert not {"malloc", "calloc", "realloc", "free", "printf"} & set(symbols.replace("@", " ").split())
    c = ctypes.CDLL(str(library))
    state, target = np.zeros(1, tracker_type(7, 1, 12)), np.empty(12)
    stored = ctypes.byref(PosturesInC.in_dll(c, "robot_stored"))
    place = ctypes.c_void_p(state.ctypes.data)
    c.robot_track_init(place, ctypes.c_double(0.01))
    c.robot_track_reset(place, ctypes.c_void_p(q.ctypes.data))
    tracker, x = arm.tracker(q), arm.x(q)
    jumps = arm.x(rng.uniform(arm.robot.lower, arm.robot.upper, (4, 7)))
    stream = [x + 0.1 * np.sin(k / 30) * np.eye(6)[0] for k in range(100)]
    stream += [row for jump in (*jumps, np.full(6, np.nan)) for row in [jump] * 30] + [x] * 700
    statuses = []
    for value in stream:
        tracker.step(value)
        c.robot_target(ctypes.c_void_p(value.ctypes.data), ctypes.c_void_p(target.ctypes.data))
        statuses.append(c.robot_track(place, stored, ctypes.c_void_p(target.ctypes.data), None))
        # Compilers round differently, and a search may end at another posture then.
        if len(statuses) < 100 or tracker.status is TrackStatus.OK == statuses[-1]:
            assert state["q"][0] == pytest.approx(tracker.q, abs=1e-7)
    assert statuses[-1] == TrackStatus.OK
    assert arm.x(state["q"][0]) == pytest.approx(x, abs=1e-8)
    assert (state["q"][0] <= arm.robot.upper).all()


def test_files_of_others_stay(tmp_path: Path) -> None:
    arm = oc.Arm(oc.problems.get("planar_3r_xy").task)
    arm.generate_c(tmp_path, "arm", postures=10)
    arm.generate_c(tmp_path, "arm", postures=10)
    (tmp_path / "arm_track.c").write_text("int mine;")
    with pytest.raises(InvalidValueError, match="did not write"):
        arm.generate_c(tmp_path, "arm", postures=10)
    with pytest.raises(InvalidValueError, match="C identifier"):
        arm.generate_c(tmp_path, "math")
