"""Branches of the joint range, and charts that are regular on a whole one."""

import json
import re
import warnings
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from chart_files import header_of, resealed
from conftest import robot_data
from numpy.typing import NDArray
from programs import Run, needs_c

import orthocas as oc
from orthocas import control
from orthocas.bases.family import JointSpace, LinearFamily, component_gradients
from orthocas.bases.given import sew_angle
from orthocas.charts.certificate import PROVED
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.regular_part import RegularPart
from orthocas.cli.fit import _format_fit
from orthocas.cli.output import format_report_rows
from orthocas.codegen import check_c
from orthocas.errors import (
    BranchWarning,
    ChartFileError,
    DomainError,
    Interrupted,
    InvalidValueError,
    NotSavableWarning,
    ShapeError,
    UnknownNameError,
)
from orthocas.fitting import wide as wide_fits
from orthocas.fitting.basis_objective import BasisObjective, build_gradients
from orthocas.fitting.combined import Resampled
from orthocas.fitting.like import Like, QuadraticTerm
from orthocas.fitting.network_objective import ArrayObjective
from orthocas.fitting.sample_loss import Loss, build_sample_loss
from orthocas.fitting.terms import Sizes
from orthocas.fitting.wide import WideFit, _build_problems, _describe_left_out, _fit_most
from orthocas.fitting.wide_search import Search, WideSettings, sample_frames, search_families
from orthocas.solvers.protocol import Status
from orthocas.tasks.branches import Branch, Branches, _Arm
from orthocas.tasks.domains import StopKind
from orthocas.tasks.regular_box import find_joint_range, regular_box
from orthocas.tasks.samples import sample_boundary_weighted, sample_uniform
from orthocas.tools.display import number_list, percent
from orthocas.tools.progress import Progress

Numbers = NDArray[np.float64]
BENT = oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2])  # of the planar arm, which has no branches


@cache
def iiwa() -> oc.Robot:
    return oc.problems.get("iiwa").robot


@cache
def panda() -> oc.Robot:
    return oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")


@cache
def branches() -> Branches:
    return oc.branches(iiwa())


def home_branch() -> Branch:
    return branches()["shoulder+ elbow- wrist+"]


@cache
def wide_pose() -> WideFit:
    return oc.fit_wide(iiwa(), oc.Task.pose(iiwa()), home_branch(), parametrisation=oc.Polynomial(4, ["A1", "A7"]))


@cache
def without_the_roll() -> oc.Chart:
    """Coordinates that do not know the turn of the tool."""
    family = oc.Polynomial(4, ["A1"], without=["A7"])
    return oc.fit_wide(iiwa(), oc.Task.pose(iiwa()), home_branch(), parametrisation=family).chart


@cache
def narrower() -> oc.Chart:
    """The same coordinates where their volume is above 0.4, which is not everywhere."""
    chart = wide_pose().chart
    domain = RegularPart(chart.problem.domain, wide_pose().chart.coordinates, 0.4)  # type: ignore[arg-type]
    return oc.Chart(oc.Problem(iiwa(), chart.problem.task, domain=domain), chart.coordinates)


@cache
def wide_plane() -> WideFit:
    known = oc.problems.get("planar_3r_xy")
    return oc.fit_wide(known.robot, known.task, BENT)


def geometric_jacobians(robot: oc.Robot, q: Numbers) -> Numbers:
    """Velocity and angular velocity of the tip per joint velocity, (N, 6, n), by differences of its pose."""
    columns = []
    for e in 1e-6 * np.eye(robot.n):
        moved = (robot.tip_position(q + e) - robot.tip_position(q - e)) / 2e-6
        turned = (
            (robot.tip_rotation(q + e) - robot.tip_rotation(q - e)) / 2e-6 @ robot.tip_rotation(q).transpose(0, 2, 1)
        )
        columns.append(np.hstack([moved, turned[:, [2, 0, 1], [1, 2, 0]]]))
    return np.stack(columns, axis=2)


def self_motions(robot: oc.Robot, q: Numbers) -> Numbers:
    """Generalised cross products of the rows, (N, n): a smooth field, by cofactors of NumPy's determinants."""
    J = geometric_jacobians(robot, q)
    signs = (-1.0) ** np.arange(robot.n)
    return np.stack([signs[k] * np.linalg.det(np.delete(J, k, axis=2)) for k in range(robot.n)], axis=1)


@pytest.mark.slow
def test_branches_are_drawn_each_in_its_posture() -> None:
    found = branches()
    figure = found.plot()
    assert [panel.get_title().split("\n")[0] for panel in figure.axes] == [item.name for item in found]
    for panel, item in zip(figure.axes, found, strict=True):
        drawn = np.column_stack(panel.lines[0].get_data_3d())  # type: ignore[attr-defined]
        np.testing.assert_allclose(drawn[-1], found.robot.tip_position(item.posture), atol=1e-12)


@pytest.mark.slow
def test_branches_of_arms_are_cut_where_geometry_says() -> None:
    found = branches()
    assert [(cut.joint_name, cut.value, cut.singular, cut.exact) for cut in found.cuts] == [
        ("A2", 0.0, False, True),
        ("A4", 0.0, True, True),
        ("A6", 0.0, False, True),
    ]
    assert len(found) == 8
    np.testing.assert_allclose([item.share for item in found], 1 / 8, atol=5e-3)
    offset = oc.branches(panda())  # axes of its elbow do not meet
    known = [("panda_joint2", False, True), ("panda_joint4", True, False), ("panda_joint6", False, False)]
    assert [(cut.joint_name, cut.singular, cut.exact) for cut in offset.cuts] == known
    stretched = -2 * np.arctan2(0.0825, 0.384) + 0.0  # both links, seen from the offset elbow
    assert abs(offset.cuts[1].value - stretched) < 0.05


@pytest.mark.slow
def test_parts_with_hardly_a_clear_position_belong_to_their_neighbour_if_it_is_beside_them() -> None:
    """The folded elbow of the xarm7 is nearly singular up to 0.5 rad beyond the cut, where joint 4 stands still."""
    xarm = oc.Robot.from_urdf(robot_data("xarm_description/urdf/xarm7.urdf"), "link_eef")
    found = oc.branches(xarm)
    assert [(cut.joint_name, cut.singular) for cut in found.cuts] == [
        ("joint2", False),
        ("joint4", True),
        ("joint6", False),
    ]
    assert len(found) == 8
    assert sum(item.share for item in found) == pytest.approx(1.0)
    folded = np.array([2.0, 1.6, 2.4, 3.2, 0.0, 1.1, -1.2])
    item = found.of(folded)
    assert item is not None
    assert item.name == "shoulder+ elbow+ wrist+"
    assert item.box.contains(folded + np.eye(7)[3] * 0.5)


@pytest.mark.slow
def test_branches_of_a_task_are_where_it_is_clear() -> None:
    """Beyond its stretched elbow, the panda reaches clear positions of the hand, but no clear poses."""
    of_pose, of_position = oc.branches(panda()), oc.branches(panda(), oc.Task.position(panda()))
    assert of_position.cuts == of_pose.cuts
    assert {item.name for item in of_pose} == {item.name for item in of_position if "elbow-" in item.name}
    beyond = np.array([item.posture for item in of_position if "elbow+" in item.name])
    assert len(beyond) == 4
    J = geometric_jacobians(panda(), beyond)
    assert np.linalg.svd(J[:, :3])[1][:, -1].min() > 0.05  # [m/rad]
    assert np.linalg.svd(J)[1][:, -1].max() < 0.05


@pytest.mark.slow
def test_self_motions_do_not_cross_cuts() -> None:
    q = sample_uniform(oc.Box(np.zeros(7), 2.0), 200, 3)
    for cut in branches().cuts:
        on = q.copy()
        on[:, cut.joint] = cut.value
        z = self_motions(iiwa(), on)
        clear = np.linalg.norm(self_motions(iiwa(), q), axis=1).mean()
        moved = np.abs(z[:, cut.joint]) if not cut.singular else np.linalg.norm(z, axis=1)
        assert moved.max() < 1e-8 * clear


