"""Writes a robot, a wall in front of its tip and a floor as MJCF, MuJoCo's format."""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from orthocas.robots import KinematicTree

HAND_RADIUS = 0.03  # of the sphere at the tip, the only part that touches the wall [m]
_WALL = np.array([0.02, 0.35, 0.25])  # half sizes [m]
_LINK, _JOINT, _HAND, _FACE = "0.82 0.84 0.87 1", "0.95 0.5 0.1 1", "0.8 0.1 0.1 1", "0.35 0.55 0.8 0.55"
_THICK, _THIN = 0.055, 0.035  # radii of links at the base and at the tip [m]
_GHOST = {"contype": 0, "conaffinity": 0, "mass": 0}  # is seen, touches nothing, weighs nothing


def write_scene(tree: KinematicTree, path: Path, wall_x: float, wall_z: float) -> None:
    """Write the robot with its motors, stops and limits of effort.

    Args:
        tree: a robot with revolute joints, none of them endless.
        path: of the file.
        wall_x: where the face of the wall is, which looks towards -x [m].
        wall_z: height of its middle [m].
    """
    root = Element("mujoco", model="arm")
    _add(root, "compiler", angle="radian")
    _add(root, "option", timestep=1e-3, integrator="implicitfast", gravity=tree.gravity)
    _add_looks(root)
    world, actuators = _add(root, "worldbody"), _add(root, "actuator")
    _add(world, "light", pos=(0, 0, 2.5), dir=(0.2, 0.3, -1), directional="true")
    _add(world, "body", name="view", pos=(0.32, 0.08, 0.4))
    _add(world, "camera", name="side", pos=(-0.75, -1.35, 1.15), mode="targetbody", target="view", fovy=36)
    _add(world, "geom", type="plane", size=(2, 2, 0.1), material="floor", **_GHOST)
    _add(world, "geom", name="wall", type="box", size=_WALL, pos=(wall_x + _WALL[0], 0, wall_z), rgba=_FACE)
    carriers = [world]  # of body i at i + 1
    for i, parent in enumerate(tree.parents):
        carriers.append(_add_body(carriers[parent + 1], tree, i))
        effort = tree.effort_limits[i]
        _add(actuators, "motor", name=f"motor{i}", joint=f"joint{i}", forcelimited="true", forcerange=(-effort, effort))
    place, carrier = tree.tip_translation, carriers[tree.tip_parent + 1]
    _add(carrier, "geom", name="hand", size=HAND_RADIUS, pos=place, mass=0, rgba=_HAND)
    ElementTree.indent(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode") + "\n")


def _add_body(carrier: Element, tree: KinematicTree, i: int) -> Element:
    """Body i with its joint, its inertia, and what is seen of it: the joint's axis and a link to each child."""
    turn = Rotation.from_matrix(np.array(tree.rotations[i])).as_quat(scalar_first=True)
    body = _add(carrier, "body", name=f"body{i}", pos=tree.translations[i], quat=turn)
    ends = (tree.lower[i], tree.upper[i])
    _add(body, "joint", name=f"joint{i}", axis=(0, 0, 1), limited="true", range=ends, armature=tree.armatures[i])
    inertia = tree.inertias[i]
    entries = tuple(inertia[row, column] for row, column in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    _add(body, "inertial", pos=tree.centres[i], mass=tree.masses[i], fullinertia=entries)
    radius = _THICK + (_THIN - _THICK) * i / (tree.n - 1)
    barrel = (0, 0, -1.2 * radius, 0, 0, 1.2 * radius)
    _add(body, "geom", type="cylinder", fromto=barrel, size=1.1 * radius, rgba=_JOINT, **_GHOST)
    tips = [tree.translations[k] for k, parent in enumerate(tree.parents) if parent == i]
    for end in tips or [tree.tip_translation]:
        _add(body, "geom", type="capsule", fromto=(0, 0, 0, *end), size=0.8 * radius, rgba=_LINK, **_GHOST)
    return body


def _add_looks(root: Element) -> None:
    """Floor, sky and the size of pictures."""
    visual = _add(root, "visual")
    _add(visual, "global", offwidth=960, offheight=720)
    _add(visual, "headlight", ambient=(0.45, 0.45, 0.45), diffuse=(0.45, 0.45, 0.45), specular=(0.1, 0.1, 0.1))
    asset = _add(root, "asset")
    _add(asset, "texture", type="skybox", builtin="flat", rgb1=(1, 1, 1), rgb2=(1, 1, 1), width=32, height=32)
    grey, light = (0.62, 0.64, 0.66), (0.72, 0.74, 0.76)
    _add(asset, "texture", name="floor", type="2d", builtin="checker", rgb1=grey, rgb2=light, width=300, height=300)
    _add(asset, "material", name="floor", texture="floor", texrepeat=(10, 10))


def _add(parent: Element, tag: str, **attributes: ArrayLike) -> Element:
    """A child with numbers written in full."""
    return ElementTree.SubElement(parent, tag, {name: _text(value) for name, value in attributes.items()})


def _text(value: ArrayLike) -> str:
    return value if isinstance(value, str) else " ".join(f"{number:.17g}" for number in np.atleast_1d(value))
