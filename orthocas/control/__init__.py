"""Controllers as CasADi functions of state, reference and gains, with the references they follow."""

from orthocas.control.controller import Controller, ControlStatus, Law
from orthocas.control.gains import Setting, matched_stiffness
from orthocas.control.kinematic import Kinematic
from orthocas.control.memory import Adaptation, Memory, MomentumObserver, Remembering
from orthocas.control.operational_space import DampingCheck, Impedance, Modes, PDPlus
from orthocas.control.posture import joint_path
from orthocas.control.reference import Reference
from orthocas.control.registry import law_names, law_of, register
from orthocas.control.run_time_model import RunTimeModel
from orthocas.control.safety import Safety
from orthocas.control.xi_task import XiTask

__all__ = [
    "Adaptation",
    "ControlStatus",
    "Controller",
    "DampingCheck",
    "Impedance",
    "Kinematic",
    "Law",
    "Memory",
    "Modes",
    "MomentumObserver",
    "PDPlus",
    "Reference",
    "Remembering",
    "RunTimeModel",
    "Safety",
    "Setting",
    "XiTask",
    "joint_path",
    "law_names",
    "law_of",
    "matched_stiffness",
    "register",
]