@pytest.mark.slow
def test_mirrored_positions_have_the_same_pose() -> None:
    found = branches()
    assert found.mirrors == (0, 1, 2)
    q = found["shoulder+ elbow- wrist+"].posture
    for k, word in enumerate(("shoulder-", "elbow+", "wrist-")):
        other = found.mirrored(q, k)
        np.testing.assert_allclose(iiwa().tip_position(other), iiwa().tip_position(q), atol=1e-12)
        np.testing.assert_allclose(iiwa().tip_rotation(other), iiwa().tip_rotation(q), atol=1e-12)
        assert np.sign(other[2 * k + 1]) == -np.sign(q[2 * k + 1])
        branch = found.of(other)
        assert branch is None or word in branch.name  # a neighbour may lie beyond its limits


@pytest.mark.slow
def test_branches_are_found_by_name_and_position() -> None:
    found = branches()
    assert found.of(found[3].posture) is found[3]
    assert found.of(np.full(7, 3.0)) is None
    with pytest.raises(UnknownNameError, match="unknown branch 'up'"):
        found["up"]


@pytest.mark.slow
def test_one_polynomial_is_regular_on_a_whole_branch() -> None:
    fit = wide_pose()
    assert fit.regular_share > 0.995
    chart, domain = fit.chart, fit.chart.problem.domain
    assert isinstance(domain, RegularPart)
    assert domain.half_width[1] > 0.99 * iiwa().upper[1] / 2  # from the cut to the limit
    q = sample_boundary_weighted(domain, 3000, 8)
    slopes = np.einsum("sn,sn->s", chart.coordinates.jacobian(q)[:, 0], self_motions(iiwa(), q))
    assert np.sign(slopes).min() == np.sign(slopes).max()
    assert fit.worst is not None
    assert fit.worst.least > 0  # by descents, too


@pytest.mark.slow
def test_volumes_are_those_of_orthonormal_rows() -> None:
    domain = narrower().problem.domain
    assert isinstance(domain, RegularPart)
    q = sample_uniform(oc.Box(domain.centre, domain.half_width), 500, 4)
    z = self_motions(iiwa(), q)
    gradients = wide_pose().chart.coordinates.jacobian(q)[:, 0]
    cosines = np.einsum("sn,sn->s", gradients, z) / np.linalg.norm(gradients, axis=1) / np.linalg.norm(z, axis=1)
    found = domain.volumes(q)
    np.testing.assert_allclose(found, np.sign(cosines @ found) * cosines, atol=1e-6)
    inside = domain.is_clear(q)
    clear = domain.singular_values(q) > domain.least_singular_value
    np.testing.assert_array_equal(inside, clear & (found > domain.least_volume))
    assert 0 < inside.sum() < clear.sum() < 500


@pytest.mark.slow
def test_charts_of_a_branch_are_saved_and_found_again(tmp_path: Path) -> None:
    chart = wide_pose().chart
    chart.save(tmp_path / "wide.orthocas")
    loaded = oc.load(tmp_path / "wide.orthocas")
    q = sample_uniform(chart.problem.domain, 300, 5)
    np.testing.assert_array_equal(loaded.phi(q), chart.phi(q))
    np.testing.assert_array_equal(loaded.problem.domain.contains(q * 1.2), chart.problem.domain.contains(q * 1.2))
    found = chart.solve(chart.phi(q))
    assert found.found.mean() > 0.99
    back = chart.phi(found.q[found.found])
    np.testing.assert_allclose(back[:, :3], chart.phi(q)[found.found][:, :3], atol=1e-8)


@pytest.mark.slow
def test_the_nearest_xi_is_the_end_of_its_range() -> None:
    chart = wide_pose().chart
    domain = chart.problem.domain
    there, wishes = sample_uniform(domain, 40, 7), sample_uniform(domain, 40, 8)
    x = chart.phi(there)[:, :6]
    found = chart.nearest_xi(wishes, x)
    wanted, got = chart.xi(wishes)[:, 0], chart.xi(found.q)[:, 0]
    assert 10 < found.found.sum() < 30  # some are possible as they are, others are not
    np.testing.assert_allclose(got[found.found], wanted[found.found], atol=1e-7)
    compared = 0
    for k, status in enumerate(found.statuses):
        if status is not oc.InverseStatus.NEAREST:
            continue
        assert domain.contains(found.q[k])
        np.testing.assert_allclose(iiwa().tip_position(found.q[k]), iiwa().tip_position(there[k]), atol=1e-8)
        (reach,) = chart.xi_range(found.q[k])
        end = np.clip(wanted[k], reach.low, reach.high)
        assert abs(got[k] - end) < 1e-4
        compared += 1
    assert compared > 3
    assert abs(chart.nearest_xi(there[0]).q[0] - there[0]).max() < 1e-9  # its own x and xi
    with pytest.raises(ShapeError, match="x"):
        chart.nearest_xi(there, x[:, :5])


@pytest.mark.slow
def test_self_motions_end_where_coordinates_do() -> None:
    chart = narrower()
    stops = set()
    for q in sample_uniform(chart.problem.domain, 40, 2):
        (reach,) = chart.xi_range(q)
        stops |= {reach.low_stop.kind, reach.high_stop.kind}
        assert chart.problem.domain.contains(q)
    assert StopKind.FOLD in stops  # v(q) is at its bound of 0.4


@pytest.mark.slow
def test_a_hand_that_rolls_moves_no_other_joint_and_closes_its_turns() -> None:
    """The poses are those of the arm with its last joint turned, by the kinematics alone."""
    chart, roll = without_the_roll(), np.eye(7)[6]
    q = np.array(chart.problem.domain.centre)
    tracker, xi = chart.tracker(q), chart.xi(q)
    for angle in np.linspace(0.0, np.pi / 2, 60):
        reached = tracker.step(np.concatenate([chart.x(q + angle * roll), xi]))
        assert tracker.status.name == "OK"
        np.testing.assert_allclose(reached, q + angle * roll, atol=1e-9)
    q = sample_uniform(chart.problem.domain, 200, 4)
    np.testing.assert_allclose(chart.xi(q + 2 * np.pi * roll), chart.xi(q), atol=1e-12)
    np.testing.assert_array_equal(chart.coordinates.jacobian(q)[:, 0, 6], 0.0)


@pytest.mark.nightly
def test_coordinates_without_the_roll_are_tried_first(tmp_path: Path) -> None:
    fit = oc.fit_wide(iiwa(), oc.Task.pose(iiwa()), home_branch(), samples=10_000)
    assert fit.chart.coordinates.label == "mlp:24x24x24:raw:isru:without=A7"
    assert fit.regular_share > 0.998
    fit.chart.save(tmp_path / "wide.orthocas")
    q = sample_uniform(fit.chart.problem.domain, 50, 1)
    np.testing.assert_array_equal(oc.load(tmp_path / "wide.orthocas").xi(q), fit.chart.xi(q))
    bent = oc.fit_wide(iiwa(), oc.Task.pose(iiwa()), home_branch(), like="A7", samples=1000).chart
    assert "without" not in bent.coordinates.label


