"""Grown charts: exact coordinates with the interface of fitted ones."""

from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from charts import planar_2r

import orthocas as oc
from orthocas import problems
from orthocas.charts.chart import GrownChart
from orthocas.charts.chart_file import CHART
from orthocas.errors import (
    ChartFileError,
    GrowError,
    InvalidValueError,
    InverseError,
    MemoryNeedError,
    MetricError,
    NoExpressionError,
    NotADiskError,
    NotInvolutiveError,
    ShapeError,
    UnknownNameError,
)
from orthocas.exact.flow import Arrival, GrownCoordinates, TaskFlow
from orthocas.exact.leaves import read_leaf
from orthocas.tools.archive import read_archive, write_archive

ARM = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
CELL = oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi])
ON_LEAF = [np.pi / 3, 0.0]  # x = 1 of planar_2r


def planar_3r(metric: str) -> oc.Problem:
    return oc.Problem(ARM, oc.Task.position(ARM, "x"), metric, CELL)


def iiwa_height() -> oc.Problem:
    arm = problems.get("iiwa")
    return oc.Problem(arm.robot, oc.Task.position(arm.robot, "z"), "euclidean", oc.Box(arm.domain.centre, 0.3))


CHARTS = {
    "circle_I": lambda: oc.grow(planar_2r("euclidean"), 1.0, origin=ON_LEAF),
    "circle_M": lambda: oc.grow(planar_2r("inertia"), 1.0, origin=ON_LEAF),
    "disk_I": lambda: oc.grow(planar_3r("euclidean"), 0.0, cells=40),
    "disk_M": lambda: oc.grow(planar_3r("inertia"), 0.0, cells=40),
    "linear": lambda: oc.grow(iiwa_height()),
}


@pytest.fixture(scope="module", params=CHARTS)
def chart(request: pytest.FixtureRequest) -> oc.Chart:
    return CHARTS[request.param]()


def known_points(chart: oc.Chart, count: int = 100, seed: int = 7) -> np.ndarray:
    """Random points of the domain where the chart has values and is not nearly singular."""
    unit = np.random.default_rng(seed).uniform(-1, 1, (4 * count, chart.n))
    points = chart.problem.domain.centre + chart.problem.domain.half_width * unit
    gradients = np.linalg.norm(chart.jacobian(points)[:, chart.m :], axis=2).min(axis=1)
    return points[gradients > 1e-3][:count]  # NaN counts as false


@pytest.mark.slow
def test_coordinates_do_not_change_along_flow_lines(chart: oc.Chart) -> None:
    points = known_points(chart)
    for dx in (0.02, -0.02):
        moved = TaskFlow(chart.problem).move(points, np.full((len(points), 1), dx), 1e-12)
        values = chart.xi(moved.points)
        kept = moved.reached & np.isfinite(values).all(axis=1)
        assert kept.mean() > 0.9
        change = np.abs(values - chart.xi(points))[kept]
        change = np.minimum(change, 2 * np.pi - change) if chart.coordinates.label == "grown:circle" else change
        size = 1 + np.abs(chart.jacobian(points)[kept]).max(axis=(1, 2))
        assert (change.max(axis=1) / size).max() < 1e-6


@pytest.mark.slow
def test_gradients_are_orthogonal_to_the_task(chart: oc.Chart) -> None:
    """True by construction; that the gradients are those of xi is what the test after this one shows."""
    points = known_points(chart)
    J, A = chart.jacobian(points), chart.problem.metric.evaluate(points)
    raised = np.linalg.solve(A, J[:, : chart.m].transpose(0, 2, 1))
    assert np.abs(J[:, chart.m :] @ raised).max() < 1e-6
    assert oc.evaluate(chart, 300).task_angle.max < 1e-4


