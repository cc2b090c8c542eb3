"""Decoupled laws on wide charts with A = M, and what a load at the tip changes about them."""

from pathlib import Path

import numpy as np
import pytest
from programs import needs_c
from public_objects import BENT
from test_payload import random_payload

import orthocas as oc
from orthocas.codegen import check_c
from orthocas.control import PDPlus
from orthocas.tools.checks import Array


def lean(robot: oc.Robot, gradient: Array, rows: Array, q: Array) -> float:
    """Largest cosine between a gradient (n,) and rows (k, n) in the metric M^-1."""
    W = np.linalg.inv(robot.mass_matrix(q))
    lengths = np.sqrt(np.diag(rows @ W @ rows.T) * (gradient @ W @ gradient))
    return float(np.abs(rows @ W @ gradient / lengths).max())


def test_no_load_at_the_tip_makes_a_gradient_that_is_orthogonal_to_a_pose_lean() -> None:
    """docs/explanation/derivations_control.md#loads: M z is orthogonal for every load, but not for positions alone."""
    rng, robot = np.random.default_rng(5), oc.problems.get("iiwa").robot
    for q in rng.uniform(-1.5, 1.5, (10, 7)):
        J, heavy = robot.tip_jacobian(q), robot.with_payload(random_payload(rng))
        z = np.linalg.svd(J)[2][-1]
        gradient = robot.mass_matrix(q) @ z
        assert lean(robot, gradient, J, q) < 1e-9  # rounding, times the condition number of M
        assert lean(heavy, gradient, J, q) < 1e-9
        tool = robot.with_tool([0.1, -0.2, 0.3, 0.4, 0.5, 0.6])
        assert lean(heavy, gradient, tool.tip_jacobian(q), q) < 1e-9
        across = robot.mass_matrix(q) @ np.linalg.svd(J[:3])[2][-1]
        assert lean(robot, across, J[:3], q) < 1e-9
        assert lean(heavy, across, J[:3], q) > 1e-4


@pytest.mark.nightly
@needs_c
def test_decoupled_law_in_c_takes_a_wide_network_with_the_inertia_metric(tmp_path: Path) -> None:
    """Without a warning, which would be an error here."""
    known = oc.problems.get("planar_3r_xy")
    family = oc.MLP((8,), raw=True)
    chart = oc.fit_wide(known.robot, known.task, BENT, metric="inertia", parametrisation=family, samples=600).chart
    law = PDPlus.on_chart(chart, coupling="decoupled")
    generated = oc.generate_c(chart, tmp_path, law, "arm")
    assert check_c(generated, chart, law, states=200).differences["control"] < 1e-10