def test_the_first_families_leave_out_the_turn_of_the_tool_and_of_a_base_that_turns_fully() -> None:
    """One coordinate is a network, a swivel a polynomial; the base of the iiwa has limits, the other one has none."""
    endless = oc.Robot.from_urdf(Path(__file__).parents[1] / "data" / "robots" / "four_endless_joints.urdf")
    for robot, metric, like, expected in (
        (iiwa(), "euclidean", None, ["mlp:24x24x24:raw:isru:without=A7"]),
        (iiwa(), "inertia", None, ["mlp:24x24x24:raw:isru:without=A7"]),
        (iiwa(), "euclidean", "swivel", ["polynomial:6:cyclic=A1:without=A7"]),
        (
            endless,
            "euclidean",
            None,
            [f"mlp:24x24x24:raw:isru:{rest}" for rest in ("without=j1,j7", "cyclic=j1:without=j7")],
        ),
    ):
        task = oc.Task.pose(robot)
        problem = oc.Problem(robot, task, metric, regular_box(robot, task))
        labels = [family.label for family in wide_fits._choose_families(problem, like)]
        assert [label for label in labels if "without" in label] == expected


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
@pytest.mark.parametrize("without", [("A7",), ("A1", "A7")])
def test_no_gradient_without_some_joints_is_nearer_to_the_self_motion_than_the_bound(
    metric: Any, without: tuple[str, ...]
) -> None:
    """The nearest one is found again by least squares, from a null vector of a Jacobian by differences.

    Self-motions leave the last link at rest, so it has no momentum: in the inertia metric its turn costs nothing.
    """
    task = oc.Task.pose(iiwa())
    problem = oc.Problem(iiwa(), task, metric, regular_box(iiwa(), task))
    points = sample_uniform(problem.domain, 2000, (0, wide_fits.RULES.bounded_tag))
    kept, leaks = [k for k, name in enumerate(iiwa().joint_names) if name not in without], []
    for q, z in zip(points, self_motions(iiwa(), points), strict=True):
        # with A = L L^T, the leak is the angle between L^-1 v and L^T z
        L = np.linalg.cholesky(iiwa().mass_matrix(q) if metric == "inertia" else np.eye(7))
        wanted = L.T @ z
        basis = np.linalg.inv(L)[:, kept]
        rest = wanted - basis @ np.linalg.lstsq(basis, wanted, rcond=None)[0]
        leaks.append(np.arcsin(np.linalg.norm(rest) / np.linalg.norm(wanted)))
    found = wide_fits._bound_leak(problem, without, 0)
    assert found == pytest.approx(np.degrees(np.sqrt(np.mean(np.square(leaks)))), rel=1e-6, abs=1e-6)
    assert found < 1e-6 if (metric, len(without)) == ("inertia", 1) else found > 5
    assert wide_fits._bound_leak(problem, (), 0) == 0


def planar_values(robot: oc.Robot, q: Numbers) -> Numbers:
    """Smaller singular values of the tip's velocity of a planar arm with three links of 1 m, by its closed form."""
    angles = np.cumsum(q, axis=1)
    ends = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    return np.asarray(np.linalg.svd(np.cumsum(ends[:, :, ::-1], axis=2)[:, :, ::-1], compute_uv=False)[:, -1])


class Shares:
    """Fits of given regular shares, one after another, or errors."""

    def __init__(self, *shares: float | DomainError) -> None:
        self.shares = iter(shares)

    def __call__(self, problem: oc.Problem) -> Any:
        share = next(self.shares)
        if isinstance(share, DomainError):
            raise share
        return SimpleNamespace(regular_share=share, status=None)


@pytest.mark.slow
@pytest.mark.parametrize(("centre", "small"), [([0.0, 0.0, 0.0], True), ([0.0, 1.3, 1.3], False)])
def test_the_printed_share_is_of_the_branch(centre: list[float], small: bool) -> None:
    """A straight arm in the middle: the chart says how little of the box it has, and why."""
    robot = oc.Robot.planar([1.0, 1.0, 1.0], [3.0, 3.0, 3.0])
    box, task = oc.Box(centre, [3.0, 2.0, 2.0] if small else [3.0, 1.2, 1.2]), oc.Task.position(robot, "xy")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fit = oc.fit_wide(robot, task, box, parametrisation=oc.Polynomial(3), samples=2000)
    rng = np.random.default_rng(12)
    whole, q = (sample_uniform(oc.Box(np.zeros(3), np.pi), 20_000, 1), rng.uniform(-1, 1, (40_000, 3)))
    q = box.centre + box.half_width * q
    size = np.sqrt((geometric_jacobians(robot, whole)[:, :2] ** 2).sum(axis=2).mean())  # of a row over the joint range
    q = q[planar_values(robot, q) / size > 0.1]
    assert fit.regular_share == pytest.approx(np.mean(fit.chart.problem.domain.contains(q)), abs=0.01)
    assert fit.facts()["regular"].startswith(percent(fit.regular_share, 2))
    assert [entry.category for entry in told] == [BranchWarning] * small
    if small:
        assert fit.regular_share < 0.9
        assert "its centre is not clear, and coordinates have one direction on a part" in str(told[0].message)
        np.testing.assert_array_equal(fit.chart.domain.half_width, box.half_width)
        share = float(re.search(r"all but ([\d.]+)% of the clear", fit.left_out)[1]) / 100  # type: ignore[index]
        assert share == pytest.approx(fit.regular_share, abs=1e-3)
        # the box whose middle is clear, which takes the place of the branch where that keeps more
        whole, smaller = _build_problems(robot, task, "euclidean", Branch("box", box, box.centre, 1.0, 1.0), 0.1)
        np.testing.assert_array_equal(smaller.domain.centre, whole.domain.home)
        assert (smaller.domain.half_width < box.half_width).any()
        reason = _describe_left_out(smaller, Branch("box", box, box.centre, 1.0, 1.0), q, 0.6)
        inside = np.abs(q - smaller.domain.centre) <= smaller.domain.half_width
        assert reason.startswith(
            f"all but {percent(float(inside.all(axis=1).mean()))} of the clear positions: its centre"
        )
        assert f"a smaller box, around q = ({number_list(smaller.domain.centre)})" in reason
        for shares, kept in (((0.95,), 0.95), ((0.5, 0.6), 0.6), ((0.6, 0.5), 0.6), ((DomainError("folds"), 0.4), 0.4)):
            assert _fit_most((whole, smaller), Shares(*shares)).regular_share == kept


@pytest.mark.nightly
def test_branches_say_which_of_them_the_usual_clearance_cannot_serve() -> None:
    robot = oc.Robot.from_urdf(
        robot_data("tiago_description/robots/tiago_dual.urdf"), "arm_left_tool_link", {"torso_lift_joint": 0.1}
    )
    found, task = oc.branches(robot), oc.Task.pose(robot)
    small = [item for item in found if item.clearance < 0.1]
    assert {item.name for item in small} == {"elbow- wrist-", "elbow- wrist+"}
    assert sum(item.share for item in small) == pytest.approx(0.039, abs=2e-3)
    assert all(f"{item.name} ({item.clearance:.2g} or less)" in found.facts()["too singular"] for item in small)
    # what the error offers is what the table says
    most = rf"clearance can be {small[0].clearance:g} at most"
    with pytest.raises(DomainError, match=f"no position with a relative singular value of 0.15, .*: {most}"):
        oc.fit_wide(robot, task, small[0])
    # its middle is singular, so its home is elsewhere, and the domain keeps nearly all of it
    fit = oc.fit_wide(
        robot, task, small[0], clearance=small[0].clearance, parametrisation=oc.Polynomial(2), samples=2000
    )
    domain = fit.chart.domain
    assert np.abs(domain.home - domain.centre).max() > 0.1
    assert domain.contains(domain.home)
    assert not domain.contains(domain.centre)
    np.testing.assert_array_equal(domain.half_width[1:-1], small[0].box.half_width[1:-1])
    assert fit.left_out == ""
    assert fit.regular_share > 0.9
    assert "too singular" not in branches().facts()


@pytest.mark.slow
def test_several_coordinates_are_regular_together() -> None:
    cubic = oc.Polynomial(3, ["A1", "A7"])
    fit = oc.fit_wide(iiwa(), oc.Task.position(iiwa()), home_branch(), parametrisation=cubic, samples=2500)
    assert fit.chart.r == 4
    assert fit.regular_share > 0.97
    q = sample_uniform(fit.chart.problem.domain, 2000, 6)
    J = np.concatenate([geometric_jacobians(iiwa(), q)[:, :3], fit.chart.coordinates.jacobian(q)], axis=1)
    signs = np.sign(np.linalg.det(J))
    assert signs.min() == signs.max()


@pytest.mark.slow
def test_coordinates_in_the_metric_of_the_inertia_are_regular_in_the_domain() -> None:
    """Orthogonal in M, four coordinates of the arm are nearly parallel otherwise, and the domain would be empty."""
    task, cubic = oc.Task.position(iiwa()), oc.Polynomial(3, ["A1"])
    fit = oc.fit_wide(iiwa(), task, home_branch(), "inertia", parametrisation=cubic, samples=1500)
    assert fit.regular_share > 0.99
    q = sample_uniform(fit.chart.problem.domain, 2000, 6)
    J = np.concatenate([geometric_jacobians(iiwa(), q)[:, :3], fit.chart.coordinates.jacobian(q)], axis=1)
    signs = np.sign(np.linalg.det(J))
    assert signs.min() == signs.max()


