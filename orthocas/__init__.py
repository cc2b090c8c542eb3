"""orthocas: joint-space coordinates that a redundant robot's task does not disturb, with CasADi."""

from pathlib import Path as _Path

# In a checkout, problems/ and solvers/ lie beside this folder, not inside it. Looking one level up keeps
# `orthocas.problems` importable there, whether or not an installed copy exists; a wheel does not take this line.
if not (_Path(__file__).parent / "problems").is_dir():
    __path__.append(str(_Path(__file__).parent.parent))

from orthocas import control, problems, simulation, solvers
from orthocas.chart import Chart, GrownChart, load
from orthocas.codegen import generate_c
from orthocas.comparing.compare import compare
from orthocas.distil import distil
from orthocas.domains import Box, Torus, contains
from orthocas.fitting.fit import fit
from orthocas.grow import grow
from orthocas.involutivity import Involutivity, involutivity, lie_bracket
from orthocas.parametrisations import MLP, SEW, Fourier, Given, Linear, Polynomial
from orthocas.problem import Problem, check
from orthocas.quality import Report, evaluate
from orthocas.robots import Robot
from orthocas.simulation import simulate
from orthocas.singularities import jumps, singular_points
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
