"""The result of a simulation: arrays over time with names and units, stored in NPZ files."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from orthocas.charts.chart import Chart
from orthocas.control.controller import FROM_THE_LAW, Controller, ControlStatus
from orthocas.control.reference import Reference
from orthocas.errors import InvalidValueError, OrthocasError, TrajectoryFileError
from orthocas.simulation.disturbances import RULES, Push
from orthocas.tools.archive import Stored, open_archive, read_npy
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import building
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_path,
    freeze_indices,
    require_kind,
    require_known,
    require_shape,
    require_text,
)
from orthocas.tools.display import Shown, listed, number_list
from orthocas.tools.expressions import wrap_shortest
from orthocas.tools.files import is_numpy_archive, publish, require_replaceable, require_writable
from orthocas.tools.interrupts import deferred
from orthocas.tools.json import get_part, read_strict_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_VERSION = 1
_ARRAYS = {  #: array fields and their units
    "times": "s",
    "q": "rad or m",
    "dq": "rad/s or m/s",
    "command": "N m or N (torque), rad/s or m/s (velocity)",
    "status": "orthocas.control.ControlStatus",
    "value": "per label: m or rad for the task, the chart's unit for extra coordinates",
    "reference": "as value",
    "reference_velocity": "value / s",
    "reference_acceleration": "value / s^2",
    "storage": "J",
    "dissipated_power": "W",
    "cause": "orthocas.control.ControlStatus",
}
_LATER = ("cause",)  #: arrays that files of older versions lack
_SINGLE = ("times", "status", "storage", "dissipated_power", "cause")  #: arrays with one number per instant
_OF_JOINTS = ("q", "dq", "command")  #: arrays with one number per joint; the others have one per label
_REQUIRED = tuple(name for name in _ARRAYS if name not in _LATER)


def read_run_file(path: Path) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Header and arrays of a run; newer arrays are optional, and unknown entries are ignored.

    Raises:
        TrajectoryFileError: if the file is missing, damaged, foreign or from a newer version.
    """
    with open_archive(path, "trajectory", TrajectoryFileError) as zipped:
        entries = ["header", *_REQUIRED, *(name for name in _LATER if f"{name}.npy" in zipped.sizes)]
        zipped.require_room([f"{name}.npy" for name in entries])
        try:
            stored = {name: read_npy(zipped.read(f"{name}.npy")) for name in entries}
            header = read_strict_json(str(stored.pop("header")))
        except ValueError as error:
            if isinstance(error, TrajectoryFileError):
                raise
            raise TrajectoryFileError(f"{path} contains an array or a header that cannot be read: {error}") from None
    if not isinstance(header, dict) or header.get("version") != _VERSION:
        saved = header.get("version") if isinstance(header, dict) else None
        raise TrajectoryFileError(f"{path} has version {saved}, this orthocas reads {_VERSION}")
    return header, stored