@pytest.mark.slow
def test_base_and_tool_count_like_other_joints_where_linear_terms_are_poor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the families that leave out joints, which are enough here."""
    every = wide_fits._choose_families
    others = lambda *words: tuple(family for family in every(*words) if ":without" not in family.label)  # noqa: E731
    monkeypatch.setattr(wide_fits, "_choose_families", others)
    robot = oc.Robot.from_urdf(
        robot_data("talos_data/robots/talos_reduced.urdf"),
        "arm_left_7_link",
        {"torso_1_joint": 0.0, "torso_2_joint": 0.0},
    )
    reports: list[Progress] = []
    fit = oc.fit_wide(robot, oc.Task.pose(robot), samples=3000, monitor=reports.append)
    assert fit.chart.coordinates.parametrisation.label == oc.Polynomial(5).label
    stages = {name: [each.fraction for each in reports if each.stage == name] for name in (r.stage for r in reports)}
    assert list(stages)[:2] == ["whole branch", "whole branch, all joints"]
    assert all(fractions == sorted(fractions) for fractions in stages.values())
    assert fit.regular_share > 0.999
    q = sample_uniform(fit.chart.problem.domain, 2000, 6)
    slopes = np.einsum("sn,sn->s", fit.chart.coordinates.jacobian(q)[:, 0], self_motions(robot, q))
    assert np.sign(slopes).min() == np.sign(slopes).max()
    turned = q.copy()
    turned[:, 0] = q[::-1, 0]  # unlike linear terms
    there, here = (fit.chart.coordinates.jacobian(points)[:, 0, 0] for points in (turned, q))
    assert np.abs(there - here).max() > 0.01


@pytest.mark.slow
def test_a_tool_that_turns_alone_is_on_one_side_of_singular_positions() -> None:
    robot = oc.Robot.from_urdf(robot_data("z1_description/urdf/z1.urdf"), "link06")
    with pytest.warns(BranchWarning, match="leaves out all but .*: singular positions divide it"):
        fit = oc.fit_wide(robot, oc.Task.named(robot, "position+axis:x"), parametrisation=oc.Polynomial(3))
    domain = fit.chart.problem.domain
    whole = oc.Box(domain.centre, domain.half_width)
    problem = oc.Problem(robot, fit.chart.problem.task, domain=whole, least_singular_value=0.1)
    searches = [Search(problem, oc.Polynomial(1), WideSettings(2, seed)) for seed in range(20)]
    with pytest.raises(
        InvalidValueError, match="samples is 2, expected more samples: all lie beyond singular positions"
    ):
        [search.sample(2, 0) for search in searches]
    q = np.vstack([domain.centre, sample_uniform(whole, 4000, 3)])
    moved = geometric_jacobians(robot, q)
    axis = robot.tip_rotation(q)[:, :, 0]
    turned = np.cross(moved[:, 3:].transpose(0, 2, 1), axis[:, None]).transpose(0, 2, 1)  # of the axis, (N, 3, n)
    assert np.abs(turned[:, :, 5]).max() < 1e-8  # the last joint moves nothing
    across = robot.tip_rotation(q)[:, :, 1:].transpose(0, 2, 1) @ turned
    sides = np.linalg.det(np.concatenate([moved[:, :3], across], axis=1)[:, :, :5])
    sides = np.sign(sides) == np.sign(sides[0])
    inside = domain.contains(q)
    assert not inside[~sides].any()
    clear = domain.singular_values(q) > domain.least_singular_value  # type: ignore[attr-defined]
    assert clear[~sides].sum() > 500
    np.testing.assert_array_equal(inside[sides], clear[sides])
    assert fit.regular_share == pytest.approx(clear[sides].sum() / clear.sum(), abs=0.03)  # of both sides
    assert "singular positions divide it" in fit.left_out


@pytest.mark.slow
@pytest.mark.parametrize("like", ["swivel", "A3"])
def test_coordinates_are_near_what_is_asked(like: str) -> None:
    """What the fit reports of swivel and joint, beside differences along self-motions; and a fit without a wish."""
    task, polynomial = oc.Task.pose(iiwa()), oc.Polynomial(4, ["A1", "A7"])
    fit = oc.fit_wide(iiwa(), task, home_branch(), like=like, parametrisation=polynomial)
    assert fit.regular_share > 0.99
    assert fit.branch is not None
    chart = fit.chart
    value = sew_angle(iiwa(), "conventional") if like == "swivel" else lambda q: q[2]
    assert abs(float(chart.xi(fit.branch.posture)[0]) - float(value(fit.branch.posture))) < 1e-9
    assert chart.parts.named_coordinates == (f"xi1: like {like} [rad]",)
    points = sample_uniform(chart.problem.domain, 4000, 21)
    z, step = self_motions(iiwa(), points), 1e-6
    z /= np.linalg.norm(z, axis=1)[:, None]

    def values(q: Numbers) -> Numbers:
        return np.array(value.map(len(q))(q.T))[0] if like == "swivel" else q[:, 2]

    def wrapped(angles: Numbers) -> Numbers:
        return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi if like == "swivel" else angles)

    missed = wrapped(chart.xi(points)[:, 0] - values(points))
    theta = chart.xi(points)[:, 0] - missed
    moved, asked = (
        wrapped(of(points + step * z) - of(points - step * z)) for of in (lambda q: chart.xi(q)[:, 0], values)
    )
    assert fit.meaning is not None
    assert fit.meaning.rms == pytest.approx(np.sqrt(np.mean(missed**2)), rel=0.05)
    assert fit.meaning.undetermined < fit.meaning.rms
    assert fit.meaning.correlation == pytest.approx(np.corrcoef(chart.xi(points)[:, 0], theta)[0, 1], abs=0.05)
    assert fit.meaning.against == pytest.approx(np.mean(moved * asked < 0), abs=0.02)
    below = [np.mean(asked / moved < bound) for bound in (fit.meaning.slow, fit.meaning.fast)]
    assert below == [pytest.approx(0.05, abs=0.015), pytest.approx(0.95, abs=0.015)]
    assert chart.notes["error of its meaning"] == fit.meaning.rms
    assert f"{fit.meaning.rms:.2g} off (rms)" in fit.facts()["meaning"]
    other = wide_pose().chart
    there = sample_uniform(other.problem.domain, 4000, 21)
    z = self_motions(iiwa(), there)
    far = [wrapped(of(there + step * z) - of(there - step * z)) for of in (lambda q: other.xi(q)[:, 0], values)]
    rates = [np.median(np.abs(np.log(np.abs(pair[1] / pair[0])))) for pair in ((moved, asked), far)]
    assert rates[0] < 0.7 * rates[1]


@pytest.mark.slow
def test_coordinates_have_the_scale_of_the_swivel_by_default() -> None:
    """Half of the self-motions change the swivel by more than xi, half by less; quantities that turn back give none."""
    chart, posture = wide_pose().chart, home_branch().posture
    value = sew_angle(iiwa(), "conventional")
    assert abs(float(chart.xi(posture)[0]) - float(value(posture))) < 1e-9
    assert chart.parts.named_coordinates == ("xi1: like swivel [rad]",)
    q = sample_uniform(chart.problem.domain, 4000, 22)
    z, step = self_motions(iiwa(), q), 1e-7
    psi = [np.array(value.map(len(q))((q + sign * step * z).T))[0] for sign in (1, -1)]
    moved = (psi[0] - psi[1] + np.pi) % (2 * np.pi) - np.pi
    rates = moved / (chart.xi(q + step * z) - chart.xi(q - step * z))[:, 0]
    assert np.median(rates) == pytest.approx(1, abs=0.04)
    scaled = [Like.of(chart.problem, name).scale(chart.coordinates, chart.problem, posture, 0) for name in ("A1", "A3")]
    assert scaled[0] is None
    assert isinstance(scaled[1], Coordinates)
    assert float(scaled[1].xi(posture[None])[0, 0]) == pytest.approx(posture[2], abs=1e-9)


@pytest.mark.slow
def test_meanings_that_cannot_be_are_refused() -> None:
    task = oc.Task.pose(iiwa())
    with pytest.raises(InvalidValueError, match="like is quantities that self-motions cannot change independently"):
        oc.fit_wide(iiwa(), task, home_branch(), like="A4")  # the elbow bends as the hand is far
    with pytest.raises(UnknownNameError, match="unknown like 'elbow'"):
        oc.fit_wide(iiwa(), task, home_branch(), like="elbow")
    with pytest.raises(InvalidValueError, match="2 quantities, expected at most 1"):
        oc.fit_wide(iiwa(), task, home_branch(), like=["A3", "A1"])


@pytest.mark.slow
def test_several_coordinates_follow_several_quantities() -> None:
    """Gradients of the first two lean from the projected ones of a joint and a height less than without a wish."""
    robot = oc.Robot.planar([1.0] * 5, [1.0] * 5)
    task, box = oc.Task.position(robot, "xy"), oc.Box([0.3, 0.6, 0.6, 0.6, 0.6], [0.8, 0.5, 0.5, 0.5, 0.5])

    def height(q: ca.SX) -> ca.SX:
        return ca.sin(q[0]) + ca.sin(q[0] + q[1])

    fits = [
        oc.fit_wide(robot, task, box, like=like, parametrisation=oc.Polynomial(2), samples=2000)
        for like in (["q3", height], None)
    ]
    assert fits[0].regular_share > 0.99
    q = sample_uniform(box, 500, 4)
    J = np.stack([(robot.tip_position(q + e) - robot.tip_position(q - e))[:, :2] / 2e-6 for e in 1e-6 * np.eye(5)], 2)
    Z = np.linalg.svd(J)[2][:, 2:]  # of self-motions
    slopes = np.zeros((500, 2, 5))
    slopes[:, 0, 2] = 1.0
    slopes[:, 1, 0], slopes[:, 1, 1] = np.cos(q[:, 0]) + np.cos(q[:, 0] + q[:, 1]), np.cos(q[:, 0] + q[:, 1])
    wanted = np.einsum("ski,sji->skj", slopes, Z)
    off = []
    for fit in fits:
        own = np.einsum("ski,sji->skj", fit.chart.coordinates.jacobian(q)[:, :2], Z)
        lengths = np.linalg.norm(own, axis=2) * np.linalg.norm(wanted, axis=2)
        off.append(np.degrees(np.arccos(np.abs((own * wanted).sum(axis=2)) / lengths)).mean(axis=0))
    assert (off[0] < 25.0).all(), off
    assert (off[0] < off[1] / 2).all(), off
    with pytest.raises(InvalidValueError, match="like is quantities that self-motions cannot change independently"):
        oc.fit_wide(robot, task, box, like=["q3", "q3"], samples=500)
    with pytest.raises(InvalidValueError, match="like is quantities without a finite gradient in the domain"):
        oc.fit_wide(robot, task, box, like=[lambda q: ca.sqrt(q[0])], samples=500)
    with pytest.raises(InvalidValueError, match="like is 4 quantities, expected at most 3"):
        oc.fit_wide(robot, task, box, like=["q1", "q2", "q3", "q4"], samples=500)
    middle = fits[0].chart.problem.domain.centre
    np.testing.assert_allclose(fits[0].chart.xi(middle)[:2], [middle[2], float(height(ca.DM(middle)))], atol=1e-9)
    assert list(fits[0].like) == ["q3 [rad]", "height"]
    assert fits[0].chart.parts.named_coordinates == ("xi1: like q3 [rad]", "xi2: like height", "xi3")


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_the_loss_has_volumes_angles_and_lengths_and_its_slopes_are_differences(metric: Any) -> None:
    robot = oc.Robot.planar([1.0, 0.8, 0.6, 0.5], [3.0, 2.0, 2.0, 1.0])
    problem, rng = (
        oc.Problem(robot, oc.Task.position(robot, "xy"), metric, oc.Box(np.full(4, 0.7), 0.6)),
        np.random.default_rng(0),
    )
    search = Search(problem, oc.Polynomial(2), WideSettings())
    basis, C = search._basis, rng.normal(size=(2, 14))
    q = [sample_uniform(problem.domain, count, seed) for seed, count in enumerate((300, 700))]
    held = QuadraticTerm(np.diag(rng.uniform(size=14)), rng.normal(size=14), 0.3)
    search._samples = [sample_frames(problem, q[0])]
    search._start_linear()  # takes the mean of products of gradients
    factor = search._factor
    search._likeness, search._last, search._sign = [held], C.ravel(), -1.0
    search._build_in_basis("volume with the worst")
    search._samples.append(sample_frames(problem, q[1]))
    loss = search._build_in_basis("volume with the worst")
    theta = loss.variables(C.ravel())
    np.testing.assert_allclose(loss.parameters(theta), C.ravel(), atol=1e-12)
    value, slopes = loss.value_and_gradient(theta)
    parts = []
    for points in q:
        J = np.stack(
            [(robot.tip_position(points + e) - robot.tip_position(points - e))[:, :2] / 2e-6 for e in 1e-6 * np.eye(4)],
            2,
        )
        G = basis.jacobian(basis.at(points), C, len(points))
        A = (
            np.array([np.array(robot.mass_matrix(p)) for p in points])
            if metric == "inertia"
            else np.broadcast_to(np.eye(4), (len(points), 4, 4))
        )
        rows, losses = np.concatenate([J, G], axis=1), np.zeros(len(points))
        for B, bound in ((np.eye(4), 0.02), (A, 0.3)) if metric == "inertia" else ((A, 0.3),):
            gram = rows @ np.linalg.inv(B) @ rows.transpose(0, 2, 1)
            lengths = np.linalg.det(gram[:, :2, :2]) * gram[:, 2, 2] * gram[:, 3, 3]
            v = -np.sign(np.linalg.det(rows)) * np.sqrt(np.linalg.det(gram) / lengths)
            losses += np.maximum(0.0, 1 - v / bound) ** 2
        uneven = np.log(gram[:, [2, 3], [2, 3]] / np.einsum("ki,ij,kj->k", C, factor @ factor.T, C)) / 2
        losses += 0.03 * (uneven**2).sum(axis=1)
        if points is q[0]:  # the worst samples only ask for regular coordinates
            along = np.linalg.solve(gram[:, :2, :2], gram[:, :2, 2:])
            sines = np.einsum("saj,saj->sj", gram[:, :2, 2:], along) / gram[:, [2, 3], [2, 3]]
            alignment = 1.0 if metric == "inertia" else 0.3
            losses += alignment * sines.mean(axis=1) + 0.15 * gram[:, 2, 3] ** 2 / (gram[:, 2, 2] * gram[:, 3, 3])
        parts.append(losses)
    assert abs(value - np.concatenate(parts).mean() - (C[0] @ held.E @ C[0] - 2 * held.g @ C[0] + 0.3)) < 1e-6
    moved = rng.normal(size=(6, len(theta)))
    ends = [[loss.value(theta + side * 1e-6 * a) for side in (-1, 1)] for a in moved]
    np.testing.assert_allclose(np.diff(ends, axis=1)[:, 0] / 2e-6, moved @ slopes, rtol=1e-5)


@pytest.mark.parametrize("metric", ["euclidean", "inertia"])
def test_the_loss_of_networks_is_that_of_bases(metric: Any) -> None:
    """A network of tanh(e q) / e with a small e is linear in q, as a polynomial of degree 1 is."""
    robot, rng = oc.Robot.planar([1.0, 0.8, 0.6, 0.5], [3.0, 2.0, 2.0, 1.0]), np.random.default_rng(2)
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), metric, oc.Box(np.full(4, 0.7), 0.6))
    family = oc.MLP((4,), raw=True).family(JointSpace.of(problem), 2)
    samples, C, small = sample_frames(problem, sample_uniform(problem.domain, 500, 0)), rng.normal(size=(2, 4)), 1e-2
    theta = np.concatenate([small * np.eye(4).ravel(), np.zeros(4), (C / small).ravel(order="F"), np.zeros(2)])
    linear = Search(problem, oc.Polynomial(1), WideSettings())
    D = linear._basis.jacobian(linear._basis.at(samples.points[:1]), np.eye(4), 1)[0]
    weights = linear._choose_weights("volume")
    start = (C @ np.linalg.inv(D)).ravel()
    assert isinstance(linear.family, LinearFamily)
    basis = BasisObjective(linear.family, samples, weights, start, linear._draw, orientation=-1.0)
    whole = ArrayObjective(family, samples, weights, theta, linear._draw, single=True, orientation=-1.0)
    found, known = whole.value(theta), basis.value(start)
    assert abs(found - known) < 2e-3 * known
    loss = Resampled(whole, np.arange(500), 500)
    parts = list(loss.batches(100, 200, (3,)))
    assert abs(np.mean([part.value(theta) for part in parts]) - found) < 0.05 * found
    theta = family.initial(0)
    moved = rng.normal(size=(4, len(theta)))
    ends = [[loss.value(theta + side * 1e-3 * a) for side in (-1, 1)] for a in moved]
    slopes = loss.value_and_gradient(theta)[1]
    np.testing.assert_allclose(np.diff(ends, axis=1)[:, 0] / 2e-3, moved @ slopes, atol=0.01 * np.linalg.norm(slopes))


@pytest.mark.parametrize("parametrisation", [oc.Polynomial(3, ["q1"]), oc.Fourier(2)])
def test_derivatives_along_directions_are_those_of_coordinates(parametrisation: Any) -> None:
    problem, rng = oc.problems.get("planar_3r_xy"), np.random.default_rng(1)
    family = parametrisation.for_problem(problem).family(JointSpace.of(problem), 2)
    q, a, C = rng.normal(size=(1500, 3)), rng.normal(size=(1500, 3)), rng.normal(size=(2, family.width))
    basis = build_gradients(family, 3)
    known = basis.at(q)
    own = Coordinates(
        parametrisation.for_problem(problem), JointSpace.of(problem), (), C.ravel(), np.zeros(2), np.ones(2)
    )
    moved = (own.once("xi", q + 1e-6 * a) - own.once("xi", q - 1e-6 * a)) / 2e-6
    np.testing.assert_allclose(basis.differentiate_along(known, a) @ C.T, moved, atol=1e-7 * np.abs(moved).max())
    np.testing.assert_allclose(
        np.einsum("sri,si->sr", basis.jacobian(known, C, 1500), a), moved, atol=1e-7 * np.abs(moved).max()
    )


@needs_c
@pytest.mark.slow
def test_c_knows_where_coordinates_are_regular(tmp_path: Path) -> None:
    chart = wide_plane().chart
    law = control.PDPlus(chart, 50.0)
    check_c(oc.generate_c(chart, tmp_path, name="arm", controller=law), chart, law, states=400)


@pytest.mark.slow
def test_laws_stop_where_coordinates_end() -> None:
    chart = narrower()
    domain = chart.problem.domain
    assert isinstance(domain, RegularPart)
    q = sample_boundary_weighted(oc.Box(domain.centre, domain.half_width), 20_000, 3)
    clear = domain.singular_values(q) > 1.05 * domain.least_singular_value
    bad = q[clear & (domain.volumes(q) < domain.least_volume)][0]
    law, zero = control.PDPlus(chart, 50.0), np.zeros(7)
    _, status = law.function(bad, zero, chart.phi(bad), zero, zero, *law.gains.values())
    assert int(status) == control.ControlStatus.OUTSIDE_DOMAIN
    assert "volume" in domain.explain(bad)


@needs_c
@pytest.mark.nightly
@pytest.mark.usefixtures("blank_pictures")
def test_the_whole_inertia_follows_in_mujoco(run: Run, tmp_path: Path) -> None:
    wide_pose().chart.save(tmp_path / "wide.orthocas")
    branch = wide_pose().branch
    assert branch is not None
    points = [{"time": 1.0, "move": {"y": -0.2}}, {"time": 2.0, "move": {"z": 0.1, "xi1": 0.3}}]
    (tmp_path / "points.json").write_text(json.dumps({"start": branch.posture.tolist(), "points": points}))
    words = (
        "simulate",
        str(tmp_path / "wide.orthocas"),
        "--controller",
        "pd_plus",
        "--steps",
        str(tmp_path / "points.json"),
    )
    simulator = ("--rate", "1000", "--plant", "mujoco", "--supervised", "--animation", "none")
    code, out, _ = run(*words, *simulator, "--out", str(tmp_path / "run"), "--json")
    assert code == 0
    report = json.loads(out)
    assert report["outcome"] == "complete"
    largest = report["tracking_error"]
    assert max(largest[name] for name in "xyz") < 1e-4  # m, though gradients lean into the task by 40 degrees


@pytest.mark.slow
def test_command_fits_a_branch(run: Run) -> None:
    code, out, err = run("info", "iiwa", "--branches", "--json")
    assert (code, err) == (0, "")
    assert len(json.loads(out)["branches"]) == 8
    words = (
        "fit",
        "iiwa",
        "--task",
        "pose",
        "--param",
        "polynomial:3:cyclic=A1,A7",
        "--out",
        "a",
    )
    code, out, err = run(*words, "--domain", "branch:shoulder+ elbow- wrist+", "--samples", "1000", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["branch"] == "shoulder+ elbow- wrist+"
    code, out, _ = run(*words, "--domain", "branch:shoulder+ elbow- wrist+", "--samples", "1000", "--force")
    assert code == 0
    assert ": xi1: like swivel [rad]" in out
    message = "orthocas: --domain branch uses its own solver: leave out --solver\n"
    assert run(*words, "--domain", "branch", "--solver", "lbfgs")[::2] == (2, message)
    words_of_python = "Python asks for one: arm.solve(x, xi, branch=NAME)"
    message = f"orthocas: no such option: --branch; fit names the branch by --domain branch:NAME; {words_of_python}\n"
    assert run("fit", "iiwa", "--branch", "up")[::2] == (2, message)


@pytest.mark.nightly
def test_command_weighs_the_terms_of_a_wide_fit(run: Run) -> None:
    """Numbers are weights of leaks in the metric; terms by name join the weights that wide fits have of their own."""
    words = ("fit", "planar_3r_xy", "--metric", "euclidean", "--domain", "branch", "--param", "polynomial:3")
    words = (*words, "--samples", "1000", "--json")

    def weights(*more: str) -> tuple[dict[str, object], float]:
        code, out, err = run(*words, "--out", "a.orthocas", "--force", *more)
        assert (code, err) == (0, "")
        notes, leak = oc.load("a.orthocas").notes, json.loads(out)["leak_deg"]["rms"]
        return {name: value for name, value in notes.items() if name.startswith("weight")}, leak

    plain, leaning = weights(), weights("--weights", "1e-6,0")
    assert plain[0] == {}
    assert leaning[0] == {"weight of metric task": 1e-6}
    assert plain[1] < leaning[1] - 1.0
    assert weights("--weights", "length=0.1")[0] == {"weight of length": 0.1}
    assert weights("--weights", "12,0,length=0.1", "--angles", "paper")[0] == {
        "weight of task": 12.0,
        "weight of length": 0.1,
    }
    message = "orthocas: --angles requires the numbers of --weights with --domain branch, such as --weights 12,0.3\n"
    assert run(*words, "--angles", "paper")[::2] == (2, message)
    assert "unknown loss term 'calm'" in run(*words, "--weights", "calm=3")[2]


@pytest.mark.slow
def test_command_notes_what_a_chart_leaves_out_of_its_branch(run: Run) -> None:
    """Also in its rows and in JSON; a warning of Python would be an error here."""
    file = robot_data("z1_description/urdf/z1.urdf")
    words = ("fit", str(file), "--tip", "link06", "--task", "position+axis:x", "--domain", "branch", "--force")
    words = (*words, "--param", "polynomial:1", "--samples", "500", "--out", "z.orthocas")
    code, out, err = run(*words)
    assert code == 0
    assert "note: the chart of branch 'whole' leaves out all but " in err
    assert "singular positions divide it, so the chart has one side of them" in out
    data = json.loads(run(*words, "--json")[1])
    assert 0.6 < data["regular_share"] < 0.8
    assert data["left_out"].startswith("all but ")
    assert f"{percent(data['regular_share'], 2)} of the branch's clear positions" in out


def test_command_gives_no_advice_that_wide_fits_refuse() -> None:
    uneven = replace(oc.evaluate(wide_plane().chart, 500), length_ratio=50.0)
    tight = replace(wide_plane().chart, notes={})
    assert "--weights" in format_report_rows(uneven, tight)["lengths"]
    assert "--weights" not in _format_fit(wide_plane(), uneven, Path("a.orthocas"))["lengths"]


@pytest.mark.slow
def test_decoupled_laws_are_warned_of_the_leak() -> None:
    chart = wide_pose().chart
    decoupled, coupled = control.PDPlus(chart, 50.0, coupling="decoupled"), control.PDPlus(chart, 50.0)
    assert any("lean into the task by 4" in remark for remark in decoupled.remarks())
    assert not any("lean into" in remark for remark in coupled.remarks())


@pytest.mark.slow
def test_interrupted_fits_keep_the_best_so_far() -> None:
    known = oc.problems.get("planar_3r_xy")
    whole = oc.Box([0.0, 1.0, 1.0], [3.0, 1.8, 1.8])  # nothing is regular enough there, so all descents are begun
    for later in (0, 1):  # stages before the one that is interrupted
        reports: list[str] = []

        def stop(progress: Progress, reports: list[str] = reports, later: int = later) -> None:
            reports.append(progress.stage)
            if len(set(reports)) > later:
                raise KeyboardInterrupt

        with pytest.raises(Interrupted) as stopped:
            oc.fit_wide(known.robot, known.task, whole, parametrisation=oc.Polynomial(3), monitor=stop)
        fit = stopped.value.result
        assert fit.status is Status.INTERRUPTED
        assert [stage.label for stage in fit.stages] == list(dict.fromkeys(reports))
        assert 0 < fit.stages[-1].result.iterations < 3


def test_coordinates_of_the_other_sense_in_the_middle_miss_it() -> None:
    known = oc.problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, domain=BENT, least_singular_value=0.1)
    search = Search(problem, oc.Polynomial(1), WideSettings(500))
    search.begin("linear")
    (missed, *_), C = search.rank, search.best
    assert not missed
    assert C is not None
    search.best = None
    search._take("mirrored", replace(search.stages[0].result, theta=-C), 500)
    assert search.rank[0]


@pytest.mark.nightly
def test_networks_are_regular_on_a_whole_box() -> None:
    known, network = oc.problems.get("planar_3r_xy"), oc.MLP((16, 16), raw=True)
    wide = oc.Box([0.0, 0.9, 0.9], [3.0, 1.3, 1.3])
    fit = oc.fit_wide(known.robot, known.task, wide, parametrisation=network)
    assert fit.chart.notes["solver"] == "adam"
    domain, clear = fit.chart.problem.domain, oc.ClearBox(wide, known.task, 0.1)
    assert np.mean(domain.contains(sample_uniform(clear, 20_000, 7))) > 0.995, fit
    points = sample_uniform(domain, 20_000, 8)
    steps = 1e-6 * np.eye(3)
    x = [(known.robot.tip_position(points + e) - known.robot.tip_position(points - e))[:, :2] for e in steps]
    xi = [fit.chart.xi(points + e) - fit.chart.xi(points - e) for e in steps]
    signs = np.sign(np.linalg.det(np.concatenate([np.stack(x, 2), np.stack(xi, 2)], axis=1) / 2e-6))
    assert abs(signs.sum()) == len(points)

    def stop(progress: Progress) -> None:
        if progress.fraction > 0.2:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        oc.fit_wide(known.robot, known.task, wide, parametrisation=network, monitor=stop)
    assert stopped.value.result.status is Status.INTERRUPTED
    assert 0.3 < stopped.value.result.regular_share <= 1


@pytest.mark.nightly
def test_networks_in_another_metric_begin_with_those_of_the_identity() -> None:
    known = oc.problems.get("planar_3r_xy")
    network = oc.MLP((8,), raw=True)
    fit = oc.fit_wide(known.robot, known.task, BENT, "inertia", parametrisation=network, samples=1000)
    first, second = [stage.label for stage in fit.stages[:2]]
    assert first == f"{second}, A = I"
    plain = oc.fit_wide(known.robot, known.task, BENT, parametrisation=network, samples=1000)
    assert np.array_equal(plain.stages[0].result.theta, fit.stages[0].result.theta)
    assert fit.regular_share > 0.99


@pytest.mark.parametrize(
    ("ranks", "begun", "kept"),
    [
        ([(False, 5e-4)], [0], 0),
        ([(False, 5e-3), (False, 1e-3)], [0, 1], 1),
        ([(False, 5e-3), (False, 5.5e-3)], [0, 1], 0),
        ([(False, 5e-3), (False, 8e-3), (False, 1e-3)], [0, 1, 2], 2),
        ([(False, 0.1), (False, 0.01)], [0, 2], 2),
        ([(True, 0.1), (True, 1e-3), (False, 0.2)], [0, 2, 1], 1),
    ],
)
def test_poor_results_ask_for_another_polynomial_and_very_poor_ones_for_a_network(
    ranks: list[tuple[bool, float]], begun: list[int], kept: int
) -> None:
    problem, tried, went_on, given = oc.problems.get("planar_3r_xy"), list[int](), list[int](), iter(ranks)

    class Known(Search):
        def begin(self, name: str) -> None:
            self.best, self.rank = np.zeros(1), (*next(given), -0.1)
            tried.append(searches.index(self))

        def go_on(self) -> None:
            went_on.append(searches.index(self))

    families = (oc.Polynomial(1), oc.Polynomial(1), oc.MLP((4,)))
    searches: list[Search] = [Known(problem, family, WideSettings(9)) for family in families]
    search_families(searches)
    assert (tried, went_on) == (begun, [kept])


@pytest.mark.slow
def test_ctrl_c_before_a_network_has_a_middle_is_no_error_of_the_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    def pressed(self: Resampled, size: int, count: int, seed: tuple[int, ...]) -> Any:
        raise KeyboardInterrupt

    known, ends = oc.problems.get("planar_3r_xy"), set[type]()
    monkeypatch.setattr(Resampled, "batches", pressed)
    for seed in range(6):  # random networks have either sign in the middle
        with pytest.raises((KeyboardInterrupt, Interrupted)) as stopped:
            oc.fit_wide(known.robot, known.task, BENT, parametrisation=oc.MLP((4,), raw=True), samples=500, seed=seed)
        ends.add(stopped.type)
    assert ends == {KeyboardInterrupt, Interrupted}


def test_slivers_join_one_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cuts at -0.4 and 0.4 that self-motions do not cross, with nothing clear between them: the weaker one goes."""
    robot = oc.problems.get("iiwa").robot
    whole = find_joint_range(robot, 0)
    arm = _Arm.build_all(robot, None, whole)[0]

    def sizes(self: _Arm, k: int, value: float, count: int) -> tuple[float, float]:
        clear = 0.05 if abs(value) < 0.4 else 0.3
        return clear, min(abs(value + 0.4), abs(value - 0.4) + 1e-3)

    monkeypatch.setattr(_Arm, "_measure_slice", sizes)
    found = arm.find_cuts(3)
    assert [(cut.value, cut.singular) for cut in found] == [(pytest.approx(-0.4, abs=1e-3), False)]


