"""Pushes, friction, stops and noise of a run, and files with the steps of its reference."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.control.gains import non_negative_gains, positive_gains
from orthocas.control.reference import DAMPING_RATIO, NATURAL_FREQUENCY, Reference
from orthocas.errors import InvalidValueError, OrthocasError, StepsFileError
from orthocas.robots.kinematics import build_point_jacobian
from orthocas.robots.tree import KinematicTree
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    as_number,
    freeze_array,
    require_at_least,
    require_count,
    require_known,
    require_positive,
    require_shape,
)
from orthocas.tools.json import read_strict_json

Link = str | int | None  #: a link, by the joint that moves it (name or index), or a frame by its name; None: the tip
_WITH_STEPS = ("steps", "duration", "start", "natural_frequency", "damping_ratio", "pushes")
_WITH_POINTS = ("points", "start", "pushes")


@dataclass(frozen=True, slots=True)
class SimulationRules:
    """Numbers of simulations."""

    tolerance: float = 1e-8  #: relative and absolute tolerance of the integrators
    #: instants per call of an integrator, so that one integrator serves all runs, and Ctrl-C waits for one call only
    outputs: int = 25
    ticks: int = 50  #: ticks per call, for the same reason
    same_time: float = 1e-9  #: [s]; events closer than this are simultaneous up to rounding
    most_steps: int = 100_000  #: most physics steps in a tick, about 5 s of computing
    most_ticks: float = 1e7  #: most ticks of a sampled run
    most_instants: float = 1e6  #: most instants of a run that a file defines
    shortest: float = 1e-3  #: [s], shortest spacing of points, run and push
    #: default Stribeck speed, at which friction falls from breakaway to Coulomb [rad/s] or [m/s]
    stribeck_speed: float = 0.05
    stiction_speed: float = 0.01  #: [rad/s] or [m/s]; above twice this speed, Coulomb friction is nearly complete
    beyond: float = 1e-3  #: [rad] or [m] beyond a joint limit that counts as outside, because stops give way a little
    lasting: float = 0.1  #: [s] of saturation after which the storage must not have risen
    no_step: float = 1e-9  #: smaller differences of targets are rounding

    steps_file: int = 2**23  #: largest size of a steps file [bytes]
    largest: float = 1e6  #: largest number in it; larger ones are mistakes and would overflow later
    longest: int = 80  #: most characters of the file that an error repeats


RULES = SimulationRules()


class Place(NamedTuple):
    """A point fixed in a body."""

    body: int  #: index of the joint that moves it, -1 for the base
    point: tuple[float, float, float]  #: in the frame of the body in `KinematicTree` [m]


def place_of(tree: KinematicTree, link: Link, point: Array) -> Place:
    """Convert a point (3,) in the frame of a link, or of the tip, to a place on a body.

    Raises:
        UnknownNameError, InvalidValueError: if the robot has no such link.
    """
    if link is None:
        x, y, z = tree.tip_translation + tree.tip_rotation @ point
        return Place(tree.tip_parent, (float(x), float(y), float(z)))
    if isinstance(link, str):
        if link in tree.frame_names:
            frame = tree.frame(link)
            x, y, z = frame.translation + frame.rotation @ point
            return Place(frame.parent, (float(x), float(y), float(z)))
        require_known("link, named by the joint that moves it,", link, tree.joint_names)
        link = tree.joint_names.index(link)
    require_link(link, tree.n)
    return Place(int(link), tuple(point.tolist()))


def require_link(link: object, n: int | None = None) -> None:
    """Raise InvalidValueError unless the link is a name, None, or an index (below n, if n is given)."""
    if link is None or isinstance(link, str):
        return
    whole = isinstance(link, int | np.integer) and not isinstance(link, bool)
    if not whole or link < 0 or (n is not None and link >= n):  # type: ignore[operator]
        most = "" if n is None else f" from 0 to {n - 1}"
        raise InvalidValueError("link", repr(link)[:80], f"the name of a joint, or the index of one{most}")


def count_steps(seconds: float, longest: float) -> int:
    """The number of equal physics steps in a tick [s], none longer than a given length [s].

    If the tick is a multiple of this length up to rounding, no further step is added.
    """
    count = as_number("seconds", seconds) / longest - 1e-9
    if not -1e-9 < count <= RULES.most_steps:
        raise InvalidValueError("seconds", seconds, f"a number > 0, at most {RULES.most_steps * longest:g}")
    return max(1, ceil(count))


@dataclass(frozen=True, eq=False)
class Push:
    """An external load that is constant over an interval of time.

    Args:
        start: [s], >= 0.
        duration: [s], > 0.
        force: in world axes, (3,) [N]; default no force.
        torque: at the joints, (n,) [N m] or [N]; default no torque.
        link: link where the force acts: name or index of the joint that moves it, or name of a frame of the robot.
            Default: the tip.
        point: point of the link where the force acts, in the link's frame, (3,) [m]. Frames of links are those of
            `Robot.tree`: the origin lies on the joint's axis, which is z.
    """

    start: float
    duration: float
    force: Array
    torque: Array | None
    link: Link
    point: Array

    def __init__(
        self,
        start: float,
        duration: float,
        force: ArrayLike = (0.0, 0.0, 0.0),
        torque: ArrayLike | None = None,
        link: Link = None,
        point: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        # Check the times, then force and torque, then the place of the force.
        object.__setattr__(self, "start", require_at_least("start of a push", start, 0))
        object.__setattr__(self, "duration", require_positive("duration of a push", duration))
        object.__setattr__(self, "force", freeze_array("force", force, (3,)))
        object.__setattr__(self, "torque", None if torque is None else freeze_array("torque", torque, (None,)))
        require_link(link)
        object.__setattr__(self, "link", link)
        object.__setattr__(self, "point", freeze_array("point", point, (3,)))

    @property
    def end(self) -> float:
        """Time at which the push ends [s]."""
        return self.start + self.duration

    def load(self, n: int) -> Array:
        """Force and joint torques as one row, (3 + n,)."""
        torque = np.zeros(n) if self.torque is None else self.torque
        require_shape("torque of a push", torque.shape, (n,))
        return np.concatenate([self.force, torque])


@dataclass(frozen=True, eq=False)
class Friction:
    """Joint friction tau_f = viscous dq + F(dq) sign(dq), which opposes the motion (Stribeck model).

    F(v) = coulomb + (breakaway - coulomb) exp(-(v / stribeck_speed)^2) is the dry friction: it is largest at breakaway,
    and falls to the Coulomb friction with speed. `StickingPlant` holds a joint at rest exactly under any torque up to
    the breakaway torque. CVODES replaces sign(v) by tanh(v / 0.01), so joints creep. MuJoCo has no Stribeck friction.

    Args:
        viscous: >= 0, (n,) or one number [N m s/rad].
        coulomb: >= 0, (n,) or one number [N m].
        breakaway: >= coulomb, (n,) or one number [N m]; default coulomb.
        stribeck_speed: > 0, speed scale of the fall from breakaway to Coulomb friction, (n,) or one number [rad/s] or
            [m/s].
    """

    viscous: ArrayLike = 0.0
    coulomb: ArrayLike = 0.0
    breakaway: ArrayLike | None = None
    stribeck_speed: ArrayLike = RULES.stribeck_speed

    def numbers(self, n: int) -> Array:
        """Viscous, Coulomb, and breakaway minus Coulomb friction, and Stribeck speed of n joints, (4 n,)."""
        viscous, coulomb = (non_negative_gains(name, getattr(self, name), n) for name in ("viscous", "coulomb"))
        breakaway = coulomb if self.breakaway is None else non_negative_gains("breakaway", self.breakaway, n)
        if (breakaway < coulomb).any():
            raise InvalidValueError("breakaway", breakaway.tolist(), f"at least coulomb, {coulomb.tolist()}")
        speed = positive_gains("stribeck_speed", self.stribeck_speed, n)
        return np.concatenate([viscous, coulomb, breakaway - coulomb, speed])

    @staticmethod
    def torque(dq: ca.SX, numbers: ca.SX) -> ca.SX:
        """Friction torque, to subtract from the joint torque, (n, 1); `numbers` is a column (4 n, 1)."""
        viscous, coulomb, extra, speed = ca.vertsplit(numbers, dq.shape[0])
        size = coulomb + extra * ca.exp(-((dq / speed) ** 2))
        friction: ca.SX = viscous * dq + size * ca.tanh(dq / RULES.stiction_speed)
        return friction


@dataclass(frozen=True, eq=False)
class Stops:
    """Joint stops tau_s = -stiffness p max(0, 1 + damping dp/dt), with p the penetration of the joint limit.

    The damping grows with p, as in the contact model of Hunt and Crossley, so the torque is continuous and never pulls.

    Args:
        stiffness: > 0, (n,) or one number [N m/rad] or [N/m].
        damping: >= 0, (n,) or one number [s/rad] or [s/m].
    """

    stiffness: ArrayLike = 2e4
    damping: ArrayLike = 1.0

    def torque(self, tree: KinematicTree, q: ca.SX, dq: ca.SX) -> ca.SX:
        """Torque of the stops on the joints, (n, 1)."""
        # A spring and a damper at each finite limit, which only push.
        stiffness = positive_gains("stiffness of stops", self.stiffness, tree.n)
        damping = non_negative_gains("damping of stops", self.damping, tree.n)
        torque = ca.SX(tree.n, 1)
        for i in range(tree.n):
            for limit, side in ((tree.lower[i], -1.0), (tree.upper[i], 1.0)):
                if np.isfinite(limit):
                    beyond = ca.fmax(0, side * (q[i] - limit))
                    torque[i] -= side * stiffness[i] * beyond * ca.fmax(0, 1 + side * damping[i] * dq[i])
        return torque


@dataclass(frozen=True)
class Noise:
    """White Gaussian noise on the controller's measurements, drawn at every control tick.

    Args:
        position: standard deviation >= 0 [rad] or [m].
        velocity: standard deviation >= 0 [rad/s] or [m/s].
        seed: seed of the random numbers.
    """

    position: float = 0.0
    velocity: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_count("seed", self.seed, least=0)
        for name in ("position", "velocity"):
            require_at_least(f"{name} noise", getattr(self, name), 0)

    def sample(self, ticks: int, n: int) -> Array:
        """Measurement errors of q and dq, (ticks, 2 n)."""
        rng = np.random.default_rng(self.seed)
        return np.asarray(rng.normal(size=(ticks, 2 * n)) * np.repeat([self.position, self.velocity], n))


class Loads:
    """The pushes of a run as rows: forces at each of P places (3 P), then joint torques (n).

    Raises:
        UnknownNameError, InvalidValueError, ShapeError: if a push does not fit the robot.
    """

    def __init__(self, tree: KinematicTree, pushes: Sequence[Push] = ()) -> None:
        self.pushes = tuple(pushes)
        self._tree = tree
        self._places_of_pushes = [place_of(tree, push.link, push.point) for push in self.pushes]
        self._rows  # noqa: B018 (checks the torques now)

    @cached_property
    def places(self) -> tuple[Place, ...]:
        """The different places where forces act."""
        return tuple(dict.fromkeys(self._places_of_pushes))

    @property
    def size(self) -> int:
        """Length of a row, 3 P + n."""
        return 3 * len(self.places) + self._tree.n

    def shares(self, starts: Array, length: float) -> Array:
        """Fraction of each interval of equal length that each push covers, (N, pushes); this keeps impulses."""
        shares = [
            np.maximum(np.minimum(starts + length, push.end) - np.maximum(starts, push.start), 0.0) / length
            for push in self.pushes
        ]
        return np.array(shares).reshape(-1, len(starts)).T

    def mean(self, starts: Array, length: float) -> Array:
        """Mean rows over time intervals of equal length, (N, 3 P + n)."""
        return np.asarray(self.shares(starts, length) @ self._rows)

    def at(self, times: Array) -> Array:
        """Rows at times (N,), (N, 3 P + n). A push acts from its start until just before its end."""
        active = [(times >= push.start) & (times < push.end) for push in self.pushes]
        return np.asarray(np.array(active).reshape(-1, len(times)).T @ self._rows)

    def joint_torques(self, q: ca.SX, row: ca.SX) -> ca.SX:
        """J^T f at every place, plus the torque of the joints, (n, 1), for a row (3 P + n, 1)."""
        torque = row[3 * len(self.places) :]
        for k, place in enumerate(self.places):
            torque += build_point_jacobian(self._tree, q, place.body, np.array(place.point)).T @ row[3 * k : 3 * k + 3]
        return torque

    @cached_property
    def _rows(self) -> Array:
        """The row of each push while it acts, (pushes, 3 P + n)."""
        rows = np.zeros((len(self.pushes), self.size))
        for row, push, place in zip(rows, self.pushes, self._places_of_pushes, strict=True):
            load, k = push.load(self._tree.n), self.places.index(place)
            row[3 * k : 3 * k + 3], row[3 * len(self.places) :] = load[:3], load[3:]
        return rows


@dataclass(frozen=True, eq=False)
class Plan:
    """The contents of a steps file."""

    reference: Reference  #: in phi = [x; xi], with the labels of the chart
    q_start: Array  #: (n,) [rad] or [m]
    pushes: tuple[Push, ...]
    has_steps: bool  #: whether the reference consists of steps instead of points


def read_steps(path: str | Path, chart: Chart) -> Plan:
    """Read a steps file for a chart, without checking that the reference is reachable.

    Raises:
        StepsFileError: names the file, the place in it, the value there and the expected value.
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
    # The motion starts at the home of the domain, or where the file says.
    q_start = chart.problem.domain.home
    if "start" in data:
        q_start = reader.numbers(data["start"], "start", chart.n)
    try:
        reference = (_read_step_reference if has_steps else _read_point_reference)(
            reader, data, chart.labels, chart.phi(q_start)
        )
        # Refuse files whose runs would exceed the memory.
        instants = reference.duration / reference.spacing
        if instants > RULES.most_instants:
            raise reader.fault(
                f"the run needs {instants:.3g} instants to show every swing, expected at most {RULES.most_instants:g}"
            )
        pushes = _read_pushes(reader, data.get("pushes", []), chart.problem.robot.joint_names, reference.duration)
    except StepsFileError:
        raise
    except OrthocasError as error:
        raise reader.fault(str(error)) from None
    return Plan(reference, q_start, pushes, has_steps)


