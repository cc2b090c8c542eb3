"""Ready charts: the files belong to their cards, the proofs to the charts, and the figures can be measured again."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import ready_charts
from programs import Run, nightly

import orthocas as oc
from orthocas.certificates import check_certificate
from orthocas.charts.chart_file import fingerprint
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import UnknownNameError
from orthocas.tasks.samples import sample_uniform

ROOT = Path(__file__).parents[2]
NAMES = oc.charts.names()
PROVED = [name for name in NAMES if not oc.charts.card(name).branch]
LICENCES = "Apache License", "Mozilla Public License", "Redistribution and use", "Permission is hereby granted"
WIDE = [name for name in NAMES if oc.charts.card(name).branch]


def test_there_are_charts_of_ten_arms() -> None:
    assert len(NAMES) >= 15
    assert len({oc.charts.card(name).model.robot for name in NAMES}) >= 10
    assert set(NAMES) == set(ready_charts.RECIPES)


@pytest.mark.parametrize("name", PROVED)
def test_chart_has_a_proof_and_is_the_one_on_its_card(name: str) -> None:
    """Loading refuses a proof of another chart, so a proof that is there is valid."""
    chart, card = oc.charts.load(name), oc.charts.card(name)
    assert chart.certificate is not None
    assert chart.certificate.proved
    assert chart.certificate.fingerprint == card.fingerprint
    assert chart.certificate.regular.proved_count == card.proved_parts
    assert chart.problem.robot.joint_names == card.joints
    assert np.array_equal(chart.problem.domain.half_width, card.half_width)
    assert card.quality["folded_samples"] == 0
    assert card.model.robot.split()[0] in repr(card)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*WIDE[:2], *nightly(*WIDE[2:])])
def test_wide_chart_holds_on_its_branch(name: str) -> None:
    """Volumes have one sign at all positions of the domain, from finite differences of poses and coordinates."""
    chart, card = oc.charts.load(name), oc.charts.card(name)
    domain = chart.problem.domain
    assert isinstance(domain, RegularPart)
    assert fingerprint(chart.problem, chart.coordinates) == card.fingerprint
    assert card.regular_share > 0.99
    assert oc.branches(chart.problem.robot, chart.problem.task).of(domain.centre).name == card.branch
    q = sample_uniform(domain, 200, 5)
    rows = np.array([[frame_velocities(chart, point, k) for k in range(chart.n)] for point in q])
    slopes = np.stack([(chart.xi(q + h) - chart.xi(q - h)) / 2e-6 for h in 1e-6 * np.eye(chart.n)], axis=2)
    signs = np.sign(np.linalg.det(np.concatenate([rows.transpose(0, 2, 1), slopes], axis=1)))
    assert np.all(signs == signs[0])


def frame_velocities(chart: oc.Chart, q: np.ndarray, k: int) -> np.ndarray:
    """Velocity and angular velocity of the tip in the world for joint k, by finite differences, (6,)."""
    robot, step = chart.problem.robot, 1e-6 * np.eye(chart.n)[k]
    before, after = robot.tip_rotation(q - step), robot.tip_rotation(q + step)
    turn = (after - before) @ robot.tip_rotation(q).T / 2e-6
    moved = (robot.tip_position(q + step) - robot.tip_position(q - step)) / 2e-6
    return np.array([*moved, turn[2, 1], turn[0, 2], turn[1, 0]])


@pytest.mark.parametrize("name", NAMES)
def test_recipes_are_those_on_the_cards_and_licences_travel(name: str) -> None:
    assert ready_charts.up_to_date(name, ready_charts.DATA)
    licence = oc.charts.card(name).licence_text
    assert any(word in licence for word in LICENCES)
    model = oc.charts.card(name).model
    head, _, rest = licence.partition(model.upstream)
    assert head.endswith(f"[{model.licence}], ")
    line = rest.split("\n\n")[0]
    assert "Copyright " in line or "no copyright line. Authors: " in line or "no copyright line. Maintainer: " in line


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-pose", "tiago-pro-left-position"])
def test_figures_of_cards_are_found_at_other_samples(name: str) -> None:
    """Root mean squares of 4,000 other points differ by some percent."""
    report, quality = oc.evaluate(oc.charts.load(name), 4000, seed=7), oc.charts.card(name).quality
    assert report.leak.rms == pytest.approx(quality["leak_deg"]["rms"], rel=0.1)
    assert report.task_angle.std == pytest.approx(quality["task_angle_deg"]["std"], rel=0.1)
    assert report.conditioning.mean == pytest.approx(quality["conditioning"]["mean"], rel=0.02)
    assert report.conditioning.min >= 0.95 * quality["conditioning"]["min"]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PROVED[:2], *nightly(*PROVED[2:])])
def test_one_to_one_box_is_large_and_holds_no_two_points_with_the_same_phi(name: str) -> None:
    """100,000 pairs, half of them near the pairs that come closest: J(c)^-1 (phi(q) - phi(p)) never comes near 0."""
    chart = oc.charts.load(name)
    assert chart.certificate is not None
    box = chart.certificate.injective
    assert box is not None
    half, rng = (box.high - box.low) / 2, np.random.default_rng(11)
    assert np.median(half) > 0.1
    q, p = rng.uniform(box.low, box.high, (2, 50_000, chart.n))
    q[::2] = np.where(rng.uniform(size=q[::2].shape) < 0.5, box.low, box.high)
    near = np.argsort(_apart(chart, q, p))[:500]
    q, p = (
        np.repeat(points[near], 100, axis=0) + rng.normal(size=(50_000, chart.n)) * 0.05 * half for points in (q, p)
    )
    q, p = np.clip(q, box.low, box.high), np.clip(p, box.low, box.high)
    assert _apart(chart, q, p).min() > 1e-3


def _apart(chart: oc.Chart, q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """|J(c)^-1 (phi(q) - phi(p))| / |q - p| at the middle c of pairs of points: 1 for a linear chart."""
    steps = np.linalg.solve(chart.jacobian((q + p) / 2), (chart.phi(q) - chart.phi(p))[:, :, None])[:, :, 0]
    ratio: np.ndarray = np.linalg.norm(steps, axis=1) / np.linalg.norm(q - p, axis=1)
    return ratio


def test_a_cyclic_joint_may_be_anywhere() -> None:
    """The Jacobian of a ready chart stays regular when the base joint turns over its whole range."""
    chart = oc.charts.load("panda-position")
    q = sample_uniform(chart.problem.domain, 500, 3)
    signs = np.sign(np.linalg.det(chart.jacobian(q)))
    assert np.ptp(q[:, 0]) > 5.5
    assert np.all(signs == signs[0])


@pytest.mark.slow
def test_a_proof_holds_when_it_is_checked_again() -> None:
    chart = oc.charts.load("xarm7-pose")
    assert check_certificate(chart, chart.certificate)


def test_cards_keep_all_they_have_as_text() -> None:
    card = oc.charts.card("panda-position")
    assert oc.charts.Card.from_json(card.to_json()).as_dict() == card.as_dict()


@pytest.mark.parametrize("call", [oc.charts.load, oc.charts.card])
def test_unknown_names_are_told_the_known_ones(call: object) -> None:
    with pytest.raises(UnknownNameError, match=r"ready chart 'panda'.*panda-position"):
        call("panda")  # type: ignore[operator]


def test_command_lists_charts_shows_cards_and_writes_files(run: Run) -> None:
    code, listed, _ = run("charts")
    assert code == 0
    assert len(listed.splitlines()) == len(NAMES) + 1
    code, shown, _ = run("charts", "panda-position", "--out", "panda.orthocas")
    assert code == 0
    assert "orthocas fit panda.urdf --tip panda_hand" in shown
    assert oc.load("panda.orthocas").labels == ("x", "y", "z", "xi1", "xi2", "xi3", "xi4")
    data = json.loads(run("charts", "--json")[1])
    assert [card["name"] for card in data["charts"]] == list(NAMES)
    code, _, complaint = run("charts", "--out", "all.orthocas")
    assert (code, len(complaint.splitlines())) == (2, 1)


def test_page_shows_the_figures_of_the_cards() -> None:
    page = (ROOT / "docs" / "reference" / "ready_charts.md").read_text(encoding="utf-8")
    for line in ready_charts.table():
        assert line in page
    pictures = re.findall(r"\]\(\.\./(figures/charts/[^)]+)\)", page)
    assert {Path(path).stem for path in pictures} == set(NAMES)
    assert all((ROOT / "docs" / path).exists() for path in pictures)
