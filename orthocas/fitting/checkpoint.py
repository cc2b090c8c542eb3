"""Checkpoints of long fits: a killed run resumes from the last state in its file."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from orthocas.checks import Array
from orthocas.errors import CheckpointError
from orthocas.files.archive import Kind, read_archive, write_archive
from orthocas.files.atomic import require_writable
from orthocas.minimising.solver import SolveResult, Status
from orthocas.minimising.watch import State

CHECKPOINT = Kind("checkpoint", 1, CheckpointError)
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
            state = {name.removeprefix("state_"): a for name, a in arrays.items() if name.startswith("state_")}
            self._running = (header["running"], state) if header["running"] else None
        except (LookupError, TypeError, ValueError) as error:
            if isinstance(error, CheckpointError):
                raise
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


def _numbers(stage: Stage) -> dict[str, str | float]:
    result = stage.result
    return {
        "label": stage.label,
        "parameters": stage.parameters,
        "samples": stage.samples,
        "value": result.value,
        "status": result.status.value,
        "iterations": result.iterations,
        "evaluations": result.evaluations,
        "seconds": result.seconds,
    }


def _stage(data: Mapping[str, float], theta: Array) -> Stage:
    result = SolveResult(
        theta,
        float(data["value"]),
        Status(data["status"]),
        int(data["iterations"]),
        int(data["evaluations"]),
        float(data["seconds"]),
    )
    return Stage(str(data["label"]), int(data["parameters"]), int(data["samples"]), result)
