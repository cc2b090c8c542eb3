"""Laws with a state: what a law remembers from tick to tick, and the memories that come with orthocas."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.control.controller import (
    LARGEST,
    Controller,
    ControlStatus,
    build_function,
    compute_bias,
    get_counted_function,
    named_inputs,
    require_controller,
)
from orthocas.control.gains import positive_gains
from orthocas.control.linear_algebra import build_block_inertia
from orthocas.errors import InvalidValueError
from orthocas.robots import dynamics
from orthocas.robots.tree import KinematicTree
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import (
    Array,
    as_float_array,
    as_number,
    as_point,
    require_finite,
    require_kind,
    require_positive,
    require_shape,
)
from orthocas.tools.display import Shown, number_list

if TYPE_CHECKING:
    from orthocas.control.operational_space import _OperationalSpace


@dataclass(frozen=True, slots=True)
class MemoryRules:
    """Numbers of the memories that come with orthocas."""

    fraction: float = 0.5  #: of the law's limit that a correction may use, by default
    gravity: float = 9.81  #: to compare moments with torques [m/s^2]
    crossed: float = 0.5  #: weight of the error in J^-1 (de + weight e), in the decay rate of the slowest mode
    #: error at which a friction observer stops: half of what it may leave, 0.5 mm, 0.01 rad and 0.02 of xi
    metres: float = 2.5e-4
    others: float = 5e-3
    extra: float = 1e-2
    breaking: float = 60.0  #: rate at which the torque of a spring breaks a joint away [1/s]
    firm: float = 2.0  #: least stiffness of that spring, in limits of the joint [1/rad] or [1/m]
    sticking: float = 5e-3  #: speed below which a joint may stick [rad/s] or [m/s]
    travel: float = 3e-3  #: way on which a joint that broke away forgets that torque [rad] or [m]
    drop: float = 0.25  #: share of that torque by which friction may fall as a joint breaks away
    least: float = 0.2  #: share of its rates with which an observer of friction works if it does: nothing creeps
    per_tick: float = 0.5  #: largest rate of an observer times a period: with 1, it forgets nothing, with 2 it is lost
    instant: float = 1e-9  #: least period to divide by [s]
    unseen: float = 3.0  #: ticks until a law stops that: torque a tick late, held for one, seen in the next


RULES = MemoryRules()


@dataclass(frozen=True, eq=False)
class Memory:
    """What a law remembers from tick to tick, in Python, and in the state of the supervised law in C.

    The law itself stays a function of state, reference and gains. Fields of its memory are added to some of these
    gains, and are brought up to date after each tick, with the command that was sent.

    Args:
        start: the fields, and their values after a start.
        adds: for each gain that the memory changes, the field that is added to it. What is added to `extra_torque`
            also corrects the fallback of the supervised law, as far as its catcher can hold against it, and begins
            with what the command that held the arm before the start has beyond fallback and `extra_torque`.
        step: q, dq, reference and two derivatives, the law's gains, command, active, period, and the fields -> the
            fields, each called next_NAME there. `active` is the weight of the law in the command, and 0 while a limit
            cuts it. `period` is the time since the last tick [s], and 0 in the first one after a start or after missing
            measurements.

    Raises:
        InvalidValueError: if a gain is none of the step, or the fields are not its last inputs and its outputs.
    """

    start: Mapping[str, Array]
    adds: Mapping[str, str]
    step: ca.Function

    def __post_init__(self) -> None:
        require_kind("step", self.step, ca.Function)
        start = {name: as_float_array(name, value) for name, value in self.start.items()}
        for name, value in start.items():
            require_finite(name, value)
            if not re.fullmatch(r"[a-z]\w*", name, flags=re.ASCII):
                raise InvalidValueError("name of a field", repr(name), "small letters, digits and underscores, for C")
        object.__setattr__(self, "start", start)
        # The step's outputs, and its last inputs, are the fields.
        sizes, inputs = {name: len(value) for name, value in start.items()}, self.step.name_in()
        outputs = {name.removeprefix("next_"): self.step.size1_out(name) for name in self.step.name_out()}
        last = {name: self.step.size1_in(name) for name in inputs[len(inputs) - len(start) :]}
        if outputs != sizes or last != sizes:
            raise InvalidValueError("outputs and last inputs of step", f"{outputs} and {last}", str(sizes))
        for gain, name in self.adds.items():
            if name not in start or gain not in inputs:
                raise InvalidValueError("adds", f"{name} to {gain}", "a field, and a gain that is an input of step")

    def require_fitting(self, controller: Controller) -> None:
        """Raise InvalidValueError unless the step takes what the law has, and fields have the sizes of their gains."""
        n, gains = controller.problem.n, controller.gains
        sizes = {name: symbol.shape[0] for name, symbol in named_inputs(n, gains, len(controller.labels)).items()}
        sizes |= {"command": n, "active": 1, "period": 1} | {name: len(value) for name, value in self.start.items()}
        inputs = {name: self.step.size1_in(name) for name in self.step.name_in()}
        if list(inputs.items()) != list(sizes.items()):
            raise InvalidValueError("inputs of step", inputs, str(sizes))
        for gain, name in self.adds.items():
            if len(self.start[name]) != len(gains[gain]) or gain == "limit":
                raise InvalidValueError("adds", f"{name} to {gain}", "a field of the size of its gain, not the limit")

    @property
    def torque(self) -> str | None:
        """The field that is added to `extra_torque`."""
        return self.adds.get("extra_torque")


class Remembers(Protocol):
    """What makes the memory of a law."""

    name: ClassVar[str]  #: for commands and displays

    def of(self, law: _OperationalSpace) -> Memory:
        """The memory of a law that has the input `extra_torque`."""


def find_memory(controller: Controller) -> Memory | None:
    """The memory of a law; None for laws without one."""
    return getattr(controller, "memory", None)


class Remembering(Shown):
    """A law tick by tick, in Python, with what a function cannot know; the supervised law does the same in C.

    It keeps the law's memory, if it has one, and counts the turns of joints that turn without end from the last
    position. So sensors may report angles with or without whole turns, and nothing jumps at half a turn.

    Args:
        controller: the law.

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> problem = problems.get("planar_3r_xy")
        >>> chart = oc.fit(problem, oc.Polynomial(degree=2), samples=300).chart
        >>> law = oc.control.PDPlus(chart, 50.0, limit=90.0, remembers=oc.control.MomentumObserver())
        >>> ticks, q = oc.control.Remembering(law), problem.domain.centre
        >>> command, status = ticks.tick(q, 0 * q, [chart.phi(q), 0 * q, 0 * q], period=1e-3)
        >>> status.name, float(abs(ticks.fields["correction"]).max())
        ('OK', 0.0)
    """

    def __init__(self, controller: Controller) -> None:
        require_controller(controller)
        memory = find_memory(controller)
        self._controller, self._memory = controller, memory
        self._law = _call_with_arrays(get_counted_function(controller))
        self._step = None if memory is None else _call_with_arrays(memory.step)
        self.fields: dict[str, Array] = {}  #: what it remembers
        self.q: Array | None = None  #: the last position with its turns counted, (n,); None before the first tick
        self.start()

    def facts(self) -> dict[str, str]:
        """The law, and what it remembers."""
        return {"law": self._controller.name} | {name: number_list(value) for name, value in self.fields.items()}

    def start(self, q: ArrayLike | None = None, command: ArrayLike | None = None) -> None:
        """Begin anew, at joint positions (n,) that a command (n,) has held until now, if both are given."""
        law, memory, n = self._controller, self._memory, self._controller.problem.n
        self.q = None if q is None else as_point("q", q, n)
        self.fields = {} if memory is None else {name: value.copy() for name, value in memory.start.items()}
        if memory is not None and memory.torque is not None and self.q is not None and command is not None:
            fallback = law.fallback(self.q, *law.gains.values()).full().ravel()
            self.fields[memory.torque] = as_point("command", command, n) - fallback - law.gains["extra_torque"]
        self._fresh = True

    def tick(self, q: ArrayLike, dq: ArrayLike, reference: ArrayLike, period: float) -> tuple[Array, ControlStatus]:
        """Command (n,) and status at a measured state.

        Args:
            q: joint positions (n,), those of joints that turn without end up to whole turns.
            dq: joint velocities (n,).
            reference: value, velocity and acceleration, (3, k).
            period: time since the last tick [s].
        """
        # The law at the position with its turns counted, with what it remembers added to its gains.
        law, n = self._controller, self._controller.problem.n
        targets = as_float_array("reference", reference)
        require_shape("reference", targets.shape, (3, len(law.labels)))
        position = as_point("q", q, n)
        self.q = position if self.q is None else law.problem.unwrap(position, self.q)
        state = self.q, as_point("dq", dq, n), *targets
        adds = {} if self._memory is None else self._memory.adds
        used = law.gains | {gain: law.gains[gain] + self.fields[name] for gain, name in adds.items()}
        command, (number,) = _evaluate(self._law, *state, *used.values())
        status = ControlStatus(int(number))
        # The memory stands still while a limit cuts the command, and in the first tick.
        if self._step is not None:
            active, since = float(status == ControlStatus.OK), 0.0 if self._fresh else as_number("period", period)
            fields = _evaluate(self._step, *state, *law.gains.values(), command, active, since, *self.fields.values())
            self.fields = dict(zip(self.fields, fields, strict=True))
        self._fresh = False
        return command, status


def _call_with_arrays(function: ca.Function) -> Batched:
    """A function of columns, to be called with arrays: CasADi's own conversions take most of the time of a tick."""
    inputs = [ca.MX.sym(name, *function.size_in(i)) for i, name in enumerate(function.name_in())]
    return Batched(dense_function(function.name(), inputs, function.call(inputs), function.name_in()))