@pytest.mark.slow
def test_jacobian_agrees_with_differences_of_values(chart: oc.Chart) -> None:
    """An independent look at orthogonality too: differences know nothing of sensitivities."""
    points, step = known_points(chart, 40), 1e-6
    J = chart.jacobian(points)[:, chart.m :]
    differences = np.stack(
        [(chart.xi(points + step * unit) - chart.xi(points - step * unit)) / (2 * step) for unit in np.eye(chart.n)], 2
    )
    error = np.abs(J - differences).max(axis=(1, 2)) / (1 + np.abs(J).max(axis=(1, 2)))
    # on a mesh the nearest triangle may change within a step: a few points may miss, the others agree
    assert np.mean(error < 1e-3) > (0.8 if chart.coordinates.label == "grown:disk" else 0.97)
    assert np.median(error) < 1e-5


@pytest.mark.slow
def test_inverse_leads_back(chart: oc.Chart) -> None:
    points = known_points(chart, 20)
    wanted = chart.phi(points)
    found = chart.coordinates.inverse(wanted, points)
    error = np.abs(chart.phi(found) - wanted).max(axis=1)
    assert np.median(error) < 1e-8
    good = error < 1e-9  # next to an edge of a mesh, or to a saddle, a value may be out of reach
    assert good.sum() >= 18
    solved = chart.inverse(wanted[good], points[good])
    np.testing.assert_allclose(chart.phi(solved), wanted[good], atol=1e-9)
    np.testing.assert_allclose(solved, points[good], atol=1e-4)


@pytest.mark.slow
def test_files_hold_everything(chart: oc.Chart, tmp_path: Path) -> None:
    chart.save(tmp_path / "grown.orthocas")
    again = oc.load(tmp_path / "grown.orthocas")
    assert isinstance(again, GrownChart)
    assert again.notes == chart.notes
    points = known_points(chart, 20)
    np.testing.assert_array_equal(again.phi(points), chart.phi(points))
    np.testing.assert_array_equal(again.jacobian(points), chart.jacobian(points))
    assert again.coordinates.label == chart.coordinates.label


def test_faces_are_integers_in_memory_and_in_files(tmp_path: Path) -> None:
    chart = oc.grow(planar_3r("euclidean"), 0.0, cells=20)
    chart.save(tmp_path / "disk.orthocas")
    kept = read_archive(tmp_path / "disk.orthocas", CHART)[1]["leaf_faces"]
    assert kept.dtype == chart.coordinates.leaf.faces.dtype == np.int64
    with pytest.raises(ValueError, match="read-only"):
        chart.coordinates.leaf.faces[0, 0] = 1


@pytest.mark.slow
def test_faces_kept_as_floats_by_early_versions_still_load(tmp_path: Path) -> None:
    chart = oc.grow(planar_3r("euclidean"), 0.0, cells=20)
    chart.save(tmp_path / "new.orthocas")
    header, arrays = read_archive(tmp_path / "new.orthocas", CHART)
    arrays["leaf_faces"] = arrays["leaf_faces"].astype(float)
    write_archive(tmp_path / "old.orthocas", CHART, {k: v for k, v in header.items() if k != "sha256"}, arrays)
    old = oc.load(tmp_path / "old.orthocas")
    points = known_points(chart, 20)
    np.testing.assert_array_equal(old.phi(points), chart.phi(points))
    assert old.coordinates.leaf.faces.dtype == np.int64
    for bad, shown in ((0.5, "0.5"), (1e6, "1e\\+06")):
        arrays["leaf_faces"][0, 0] = bad
        write_archive(tmp_path / "bad.orthocas", CHART, {k: v for k, v in header.items() if k != "sha256"}, arrays)
        with pytest.raises(ChartFileError, match=f"faces is {shown}, expected whole numbers from 0 to"):
            oc.load(tmp_path / "bad.orthocas")