def _read_step_reference(reader: Reader, data: Mapping[str, Any], labels: tuple[str, ...], start: Array) -> Reference:
    # Duration of the run, and frequency of the filter that smooths the steps.
    duration = reader.number(data.get("duration"), "duration", least=RULES.shortest)
    frequency = reader.number(data.get("natural_frequency", NATURAL_FREQUENCY), "natural_frequency", above=0.0)
    ratio = reader.number(data.get("damping_ratio", DAMPING_RATIO), "damping_ratio", least=0.0)
    # Read the steps in order. Quantities that a step does not name keep their targets.
    changes, before = [], 0.0
    targets = dict(zip(labels, start.tolist(), strict=True))
    for k, entry in enumerate(reader.items(data["steps"], "steps")):
        time, targets = _read_change(reader, entry, f"steps[{k}]", targets)
        if not before <= time < duration:
            raise reader.wrong(f"steps[{k}].time", time, f"from {before:g} to below the duration {duration:g}")
        if not (entry.get("move") or entry.get("to")):
            raise reader.wrong(f"steps[{k}]", entry, "a quantity in 'move' or 'to'")
        changes.append((time, targets))
        before = time
    return Reference.steps(labels, start, changes, duration, frequency, ratio)


def _read_point_reference(reader: Reader, data: Mapping[str, Any], labels: tuple[str, ...], start: Array) -> Reference:
    times, targets = [0.0], [dict(zip(labels, start.tolist(), strict=True))]
    for k, entry in enumerate(reader.items(data["points"], "points")):
        time, values = _read_change(reader, entry, f"points[{k}]", targets[-1])
        if time < times[-1] + RULES.shortest:
            want = f"at least {times[-1] + RULES.shortest:g}, because the start is the point at 0"
            raise reader.wrong(f"points[{k}].time", time, want)
        times.append(time)
        targets.append(values)
    if len(times) == 1:
        raise reader.wrong("points", [], "at least one point")
    return Reference.through(labels, times, np.array([list(values.values()) for values in targets]))


