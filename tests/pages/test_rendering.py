"""Shaded pictures: what is in front hides what is behind, ghosts let light through, the hand of the README stays."""

from pathlib import Path

import numpy as np
import pytest
import self_motion_picture
import wide_film
from PIL import Image
from rendering import Camera, Layer, on_ground, render

from orthocas.viewer.looks import Solid, build_ball

CAMERA = Camera((5.0, 0.0, 0.0), (0.0, 0.0, 0.0), 60.0)
RED, BLUE = (200, 20, 20), (20, 20, 200)


def ball_at(x: float, radius: float, colour: tuple[int, int, int]) -> Solid:
    return build_ball(radius, colour).move(np.eye(3), np.array([x, 0.0, 0.0]))


def middle_of(*layers: Layer) -> np.ndarray:
    return on_ground(render(layers, CAMERA, 60, 40, floor=None))[20, 30].astype(int)


def test_ball_has_the_size_that_the_pinhole_gives_it() -> None:
    picture = render([Layer([ball_at(0.0, 1.0, RED)])], CAMERA, 90, 60, floor=None)
    rows = np.flatnonzero((picture[..., 3] > 5).any(axis=1))
    seen = 30 / np.tan(np.radians(30)) * np.tan(np.arcsin(1 / 5))  # [pixels]
    assert np.ptp(rows) + 1 == pytest.approx(2 * seen, abs=1.5)
    assert picture[0, 0, 3] == 0
    assert (on_ground(picture)[0, 0] == 255).all()


def test_nearer_solids_hide_farther_ones_in_any_order() -> None:
    near, far = Layer([ball_at(1.0, 0.5, RED)]), Layer([ball_at(-1.0, 1.0, BLUE)])
    assert middle_of(near, far).tolist() == middle_of(far, near).tolist() == middle_of(near).tolist()


def test_ghosts_let_half_of_the_light_through() -> None:
    behind, ghost = [ball_at(-1.0, 1.0, BLUE)], [ball_at(1.0, 0.5, RED)]
    alone = middle_of(Layer(ghost)), middle_of(Layer(behind))
    assert middle_of(Layer(behind), Layer(ghost, 0.5)) == pytest.approx((alone[0] + alone[1]) / 2, abs=1)


def test_layers_above_are_seen_through_everything() -> None:
    hidden, front = [ball_at(-1.0, 1.0, BLUE)], [ball_at(1.0, 0.5, RED)]
    assert middle_of(Layer(hidden, above=True), Layer(front)).tolist() == middle_of(Layer(hidden)).tolist()


def test_shadows_fall_on_the_floor() -> None:
    above = ball_at(0.0, 0.5, RED).move(np.eye(3), np.array([0.0, 0.0, 1.0]))
    camera = Camera((3.0, 0.0, 3.0), (0.0, 0.0, 0.0), 60.0)
    picture = on_ground(render([Layer([above])], camera, 60, 40, floor=0.0))
    greys = (np.ptp(picture.astype(int), axis=2) == 0) & (picture[..., 0] < 230)
    assert greys.sum() > 20


@pytest.mark.slow
def test_the_hand_of_the_readme_stays_while_the_elbow_moves(tmp_path: Path) -> None:
    found = self_motion_picture.main(tmp_path, quick=True)
    assert found["hand_moves"] < 1e-9
    assert found["elbow_moves_m"] > 0.5
    with Image.open(tmp_path / "self_motion.png") as picture:
        opacity = np.asarray(picture)[..., 3]
        assert opacity[0].max() == opacity[:, 0].max() == 0  # nothing touches the edge
        assert opacity.max() == 255


@pytest.mark.nightly
@pytest.mark.slow
def test_the_film_of_the_readme_shows_a_hand_that_stays_and_joints_that_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wide_film, "LOOPS", 1)
    monkeypatch.setattr(wide_film, "STEPS", 100)
    found = wide_film.main(tmp_path, quick=True)
    assert found["hand_moves"] < 1e-12
    assert found["elbow_moves_m"] > 0.3
    assert found["left_by_chart_rad"] < 1e-9
    assert found["left_by_pseudo_inverse_rad"] > 0.1
    with Image.open(tmp_path / "wide_chart.gif") as film:
        assert film.n_frames > 5  # type: ignore[attr-defined]
