"""Capsules contain the links, and NAME_distance is what coal says of the capsules."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
from conftest import robot_data
from programs import Run, needs_c
from scipy.spatial import ConvexHull
from solid_arms import BALL, build_arm

import orthocas as oc
from orthocas.codegen import GeneratedC
from orthocas.codegen.library import NO_DOUBLE, STRICT
from orthocas.errors import InvalidValueError
from orthocas.native.libraries import find_compilers
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.collisions import Collisions, Part
from orthocas.robots.shapes import BallGeometry, BoxGeometry, Shape
from orthocas.tools.checks import Array

pytestmark = needs_c


class Compiled:
    """NAME_distance, compiled without warnings."""

    def __init__(self, generated: GeneratedC, n: int) -> None:
        library = str(generated.folder / "distance.so")
        source = str(generated.folder / f"{generated.name}_distance.c")
        strict = (*STRICT, *(NO_DOUBLE if generated.single_precision else ()))
        subprocess.run(
            [find_compilers()[0], *strict, "-O2", "-fPIC", "-shared", "-o", library, source, "-lm"], check=True
        )
        self.kind = np.float32 if generated.single_precision else np.float64
        self.run = getattr(ctypes.CDLL(library), f"{generated.name}_distance")
        self.n = n

    def __call__(self, q: Array) -> tuple[float, Array, Array, int, int]:
        """Distance, gradient (n,), points (2, 3), number of the pair, status."""
        sizes = (1, self.n, 6)
        results = [np.empty(size, dtype=self.kind) for size in sizes]
        pair = np.empty(1, dtype=np.int32)
        arrays = [np.ascontiguousarray(q, dtype=self.kind), *results, pair]
        status = self.run(*(ctypes.c_void_p(array.ctypes.data) for array in arrays))
        distance, gradient, points = (array.astype(float) for array in results)
        return float(distance[0]), gradient, points.reshape(2, 3), int(pair[0]), int(status)


def write(folder: Path, robot: oc.Robot, fitted: FittedCapsules, **options: bool) -> Compiled:
    """Generated and compiled, for a chart of the tip's x."""
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box(robot.tree.centre_posture + 0.4, 0.2))
    chart = oc.fit(problem, oc.Linear(), samples=300).chart
    return Compiled(oc.generate_c(chart, folder, name="arm", capsules=fitted, **options), robot.n)


def compare(compiled: Compiled, model: Collisions, q: Array, tolerance: float) -> None:
    """The same as coal's for the same solids, whose points are good to some 1e-6 where axes are nearly parallel."""
    wanted = model.distance(q)
    errors = []
    for k, posture in enumerate(q):
        distance, gradient, points, pair, status = compiled(posture)
        assert status == 0
        assert distance == pytest.approx(wanted.distance[k], abs=tolerance)
        same = model.pairs[pair] == wanted.pair[k]
        errors.append((not same, np.abs(points - wanted.points[k]).max(), np.abs(gradient - wanted.gradient[k]).max()))
    # Points of parallel axes are those of one choice, which rounding makes in single precision.
    certain = 0.9 if compiled.kind is np.float32 else 1.0
    assert (np.quantile(errors, certain, axis=0) <= [0, max(5e-6, 10 * tolerance), max(5e-5, 100 * tolerance)]).all()


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[oc.Robot, FittedCapsules]:
    """A planar arm of boxes, a cylinder and a ball, with a floor and a post."""
    solids = [BALL, '<box size="0.6 0.2 0.1"/>', '<cylinder radius="0.1" length="0.5"/>', '<box size="0.4 0.3 0.02"/>']
    robot = build_arm(Path(tmp_path_factory.mktemp("arm")), solids)
    scene = oc.Scene(
        {
            "wall": oc.obstacles.Plane([0.3, 1.0, 0.1], [0.0, -1.5, 0.0]),
            "post": oc.obstacles.Capsule([1.5, 1.5, -1.0], [1.4, 1.6, 1.0], 0.05),
        }
    )
    return robot, oc.fit_capsules(robot.collisions.with_scene(scene))


