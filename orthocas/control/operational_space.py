"""Impedance and PD+ control in phi ([AS2023] Sec. 8), and their modes of decoupling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.point_quality import Judged, least_in_domain
from orthocas.control.controller import (
    Command,
    LawOfChart,
    Setting,
    build_function,
    compute_bias,
    compute_drift,
    compute_errors,
    count_turns_from_centre,
    fallback_function,
    guarded_graph,
    named_inputs,
    require_chart,
)
from orthocas.control.gains import (
    COMPLIANCE,
    DAMPING_RATIO,
    FASTEST,
    LIMIT,
    STIFFNESS,
    Modes,
    command_limit,
    compute_mobility,
    compute_modes,
    find_fastest_posture,
    find_holding_doubts,
    limit_stiffness,
    matched_stiffness,
    non_negative_gains,
    positive_gains,
    tracking_gains,
)
from orthocas.control.linear_algebra import (
    DAMPING_DESIGNS,
    DampingDesign,
    apply_damping,
    apply_limited_springs,
    build_block_inertia,
    compute_median_volume,
)
from orthocas.control.memory import MEMORIES, Memory, Remembers
from orthocas.control.run_time_model import UNITS, Gravity, RunTimeModel, Source
from orthocas.errors import InvalidValueError, LawWarning, warn_caller
from orthocas.robots.robot import Robot
from orthocas.tasks.metric import Metric
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_number, as_point_set, require_kind, require_known
from orthocas.tools.display import percent


@dataclass(frozen=True, slots=True)
class TorqueRules:
    """Numbers of torque laws."""

    samples: int = 256  #: of the domain, for modes and leaks
    much_deg: float = 15.0  #: leak from which on decoupled laws are warned of [deg]
    large_ratio: float = 5.0  #: damping ratio from which on a percentage is suspected


RULES = TorqueRules()

Coupling = Literal["coupled", "decoupled"]


@dataclass(frozen=True)
class DampingCheck:
    """Whether the damping matrix D is positive semi-definite over a domain."""

    samples: int
    smallest_eigenvalue: float  #: of D, divided by the largest eigenvalue at the same point
    indefinite_share: float  #: share of samples with a negative eigenvalue
    worst_point: tuple[float, ...]  #: [rad] or [m]


@dataclass(frozen=True, eq=False, repr=False)
class _OperationalSpace(LawOfChart):
    """The common part of impedance control and PD+: settings, inertia and damping in the coordinates of a chart.

    Args:
        chart: a chart with a closed expression (not a grown one).
        stiffness: diagonal of K, > 0, (n,) or one number for all; [N/m] for positions, [J] for coordinates. With
            `damping_stiffness`, 0 is allowed. Default: `tracking_gains` for PD+, `matched_stiffness` for impedance.
        damping_ratio: diagonal of Z, >= 0, (n,) or one number.
        coupling: `coupled` uses the full M_phi = (J M^-1 J^T)^-1; `decoupled` adds one controller for the task and one
            for the extra coordinates, each with its own inertia, and relies on condition (5).
        damping: `double_diagonal` is always positive semi-definite; `square_root` is the paper's design (29), which is
            indefinite in parts of many domains if the stiffnesses are far apart.
        limit: largest torque of each joint, (n,) or one number [N m] or [N]; default the effort limits of the robot.
        damping_stiffness: damping is designed as if this were the stiffness, > 0, (n,) or one number. So a coordinate
            without a spring, K_i = 0, is free, but does not swing. Default: damping follows the stiffness.
        model: where the law gets the robot's model from, and its additional inputs. Default: the model of the problem.
        fastest: frequency omega > 0 that no mode exceeds [rad/s]: K is then in series with omega^2 M_phi(q),
            K(q) = (K^-1 + M_phi^-1 / omega^2 + J diag(c) J^T)^-1, and the damping is designed for K(q). For
            `double_diagonal`, without `damping_stiffness`. Default, and infinity: K itself, but 18 Hz for PD+ without a
            stiffness.
        compliance: c >= 0 of each joint, in series with the springs, (n,) or one number [rad/(N m)]; used with a finite
            `fastest`. Default: 0, but that of `tracking_gains` for PD+ without a stiffness.
        remembers: integral action against a wrong model: `FrictionObserver()`, `MomentumObserver()`, `Adaptation()`, or
            their names "friction", "momentum", "adaptive". Arms that stick need the first. It needs the input
            `extra_torque`, which it adds to `model`, and ticks: a `control_rate` in simulations, the supervised law in
            C, `Remembering` in programs of your own. Default: none.

    Raises:
        ShapeError, InvalidValueError, UnknownNameError: for settings of the wrong shape, value or name.
        NoExpressionError: if the chart is grown; `orthocas.distil` turns it into a chart with a closed expression.
    """

    chart: Chart
    stiffness: Array
    damping_ratio: Array
    coupling: Coupling
    damping: DampingDesign
    limit: Array
    damping_stiffness: Array | None
    fastest: float
    compliance: Array
    model: RunTimeModel
    remembers: Remembers | None

    feed_forward: ClassVar[bool]
    name: ClassVar[str]
    force: ClassVar[str]  #: the formula, without torques that do not act through the coordinates
    command: ClassVar[Command] = "torque"
    options: ClassVar[Mapping[str, Setting]] = {
        "stiffness": Setting(
            '"100", or "100,50,..." per quantity; default: modes up to 18 Hz (PD+), around 6 Hz (impedance).'
        ),
        "delay": Setting("Delay from measurement to torque that the default stiffness is to bear [s]; default: 0."),
        "damping_ratio": Setting('"0.7", or "0.7,1,..." per quantity; default: 0.7.'),
        "coupling": Setting("coupled (default) or decoupled.", is_word=True),
        "damping": Setting("double_diagonal (default) or square_root.", is_word=True),
        "model": Setting(
            "own (default), or given: mass matrix and torques become inputs.", is_word=True, codegen_only=True
        ),
        "gravity": Setting(
            "law (default) compensates gravity; robot: the robot does so itself.",
            is_word=True,
            codegen_only=True,
            option="--gravity-compensation",
        ),
        "inputs": Setting(
            "Additional inputs: payload, wrench, extra_torque, with commas between.", is_word=True, codegen_only=True
        ),
        "memory": Setting(
            "none (default), momentum, adaptive or friction: against wrong models; simulations need a rate.",
            is_word=True,
        ),
    }

    def __init__(
        self,
        chart: Chart,
        stiffness: ArrayLike | None = None,
        damping_ratio: ArrayLike = 0.7,
        coupling: Coupling = "coupled",
        damping: DampingDesign = "double_diagonal",
        limit: ArrayLike | None = None,
        damping_stiffness: ArrayLike | None = None,
        model: RunTimeModel | None = None,
        remembers: Remembers | Literal["momentum", "adaptive", "friction"] | None = None,
        *,
        fastest: float | None = None,
        compliance: ArrayLike | None = None,
        delay: float = 0.0,
    ) -> None:
        require_known("coupling", coupling, get_args(Coupling))
        require_known("damping", damping, DAMPING_DESIGNS)
        require_chart(chart, f"the law {self.name}")
        model = RunTimeModel() if model is None else model
        require_kind("model", model, RunTimeModel)
        if isinstance(remembers, str):
            require_known("remembers", remembers, MEMORIES)
            remembers = MEMORIES[remembers]()
        if remembers is not None and not callable(getattr(remembers, "of", None)):
            raise InvalidValueError(
                "remembers", repr(remembers)[:80], "what makes a memory, such as MomentumObserver()"
            )
        if remembers is not None and model.extra_torque is None:
            model = replace(model, extra_torque=0.0)
        # Values of another size raise here.
        n, as_stiffness = chart.n, damping_stiffness is None
        if damping_stiffness is not None:
            damping_stiffness = positive_gains("damping_stiffness", damping_stiffness, n)
        model.gains(chart.problem, self.feed_forward)
        can_limit = as_stiffness and damping == "double_diagonal"
        stiffness, fastest, compliance = self._choose_springs(
            chart, stiffness, fastest, compliance, delay, damping_ratio, can_limit
        )
        for name, value in {
            "chart": chart,
            "stiffness": (positive_gains if as_stiffness else non_negative_gains)("stiffness", stiffness, n),
            "damping_stiffness": damping_stiffness,
            "model": model,
            "damping_ratio": non_negative_gains("damping_ratio", damping_ratio, n),
            "coupling": coupling,
            "damping": damping,
            "fastest": fastest,
            "compliance": non_negative_gains("compliance", compliance, n),
            "limit": command_limit("limit", limit, chart.problem.robot.effort_limits),
            "remembers": remembers,
        }.items():
            object.__setattr__(self, name, value)
        if remembers is not None:
            # Bounds of another size raise here.
            _ = self.memory
        # Doubtful settings are accepted with a warning.
        doubts = [*_doubt_ratio(self.damping_ratio), *self._find_holding_doubts()]
        if coupling == "decoupled" and (metric := chart.problem.metric.name) != "inertia":
            doubts.append(f"a decoupled law relies on A = M (inertia), but the metric of this chart is {metric}")
        for doubt in doubts:
            warn_caller(doubt, LawWarning)

    @classmethod
    def _choose_springs(
        cls,
        chart: Chart,
        stiffness: ArrayLike | None,
        fastest: float | None,
        compliance: ArrayLike | None,
        delay: float,
        damping_ratio: ArrayLike,
        can_limit: bool,
    ) -> tuple[ArrayLike, float, ArrayLike]:
        """Stiffness, the frequency that no mode exceeds, and compliance: what was given, or the default."""
        if stiffness is not None and delay:
            raise InvalidValueError("delay", delay, "none with a given stiffness")
        if stiffness is None and fastest is None and compliance is None and cls.feed_forward and can_limit:
            return tracking_gains(chart, delay, damping_ratio)
        if stiffness is None:
            stiffness = matched_stiffness(chart, delay=delay, damping_ratio=damping_ratio)
        omega = np.inf if fastest is None else as_number("fastest", fastest)
        if not omega > 0:
            raise InvalidValueError("fastest", fastest, "a number > 0 or infinity")
        if np.isfinite(omega) and not can_limit:
            raise InvalidValueError("fastest", fastest, "infinity with damping_stiffness and with square_root damping")
        if compliance is not None and np.any(compliance) and not np.isfinite(omega):
            raise InvalidValueError("compliance", compliance, "none without a finite `fastest`")
        return stiffness, omega, 0.0 if compliance is None else compliance

    @classmethod
    def on_chart(
        cls,
        chart: Chart,
        limit: ArrayLike | None = None,
        *,
        stiffness: ArrayLike | None = None,
        damping_ratio: ArrayLike = 0.7,
        coupling: Coupling = "coupled",
        damping: DampingDesign = "double_diagonal",
        damping_stiffness: ArrayLike | None = None,
        model: Source = "own",
        gravity: Gravity = "law",
        inputs: str = "",
        memory: Literal["none", "momentum", "adaptive", "friction"] = "none",
        fastest: float | None = None,
        compliance: ArrayLike | None = None,
        delay: float = 0.0,
    ) -> Self:
        """Build the law on a chart from numbers and words; other settings are those of the law itself.

        `model`, `gravity` and `inputs` ("payload,wrench,extra_torque") are those of a `RunTimeModel`, `memory` names a
        `MomentumObserver`, an `Adaptation` or a `FrictionObserver`. Without a stiffness, modes are slow enough to bear
        a `delay` from the measurement to the torque [s].

        Raises:
            ShapeError, InvalidValueError, UnknownNameError: as for the law itself, and for a delay beside a stiffness.
        """
        # Words become the objects that they name.
        require_known("memory", memory, ("none", *MEMORIES))
        remembers = None if memory == "none" else memory
        zeros: dict[str, ArrayLike] = {"payload": 0.0, "wrench": np.zeros(6), "extra_torque": 0.0}
        names = inputs.split(",") if inputs else []
        for name in names:
            require_known("input", name, zeros)
        run_time = RunTimeModel(model, gravity, **{name: zeros[name] for name in names})
        settings = (stiffness, damping_ratio, coupling, damping, limit, damping_stiffness, run_time, remembers)
        return cls(chart, *settings, fastest=fastest, compliance=compliance, delay=delay)

    @cached_property
    def memory(self) -> Memory | None:
        """What the law remembers from tick to tick."""
        if self.remembers is None:
            return None
        memory = self.remembers.of(self)
        require_kind("memory", memory, Memory)
        memory.require_fitting(self)
        return memory

    @property
    def settings(self) -> Mapping[str, str]:
        """Coupling and damping design, and choices of the model that differ from the default."""
        memory = {} if self.remembers is None else {"memory": self.remembers.name}
        return {"coupling": self.coupling, "damping": self.damping, **self.model.settings, **memory}

    @property
    def formula(self) -> str:
        """The law in one line, for generated C."""
        wrench, extra = (name in self.gains for name in ("wrench", "extra_torque"))
        gravity = " + g(q)" if self.model.gravity == "law" else ""
        return f"{self.force}{gravity}{' + J_tip^T wrench' if wrench else ''}{' + extra_torque' if extra else ''}."

    @property
    def gain_units(self) -> Mapping[str, str]:
        """Units and admissible values of the gains, in words, by name."""
        design = {"damping_stiffness": "like stiffness, > 0; damping is designed for it"}
        springs = {"stiffness": STIFFNESS, "fastest": FASTEST, "compliance": COMPLIANCE}
        return {**springs, "damping_ratio": DAMPING_RATIO, "limit": LIMIT, **design, **UNITS}

    def remarks(self) -> list[str]:
        """Warnings.

        The motors cannot hold the arm, the metric does not decouple task and extra coordinates, a damping ratio looks
        like a percentage, a decoupled law has a chart that leaks much, or D is not positive semi-definite.
        """
        result, metric = [*self._find_holding_doubts()], self.problem.metric.name
        if metric != "inertia":
            result.append(
                f"the metric of this chart is {metric}, but task and extra coordinates are decoupled only for A = M "
                "(inertia)"
            )
        result += _doubt_ratio(self.damping_ratio)
        # Where coordinates leak, decoupled springs pull at task and xi.
        if self.coupling == "decoupled":
            points = sample_uniform(self.problem.domain, RULES.samples, 0)
            sines = Judged.at(self.problem, self.chart.coordinates, points).leak_sines
            leak = float(np.degrees(np.sqrt(np.mean(np.arcsin(np.clip(sines, 0.0, 1.0)) ** 2))))
            if leak > RULES.much_deg:
                result.append(
                    f"the gradients of this chart lean into the task by {leak:.0f} deg (rms): decoupled springs pull "
                    "at both, which coupled ones do not; see docs/how-to/wide.md"
                )
        # Indefinite damping can feed energy in.
        if fraction := self.check_damping().indefinite_share:
            where = f"in {percent(fraction, fault=True)} of the domain with these gains"
            result.append(f"the damping matrix (29) is indefinite {where}; the damping design double_diagonal never is")
        return result + self.model.remarks()

    def _find_holding_doubts(self) -> list[str]:
        """Of an arm that the motors cannot hold; none if the robot compensates gravity itself."""
        if self.model.gravity == "robot":
            return []
        return find_holding_doubts(self.model.robot(self.problem), self.problem.domain, self.limit)

    @property
    def gains(self) -> dict[str, Array]:
        """Stiffness, fastest mode and compliance if K(q) varies, damping ratio, limit, inputs that were asked for."""
        springs = {"fastest": np.array([self.fastest]), "compliance": self.compliance} if self.is_limited else {}
        design = {} if self.damping_stiffness is None else {"damping_stiffness": self.damping_stiffness}
        inputs = self.model.gains(self.problem, self.feed_forward)
        return {
            "stiffness": self.stiffness,
            **springs,
            "damping_ratio": self.damping_ratio,
            "limit": self.limit,
            **design,
            **inputs,
        }

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        inputs = named_inputs(self.chart.n, self.gains, self.chart.n)
        q, dq, robot, model = inputs["q"], inputs["dq"], self.problem.robot, self.model

        # f_imp = -K(q) e - D de, (33); Lambda is M_phi, or its blocks.
        e, de, J = self._compute_errors(inputs)
        B, Lambda, volume = self._compute_inertia(J, model.mass_matrix(robot, inputs))
        spring, damper = self._apply_springs(J, B, Lambda, inputs, e, de)
        force = -spring - damper

        # f_FF = Lambda (dd_phi_d + (J M^-1 C - dJ/dt) w), (35), with w = J^-1 d_phi_d: by (8) also when decoupled.
        if self.feed_forward:
            w = B @ (Lambda @ self._compute_drift(inputs))
            reference = inputs["reference"], inputs["reference_velocity"], inputs["reference_acceleration"]
            bias = compute_bias(self.chart, q, dq, dq if model.source == "given" else w, reference)
            force += Lambda @ (B.T @ model.coriolis_torque(robot, inputs, w) - bias)

        # tau = J^T f + g + J_tip^T wrench + extra_torque.
        gravity = model.gravity_torque(robot, inputs)
        torque = J.T @ force + gravity + model.feed_forward(robot, inputs)
        relative = volume / self.median_volume
        return guarded_graph(self.name, inputs, torque, gravity, relative, self.problem.domain)

    @cached_property
    def fallback(self) -> ca.Function:
        """q, gains -> gravity torque, also of the payload; zero if the robot compensates gravity."""
        inputs = named_inputs(self.chart.n, self.gains, 0)
        return fallback_function(inputs, self.model.gravity_torque(self.problem.robot, inputs))

    @cached_property
    def energy(self) -> ca.Function:
        """The fast form of `energy_graph`."""
        return self.chart.parts.runnable(count_turns_from_centre(self.energy_graph, self.problem))

    @cached_property
    def energy_graph(self) -> ca.Function:
        """V = 1/2 de^T M_phi de + 1/2 e^T K(q) e [J] and P = de^T D de [W], e = phi - phi_d.

        Impedance control uses the velocity J dq instead of de, so V is the kinetic energy plus that of the springs.
        M_phi is the full inertia even for decoupled controllers, because the robot's energy is not block diagonal. M is
        that of the problem's robot with the payload, also if the law is given another one.
        """
        inputs = named_inputs(self.chart.n, self.gains, self.chart.n)
        # Kinetic and spring energy, and the power of the damping.
        M = self.model.own_mass_matrix(self.problem.robot, inputs)
        e, de, J = self._compute_errors(inputs)
        B, Lambda, _ = self._compute_inertia(J, M)
        spring, damping_force = self._apply_springs(J, B, Lambda, inputs, e, de)
        M_phi = build_block_inertia(self.chart.n, (self.chart.n,))(J, M)[1]
        kinetic = ca.bilin(M_phi, de, de) if self.feed_forward else ca.bilin(M, inputs["dq"], inputs["dq"])
        storage = (kinetic + ca.dot(e, spring)) / 2
        outputs = {"storage": storage, "dissipated_power": ca.dot(de, damping_force)}
        return build_function("energy", inputs, outputs)

    @cached_property
    def damping_matrix(self) -> ca.Function:
        """q, stiffness, damping_ratio, then those of `_damping_inputs` that are inputs -> D(q), (n, n)."""
        inputs = named_inputs(self.chart.n, self.gains, self.chart.n)
        chosen = {name: inputs[name] for name in ("q", *self._damping_inputs)}
        J, M = self.chart.parts.rates(inputs["q"]), self.model.own_mass_matrix(self.problem.robot, inputs)
        identity = ca.MX.eye(self.chart.n)
        B, Lambda, _ = self._compute_inertia(J, M)
        D = self._apply_springs(J, B, Lambda, inputs, identity, identity)[1]
        return self.chart.parts.runnable(build_function("damping_matrix", chosen, {"D": D}))

    def check_damping(self, samples: int = 1000, seed: int = 0) -> DampingCheck:
        """Find the smallest eigenvalue of D over uniform samples of the domain; (29) can make it negative."""
        points = sample_uniform(self.problem.domain, samples, seed)
        values = np.linalg.eigvalsh(self._compute_damping(points))
        ratio = values[:, 0] / np.abs(values).max(axis=1).clip(np.finfo(float).tiny)
        worst = int(np.argmin(ratio))
        return DampingCheck(samples, float(ratio[worst]), float((ratio < -1e-12).mean()), tuple(points[worst].tolist()))

    def modes(self, q: ArrayLike | None = None) -> Modes:
        """Modes of the closed loop M_phi dde + D de + K(q) e = 0 at rest, without disturbances.

        Args:
            q: one posture (n,) or several (N, n); default: 256 uniform samples of the domain, and last the posture
                of the fastest mode, which descents find (`least_in_domain`).

        Raises:
            ShapeError, InvalidValueError: if q has another shape, or is not finite.
        """
        if q is None:
            fastest = find_fastest_posture(self.chart, self.stiffness, self._robot)
            q = np.vstack([sample_uniform(self.problem.domain, RULES.samples, 0), fastest])
        points, single = as_point_set("q", q, self.chart.n)
        W = compute_mobility(self.chart, points, self._robot)
        result = compute_modes(W, self.compute_stiffness(points), self._compute_damping(points))
        return Modes(*(values[0] for values in vars(result).values())) if single else result

    @cached_property
    def _robot(self) -> Robot:
        """The robot with the default payload: one object, whose functions are built once."""
        return self.model.robot(self.problem)

    @cached_property
    def integral_bound(self) -> float:
        """Largest rate of integral action [1/s]: zeta omega of the slowest mode that descents find in the domain.

        With the rate L, a mode becomes kappa s^3 + 2 zeta omega s^2 + omega^2 s + L omega^2, where kappa is the true
        inertia in that of the model. It is stable for L < 2 zeta omega / kappa, so half of that bears kappa = 2.
        """

        def find_slowest(q: Array) -> Array:
            modes = self.modes(q)
            with np.errstate(invalid="ignore"):
                decays = 2 * np.pi * modes.frequencies * modes.damping_ratios
            # Coordinates without a spring have no integral action.
            return np.asarray(np.where(modes.frequencies > 0, decays, np.inf).min(axis=1))

        # A mode without damping bears none; rounding may put it below zero.
        return max(0.0, float(find_slowest(least_in_domain(find_slowest, self.problem.domain)[None])[0]))

    def compute_stiffness(self, points: Array) -> Array:
        """K(q) at points (N, n), (N, n, n): the diagonal of the stiffness, or what inertia and joints leave of it."""
        if not self.is_limited:
            return np.tile(np.diag(self.stiffness), (len(points), 1, 1))
        W = compute_mobility(self.chart, points, self._robot)
        J = self.chart.parts.batched_rates(points)
        return limit_stiffness(W, J, self.stiffness, self.fastest, self.compliance, self._blocks)

    def _compute_damping(self, points: Array) -> Array:
        """D(q) with the law's gains at points (N, n), (N, n, n)."""
        rows = [np.tile(self.gains[name], (len(points), 1)) for name in self._damping_inputs]
        return Batched(self.damping_matrix)(points, *rows)[0].reshape(-1, self.chart.n, self.chart.n)

    @property
    def _damping_inputs(self) -> tuple[str, ...]:
        """The inputs that the damping depends on."""
        names = ("stiffness", "damping_ratio", "fastest", "compliance", "damping_stiffness", "payload")
        return tuple(name for name in names if name in self.gains)

    @property
    def is_limited(self) -> bool:
        """Whether springs are in series with the inertia, so that no mode is faster than `fastest`."""
        return bool(np.isfinite(self.fastest))

    @property
    def _blocks(self) -> tuple[int, ...]:
        return (self.chart.n,) if self.coupling == "coupled" else (self.chart.m, self.chart.r)

    def _compute_inertia(self, J: ca.MX, M: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """B = M^-1 J^T, the inertia Lambda in blocks, and its volume."""
        B, Lambda, volume = build_block_inertia(self.chart.n, self._blocks)(J, M)
        return B, Lambda, volume

    def _apply_springs(
        self, J: ca.MX, B: ca.MX, Lambda: ca.MX, inputs: dict[str, ca.MX], e: ca.MX, de: ca.MX
    ) -> tuple[ca.MX, ca.MX]:
        """K(q) E and D V, with the same blocks, for E (n, c) and V (n, d)."""
        # A function of its own, block by block, so that its code appears once.
        n, c, d = self.chart.n, e.shape[1], de.shape[1]
        places = [place.tolist() for place in np.split(np.arange(n), np.cumsum(self._blocks)[:-1])]
        inertia, C, K, Z = (ca.MX.sym(name, n, size) for name, size in {"Lambda": n, "C": n, "K": 1, "Z": 1}.items())
        E, V = ca.MX.sym("E", n, c), ca.MX.sym("V", n, d)
        if self.is_limited:
            compliance = J @ B / inputs["fastest"] ** 2 + (J * ca.repmat(inputs["compliance"].T, n, 1)) @ J.T
            parts = [apply_limited_springs(inertia[p, p], C[p, p], K[p], Z[p], E[p, :], V[p, :]) for p in places]
            outputs = [ca.densify(ca.vertcat(*blocks)) for blocks in zip(*parts, strict=True)]
            springs = ca.Function("springs", [inertia, C, K, Z, E, V], outputs)
            spring, damper = springs(Lambda, compliance, inputs["stiffness"], inputs["damping_ratio"], e, de)
            return spring, damper
        dampers = [apply_damping(self.damping, inertia[p, p], K[p], Z[p], V[p, :]) for p in places]
        damping = ca.Function("damping", [inertia, K, Z, V], [ca.densify(ca.vertcat(*dampers))])
        designed_for = inputs.get("damping_stiffness", inputs["stiffness"])
        damper = damping(Lambda, designed_for, inputs["damping_ratio"], de)
        return ca.repmat(inputs["stiffness"], 1, c) * e, damper

    def _compute_errors(self, inputs: dict[str, ca.MX]) -> tuple[ca.MX, ca.MX, ca.MX]:
        """The error e, how fast it changes, and J = de/dq."""
        e, J = compute_errors(self.chart, inputs["q"], inputs["reference"])
        velocity = J @ inputs["dq"]
        return e, velocity - self._compute_drift(inputs) if self.feed_forward else velocity, J

    def _compute_drift(self, inputs: dict[str, ca.MX]) -> ca.MX:
        return compute_drift(self.chart, inputs["q"], inputs["reference"], inputs["reference_velocity"])

    @cached_property
    def median_volume(self) -> float:
        """Of the gradients over the domain, squared; in blocks if the law is decoupled."""
        inertia = Metric.from_spec(self.problem.robot, "inertia")
        return compute_median_volume(self.problem, self.chart.parts.rates, inertia, self._blocks)


def _doubt_ratio(damping_ratio: Array) -> list[str]:
    """A remark on damping ratios that are far above 1."""
    largest = float(damping_ratio.max())
    if largest <= RULES.large_ratio:
        return []
    return [f"damping_ratio = {largest:g} is far above critical damping, which is 1; 0.7 is usual"]


class Impedance(_OperationalSpace):
    """Impedance control tau = J^T (-K (phi - phi_d) - D J dq) + g.

    For constant phi_d, V = 1/2 dq^T M dq + 1/2 e^T K e changes by -dq^T J^T D J dq. So the loop is passive where D is
    positive semi-definite: everywhere with `double_diagonal`. With `square_root` it may be indefinite; for the default
    stiffness and the 7-DoF arm, it is in 1.5 % of the domain (position) or 77 % (pose). `check_damping` measures this.
    Saturation, and the fallback outside the domain, are not covered.

    Source:
        [AS2023] eqs. (28), (29), (33).
    """

    feed_forward = False
    name: ClassVar[str] = "impedance"
    force = "Impedance control: tau = J^T (-K (phi - phi_d) - D J dq)"


class PDPlus(_OperationalSpace):
    """Trajectory tracking tau = J^T (f_imp + f_FF) + g, operational space PD+.

    f_FF = M_phi (dd_phi_d + (J M^-1 C - dJ/dt) J^-1 d_phi_d) + D d_phi_d.

    Without a stiffness, the springs change with q, so that no mode is fast and hardly one slow (`compute_stiffness`).
    With a given stiffness, the coupled law is passive.

    Source:
        [AS2023] eq. (35).

    Example:
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> chart = oc.fit(problems.get("planar_3r_xy"), oc.Polynomial(degree=2), samples=300).chart
        >>> controller = oc.control.PDPlus(chart, stiffness=50.0, coupling="decoupled")
        >>> controller.labels, controller.command
        (('x', 'y', 'xi1'), 'torque')
    """

    feed_forward = True
    name: ClassVar[str] = "pd_plus"
    force = "Operational space PD+: tau = J^T (f_imp + f_FF)"
