"""Examples and the benchmark of closed loops, in quick mode."""

import struct
from pathlib import Path

import closed_loop
import control_tick
import controllers
import elbow_follower
import joystick
import lengths
import numpy as np
import panda_elbow
import pytest
from programs import needs_c

pytestmark = pytest.mark.slow


@pytest.mark.nightly
def test_panda_moves_its_elbow_and_not_its_hand(tmp_path: Path) -> None:
    found = panda_elbow.main(tmp_path, quick=True)
    assert found["coupled_elbow_m"] > 0.04
    assert found["decoupled_elbow_m"] > 0.04
    assert found["coupled_hand_m"] < 1e-4  # half a tick late, and noise
    assert found["decoupled_hand_m"] < 5e-3
    assert found["coupled_share_of_limit"] < 1
    assert found["coupled_ticks_not_ok"] == found["decoupled_ticks_not_ok"] == 0
    assert (tmp_path / "panda_elbow.png").stat().st_size > 20_000


@pytest.mark.nightly
def test_table_of_controllers_shows_what_fitted_coordinates_are_good_for() -> None:
    found = controllers.main(quick=True)
    fitted = found["planar_3r_x PD+ decoupled, fitted"]
    assert found["planar_3r_x PD+ coupled, linear"] < 1e-4  # the full inertia tracks in any coordinates
    assert fitted < 0.5 * found["planar_3r_x PD+ decoupled, linear"]  # degree 6; degree 8 has 0.07 of it
    assert fitted < found["planar_3r_x projector, A = M"] < found["planar_3r_x projector, A = I"]


@needs_c
def test_closed_loop_benchmark_agrees_with_its_peer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = closed_loop.main(quick=True)
    assert found["planar_3r_x continuous error"] < 1e-6
    assert found["planar_3r_x continuous, compiled error"] < 1e-6
    assert found["planar_3r_x SciPy LSODA error"] < 1e-6
    assert 1e-6 < found["planar_3r_x sampled at 1 kHz error"] < 1e-3  # half a tick late


@pytest.mark.nightly
@needs_c
def test_ticks_of_generated_c_are_measured() -> None:
    found = control_tick.main(quick=True)
    assert {"PD+ decoupled, polynomial:2", "projector, A = M"} <= set(found)
    for row in found.values():
        assert 0 < row["median"] <= row["p99"] <= row["worst"]


@pytest.mark.nightly
def test_length_term_evens_gradients() -> None:
    found = lengths.main(quick=True)
    assert found["planar_3r_x 4 1"].length_ratio < 0.3 * found["planar_3r_x 4 0"].length_ratio


@pytest.mark.nightly
@pytest.mark.slow
def test_elbow_follows_as_near_as_the_self_motion_allows(tmp_path: Path) -> None:
    found = elbow_follower.main(tmp_path, quick=True)["left"]
    assert found["travel_mm"] > 50
    assert found["error_mm"] <= 1.05 * found["least_error_mm"]
    assert found["hand_error_m"] < 1e-9
    assert found["fastest_rad_s"] < 2.0


def test_recording_with_other_columns_is_refused(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("1,2,3\n")
    with pytest.raises(SystemExit, match="rows have 3 numbers, expected 18"):
        elbow_follower.read(tmp_path / "points.csv")


def test_elbow_of_a_joystick_meets_its_boundary_and_the_hand_stays() -> None:
    """By MuJoCo; where only the elbow is pushed beyond its boundary, the hand is off by less than 1e-6 m."""
    found = joystick.main(iter(np.tile(np.eye(7)[6], (1000, 1))))
    assert found["reached"] + found["nearest"] == 1
    assert found["nearest"] > 0.1
    assert found["hand_error_m"] < 1e-9
    assert found["at_boundary_m"] < 1e-6
    assert found["fastest"] < 1 + 1e-9
    assert found["room_rad"] > 0


def test_events_of_a_joystick_become_sticks(tmp_path: Path) -> None:
    """Bytes as the kernel writes them: the first state, then axes and a button, in two ticks."""
    events = [(5000, 0, 0x82, 0), (5000, 16384, 0x82, 6), (5000, 1, 1, 0), (5012, -32767, 2, 0), (5012, 99, 2, 9)]
    (tmp_path / "events").write_bytes(b"".join(struct.pack("<IhBB", *event) for event in events))
    sticks = np.array(list(joystick.recorded(tmp_path / "events")))
    np.testing.assert_allclose(sticks[:, 0], [0.0, 0.0, -1.0])
    np.testing.assert_allclose(sticks[:, 6], 16384 / 32767)
    (tmp_path / "events").write_bytes(b"123")
    with pytest.raises(SystemExit, match="3 bytes, expected events of 8"):
        next(joystick.recorded(tmp_path / "events"))
