"""Shaded pictures of arms by a depth buffer in NumPy, without a graphics card or a display."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.charts.self_motion import fan_along
from orthocas.robots.robot import Robot
from orthocas.tools.checks import Array, Indices
from orthocas.viewer.looks import (
    RULES,
    BodyPoses,
    Colour,
    Look,
    Solid,
    build_capsule,
    build_stick_arm,
    compute_chain_length,
    compute_shades,
)

_SAMPLES = 2  # per pixel and axis
_MOST = 2_000_000  # candidates of pixels that are looked at together
_LIGHTS = (((0.35, -0.45, 0.82), 0.62), ((-0.8, -0.3, 0.3), 0.2))  # direction and strength
_SUN = np.array(_LIGHTS[0][0]) / np.linalg.norm(_LIGHTS[0][0])
_EDGE = 0.8  # cosine between a triangle and the average at a vertex, below which there is an edge
_SKY, _GROUND = 0.46, 0.26  # ambient light from above and below
_SHINE = 0.22  # strength of highlights
_FRONT = 1e9  # more than any 1 / depth [1/m]
_SHADOW, _SOFT = 0.30, 0.008  # strength, and width of the boundary as a share of the height
GHOSTS = 7
_SEEN_FROM = np.array([0.62, -0.68, 0.38])
_ANGLE = 22.0  # of view [deg]
_STAY = 2e-3  # [m] and twice the sine of half an angle: what moves less is drawn once
_OPACITY, _DIM = 0.42, 0.5
_TRACE = 0.006  # radius of the path of the elbow, as a share of the arm's length

Picture = NDArray[np.uint8]  #: red, green, blue and opacity, (height, width, 4)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera."""

    eye: tuple[float, float, float]  #: where it stands [m]
    target: tuple[float, float, float]  #: what is in the middle of the picture [m]
    angle: float = 24.0  #: from the lower to the upper boundary of the picture [deg]

    def axes(self) -> Array:
        """Unit vectors to the right, down, and ahead, rows (3, 3)."""
        ahead = np.subtract(self.target, self.eye)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(ahead, right), ahead])

    def project(self, points: Array, width: int, height: int) -> Array:
        """Column, row and 1 / depth of points (N, 3), (N, 3)."""
        x, y, depth = self.axes() @ (points - np.asarray(self.eye)).T
        focal = height / (2 * np.tan(np.radians(self.angle) / 2))
        return np.column_stack([width / 2 + focal * x / depth, height / 2 + focal * y / depth, 1 / depth])


@dataclass(frozen=True)
class Layer:
    """Solids that hide each other, and let through what lies behind all of them."""

    solids: Sequence[Solid]
    opacity: float = 1.0
    above: bool = False  #: in front of layers that are not, wherever they are


def render(layers: Sequence[Layer], camera: Camera, width: int, height: int, floor: float | None = 0.0) -> Picture:
    """Draw layers on nothing, with a soft shadow on the floor, for pages of any colour.

    Args:
        layers: solids in the world.
        camera: where from.
        width: of the picture, in pixels.
        height: of the picture, in pixels.
        floor: height of the floor [m]; None for none.
    """
    size = (_SAMPLES * width, _SAMPLES * height)
    seen = np.zeros((size[1] * size[0], 4))  # colours times opacity, and opacity
    if floor is not None:
        for layer in layers:
            seen[:, 3] += layer.opacity * _shadow(layer.solids, camera, size, floor) * (1 - seen[:, 3])
    drawn = [(layer.opacity, *_drawn(layer.solids, camera, size)) for layer in layers]
    near = np.stack(
        [depth + (depth > 0) * _FRONT * layer.above for layer, (_, depth, _) in zip(layers, drawn, strict=True)]
    )
    order = np.argsort(near, axis=0, kind="stable")  # the farthest first: these are 1 / depth
    for place in order:
        for k, (opacity, depth, colours) in enumerate(drawn):
            here = np.flatnonzero((place == k) & (depth > 0))
            seen[here] += opacity * (np.column_stack([colours[here], np.ones(len(here))]) - seen[here])
    smooth = seen.reshape(height, _SAMPLES, width, _SAMPLES, 4).mean(axis=(1, 3))
    smooth[..., :3] /= np.maximum(smooth[..., 3:], 1e-12)
    return np.asarray(np.round(255 * np.clip(smooth, 0, 1)), dtype=np.uint8)


