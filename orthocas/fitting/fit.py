"""Fitting coordinates to a problem: idle joints split off, spectral start, degree continuation, a minimiser."""

import hashlib
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocas.chart import Chart
from orthocas.checks import Array, frozen_array, require_count
from orthocas.coordinates.fitted import Coordinates, joint_space
from orthocas.errors import InvalidValueError, OrthocasError
from orthocas.fitting.checkpoint import Checkpoint, Stage
from orthocas.fitting.idle_joints import idle_joints
from orthocas.fitting.loss import DEFAULT_WEIGHTS, WeightNumbers, Weights
from orthocas.fitting.stages import StageRunner
from orthocas.minimising.solver import Solver, Status
from orthocas.minimising.watch import Monitor, silent
from orthocas.parametrisations import SEW, Given, GradedParametrisation, JointSpace, Linear, Parametrisation, Polynomial
from orthocas.problem import Problem, ProblemCheck, check
from orthocas.samples import Samples, sample_problem, samples_at
from orthocas.showing import Shown, listed
from orthocas.solvers import LBFGS, GaussNewton, Ipopt

_FIRST_SAMPLES = 1000  # tag of the samples that scale coordinates, apart from those of the stages


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Shown):
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

    def facts(self) -> dict[str, str]:
        """Status, time, stages and the chart."""
        stages = [f"{stage.label} {stage.result.value:.4g}" for stage in self.stages]
        return {
            "fit": f"{self.chart.coordinates.label}, {self.status.value} after {self.seconds:.3g} s",
            "problem": self.chart.problem.heading,
            "loss": listed(stages) or "nothing to minimise",
            "samples": str(self.chart.notes.get("samples", "")),
            "idle joints": listed(self.idle_joints) or "none",
            "near singular": f"{self.problem_check.singular_share:.3%} of the domain",
        }


def fit(
    problem: Problem,
    parametrisation: Parametrisation | SEW | None = None,
    solver: Solver | None = None,
    *,
    weights: Weights | WeightNumbers = DEFAULT_WEIGHTS,
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
    max_mutual_deg: float | None = None,
    checkpoint: str | Path | None = None,
) -> Fit:
    """Find coordinates xi(q) that are as orthogonal as possible to the task.

    Minimises the mean of [AS2023] eq. (24) over uniform samples of the domain. Joints that the task does not feel
    become coordinates themselves; families linear in their parameters start from a spectral solution of low degree
    and climb degree by degree. Ctrl-C returns the best coordinates so far, with status INTERRUPTED.

    Args:
        problem: robot, task, metric and domain.
        parametrisation: default Polynomial(degree=4).
        solver: default GaussNewton for families linear in their parameters, LBFGS otherwise.
        weights: (lambda1, lambda2) is the loss of the paper: task term against mutual term; their ratio picks a point
            on the front. A third number lambda3 adds the regularity term (ours), which keeps the gradients of the
            coordinates from collapsing anywhere; a fourth, lambda4, the length term (ours), which keeps their lengths
            even.
        samples: number of samples; default grows with the number of parameters.
        seed: seed of samples and of random starts.
        monitor: called with progress.
        max_mutual_deg: the constrained form: the smallest task term while mutual angles deviate from 90 degrees by at
            most this much (root mean square over the samples) [deg], found by Ipopt; lambda2 is not used then.
        checkpoint: a file that keeps the state of a long fit. If it exists, the fit goes on from there.

    Returns:
        The chart, how each stage went, and seconds.

    Raises:
        SingularTaskError, MetricError: if the problem does not pass its own check.
        MemoryNeedError: if the degree is too large for this machine.
        InvalidValueError, SolveError: if settings do not fit together, or the loss is not finite.
        InfeasibleError: if max_mutual_deg cannot be met.
        CheckpointError: if the checkpoint is damaged, or belongs to another fit.
    """
    parametrisation = Polynomial(degree=4) if parametrisation is None else parametrisation
    if not isinstance(parametrisation, Parametrisation | SEW):
        raise InvalidValueError("parametrisation", repr(parametrisation), "an object such as Polynomial(degree=4)")
    solver = _suitable(solver, parametrisation, max_mutual_deg is not None)
    loss = Weights.of(weights)
    starter = None if max_mutual_deg is None else GaussNewton()
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
    settings = _settings(problem, parametrisation, solver, loss, samples, seed, max_mutual_deg)
    runner = StageRunner(
        problem,
        space.restricted_to(active),
        active,
        loss,
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
        chart=Chart(problem, coordinates, _notes(stages, solver, loss, seed)),
        stages=tuple(stages),
        problem_check=found,
        idle_joints=tuple(problem.robot.joint_names[i] for i in idle),
        seconds=time.perf_counter() - start,
    )


def default_solver(parametrisation: Parametrisation | SEW) -> Solver:
    """Gauss-Newton for families linear in their parameters, L-BFGS for others."""
    return GaussNewton() if isinstance(parametrisation, GradedParametrisation | Linear) else LBFGS()


def _suitable(solver: Solver | None, parametrisation: Parametrisation | SEW, bounded: bool) -> Solver:
    """The solver, or the default one; refuses one that cannot keep a bound on mutual angles."""
    if solver is None:
        return Ipopt() if bounded else default_solver(parametrisation)
    if not isinstance(solver, Solver):
        raise InvalidValueError("solver", repr(solver), "an object such as GaussNewton()")
    if bounded and not isinstance(solver, Ipopt):
        raise InvalidValueError("solver", solver.name, "ipopt, which alone can keep max_mutual_deg")
    return solver


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
