"""The supervised law keeps links from contacts where it has their capsules."""

import re
from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from supervised import TICK, Arm, at_rest

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus, Safety

pytestmark = needs_c
MARGIN = 0.02  # [m]


@pytest.mark.slow
def test_the_supervised_law_keeps_links_apart(planar_arm: oc.Chart, tmp_path: Path) -> None:
    """The tip is asked into a ball: the arm comes to rest before it, not far, and goes back when asked."""
    domain, robot = planar_arm.problem.domain, planar_arm.problem.robot
    start = domain.centre
    goal = start + 0.5 * domain.half_width
    ball = oc.obstacles.Sphere([*planar_arm.phi(goal)[:2], 0.0], 0.05)
    around = robot.with_rods(0.02).collisions.with_scene(oc.Scene({"ball": ball}))
    assert around.distance(goal).distance < 0
    assert around.distance(start).distance > 0.1

    law = PDPlus.on_chart(planar_arm)
    generated = oc.generate_c(planar_arm, tmp_path, law, "arm", capsules=oc.fit_capsules(around))
    supervisor = Supervisor(
        CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3), law, Safety.of(law, offset_rate=2.0)
    )
    arm = Arm(robot, start)
    supervisor.start(start)
    reference, target, path, statuses = at_rest(planar_arm, start), planar_arm.phi(goal), [], []
    arm_speed = arm.dq
    for k in range(9000):
        # Asked for the law again at rest before the ball, with a target that is free.
        if k == 5000:
            supervisor.resume()
            reference, target = at_rest(planar_arm, arm.q), planar_arm.phi(start)
        # A stream ends before the ball; a reference goes on towards it.
        if k < 3000 or k >= 5000:
            supervisor.stream(reference, target, 6.0, TICK)
        else:
            reference[:3], reference[3:] = target, 0.0
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command)
        arm_speed = arm.dq if k < 5000 else arm_speed
        path.append(arm.q)
        statuses.append(status)
    gaps = around.distance(np.array(path)).distance
    # It waits near the margin, under the law or its fallback.
    assert statuses[4999] in (ControlStatus.OK, ControlStatus.NEAR_BOUNDARY, ControlStatus.CAUGHT)
    assert gaps[4999] < 0.06
    assert np.abs(arm_speed).max() < 0.01
    assert gaps.min() > MARGIN - 1e-3
    assert statuses[-1] is ControlStatus.OK
    assert np.abs(path[-1] - start).max() < 0.02


def test_the_stack_of_a_tick_counts_the_distance_of_links(planar_arm: oc.Chart, tmp_path: Path) -> None:
    """By as many bytes as the header of the distance says."""
    law = PDPlus.on_chart(planar_arm)
    capsules = oc.fit_capsules(planar_arm.problem.robot.with_rods(0.02).collisions)
    without = oc.generate_c(planar_arm, tmp_path / "without", law, "arm").stack_bytes
    generated = oc.generate_c(planar_arm, tmp_path / "with", law, "arm", capsules=capsules)
    header = (generated.folder / "arm_distance.h").read_text()
    said = re.search(r"at most (\d+) bytes of stack", header)
    assert said is not None
    assert generated.stack_bytes == without + int(said[1])