@pytest.mark.slow
def test_capsules_contain_the_solids(arm: tuple[oc.Robot, FittedCapsules]) -> None:
    """Corners of pieces are within capsules, pieces are the hull together, and random points of solids inside."""
    robot, fitted = arm
    source = robot.collisions
    rng = np.random.default_rng(3)
    for name in fitted.ratios:
        pieces = [(corners, part.shape) for owner, corners, part in fitted.pieces if owner == name]
        for corners, shape in pieces:
            (ends, radius), n = shape.list_corners(), len(corners)
            along = ends[-1] - ends[0]
            s = np.clip((corners - ends[0]) @ along / max(along @ along, 1e-300), 0, 1) if along.any() else np.zeros(n)
            away = np.linalg.norm(corners - ends[0] - s[:, None] * along, axis=1)
            assert (away <= radius - 1e-10).all()
        parts = [part.shape for part in source.parts if part.name == name]
        for part in parts:
            low, high = part.list_box()
            points = rng.uniform(low, high, (20_000, 3))
            points = points[part.contains(points)]
            assert np.any([shape.contains(points) for _, shape in pieces], axis=0).all()
        if len(parts) == 1 and len(corners := parts[0].list_corners()[0]) > 3:
            whole = ConvexHull(corners).volume
            cut = sum(ConvexHull(corners, qhull_options="QJ").volume for corners, _ in pieces)
            assert cut == pytest.approx(whole, rel=1e-6)
    assert fitted.ratio < 2
    assert "capsules" in fitted.facts()


def test_distances_in_c_are_those_of_coal(arm: tuple[oc.Robot, FittedCapsules], tmp_path: Path) -> None:
    robot, fitted = arm
    compiled = write(tmp_path, robot, fitted)
    q = robot.sample(400, seed=8)
    compare(compiled, fitted.collisions, q, 1e-9)
    kinds = {fitted.collisions.pairs[compiled(posture)[3]][1] for posture in q}
    assert {"wall", "post", "link3"} <= kinds
    # Gradients by central differences of the C itself.
    for posture in q[:50]:
        ends = [[compiled(posture + move)[0] for move in sign * 1e-6 * np.eye(3)] for sign in (1, -1)]
        slopes = np.subtract(*ends) / 2e-6
        pairs = {compiled(posture + move)[3] for move in 1e-6 * np.vstack([np.eye(3), -np.eye(3)])}
        if len(pairs) == 1:
            assert np.median(np.abs(slopes - compiled(posture)[1])) < 1e-7
    # Never farther than the solids, and touching where they touch.
    source = robot.collisions.with_scene(oc.Scene({}))
    own = source.distance(q).distance
    mine = np.array([compiled(posture)[0] for posture in q])
    assert (mine[own > 0] <= own[own > 0] + 1e-9).all()
    assert (mine[own <= 0] <= 0).all()


def test_bad_postures_give_zeros(arm: tuple[oc.Robot, FittedCapsules], tmp_path: Path) -> None:
    compiled = write(tmp_path, *arm)
    for bad in (np.nan, np.inf, 1e7):
        distance, gradient, points, pair, status = compiled(np.array([0.1, bad, 0.2]))
        assert (distance, pair, status) == (0.0, 0, 3)
        assert not gradient.any()
        assert not points.any()


@pytest.mark.slow
def test_single_precision_and_few_pairs(arm: tuple[oc.Robot, FittedCapsules], tmp_path: Path) -> None:
    robot, fitted = arm
    compare(write(tmp_path, robot, fitted, single_precision=True), fitted.collisions, robot.sample(100, seed=9), 1e-5)
    # Without pairs, nothing is near.
    model = robot.collisions
    none = oc.fit_capsules(Collisions(robot.tree, model.parts, ()))
    (tmp_path / "none").mkdir()
    distance, gradient, _, _, status = write(tmp_path / "none", robot, none)(np.zeros(3))
    assert (distance > 1e10, gradient.any(), status) == (True, False, 0)


