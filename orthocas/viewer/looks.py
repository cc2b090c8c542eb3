"""Appearance of robots: meshes of a URDF file, or drums and rods made from the kinematic tree."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import scipy

from orthocas.errors import RobotError
from orthocas.robots.collision_files import load_mesh, place_links, read_numbers, read_pose
from orthocas.robots.kinematics import build_body_poses, build_tip_pose
from orthocas.robots.robot import Robot
from orthocas.robots.spatial import rotate_z_to
from orthocas.robots.tree import KinematicTree
from orthocas.robots.urdf import read_urdf_xml
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array, Indices, as_path

Colour = tuple[int, int, int]  #: red, green, blue, 0 to 255


@dataclass(frozen=True, slots=True)
class ViewRules:
    """Numbers of views. Lengths without a unit are fractions of the length of the arm."""

    facets: int = 16  #: facets around an axis
    ghost_facets: int = 6
    shell: Colour = (226, 229, 233)
    joint: Colour = (72, 80, 92)
    tool: Colour = (214, 96, 20)
    rod: float = 0.042  #: radius of the first rod
    taper: float = 0.45  #: fraction of the radius that is lost on the way to the tip
    shortest_rod: float = 0.35  #: in radii; shorter rods are left out
    triangles: int = 20_000  #: most triangles of an arm in a picture
    mesh_triangles: int = 500  #: each mesh keeps at least this many triangles
    most_triangles: int = 3_000_000  #: most triangles of all meshes; more are slow to send and to draw
    ghosts: int = 7  #: number of arms in a fan
    ghost_thickness: float = 0.32  #: thickness relative to the arm's
    low: Colour = (24, 92, 214)  #: colours along a coordinate
    centre: Colour = (64, 168, 116)
    high: Colour = (245, 118, 10)
    trace: float = 0.004  #: thickness of a line
    same_place: float = 0.3  #: labels nearer than this fraction of the curve's extent are merged

    most_instants: int = 1_000_000  #: most instants of a motion file
    cycle: float = 5.0  #: duration of a closed path [s]
    cycle_points: int = 250
    most_cycles: int = 20
    circle: float = 0.6  #: radius of the default path, as a fraction of the task's range over the domain
    smallest_circle: float = 1e-3
    corrections: int = 2  #: corrections of the pseudo-inverse at each point
    same_ends: float = 1e-9  #: largest gap between the ends of a closed path, in sizes of the task

    tracker_steps: int = 200  #: largest number of tracker steps towards one target
    shortest_step: float = 1e-4  #: fraction of the way to a target below which the tracker is stuck
    reached: float = 1e-10  #: tolerance of a target, in sizes of the components
    most_undone: int = 100

    small_angle: float = 0.001  #: [deg]
    slider_step: float = 1e-3
    reach_steps: int = 8  #: steps per size of a task component, to find its range
    missed: float = 1e-6  #: in sizes of the components; a target missed by more is not reached
    reach_sizes: float = 2.0  #: largest range of a slider, in sizes of the component
    endless: float = float(np.pi)  #: half of a slider without limits [rad] or [m]
    handle: float = 0.17  #: length of arrows at the tool, as a fraction of the chain's length
    rings: float = 0.13  #: radius of rings at the tool
    sweep: float = 6.0  #: duration of a sweep there and back [s]
    sweep_range: float = 0.97  #: fraction of the range that a sweep uses
    most_recorded: int = 100_000  #: most joint positions of a recording, about an hour
    reading_pause: float = 0.1  #: [s] between readings during a sweep, because they take longer than a picture

    plot_points: int = 400  #: points of a line in a plot
    #: colours of lines in a plot: eight that colour-blind people can also distinguish (Okabe and Ito)
    plot_colours: tuple[str, ...] = (
        *("#0072b2", "#e69f00", "#009e73", "#cc79a7"),
        *("#d55e00", "#56b4e9", "#000000", "#b8a800"),
    )
    path_colours: tuple[Colour, ...] = ((31, 95, 168), (217, 95, 2), (27, 158, 119))
    path_points: int = 2000  #: most points of a tool path
    apart: float = 0.9  #: distance of arms side by side
    time_step: float = 0.01  #: step of the time slider [s]
    rate: int = 30  #: recorded pictures per second
    recorded_sweep: float = 5.0  #: duration of the recorded sweep of one coordinate [s]
    recorded_length: float = 120.0  #: longer motions are recorded faster [s]

    far_links: float = 0.3  #: distance of a full bar [m]
    near_links: float = 0.1  #: amber below this distance [m]
    close_links: float = 0.02  #: bar and pair red below this distance [m]
    link_line: float = 0.004  #: thickness of the line between nearest points [m]
    touching: Colour = (214, 69, 69)
    solid: Colour = (150, 158, 168)

    brand: Colour = (31, 95, 168)
    panel_widths: tuple[int, int] = (320, 300)  #: widths of the panels of readings and sliders [px]
    view_angle: float = 0.7  #: of the camera [rad]
    room: float = 1.15  #: margin around the arms in the picture
    #: largest displacement of a camera that still counts as placed, as a fraction of its distance
    camera_slack: float = 1e-3
    camera_pause: float = 0.5  #: [s] a camera may need to reach its place
    flat: float = 1e-9  #: extent below which an arm is planar or gravity is zero
    floor: float = 1.5  #: radius of the floor
    fade: float = 0.5  #: fraction of the floor's radius at which its lines begin to fade
    line: float = 0.002  #: thickness of the floor's lines
    grid: tuple[Colour, Colour] = ((205, 210, 217), (228, 231, 235))  #: colours of every fifth line, and of the others

    tick: float = 1 / 30  #: [s] per frame of animations; without a graphics card, browsers cannot draw more often
    quiet: float = 0.25  #: [s] without jobs before the page settles
    silence: float = 1.0  #: [s] without a request before a connection is dropped
    most_files: int = 50  #: most files of a folder that a page lists
    largest_message: int = 2**20  #: largest message from a browser [bytes]; sliders and cameras need hundreds
    message_length: int = 80  #: most characters of a message in a report


RULES = ViewRules()


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles of one colour."""

    vertices: Array  #: (V, 3) in the frame of the body [m]
    faces: Indices  #: (F, 3) indices of vertices, counterclockwise from outside
    colour: Colour

    def move(self, rotation: Array, translation: Array) -> "Solid":
        """The solid turned by a rotation (3, 3), then shifted by a translation (3,)."""
        return replace(self, vertices=self.vertices @ rotation.T + translation)


