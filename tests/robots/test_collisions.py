"""Distances between links and scenes are those of coal and of closed forms; no way between postures hides a contact."""

import pickle
from collections.abc import Callable
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from collisions import hull_of
from conftest import robot_data
from solid_arms import BALL, build_arm, place_balls

import orthocas as oc
from orthocas.errors import InvalidValueError, PathError, RobotError, UnknownNameError
from orthocas.robots.collisions import Collisions
from orthocas.robots.shapes import HullGeometry
from orthocas.tasks.domains import StopKind
from orthocas.tools.checks import Array


def differentiate(collisions: Collisions, q: Array, step: float = 1e-6) -> Array:
    """Central differences of the least distance at q (N, n)."""
    columns = []
    for move in step * np.eye(q.shape[1]):
        ahead, behind = collisions.distance(q + move), collisions.distance(q - move)
        columns.append((ahead.distance - behind.distance) / (2 * step))
    return np.array(columns).T


def test_balls_have_the_distance_of_their_centres(tmp_path: Path) -> None:
    collisions = build_arm(tmp_path, [BALL, BALL, BALL]).collisions
    assert collisions.pairs == (("link0", "link2"),)  # the others are neighbours
    q = np.random.default_rng(7).uniform(-3, 3, (200, 2))
    found = collisions.distance(q)
    centres = np.array([place_balls(position) for position in q])
    np.testing.assert_allclose(found.distance, np.linalg.norm(centres[:, 2], axis=1) - 0.2, atol=1e-9)
    np.testing.assert_array_equal(collisions.check_free(q), found.distance > 0)
    np.testing.assert_allclose(collisions.pair_distances(q)[:, 0], found.distance, atol=1e-12)
    # The nearest points lie on the line between the centres, each on its ball, in the order of the pair.
    toward = centres[:, 2] / np.linalg.norm(centres[:, 2], axis=1)[:, None]
    np.testing.assert_allclose(found.points[:, 0, :2], 0.1 * toward, atol=1e-6)
    np.testing.assert_allclose(found.points[:, 1, :2], centres[:, 2] - 0.1 * toward, atol=1e-6)
    np.testing.assert_allclose(found.gradient, differentiate(collisions, q), atol=1e-6)
    one = collisions.distance(q[0])
    assert one.pair == ("link0", "link2")
    assert one.distance == found.distance[0]
    assert isinstance(collisions.check_free(q[0]), bool)


SOLIDS = {
    "sphere": oc.obstacles.Sphere([0.3, 1.9, 0.1], 0.3),
    "capsule": oc.obstacles.Capsule([0.3, 1.9, -1.0], [0.5, 1.7, 1.0], 0.2),
    "plane": oc.obstacles.Plane([0.1, -1.0, 0.2], [0.0, 2.2, 0.0]),
    "box": oc.obstacles.Box([0.4, 0.3, 0.2], [0.2, 1.9, 0.1], pin.utils.rotate("z", 0.4)),
    "mesh": oc.obstacles.Mesh(np.random.default_rng(1).normal(size=(40, 3)) * 0.2, [0.3, 1.9, 0.0]),
    "cloud": oc.obstacles.PointCloud(np.random.default_rng(1).normal(size=(300, 3)) * 0.1 + [0.3, 1.9, 0.0], 0.05),
}


def measure_from(kind: str, point: Array) -> float:
    """Distance of a point (3,) from a solid of SOLIDS, by NumPy alone."""
    solid = SOLIDS[kind]
    if isinstance(solid, oc.obstacles.Sphere):
        return float(np.linalg.norm(point - solid.centre) - solid.radius)
    if isinstance(solid, oc.obstacles.Capsule):
        along = solid.end - solid.start
        s = np.clip((point - solid.start) @ along / (along @ along), 0, 1)
        return float(np.linalg.norm(point - solid.start - s * along) - solid.radius)
    if isinstance(solid, oc.obstacles.Plane):
        return float((point - solid.point) @ solid.normal)
    if isinstance(solid, oc.obstacles.Box):
        inside = solid.rotation.T @ (point - solid.centre)
        return float(np.linalg.norm(np.maximum(np.abs(inside) - solid.size / 2, 0.0)))
    assert isinstance(solid, oc.obstacles.PointCloud)
    centres = (np.floor(solid.points / solid.cell) + 0.5) * solid.cell
    return float(np.linalg.norm(np.maximum(np.abs(point - centres) - solid.cell / 2, 0.0), axis=1).min())


