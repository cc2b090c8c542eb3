"""Robots: the numbers of a `pin.Model`, turned into CasADi kinematics and dynamics.

- `robot` has `Robot`, and `tree` the plain numbers behind it (`KinematicTree`).
- `kinematics`, `dynamics` and `spatial` build the CasADi expressions; `kinematics` also moves the tip by a tool, and
  compares its orientation with a reference.
- `urdf` and `mjcf` read URDF, SRDF and MJCF files; `pinocchio_model` locks joints of a `pin.Model`, converts it to a
  tree, and builds planar arms.
- `collisions` measures distances between links, and from links to a scene. `obstacles` has the scenes and their solids,
  `shapes` the geometry of solids, and `collision_files` reads solids from robot files and chart files. `capsules`
  bounds links by capsules, for C.
"""

from orthocas.robots.robot import Robot
from orthocas.robots.tree import KinematicTree

__all__ = ["KinematicTree", "Robot"]
