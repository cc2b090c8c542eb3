"""orthocas: joint-space coordinates that a redundant robot's task does not disturb, with CasADi."""

import os as _os
import sys as _sys
from importlib import import_module as _import_module
from pathlib import Path as _Path
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING

from orthocas.cli.entry import is_command_line as _is_command_line
from orthocas.cli.entry import leave_on_ctrl_c as _leave_on_ctrl_c
from orthocas.version import VERSION as _VERSION

if _is_command_line():
    _leave_on_ctrl_c()  # what a command imports takes half a second

if "ORTHOCAS_PARENT" in _os.environ:  # a process that shares work of another one, see `orthocas.comparing.workers`
    _import_module("orthocas.comparing.workers").end_early_with_parent()

# In a checkout, problems/ and solvers/ lie beside this folder, not inside it. Looking one level up keeps
# `orthocas.problems` importable there, whether or not an installed copy exists; a wheel does not run this line.
if not (_Path(__file__).parent / "problems").is_dir():
    __path__.append(str(_Path(__file__).parent.parent))

if TYPE_CHECKING:
    from orthocas import (
        charts,
        control,
        errors,
        following,
        obstacles,
        parametrisations,
        plotting,
        problems,
        simulation,
        solvers,
    )
    from orthocas.atlases.atlas import Atlas
    from orthocas.atlases.building import build_atlas
    from orthocas.atlases.chart_along import chart_along
    from orthocas.atlases.corridor_problem import corridor_problem
    from orthocas.atlases.coverage import Coverage, evaluate_atlas
    from orthocas.atlases.part import AtlasPart
    from orthocas.atlases.plan import AtlasSettings
    from orthocas.certificates import Certificate
    from orthocas.certifying.certify import certified_box, certify
    from orthocas.certifying.check import check_certificate
    from orthocas.chart import Chart, GrownChart, load
    from orthocas.codegen import compile_inverse, generate_c
    from orthocas.comparing.compare import compare
    from orthocas.comparing.report import Comparison
    from orthocas.distil import distil
    from orthocas.domains import Box, Torus, contains, default_box
    from orthocas.exporting.export import export
    from orthocas.fitting.fit import Fit, fit
    from orthocas.fitting.loss import Weights
    from orthocas.fitting.loss import register as register_loss_term
    from orthocas.fitting.symbolic_loss import loss
    from orthocas.following.follow import follow
    from orthocas.grow import grow
    from orthocas.inverting import InverseStatus, Solutions, Tracker, TrackerStatus
    from orthocas.involutivity import Involutivity, involutivity, lie_bracket
    from orthocas.metrics import Metric
    from orthocas.parametrisations import MLP, SEW, Circle, Fourier, Given, Linear, Polynomial, cyclic_joints
    from orthocas.parametrisations import register as register_parametrisation
    from orthocas.postures.clear_box import ClearBox
    from orthocas.postures.corridor import Corridor
    from orthocas.postures.suggest import suggest_domain
    from orthocas.problem import Problem, check
    from orthocas.quality import Report, evaluate
    from orthocas.robots import Robot
    from orthocas.showing.progress import progress
    from orthocas.simulation import simulate, simulate_many
    from orthocas.singularities import jumps, singular_points
    from orthocas.tasks import Task
    from orthocas.viewing.view import view

__version__ = _VERSION
__all__ = [
    "MLP",
    "SEW",
    "Atlas",
    "AtlasPart",
    "AtlasSettings",
    "Box",
    "Certificate",
    "Chart",
    "Circle",
    "ClearBox",
    "Comparison",
    "Corridor",
    "Coverage",
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
    "build_atlas",
    "certified_box",
    "certify",
    "chart_along",
    "charts",
    "check",
    "check_certificate",
    "compare",
    "compile_inverse",
    "contains",
    "control",
    "corridor_problem",
    "cyclic_joints",
    "default_box",
    "distil",
    "errors",
    "evaluate",
    "evaluate_atlas",
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
    "progress",
    "register_loss_term",
    "register_parametrisation",
    "simulate",
    "simulate_many",
    "simulation",
    "singular_points",
    "solvers",
    "suggest_domain",
    "view",
]

# Everything is imported on first use: all of it takes half a second, and few programs need all.
_HOMES = {
    "orthocas.atlases.atlas": ["Atlas"],
    "orthocas.atlases.building": ["build_atlas"],
    "orthocas.atlases.chart_along": ["chart_along"],
    "orthocas.atlases.corridor_problem": ["corridor_problem"],
    "orthocas.atlases.coverage": ["Coverage", "evaluate_atlas"],
    "orthocas.atlases.part": ["AtlasPart"],
    "orthocas.atlases.plan": ["AtlasSettings"],
    "orthocas.certificates": ["Certificate"],
    "orthocas.certifying.certify": ["certified_box", "certify"],
    "orthocas.certifying.check": ["check_certificate"],
    "orthocas.chart": ["Chart", "GrownChart", "load"],
    "orthocas.codegen": ["compile_inverse", "generate_c"],
    "orthocas.comparing.compare": ["compare"],
    "orthocas.comparing.report": ["Comparison"],
    "orthocas.distil": ["distil"],
    "orthocas.domains": ["Box", "Torus", "contains", "default_box"],
    "orthocas.exporting.export": ["export"],
    "orthocas.fitting.fit": ["Fit", "fit"],
    "orthocas.fitting.loss": ["Weights", "register as register_loss_term"],
    "orthocas.fitting.symbolic_loss": ["loss"],
    "orthocas.following.follow": ["follow"],
    "orthocas.grow": ["grow"],
    "orthocas.inverting": ["InverseStatus", "Solutions", "Tracker", "TrackerStatus"],
    "orthocas.involutivity": ["Involutivity", "involutivity", "lie_bracket"],
    "orthocas.metrics": ["Metric"],
    "orthocas.parametrisations": [
        *("MLP", "SEW", "Circle", "Fourier", "Given", "Linear", "Polynomial", "cyclic_joints"),
        "register as register_parametrisation",
    ],
    "orthocas.postures.clear_box": ["ClearBox"],
    "orthocas.postures.corridor": ["Corridor"],
    "orthocas.postures.suggest": ["suggest_domain"],
    "orthocas.problem": ["Problem", "check"],
    "orthocas.quality": ["Report", "evaluate"],
    "orthocas.robots": ["Robot"],
    "orthocas.showing.progress": ["progress"],
    "orthocas.simulation": ["simulate", "simulate_many"],
    "orthocas.singularities": ["jumps", "singular_points"],
    "orthocas.tasks": ["Task"],
    "orthocas.viewing.view": ["view"],
}
_PLACES = {name.split()[-1]: (home, name.split()[0]) for home, names in _HOMES.items() for name in names}


class _Package(_ModuleType):
    """This package. `orthocas.grow`, `distil` and `involutivity` stay the functions of modules of the same names."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _PLACES and isinstance(value, _ModuleType)):  # Python sets modules that are imported
            super().__setattr__(name, value)


_sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    """A public name, imported on first use."""
    if name in _PLACES:
        home, own_name = _PLACES[name]
        found = getattr(_import_module(home), own_name)
    elif name in __all__:
        found = _import_module(f"orthocas.{name}")
    else:
        raise AttributeError(f"module 'orthocas' has no attribute '{name}'")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The public names; internal modules are imported by their full names."""
    return [*__all__, "__version__"]
