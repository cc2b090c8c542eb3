"""Planar arms whose links are solids."""

from pathlib import Path

import numpy as np

import orthocas as oc
from orthocas.tools.checks import Array

BALL = '<sphere radius="0.1"/>'


def build_arm(folder: Path, solids: list[str], limit: float = 3.1) -> oc.Robot:
    """A planar arm of links of length 1 along x, each with a solid 0.8 along it; the base has one at the origin."""
    links, joints = [], []
    for k, solid in enumerate(solids):
        place = f'<origin xyz="{0.8 if k else 0} 0 0"/>'
        shape = f"<collision>{place}<geometry>{solid}</geometry></collision>" if solid else ""
        inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        links.append(f'<link name="link{k}"><inertial><mass value="1"/>{inertia}</inertial>{shape}</link>')
        if k:
            ends = f'<parent link="link{k - 1}"/><child link="link{k}"/><axis xyz="0 0 1"/>'
            bounds = f'<limit lower="-{limit}" upper="{limit}" effort="1" velocity="1"/>'
            joints.append(
                f'<joint name="q{k}" type="revolute"><origin xyz="{1 if k > 1 else 0} 0 0"/>{ends}{bounds}</joint>'
            )
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(links)}{"".join(joints)}</robot>')
    return oc.Robot.from_urdf(path, f"link{len(solids) - 1}")


def place_balls(q: Array) -> Array:
    """Centres of the balls of `build_arm` in the plane, (3, 2) for q (2,)."""
    first, second = q[0], q[0] + q[1]
    elbow = np.array([np.cos(first), np.sin(first)])
    return np.array([np.zeros(2), 0.8 * elbow, elbow + 0.8 * np.array([np.cos(second), np.sin(second)])])