def _read_change(
    reader: Reader, data: object, where: str, before: Mapping[str, float]
) -> tuple[float, dict[str, float]]:
    """Time and targets of one step or point. Quantities that it does not name keep their targets."""
    entry = reader.fields(data, where, ("time", "move", "to"))
    targets, named = dict(before), set()
    for key in ("move", "to"):
        for label, value in reader.fields(entry.get(key, {}), f"{where}.{key}", before, "quantity").items():
            if label in named:
                raise reader.fault(f"{where} has {label} in both 'move' and 'to', expected it in only one")
            named.add(label)
            targets[label] = reader.number(value, f"{where}.{key}.{label}") + (before[label] if key == "move" else 0.0)
    return reader.number(entry.get("time"), f"{where}.time", least=0.0), targets


def _read_pushes(reader: Reader, data: object, joint_names: tuple[str, ...], run_ends: float) -> tuple[Push, ...]:
    """Read pushes: a force at a point of a link or the tip, or a torque on the joints."""
    pushes = []
    for k, item in enumerate(reader.items(data, "pushes")):
        where = f"pushes[{k}]"
        entry = reader.fields(item, where, ("start", "duration", "force", "torque", "link", "point"))
        if not entry.keys() & {"force", "torque"}:
            raise reader.wrong(where, entry, "a 'force' at the tip or a link, or a 'torque' at the joints")
        start = reader.number(entry.get("start"), f"{where}.start", least=0.0)
        if start >= run_ends:
            raise reader.wrong(f"{where}.start", start, f"below the end of the run at {run_ends:g}")
        duration = reader.number(entry.get("duration"), f"{where}.duration", least=RULES.shortest)
        force = reader.numbers(entry.get("force", [0.0] * 3), f"{where}.force", 3)
        torque = reader.numbers(entry.get("torque", [0.0] * len(joint_names)), f"{where}.torque", len(joint_names))
        # A force acts at a point of a link, or of the tip.
        for key in ("link", "point"):
            if key in entry and "force" not in entry:
                raise reader.fault(f"{where} has a '{key}' but no 'force', expected 'force' too, or no '{key}'")
        link = entry.get("link")
        whole = isinstance(link, int) and not isinstance(link, bool) and 0 <= link < len(joint_names)
        if "link" in entry and not whole and link not in joint_names:
            names = ", ".join(joint_names)[:200]
            raise reader.wrong(f"{where}.link", link, f"the index of a joint from 0, or a name: {names}")
        point = reader.numbers(entry.get("point", [0.0] * 3), f"{where}.point", 3)
        pushes.append(Push(start, duration, force, torque, link, point))
    return tuple(pushes)


