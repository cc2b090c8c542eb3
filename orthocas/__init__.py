"""orthocas: joint-space coordinates that a redundant robot's task does not disturb, with CasADi."""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING

from orthocas.cli.entry import is_command_line as _is_command_line
from orthocas.cli.entry import leave_on_ctrl_c as _leave_on_ctrl_c

if _is_command_line():
    _leave_on_ctrl_c()  # the imports below take a second

from orthocas.comparing.workers import end_early_with_parent as _end_early_with_parent
from orthocas.comparing.workers import knows_parent as _knows_parent

if _knows_parent():
    _end_early_with_parent()

# In a checkout, problems/ and solvers/ lie beside this folder, not inside it. Looking one level up keeps
# `orthocas.problems` importable there, whether or not an installed copy exists; a wheel does not run this line.
if not (_Path(__file__).parent / "problems").is_dir():
    __path__.append(str(_Path(__file__).parent.parent))

from orthocas import control, errors, following, obstacles, parametrisations, problems, simulation, solvers
from orthocas.certificates import Certificate
from orthocas.certifying import certified_box, certify, check_certificate
from orthocas.chart import Chart, GrownChart, load
from orthocas.codegen import compile_inverse, generate_c
from orthocas.comparing.compare import compare
from orthocas.comparing.report import Comparison
from orthocas.distil import distil
from orthocas.domains import Box, Torus, contains, default_box
from orthocas.exporting import export
from orthocas.fitting.fit import Fit, fit
from orthocas.fitting.loss import Weights
from orthocas.fitting.loss import register as register_loss_term
from orthocas.fitting.symbolic_loss import loss
from orthocas.following.follow import follow
from orthocas.grow import grow
from orthocas.inverting import InverseStatus, Solutions, Tracker, TrackerStatus
from orthocas.involutivity import Involutivity, involutivity, lie_bracket
from orthocas.metrics import Metric
from orthocas.parametrisations import MLP, SEW, Fourier, Given, Linear, Polynomial, cyclic_joints
from orthocas.parametrisations import register as register_parametrisation
from orthocas.postures.clear_box import ClearBox
from orthocas.postures.suggest import suggest_domain
from orthocas.problem import Problem, check
from orthocas.quality import Report, evaluate
from orthocas.robots import Robot
from orthocas.simulation import simulate
from orthocas.singularities import jumps, singular_points
from orthocas.tasks import Task
from orthocas.version import VERSION as _VERSION

if TYPE_CHECKING:
    from orthocas import plotting

__version__ = _VERSION
__all__ = [
    "MLP",
    "SEW",
    "Box",
    "Certificate",
    "Chart",
    "ClearBox",
    "Comparison",
    "Fit",
    "Fourier",
    "Given",
    "GrownChart",
    "InverseStatus",
    "Involutivity",
    "Linear",
    "Metric",
    "Polynomial",
    "Problem",
    "Report",
    "Robot",
    "Solutions",
    "Task",
    "Torus",
    "Tracker",
    "TrackerStatus",
    "Weights",
    "certified_box",
    "certify",
    "check",
    "check_certificate",
    "compare",
    "compile_inverse",
    "contains",
    "control",
    "cyclic_joints",
    "default_box",
    "distil",
    "errors",
    "evaluate",
    "export",
    "fit",
    "follow",
    "following",
    "generate_c",
    "grow",
    "involutivity",
    "jumps",
    "lie_bracket",
    "load",
    "loss",
    "obstacles",
    "parametrisations",
    "plotting",
    "problems",
    "register_loss_term",
    "register_parametrisation",
    "simulate",
    "simulation",
    "singular_points",
    "solvers",
    "suggest_domain",
]


def __getattr__(name: str) -> object:
    """Import `plotting` on first use: it needs matplotlib, which takes half a second to import."""
    if name == "plotting":
        return _import_module("orthocas.plotting")
    raise AttributeError(f"module 'orthocas' has no attribute '{name}'")


def __dir__() -> list[str]:
    """The public names; internal modules are imported by their full names."""
    return [*__all__, "__version__"]
