"""Steps files: JSON files that describe the motion of a simulated robot. Format: docs/reference/simulation.md."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.charts.chart import Chart
from orthocas.control.reference import DAMPING_RATIO, NATURAL_FREQUENCY, Reference
from orthocas.errors import OrthocasError, StepsFileError
from orthocas.simulation.disturbances import Push
from orthocas.tools.checks import Array
from orthocas.tools.json import Reader

_MOST_INSTANTS = 1e6
_LONGEST = 200  # most characters of the names of joints in an error
_SHORTEST = 1e-3  # time between points, and length of a run or a push [s]
_WITH_STEPS = ("steps", "duration", "start", "natural_frequency", "damping_ratio", "pushes")
_WITH_POINTS = ("points", "start", "pushes")


@dataclass(frozen=True, eq=False)
class Plan:
    """The contents of a steps file."""

    reference: Reference  #: in phi = [x; xi], with the labels of the chart
    q_start: Array  #: (n,) [rad] or [m]
    pushes: tuple[Push, ...]
    has_steps: bool  #: whether the reference consists of steps rather than points


def read_steps(path: str | Path, chart: Chart) -> Plan:
    """Read a steps file for a chart. Does not check that the reference is reachable.

    Raises:
        StepsFileError: names the file, the place in it, the value there and what was expected.
    """
    reader = Reader(Path(path))
    data = reader.parsed()
    if not isinstance(data, dict):
        raise reader.wrong("content", data, "an object")
    if ("steps" in data) == ("points" in data):
        came = "both 'steps' and 'points'" if "steps" in data else "neither 'steps' nor 'points'"
        raise reader.fault(f"it has {came}, expected one of them")
    has_steps = "steps" in data
    where = "the object with 'steps'" if has_steps else "the object with 'points'"
    reader.fields(data, where, _WITH_STEPS if has_steps else _WITH_POINTS)
    q_start = chart.problem.domain.centre
    if "start" in data:
        q_start = reader.numbers(data["start"], "start", chart.n)
    try:
        reference = (_steps if has_steps else _points)(reader, data, chart.labels, chart.phi(q_start))
        instants = reference.duration / reference.spacing
        if instants > _MOST_INSTANTS:
            raise reader.fault(
                f"the run needs {instants:.3g} instants to show every swing, expected at most {_MOST_INSTANTS:g}"
            )
        pushes = _pushes(reader, data.get("pushes", []), chart.problem.robot.joint_names, reference.duration)
    except StepsFileError:
        raise
    except OrthocasError as error:
        raise reader.fault(str(error)) from None
    return Plan(reference, q_start, pushes, has_steps)


def _steps(reader: Reader, data: Mapping[str, Any], labels: tuple[str, ...], start: Array) -> Reference:
    duration = reader.number(data.get("duration"), "duration", least=_SHORTEST)
    frequency = reader.number(data.get("natural_frequency", NATURAL_FREQUENCY), "natural_frequency", above=0.0)
    ratio = reader.number(data.get("damping_ratio", DAMPING_RATIO), "damping_ratio", least=0.0)
    changes, before = [], 0.0
    targets = dict(zip(labels, start.tolist(), strict=True))
    for k, entry in enumerate(reader.items(data["steps"], "steps")):
        time, targets = _change(reader, entry, f"steps[{k}]", targets)
        if not before <= time < duration:
            raise reader.wrong(f"steps[{k}].time", time, f"from {before:g} to below the duration {duration:g}")
        if not (entry.get("move") or entry.get("to")):
            raise reader.wrong(f"steps[{k}]", entry, "a quantity in 'move' or 'to'")
        changes.append((time, targets))
        before = time
    return Reference.steps(labels, start, changes, duration, frequency, ratio)


def _points(reader: Reader, data: Mapping[str, Any], labels: tuple[str, ...], start: Array) -> Reference:
    times, targets = [0.0], [dict(zip(labels, start.tolist(), strict=True))]
    for k, entry in enumerate(reader.items(data["points"], "points")):
        time, values = _change(reader, entry, f"points[{k}]", targets[-1])
        if time < times[-1] + _SHORTEST:
            want = f"at least {times[-1] + _SHORTEST:g}, because the start is the point at 0"
            raise reader.wrong(f"points[{k}].time", time, want)
        times.append(time)
        targets.append(values)
    if len(times) == 1:
        raise reader.wrong("points", [], "at least one point")
    return Reference.through(labels, times, np.array([list(values.values()) for values in targets]))


def _change(reader: Reader, data: object, where: str, before: Mapping[str, float]) -> tuple[float, dict[str, float]]:
    """Time and targets of one step or point. Quantities that it does not name keep their previous targets."""
    entry = reader.fields(data, where, ("time", "move", "to"))
    targets, named = dict(before), set()
    for key in ("move", "to"):
        for label, value in reader.fields(entry.get(key, {}), f"{where}.{key}", before, "quantity").items():
            if label in named:
                raise reader.fault(f"{where} has {label} in 'move' and in 'to', expected it in one of them")
            named.add(label)
            targets[label] = reader.number(value, f"{where}.{key}.{label}") + (before[label] if key == "move" else 0.0)
    return reader.number(entry.get("time"), f"{where}.time", least=0.0), targets


def _pushes(reader: Reader, data: object, joint_names: tuple[str, ...], run_ends: float) -> tuple[Push, ...]:
    pushes = []
    for k, item in enumerate(reader.items(data, "pushes")):
        where = f"pushes[{k}]"
        entry = reader.fields(item, where, ("start", "duration", "force", "torque", "link", "point"))
        if not entry.keys() & {"force", "torque"}:
            raise reader.wrong(where, entry, "a 'force' at the tip or a link, or a 'torque' at the joints")
        start = reader.number(entry.get("start"), f"{where}.start", least=0.0)
        if start >= run_ends:
            raise reader.wrong(f"{where}.start", start, f"below the end of the run at {run_ends:g}")
        duration = reader.number(entry.get("duration"), f"{where}.duration", least=_SHORTEST)
        force = reader.numbers(entry.get("force", [0.0] * 3), f"{where}.force", 3)
        torque = reader.numbers(entry.get("torque", [0.0] * len(joint_names)), f"{where}.torque", len(joint_names))
        pushes.append(Push(start, duration, force, torque, *_place(reader, entry, where, joint_names)))
    return tuple(pushes)


def _place(
    reader: Reader, entry: Mapping[str, Any], where: str, joint_names: tuple[str, ...]
) -> tuple[str | int | None, Array]:
    """Where the force of a push acts: a link (None: the tip), and a point (3,) in its frame."""
    for key in ("link", "point"):
        if key in entry and "force" not in entry:
            raise reader.fault(f"{where} has a '{key}' but no 'force', expected both or none of them")
    link = entry.get("link")
    whole = isinstance(link, int) and not isinstance(link, bool) and 0 <= link < len(joint_names)
    if "link" in entry and not whole and link not in joint_names:
        names = ", ".join(joint_names)[:_LONGEST]
        raise reader.wrong(f"{where}.link", link, f"the index of a joint from 0, or a name: {names}")
    return link, reader.numbers(entry.get("point", [0.0] * 3), f"{where}.point", 3)