def on_ground(picture: Picture, ground: tuple[int, int, int] = (255, 255, 255)) -> NDArray[np.uint8]:
    """A picture on a colour, (height, width, 3)."""
    opacity = picture[..., 3:] / 255
    return np.asarray(np.round(picture[..., :3] * opacity + np.array(ground) * (1 - opacity)), dtype=np.uint8)


def _drawn(solids: Sequence[Solid], camera: Camera, size: tuple[int, int]) -> tuple[Array, Array]:
    """1 / depth of the nearest surface (0: none) and its colour for each pixel, (P,) and (P, 3)."""
    depth, colours = np.zeros(size[0] * size[1]), np.zeros((size[0] * size[1], 3))
    for solid in solids:
        normals = _normals(solid)
        corners = camera.project(solid.vertices, *size)[solid.faces]
        for pixels, faces, weights in _covered(corners, size):
            inverse = np.einsum("pk,pk->p", weights, corners[faces, :, 2])
            np.maximum.at(depth, pixels, inverse)
            seen = inverse >= depth[pixels]
            vertices = solid.faces[faces[seen]]
            share = (weights[seen] * corners[faces[seen], :, 2] / inverse[seen, None])[..., None]
            points, turned = (solid.vertices[vertices] * share).sum(axis=1), (normals[faces[seen]] * share).sum(axis=1)
            colours[pixels[seen]] = _lit(np.array(solid.colour) / 255, points, turned, camera)
    return depth, colours


def _covered(corners: Array, size: tuple[int, int]) -> Iterator[tuple[Indices, Indices, Array]]:
    """Pixels that triangles (F, 3, 3) cover: indices of pixels and triangles, and barycentric weights, in portions."""
    width, height = size
    low = np.clip(np.floor(corners[..., :2].min(axis=1)).astype(np.int64), 0, [width, height])
    high = np.clip(np.ceil(corners[..., :2].max(axis=1)).astype(np.int64), 0, [width, height])
    wide, tall = (high - low).T
    (x0, y0), (x1, y1), (x2, y2) = (corners[:, k, :2].T for k in range(3))
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    useful = np.flatnonzero((wide * tall > 0) & (np.abs(area) > 1e-9) & (corners[..., 2] > 0).all(axis=1))
    total = np.cumsum(wide[useful] * tall[useful])
    for part in np.split(useful, np.searchsorted(total, np.arange(_MOST, total[-1] if len(total) else 0, _MOST))):
        counts = wide[part] * tall[part]
        faces = np.repeat(part, counts)
        k = np.arange(len(faces)) - np.repeat(np.cumsum(counts) - counts, counts)
        column, row = low[faces, 0] + k % wide[faces], low[faces, 1] + k // wide[faces]
        x, y = column + 0.5 - x0[faces], row + 0.5 - y0[faces]
        second = (x * (y2 - y0)[faces] - y * (x2 - x0)[faces]) / area[faces]
        third = (y * (x1 - x0)[faces] - x * (y1 - y0)[faces]) / area[faces]
        weights = np.column_stack([1 - second - third, second, third])
        inside = (weights >= 0).all(axis=1)
        yield (row * width + column)[inside], faces[inside], weights[inside]


def _lit(colour: Array, points: Array, normals: Array, camera: Camera) -> Array:
    """Colours of points with normals, both (P, 3), under the lights, (P, 3)."""
    towards = np.asarray(camera.eye) - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    unit *= np.where((unit * towards).sum(axis=1, keepdims=True) < 0, -1, 1)  # meshes may be inside out
    light = _GROUND + (_SKY - _GROUND) * (1 + unit[:, 2]) / 2
    shine = np.zeros(len(points))
    for direction, strength in _LIGHTS:
        sun = np.asarray(direction) / np.linalg.norm(direction)
        half = towards + sun
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        light = light + strength * np.maximum(unit @ sun, 0)
        shine += strength * np.maximum((unit * half).sum(axis=1), 0) ** 40
    return np.asarray(np.outer(light, colour) + _SHINE * shine[:, None])


