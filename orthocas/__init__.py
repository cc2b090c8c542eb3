"""orthocas: joint-space coordinates that a redundant robot's task does not disturb, with CasADi."""

from pathlib import Path as _Path

# In a checkout, problems/ and solvers/ lie beside this folder, not inside it. Looking one level up keeps
# `orthocas.problems` importable there, whether or not an installed copy exists; a wheel does not take this line.
if not (_Path(__file__).parent / "problems").is_dir():
    __path__.append(str(_Path(__file__).parent.parent))

from orthocas import control, problems, simulation, solvers
from orthocas.api import compare, distil, fit, load
from orthocas.chart import Chart
from orthocas.codegen import generate_c
from orthocas.domains import Box, Torus, contains
from orthocas.grown_chart import GrownChart, grow
from orthocas.involutivity import Involutivity, involutivity
from orthocas.parametrisations import MLP, SEW, Fourier, Given, Linear, Polynomial
from orthocas.problem import Problem, check
from orthocas.quality import Report, evaluate
from orthocas.robots import Robot
from orthocas.simulation import simulate
from orthocas.singularities import jumps, singular_points
from orthocas.task_brackets import lie_bracket
from orthocas.tasks import Task
from orthocas.version import VERSION as _VERSION

__version__ = _VERSION
__all__ = [
    "MLP",
    "SEW",
    "Box",
    "Chart",
    "Fourier",
    "Given",
    "GrownChart",
    "Involutivity",
    "Linear",
    "Polynomial",
    "Problem",
    "Report",
    "Robot",
    "Task",
    "Torus",
    "check",
    "compare",
    "contains",
    "control",
    "distil",
    "evaluate",
    "fit",
    "generate_c",
    "grow",
    "involutivity",
    "jumps",
    "lie_bracket",
    "load",
    "problems",
    "simulate",
    "simulation",
    "singular_points",
    "solvers",
]
