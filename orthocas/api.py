"""The front door: fit, with a default parametrisation and solver, and load."""

from pathlib import Path

from orthocas.chart import Chart
from orthocas.checks import as_float_array
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.fitting import Fit, fit_chart
from orthocas.loss import DEFAULT_WEIGHTS, Weights
from orthocas.objective import Monitor, Solver, silent
from orthocas.parametrisations import SEW, GradedParametrisation, Linear, Parametrisation, Polynomial
from orthocas.problem import Problem
from orthocas.solvers import LBFGS, GaussNewton, Ipopt


def fit(
    problem: Problem,
    parametrisation: Parametrisation | SEW | None = None,
    solver: Solver | None = None,
    weights: tuple[float, float] | tuple[float, float, float] = DEFAULT_WEIGHTS,
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
            on the front. (lambda1, lambda2, lambda3) adds the regularity term (ours), which keeps the gradients of
            the coordinates from collapsing anywhere.
        samples: number of samples; default grows with the number of parameters.
        seed: seed of samples and of random starts.
        monitor: called with progress.
        max_mutual_deg: the constrained form: the smallest task term at mutual angles of this standard deviation
            [deg] on the samples, found by Ipopt; lambda2 is not used then.
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
    if solver is None:
        linear = isinstance(parametrisation, GradedParametrisation | Linear)
        solver = (GaussNewton() if linear else LBFGS()) if max_mutual_deg is None else Ipopt()
    if not isinstance(solver, Solver):
        raise InvalidValueError("solver", repr(solver), "an object such as GaussNewton()")
    if max_mutual_deg is not None and not isinstance(solver, Ipopt):
        raise InvalidValueError("solver", solver.name, "ipopt, which alone can keep max_mutual_deg")
    values = as_float_array("weights", weights)
    if values.shape not in ((2,), (3,)):
        raise ShapeError("weights", values.shape, (3,))
    loss = Weights(*values.tolist())
    if loss.task == 0:
        raise InvalidValueError("lambda1", loss.task, "a positive number")
    return fit_chart(problem, parametrisation, solver, loss, samples, seed, monitor, max_mutual_deg, checkpoint)


def load(path: str | Path) -> Chart:
    """Read a chart file; see `Chart.load`."""
    return Chart.load(path)
