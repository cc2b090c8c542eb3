"""Actions in (x, xi) never break joint limits; episodes come back as they were."""

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from mujoco_arm import Arm
from pages import blocks
from programs import nightly
from public_objects import ring, wide

import orthocas as oc
from orthocas import learn
from orthocas.charts.trackers import TrackerStatus
from orthocas.errors import DomainError, InvalidValueError, InverseError, ShapeError
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array


def walked(chart: oc.Chart, steps: int, step: float) -> tuple[Array, list[TrackerStatus]]:
    """Joint positions of a random walk, and how the steps ended."""
    env, rng = learn.PhiActions(Arm(chart), chart, step), np.random.default_rng(3)
    env.reset(seed=0)
    q, statuses, drift = np.empty((steps, chart.n)), [], rng.normal(size=chart.n)
    for k in range(steps):
        drift = 0.95 * drift + rng.normal(size=chart.n)  # it reaches the boundaries again and again
        _, _, _, _, info = env.step(np.clip(drift, -1, 1))
        q[k] = env.unwrapped.data.qpos  # type: ignore[attr-defined]
        statuses.append(info["tracker"])
    return q, statuses


@pytest.mark.slow
@pytest.mark.parametrize(("name", "steps"), [("planar, wide", 3000), *nightly(("panda-wide", 3000))])
def test_random_walks_break_no_joint_limit(name: str, steps: int) -> None:
    chart = wide().chart if name == "planar, wide" else oc.charts.load(name)
    q, statuses = walked(chart, steps, 0.02)
    robot = chart.problem.robot
    assert ((q >= robot.lower) & (q <= robot.upper)).all()
    assert chart.problem.domain.contains(q).all()
    refused = np.mean([status != TrackerStatus.OK for status in statuses])
    assert 0.001 < refused < 0.9  # the walk did meet boundaries, and went on
    assert np.ptp(q[-500:], axis=0).max() > 0.05


PAGE = 0.02  # the step of the page


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda-position", "panda-pose", "iiwa7-pose", "panda-wide"])
def test_actions_that_need_several_steps_of_the_tracker_act(name: str) -> None:
    """A whole one along each axis from home, by MuJoCo; and none of many random ones is dropped."""
    chart = oc.charts.load(name)
    env, rng = learn.PhiActions(Arm(chart), chart, PAGE), np.random.default_rng(0)
    for axis in range(3):
        first, _ = env.reset()
        last, *_, info = env.step(np.eye(chart.n)[axis])
        assert info["tracker"] == TrackerStatus.OK
        np.testing.assert_allclose(last[:3] - first[:3], PAGE * np.eye(3)[axis], rtol=0, atol=1e-9)
    env.reset()
    data: Any = env.unwrapped.data  # type: ignore[attr-defined]
    for _ in range(200):
        before = data.qpos.copy()
        *_, info = env.step(rng.uniform(-1, 1, chart.n))
        assert info["tracker"] in (TrackerStatus.OK, TrackerStatus.NEAREST)
        assert np.abs(data.qpos - before).max() > 1e-6
        assert chart.problem.domain.contains(data.qpos)


