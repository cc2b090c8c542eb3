"""A shaded picture of a self-motion: the arm, and ghosts of it along a curve (ours)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.reaching.fan import fan_along
from orthocas.robots import Robot
from orthocas.viewing.arm import shades
from orthocas.viewing.body_poses import BodyPoses
from orthocas.viewing.rendering import Camera, Layer, Picture, render
from orthocas.viewing.solids import Colour, Solid, capsule
from orthocas.viewing.stick_arm import SHELL, Look, chain_length, stick_arm

GHOSTS = 7
_SEEN_FROM = np.array([0.62, -0.68, 0.38])
_ANGLE = 22.0  # of view [deg]
_STAY = 2e-3  # [m] and twice the sine of half an angle: what moves less is drawn once
_OPACITY, _DIM = 0.42, 0.5
_TRACE = 0.006  # radius of the path of the elbow, as a share of the arm's length


def fan_picture(robot: Robot, q: Array, curve: Array, width: int, height: int, look: Look | None = None) -> Picture:
    """Draw the arm at one posture, and ghosts of it along a curve, with the path of the joint that moves farthest.

    Args:
        robot: the robot.
        q: joint position (n,) of the solid arm.
        curve: joint positions (N, n), at even distances.
        width: of the picture, in pixels.
        height: of the picture, in pixels.
        look: what the bodies carry, see `urdf_look`. Default: rods and drums.
    """
    solids = stick_arm(robot.tree) if look is None else look
    poses = BodyPoses(robot.tree)
    place = _placed(poses, q)
    layers = [Layer([*_arm(solids, place), *_trace(robot, curve)], above=True)]
    shown = curve[np.round(np.linspace(0, len(curve) - 1, GHOSTS)).astype(int)]
    for posture, colour in zip(shown, shades(GHOSTS), strict=True):
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
    return [solid.moved(*place) for solids, place in zip(look, places, strict=True) for solid in solids]


def _tinted(solids: Sequence[Solid], colour: Colour) -> list[Solid]:
    """Solids in shades of one colour: dark ones stay darker."""
    found = []
    for solid in solids:
        share = _DIM + (1 - _DIM) * min(sum(solid.colour) / sum(SHELL), 1.0)
        red, green, blue = (round(share * part) for part in colour)
        found.append(replace(solid, colour=(red, green, blue)))
    return found


def _trace(robot: Robot, curve: Array) -> list[Solid]:
    """The path of the joint that moves farthest."""
    points = robot.joint_points(curve)  # (N, points, 3)
    way = points[:, int(np.argmax(np.ptp(points, axis=0).max(axis=1)))]
    radius = _TRACE * chain_length(robot.tree)
    colours = shades(len(way) - 1).tolist()
    return [
        capsule(start, end, (radius, radius), tuple(colour), 8)
        for start, end, colour in zip(way[:-1], way[1:], colours, strict=True)
    ]


def _camera(points: Array, aspect: float) -> Camera:
    """A camera that sees all points (P, 3)."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = np.linalg.norm(points - middle, axis=1).max()
    towards = _SEEN_FROM / np.linalg.norm(_SEEN_FROM)
    distance = radius / np.sin(np.radians(_ANGLE) / 2 * min(1.0, aspect))
    return Camera(tuple(middle + distance * towards), tuple(middle), _ANGLE)
