"""The peer of benchmarks/operational_space.py."""

from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from textbook_law import TextbookLaw

import orthocas as oc
from orthocas.codegen import CompiledLibrary, compile_shared
from orthocas.control import PDPlus


@pytest.mark.slow
@needs_c
def test_textbook_law_gives_the_task_the_commanded_acceleration_whatever_the_posture(tmp_path: Path) -> None:
    problem = oc.problems.get("planar_3r_xy")
    chart = oc.fit(problem, oc.Polynomial(2), samples=300).chart
    generated = oc.generate_c(chart, tmp_path, PDPlus(chart, 50.0), "law")
    law = TextbookLaw(CompiledLibrary(compile_shared(generated, tmp_path), "law", 3), 2, omega=5.0, zeta=0.7)
    rng = np.random.default_rng(4)
    q = problem.domain.centre + rng.uniform(-0.2, 0.2, 3)
    dq, task, posture = rng.normal(size=3), rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    ddq = problem.robot.forward_dynamics(q, dq, law.command(q, dq, task, posture))
    h = 1e-4  # the motion q + t dq + t^2/2 ddq, by central differences
    before, now, after = (chart.x(q + t * dq + t**2 / 2 * ddq) for t in (-h, 0.0, h))
    wanted = task[2] + 7.0 * (task[1] - (after - before) / (2 * h)) + 25.0 * (task[0] - now)
    np.testing.assert_allclose((after - 2 * now + before) / h**2, wanted, rtol=1e-5, atol=1e-5)