@pytest.mark.parametrize("kind", SOLIDS)
def test_distances_from_scenes_have_closed_forms_and_gradients(kind: str, tmp_path: Path) -> None:
    robot = build_arm(tmp_path, ["", "", BALL])
    collisions = Collisions(robot.tree, robot.with_solids(tmp_path / "arm.urdf").collisions.parts, ())
    around = collisions.with_scene(oc.Scene({"thing": SOLIDS[kind]}))
    assert around.pairs == (("link2", "thing"),)
    q = np.random.default_rng(3).uniform(0.2, 1.4, (200, 2))
    found = around.distance(q)
    apart = found.distance > 1e-3
    assert apart.sum() > 50
    if kind != "mesh":
        points = np.array([np.append(place_balls(position)[2], 0.0) for position in q])
        expected = np.array([measure_from(kind, point) for point in points]) - 0.1
        np.testing.assert_allclose(found.distance[apart], expected[apart], atol=1e-7)
    # The first point is that of the link, the second that of the object.
    gap = np.linalg.norm(found.points[:, 1] - found.points[:, 0], axis=1)
    np.testing.assert_allclose(gap[apart], found.distance[apart], atol=1e-6)
    ball = np.array([np.append(place_balls(position)[2], 0.0) for position in q[apart]])
    np.testing.assert_allclose(np.linalg.norm(found.points[apart, 0] - ball, axis=1), 0.1, atol=1e-6)
    errors = np.abs(found.gradient - differentiate(around, q)).max(axis=1)[apart]
    # Nearest points jump between the cubes of a cloud, where no gradient is right.
    assert np.quantile(errors, 0.95) < 1e-4
    assert np.quantile(errors, 0.5) < 1e-6


def test_depths_of_balls_in_cylinders_have_a_closed_form(tmp_path: Path) -> None:
    """A ball whose centre is inside: out through the curved face or the nearer end, whichever is shorter."""
    robot = build_arm(tmp_path, ["", BALL, '<cylinder radius="0.5" length="0.6"/>'])
    turn = oc.obstacles.Sphere([0.0, 0.0, 0.1], 0.2)
    around = Collisions(robot.tree, robot.collisions.parts, ()).with_scene(oc.Scene({"ball": turn}))
    q = np.random.default_rng(4).uniform(-3.1, 3.1, (400, 2))
    centres = np.array([place_balls(position)[2] for position in q])
    across, along = np.linalg.norm(centres, axis=1) - 0.5, 0.1 - 0.3
    depth = np.minimum(np.maximum(across, along), 0.0) + np.maximum(across, 0.0) - 0.2
    found = around.pair_distances(q)[:, around.pairs.index(("link2", "ball"))]
    assert (across < along).any()
    assert (across > along).any()
    np.testing.assert_allclose(found, depth, atol=2e-6)


def test_attached_solids_move_with_their_link(tmp_path: Path) -> None:
    robot = build_arm(tmp_path, [BALL, BALL, BALL])
    held = {"box": oc.obstacles.Sphere([1.0, 0.0, 0.0], 0.05)}
    collisions = robot.collisions.with_attached("link2", held)
    assert collisions.pairs == (("link0", "link2"), ("link0", "box"), ("link1", "box"))
    q = np.array([0.3, 2.8])
    position = robot.frame_position(q, "link2") + robot.frame_rotation(q, "link2") @ [1.0, 0.0, 0.0]
    distances = dict(zip(collisions.pairs, collisions.pair_distances(q), strict=True))
    assert distances["link0", "box"] == pytest.approx(np.linalg.norm(position) - 0.15, abs=1e-9)
    allowed = robot.collisions.with_attached("link2", held, allowed=[("box", "link1")])
    assert allowed.pairs == (("link0", "link2"), ("link0", "box"))
    # Further objects are checked against what is held, too.
    table = oc.Scene({"table": oc.obstacles.Plane([0, 1, 0], [0, -2, 0])})
    assert ("box", "table") in allowed.with_scene(table).pairs
    with pytest.raises(UnknownNameError, match="link or object"):
        allowed.with_scene(table, allowed=[("box", "tabel")])
    with pytest.raises(InvalidValueError, match="name is 'box'|name is box"):
        allowed.with_attached("link2", held)


