"""Controllers as CasADi functions of state, reference and gains, with the references they follow."""

from orthocas.control.controller import Controller, ControlStatus, Law, Setting, law_names, law_of, register
from orthocas.control.gains import Modes, matched_stiffness
from orthocas.control.kinematic import Kinematic, XiTask
from orthocas.control.memory import Adaptation, FrictionObserver, Memory, MomentumObserver, Remembering
from orthocas.control.operational_space import DampingCheck, Impedance, PDPlus
from orthocas.control.reference import Reference, joint_path
from orthocas.control.run_time_model import RunTimeModel
from orthocas.control.safety import Safety

__all__ = [
    "Adaptation",
    "ControlStatus",
    "Controller",
    "DampingCheck",
    "FrictionObserver",
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

for _law in (Impedance, PDPlus, Kinematic):
    register(_law)