def _evaluate(function: Batched, *columns: ArrayLike) -> list[Array]:
    return [out[0] for out in function(*(np.reshape(column, (1, -1)) for column in columns))]


@dataclass(frozen=True)
class _Correcting:
    """A rate, and a bound on the correction."""

    rate: float = 5.0
    bound: ArrayLike | None = None

    def __post_init__(self) -> None:
        require_positive("rate", self.rate)
        if self.bound is not None:
            as_float_array("bound", self.bound)

    def _bound_rate(self, period: ca.MX) -> Any:
        """The rate, or what a tick of that length bears."""
        return ca.fmin(self.rate, RULES.per_tick / ca.fmax(period, RULES.instant))


@dataclass(frozen=True)
class MomentumObserver(_Correcting):
    """Finds the torque that the model does not explain from the momentum p = M dq, and takes it off the command.

    With M ddq + C dq + g = tau + tau_ext, the momentum obeys dp/dt = tau + C^T dq - g + tau_ext. The observer
    r = rate (p - integral of (tau + C^T dq - g + r)) follows tau_ext with the time constant 1 / rate in any motion,
    and needs no acceleration. The law gets the `extra_torque` -r, cut at a bound: integral action against wrong masses,
    payloads, friction and offsets of torque sensors. It holds against people as well; what it finds is also what shows
    a collision.

    Args:
        rate: > 0 [1/s].
        bound: largest correction of each joint, > 0, (n,) or one number [N m] or [N]; default half of the law's limit.

    Source:
        De Luca, Albu-Schaeffer, Haddadin, Hirzinger, "Collision detection and safe reaction with the DLR-III
        lightweight manipulator arm", IROS 2006.
    """

    name: ClassVar[str] = "momentum"

    def of(self, law: _OperationalSpace) -> Memory:
        """The memory of a law: expected momentum, its rate, and the correction.

        Raises:
            ShapeError, InvalidValueError: for a bound of another shape or value, none for a law without a limit, and
                laws whose model is given.
        """
        n, model = law.problem.n, law.model
        bound = _check_bound(self.bound, law)
        fields = {name: np.zeros(n) for name in ("expected", "drive", "correction")}
        inputs = _name_inputs(law, fields)
        q, dq, period = inputs["q"], inputs["dq"], inputs["period"]
        payload = [inputs["payload"]] if "payload" in inputs else []
        p, rate = _build_momentum(law.problem.robot.tree, bool(payload), model.gravity == "law")(q, dq, *payload)

        # The momentum that the last tick foresaw; after a start, the one that explains the correction.
        anew, later = p + inputs["correction"] / self.rate, inputs["expected"] + period * inputs["drive"]
        expected = ca.if_else(ca.logic_and(period > 0, ca.fabs(later) <= LARGEST), later, anew)

        # r follows tau_ext; dp/dt = tau + C^T dq - g + r drives the momentum until the next tick.
        r = self._bound_rate(period) * (p - expected)
        drive = inputs["command"] - model.feed_forward(law.problem.robot, inputs) + rate + r
        return _build_memory(fields, inputs, {"expected": expected, "drive": drive, "correction": _clip(-r, bound)})