def build_directly(path: Path, pairs: tuple[tuple[str, str], ...]) -> tuple[pin.Model, pin.GeometryModel]:
    """Pinocchio's own model of a URDF file, with meshes as hulls and the same pairs of links."""
    model = pin.buildModelFromUrdf(str(path))
    geometry = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION, [str(path.parents[4])])
    for solid in geometry.geometryObjects:
        if isinstance(solid.geometry, coal.BVHModelBase):
            vertices = np.array(solid.geometry.vertices())
            solid.geometry = hull_of(vertices)
    names = [model.frames[solid.parentFrame].name for solid in geometry.geometryObjects]
    for first, second in pairs:
        for i in [k for k, name in enumerate(names) if name == first]:
            for j in [k for k, name in enumerate(names) if name == second]:
                geometry.addCollisionPair(pin.CollisionPair(i, j))
    return model, geometry


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "name", "tip"), [("xarm", "xarm7", "link_eef"), ("panda", "panda", "panda_hand")])
@pytest.mark.filterwarnings("ignore:You passed package dir")
def test_distances_are_those_of_coal_called_directly(folder: str, name: str, tip: str) -> None:
    path = robot_data(f"{folder}_description/urdf/{name}.urdf")
    robot = oc.Robot.from_urdf(path, tip)
    collisions = robot.collisions
    assert collisions.origin == f"from {name}.srdf"
    assert not collisions.missing
    model, geometry = build_directly(path, collisions.pairs)
    data, placed = model.createData(), geometry.createData()
    q = robot.sample(500, seed=7)
    expected = []
    for position in q:
        pin.computeDistances(model, data, geometry, placed, np.append(position, np.zeros(model.nq - 7)))
        expected.append(min(result.min_distance for result in placed.distanceResults))
    found = collisions.distance(q)
    # coal's own tolerance is 1e-6, and tighter in ours for separate solids.
    np.testing.assert_allclose(found.distance, expected, atol=5e-6)
    np.testing.assert_array_equal(collisions.check_free(q), np.array(expected) > 0)
    assert 0.02 < np.mean(found.distance <= 0) < 0.15
    np.testing.assert_allclose(collisions.pair_distances(q).min(axis=1), found.distance, atol=2e-6)
    apart = found.distance > 1e-3
    errors = np.abs(found.gradient - differentiate(collisions, q, 1e-5))[apart].max(axis=1)
    # At few postures two pairs are as near as each other, and the least distance has a kink.
    assert np.quantile(errors, 0.98) < 1e-5
    # Bounds that leave pairs out are below the distances.
    bounds = collisions._bound_distances(q)
    for k, owner in enumerate(collisions._owners):
        alone = Collisions(
            robot.tree, [collisions.parts[i] for i in collisions._pair_parts[k]], [collisions.pairs[owner]]
        )
        assert (bounds[:50, k] <= alone.pair_distances(q[:50])[:, 0] + 1e-9).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:You passed package dir")
def test_pairs_of_an_srdf_file_are_those_of_pinocchio() -> None:
    path = robot_data("panda_description/urdf/panda.urdf")
    srdf = robot_data("panda_description/srdf/panda.srdf")
    collisions = oc.Robot.from_urdf(path, "panda_hand").collisions
    model, geometry = build_directly(path, ())
    geometry.addAllCollisionPairs()
    pin.removeCollisionPairs(model, geometry, str(srdf))
    names = [model.frames[solid.parentFrame].name for solid in geometry.geometryObjects]
    bodies = {part.name: part.body for part in collisions.parts}
    theirs = {frozenset((names[pair.first], names[pair.second])) for pair in geometry.collisionPairs}
    # Fingers that are locked move with the hand.
    assert {frozenset(pair) for pair in collisions.pairs} == {
        pair for pair in theirs if len({bodies[name] for name in pair}) == 2
    }