@pytest.mark.slow
def test_moving_bases_and_slides_are_placed_right(tmp_path: Path) -> None:
    robot = build_arm(tmp_path, [BALL, BALL, '<box size="0.3 0.1 0.1"/>'])
    rail = oc.Robot.from_urdf(tmp_path / "arm.urdf", "link2", base="rail:x")
    post = oc.Scene({"post": oc.obstacles.Box([0.2, 0.3, 0.4], [1.0, 1.5, 0.0])})
    fitted = oc.fit_capsules(rail.collisions.with_scene(post))
    (tmp_path / "c").mkdir()
    compare(write(tmp_path / "c", rail, fitted), fitted.collisions, rail.sample(200, seed=2), 1e-9)
    assert robot.n == rail.n - 1


@pytest.mark.nightly
def test_a_panda_s_capsules_hold_its_meshes(tmp_path: Path) -> None:
    robot = oc.Robot.from_urdf(robot_data("panda_description/urdf/panda.urdf"), "panda_hand")
    fitted = oc.fit_capsules(robot.collisions)
    assert fitted.ratio < 1.6
    compiled = write(tmp_path, robot, fitted)
    q = robot.sample(1000, seed=3)
    # Of nearly parallel axes, coal's distances are 4e-7 off: those in C agree with a search over both axes to 1e-15.
    compare(compiled, fitted.collisions, q[:300], 1e-6)
    hulls = robot.collisions.distance(q).distance
    mine = np.array([compiled(posture)[0] for posture in q])
    assert (mine[hulls > 0] <= hulls[hulls > 0] + 1e-8).all()
    assert (mine[hulls <= 0] <= 0).all()


def test_what_cannot_be_held_or_is_another_robot_s_is_refused(
    arm: tuple[oc.Robot, FittedCapsules], run: Run, tmp_path: Path
) -> None:
    robot, fitted = arm
    cloud = oc.Scene({"cloud": oc.obstacles.PointCloud([[1.0, 1.0, 0.0]])})
    with pytest.raises(InvalidValueError, match="the point cloud 'cloud'"):
        oc.fit_capsules(robot.collisions.with_scene(cloud))
    other = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    problem = oc.Problem(other, oc.Task.position(other, "x"), domain=oc.Box([0.5, 0.5], 0.3))
    chart = oc.fit(problem, oc.Linear(), samples=100).chart
    with pytest.raises(InvalidValueError, match="those of the chart's robot"):
        oc.generate_c(chart, tmp_path, name="arm", capsules=fitted)


def test_the_command_writes_distances(run: Run) -> None:
    robot = build_arm(Path(), [BALL, BALL, BALL])
    problem = oc.Problem(robot, oc.Task.position(robot, "x"), domain=oc.Box([0.5, 0.5], 0.3))
    oc.fit(problem, oc.Linear(), samples=100).chart.save("a.orthocas")
    words = ("a.orthocas", "--controller", "none", "--out", "c", "--name", "arm", "--collisions", "arm.urdf")
    code, _, err = run("codegen", *words)
    assert (code, err) == (0, "")
    assert '{"link0", "link2"}' in Path("c/arm_distance.c").read_text()
    assert "arm_distance.c" in Path("c/CMakeLists.txt").read_text()


class KeepClear:
    """NAME_keep_clear of the same library."""

    def __init__(self, compiled: Compiled, library: Path) -> None:
        self.run, self.n = ctypes.CDLL(str(library)).arm_keep_clear, compiled.n

    def __call__(self, q: Array, goal: Array, margin: float) -> tuple[Array, float, int]:
        """The result (n,), the distance there, and the status."""
        result, distance = np.empty(self.n), np.empty(1)
        inputs = [np.ascontiguousarray(row, dtype=float) for row in (q, goal)]
        first, second, place, least = (ctypes.c_void_p(row.ctypes.data) for row in (*inputs, result, distance))
        status = int(self.run(first, second, ctypes.c_double(margin), place, least))
        return result, float(distance[0]), status


