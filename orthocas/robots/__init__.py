"""Robots: the numbers of a `pin.Model`, turned into CasADi kinematics and dynamics.

- `robot` has `Robot`, and `tree` the plain numbers behind it (`KinematicTree`).
- `kinematics`, `dynamics` and `spatial` build the CasADi expressions; `kinematics` also moves the tip by a tool, and
  compares its orientation with a reference.
- `urdf` and `mjcf` read URDF, SRDF and MJCF files; `pinocchio_model` locks joints of a `pin.Model`, converts it to a
  tree, and builds planar arms.
- `collisions` measures distances between links and from scenes; `obstacles` has scenes and their solids, `shapes` what
  these are made of, and `collision_files` the solids of robot files and chart files. `capsules` bounds links for C.
"""

from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree

__all__ = ["KinematicTree", "Robot"]