def test_files_say_which_pairs_are_checked_and_what_is_missing(tmp_path: Path) -> None:
    robot = build_arm(tmp_path, [BALL, BALL, BALL, '<mesh filename="lost.stl"/>'])
    assert robot.collisions.missing == ("link3",)
    assert "unchecked" in robot.collisions.facts()
    # Disabled pairs of an SRDF file beside the URDF file; all others are checked, neighbours too.
    disabled = '<disable_collisions link1="link0" link2="link1" reason="Adjacent"/>'
    (tmp_path / "arm.srdf").write_text(f'<robot name="arm">{disabled}</robot>')
    again = oc.Robot.from_urdf(tmp_path / "arm.urdf", "link3")
    assert again.collisions.pairs == (("link0", "link2"), ("link1", "link2"))
    # Or one that is named.
    other = tmp_path / "other.srdf"
    other.write_text('<robot name="arm"><disable_collisions link1="link0" link2="link2"/></robot>')
    named = robot.with_solids(tmp_path / "arm.urdf", other)
    assert named.collisions.origin == "from other.srdf"
    assert named.collisions.pairs == (("link0", "link1"), ("link1", "link2"))
    # A link that never comes near another one is left out.
    far = build_arm(tmp_path, [BALL, "", BALL], limit=0.5)
    (tmp_path / "arm.srdf").unlink()
    assert far.collisions.pairs == ()
    assert far.collisions.distance([0.1, 0.1]).distance == np.inf
    assert far.collisions.check_free([0.1, 0.1]) is True


def test_robots_without_solids_say_so(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="the links have no solids.*with_solids"):
        _ = oc.Robot.planar([1.0], [1.0]).collisions
    robot = build_arm(tmp_path, ["", '<mesh filename="lost.stl"/>'])
    with pytest.raises(RobotError, match="no mesh of link1"):
        _ = robot.collisions
    with pytest.raises(RobotError, match="has the joints q1, expected q2 among them"):
        _ = oc.Robot.planar([1.0, 1.0], [1.0, 1.0]).with_solids(tmp_path / "arm.urdf").collisions
    flat = build_arm(tmp_path, ["", '<box size="1 0 1"/>'])
    with pytest.raises(RobotError, match="<box> of a collision element has no size"):
        _ = flat.collisions
    with pytest.raises(InvalidValueError, match="solid 'x'"):
        oc.Scene({"x": 3})  # type: ignore[dict-item]
    with pytest.raises(InvalidValueError, match="span no volume"):
        oc.obstacles.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])


def test_rates_bound_how_fast_distances_change(tmp_path: Path) -> None:
    """What conservative advancement rests on, for one joint at a time and for all."""
    link = '<box size="0.3 0.05 0.1"/>'
    robot = build_arm(tmp_path, [link, link, link, link])
    pairs = [("link0", "link2"), ("link0", "link3"), ("link1", "link3")]
    collisions = Collisions(robot.tree, robot.collisions.parts, pairs)
    rng = np.random.default_rng(11)
    q = rng.uniform(-3, 3, (400, 3))
    moves = rng.normal(size=q.shape) * rng.choice([1e-3, 0.05, 0.5], size=(400, 1))
    moves[:200] *= np.eye(3)[rng.integers(3, size=200)]
    change = np.abs(collisions.pair_distances(q + moves) - collisions.pair_distances(q))
    bound = np.abs(moves) @ collisions.rates.T
    # Overlaps are known to 1e-6 m.
    assert (change <= bound + 5e-6).all()
    assert (change > 0.5 * bound).any()
    # A joint that carries both of a pair moves neither against the other.
    assert not collisions.rates[pairs.index(("link1", "link3")), 0]


@pytest.mark.slow
def test_bounds_leave_out_no_pair_of_many() -> None:
    """Of 277 pairs few are evaluated; evaluating all gives the same."""
    collisions = oc.Robot.from_urdf(robot_data("baxter_description/urdf/baxter.urdf"), "left_gripper").collisions
    q = oc.Robot(collisions.tree).sample(300, seed=5)
    every = collisions.pair_distances(q)
    assert every.shape[1] > 200
    np.testing.assert_allclose(collisions.distance(q).distance, every.min(axis=1), atol=2e-6)
    np.testing.assert_array_equal(collisions.check_free(q), every.min(axis=1) > 0)
    for position, row in zip(q[:20], every, strict=False):
        assert set(collisions.find_near(position, 0.2).pairs) == {
            collisions.pairs[k] for k in np.flatnonzero(row < 0.2)
        }


