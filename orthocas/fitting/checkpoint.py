"""Checkpoints of long fits: a killed run resumes from the last state in its file."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.errors import CheckpointError, InvalidValueError, OrthocasError
from orthocas.solvers.protocol import SolveResult, Status
from orthocas.tools.archive import Kind, read_archive, write_archive
from orthocas.tools.checks import Array, as_float_array, frozen_array, require_count, require_text
from orthocas.tools.files import require_writable
from orthocas.tools.progress import State

CHECKPOINT = Kind("checkpoint", 1, CheckpointError)
_NUMBERS = ("iterations", "evaluations", "seconds", "damping", "stretch", "scale", "converged", "gained_little")
_VECTORS = ("best_theta", "theta", "gradient", "mean", "square", "place")
_LOSSES = ("best_value", "value", "height")
_MOST = 1e15  # of these numbers
_SECONDS = 30.0  # least time between two writes of a running stage


@dataclass(frozen=True, eq=False)
class Stage:
    """One minimisation of a fit."""

    label: str  #: parametrisation, for example 'polynomial:3'
    parameters: int
    samples: int
    result: SolveResult

    def interrupted(self) -> "Stage":
        """The same stage, marked as interrupted by Ctrl-C."""
        return replace(self, result=replace(self.result, status=Status.INTERRUPTED))


class Checkpoint:
    """The finished stages of a fit and the state of the running one, kept in a file. Without a path nothing is kept.

    Args:
        path: the file. If it exists, it is read.
        fit: settings that identify this fit. A file of another fit is rejected.

    Raises:
        CheckpointError: if the file cannot be written, is damaged, or belongs to another fit. The message names the
            setting that differs.
    """

    def __init__(self, path: Path | None, fit: Mapping[str, str]) -> None:
        self._path, self._fit = path, dict(fit)
        self._stages: list[Stage] = []
        self._running: tuple[str, State] | None = None
        if path is None:
            return
        require_writable(path, CheckpointError)
        if path.exists():
            self._read(path)

    def finished(self, label: str) -> Stage | None:
        """The stage with this label, if an earlier run finished it."""
        return next((stage for stage in self._stages if stage.label == label), None)

    def require_fitting(self, label: str, size: int, free: int) -> None:
        """Raise CheckpointError unless what is kept of a stage belongs to a family with that many parameters.

        Args:
            label: name of the stage.
            size: number of parameters of the family.
            free: number of those that the stage fits.
        """
        done = self.finished(label)
        if done is not None and done.parameters != size:
            raise self.inconsistent(f"stage '{label}' has {done.parameters} parameters, expected {size}")
        for name, value in (self._running[1] if self._running and self._running[0] == label else {}).items():
            if name in _VECTORS and (value.shape != (free,) or not np.isfinite(value).all()):
                raise self.inconsistent(f"{name} has shape {value.shape}, expected ({free},) with finite entries")
            if name in _NUMBERS and (value.shape != () or not 0 <= value < _MOST):
                raise self.inconsistent(f"{name} is {np.ravel(value)[:3].tolist()}, expected one number >= 0")
            if name in _LOSSES and value.shape != ():
                raise self.inconsistent(f"{name} has shape {value.shape}, expected one number")

    def inconsistent(self, reason: str) -> CheckpointError:
        """The error for a file that contradicts itself, or the fit."""
        return CheckpointError(f"{self._path} is inconsistent: {reason}")

    def add(self, stage: Stage) -> None:
        """Write a finished stage. Interrupted stages are not finished."""
        if stage.result.status is Status.INTERRUPTED:
            return
        self._stages.append(stage)
        self._running = None
        self._write()

    def keeper(self, label: str) -> "StageKeeper":
        """The keeper in which the solver of a stage keeps its state."""
        state = self._running[1] if self._running and self._running[0] == label else None
        return StageKeeper(state, lambda new: self._keep(label, new))

    def _keep(self, label: str, state: State) -> None:
        self._running = label, state
        self._write()

    def _write(self) -> None:
        if self._path is None:
            return
        arrays: dict[str, Array] = {f"stage_{k}": stage.result.theta for k, stage in enumerate(self._stages)}
        label, state = self._running or ("", {})
        arrays |= {f"state_{name}": value for name, value in state.items()}
        header = {"fit": self._fit, "running": label, "stages": [_numbers(stage) for stage in self._stages]}
        write_archive(self._path, CHECKPOINT, header, arrays)

    def _read(self, path: Path) -> None:
        header, arrays = read_archive(path, CHECKPOINT)
        try:
            other = dict(header["fit"])
            for name, wanted in self._fit.items():
                if other.get(name) != wanted:
                    raise CheckpointError(
                        f"{path} belongs to another fit: its {name} is {other.get(name)}, expected {wanted}; "
                        "remove the file to start again"
                    )
            self._stages = [_stage(data, arrays[f"stage_{k}"]) for k, data in enumerate(header["stages"])]
            self._running = (header["running"], _state(arrays)) if header["running"] else None
        except CheckpointError:
            raise
        except OrthocasError as error:
            raise CheckpointError(f"{path} is inconsistent: {error}") from None
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CheckpointError(f"{path} is incomplete: {type(error).__name__} {error}") from None


class StageKeeper:
    """Keeper of one stage. It limits how often the file is written."""

    def __init__(self, state: State | None, write: Callable[[State], None]) -> None:
        self._state, self._write = state, write
        self._newest: State | None = None
        self._last = time.monotonic()

    def restored(self) -> State | None:
        """The state that an earlier run kept, or None."""
        return self._state

    def keep(self, state: Callable[[], State]) -> None:
        """Write the state, unless the last write was too recent."""
        self._newest = state()
        if time.monotonic() - self._last >= _SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write the latest state now."""
        if self._newest is not None:
            self._write(self._newest)
            self._newest, self._last = None, time.monotonic()


def _numbers(stage: Stage) -> dict[str, str | float | None]:
    result = stage.result
    return {
        "label": stage.label,
        "parameters": stage.parameters,
        "samples": stage.samples,
        "value": result.value if isfinite(result.value) else None,  # a bound that is not kept yet
        "status": result.status.value,
        "iterations": result.iterations,
        "evaluations": result.evaluations,
        "seconds": result.seconds,
    }


def _stage(data: Mapping[str, Any], theta: Array) -> Stage:
    """A finished stage, checked.

    Raises:
        OrthocasError, LookupError, TypeError, ValueError: if it is not one.
    """
    counts = {name: require_count(name, data[name], least=0) for name in ("iterations", "evaluations", "samples")}
    parameters = require_count("parameters", data["parameters"])
    status = Status(data["status"])
    if status is Status.INTERRUPTED:
        raise InvalidValueError(f"status of stage '{data['label']}'", status.value, "that of a finished stage")
    result = SolveResult(
        frozen_array(f"theta of stage '{data['label']}'", theta, (parameters,)),
        inf if data["value"] is None else float(data["value"]),
        status,
        counts["iterations"],
        counts["evaluations"],
        float(data["seconds"]),
    )
    return Stage(require_text("label of a stage", data["label"]), parameters, counts["samples"], result)


def _state(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """What a minimiser kept: numbers only; what they mean is its own affair.

    Raises:
        InvalidValueError: for anything but real numbers, or NaN.
    """
    state = {}
    for name, array in arrays.items():
        if name.startswith("state_"):
            state[name.removeprefix("state_")] = as_float_array(name, array)
            if np.isnan(array).any():
                raise InvalidValueError(name, "NaN", "numbers")
    return state