def _normals(solid: Solid) -> Array:
    """Unit normals at the corners of triangles, (F, 3, 3): averages over all triangles there, except at edges."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    smooth = np.zeros_like(solid.vertices)
    for k in range(3):
        np.add.at(smooth, solid.faces[:, k], flat)
    smooth, flat = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12) for v in (smooth, flat))
    corners, own = smooth[solid.faces], flat[:, None]
    return np.asarray(np.where((corners * own).sum(axis=2, keepdims=True) < _EDGE, own, corners))


def _shadow(solids: Sequence[Solid], camera: Camera, size: tuple[int, int], floor: float) -> Array:
    """How dark the shadow of solids on the floor is for each pixel, (P,)."""
    dark = np.zeros(size[0] * size[1])
    for solid in solids:
        above = np.maximum(solid.vertices[:, 2:] - floor, 0)
        flat = solid.vertices - above / _SUN[2] * _SUN
        for pixels, _, _ in _covered(camera.project(flat, *size)[solid.faces], size):
            dark[pixels] = _SHADOW
    soft = scipy.ndimage.gaussian_filter(dark.reshape(size[::-1]), _SOFT * size[1])
    return np.asarray(soft.ravel())


def fan_picture(robot: Robot, q: Array, curve: Array, width: int, height: int, look: Look | None = None) -> Picture:
    """Draw the arm at one posture, and ghosts of it along a curve, with the path of the joint that moves farthest.

    Args:
        robot: the robot.
        q: joint position (n,) of the solid arm.
        curve: joint positions (N, n), at even distances.
        width: of the picture, in pixels.
        height: of the picture, in pixels.
        look: what the bodies carry, see `read_urdf_look`. Default: rods and drums.
    """
    solids = build_stick_arm(robot.tree) if look is None else look
    poses = BodyPoses(robot.tree)
    place = _placed(poses, q)
    layers = [Layer([*_arm(solids, place), *_trace(robot, curve)], above=True)]
    shown = curve[np.round(np.linspace(0, len(curve) - 1, GHOSTS)).astype(int)]
    for posture, colour in zip(shown, compute_shades(GHOSTS), strict=True):
        there = _placed(poses, posture)
        moving = [body if _differ(one, other) else [] for body, one, other in zip(solids, place, there, strict=True)]
        layers.append(Layer(_tinted(_arm(moving, there), tuple(colour.tolist())), _OPACITY))
    points = np.concatenate([solid.vertices for solid in layers[0].solids] + list(robot.joint_points(curve)))
    return render(layers, _camera(points, width / height), width, height, floor=float(points[:, 2].min()))


def widest_coordinate(chart: Chart, q: Array) -> int:
    """The index of the coordinate along which the joints of the arm move farthest in space from q."""
    ways = [np.ptp(chart.problem.robot.joint_points(fan_along(chart, q, k).q), axis=0).max() for k in range(chart.r)]
    return int(np.argmax(ways))


def _placed(poses: BodyPoses, q: Array) -> list[tuple[Array, Array]]:
    """Rotation and position of every frame."""
    positions, quaternions = poses(q[None])
    rotations = scipy.spatial.transform.Rotation.from_quat(quaternions[0], scalar_first=True).as_matrix()
    return list(zip(rotations, positions[0], strict=True))


def _differ(one: tuple[Array, Array], other: tuple[Array, Array]) -> bool:
    return any(np.abs(a - b).max() > _STAY for a, b in zip(one, other, strict=True))


def _arm(look: Look, places: Sequence[tuple[Array, Array]]) -> list[Solid]:
    return [solid.move(*place) for solids, place in zip(look, places, strict=True) for solid in solids]


def _tinted(solids: Sequence[Solid], colour: Colour) -> list[Solid]:
    """Solids in shades of one colour: dark ones stay darker."""
    found = []
    for solid in solids:
        share = _DIM + (1 - _DIM) * min(sum(solid.colour) / sum(RULES.shell), 1.0)
        red, green, blue = (round(share * part) for part in colour)
        found.append(replace(solid, colour=(red, green, blue)))
    return found


def _trace(robot: Robot, curve: Array) -> list[Solid]:
    """The path of the joint that moves farthest."""
    points = robot.joint_points(curve)  # (N, points, 3)
    way = points[:, int(np.argmax(np.ptp(points, axis=0).max(axis=1)))]
    radius = _TRACE * compute_chain_length(robot.tree)
    colours = compute_shades(len(way) - 1).tolist()
    return [
        build_capsule(start, end, (radius, radius), tuple(colour), 8)
        for start, end, colour in zip(way[:-1], way[1:], colours, strict=True)
    ]


def _camera(points: Array, aspect: float) -> Camera:
    """A camera that sees all points (P, 3)."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - middle, axis=1).max()
    towards = _SEEN_FROM / np.linalg.norm(_SEEN_FROM)
    distance = radius / np.sin(np.radians(_ANGLE) / 2 * min(1.0, aspect))
    return Camera(tuple(middle + distance * towards), tuple(middle), _ANGLE)