@dataclass(frozen=True)
class Adaptation(_Correcting):
    """Adaptive PD+: first moments of the links and of what the arm carries are learned from the tracking error.

    Inverse dynamics are linear in the errors p of the first moments (mass times centre) of the links. The law gets
    the `extra_torque` Y p with Y = Y(q, dq, w, a) at the desired velocity w and acceleration a of the joints, and
    dp/dt = -rate gain Y^T J^-1 (de / c + e) in phi, with a gain for each moment by the law's own stiffness, and c half
    of the decay rate of the law's slowest mode. Moments stay within bounds. Torque that no moment explains (offsets,
    friction) is known from the start only, when all that is missing counts as such; what is wrong about that in other
    postures is learned there.

    Args:
        rate: about how fast moments are learned, > 0 [1/s]; at most c.
        bound: largest correction of each joint, > 0, (n,) or one number [N m] or [N]; default half of the law's limit.

    Source:
        Slotine, Li, "On the adaptive control of robot manipulators", IJRR 6(3), 1987; here in the coordinates phi,
        with the gradient of PD+ and the crossed error of Tomei, "Adaptive PD controller for robot manipulators",
        IEEE T-RA 7(4), 1991.
    """

    name: ClassVar[str] = "adaptive"

    def of(self, law: _OperationalSpace) -> Memory:
        """The memory of a law: errors of first moments [kg m] (masses [kg] for sliding joints), offset, correction.

        Raises:
            ShapeError, InvalidValueError: for a bound of another shape or value, none for a law without a limit, and
                laws whose model is given.
        """
        problem, chart = law.problem, law.chart
        bound, tree = _check_bound(self.bound, law), problem.robot.tree
        regressor, joints = _build_regressor(tree)
        fields = {"moments": np.zeros(len(joints)), "offset": np.zeros(problem.n), "correction": np.zeros(problem.n)}
        inputs = _name_inputs(law, fields)
        q, dq = inputs["q"], inputs["dq"]

        # Y at the desired velocity w and acceleration a of the joints.
        e, de, J = law._compute_errors(inputs)
        B, Lambda, _ = build_block_inertia(chart.n, (chart.n,))(J, law.model.own_mass_matrix(problem.robot, inputs))
        w = B @ (Lambda @ law._compute_drift(inputs))
        reference = inputs["reference"], inputs["reference_velocity"], inputs["reference_acceleration"]
        a = -B @ (Lambda @ compute_bias(chart, q, dq, w, reference))
        Y = regressor(q, dq, w, a)

        # dp/dt = -rate gain Y^T J^-1 (de / c + e), while the law commands; gains follow its stiffness at the joints,
        # the diagonal of J^T K J at the centre of the domain.
        J_home = chart.parts.batched_rates(problem.domain.home[None])[0]
        stiffness = np.diag(J_home.T @ law.compute_stiffness(problem.domain.home[None])[0] @ J_home)
        springs = stiffness[list(joints)] / RULES.gravity**2
        slowest = self._compute_crossing(law)
        slope = -min(self.rate, slowest) * springs * (Y.T @ (B @ (Lambda @ (de / slowest + e))))
        change = ca.if_else(inputs["active"] > 0, inputs["active"] * inputs["period"] * slope, 0)
        largest = np.full(len(joints), float(bound.max()) / RULES.gravity)
        moments = _clip(inputs["moments"] + _replace_invalid(change), largest)

        # What no moment explains is known from the start only.
        offset = ca.if_else(inputs["period"] > 0, inputs["offset"], inputs["correction"] - Y @ moments)
        correction = _clip(Y @ moments + offset, bound)
        offset = _replace_invalid(offset)
        return _build_memory(fields, inputs, {"moments": moments, "offset": offset, "correction": correction})

    def _compute_crossing(self, law: _OperationalSpace) -> float:
        """c [1/s]; larger weights, and faster learning, make soft laws swing."""
        # The slowest mode with a spring.
        modes = law.modes(law.problem.domain.home)
        sprung = modes.frequencies > 0
        decays = 2 * np.pi * modes.frequencies[sprung] * np.minimum(modes.damping_ratios[sprung], 1.0)
        if not (decays > 0).any():
            raise InvalidValueError("law with a memory", "without springs and damping", "both, to learn from errors")
        return RULES.crossed * float(decays[decays > 0].min())