@pytest.mark.slow
def test_ways_between_postures_hide_no_contact(tmp_path: Path) -> None:
    """A post of 2 mm, which no posture of the way touches: dense samples are the second route."""
    robot = build_arm(tmp_path, ["", '<box size="0.3 0.05 0.05"/>', '<box size="0.3 0.02 0.02"/>'])
    bare = robot.collisions
    rng = np.random.default_rng(5)
    touched = 0
    for _ in range(60):
        way = np.cumsum(rng.uniform(-0.7, 0.7, (4, 2)), axis=0)
        centre = place_balls(way[1:3].mean(axis=0))[rng.integers(1, 3)] + rng.normal(size=2) * 0.15
        post = oc.obstacles.Capsule([*centre, -1.0], [*centre, 1.0], 0.001)
        around = bare.with_scene(oc.Scene({"post": post}))
        contact = around.find_contact(way)
        s = np.linspace(0, 3, 6001)
        dense = np.column_stack([np.interp(s, np.arange(4), column) for column in way.T])
        hits = np.flatnonzero(~around.check_free(dense))
        if contact is None:
            assert not hits.size
            continue
        touched += 1
        assert "post" in contact.pair
        # It is the first one, up to a way on which the bound cannot tell.
        place = contact.segment + contact.fraction
        least = around.distance(dense).distance.min()
        assert hits.size or least < 1e-4
        assert not hits.size or place <= s[hits[0]] + 1e-9
        assert (
            around.distance(
                (1 - contact.fraction) * way[contact.segment] + contact.fraction * way[contact.segment + 1]
            ).distance
            < 2e-6
        )
    assert 10 < touched < 55
    assert bare.find_contact(np.zeros((1, 2))) is None


def post_across(robot: oc.Robot, q: Array) -> Collisions:
    """A scene with a thin post where the last link comes by when its joint turns from q."""
    turned = q + np.array([0.0, 0.0, 0.3])
    place = robot.frame_position(turned, "link3") + 0.8 * robot.frame_rotation(turned, "link3")[:, 0]
    post = oc.obstacles.Capsule([*place[:2], -1.0], [*place[:2], 1.0], 0.002)
    return robot.collisions.with_scene(oc.Scene({"post": post}))


@pytest.fixture
def planar(tmp_path: Path) -> tuple[oc.Chart, Callable[[], oc.Robot]]:
    """A linear chart of a planar arm whose last joint alone does not move the task, and its robot."""
    link = '<box size="0.3 0.04 0.04"/>'
    robot = build_arm(tmp_path, ["", link, link, link])
    task = oc.Task.position(robot, axes="xy")
    problem = oc.Problem(robot, task, "euclidean", oc.Box([0.6, 0.8, 0.8], 0.5))
    return oc.fit(problem, oc.Linear(), samples=300).chart, lambda: robot


def test_ranges_and_self_motions_end_at_contacts(planar: tuple[oc.Chart, Callable[[], oc.Robot]]) -> None:
    chart, robot = planar[0], planar[1]()
    q = np.array([0.6, 0.8, 0.8])
    around = post_across(robot, q)
    plain = chart.self_motion(q)
    motion = chart.self_motion(q, collisions=around)
    stops = (motion.extent[0].low_stop, motion.extent[0].high_stop)
    hit = next(stop for stop in stops if stop.kind is StopKind.CONTACT)
    assert "'post'" in str(hit)
    assert "contact of" in hit.brief
    assert np.ptp(motion.q[:, 2]) < np.ptp(plain.q[:, 2]) - 0.1
    assert around.distance(motion.q).distance.min() > -1e-4
    found = chart.xi_range(q, collisions=around)["xi1"]
    assert StopKind.CONTACT in (found.low_stop.kind, found.high_stop.kind)
    assert found.low >= chart.xi_range(q)["xi1"].low - 1e-9
    assert found.high <= chart.xi_range(q)["xi1"].high + 1e-9
    # Both ends are where the pair touches.
    end = motion.q[0] if stops[0].kind is StopKind.CONTACT else motion.q[-1]
    assert abs(around.distance(end).distance) < 1e-6
    inside = robot.collisions.with_scene(oc.Scene({"ball": oc.obstacles.Sphere([0, 0, 0], 3.0)}))
    with pytest.raises(InvalidValueError, match="a posture without a contact of 'link. and 'ball'|without a contact"):
        chart.xi_range(q, collisions=inside)