def test_one_point_and_many_have_the_usual_shapes(chart: oc.Chart) -> None:
    point = known_points(chart, 1)[0]
    assert chart.xi(point).shape == (chart.r,)
    assert chart.phi(point[None]).shape == (1, chart.n)
    assert chart.jacobian(point).shape == (chart.n, chart.n)
    with pytest.raises(ShapeError):
        chart.xi(np.zeros(chart.n + 1))


def test_there_is_no_expression_but_a_pointer(chart: oc.Chart) -> None:
    with pytest.raises(NoExpressionError, match=r"orthocas\.distil"):
        chart.function("phi")
    assert chart.function("task").size_out(0) == (chart.m, 1)


@pytest.mark.slow
def test_evaluate_counts_what_lies_too_near_to_a_separatrix_as_folded() -> None:
    report = oc.evaluate(CHARTS["circle_M"](), 20_000)
    assert 0 < report.folded_samples < 200
    assert oc.evaluate(CHARTS["circle_I"](), 20_000).folded_samples == 0


def test_both_metrics_agree_on_the_base_leaf() -> None:
    charts = [oc.grow(planar_2r(metric), 1.0, origin=ON_LEAF) for metric in ("euclidean", "inertia")]
    leaves = [chart.coordinates.leaf for chart in charts]
    np.testing.assert_allclose(leaves[0].curve, leaves[1].curve, atol=1e-7)
    on_leaf = leaves[0].points(np.linspace(-3, 3, 50)[:, None])
    np.testing.assert_allclose(charts[0].xi(on_leaf), charts[1].xi(on_leaf), atol=1e-6)


@pytest.mark.slow
def test_points_that_leave_the_chart_get_a_status() -> None:
    chart = oc.grow(planar_3r("euclidean"), 0.0, cells=20)
    points = CELL.centre + CELL.half_width * np.random.default_rng(0).uniform(-1, 1, (500, 3))
    assert isinstance(chart.coordinates, GrownCoordinates)
    pulled = chart.coordinates.pull(points)
    outside = pulled.status == Arrival.OUTSIDE
    assert 0 < outside.mean() < 0.5
    np.testing.assert_array_equal(np.isnan(chart.xi(points)).any(axis=1), outside)
    assert (np.abs(pulled.points[outside, 0] - np.pi / 2) > np.pi / 2).all()  # q1 has left (0, pi)
    assert oc.evaluate(chart, 500, seed=0).singular_samples > 0


def test_a_box_domain_gets_a_leaf_large_enough() -> None:
    box = oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", problems.get("planar_3r_x").domain)
    chart = oc.grow(box, cells=30)
    report = oc.evaluate(chart, 500)
    assert report.singular_samples <= 5
    assert report.conditioning.p01 > 0.8


def test_non_involutive_tasks_are_refused() -> None:
    with pytest.raises(NotInvolutiveError, match="depend on the path"):
        oc.grow(problems.get("planar_3r_xy"))


def test_involutive_tasks_of_two_components_grow() -> None:
    arm = oc.Robot.planar(lengths=[1.0] * 4, masses=[1.0] * 4)
    task = oc.Task.custom(arm, "disjoint", lambda q: ca.vertcat(ca.sin(q[0] + q[1]), ca.sin(q[2]) + q[3] ** 2))
    problem = oc.Problem(arm, task, "euclidean", oc.Box([0.3, 0.4, 0.2, 0.5], 0.2))
    chart = oc.grow(problem)
    points = known_points(chart)
    J = chart.jacobian(points)
    assert np.abs(J[:, 2:] @ J[:, :2].transpose(0, 2, 1)).max() < 1e-9
    assert oc.evaluate(chart, 200).conditioning.min > 0.8


def test_leaves_that_are_no_disk_say_what_they_are() -> None:
    whole = oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", oc.Box([0, 0, 0], np.pi))
    with pytest.raises(NotADiskError, match="2 boundary loops"):
        oc.grow(whole, 0.0, cells=20)