@dataclass(frozen=True)
class FrictionObserver(_Correcting):
    """Finds what the model does not explain, also in joints that stick, and stops where the error is small enough.

    A momentum observer r alone hunts: friction changes its sign with the motion, and what was found while a joint moved
    pushes it on where it stands. Here the law gets the `extra_torque` b - r. With d = J^-1 e, what each joint is off,

        s = clip(max_k |e_k| / tolerance_k - 1), s_i = s clip(max_k n |J_ki d_i| / tolerance_k - 1),
        dr_i/dt = s_i rate (the torque that momentum shows beyond command, C^T dq - g, r and -b),
        db_i/dt = -s_i 60/s k_i d_i exp(-(dq_i / 5 mrad/s)^2) - b_i |dq_i| / 3 mrad,

    where clip is 0 below 0, and then between 0.2 and 1, so that nothing creeps.

    b breaks joints away: it grows where a joint is off and stands, and is forgotten as soon as it moves, so that its
    own friction stops it. Joints that are off by little, s_i = 0, are left alone. k_i is M_ii times the squared
    frequency of the law's fastest mode, in series with the joint's compliance, or twice the joint's limit, if that is
    more: light joints are not slower.

    Between ticks nothing stops a joint. Where friction falls by b / 4, it goes on by b / 4 (3 period)^2 / (2 M_ii), and
    no law resolves less. tolerance_k is at least what that moves phi_k: nothing for arms with rotors, but 20 mrad for a
    bare flange of 1e-4 kg m^2, which would otherwise jump to and fro. Slow r bears wrong masses: with the rate
    alpha omega, a joint whose true inertia is kappa times that of the model is stable up to
    kappa = (2 zeta + alpha) (1 + 2 zeta alpha) / alpha (docs/explanation/derivations_springs.md#observers).

    Args:
        rate: > 0 [1/s].
        bound: largest r, b and correction of each joint, > 0, (n,) or one number [N m] or [N]; default half the limit.
        tolerance: errors of phi at which it stops, > 0, (n,) or one number; up to twice that may be left. Default
            0.25 mm, 5 mrad, and 0.01 of each xi.

    Example:
        >>> import orthocas as oc
        >>> chart = oc.charts.load("panda-wide")
        >>> law = oc.control.PDPlus(chart, remembers=oc.control.FrictionObserver())
        >>> list(law.memory.start)
        ['expected', 'drive', 'breakaway', 'correction']
    """

    tolerance: ArrayLike | None = None

    name: ClassVar[str] = "friction"

    def of(self, law: _OperationalSpace) -> Memory:
        """The memory of a law: expected momentum, its rate, b, and the correction b - r.

        Raises:
            ShapeError, InvalidValueError: for a bound or tolerance of another shape or value, none for a law without a
                limit, and laws whose model is given.
        """
        n, model = law.problem.n, law.model
        bound = _check_bound(self.bound, law)
        # Tolerances by the units of x and xi; the frequency of the law's fastest mode [rad/s].
        units = [RULES.metres if unit == "m" else RULES.others for unit in law.problem.task.units]
        default = np.array([*units, *[RULES.extra] * law.problem.r])
        tolerance = default if self.tolerance is None else positive_gains("tolerance", self.tolerance, n)
        fastest = law.fastest if law.is_limited else 2 * np.pi * float(law.modes().frequencies.max())
        fields = {name: np.zeros(n) for name in ("expected", "drive", "breakaway", "correction")}
        inputs = _name_inputs(law, fields)
        q, dq, period, b = (inputs[name] for name in ("q", "dq", "period", "breakaway"))
        payload = [inputs["payload"]] if "payload" in inputs else []
        p, rate = _build_momentum(law.problem.robot.tree, bool(payload), model.gravity == "law")(q, dq, *payload)

        # How far joints are off, and beyond the tolerance, while the law commands and no limit cuts it.
        error, _, J = law._compute_errors(inputs)
        M = law.model.own_mass_matrix(law.problem.robot, inputs)
        B, Lambda, _ = build_block_inertia(n, (n,))(J, M)
        off, inertia = B @ (Lambda @ error), ca.diag(M)
        jump = RULES.drop * ca.fabs(b) * (RULES.unseen * period) ** 2 / (2 * inertia)
        allowed = ca.fmax(ca.DM(tolerance), ca.fabs(J) @ jump)
        beyond = _clip_share(ca.mmax(ca.fabs(error) / allowed) - 1)
        parts = n * ca.fabs(off) * ca.vertcat(*(ca.mmax(ca.fabs(J[:, i]) / allowed) for i in range(n)))
        gate = ca.if_else(inputs["active"] > 0, inputs["active"] * beyond, 0) * _clip_share(parts - 1)

        # r, and the momentum that the last tick foresaw; none after a start.
        foreseen = inputs["expected"] + period * inputs["drive"]
        surprise = ca.if_else(ca.logic_and(period > 0, ca.fabs(foreseen) <= LARGEST), p - foreseen, 0)
        r = _clip(b - inputs["correction"] + gate * self._bound_rate(period) * surprise, bound)

        # b grows where a joint stands and is off, and is forgotten on its way.
        firmness = 1 / (1 / (inertia * fastest**2) + ca.DM(law.compliance))
        firmness = ca.fmax(firmness, RULES.firm * ca.DM(np.fmin(law.limit, LARGEST)))
        growth = period * RULES.breaking * gate * ca.exp(-((dq / RULES.sticking) ** 2))
        grown = b - growth * _clip(firmness * off, bound)
        b = _clip(grown * ca.exp(-ca.fabs(dq) * period / RULES.travel), bound)
        explained = inputs["command"] - model.feed_forward(law.problem.robot, inputs) + rate
        correction = _clip(b - r, bound)
        values = {"expected": p, "drive": explained - correction, "breakaway": b, "correction": correction}
        return _build_memory(fields, inputs, {name: _replace_invalid(value) for name, value in values.items()})


