"""Impedance and PD+ control in phi ([AS2023] Sec. 8), and their modes of decoupling."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.chart import Chart
from orthocas.charts.point_quality import Judged
from orthocas.control.controller import (
    Command,
    count_turns_from_centre,
    fallback_function,
    guarded_graph,
    law_facts,
    named_function,
    named_inputs,
)
from orthocas.control.errors import bend, drift, errors
from orthocas.control.gains import (
    DAMPING_RATIO,
    DAMPING_RATIO_SETTING,
    DELAY_SETTING,
    LIMIT,
    STIFFNESS,
    STIFFNESS_SETTING,
    Setting,
    command_limit,
    fastest_posture,
    matched_stiffness,
    mobility,
    non_negative_gains,
    positive_gains,
)
from orthocas.control.holding import holding_doubts
from orthocas.control.linear_algebra import DAMPING_DESIGNS, DampingDesign, block_inertia, damped, median_volume
from orthocas.control.memory import MEMORIES, Memory, Remembers
from orthocas.control.posture import joint_path
from orthocas.control.reference import Reference
from orthocas.control.run_time_model import Gravity, RunTimeModel, Source
from orthocas.errors import InvalidValueError, LawWarning
from orthocas.robots.tree import require_driven
from orthocas.tasks.problem import Problem
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_point_set, require_kind, require_known
from orthocas.tools.display import Shown, number_list, percent

_MODE_SAMPLES = 256
_MUCH_DEG = 15.0  # leak from which on decoupled laws are warned of
_LARGE_RATIO = 5.0  # damping ratio from which on a percentage is suspected


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Shown):
    """Modes of M_phi dde + D de + K e = 0 at one posture (n,) or at several (N, n).

    Mode i has the shape v_i with K v_i = omega_i^2 M_phi v_i and v_i^T M_phi v_i = 1. Its damping ratio is
    v_i^T D v_i / (2 omega_i). This is exact if D is diagonal in the modes, as for coupled laws with `double_diagonal`
    and one damping ratio for all.
    """

    frequencies: Array  #: [Hz], in ascending order
    damping_ratios: Array  #: infinite for a mode without a spring
    delays: Array  #: longest delay of the loop with which the mode alone stays stable [s]

    def facts(self) -> dict[str, str]:
        """Frequencies, damping ratios and delay."""
        return {
            "modes": f"{number_list(np.median(np.atleast_2d(self.frequencies), axis=0))} Hz",
            "fastest": f"{self.frequencies.max():.4g} Hz",
            "damping ratios": f"{self.damping_ratios.min():.3g} to {self.damping_ratios.max():.3g}",
            "delay": f"stable up to {1e3 * self.delays.min():.3g} ms",
        }


def modes_of(mobility: Array, stiffness: Array, damping: Array) -> Modes:
    """Modes for M_phi^-1 (N, n, n), the diagonal of K (n,), and D (N, n, n).

    With S = M_phi^-1/2 and the unit eigenvectors u_i of S K S, v_i = S u_i.
    """
    values, vectors = np.linalg.eigh(mobility)
    half = (vectors * np.sqrt(values.clip(0))[:, None, :]) @ vectors.transpose(0, 2, 1)
    squares, shapes = np.linalg.eigh((half * stiffness) @ half)
    omega = np.sqrt(squares.clip(0))
    rates = np.einsum("kij,kij->kj", shapes, half @ damping @ half @ shapes)  # 2 zeta omega [1/s]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = rates / (2 * omega)
    return Modes(omega / (2 * np.pi), ratios, _longest_delays(omega, rates))


def _longest_delays(omega: Array, rates: Array) -> Array:
    """Delay [s] at which s^2 + (rate s + omega^2) exp(-s T) = 0 gets a root i Omega.

    The modulus gives Omega^2 = rate^2/2 + sqrt(rate^4/4 + omega^4), the phase T = atan(rate Omega / omega^2) / Omega.
    """
    crossing = np.sqrt(rates**2 / 2 + np.sqrt(rates**4 / 4 + omega**4))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.arctan2(rates * crossing, omega**2) / crossing)


Coupling = Literal["coupled", "decoupled"]
COUPLINGS: tuple[Coupling, ...] = ("coupled", "decoupled")


@dataclass(frozen=True)
class DampingCheck:
    """Whether the damping matrix D is positive semi-definite over a domain."""

    samples: int
    smallest_eigenvalue: float  #: of D, divided by the largest eigenvalue at the same point
    indefinite_share: float  #: share of samples with a negative eigenvalue
    worst_point: tuple[float, ...]  #: [rad] or [m]


@dataclass(frozen=True, eq=False, repr=False)
class _OperationalSpace(Shown):
    """The common part of impedance control and PD+: settings, inertia and damping in the coordinates of a chart.

    Args:
        chart: a chart with a closed expression (not a grown one).
        stiffness: diagonal of K, > 0, (n,) or one number for all; [N/m] for positions, [J] for coordinates. With
            `damping_stiffness`, 0 is allowed.
        damping_ratio: diagonal of Z, >= 0, (n,) or one number.
        coupling: `coupled` uses the full M_phi = (J M^-1 J^T)^-1; `decoupled` adds one controller for the task and one
            for the extra coordinates, each with its own inertia, and relies on condition (5).
        damping: `double_diagonal` is always positive semi-definite; `square_root` is the paper's design (29), which is
            indefinite in parts of many domains if the stiffnesses are far apart.
        limit: largest torque of each joint, (n,) or one number [N m] or [N]; default the effort limits of the robot.
        damping_stiffness: damping is designed as if this were the stiffness, > 0, (n,) or one number. So a coordinate
            without a spring, K_i = 0, is free, but does not swing. Default: damping follows the stiffness.
        model: where the law gets the robot's model from, and its additional inputs. Default: the model of the problem.
        remembers: integral action against a wrong model: `MomentumObserver()` or `Adaptation()`. It needs the input
            `extra_torque`, which it adds to `model`, and ticks: a `control_rate` in simulations, the supervised law
            in C, `Remembering` in programs of your own. Default: none.

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
    model: RunTimeModel
    remembers: Remembers | None

    feed_forward: ClassVar[bool]
    name: ClassVar[str]
    force: ClassVar[str]  #: the formula, without torques that do not act through the coordinates
    command: ClassVar[Command] = "torque"
    options: ClassVar[Mapping[str, Setting]] = {
        "stiffness": STIFFNESS_SETTING,
        "delay": DELAY_SETTING,
        "damping_ratio": DAMPING_RATIO_SETTING,
        "coupling": Setting("coupled (default) or decoupled.", is_word=True),
        "damping": Setting("double_diagonal (default) or square_root.", is_word=True),
        "damping_stiffness": Setting("Design the damping for this stiffness, so that --stiffness may be 0 in places."),
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
            "none (default), momentum or adaptive: integral action against a wrong model; simulations need a rate.",
            is_word=True,
        ),
    }

    def __init__(
        self,
        chart: Chart,
        stiffness: ArrayLike,
        damping_ratio: ArrayLike = 0.7,
        coupling: Coupling = "coupled",
        damping: DampingDesign = "double_diagonal",
        limit: ArrayLike | None = None,
        damping_stiffness: ArrayLike | None = None,
        model: RunTimeModel | None = None,
        remembers: Remembers | None = None,
    ) -> None:
        require_known("coupling", coupling, COUPLINGS)
        require_known("damping", damping, DAMPING_DESIGNS)
        require_kind("chart", chart, Chart)
        require_driven(f"the law {self.name}", chart.problem.robot.tree)
        model = RunTimeModel() if model is None else model
        require_kind("model", model, RunTimeModel)
        if remembers is not None and not callable(getattr(remembers, "of", None)):
            raise InvalidValueError(
                "remembers", repr(remembers)[:80], "what makes a memory, such as MomentumObserver()"
            )
        if remembers is not None and model.extra_torque is None:
            model = replace(model, extra_torque=0.0)
        chart.function("xi")  # raises for grown charts
        n, as_stiffness = chart.n, damping_stiffness is None
        model.gains(chart.problem, self.feed_forward)  # raises for values of another size
        for name, value in {
            "chart": chart,
            "stiffness": (positive_gains if as_stiffness else non_negative_gains)("stiffness", stiffness, n),
            "damping_stiffness": _positive_or_none("damping_stiffness", damping_stiffness, n),
            "model": model,
            "damping_ratio": non_negative_gains("damping_ratio", damping_ratio, n),
            "coupling": coupling,
            "damping": damping,
            "limit": command_limit("limit", limit, chart.problem.robot.effort_limits),
            "remembers": remembers,
        }.items():
            object.__setattr__(self, name, value)
        if remembers is not None:
            _ = self.memory  # raises for bounds of another size
        doubts = [*_like_a_percentage(self.damping_ratio), *self._holding_doubts()]
        if coupling == "decoupled" and (metric := chart.problem.metric.name) != "inertia":
            doubts.append(f"a decoupled law relies on A = M (inertia), but the metric of this chart is {metric}")
        for doubt in doubts:
            warnings.warn(doubt, LawWarning, stacklevel=2)

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
        memory: Literal["none", "momentum", "adaptive"] = "none",
        delay: float = 0.0,
    ) -> Self:
        """Build the law on a chart.

        Args:
            chart: the chart.
            limit: largest torque of each joint.
            stiffness: default: `matched_stiffness`, modes around 6 Hz, or slower ones that bear the delay.
            damping_ratio: as for the law itself.
            coupling: as for the law itself.
            damping: as for the law itself.
            damping_stiffness: as for the law itself.
            model: the source of the `RunTimeModel`.
            gravity: its gravity.
            inputs: its inputs, such as "payload,wrench,extra_torque".
            memory: none, momentum for a `MomentumObserver`, or adaptive for an `Adaptation`.
            delay: from the measurement to the torque [s], for the default stiffness.

        Raises:
            ShapeError, InvalidValueError, UnknownNameError: as for the law itself, and for a delay beside a stiffness.
        """
        require_known("memory", memory, ("none", *MEMORIES))
        remembers = None if memory == "none" else MEMORIES[memory]()
        if stiffness is None:
            stiffness = matched_stiffness(chart, delay=delay, damping_ratio=damping_ratio)
        elif delay:
            raise InvalidValueError("delay", delay, "none with a given stiffness")
        run_time = RunTimeModel.with_inputs(model, gravity, inputs.split(",") if inputs else ())
        return cls(chart, stiffness, damping_ratio, coupling, damping, limit, damping_stiffness, run_time, remembers)

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
        return {"stiffness": STIFFNESS, "damping_ratio": DAMPING_RATIO, "limit": LIMIT, **design, **self.model.units}

    def remarks(self) -> list[str]:
        """Warnings.

        The motors cannot hold the arm, the metric does not decouple task and extra coordinates, a damping ratio looks
        like a percentage, a decoupled law has a chart that leaks much, or D is not positive semi-definite.
        """
        found, metric = [*self._holding_doubts()], self.problem.metric.name
        if metric != "inertia":
            found.append(
                f"the metric of this chart is {metric}, but task and extra coordinates are decoupled only for A = M "
                "(inertia)"
            )
        found += _like_a_percentage(self.damping_ratio)
        if self.coupling == "decoupled" and (leak := self._leak_deg()) > _MUCH_DEG:
            found.append(
                f"the gradients of this chart lean into the task by {leak:.0f} deg (rms): decoupled springs pull at "
                "both, which coupled ones do not; see docs/how-to/wide.md"
            )
        if share := self.check_damping().indefinite_share:
            where = f"in {percent(share, fault=True)} of the domain with these gains"
            found.append(f"the damping matrix (29) is indefinite {where}; the damping design double_diagonal never is")
        return found + self.model.remarks()

    def _holding_doubts(self) -> list[str]:
        """Of an arm that the motors cannot hold; none if the robot compensates gravity itself."""
        if self.model.gravity == "robot":
            return []
        return holding_doubts(self.model.robot(self.problem), self.problem.domain, self.limit)

    def _leak_deg(self) -> float:
        """Root mean square of the chart's leaks at samples [deg]."""
        points = sample_uniform(self.problem.domain, _MODE_SAMPLES, 0)
        sines = Judged.at(self.problem, self.chart.coordinates, points).leak_sines
        return float(np.degrees(np.sqrt(np.mean(np.arcsin(np.clip(sines, 0.0, 1.0)) ** 2))))

    @property
    def problem(self) -> Problem:
        """Robot, task, metric and domain of the chart."""
        return self.chart.problem

    def facts(self) -> dict[str, str]:
        """Quantities, gains, design and problem."""
        return law_facts(self)

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then xi1, xi2, ..."""
        return self.chart.labels

    @property
    def gains(self) -> dict[str, Array]:
        """Stiffness, damping ratio and limit, then the inputs that were asked for."""
        design = {} if self.damping_stiffness is None else {"damping_stiffness": self.damping_stiffness}
        inputs = self.model.gains(self.problem, self.feed_forward)
        return {
            "stiffness": self.stiffness,
            "damping_ratio": self.damping_ratio,
            "limit": self.limit,
            **design,
            **inputs,
        }

    @property
    def measured(self) -> ca.Function:
        """Phi(q)."""
        return self.chart.function("phi")

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (n, 1), gains -> command (n, 1), status (1, 1)."""
        return self.chart.runnable(count_turns_from_centre(self.graph, self.problem))

    @cached_property
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""
        inputs = named_inputs(self.chart.n, self.gains, self.chart.n)
        robot = self.problem.robot
        gravity = self.model.gravity_torque(robot, inputs)
        force, volume, J = self._force(inputs)
        torque = J.T @ force + gravity + self.model.feed_forward(robot, inputs)
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
        return self.chart.runnable(count_turns_from_centre(self.energy_graph, self.problem))

    @cached_property
    def energy_graph(self) -> ca.Function:
        """V = 1/2 de^T M_phi de + 1/2 e^T K e [J] and P = de^T D de [W], e = phi - phi_d.

        Impedance control uses the velocity J dq instead of de, so V is the kinetic energy plus that of the springs.
        M_phi is the full inertia even for decoupled controllers, because the robot's energy is not block diagonal. M is
        that of the problem's robot with the payload, also if the law is given another one.
        """
        inputs = named_inputs(self.chart.n, self.gains, self.chart.n)
        K = ca.diag(inputs["stiffness"])
        M = self.model.own_mass_matrix(self.problem.robot, inputs)
        e, de, J = self._errors(inputs)
        damping_force = self._damped(self._inertia(J, M)[1], inputs, de)
        M_phi = block_inertia(self.chart.n, (self.chart.n,))(J, M)[1]
        kinetic = ca.bilin(M_phi, de, de) if self.feed_forward else ca.bilin(M, inputs["dq"], inputs["dq"])
        storage = (kinetic + ca.bilin(K, e, e)) / 2
        outputs = {"storage": storage, "dissipated_power": ca.dot(de, damping_force)}
        return named_function("energy", inputs, outputs)

    @cached_property
    def damping_matrix(self) -> ca.Function:
        """q, stiffness, damping_ratio, then damping_stiffness and payload if they are inputs -> D(q), (n, n)."""
        inputs = named_inputs(self.chart.n, self.gains, self.chart.n)
        chosen = {name: inputs[name] for name in ("q", *self._of_the_damping)}
        J, M = self.chart.rates(inputs["q"]), self.model.own_mass_matrix(self.problem.robot, inputs)
        D = self._damped(self._inertia(J, M)[1], inputs, ca.MX.eye(self.chart.n))
        return self.chart.runnable(named_function("damping_matrix", chosen, {"D": D}))

    def check_damping(self, samples: int = 1000, seed: int = 0) -> DampingCheck:
        """Find the smallest eigenvalue of D over uniform samples of the domain; (29) can make it negative."""
        points = sample_uniform(self.problem.domain, samples, seed)
        values = np.linalg.eigvalsh(self._damping_at(points))
        ratio = values[:, 0] / np.abs(values).max(axis=1).clip(np.finfo(float).tiny)
        worst = int(np.argmin(ratio))
        return DampingCheck(samples, float(ratio[worst]), float((ratio < -1e-12).mean()), tuple(points[worst].tolist()))

    def modes(self, q: ArrayLike | None = None) -> Modes:
        """Modes of the closed loop M_phi dde + D de + K e = 0 at rest, without disturbances.

        Args:
            q: one posture (n,) or several (N, n); default: 256 uniform samples of the domain, and last the posture
                of the fastest mode, which descents find (`least_in_domain`).

        Raises:
            ShapeError, InvalidValueError: if q has another shape, or is not finite.
        """
        points, single = as_point_set("q", self._mode_points() if q is None else q, self.chart.n)
        W = mobility(self.chart, points, self.model.robot(self.problem))
        found = modes_of(W, self.stiffness, self._damping_at(points))
        return Modes(*(values[0] for values in vars(found).values())) if single else found

    def _mode_points(self) -> Array:
        """Samples of the domain, and the posture with the fastest mode that a search finds, (N, n)."""
        fastest = fastest_posture(self.chart, self.stiffness, self.model.robot(self.problem))
        return np.vstack([sample_uniform(self.problem.domain, _MODE_SAMPLES, 0), fastest])

    def _damping_at(self, points: Array) -> Array:
        """D(q) with the law's gains at points (N, n), (N, n, n)."""
        rows = [np.tile(self.gains[name], (len(points), 1)) for name in self._of_the_damping]
        return Batched(self.damping_matrix)(points, *rows)[0].reshape(-1, self.chart.n, self.chart.n)

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the motion from q_start along the reference leaves the chart's domain."""
        joint_path(self.chart, reference, q_start)

    @property
    def _of_the_damping(self) -> tuple[str, ...]:
        """The inputs that the damping depends on."""
        return tuple(n for n in ("stiffness", "damping_ratio", "damping_stiffness", "payload") if n in self.gains)

    @property
    def _blocks(self) -> tuple[int, ...]:
        return (self.chart.n,) if self.coupling == "coupled" else (self.chart.m, self.chart.r)

    def _inertia(self, J: ca.MX, M: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """B = M^-1 J^T, the inertia Lambda in blocks, and its volume."""
        B, Lambda, volume = block_inertia(self.chart.n, self._blocks)(J, M)
        return B, Lambda, volume

    def _damped(self, Lambda: ca.MX, inputs: dict[str, ca.MX], velocities: ca.MX) -> ca.MX:
        """D V, with the same blocks, for V (n, c)."""
        designed_for = inputs.get("damping_stiffness", inputs["stiffness"])
        function = _block_damping(self.damping, self._blocks, velocities.shape[1])
        return function(Lambda, designed_for, inputs["damping_ratio"], velocities)

    def _errors(self, inputs: dict[str, ca.MX]) -> tuple[ca.MX, ca.MX, ca.MX]:
        """The error e, how fast it changes, and J = de/dq."""
        e, J = errors(self.chart, inputs["q"], inputs["reference"])
        velocity = J @ inputs["dq"]
        return e, velocity - self._drift(inputs) if self.feed_forward else velocity, J

    def _drift(self, inputs: dict[str, ca.MX]) -> ca.MX:
        return drift(self.chart, inputs["q"], inputs["reference"], inputs["reference_velocity"])

    def _force(self, inputs: dict[str, ca.MX]) -> tuple[ca.MX, ca.MX, ca.MX]:
        """Force in the coordinates, (n, 1), the volume of the gradients, and J."""
        q, dq, robot, model = inputs["q"], inputs["dq"], self.problem.robot, self.model
        e, de, J = self._errors(inputs)
        B, Lambda, volume = self._inertia(J, model.mass_matrix(robot, inputs))
        force = -inputs["stiffness"] * e - self._damped(Lambda, inputs, de)
        if self.feed_forward:
            w = B @ (Lambda @ self._drift(inputs))  # J^-1 d_phi_d; if (5) holds, by (8) also when decoupled
            wanted = inputs["reference"], inputs["reference_velocity"], inputs["reference_acceleration"]
            bent = bend(self.chart, q, dq, dq if model.source == "given" else w, wanted)
            force += Lambda @ (B.T @ model.coriolis_torque(robot, inputs, w) - bent)
        return force, volume, J

    @cached_property
    def median_volume(self) -> float:
        """Of the gradients over the domain, squared; in blocks if the law is decoupled."""
        return median_volume(self.problem, self.chart.rates, "inertia", self._blocks)


def _like_a_percentage(damping_ratio: Array) -> list[str]:
    """A remark on damping ratios that are far above 1."""
    largest = float(damping_ratio.max())
    if largest <= _LARGE_RATIO:
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


def _positive_or_none(name: str, value: ArrayLike | None, length: int) -> Array | None:
    return None if value is None else positive_gains(name, value, length)


def _block_damping(design: DampingDesign, blocks: tuple[int, ...], columns: int) -> ca.Function:
    """Lambda (block diagonal), stiffness, damping_ratio, V (n, columns) -> D V; D has the same blocks."""
    n = sum(blocks)
    Lambda, K, Z, V = (ca.MX.sym(*of) for of in (("Lambda", n, n), ("K", n), ("Z", n), ("V", n, columns)))
    places = [place.tolist() for place in np.split(np.arange(n), np.cumsum(blocks)[:-1])]
    parts = [damped(design, Lambda[p, p], K[p], Z[p], V[p, :]) for p in places]
    return ca.Function("damping", [Lambda, K, Z, V], [ca.densify(ca.vertcat(*parts))])