@dataclass(frozen=True)
class Evenness:
    """A term of a user: coordinates should not depend on the second joint."""

    name: str = "second joint"
    data: tuple[str, ...] = ()
    hinge: bool = False

    def residuals(self, coordinate_jacobian: ca.SX, data: Any, sizes: Any) -> ca.SX:
        return coordinate_jacobian[:, 1]


@pytest.mark.slow
def test_terms_and_weights_of_users_reach_wide_fits() -> None:
    known = oc.problems.get("planar_3r_xy")
    oc.register_loss_term(Evenness())
    oc.register_loss_term(Evenness())

    def fit(**settings: Any) -> WideFit:
        return oc.fit_wide(known.robot, known.task, BENT, parametrisation=oc.Polynomial(3), samples=2000, **settings)

    def share(chart: oc.Chart) -> float:
        """Of the second joint in the gradients."""
        J = chart.coordinates.jacobian(sample_uniform(chart.problem.domain, 500, 1))[:, 0]
        return float((J[:, 1] ** 2).mean() / (J**2).sum(axis=1).mean())

    plain, less = fit(), fit(weights={"second joint": 3.0})
    assert share(less.chart) < 0.5 * share(plain.chart)
    assert less.regular_share > 0.95
    assert less.chart.notes["weight of second joint"] == 3.0
    loose = fit(weights=oc.Weights(task=1e-6, mutual=0.0, regularity=0.0))
    leaks = [oc.evaluate(item.chart, 1000).leak.rms for item in (loose, plain)]
    assert leaks[1] < leaks[0] - 5.0, leaks
    assert plain.regular_share > 0.99
    with pytest.raises(UnknownNameError, match="unknown loss term 'third joint'"):
        fit(weights={"third joint": 1.0})


