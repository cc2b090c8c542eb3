"""Fitting coordinates to a problem: idle joints split off, spectral start, degree continuation, a minimiser."""

import hashlib
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.chart import Chart
from orthocas.checkpoint import Checkpoint, Stage
from orthocas.checks import Array, frozen_array, require_count
from orthocas.coordinates import Coordinates, joint_space
from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.fit_stages import StageRunner
from orthocas.idle_joints import idle_joints
from orthocas.loss import Weights
from orthocas.objective import Monitor, Solver, Status, silent
from orthocas.parametrisations import SEW, Given, GradedParametrisation, JointSpace, Linear, Parametrisation, Polynomial
from orthocas.problem import Problem, ProblemCheck, check
from orthocas.samples import Samples, sample_problem, samples_at

_FIRST_SAMPLES = 1000  # tag of the samples that scale coordinates, apart from those of the stages


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted chart and how it came about."""

    chart: Chart
    stages: tuple[Stage, ...]
    problem_check: ProblemCheck
    idle_joints: tuple[str, ...]  #: joints that are exact coordinates themselves
    seconds: float  #: of this run; those of stages count what ran before a checkpoint too

    @property
    def status(self) -> Status:
        """How the last stage ended; CONVERGED if there was nothing to minimise."""
        return self.stages[-1].result.status if self.stages else Status.CONVERGED


def fit_chart(
    problem: Problem,
    parametrisation: Parametrisation | SEW,
    solver: Solver,
    weights: Weights,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
    max_mutual_deg: float | None = None,
    checkpoint: str | Path | None = None,
    starter: Solver | None = None,
) -> Fit:
    """Fit coordinates; see `orthocas.fit`, which fills in the default solver."""
    start = time.perf_counter()
    samples = None if samples is None else require_count("samples", samples, least=2)
    seed = require_count("seed", seed, least=0)
    max_mutual = _in_radians(max_mutual_deg)
    found = check(problem, seed=seed)
    first = sample_problem(problem, 200, (seed, _FIRST_SAMPLES))
    space = joint_space(problem)
    parametrisation = parametrisation.for_problem(problem) if isinstance(parametrisation, SEW) else parametrisation
    in_closed_form = isinstance(parametrisation, Linear | Given)
    if in_closed_form and max_mutual is not None:
        raise InvalidValueError("max_mutual_deg", f"given with {parametrisation.label}", "a parametrisation to fit")
    idle = [] if in_closed_form else idle_joints(problem, first)[-problem.r :]
    active = [i for i in range(problem.n) if i not in idle]
    settings = _settings(problem, parametrisation, solver, weights, samples, seed, max_mutual_deg)
    runner = StageRunner(
        problem,
        space.restricted_to(active),
        active,
        weights,
        max_mutual,
        samples,
        seed,
        monitor,
        Checkpoint(None if checkpoint is None else Path(checkpoint), settings),
        starter,
    )
    stages, parametrisation, theta = _solved(runner, parametrisation, problem.r - len(idle), solver)
    coordinates = _normalised(problem, parametrisation, space, tuple(idle), theta, problem.r - len(idle), first)
    return Fit(
        chart=Chart(problem, coordinates, _notes(stages, solver, weights, seed)),
        stages=tuple(stages),
        problem_check=found,
        idle_joints=tuple(problem.robot.joint_names[i] for i in idle),
        seconds=time.perf_counter() - start,
    )


def _settings(
    problem: Problem,
    parametrisation: Parametrisation,
    solver: Solver,
    weights: Weights,
    samples: int | None,
    seed: int,
    max_mutual_deg: float | None,
) -> dict[str, str]:
    """What tells one fit from another, for its checkpoint."""
    return {
        "problem": _digest(sample_problem(problem, 20, (0, _FIRST_SAMPLES))),
        "parametrisation": parametrisation.label,
        "solver": repr(solver),
        "weights": repr(weights),
        "samples": repr(samples),
        "seed": repr(seed),
        "max_mutual_deg": repr(max_mutual_deg),
    }


def _solved(
    runner: StageRunner, parametrisation: Parametrisation, r: int, solver: Solver
) -> tuple[list[Stage], Parametrisation, Array]:
    """Stages of the fit, the parametrisation reached, and its parameters."""
    if r == 0:
        return [], Polynomial(1), np.zeros(0)
    if isinstance(parametrisation, Linear):
        return [], parametrisation, _linear_normals(runner.problem, parametrisation)
    if isinstance(parametrisation, Given):
        return [], parametrisation, np.zeros(0)
    if isinstance(parametrisation, GradedParametrisation):
        stages, reached = runner.graded(parametrisation, r, solver)
        return stages, reached, stages[-1].result.theta
    stage = runner.stage(parametrisation, parametrisation.family(runner.space, r), None, solver)
    return [stage], parametrisation, stage.result.theta


def _notes(stages: list[Stage], solver: Solver, weights: Weights, seed: int) -> dict[str, str | float]:
    """How a chart was made."""
    return {
        "solver": solver.name if stages else "closed form",
        "lambda1": weights.task,
        "lambda2": weights.mutual,
        "lambda3": weights.regularity,
        "lambda4": weights.length,
        "seed": seed,
        "samples": stages[-1].samples if stages else 0,
        "status": stages[-1].result.status.value if stages else Status.CONVERGED.value,
    }


def _in_radians(max_mutual_deg: float | None) -> float | None:
    if max_mutual_deg is None:
        return None
    if not 0 < max_mutual_deg < 90:
        raise InvalidValueError("max_mutual_deg", max_mutual_deg, "an angle between 0 and 90 degrees")
    return float(np.radians(max_mutual_deg))


def _digest(samples: Samples) -> str:
    """A fingerprint of a problem: task, metric and domain as they act on some samples."""
    parts = [samples.points, samples.task_jacobian]
    parts += [] if samples.metric_inverse is None else [samples.metric_inverse]
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()[:16]


def _linear_normals(problem: Problem, parametrisation: Linear) -> Array:
    """Normals of linear coordinates at their base, row by row."""
    base = _base(problem, parametrisation)
    at_base = samples_at(problem, base[None, :])
    if len(at_base) == 0:
        raise InvalidValueError("base", base.tolist(), "a joint position where no task gradient vanishes")
    return parametrisation.normal_vectors(at_base.raised(at_base.task_jacobian)[0]).ravel()


def _base(problem: Problem, parametrisation: Linear) -> Array:
    """Base q0 of linear coordinates, (n,)."""
    return frozen_array(
        "base", problem.domain.centre if parametrisation.base is None else parametrisation.base, (problem.n,)
    )


def _normalised(
    problem: Problem,
    parametrisation: Parametrisation,
    space: JointSpace,
    idle: tuple[int, ...],
    theta: Array,
    r: int,
    samples: Samples,
) -> Coordinates:
    """Shift and scale so that xi(centre) = 0 and each coordinate's mean gradient length is 1.

    Linear coordinates keep their unit normals and vanish at their own base.
    """
    raw = Coordinates(parametrisation, space, idle, theta, np.zeros(r), np.ones(r))
    lengths = np.linalg.norm(raw.jacobian(samples.points)[:, :r], axis=2).mean(axis=0)
    if r and not lengths.min() > 0:
        raise OrthocasError(f"coordinate {int(np.argmin(lengths))} has no gradient on the domain")
    base = _base(problem, parametrisation) if isinstance(parametrisation, Linear) else problem.domain.centre
    offset = raw.xi(base[None, :])[0, :r]
    scale = np.ones(r) if isinstance(parametrisation, Linear) else 1 / lengths
    return Coordinates(parametrisation, space, idle, theta, offset, scale)