def test_evaluations_count_postures_that_touch(planar: tuple[oc.Chart, Callable[[], oc.Robot]]) -> None:
    chart, robot = planar[0], planar[1]()
    wall = oc.Scene({"wall": oc.obstacles.Plane([-1.0, 0.0, 0.0], [1.2, 0.0, 0.0])})
    around = robot.collisions.with_scene(wall)
    report = oc.evaluate(chart, samples=2000, collisions=around)
    contacts = report.contacts
    assert contacts is not None
    assert 0 < contacts.fraction < 1
    assert "wall" in contacts.pair
    free = around.check_free(chart.problem.domain.sample(5000, 9))
    assert contacts.fraction == pytest.approx(1 - free.mean(), abs=0.04)
    assert "collisions" in report.facts()
    assert report.as_dict()["contacts"]["touching"] == contacts.touching
    assert oc.evaluate(chart, samples=2000).contacts is None
    other = build_other(around)
    with pytest.raises(InvalidValueError, match="collisions is those of a robot|collisions"):
        oc.evaluate(chart, samples=2000, collisions=other)


def build_other(collisions: Collisions) -> Collisions:
    """The same solids on an arm with other joints."""
    return Collisions(oc.Robot.planar([2.0, 1.0, 1.0], [1.0, 1.0, 1.0]).tree, collisions.parts, ())


def test_paths_that_touch_between_samples_are_refused(planar: tuple[oc.Chart, Callable[[], oc.Robot]]) -> None:
    chart, robot = planar[0], planar[1]()
    q = np.array([0.6, 0.8, 0.8])
    path = chart.x(q) + np.linspace(0, 1, 9)[:, None] * np.array([-0.25, 0.1])
    options = {"q_start": q, "velocity_limits": 1.0}
    motion = oc.follow(chart, path, **options)
    k = len(motion.q) // 2
    place = robot.frame_position(motion.q[k], "link3") + 0.8 * robot.frame_rotation(motion.q[k], "link3")[:, 0]
    around = robot.collisions.with_scene(
        oc.Scene({"post": oc.obstacles.Capsule([*place[:2], -1.0], [*place[:2], 1.0], 0.001)})
    )
    assert around.check_free(motion.q[0])
    with pytest.raises(PathError, match=r"at \d.\d+ s 'link\d' and 'post' (touch|come to)"):
        oc.follow(chart, path, **options, collisions=around)
    kept = oc.follow(chart, path, **options, collisions=robot.collisions)
    np.testing.assert_array_equal(kept.q, motion.q)
    far = robot.collisions.with_scene(oc.Scene({"ball": oc.obstacles.Sphere([5.0, 0, 0], 0.5)}))
    oc.follow(chart, path, **options, collisions=far, clearance=0.01)
    with pytest.raises(PathError, match="clearance = 4 m"):
        oc.follow(chart, path, **options, collisions=far, clearance=4.0)


def test_collisions_travel(tmp_path: Path) -> None:
    robot = build_arm(tmp_path, [BALL, BALL, BALL])
    scene = oc.Scene({**SOLIDS})
    around = robot.collisions.with_scene(scene)
    q = robot.sample(20, seed=2)
    before = around.distance(q)
    after = pickle.loads(pickle.dumps(around)).distance(q)
    np.testing.assert_allclose(after.distance, before.distance, atol=2e-6)
    assert pickle.loads(pickle.dumps(scene)).names == scene.names
    assert pickle.loads(pickle.dumps(robot)).collisions.pairs == robot.collisions.pairs
    tool = robot.with_tool([0.1, 0.0, 0.0]).with_payload(0.2)
    assert tool.collisions.pairs == robot.collisions.pairs


TWO_ARMS = """<robot name="two"><link name="base"/>{parts}</robot>"""
ARM_LINK = """<link name="{side}{k}"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0.25 0 0"/><geometry><box size="0.3 0.05 0.05"/></geometry></collision></link>
<joint name="{side}q{k}" type="revolute"><origin xyz="{at} 0"/><parent link="{parent}"/><child link="{side}{k}"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>"""
HAND = """<link name="{side}hand"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="{side}fix" type="fixed"><origin xyz="0.5 0 0"/><parent link="{side}3"/><child link="{side}hand"/>
</joint>"""