@pytest.mark.slow
def test_families_of_users_reach_wide_fits() -> None:
    """One with no more than expressions, not linear in its parameters."""

    @dataclass(frozen=True)
    class Bent:
        label: str = "bent"
        linear: bool = False
        closed_form: None = None

        def for_problem(self, problem: oc.Problem) -> "Bent":
            return self

        def family(self, space: JointSpace, outputs: int) -> "BentFamily":
            return BentFamily(space, outputs)

    @dataclass(frozen=True, eq=False)
    class BentFamily:
        """xi = sum_k a_k q_k + b_k sin(c_k q_k)."""

        space: JointSpace
        outputs: int
        as_matrices: bool = True
        width: int = 4

        @property
        def size(self) -> int:
            return 3 * self.space.n

        def expression(self, q: Any, theta: Any) -> Any:
            a, b, c = ca.vertsplit(ca.reshape(theta, self.space.n, 3).T)
            return a @ q + b @ ca.sin(q * ca.repmat(c.T, 1, q.shape[1]))

        def jacobian(self, q: Any, theta: Any) -> list[Any]:
            return component_gradients(self.expression(q, theta), q)

        def initial(self, seed: int) -> Numbers:
            return np.random.default_rng(seed).normal(size=self.size)

    known, box = oc.problems.get("planar_3r_xy"), oc.Box([0.0, 1.3, 1.3], [1.0, 0.6, 0.6])
    with pytest.warns(NotSavableWarning):
        fit = oc.fit_wide(known.robot, known.task, box, parametrisation=Bent(), samples=2000)
    assert fit.chart.notes["solver"] == "adam"
    assert fit.regular_share > 0.9