class Outcome(Enum):
    """How a run ended."""

    COMPLETE = "complete"
    INTERRUPTED = "interrupted"  #: by Ctrl-C; the arrays end at that point
    DIVERGED = "diverged"  #: the integrator failed; the arrays end at that point
    LOST = "lost"  #: the law lost the arm, see `Trajectory.reason`; the arrays are complete


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Shown):
    """A closed loop over time: N instants, n joints, k controlled quantities.

    `orthocas.simulation.figure.trajectory_figure` draws it.
    """

    controller: str
    kind: str  #: kind of the command, 'torque' or 'velocity'
    outcome: Outcome
    labels: tuple[str, ...]  #: names of the k quantities
    joint_names: tuple[str, ...]
    times: Array  #: (N,) [s]
    q: Array  #: (N, n)
    dq: Array  #: (N, n)
    command: Array  #: (N, n) torques or velocities
    status: Array  #: (N,) of the controller, `orthocas.control.ControlStatus`
    value: Array  #: (N, k) the controlled quantities
    reference: Array  #: (N, k) their references
    reference_velocity: Array  #: (N, k)
    reference_acceleration: Array  #: (N, k)
    storage: Array  #: (N,) V [J]; NaN for velocity controllers
    dissipated_power: Array  #: (N,) power dissipated by the controller's damping [W]; NaN for velocity controllers
    cause: Array  #: (N,) reason of the last catch of a supervised law, `ControlStatus`; OK if there was none
    reason: str = ""  #: reason of the outcome LOST, in words

    @property
    def energy_balance(self) -> Array:
        """V(t) - V(0) + the energy dissipated until t, (N,) [J].

        For impedance control and PD+ (coupled), it is 0 while the reference is at rest, in continuous time, with the
        exact model, and without friction, pushes, noise, limited commands and fallback.
        """
        lost = scipy.integrate.cumulative_simpson(self.dissipated_power, x=self.times, initial=0.0)
        return np.asarray(self.storage - self.storage[0] + lost)

    @property
    def fell_back(self) -> NDArray[np.bool_]:
        """Whether the command was the fallback instead of the law's, (N,)."""
        return ~np.isin(self.status, FROM_THE_LAW)

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Whether the limit cut the command of the law, (N,)."""
        return np.asarray(self.status == ControlStatus.SATURATED)

    @property
    def seconds_in_status(self) -> dict[ControlStatus, float]:
        """Duration of each status that occurred [s]; a status holds until the next instant."""
        lasting = np.diff(self.times)
        return {ControlStatus(int(s)): float(lasting[self.status[:-1] == s].sum()) for s in np.unique(self.status)}

    @property
    def catches(self) -> tuple[tuple[float, ControlStatus], ...]:
        """Times of catches of a supervised law [s] and their reasons; OK if the run started too near the boundary."""
        caught = self.status == ControlStatus.CAUGHT
        first = np.flatnonzero(caught & ~np.concatenate([[False], caught[:-1]]))
        return tuple((float(self.times[i]), ControlStatus(int(self.cause[i]))) for i in first)

    @property
    def storage_rise(self) -> float:
        """Largest rise of V above an earlier value [J]; 0 for a passive controller and a reference at rest."""
        return float((self.storage - np.minimum.accumulate(self.storage)).max())

    @property
    def tracking_error(self) -> Array:
        """Largest |value - reference| of each quantity, (k,)."""
        return np.asarray(np.abs(self.value - self.reference).max(axis=0))

    def facts(self) -> dict[str, str]:
        """Outcome, errors, commands, and whether the controller used its fallback."""
        errors = zip(self.labels, self.tracking_error, strict=True)
        bad, cut = np.count_nonzero(self.fell_back), np.count_nonzero(self.saturated)
        end = self.outcome.value + (f", {self.reason}" if self.reason else "")
        facts = {
            "run": f"{self.controller}, {self.times[-1]:.4g} s: {end}",
            "instants": f"{len(self.times)} of {self.q.shape[1]} joints",
            "largest error": listed(f"{label} {error:.3g}" for label, error in errors),
            f"largest {self.kind}": number_list(np.abs(self.command).max(axis=0)),
            "fallback": f"at {bad} instants" if bad else "never",
            "limit reached": f"at {cut} instants" if cut else "never",
        }
        if self.catches:
            facts["caught"] = listed(f"at {time:.4g} s ({cause.words})" for time, cause in self.catches)
        return facts if np.isnan(self.storage).any() else facts | {"storage rise": f"{self.storage_rise:.3g} J"}

    def plot(self, units: Mapping[str, str] | None = None) -> "Figure":
        """Quantities, joints and commands over time, as a matplotlib figure.

        Args:
            units: units of the quantities by label, as from `orthocas.simulation.figure.units_of(problem)`.
        """
        # matplotlib takes long to import.
        from orthocas.simulation.figure import trajectory_figure

        return trajectory_figure(self, units)

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write an NPZ file with all arrays, names and units. The file appears complete or not at all.

        It replaces a trajectory file of the same name; with `force` also any other file.

        Raises:
            TrajectoryFileError: if the folder is missing or not writable, or the path is a symbolic link or a file that
                is not a trajectory.
        """
        target = as_path("path", path)
        require_writable(target, TrajectoryFileError)
        require_replaceable(target, is_numpy_archive(target, ("header", *_REQUIRED)), force, TrajectoryFileError)
        # The header holds everything that is not an array.
        header = {
            "version": _VERSION,
            "controller": self.controller,
            "kind": self.kind,
            "outcome": self.outcome.value,
            **({"reason": self.reason} if self.reason else {}),
            "labels": self.labels,
            "joint_names": self.joint_names,
            "units": _ARRAYS,
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        with publish(target.parent) as drafts, (drafts / target.name).open("wb") as draft:
            np.savez_compressed(draft, header=json.dumps(header), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file that `save` wrote. Loading never runs code.

        Raises:
            TrajectoryFileError: if the file is missing, damaged, foreign or from a newer version.
        """
        path = as_path("path", path)
        header, arrays = read_run_file(path)
        try:
            # Read the header first, because it determines the shapes of the arrays.
            names: dict[str, Any] = {name: tuple(get_part(header, name, list)) for name in ("labels", "joint_names")}
            for what, texts in names.items():
                if not texts:
                    raise InvalidValueError(what, "empty", "at least one name")
                for k, text in enumerate(texts):
                    require_text(f"{what}[{k}]", text)
            require_known("kind of command", get_part(header, "kind", str), ("torque", "velocity"))
            require_known("outcome", get_part(header, "outcome", str), [outcome.value for outcome in Outcome])
            controller = require_text("controller", get_part(header, "controller", str))
            # Arrays have one row per instant, as wide as the kind of quantity.
            n, k, N = len(names["joint_names"]), len(names["labels"]), arrays["times"].size
            checked: dict[str, Any] = {}
            for name, array in arrays.items():
                checked[name] = as_float_array(name, array)
                width = () if name in _SINGLE else (n,) if name in _OF_JOINTS else (k,)
                require_shape(name, checked[name].shape, (N, *width))
            # Files of early versions have no causes.
            checked.setdefault("cause", np.zeros(N))
            for name in ("status", "cause"):
                checked[name] = freeze_indices(name, checked[name], (N,), len(ControlStatus))
            if N == 0 or not np.isfinite(checked["times"]).all() or (np.diff(checked["times"]) <= 0).any():
                raise InvalidValueError("times", "empty or not increasing", "increasing instants, at least one")
            own: dict[str, Any] = {
                "controller": controller,
                "kind": header["kind"],
                "outcome": Outcome(header["outcome"]),
                "reason": require_text("reason", header["reason"]) if "reason" in header else "",
            }
            return cls(**own, **names, **checked)
        except OrthocasError as error:
            raise TrajectoryFileError(f"{path} is inconsistent: {error}") from None


assert set(_ARRAYS) < {field.name for field in fields(Trajectory)}


def find_loss(run: Trajectory, controller: Controller, pushes: Sequence[Push], supervised: bool) -> str:
    """Find why a law lost the arm in a run; returns the reason in words, empty if it kept the arm.

    A law loses the arm in two ways. First, the arm leaves the domain of the law's chart, outside of which the law
    commands nothing, or the joint limits if the law has no chart. A supervised law may return from there, and its
    catcher may hold the arm outside.

    Second, motors are saturated for some time, and afterwards the storage V (the energy of springs and motion) is
    larger than before. This counts if the saturation lasts to the end of the run, or if the catcher of a supervised law
    took over during it without a push.

    Args:
        run: the run, in the quantities of the law.
        controller: the law.
        pushes: pushes on the arm.
        supervised: whether the law was supervised.
    """
    # Instants at which the arm is outside, (N,).
    if controller.chart is not None:
        outside, what = np.asarray(~controller.problem.domain.contains(run.q)), "the domain of the chart"
    else:
        robot = controller.problem.robot
        beyond = (run.q < robot.lower - RULES.beyond) | (run.q > robot.upper + RULES.beyond)
        outside, what = np.asarray(beyond.any(axis=1)), "the joint limits"
    held = supervised and run.status[-1] in (ControlStatus.CAUGHT, ControlStatus.RETURNING)
    if (outside[-1] and not held) or (outside.any() and not supervised):
        first, _ = next(_find_stretches(outside))
        left = "was outside" if first == 0 else "left"
        return f"the arm {left} {what} at t = {run.times[first]:.4g} s"

    # Look for intervals inside with saturated motors and growing errors.
    at_limit = np.abs(run.command) >= controller.gains["limit"]
    for first, last in _find_stretches(np.asarray(at_limit.any(axis=1))):
        since, until = run.times[[first, last]]
        pushed = any(push.start < until and push.end > since for push in pushes)
        caught = (run.status[first : last + 1] == ControlStatus.CAUGHT).any() and not pushed
        growing = run.storage[last] > run.storage[first]
        if (caught or last == len(run.times) - 1) and until - since > RULES.lasting and growing:
            joint = run.joint_names[int(np.argmax(at_limit[first : last + 1].sum(axis=0)))]
            return f"from t = {since:.4g} s to {until:.4g} s joint '{joint}' was at its limit, and errors grew"
    return ""


def _find_stretches(true: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and last index of every run of consecutive true entries."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(int)))
    for first, end in edges.reshape(-1, 2).tolist():
        yield first, end - 1


@dataclass(frozen=True, eq=False, repr=False)
class Coupling(Shown):
    """Coupling indices. Rows are disturbed coordinates, columns are commanded coordinates."""

    labels: tuple[str, ...]  #: of phi = [x; xi]
    index: Array  #: (n, n) [unit of the row / unit of the column]; NaN where a coordinate was never commanded alone

    def of(self, disturbed: str, commanded: str) -> float:
        """The index of a pair of labels: how much steps of `commanded` disturb `disturbed`."""
        return float(self.index[self.labels.index(disturbed), self.labels.index(commanded)])

    def facts(self) -> dict[str, str]:
        """For each commanded coordinate, the one that it disturbs most."""
        known = [j for j in range(len(self.labels)) if np.isfinite(self.index[:, j]).any()]
        worst = {j: int(np.nanargmax(self.index[:, j])) for j in known}
        found = {f"steps of {self.labels[j]}": f"{self.index[i, j]:.3g} in {self.labels[i]}" for j, i in worst.items()}
        return {"coupling": f"{len(known)} of {len(self.labels)} coordinates commanded alone", **found}


def coupling_index(chart: Chart, reference: Reference, trajectory: Trajectory) -> Coupling:
    """Largest deviation of each coordinate while only one other is commanded, divided by the commanded step.

    Deviations are measured from the reference. Steps that change several targets at once are ignored. For several steps
    of one coordinate, the worst counts. Motion that remains from an earlier step counts too, so let the arm come to
    rest between steps.

    Args:
        chart: the chart whose coordinates are evaluated, even if the controller does not use them.
        reference: steps in phi = [x; xi], `Reference.steps` with `chart.labels`.
        trajectory: the run.

    Raises:
        InvalidValueError: if the reference has other labels.

    Source:
        ours
    """
    require_kind("chart", chart, Chart)
    require_kind("reference", reference, Reference)
    require_kind("trajectory", trajectory, Trajectory)
    if reference.labels != chart.labels:
        raise InvalidValueError("labels of the reference", reference.labels, f"the labels {chart.labels} of the chart")
    wanted = reference.sample(np.minimum(trajectory.times, reference.duration))[0]
    away = np.abs(wrap_shortest(chart.phi(trajectory.q) - wanted, chart.parts.turns))
    # Between two steps, only the commanded coordinate should move.
    steps = np.diff(np.vstack([reference.start, reference.targets]), axis=0)
    index = np.full((chart.n, chart.n), np.nan)
    for segment, step in enumerate(steps):
        moved = np.flatnonzero(np.abs(step) > RULES.no_step)
        begin, end = reference.times[segment : segment + 2]
        inside = (trajectory.times >= begin) & (trajectory.times <= end)
        if len(moved) == 1 and inside.any():
            worst = away[inside].max(axis=0) / abs(step[moved[0]])
            worst[moved] = np.nan
            index[:, moved[0]] = np.fmax(index[:, moved[0]], worst)
    return Coupling(chart.labels, index)


@dataclass(frozen=True, eq=False)
class Breakdown:
    """Terms of the task acceleration dd_x along a run, each (N, m), which sum to dd_x."""

    labels: tuple[str, ...]  #: of x
    own: Array = field(repr=False)  #: J_x M^-1 J_x^T f_x, the effect of the task force
    error: Array = field(repr=False)  #: J_x M^-1 J_xi^T f_xi, [AS2023] eq. (38); 0 where (5) holds with A = M
    curvature: Array = field(repr=False)  #: dJ_x/dt dq
    coriolis: Array = field(repr=False)  #: -J_x M^-1 C dq

    @property
    def total(self) -> Array:
        """dd_x, (N, m)."""
        return self.own + self.error + self.curvature + self.coriolis


def task_acceleration_breakdown(chart: Chart, trajectory: Trajectory) -> Breakdown:
    """Split dd_x into the terms of the first rows of [AS2023] eq. (34), with f_phi = J^-T (tau - g).

    The terms use the controller's robot model, without pushes and friction.

    Args:
        chart: the chart whose coordinates define the terms.
        trajectory: a run of any torque controller.

    Raises:
        InvalidValueError: if the trajectory belongs to a velocity controller.
    """
    require_kind("chart", chart, Chart)
    require_kind("trajectory", trajectory, Trajectory)
    if trajectory.kind != "torque":
        raise InvalidValueError("trajectory", f"a run of '{trajectory.controller}'", "a run of a torque controller")
    # Forces f_phi = J^-T (tau - g), and dd_x = J_x M^-1 (J^T f - C dq) + dJ_x/dt dq. Threads share the chart.
    with deferred(), building:
        n, m, robot = chart.n, chart.m, chart.problem.robot
        q, dq, tau = (ca.MX.sym(name, n) for name in ("q", "dq", "tau"))
        J = chart.function("jacobian")(q)
        f = ca.solve(J.T, tau - robot.gravity(q))
        mobility = ca.solve(robot.mass_matrix(q), J[:m, :].T).T  # J_x M^-1
        own, error = mobility @ J[:m, :].T @ f[:m], mobility @ J[m:, :].T @ f[m:]
        curvature = chart.function("second_derivative")(q, dq, dq)[:m]
        coriolis = -mobility @ robot.coriolis_product(q, dq, dq)
        function = dense_function("breakdown", [q, dq, tau], [own, error, curvature, coriolis], ["q", "dq", "tau"])
    parts = Batched(function)(trajectory.q, trajectory.dq, trajectory.command)
    return Breakdown(chart.problem.task.labels, *parts)
