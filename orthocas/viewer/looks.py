"""How robots look: meshes of a URDF file, or drums and rods made from the kinematic tree."""

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
    """Numbers of views. Sizes without a unit are fractions of the length of the arm."""

    facets: int = 16  #: around an axis
    ghost_facets: int = 6
    shell: Colour = (226, 229, 233)
    joint: Colour = (72, 80, 92)
    tool: Colour = (214, 96, 20)
    rod: float = 0.042  #: radius of the first rod
    taper: float = 0.45  #: fraction of the radius that is lost on the way to the tip
    shortest_rod: float = 0.35  #: in radii; shorter ones are left out
    triangles: int = 20_000  #: of an arm for a picture
    mesh_triangles: int = 500  #: of a mesh at least
    most_triangles: int = 3_000_000  #: of all meshes, more is slow to send and to draw
    ghosts: int = 7  #: arms of a fan
    ghost_thickness: float = 0.32  #: fraction of the arm's
    low: Colour = (24, 92, 214)  #: colours along a coordinate
    centre: Colour = (64, 168, 116)
    high: Colour = (245, 118, 10)
    trace: float = 0.004  #: thickness of a line
    same_place: float = 0.3  #: of two labels, over the size of what moves

    most_instants: int = 1_000_000  #: of a motion in a file
    cycle: float = 5.0  #: of a closed path [s]
    cycle_points: int = 250
    most_cycles: int = 20
    circle: float = 0.6  #: radius of the default path, as a fraction of how far the task moves over the domain
    smallest_circle: float = 1e-3
    corrections: int = 2  #: of the pseudo-inverse at each point
    same_ends: float = 1e-9  #: of closed paths, relative to the sizes of the task

    tracker_steps: int = 200  #: towards one target
    shortest_step: float = 1e-4  #: fraction of the way to a target below which there is no way on
    reached: float = 1e-10  #: of the sizes of the components
    most_undone: int = 100

    small_angle: float = 0.001  #: [deg]
    slider_step: float = 1e-3
    reach_steps: int = 8  #: of a component of the task over its size, to find how far it goes
    missed: float = 1e-6  #: of the sizes of the components: a target that is not reached
    reach_sizes: float = 2.0  #: of a component, beyond which nobody slides
    endless: float = float(np.pi)  #: half of a slider without limits [rad] or [m]
    handle: float = 0.17  #: arrows at the tool, of the length of the chain
    rings: float = 0.13  #: that turn it
    sweep: float = 6.0  #: there and back [s]
    sweep_range: float = 0.97  #: fraction of the range that a sweep uses
    most_recorded: int = 100_000  #: joint positions, about an hour
    reading_pause: float = 0.1  #: between readings in a sweep, which take longer than a picture [s]

    plot_points: int = 400  #: of a line in a plot
    #: of the lines in a plot: eight that are told apart, also by the colour-blind (Okabe and Ito)
    plot_colours: tuple[str, ...] = (
        *("#0072b2", "#e69f00", "#009e73", "#cc79a7"),
        *("#d55e00", "#56b4e9", "#000000", "#b8a800"),
    )
    path_colours: tuple[Colour, ...] = ((31, 95, 168), (217, 95, 2), (27, 158, 119))
    path_points: int = 2000  #: of a tool path, at most
    apart: float = 0.9  #: distance of arms that are side by side
    time_step: float = 0.01  #: of the time slider [s]
    rate: int = 30  #: recorded pictures a second
    recorded_sweep: float = 5.0  #: of one coordinate [s]
    recorded_length: float = 120.0  #: longer motions are recorded faster [s]

    far_links: float = 0.3  #: [m]: a full bar
    near_links: float = 0.1  #: [m]: amber below
    close_links: float = 0.02  #: [m]: red below, and the pair with it
    link_line: float = 0.004  #: thickness of the line between nearest points [m]
    touching: Colour = (214, 69, 69)
    solid: Colour = (150, 158, 168)

    brand: Colour = (31, 95, 168)
    panel_widths: tuple[int, int] = (320, 300)  #: of readings and sliders [px]
    view_angle: float = 0.7  #: of the camera [rad]
    room: float = 1.15  #: around the arms in the picture
    camera_slack: float = 1e-3  #: fraction of its distance within which a camera stands where it was placed
    camera_pause: float = 0.5  #: that a camera may be elsewhere before it is where it was placed [s]
    flat: float = 1e-9  #: of planar arms, and no gravity
    floor: float = 1.5  #: radius
    fade: float = 0.5  #: where the lines of the floor begin to fade, as a fraction of its radius
    line: float = 0.002  #: thickness of these lines
    grid: tuple[Colour, Colour] = ((205, 210, 217), (228, 231, 235))  #: every fifth line, and the others

    tick: float = 1 / 30  #: of animations; browsers without a graphics card fall behind more [s]
    quiet: float = 0.25  #: without jobs, after which the page settles [s]
    silence: float = 1.0  #: of a connection that asks for nothing, before it is dropped [s]
    most_files: int = 50  #: of a folder, that a page offers
    largest_message: int = 2**20  #: from a browser; sliders and cameras need hundreds [bytes]
    message_length: int = 80  #: of a report [characters]