def test_bad_settings_are_named() -> None:
    known = oc.problems.get("planar_3r_xy")
    with pytest.raises(InvalidValueError, match="clearance"):
        oc.fit_wide(known.robot, known.task, clearance=float("nan"))
    with pytest.raises(
        InvalidValueError, match=r"parametrisation is linear.*, expected a family to fit.* or one without"
    ):
        oc.fit_wide(known.robot, known.task, BENT, parametrisation=oc.Linear())
    with pytest.raises(InvalidValueError, match=r"parametrisation is mlp:4x4, expected .* linear in .*, for like"):
        oc.fit_wide(known.robot, known.task, BENT, parametrisation=oc.MLP((4, 4)), like="q3")
    with pytest.raises(UnknownNameError, match="unknown branch 'up'"):
        oc.fit_wide(known.robot, known.task, "up")


def test_a_middle_with_another_sign_than_the_rest_is_no_domain() -> None:
    robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
    box, task = oc.Box([0.0, 0.35, 0.35], [3.0, 2.9, 2.9]), oc.Task.position(robot, "xy")
    with pytest.raises(DomainError, match="at the centre of branch 'box', coordinates fold or have another sign"):
        oc.fit_wide(robot, task, box, parametrisation=oc.Polynomial(1), samples=2000)


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    wide_plane().chart.save(tmp_path / "a.orthocas")
    header = header_of(tmp_path / "a.orthocas")
    for value in (0.0, 1.0, -3.0):
        header["problem"]["least_volume"] = value
        with pytest.raises(ChartFileError, match="least_volume"):
            oc.load(resealed(tmp_path / "a.orthocas", header))