def join_solids(solids: Sequence[Solid], colour: Colour) -> Solid:
    """Join the triangles of several solids into one solid of one colour."""
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + start for solid, start in zip(solids, first, strict=False)]
    return Solid(np.concatenate([solid.vertices for solid in solids]), np.concatenate(faces), colour)


def build_capsule(
    start: Array, end: Array, radii: tuple[float, float], colour: Colour, facets: int = RULES.facets
) -> Solid:
    """A rod with round ends between two points (3,), with a radius at each end [m]."""
    length = float(np.linalg.norm(end - start))
    low = _build_arc(radii[0], -np.pi / 2, 0.0, facets)
    high = _build_arc(radii[1], 0.0, np.pi / 2, facets) + np.array([0.0, length])
    axis = np.array([0.0, 0.0, 1.0]) if length == 0 else (end - start) / length
    return _revolve(np.concatenate([low, high]), colour, facets).move(rotate_z_to(axis), start)


def build_drum(radius: float, half_height: float, colour: Colour, facets: int = RULES.facets) -> Solid:
    """A cylinder with rounded edges about the z axis, with its centre at the origin."""
    edge = 0.25 * min(radius, half_height)
    lower, upper = _build_arc(edge, -np.pi / 2, 0.0, facets), _build_arc(edge, 0.0, np.pi / 2, facets)
    shift = np.array([radius - edge, half_height - edge])
    rim = np.concatenate([lower + shift * [1, -1], upper + shift])
    return _revolve(np.concatenate([[[0.0, -half_height]], rim, [[0.0, half_height]]]), colour, facets)


