"""Charts beside the solvers and planners of others; what is not installed here is skipped."""

from argparse import Namespace

import numpy as np
import peer_arms
import peer_methods
import pytest
import redundancy_peers


@pytest.mark.slow
@pytest.mark.parametrize("task", redundancy_peers.TASKS)
def test_charts_close_circles_and_come_back_where_the_pseudo_inverse_drifts(task: str) -> None:
    arm = peer_arms.Arm("iiwa", task)
    found = {}
    for name, build in peer_methods.methods(arm):
        if name in ("chart", "stereographic SEW", "pseudo-inverse"):
            asked, method = Namespace(circles=2, lines=1, targets=3, peer_targets=3), build()
            found[name] = [float(cell.split()[0]) for cell in redundancy_peers.motion(name, method, arm, asked)[1:]]
            assert redundancy_peers.shares(method, arm, asked)[0] == "100.0 %"
    drift, error, reached, left = (
        dict(zip(found, column, strict=True)) for column in list(zip(*found.values(), strict=True))[:4]
    )
    assert drift.pop("pseudo-inverse") > 1e-2
    assert reached.pop("pseudo-inverse") == 0
    del error["pseudo-inverse"], left["pseudo-inverse"]
    assert max(drift.values()) < 1e-9
    assert max(error.values()) < 1e-6
    assert max(left.values()) < 1e-9
    assert set(reached.values()) == {100.0}


def test_the_model_of_the_peers_is_that_of_the_chart() -> None:
    arm = peer_arms.Arm("panda", "pose")
    q = arm.home + 0.1 * np.sin(np.arange(7))
    target = arm.target(q)
    assert np.abs(arm.error(q, target.placement)).max() < 1e-12
    moved = arm.robot.tip_position(q)
    np.testing.assert_allclose(target.placement.translation, moved, atol=1e-12)
    np.testing.assert_allclose(arm.jacobian(q)[:3], arm.robot.tip_jacobian(q)[:3], atol=1e-12)


@pytest.mark.slow
def test_plans_in_xi_keep_the_tool_in_place() -> None:
    pytest.importorskip("ompl")
    import planning

    rows = planning.main(quick=True)
    assert [row.split("|")[1].strip() for row in rows] == list(planning.SPACES)
    assert float(rows[0].split("|")[6]) < 1e-9


@pytest.mark.slow
def test_regions_of_xi_are_free() -> None:
    pytest.importorskip("pydrake")
    import convex_regions

    (row,) = convex_regions.main(quick=True)
    assert float(row.split("|")[4].split()[0]) > 98