def test_regular_part_refuses_coordinates_that_fold_at_its_centre() -> None:
    domain = wide_plane().chart.problem.domain
    assert isinstance(domain, RegularPart)
    with pytest.raises(DomainError, match="coordinates have the volume .* at the centre"):
        RegularPart(domain, domain.coordinates, 0.999999)


@pytest.mark.slow
@pytest.mark.nightly
def test_nearly_all_of_a_branch_is_proved_and_holds() -> None:
    robot, chart = iiwa(), wide_pose().chart

    def enough(progress: Progress) -> None:
        if progress.fraction > 0.12:  # of the boxes: nearly all of what is clear is proved, and most boxes are left
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        oc.certify(chart, monitor=enough)
    found = stopped.value.result
    assert 0.99 < found.clear_share < 1
    assert found.heading.startswith("not proved, ")
    assert "100.0" not in found.heading
    low, high = found.regular.leaves(PROVED)
    rng = np.random.default_rng(9)
    chosen = rng.choice(len(low), 100_000)
    points = rng.uniform(low[chosen], high[chosen])
    domain = chart.problem.domain
    assert isinstance(domain, RegularPart)
    clear = domain.singular_values(points) > domain.least_singular_value
    assert clear.sum() > 5000  # enough to look at; how many depends on how far the proof got
    assert (domain.volumes(points[clear]) > 0).all()
    far = robot.tip_rotation(points) @ robot.tip_rotation(domain.centre).T
    assert (np.trace(far, axis1=1, axis2=2) < 2 * np.cos(3.1) + 1).any()  # half a turn is no boundary of the proof


@pytest.mark.nightly
def test_cuts_of_two_arms_are_those_of_each() -> None:
    """The last seven joints of a robot with two tips carry one of them only."""
    path = robot_data("baxter_description/urdf/baxter.urdf")
    tips = ["left_gripper", "right_gripper"]
    both = oc.Robot.from_urdf(path, tips=tips)
    found = {(cut.joint_name, cut.singular): cut.value for cut in oc.branches(both).cuts}
    alone = [cut for tip in tips for cut in oc.branches(oc.Robot.from_urdf(path, tip=tip)).cuts]
    assert set(found) == {(cut.joint_name, cut.singular) for cut in alone}
    for cut in alone:
        assert found[cut.joint_name, cut.singular] == pytest.approx(cut.value, abs=0.05)
    of_right = oc.branches(both, oc.Task.pose(both, frame=tips[1]))
    assert {cut.joint_name.partition("_")[0] for cut in of_right.cuts} == {"right"}


def test_the_leak_by_the_self_motion_is_that_by_task_gradients() -> None:
    known = oc.problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, "inertia", BENT)
    samples = sample_frames(problem, sample_uniform(problem.domain, 50, 0))
    J = np.random.default_rng(1).normal(size=(len(samples), 1, 3))
    squares = np.einsum("srn,srn->s", J, samples.compute_metric_gradients(J))
    sines = ((samples.task_basis @ J.transpose(0, 2, 1))[:, :, 0] ** 2).sum(axis=1) / squares
    loss = build_sample_loss(Loss.of(Sizes(3, 2, 1, False), {"self-motion": 2.0}))
    found = [
        float(loss(j, inverse, z)) for j, inverse, z in zip(J, samples.metric_inverse, samples.null_basis, strict=True)
    ]
    np.testing.assert_allclose(found, sines, atol=1e-10)