@pytest.mark.filterwarnings("ignore:.*(infinity|different from the unwrapped):UserWarning")
def test_the_checker_of_gymnasium_accepts_it() -> None:
    chart = oc.fit(oc.problems.get("planar_3r_xy"), oc.Polynomial(2), samples=300).chart
    env = learn.PhiActions(Arm(chart), chart, PAGE)
    check_env(env, skip_render_check=True)
    first, _ = env.reset(seed=3, options={})
    np.testing.assert_array_equal(first, env.reset(seed=3)[0])


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_checker_of_stable_baselines_accepts_it() -> None:
    """Where it is installed: it brings several gigabytes of torch, so the extras do not ask for it."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    chart = oc.fit(oc.problems.get("planar_3r_xy"), oc.Polynomial(2), samples=300).chart
    checker.check_env(learn.PhiActions(Arm(chart), chart, PAGE))


@pytest.mark.slow
def test_an_action_moves_one_coordinate_with_the_tool_at_rest() -> None:
    """Against MuJoCo's kinematics; observations are those of the environment with xi and the room to the boundary."""
    chart = oc.fit(oc.problems.get("iiwa"), oc.Polynomial(2), samples=500).chart
    env = learn.PhiActions(Arm(chart), chart, 0.01)
    first, _ = env.reset()
    again, *_, info = env.step(np.array([0, 0, 0, 1, 0, 0, 0.0]))
    assert info["tracker"] == TrackerStatus.OK
    np.testing.assert_allclose(again[:3], first[:3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(again[3:7] - first[3:7], [0.01, 0, 0, 0], rtol=0, atol=1e-9)
    assert first[-1] == pytest.approx(chart.problem.domain.half_width.min())
    assert env.observation_space.contains(again)
    moved, *_ = env.step(np.array([1, 0, 0, 0, 0, 0, 0.0]))
    np.testing.assert_allclose(moved[:3] - again[:3], [0.01, 0, 0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_an_action_turns_a_pose_about_the_tips_axes() -> None:
    chart = oc.charts.load("panda-wide")
    env = learn.PhiActions(Arm(chart), chart, 0.01)
    env.reset()
    data: Any = env.unwrapped.data  # type: ignore[attr-defined]
    before = data.body("tip").xmat.reshape(3, 3).copy()
    env.step(np.array([0, 0, 0, 0, 0, 1.0, 0]))
    turn = before.T @ data.body("tip").xmat.reshape(3, 3)
    assert turn[1, 0] == pytest.approx(2 * 0.005 * np.sqrt(1 - 0.005**2), abs=1e-9)  # 2 sin(angle / 2) = 0.01
    np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar, wide", "circle", "pose"])
def test_episodes_come_back_as_they_were(name: str) -> None:
    chart = {"planar, wide": wide().chart, "circle": ring(), "pose": oc.charts.load("panda-wide")}[name]
    points = sample_uniform(chart.problem.domain, 200, 5)
    domain = chart.problem.domain
    ends = (
        np.array([[0.5, 1.3], [1.2, 0.9]]) if name == "circle" else domain.centre + 0.3 * (points[:2] - domain.centre)
    )
    s = np.linspace(0, 1, 300)[:, None]
    q = ends[0] + (ends[1] - ends[0]) * s + 0.01 * np.sin(40 * s)
    phi = learn.coordinates_of(chart, q)
    np.testing.assert_allclose(phi, chart.phi(q), rtol=0, atol=0)
    np.testing.assert_allclose(learn.joints_of(chart, phi, q[0]), q, rtol=0, atol=1e-9)


def test_what_has_no_way_back_is_named() -> None:
    chart = wide().chart
    centre = chart.problem.domain.centre
    with pytest.raises(DomainError, match="row 1 of 2 lies outside the domain"):
        learn.coordinates_of(chart, [centre, centre + 9.0])
    phi = chart.phi(np.array([centre, centre]))
    phi[1, 0] += 50.0
    with pytest.raises(InverseError, match="row 1 of 2 has no solution near the previous one: LOST"):
        learn.joints_of(chart, phi, centre)
    with pytest.raises(ShapeError):
        learn.coordinates_of(chart, np.zeros((4, 9)))
    with pytest.raises(InvalidValueError, match="actions of env"):
        learn.PhiActions(Arm(ring()), chart, 0.1)
    with pytest.raises(InvalidValueError, match="step is"):
        learn.PhiActions(Arm(chart), chart, -1.0)


def test_steps_of_the_page_bring_episodes_through_the_pipelines_of_lerobot() -> None:
    """Batches of a data set to (x, xi), and actions one by one back, with other entries untouched."""
    pytest.importorskip("lerobot", reason="lerobot is no dependency")
    import torch  # type: ignore[import-not-found]
    from lerobot.processor.converters import (  # type: ignore[import-not-found]
        policy_action_to_transition,
        transition_to_policy_action,
    )

    chart = oc.charts.load("panda-position")
    names = {"chart": chart, "np": np, "coordinates_of": learn.coordinates_of}
    exec(blocks("python", "how-to/learning.md")[-1], names)
    t = np.linspace(0, 2, 50)[:, None]
    episode = torch.as_tensor(chart.problem.domain.centre + 0.2 * np.sin(t + np.arange(7)) * [1, 1, 1, 1, 1, 1, 0])
    found = names["before"]({"action": episode, "observation.state": episode})
    np.testing.assert_array_equal(found["observation.state"], episode)
    np.testing.assert_array_equal(found["action"], chart.phi(np.asarray(episode)))
    back = names["ToJoints"]()
    after = names["PolicyProcessorPipeline"]([back], "back", policy_action_to_transition, transition_to_policy_action)
    back.start(np.asarray(episode[0]))
    np.testing.assert_allclose([after(row).numpy() for row in found["action"]], episode, rtol=0, atol=1e-9)
    assert after(found["action"].float()).dtype == torch.float32
