"""Many runs that differ in some arguments: Monte Carlo over masses, pushes, gains, starts (ours)."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any

from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import THREADS
from orthocas.checks import require_executor, require_kind, require_known
from orthocas.control.controller import Controller
from orthocas.control.reference import Reference
from orthocas.errors import Interrupted
from orthocas.minimising.watch import Monitor, Progress, silent
from orthocas.simulation.prepared import Prepared, Settings, prepare
from orthocas.simulation.run import simulate
from orthocas.simulation.trajectory import Trajectory

_POSITIONAL = ("controller", "reference", "q_start")
_DEFAULTS = {
    name: parameter.default
    for name, parameter in inspect.signature(simulate).parameters.items()
    if name not in (*_POSITIONAL, "monitor")
}


def simulate_many(
    controller: Controller,
    reference: Reference,
    q_start: ArrayLike,
    changes: Sequence[Mapping[str, Any]],
    *,
    executor: Executor | None = None,
    monitor: Monitor = silent,
    **settings: Any,
) -> tuple[Trajectory, ...]:
    """Simulate one run for each entry of `changes`, which holds the arguments of `simulate` that differ in it.

    Args:
        controller: as in `simulate`, as are reference and q_start.
        reference: the motion to follow.
        q_start: joint positions at t = 0, (n,) [rad] or [m].
        changes: for each run, arguments of `simulate` by name: plant, pushes, friction, noise, controller, q_start, ...
        executor: shares the runs, for example `concurrent.futures.ProcessPoolExecutor`, or
            `distributed.Client(...).get_executor()` of Dask. Default: this process, with as many threads as
            OMP_NUM_THREADS or the number of cores says where runs are compiled.
        monitor: called with progress.
        settings: further arguments of `simulate` that all runs share, such as `control_rate` and `compiled`. With
            `compiled=True`, runs that differ in masses, friction, gains or sizes of pushes share one library.

    Returns:
        The trajectories in the order of `changes`.

    Raises:
        UnknownNameError: if `simulate` has no such argument.
        UnreachableReferenceError, ShapeError, InvalidValueError, CompileError: as `simulate`.
        Interrupted: after Ctrl-C; its `result` has the trajectories that were ready.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> problem = problems.get("planar_3r_xy")
        >>> chart = oc.fit(problem, oc.Polynomial(degree=2), samples=300).chart
        >>> controller, centre = oc.control.PDPlus(chart, stiffness=50.0), problem.domain.centre
        >>> reference = oc.control.Reference.steps(chart.labels, chart.phi(centre), [], duration=0.2)
        >>> heavier = [{"plant": problem.robot.with_scaled_masses(scale)} for scale in (1.0, 1.2)]
        >>> runs = oc.simulate_many(controller, reference, centre, heavier)
        >>> [bool(abs(run.q - centre).max() > 1e-3) for run in runs]  # the heavier arm sags
        [False, True]
    """
    require_executor(executor)
    common = {"controller": controller, "reference": reference, "q_start": q_start, **settings}
    calls = _calls(common, changes)
    if executor is not None:
        return _shared(executor, [partial(simulate, **call) for call in calls], monitor)
    ready = [partial(_prepared(call).run, silent) for call in calls]  # CasADi must not build functions in threads
    if THREADS > 1 and all(call.get("compiled") for call in calls):
        with ThreadPoolExecutor(THREADS) as pool:
            return _shared(pool, ready, monitor)
    return _one_by_one(ready, monitor)


def _calls(common: Mapping[str, Any], changes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Arguments of `simulate` for each run."""
    require_kind("changes", changes, Sequence)
    for k, change in enumerate(changes):
        require_kind(f"changes[{k}]", change, Mapping)
        for name in (*common, *change):
            require_known("argument of simulate", name, (*_POSITIONAL, *_DEFAULTS))
    return [{**common, **change} for change in changes]


def _prepared(call: Mapping[str, Any]) -> Prepared:
    given = {**_DEFAULTS, **call}
    controller, reference, q_start = (given.pop(name) for name in _POSITIONAL)
    return prepare(controller, reference, q_start, Settings(**given))


def _one_by_one(runs: Sequence[Callable[[], Trajectory]], monitor: Monitor) -> tuple[Trajectory, ...]:
    done: list[Trajectory] = []
    try:
        for run in runs:
            done.append(run())
            _report(monitor, len(done), len(runs))
    except KeyboardInterrupt:
        raise Interrupted(tuple(done)) from None
    return tuple(done)


def _shared(executor: Executor, runs: Sequence[Callable[[], Trajectory]], monitor: Monitor) -> tuple[Trajectory, ...]:
    futures = [executor.submit(run) for run in runs]
    try:
        for done, future in enumerate(as_completed(futures), start=1):
            future.result()  # a run that fails ends all
            _report(monitor, done, len(runs))
        return tuple(future.result() for future in futures)
    except KeyboardInterrupt:
        ready = tuple(future.result() for future in futures if future.done() and not future.exception())
        raise Interrupted(ready) from None
    finally:
        for future in futures:
            future.cancel()


def _report(monitor: Monitor, done: int, count: int) -> None:
    monitor(Progress("simulate many", done / count, f"{done} of {count} runs"))
