"""The laws that `operational_space.py` compares: ours in compiled C, and the textbook's."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from reference_motions import TICK, Motion
from textbook_law import TextbookLaw

import orthocas as oc
from orthocas.codegen import Supervisor
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.control import ControlStatus, Impedance, PDPlus, Safety
from orthocas.control.gains import RULES
from orthocas.tools.checks import Array

COULOMB = (1.0, 1.0, 1.0, 1.0, 0.3, 0.3, 0.3)  # friction [N m]
INTEGRAL = 3.0  # rate of the integral action [1/s]
KNOWN, SLOW = 0.8, 0.02  # share of the friction that a law compensates; speed at which half of that is reached [rad/s]


@dataclass(frozen=True)
class Law:
    """A law by its name in the tables."""

    name: str
    command: Callable[[Array, Array, Motion, int], tuple[Array, int]]
    hidden: Callable[[Array, Motion], float]  #: energy at the end in springs that the task does not feel [J]


@contextmanager
def laws_on(chart: oc.Chart) -> Iterator[list[Law]]:
    """The laws of the tables, compiled: four for all, a textbook law without posture for circles, two for friction."""
    ours: dict[str, PDPlus | Impedance] = {
        "PD+ coupled": PDPlus.on_chart(chart),
        "PD+ decoupled": PDPlus.on_chart(chart, coupling="decoupled"),
        "impedance": Impedance.on_chart(chart),
    }
    with TemporaryDirectory() as folder:
        laws = []
        for i, (name, law) in enumerate(ours.items()):
            generated = oc.generate_c(chart, Path(folder) / str(i), law, f"law{i}")
            library = CompiledLibrary(compile_shared(generated, generated.folder), generated.name, chart.n)
            laws.append(in_coordinates(name, law, library))
        for name, posture in (("textbook", True), ("textbook, posture only damped", False)):
            laws.append(textbook(name, TextbookLaw(library, chart.m, RULES.frequency, 0.7, posture)))
        law = PDPlus.on_chart(chart, inputs="extra_torque")
        generated = oc.generate_c(chart, Path(folder) / "friction", law, "friction")
        library = CompiledLibrary(compile_shared(generated, generated.folder), "friction", chart.n)
        laws.append(integrating("PD+ coupled with integral action on x", law, library))
        laws.append(compensating("PD+ coupled with 80 % of the friction compensated", law, library))
        yield laws


def in_coordinates(name: str, law: PDPlus | Impedance, library: CompiledLibrary) -> Law:
    """One of our laws."""
    gains, m = gain_numbers(law), law.chart.m

    def command(q: Array, dq: Array, motion: Motion, k: int) -> tuple[Array, int]:
        return library.control(q, dq, motion.phi[k], gains)

    def hidden(q: Array, motion: Motion) -> float:
        e = law.chart.phi(q) - motion.phi[-1, 0]
        return float(law.stiffness[m:] @ e[m:] ** 2 / 2)

    return Law(name, command, hidden)


def integrating(name: str, law: PDPlus, library: CompiledLibrary) -> Law:
    """A supervised law with integral action on x. On xi as well, joints that stick would break loose one by one."""
    rates = np.repeat([min(INTEGRAL, law.integral_bound), 0.0], [law.chart.m, law.chart.r])
    supervisor = Supervisor(library, law, Safety.of(law, integral_rate=rates))

    def command(q: Array, dq: Array, motion: Motion, k: int) -> tuple[Array, int]:
        if k == 0:
            supervisor.start(q)
        return supervisor.step(q, dq, motion.phi[k].ravel(), TICK)

    return Law(name, command, lambda q, motion: np.nan)


def compensating(name: str, law: PDPlus, library: CompiledLibrary) -> Law:
    """A law whose extra torque is most of the friction of the wanted motion."""
    gains, n = gain_numbers(law), law.problem.n

    def command(q: Array, dq: Array, motion: Motion, k: int) -> tuple[Array, int]:
        gains[-n:] = KNOWN * np.array(COULOMB) * np.tanh(motion.posture[k, 1] / SLOW)
        return library.control(q, dq, motion.phi[k], gains)

    return Law(name, command, lambda q, motion: np.nan)


def textbook(name: str, law: TextbookLaw) -> Law:
    """The peer."""

    def command(q: Array, dq: Array, motion: Motion, k: int) -> tuple[Array, int]:
        return law.command(q, dq, motion.phi[k, :, : law.m], motion.posture[k]), ControlStatus.OK

    return Law(name, command, lambda q, motion: law.spring_energy(q, motion.posture[-1, 0]))