@pytest.mark.slow
def test_steps_in_c_keep_clear_between_postures_too(arm: tuple[oc.Robot, FittedCapsules], tmp_path: Path) -> None:
    """Hostile steps, over half of a joint's range at once: never a contact, and no step that could have been longer."""
    robot, fitted = arm
    compiled = write(tmp_path, robot, fitted)
    keep_clear = KeepClear(compiled, tmp_path / "distance.so")
    model, margin, rng = fitted.collisions, 0.02, np.random.default_rng(5)
    starts = robot.sample(200, seed=6)
    q = starts[np.argmax([compiled(posture)[0] for posture in starts])]
    way, counts = [q], np.zeros(4, dtype=int)
    for k in range(1500):
        goal = q + rng.normal(size=3) * (0.02, 0.2, 1.0)[k % 3]
        new, distance, status = keep_clear(q, goal, margin)
        counts[status] += 1
        before = compiled(q)[0]
        floor = margin + 0.5 * (min(before, 3 * margin) - margin) if before > margin else before
        assert distance == compiled(new)[0]
        assert distance >= floor - 1e-12
        shares = (new - q) / (goal - q)
        np.testing.assert_allclose(shares, shares[0], atol=1e-9)
        assert np.isclose(shares[0], [0, 1, 0.5, 0.25, 0.125, 0.0625, 0.03125]).any()
        assert (status == 0) == (shares[0] == 1)
        if np.abs(new - q).max() > 0 and status:
            # The step of twice the length comes too near at its end, or may do so on its way.
            longer = q + 2 * (new - q)
            low = 0.5 * min(margin, before)
            assert (
                compiled(longer)[0] < floor + 1e-12
                or model.find_contact(np.array([q, longer]), low)
                or (np.abs(longer - q).max() > 0.05)
            )
        q = new
        way.append(q)
    assert (counts[:3] > 20).all()
    assert robot.collisions.check_free(np.array(way)).all()
    assert model.find_contact(np.array(way), 0.49 * margin) is None
    for bad in ((np.nan, 0.02), (0.0, 0.0), (0.0, -1.0), (0.0, np.nan)):
        result, distance, status = keep_clear(q + bad[0], q, bad[1])
        assert (status, distance, result.any()) == (3, 0.0, False)


@pytest.mark.slow
def test_pairs_whose_capsules_always_touch_are_left_out_and_named(tmp_path: Path) -> None:
    """Plates above each other at a joint: no posture brings them together, and all have their capsules touching."""
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    plate, turn = BoxGeometry(np.array([0.6, 0.6, 0.01])), np.eye(3)
    parts = [
        Part("lower plate", 0, Shape(plate, turn, np.array([1.0, 0.0, 0.0]))),
        Part("upper plate", 1, Shape(plate, turn, np.array([0.0, 0.0, 0.015]))),
        Part("ball", 1, Shape(BallGeometry(0.1), turn, np.array([1.0, 0.0, 0.0]))),
    ]
    own = Collisions(robot.tree, parts, [("lower plate", "upper plate"), ("lower plate", "ball")])
    assert own.check_free(robot.sample(50))[:, None].all()
    fitted = oc.fit_capsules(own)
    assert fitted.dropped == (("lower plate", "upper plate"),)
    assert fitted.collisions.pairs == (("lower plate", "ball"),)
    assert fitted.facts()["unchecked"] == "lower plate and upper plate"
    write(tmp_path, robot, fitted)
    assert "touch in every posture tried: lower plate and upper plate" in (tmp_path / "arm_distance.h").read_text()
