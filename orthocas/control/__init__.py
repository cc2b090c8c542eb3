"""Controllers as CasADi functions of state, reference and gains, with the references they follow."""

from orthocas.control.controller import Controller, Law
from orthocas.control.kinematic import Kinematic
from orthocas.control.kinematic_projector import KinematicProjector
from orthocas.control.matched_stiffness import matched_posture_stiffness, matched_stiffness
from orthocas.control.modes import Modes
from orthocas.control.operational_space import DampingCheck, Impedance, PDPlus
from orthocas.control.posture import posture_reference
from orthocas.control.projector import Projector
from orthocas.control.reachability import joint_path
from orthocas.control.reference import Reference
from orthocas.control.registry import law_names, law_of, register
from orthocas.control.run_time_model import RunTimeModel
from orthocas.control.safety import Safety
from orthocas.control.status import ControlStatus

__all__ = [
    "ControlStatus",
    "Controller",
    "DampingCheck",
    "Impedance",
    "Kinematic",
    "KinematicProjector",
    "Law",
    "Modes",
    "PDPlus",
    "Projector",
    "Reference",
    "RunTimeModel",
    "Safety",
    "joint_path",
    "law_names",
    "law_of",
    "matched_posture_stiffness",
    "matched_stiffness",
    "posture_reference",
    "register",
]