MEMORIES: Mapping[str, type[MomentumObserver] | type[Adaptation] | type[FrictionObserver]] = {
    kind.name: kind for kind in (MomentumObserver, Adaptation, FrictionObserver)
}


def _check_bound(bound: ArrayLike | None, law: _OperationalSpace) -> Array:
    """Largest corrections (n,)."""
    if law.model.source == "given":
        raise InvalidValueError("model of a law with a memory", "given", "own, because it needs the momentum")
    if bound is not None:
        return positive_gains("bound", bound, law.problem.n)
    largest = RULES.fraction * law.limit
    if not np.isfinite(largest).all():
        raise InvalidValueError("bound of the correction", largest.tolist(), "finite numbers > 0, or a finite limit")
    return largest


def _name_inputs(law: _OperationalSpace, fields: Mapping[str, Array]) -> dict[str, ca.MX]:
    """Symbols for the inputs of a step, in order."""
    further = {"command": law.problem.n, "active": 1, "period": 1} | {name: len(fields[name]) for name in fields}
    symbols = {name: ca.MX.sym(name, size) for name, size in further.items()}
    return named_inputs(law.problem.n, law.gains, len(law.labels)) | symbols


def _build_memory(fields: Mapping[str, Array], inputs: dict[str, ca.MX], values: Mapping[str, ca.MX]) -> Memory:
    """A memory whose `correction` is a torque."""
    outputs = {f"next_{name}": value for name, value in values.items()}
    return Memory(fields, {"extra_torque": "correction"}, build_function("memory", inputs, outputs))


