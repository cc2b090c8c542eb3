"""The result of a simulation: arrays over time with names and units, stored in NPZ files."""

import json
import zipfile
import zlib
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from tokenize import TokenError
from typing import Any, Self

import numpy as np
from scipy.integrate import cumulative_simpson

from orthocas.checks import Array, as_path
from orthocas.errors import TrajectoryFileError
from orthocas.files.atomic import published, require_writable
from orthocas.showing import Shown, listed, number_list

_VERSION = 1
_WRONG_CONTENT = (ValueError, KeyError, TypeError, AttributeError, SyntaxError, TokenError)
_DAMAGE = (*_WRONG_CONTENT, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
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
}


class Outcome(Enum):
    """How a run ended."""

    COMPLETE = "complete"
    INTERRUPTED = "interrupted"  #: by Ctrl-C; the arrays end at that point
    DIVERGED = "diverged"  #: the integrator gave up; the arrays end at that point


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
    dissipated_power: Array  #: (N,) dissipated by the controller's damping [W]; NaN for velocity controllers

    @property
    def energy_balance(self) -> Array:
        """V(t) - V(0) + the energy dissipated until t, (N,) [J].

        It is 0 for impedance control and PD+ (coupled) while the reference is at rest, in continuous time with the true
        model and without friction, pushes, noise, or commands that were clipped or replaced by the fallback.
        """
        lost = cumulative_simpson(self.dissipated_power, x=self.times, initial=0.0)
        return np.asarray(self.storage - self.storage[0] + lost)

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
        bad = np.count_nonzero(self.status)
        facts = {
            "run": f"{self.controller}, {self.times[-1]:.4g} s: {self.outcome.value}",
            "instants": f"{len(self.times)} of {self.q.shape[1]} joints",
            "largest error": listed(f"{label} {error:.3g}" for label, error in errors),
            f"largest {self.kind}": number_list(np.abs(self.command).max(axis=0)),
            "fallback": f"at {bad} instants" if bad else "never",
        }
        return facts if np.isnan(self.storage).any() else facts | {"storage rise": f"{self.storage_rise:.3g} J"}

    def save(self, path: str | Path) -> None:
        """Write an NPZ file with all arrays, names and units. The file appears whole or not at all.

        Raises:
            TrajectoryFileError: if the folder is missing or not writable.
        """
        target = as_path("path", path)
        require_writable(target, TrajectoryFileError)
        header = {
            "version": _VERSION,
            "controller": self.controller,
            "kind": self.kind,
            "outcome": self.outcome.value,
            "labels": self.labels,
            "joint_names": self.joint_names,
            "units": _ARRAYS,
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        with published(target.parent) as drafts, (drafts / target.name).open("wb") as draft:
            np.savez_compressed(draft, header=json.dumps(header), **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file that `save` wrote. Loading never runs code.

        Raises:
            TrajectoryFileError: if the file is missing, damaged, foreign or from a newer version.
        """
        path = as_path("path", path)
        damaged = TrajectoryFileError(f"{path} is truncated, damaged or not a trajectory file")
        try:
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:  # np.load leaks bad handles
                header: dict[str, Any] = json.loads(str(file["header"]))
                arrays: dict[str, Any] = {name: file[name] for name in _ARRAYS}
            version = header["version"]
        except FileNotFoundError:
            raise TrajectoryFileError(f"trajectory file {path} does not exist") from None
        except _DAMAGE:
            raise damaged from None
        if version != _VERSION:
            raise TrajectoryFileError(f"{path} has version {version}, this orthocas reads {_VERSION}")
        try:
            labels, joint_names = tuple(header["labels"]), tuple(header["joint_names"])
            outcome = Outcome(header["outcome"])
            run = cls(header["controller"], header["kind"], outcome, labels, joint_names, **arrays)
        except _DAMAGE:
            raise damaged from None
        if run.q.shape != (len(run.times), len(run.joint_names)) or run.value.shape != (
            len(run.times),
            len(run.labels),
        ):
            raise damaged
        return run


assert set(_ARRAYS) < {field.name for field in fields(Trajectory)}
