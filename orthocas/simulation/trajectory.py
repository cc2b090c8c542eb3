"""What a simulation returns: arrays over time, with names and units, in and out of NPZ files."""

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

from orthocas.checks import Array
from orthocas.errors import TrajectoryFileError
from orthocas.files.atomic import published, require_writable
from orthocas.files.ours import is_numpy_archive, require_replaceable
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
    "value": "as labels: m or rad of the task, coordinates as charted",
    "reference": "as value",
    "reference_velocity": "value / s",
    "reference_acceleration": "value / s^2",
    "storage": "J",
    "dissipated_power": "W",
}


class Outcome(Enum):
    """How a run ended."""

    COMPLETE = "complete"
    INTERRUPTED = "interrupted"  #: by Ctrl-C; the arrays end there
    DIVERGED = "diverged"  #: the integrator gave up; the arrays end there


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Shown):
    """A closed loop over time: N instants, n joints, k controlled quantities.

    `orthocas.simulation.figure.trajectory_figure` draws it.
    """

    controller: str
    kind: str  #: of the command, 'torque' or 'velocity'
    outcome: Outcome
    labels: tuple[str, ...]  #: names of the k quantities
    joint_names: tuple[str, ...]
    times: Array  #: (N,) [s]
    q: Array  #: (N, n)
    dq: Array  #: (N, n)
    command: Array  #: (N, n) torques, or velocities
    status: Array  #: (N,) of the controller, `orthocas.control.ControlStatus`
    value: Array  #: (N, k) the controlled quantities
    reference: Array  #: (N, k) what they should be
    reference_velocity: Array  #: (N, k)
    reference_acceleration: Array  #: (N, k)
    storage: Array  #: (N,) V [J]; NaN for velocity controllers
    dissipated_power: Array  #: (N,) taken by the controller's damping [W]; NaN for velocity controllers

    @property
    def energy_balance(self) -> Array:
        """V(t) - V(0) + the energy dissipated until t, (N,) [J].

        0 for impedance and PD+ (coupled) in continuous time with the right model, without friction, pushes, noise, and
        commands that were cut or replaced by the fallback, while the reference rests.
        """
        lost = cumulative_simpson(self.dissipated_power, x=self.times, initial=0.0)
        return np.asarray(self.storage - self.storage[0] + lost)

    @property
    def storage_rise(self) -> float:
        """How far V ever climbs above an earlier value [J]: 0 for a passive controller at a resting reference."""
        return float((self.storage - np.minimum.accumulate(self.storage)).max())

    @property
    def tracking_error(self) -> Array:
        """Largest |value - reference| of each quantity, (k,)."""
        return np.asarray(np.abs(self.value - self.reference).max(axis=0))

    def facts(self) -> dict[str, str]:
        """How it ended, errors and commands, and whether the law gave way."""
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

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write an NPZ file with every array, names and units; it appears whole or not at all.

        It replaces a trajectory file of that name, and with `force` any other file.

        Raises:
            TrajectoryFileError: if the folder is missing or cannot be written, if there is a file that is no
                trajectory, or a symbolic link.
        """
        target = Path(path)
        require_writable(target, TrajectoryFileError)
        require_replaceable(target, is_numpy_archive(target, ("header", *_ARRAYS)), force, TrajectoryFileError)
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
        """Read a file of `save`; never runs code.

        Raises:
            TrajectoryFileError: if the file is missing, damaged, foreign or from a newer version.
        """
        damaged = TrajectoryFileError(f"{path} is truncated, damaged or not a trajectory file")
        try:
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:  # np.load leaks bad ones
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