def _clip_share(values: ca.MX) -> Any:
    """0 for values that are not positive, others within `RULES.least` and 1."""
    return ca.if_else(values > 0, ca.fmin(ca.fmax(values, RULES.least), 1), 0)


def _clip(values: ca.MX, bound: Array) -> Any:
    """Values within +- bound; 0 where they are no numbers."""
    return ca.fmin(ca.fmax(_replace_invalid(values), -ca.DM(bound)), ca.DM(bound))


def _replace_invalid(values: ca.MX) -> Any:
    return ca.if_else(ca.fabs(values) <= LARGEST, values, 0)


def _build_momentum(tree: KinematicTree, with_payload: bool, with_gravity: bool) -> ca.Function:
    """q, dq, and the payload if there is one -> p = M dq and C^T dq - g, (n, 1) each, without g if the robot adds it.

    C^T dq is the gradient of the kinetic energy dq^T M dq / 2 by q: dM/dt dq = C dq + C^T dq.
    """
    q, dq, rest = ca.SX.sym("q", tree.n), ca.SX.sym("dq", tree.n), ca.SX(tree.n, 1)
    payload = ca.SX.sym("payload", dynamics.PAYLOAD) if with_payload else None
    p = dynamics.build_inverse_dynamics(tree, q, rest, dq, payload, gravity=np.zeros(3))
    rate = ca.gradient(ca.dot(dq, p) / 2, q)
    if with_gravity:
        rate -= dynamics.build_bias(tree, q, rest, payload)
    inputs = [q, dq] if payload is None else [q, dq, payload]
    return ca.Function("momentum", inputs, [ca.densify(p), ca.densify(rate)])


def _build_regressor(tree: KinematicTree) -> tuple[ca.Function, tuple[int, ...]]:
    """q, dq, w, a -> Y (n, k) of M a + C(q, dq) w + g in the first moments, and the joint whose link has each."""
    q, dq, w, a = (ca.SX.sym(name, tree.n) for name in ("q", "dq", "w", "a"))
    numbers = ca.SX.sym("numbers", len(dynamics.collect_inertials(tree)))
    rest, weightless = ca.SX(tree.n, 1), np.zeros(3)
    force = dynamics.build_inverse_dynamics(tree, q, rest, a, inertials=numbers)
    # C(q, dq) w by polarisation, as in `dynamics.build_coriolis_product`.
    for sign in (1, -1):
        force += sign / 4 * dynamics.build_bias(tree, q, dq + sign * w, inertials=numbers, gravity=weightless)
    places, joints = dynamics.find_first_moments(tree)
    # The force is linear in them, but for the rotors' inertias, which do not depend on the first moments.
    Y = ca.jacobian(force, numbers)[:, places]
    return ca.Function("regressor", [q, dq, w, a], [ca.densify(Y)]), joints