def build_block(size: Array, colour: Colour) -> Solid:
    """A box of a size (3,) [m] with its centre at the origin. Faces share no vertices, so that edges look sharp."""
    vertices: list[Array] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            across = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)[:: int(sign)]
            corner = np.insert(across, 0, sign, axis=1)
            faces += [[4 * len(vertices) + k for k in triple] for triple in ((0, 1, 2), (0, 2, 3))]
            vertices.append(np.roll(corner, axis, axis=1))
    return Solid(np.concatenate(vertices) * np.asarray(size) / 2, np.array(faces), colour)


def build_ball(radius: float, colour: Colour, facets: int = RULES.facets) -> Solid:
    """A sphere about the origin."""
    return _revolve(_build_arc(radius, -np.pi / 2, np.pi / 2, facets), colour, facets)


def _build_arc(radius: float, start: float, end: float, facets: int) -> Array:
    """Points (r, z) on an arc about the origin."""
    count = max(round(facets * (end - start) / (2.5 * np.pi)), 1) + 1
    angle = np.linspace(start, end, count)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _revolve(profile: Array, colour: Colour, facets: int) -> Solid:
    """Revolve a profile of points (r, z), from bottom to top, about the z axis."""
    angle = np.linspace(0.0, 2 * np.pi, facets, endpoint=False)
    r, z = profile.T
    ring = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.outer(z, np.ones_like(angle))], axis=-1)
    index = np.arange(len(profile) * facets).reshape(len(profile), facets)
    here, next_ = index, np.roll(index, -1, axis=1)
    lower = np.stack([here[:-1], next_[:-1], next_[1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([here[:-1], next_[1:], here[1:]], axis=-1).reshape(-1, 3)
    return Solid(ring.reshape(-1, 3), np.concatenate([lower, upper]), colour)


Look = list[list[Solid]]  #: solids carried by each frame of `BodyPoses`: base, bodies, tip


def decimate(look: Look, most: int = RULES.triangles) -> Look:
    """The same look with at most about `most` triangles; small solids stay as they are.

    It uses the quadric error metric (package fast-simplification, through trimesh). Without that package, nothing
    changes.
    """
    share = most / max(sum(len(solid.faces) for solids in look for solid in solids), 1)
    if share >= 1 or find_spec("fast_simplification") is None:
        return look
    return [
        [_decimate(solid, max(int(share * len(solid.faces)), RULES.mesh_triangles)) for solid in solids]
        for solids in look
    ]


def _decimate(solid: Solid, count: int) -> Solid:
    """Simplify a solid to about `count` triangles."""
    # trimesh takes half a second to import, and only meshes of robot files need it.
    import trimesh

    if len(solid.faces) <= count:
        return solid
    mesh = trimesh.Trimesh(solid.vertices, solid.faces).simplify_quadric_decimation(face_count=count)
    return replace(solid, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces, dtype=np.intp))


def build_stick_arm(tree: KinematicTree, thickness: float = 1.0, facets: int = RULES.facets) -> Look:
    """Drums about the joint axes and tapered rods between the frames, with a factor on their thickness."""
    look: Look = [[] for _ in range(tree.bodies + 2)]
    # Radii of the rods that begin at the base and at each body, (N + 1,).
    total, run = compute_chain_length(tree), np.zeros(tree.bodies + 1)
    for i in tree.order:
        run[i + 1] = run[tree.parents[i] + 1] + np.linalg.norm(tree.translations[i])
    radii = thickness * RULES.rod * total * (1 - RULES.taper * np.clip(run / total, 0.0, 1.0))
    for i, parent in enumerate(tree.parents):
        r = radii[i + 1]
        # Put a drum about the axis of a revolute joint, or a slim rail along that of a prismatic one.
        size = (0.8 * r, 2.2 * r) if tree.body_kinds[i] == "prismatic" else (1.18 * r, 1.3 * r)
        look[i + 1].append(build_drum(*size, RULES.joint, facets))
        _add_rod(look[parent + 1], tree.translations[i], (radii[parent + 1], r), facets)
    r = radii[tree.tip_parent + 1]
    _add_rod(look[tree.tip_parent + 1], tree.tip_translation, (r, 0.75 * r), facets)
    look[-1].append(build_ball(0.55 * r, RULES.tool, facets))
    # The other tips.
    for frame in map(tree.frame, tree.tips):
        r = radii[frame.parent + 1]
        _add_rod(look[frame.parent + 1], frame.translation, (r, 0.75 * r), facets)
        look[frame.parent + 1].append(build_ball(0.55 * r, RULES.tool, facets).move(np.eye(3), frame.translation))
    if np.linalg.norm(tree.translations[0]) > radii[0]:
        look[0].append(build_drum(1.7 * radii[0], 0.35 * radii[0], RULES.joint, facets))
    return look


def compute_chain_length(tree: KinematicTree) -> float:
    """Length of the longest chain from the base to a tip, through all joint frames [m]."""
    lengths = [1e-3]
    for frame in (tree.tip, *map(tree.frame, tree.tips)):
        steps = [frame.translation, *tree.translations[tree.carriers(frame.parent)]]
        lengths.append(float(sum(np.linalg.norm(step) for step in steps)))
    return max(lengths)


def _add_rod(solids: list[Solid], end: Array, radii: tuple[float, float], facets: int) -> None:
    """Add a rod from the origin of a body to one of its points, unless drums hide it."""
    if np.linalg.norm(end) > RULES.shortest_rod * radii[0]:
        solids.append(build_capsule(np.zeros(3), end, radii, RULES.shell, facets))


@dataclass(frozen=True)
class RobotLook:
    """The appearance of a robot."""

    look: Look  #: empty lists for bodies without solids
    missing: tuple[str, ...] = ()  #: mesh files that cannot be found or read


def build_shape(robot: Robot, robot_file: str | Path | None, locked: Mapping[str, float] | None) -> RobotLook:
    """Appearance of a robot: from its file, or drums and rods if the file shows nothing."""
    sticks = build_stick_arm(robot.tree)
    if robot_file is None:
        return RobotLook(sticks)
    read = read_urdf_look(as_path("robot_file", robot_file), robot.tree, locked)
    bare = bool(read.missing) or not any(read.look)
    look = [part or (sticks[i] if bare else []) for i, part in enumerate(read.look)]
    return RobotLook(decimate([*look[:-1], sticks[-1]]), read.missing)


def read_urdf_look(path: Path, tree: KinematicTree, locked: Mapping[str, float] | None = None) -> RobotLook:
    """Solids of all links of a URDF file, on the bodies of a robot that was built from it.

    Joints outside the chain are locked as in `Robot.from_urdf`, so their links are shown too.

    Args:
        path: the URDF file.
        tree: the robot.
        locked: joints that were locked when the robot was built, with their positions [rad] or [m].

    Raises:
        RobotError: if the file cannot be read, or its joints are not those of the robot.
    """
    root = read_urdf_xml(path)
    links = root.findall("link")
    places = place_links(path, tree, [link.get("name", "") for link in links], locked)
    colours = {
        material.get("name", ""): colour
        for material in root.iter("material")
        if (colour := _read_colour(material)) is not None and material.get("name")
    }
    look: Look = [[] for _ in range(tree.bodies + 2)]
    missing: list[str] = []
    for link, carrier in zip(links, places, strict=True):
        for visual in link.findall("visual"):
            solid = _build_solid(path, visual, colours, missing)
            if solid is not None:
                place = carrier.pose * read_pose(visual)
                look[carrier.body + 1].append(solid.move(place.rotation, place.translation))
    triangles = sum(len(solid.faces) for solids in look for solid in solids)
    if triangles > RULES.most_triangles:
        raise RobotError(f"{path} shows {triangles:,} triangles, expected at most {RULES.most_triangles:,}")
    return RobotLook(look, tuple(missing))


def _read_colour(material: ElementTree.Element) -> Colour | None:
    """The colour that a material element itself defines; None if it has none."""
    element = material.find("color")
    if element is None:
        return None
    red, green, blue, *_ = (
        round(255 * value) for value in np.clip(read_numbers(element, "rgba", 4, (1, 1, 1, 1)), 0, 1)
    )
    return red, green, blue


def _build_solid(
    path: Path, visual: ElementTree.Element, colours: Mapping[str, Colour], missing: list[str]
) -> Solid | None:
    """The geometry of a visual element in its own frame; None if it has none."""
    # The colour is the element's own, that of a named material, or the default.
    material = visual.find("material")
    colour = RULES.shell
    if material is not None:
        colour = _read_colour(material) or colours.get(material.get("name", ""), RULES.shell)
    shape = next(iter(visual.find("geometry") if visual.find("geometry") is not None else ()), None)  # type: ignore[arg-type]
    # Build the shapes of URDF; other shapes are not shown.
    if shape is None:
        return None
    if shape.tag == "box":
        return build_block(read_numbers(shape, "size", 3, (0.1, 0.1, 0.1)), colour)
    if shape.tag == "sphere":
        return build_ball(float(read_numbers(shape, "radius", 1, (0.1,))[0]), colour)
    if shape.tag == "cylinder":
        radius, length = (float(read_numbers(shape, name, 1, (0.1,))[0]) for name in ("radius", "length"))
        return build_drum(radius, length / 2, colour)
    if shape.tag == "mesh":
        try:
            return Solid(*load_mesh(path, shape), colour)
        except ValueError:
            missing.append(shape.get("filename", ""))
    return None


class BodyPoses:
    """Poses in the world of the base, of each body and of the tip frame: N + 2 frames in this order."""

    def __init__(self, tree: KinematicTree) -> None:
        q = ca.SX.sym("q", tree.n)
        base = (ca.SX.eye(3), ca.SX.zeros(3))
        poses = [base, *build_body_poses(tree, q), build_tip_pose(tree, q)]
        self._batched = Batched(dense_function("poses", [q], [ca.horzcat(*(ca.horzcat(R, p) for R, p in poses))]))

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """Positions (K, N + 2, 3) [m] and unit quaternions w, x, y, z (K, N + 2, 4) at joint positions (K, n)."""
        flat = self._batched(q)[0]
        frames = flat.reshape(len(q), 3, -1, 4).transpose(0, 2, 1, 3)  # (K, N + 2, 3, 4)
        turns = scipy.spatial.transform.Rotation.from_matrix(frames[..., :3].reshape(-1, 3, 3))
        quaternions = turns.as_quat(scalar_first=True).reshape(len(q), -1, 4)
        return np.ascontiguousarray(frames[..., 3]), quaternions


class Arm:
    """An arm in the scene: one skinned mesh for each colour, with the bodies as bones.

    Without a graphics card, drawing time depends on the number of meshes more than on their triangles.

    Args:
        scene: scene of a viser server.
        name: name of its node, such as "/arm".
        robot: the robot.
        look: solids of its bodies.
        shift: position of its base (3,) [m].
    """

    def __init__(self, scene: Any, name: str, robot: Robot, look: Look, shift: Array | None = None) -> None:
        self._poses = BodyPoses(robot.tree)
        self.shift = np.zeros(3) if shift is None else shift
        self._nodes = [scene.add_frame(name, show_axes=False, position=tuple(self.shift))]
        # Make one mesh per colour. Its bones are the bodies.
        self._bones: list[tuple[int, Any]] = []
        colours = dict.fromkeys(solid.colour for solids in look for solid in solids)
        for k, colour in enumerate(colours):
            parts = {i: [solid for solid in solids if solid.colour == colour] for i, solids in enumerate(look)}
            solids = {i: join_solids(part, colour) for i, part in parts.items() if part}
            mesh, count = join_solids(list(solids.values()), colour), len(solids)
            weights = np.repeat(np.eye(count), [len(solid.vertices) for solid in solids.values()], axis=0)
            handle = scene.add_mesh_skinned(
                f"{name}/{k}", mesh.vertices, mesh.faces, skin_weights=weights, color=mesh.colour, side="double",
                bone_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), bone_positions=np.zeros((count, 3)),
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._nodes.insert(0, handle)
            self._bones += zip(solids, handle.bones, strict=True)

    def remove(self) -> None:
        """Remove it from the scene."""
        for node in self._nodes:
            node.remove()

    def show(self, q: Array) -> None:
        """Move to a joint position (n,)."""
        positions, quaternions = self._poses(q[None])
        for body, bone in self._bones:
            bone.position, bone.wxyz = positions[0, body], quaternions[0, body]


class Ghosts:
    """Slim arms at several joint positions, coloured from the first to the last, and lines through their joints."""

    def __init__(self, scene: Any, robot: Robot) -> None:
        self._scene, self._robot = scene, robot
        self._poses = BodyPoses(robot.tree)
        self._look = build_stick_arm(robot.tree, RULES.ghost_thickness, RULES.ghost_facets)[1:]
        self._nodes: list[Any] = []

    def show(self, q: Array, curve: Array, ends: Sequence[str] = ()) -> None:
        """Show arms at joint positions (N, n), lines of their joints along a curve (M, n), and labels at its ends."""
        self.hide()
        positions, quaternions = self._poses(q)
        for k, colour in enumerate(compute_shades(len(q)).tolist()):
            turns = scipy.spatial.transform.Rotation.from_quat(quaternions[k, 1:], scalar_first=True).as_matrix()
            places = zip(self._look, turns, positions[k, 1:], strict=True)
            ghost = join_solids([solid.move(R, p) for solids, R, p in places for solid in solids], tuple(colour))
            node = self._scene.add_mesh_simple(
                f"/ghosts/{k}", ghost.vertices, ghost.faces, color=ghost.colour, opacity=0.55, side="front",
                flat_shading=False, cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._nodes.append(node)
        # Draw the lines of joints that move.
        points = self._robot.joint_points(curve)  # (M, joints, 3)
        size = float(np.ptp(points.reshape(-1, 3), axis=0).max())
        moving = points[:, np.ptp(points, axis=0).max(axis=1) > 0.03 * size]
        if moving.size:
            colours = np.repeat(compute_shades(len(curve))[:, None], moving.shape[1], axis=1)
            lines = np.stack([moving[:-1], moving[1:]], axis=2).reshape(-1, 2, 3)
            shade = np.stack([colours[:-1], colours[1:]], axis=2).reshape(-1, 2, 3)
            thickness = RULES.trace * max(size, 1e-3)
            self._nodes.append(self._scene.add_line_segments("/ghosts/traces", lines, shade, thickness=thickness))
            # Put labels at the joint that moves farthest; merge them if the curve is closed.
            way = points[:, int(np.argmax(np.linalg.norm(np.ptp(points, axis=0), axis=1)))]
            if len(ends) == 2 and np.linalg.norm(way[-1] - way[0]) < RULES.same_place * size:
                ends, way = [f"{ends[0]} and {ends[1]}"], way[:1]
            for k, (text, place) in enumerate(zip(ends, (way[0], way[-1]), strict=False)):
                self._nodes.append(
                    self._scene.add_label(f"/ghosts/end{k}", text, position=tuple(place), anchor="top-center")
                )

    def hide(self) -> None:
        """Remove arms, lines and labels."""
        for node in self._nodes:
            node.remove()
        self._nodes = []


def compute_shades(count: int) -> Array:
    """Colours from low to high values of a coordinate, (count, 3), 0 to 255."""
    share = np.linspace(0.0, 1.0, count)
    return np.column_stack(
        [np.interp(share, [0, 0.5, 1], channel) for channel in zip(RULES.low, RULES.centre, RULES.high, strict=True)]
    ).astype(np.uint8)