@pytest.mark.slow
def test_a_box_in_both_hands_moves_with_them_and_hits_what_is_around(tmp_path: Path) -> None:
    """The left hand carries it, the right hand may touch it; coordinates of both arms keep it between the hands."""
    parts = []
    for side, x in (("l", -0.3), ("r", 0.3)):
        for k in (1, 2, 3):
            at = f"{x} 0" if k == 1 else "0.5 0"
            parts.append(ARM_LINK.format(side=side, k=k, at=at, parent="base" if k == 1 else f"{side}{k - 1}"))
        parts.append(HAND.format(side=side))
    path = tmp_path / "two.urdf"
    path.write_text(TWO_ARMS.format(parts="".join(parts)))
    robot = oc.Robot.from_urdf(path, tips=["lhand", "rhand"])
    q = np.array([2.2, -1.2, -1.0, 0.9416, 1.2, 1.0])
    across = robot.frame_position(q, "rhand", "lhand")
    carton = {"carton": oc.obstacles.Sphere(across / 2, np.linalg.norm(across) / 2 - 0.05)}
    # both hands touch the carton, and no pair with them is checked
    held = robot.collisions.with_attached("lhand", carton, allowed=[("carton", "rhand")])
    assert ("rhand", "carton") not in held.pairs
    assert ("r1", "carton") in held.pairs
    free = robot.collisions.with_attached("lhand", carton)
    gap = free.pairs.index(("rhand", "carton"))
    assert free.pair_distances(q)[gap] == pytest.approx(0.0, abs=1e-9)
    # coordinates that keep the right hand where it is in the left one carry the carton, and it stays between them
    task = oc.Task.relative_position(robot, "lhand", "rhand", "xy")
    chart = oc.fit(oc.Problem(robot, task, domain=oc.Box(q, 0.25)), oc.Polynomial(3)).chart
    goal = chart.phi(q) + np.array([0.0, 0.0, 0.05, -0.05, 0.04, 0.03])
    moved = chart.inverse(goal, q)
    centre = (robot.frame_position(moved, "lhand") + robot.frame_position(moved, "rhand")) / 2
    assert np.linalg.norm(centre - (robot.frame_position(q, "lhand") + robot.frame_position(q, "rhand")) / 2) > 0.01
    assert free.pair_distances(moved)[gap] == pytest.approx(0.0, abs=1e-7)
    # the carton reaches a wall at the end of its way, by 2 mm
    before = (robot.frame_position(q, "lhand") + robot.frame_position(q, "rhand")) / 2
    way = (centre - before) / np.linalg.norm(centre - before)
    reach = np.linalg.norm(across) / 2 - 0.05
    point = centre + (reach - 0.002) * way
    wall = oc.Scene({"wall": oc.obstacles.Sphere(point + 0.2 * way, 0.2)})
    around = held.with_scene(wall)
    assert ("carton", "wall") in around.pairs
    contact = Collisions(around.tree, around.parts, [("carton", "wall")]).find_contact(np.linspace(q, moved, 20))
    assert contact is not None
    assert contact.segment > 15


def test_discs_of_many_corners_are_solids_with_the_distances_of_a_prism() -> None:
    """coal counts up to 255 neighbours of a corner; Qhull would give one corner of each face 598."""
    turns = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    ring = np.column_stack([np.cos(turns), np.sin(turns)])
    disc = HullGeometry.around(np.vstack([np.column_stack([ring, np.full(600, z)]) for z in (-0.1, 0.1)]))
    assert len(disc.points) == 1200
    assert np.bincount(disc.faces.ravel()).max() < 40
    # the faces close: as many edges, two sides each, as Euler's formula asks for
    edges = np.sort(np.vstack([disc.faces[:, [0, 1]], disc.faces[:, [1, 2]], disc.faces[:, [2, 0]]]), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    assert len(disc.points) - len(edges) / 2 + len(disc.faces) == 2
    built, ball = disc.build(), coal.Sphere(0.2)
    for place, expected in [((0.3, 0.2, 1.0), 0.7), ((2.0, 0.0, 0.05), 0.8), ((0.0, -3.0, 0.0), 1.8)]:
        answer = coal.DistanceResult()
        coal.distance(
            built,
            coal.Transform3s(),
            ball,
            coal.Transform3s(np.eye(3), np.array(place)),
            coal.DistanceRequest(),
            answer,
        )
        assert answer.min_distance == pytest.approx(expected, abs=1e-5)