@pytest.mark.slow
def test_bad_arguments_name_what_came() -> None:
    problem = planar_2r("euclidean")
    with pytest.raises(UnknownNameError, match="unknown leaf 'sphere'"):
        oc.grow(problem, leaf="sphere")
    with pytest.raises(GrowError, match="cannot be reached"):
        oc.grow(problem, 2.5)
    with pytest.raises(ShapeError, match="level"):
        oc.grow(problem, [1.0, 2.0])
    with pytest.raises(GrowError, match="expected n = 3 and m = 1"):
        oc.grow(problem, 1.0, leaf="disk")
    with pytest.raises(GrowError, match="r = 1"):
        oc.grow(planar_3r("euclidean"), 0.0, leaf="circle")
    with pytest.raises(InvalidValueError, match="problem is 'planar_2r', expected a Problem"):
        oc.grow("planar_2r")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="leaf is 3"):
        oc.grow(problem, leaf=3)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="applies to disk leaves only"):
        oc.grow(problem, 1.0, cells=30)
    with pytest.raises(InvalidValueError, match="expected a Box"):
        oc.grow(planar_3r("euclidean"), 0.0, region="all")  # type: ignore[arg-type]
    with pytest.raises(GrowError, match="not periodic"):
        oc.grow(problem, 1.0, leaf="linear")
    with pytest.raises(MemoryNeedError, match="cells"):
        oc.grow(planar_3r("euclidean"), 0.0, cells=100_000)
    with pytest.raises(GrowError, match="along the shortest, expected at least"):
        oc.grow(planar_3r("euclidean"), 0.0, region=oc.Box([1.5, 0, 0], [0.01, 1, 1]))
    with pytest.raises(GrowError, match="singularity of the task"):
        oc.grow(problem, 0.0)  # the leaf through the saddles is no circle
    chart = oc.grow(problem, 1.0, origin=ON_LEAF)
    with pytest.raises(InverseError, match="no q"):
        chart.inverse([1.0, 4.0], [0.0, 0.0])  # beyond pi
    assert isinstance(chart.coordinates, GrownCoordinates)
    with pytest.raises(ShapeError, match="points"):
        chart.coordinates.pull(np.zeros(3))
    with pytest.raises(InverseError, match="no q"):
        oc.grow(planar_3r("euclidean"), 0.0, cells=20).inverse([0.0, 1e300, 1e300], [1.0, 0.0, 0.0])


def test_metrics_that_are_not_positive_are_refused() -> None:
    def metric(q: ca.SX) -> ca.SX:
        return ca.diag(ca.vertcat(q[0] - 0.5, 1, 1))

    with pytest.raises(MetricError, match="eigenvalue"):
        oc.grow(oc.Problem(ARM, oc.Task.position(ARM, "x"), metric, oc.Box([0.6, 0.8, 0.8], 0.4)))


def test_the_two_ends_of_a_circle_are_one_point() -> None:
    chart = oc.grow(planar_2r("euclidean"), 1.0, origin=ON_LEAF)
    ends = [chart.inverse([1.2, xi], [-1.0, 0.0]) for xi in (np.pi, -np.pi)]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-6, 1e5])
@pytest.mark.parametrize("leaf", ["disk", "linear"])
def test_units_of_the_task_do_not_matter(leaf: str, scale: float) -> None:
    box = oc.Box([0.6, 0.8, 0.8], 0.3)
    charts = []
    for factor in (1.0, scale):
        task = oc.Task.custom(ARM, "x", lambda q, f=factor: f * (ca.cos(q[0]) + ca.cos(q[0] + q[1]) + ca.sin(q[2])))
        charts.append(oc.grow(oc.Problem(ARM, task, "euclidean", box), leaf=leaf))
    points = known_points(charts[0], 20)
    np.testing.assert_allclose(charts[1].xi(points), charts[0].xi(points), atol=1e-8)
    found = charts[1].coordinates.inverse(charts[1].phi(points), points)
    np.testing.assert_allclose(charts[1].x(found), charts[1].x(points), rtol=1e-9, atol=1e-9 * scale)
    np.testing.assert_allclose(found, points, atol=1e-4)