RULES = ViewRules()


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles of one colour."""

    vertices: Array  #: (V, 3) in the frame of the body [m]
    faces: Indices  #: (F, 3) rows of vertices, counterclockwise from outside
    colour: Colour

    def move(self, rotation: Array, translation: Array) -> "Solid":
        """The solid turned by a rotation (3, 3), then shifted by a translation (3,)."""
        return replace(self, vertices=self.vertices @ rotation.T + translation)


def join_solids(solids: Sequence[Solid], colour: Colour) -> Solid:
    """All triangles of some solids as one, in one colour."""
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + start for solid, start in zip(solids, first, strict=False)]
    return Solid(np.concatenate([solid.vertices for solid in solids]), np.concatenate(faces), colour)


def build_capsule(
    start: Array, end: Array, radii: tuple[float, float], colour: Colour, facets: int = RULES.facets
) -> Solid:
    """A rod with round ends from one point (3,) to another, with a radius at each end [m]."""
    length = float(np.linalg.norm(end - start))
    low = _build_arc(radii[0], -np.pi / 2, 0.0, facets)
    high = _build_arc(radii[1], 0.0, np.pi / 2, facets) + np.array([0.0, length])
    axis = np.array([0.0, 0.0, 1.0]) if length == 0 else (end - start) / length
    return _revolve(np.concatenate([low, high]), colour, facets).move(rotate_z_to(axis), start)


def build_drum(radius: float, half_height: float, colour: Colour, facets: int = RULES.facets) -> Solid:
    """A cylinder with rounded edges about the z axis, with its middle at the origin."""
    edge = 0.25 * min(radius, half_height)
    lower, upper = _build_arc(edge, -np.pi / 2, 0.0, facets), _build_arc(edge, 0.0, np.pi / 2, facets)
    shift = np.array([radius - edge, half_height - edge])
    rim = np.concatenate([lower + shift * [1, -1], upper + shift])
    return _revolve(np.concatenate([[[0.0, -half_height]], rim, [[0.0, half_height]]]), colour, facets)


def build_block(size: Array, colour: Colour) -> Solid:
    """A box of a size (3,) [m] with its middle at the origin. Faces share no vertices, so that edges look sharp."""
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
    """A profile of points (r, z), from bottom to top, turned about the z axis."""
    angle = np.linspace(0.0, 2 * np.pi, facets, endpoint=False)
    r, z = profile.T
    ring = np.stack([np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.outer(z, np.ones_like(angle))], axis=-1)
    index = np.arange(len(profile) * facets).reshape(len(profile), facets)
    here, next_ = index, np.roll(index, -1, axis=1)
    lower = np.stack([here[:-1], next_[:-1], next_[1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([here[:-1], next_[1:], here[1:]], axis=-1).reshape(-1, 3)
    return Solid(ring.reshape(-1, 3), np.concatenate([lower, upper]), colour)


Look = list[list[Solid]]  #: what each frame of `BodyPoses` carries: base, bodies, tip


def decimate(look: Look, most: int = RULES.triangles) -> Look:
    """The same look with about so many triangles, or fewer; small solids stay as they are.

    By the quadric error metric (package fast-simplification, through trimesh). Without that package, all stay.
    """
    share = most / max(sum(len(solid.faces) for solids in look for solid in solids), 1)
    if share >= 1 or find_spec("fast_simplification") is None:
        return look
    return [
        [_decimate(solid, max(int(share * len(solid.faces)), RULES.mesh_triangles)) for solid in solids]
        for solids in look
    ]


def _decimate(solid: Solid, count: int) -> Solid:
    """A solid with about so many triangles."""
    import trimesh  # half a second, for meshes of robot files only

    if len(solid.faces) <= count:
        return solid
    mesh = trimesh.Trimesh(solid.vertices, solid.faces).simplify_quadric_decimation(face_count=count)
    return replace(solid, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces, dtype=np.intp))


def build_stick_arm(tree: KinematicTree, thickness: float = 1.0, facets: int = RULES.facets) -> Look:
    """Drums about the joint axes and tapered rods between the frames, thinner or thicker than usual by a factor."""
    look: Look = [[] for _ in range(tree.bodies + 2)]
    # Radii of the rods that begin at the base and at each body, (N + 1,).
    total, run = compute_chain_length(tree), np.zeros(tree.bodies + 1)
    for i in tree.order:
        run[i + 1] = run[tree.parents[i] + 1] + np.linalg.norm(tree.translations[i])
    radii = thickness * RULES.rod * total * (1 - RULES.taper * np.clip(run / total, 0.0, 1.0))
    for i, parent in enumerate(tree.parents):
        r = radii[i + 1]
        # A drum about the axis of a revolute joint, or a slim rail along that of a prismatic one.
        size = (0.8 * r, 2.2 * r) if tree.body_kinds[i] == "prismatic" else (1.18 * r, 1.3 * r)
        look[i + 1].append(build_drum(*size, RULES.joint, facets))
        _add_rod(look[parent + 1], tree.translations[i], (radii[parent + 1], r), facets)
    r = radii[tree.tip_parent + 1]
    _add_rod(look[tree.tip_parent + 1], tree.tip_translation, (r, 0.75 * r), facets)
    look[-1].append(build_ball(0.55 * r, RULES.tool, facets))
    for frame in map(tree.frame, tree.tips):  # further hands
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
    """A rod from the origin of a body to a point of it, unless it is hidden in the drums."""
    if np.linalg.norm(end) > RULES.shortest_rod * radii[0]:
        solids.append(build_capsule(np.zeros(3), end, radii, RULES.shell, facets))


@dataclass(frozen=True)
class RobotLook:
    """How a robot looks."""

    look: Look  #: empty for bodies without anything to show
    missing: tuple[str, ...] = ()  #: mesh files that cannot be found or read


def build_shape(robot: Robot, robot_file: str | Path | None, locked: Mapping[str, float] | None) -> RobotLook:
    """How a robot looks: as its file says, or drums and rods where that shows nothing."""
    sticks = build_stick_arm(robot.tree)
    if robot_file is None:
        return RobotLook(sticks)
    read = read_urdf_look(as_path("robot_file", robot_file), robot.tree, locked)
    bare = bool(read.missing) or not any(read.look)
    look = [part or (sticks[i] if bare else []) for i, part in enumerate(read.look)]
    return RobotLook(decimate([*look[:-1], sticks[-1]]), read.missing)


def read_urdf_look(path: Path, tree: KinematicTree, locked: Mapping[str, float] | None = None) -> RobotLook:
    """Solids of all links of a URDF file, carried by the bodies of a robot that was built from it.

    Joints off the chain to the tip are locked as in `Robot.from_urdf`, so their links are shown too.

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
    """The colour that a material defines itself."""
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
    """The geometry of a visual element in its own frame; None if there is none to show."""
    # A colour of its own, that of a named material, or the default.
    material = visual.find("material")
    colour = RULES.shell
    if material is not None:
        colour = _read_colour(material) or colours.get(material.get("name", ""), RULES.shell)
    shape = next(iter(visual.find("geometry") if visual.find("geometry") is not None else ()), None)  # type: ignore[arg-type]
    # Shapes as URDF files name them; others are not shown.
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
    """Poses of the base, of each body and of the tip frame in the world: N + 2 frames in this order."""

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
    """An arm in the scene: one skinned mesh for each colour, whose bones are the bodies.

    Without a graphics card, the time of a picture goes with the number of meshes more than with their triangles.

    Args:
        scene: of a viser server.
        name: of its node, such as "/arm".
        robot: the robot.
        look: what its bodies carry.
        shift: where its base stands (3,) [m].
    """

    def __init__(self, scene: Any, name: str, robot: Robot, look: Look, shift: Array | None = None) -> None:
        self._poses = BodyPoses(robot.tree)
        self.shift = np.zeros(3) if shift is None else shift
        self._nodes = [scene.add_frame(name, show_axes=False, position=tuple(self.shift))]
        # A mesh for each colour; bones are bodies, and move with them.
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
        """Take it out of the scene."""
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
        """Show arms at joint positions (N, n), the way of their joints along a curve (M, n), and texts at its ends."""
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
        # Lines that the joints move along, except those that stay.
        points = self._robot.joint_points(curve)  # (M, joints, 3)
        size = float(np.ptp(points.reshape(-1, 3), axis=0).max())
        moving = points[:, np.ptp(points, axis=0).max(axis=1) > 0.03 * size]
        if moving.size:
            colours = np.repeat(compute_shades(len(curve))[:, None], moving.shape[1], axis=1)
            lines = np.stack([moving[:-1], moving[1:]], axis=2).reshape(-1, 2, 3)
            shade = np.stack([colours[:-1], colours[1:]], axis=2).reshape(-1, 2, 3)
            thickness = RULES.trace * max(size, 1e-3)
            self._nodes.append(self._scene.add_line_segments("/ghosts/traces", lines, shade, thickness=thickness))
            # At the joint that moves farthest; both texts in one place if the curve comes back.
            way = points[:, int(np.argmax(np.linalg.norm(np.ptp(points, axis=0), axis=1)))]
            if len(ends) == 2 and np.linalg.norm(way[-1] - way[0]) < RULES.same_place * size:
                ends, way = [f"{ends[0]} and {ends[1]}"], way[:1]
            for k, (text, place) in enumerate(zip(ends, (way[0], way[-1]), strict=False)):
                self._nodes.append(
                    self._scene.add_label(f"/ghosts/end{k}", text, position=tuple(place), anchor="top-center")
                )

    def hide(self) -> None:
        """Remove all."""
        for node in self._nodes:
            node.remove()
        self._nodes = []


def compute_shades(count: int) -> Array:
    """Colours from low to high values of a coordinate, (count, 3), 0 to 255."""
    share = np.linspace(0.0, 1.0, count)
    return np.column_stack(
        [np.interp(share, [0, 0.5, 1], channel) for channel in zip(RULES.low, RULES.centre, RULES.high, strict=True)]
    ).astype(np.uint8)
