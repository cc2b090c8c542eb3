"""Robots: the numbers of a `pin.Model`, turned into CasADi kinematics and dynamics.

- `robot` has `Robot`, and `tree` the plain numbers behind it (`KinematicTree`).
- `kinematics`, `dynamics` and `spatial` build the CasADi expressions.
- `files`, `homes`, `urdf_checks` and `mjcf` (with `mjcf_*` and `xml_*`) read URDF, SRDF and MJCF files.
  `pinocchio_model` converts a `pin.Model` to a tree. `planar` builds planar arms.
- `tool` moves the tip, and `tip_turn` compares its orientation with a reference.
"""

from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree

__all__ = ["KinematicTree", "Robot"]