@dataclass(frozen=True)
class Reader:
    """Reads values from a steps file. Every method raises StepsFileError for data of the wrong kind."""

    path: Path

    def parsed(self) -> object:
        """The data of the file. NaN and duplicate keys are errors."""
        try:
            with self.path.open("rb") as stream:
                content = stream.read(RULES.steps_file + 1)
        except OSError as error:
            raise self.fault(f"cannot be read, {error.strerror}") from None
        # ValueError: the path contains a null character.
        except ValueError as error:
            raise self.fault(f"cannot be read, {error}") from None
        if len(content) > RULES.steps_file:
            raise self.fault(f"larger than {RULES.steps_file / 2**20:.0f} MiB, which is too large for a steps file")
        try:
            return read_strict_json(content.decode("utf-8-sig"))
        # ValueError: not JSON, or bytes that are not text.
        except ValueError as error:
            raise self.fault(f"truncated or not JSON, {str(error)[: RULES.longest]}") from None

    def fault(self, text: str) -> StepsFileError:
        """An error that names the file."""
        return StepsFileError(f"steps file {self.path}: {text}")

    def wrong(self, where: str, got: object, want: str) -> StepsFileError:
        """An error that names the place, the value there and what was expected."""
        return self.fault(f"{where} is {json.dumps(got)[: RULES.longest]}, expected {want}")

    def fields(self, data: object, where: str, known: Collection[str], what: str = "key") -> dict[str, Any]:
        """Return the data if it is an object with known keys only."""
        if not isinstance(data, dict):
            raise self.wrong(where, data, "an object")
        for key in data:
            if key not in known:
                names = ", ".join(known)
                raise self.fault(f"{where} has an unknown {what} '{key[: RULES.longest]}', known: {names}")
        return data

    def items(self, data: object, where: str) -> list[Any]:
        """Return the data if it is a list."""
        if not isinstance(data, list):
            raise self.wrong(where, data, "a list")
        return data

    def number(self, data: object, where: str, least: float = -RULES.largest, above: float = -inf) -> float:
        """Return a number that is at least `least` or above `above`, and at most 1e6."""
        if data is None:
            raise self.fault(f"{where} is missing, expected a number")
        low = f"above {above:g}" if isfinite(above) else f"from {least:g}"
        if (
            isinstance(data, bool)
            or not isinstance(data, int | float)
            or not (above < data and least <= data <= RULES.largest)
        ):
            raise self.wrong(where, data, f"a number {low} to {RULES.largest:g}")
        return float(data)

    def numbers(self, data: object, where: str, length: int) -> Array:
        """Return a list of finite numbers as an array (length,)."""
        items = self.items(data, where)
        if len(items) != length:
            raise self.wrong(where, items, f"a list of {length} numbers")
        return np.array([self.number(item, f"{where}[{i}]") for i, item in enumerate(items)])