def test_a_start_elsewhere_is_no_obstacle_for_a_linear_leaf() -> None:
    box = oc.Box([0.6, 0.8, 0.8], 0.4)
    chart = oc.grow(oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", box), leaf="linear")
    points = known_points(chart, 10)
    np.testing.assert_allclose(chart.inverse(chart.phi(points), points + np.array([0, 0, 1.0])), points, atol=1e-7)
    np.testing.assert_allclose(chart.inverse(chart.phi(points), points), points, atol=1e-7)


@pytest.mark.slow
def test_prismatic_joints_grow(tmp_path: Path) -> None:
    """A slide that carries a planar arm: x = q1 + cos q2 + cos(q2 + q3)."""
    kinds = [("prismatic", 0, "1 0 0"), ("revolute", 0, "0 0 1"), ("revolute", 1, "0 0 1")]
    joints = "".join(
        f'<joint name="j{k}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="{x} 0 0"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for k, (kind, x, axis) in enumerate(kinds)
    )
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="l{k}">{inertia}</link>' for k in range(4)) + '<link name="tip"/>'
    fixed = '<joint name="end" type="fixed"><parent link="l3"/><child link="tip"/><origin xyz="1 0 0"/></joint>'
    (tmp_path / "slide.urdf").write_text(f'<robot name="slide">{links}{joints}{fixed}</robot>')
    robot = oc.Robot.from_urdf(tmp_path / "slide.urdf", tip="tip")
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), "inertia", oc.Box([0.2, 0.6, 0.8], [0.2, 0.3, 0.3]))
    for leaf in ("disk", "linear"):
        grown = oc.grow(problem, leaf=leaf)
        points = known_points(grown, 20)
        step = 1e-6 * np.random.default_rng(1).normal(size=points.shape)
        change = (grown.xi(points + step) - grown.xi(points - step)) / 2
        wanted = np.einsum("srn,sn->sr", grown.jacobian(points)[:, 1:], step)
        assert np.median(np.abs(change - wanted)) < 1e-10


def test_damaged_files_of_grown_charts_are_refused(tmp_path: Path) -> None:
    chart = oc.grow(planar_2r("euclidean"), 1.0, origin=ON_LEAF)
    chart.save(tmp_path / "grown.orthocas")
    content = (tmp_path / "grown.orthocas").read_bytes()
    (tmp_path / "short.orthocas").write_bytes(content[: len(content) // 2])
    with pytest.raises(ChartFileError):
        oc.load(tmp_path / "short.orthocas")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("leaf", "name", "change"),
    [
        ("circle", "curve", lambda a: a[:1]),
        ("circle", "curve", lambda a: a + 0.1),
        ("circle", "length", lambda a: -a),
        ("disk", "faces", lambda a: a + 10**6),
        ("disk", "faces", lambda a: a + 0.5),
        ("disk", "disk", lambda a: 5 * a),
        ("disk", "vertices", lambda a: a + 0.3),
        ("linear", "normals", lambda a: 0 * a),
        ("linear", "level", lambda a: a + 0.3),
    ],
)
def test_edited_leaves_are_refused(leaf: str, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    if leaf == "circle":
        chart = oc.grow(planar_2r("euclidean"), 1.0, origin=ON_LEAF)
    else:
        problem = oc.Problem(ARM, oc.Task.position(ARM, "x"), "euclidean", oc.Box([0.6, 0.8, 0.8], 0.3))
        chart = oc.grow(problem, leaf=leaf)
    arrays = dict(chart.coordinates.leaf.to_arrays())
    arrays[name] = change(arrays[name])
    with pytest.raises((InvalidValueError, ShapeError)):
        read_leaf(chart.problem, leaf, arrays)
