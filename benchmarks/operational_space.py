"""Laws in xi against the textbook's operational space controller, in MuJoCo at 1 kHz: four tables (15 min).

The arm is the 7-DoF arm with cubic coordinates, A = M and default gains; `--robot panda` takes another one. Circles and
steps of 0.1 m need A = I: with A = M, the light wrist would turn beyond its part of the box. The peer has 6 Hz and the
damping ratio 0.7 in all directions of task and posture. The laws in xi have modes around 6 Hz and the same damping
ratio. All laws hold the same postures: those of the peer come from the chart's inverse map.
"""

import argparse
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from default_gains import problem_of, starts_of
from textbook_law import TextbookLaw

import orthocas as oc
from orthocas.checks import Array
from orthocas.codegen import Supervisor
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.control import ControlStatus, Impedance, PDPlus, Reference, Safety, posture_reference
from orthocas.control.matched_stiffness import SPRING_FREQUENCY
from orthocas.control.status import FROM_THE_LAW
from orthocas.errors import SimulationError, UnreachableReferenceError
from orthocas.simulation import Friction, MuJoCoPlant

WEIGHTS = (1000, 30, 150, 1, 1000)
TICK = 1e-3  # [s]
REST = 0.2  # at the start of every motion [s]
STEP, MOTION = 0.04, 0.4  # of steps in x [m]; joint motion of steps in xi [rad]
ROOM = 0.9  # share of the box for the reference: laws without feed-forward leave it by a little
PUSH = 20.0  # [N]
RADIUS, PERIOD = 0.1, 2.0  # of the circle [m], [s]
BITS, CUTOFF = 14, 100.0  # of the encoders; of the low pass behind the differences [Hz]
COULOMB = (1.0, 1.0, 1.0, 1.0, 0.3, 0.3, 0.3)  # [N m]
INTEGRAL = 3.0  # rate of the integral action [1/s]
KNOWN, SLOW = 0.8, 0.02  # share of the friction that a law compensates; speed at which half of that is reached [rad/s]
GIVEN_UP = 100  # ticks without the law, after which a run ends


@dataclass(frozen=True)
class Motion:
    """What is wanted at every tick."""

    phi: Array  #: (N, 3, n), with two derivatives
    posture: Array  #: (N, 2, n), with one derivative

    def at_end(self) -> "Motion":
        """The last tick alone."""
        return Motion(self.phi[-1:], self.posture[-1:])


@dataclass(frozen=True)
class Law:
    """A law by its name in the tables."""

    name: str
    command: Callable[[Array, Array, Motion, int], tuple[Array, int]]
    hidden: Callable[[Array, Motion], float]  #: energy at the end in springs that the task does not feel [J]


@dataclass(frozen=True)
class Loop:
    """What lies between law and arm, and a force at the flange."""

    delay: int = 0  #: ticks from measurement to torque
    every: int = 1  #: ticks between commands
    encoders: bool = False
    coulomb: float = 0.0  #: friction, as a share of COULOMB
    push: tuple[float, ...] = (0.0, 0.0, 0.0)  #: [N]
    stops: bool = True  #: of the joints


IDEAL = Loop()
Moves = list[list[tuple[Array, Motion]]]


@dataclass(frozen=True)
class Run:
    """What happened."""

    q: Array  #: (N, n), after each tick
    noise: Array  #: (N, n), command minus the command at the true state [N m]
    status: str  #: "" if all is well


class Encoders:
    """Joint positions in counts of a turn, velocities by filtered differences."""

    def __init__(self, q: Array, period: float) -> None:
        self.count, self.period = 2 * np.pi / 2**BITS, period
        self.keep = np.exp(-2 * np.pi * CUTOFF * period)
        self.q, self.dq = self._rounded(q), np.zeros_like(q)

    def measure(self, q: Array) -> tuple[Array, Array]:
        """Measured q and dq."""
        rounded = self._rounded(q)
        self.dq = self.keep * self.dq + (1 - self.keep) * (rounded - self.q) / self.period
        self.q = rounded
        return self.q, self.dq

    def _rounded(self, q: Array) -> Array:
        return np.asarray(self.count * np.round(q / self.count))


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
            laws.append(textbook(name, TextbookLaw(library, chart.m, SPRING_FREQUENCY, 0.7, posture)))
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
    rates = np.repeat([INTEGRAL, 0.0], [law.chart.m, law.chart.r])
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


def followed(law: Law, robot: oc.Robot, q: Array, motion: Motion, loop: Loop = IDEAL) -> Run:
    """Run a law on the arm in MuJoCo, from rest at q."""
    plant = MuJoCoPlant(robot, friction=Friction(coulomb=loop.coulomb * np.array(COULOMB)), stops=loop.stops)
    plant.reset(q)
    plant.push(loop.push)
    encoders = Encoders(q, TICK * loop.every)
    late = deque([robot.gravity(q)] * loop.delay)
    path, noise, lost, command = [], [], 0, late[0] if late else np.zeros_like(q)
    for k in range(len(motion.phi)):
        if k % loop.every == 0:
            state = encoders.measure(plant.q) if loop.encoders else (plant.q, plant.dq)
            command, status = law.command(*state, motion, k)
            lost += status not in FROM_THE_LAW
            noise.append(command - law.command(plant.q, plant.dq, motion, k)[0] if loop.encoders else 0 * q)
        late.append(command)
        try:
            plant.step(late.popleft(), TICK)
        except SimulationError:
            lost = GIVEN_UP + 1
        path.append(plant.q)
        if lost > GIVEN_UP:
            return Run(np.array(path), np.array(noise), "left the domain")
    swinging = np.ptp(path[-300:], axis=0).max() > 0.02  # [rad], in the last 0.3 s, where the reference is at rest
    return Run(np.array(path), np.array(noise), "swings" if swinging else "")


def motion_of(chart: oc.Chart, q: Array, changes: list[tuple[float, dict[str, float]]], duration: float) -> Motion:
    """Steps through the low pass of the paper; raises UnreachableReferenceError if they leave the domain."""
    reference = Reference.steps(chart.labels, chart.phi(q), changes, duration)
    times = np.arange(0, duration, TICK)
    posture = posture_reference(chart, reference, q)
    joints = np.stack(posture.sample(times)[:2], axis=1)[:, :, chart.m :]
    return Motion(np.stack(reference.sample(times), axis=1), joints)


def step_of(chart: oc.Chart, q: Array, label: str, size: float | None = None) -> Motion:
    """A step in one quantity, of a size or one that moves a joint by MOTION; smaller where the domain asks for it."""
    i, domain = chart.labels.index(label), chart.problem.domain
    size = MOTION / np.abs(np.linalg.inv(chart.jacobian(q))[:, i]).max() if size is None else size
    for share in (1.0, -1.0, 0.7, -0.7, 0.5, -0.5, 0.35, -0.35, 0.25, -0.25, 0.15, -0.15):
        with suppress(UnreachableReferenceError):
            motion = motion_of(chart, q, [(REST, {label: chart.phi(q)[i] + share * size})], REST + 2.0)
            if (np.abs(motion.posture[:, 0] - domain.centre) < ROOM * domain.half_width).all():
                return motion
    raise UnreachableReferenceError(f"no step in {label} stays within the domain")


def held(chart: oc.Chart, q: Array, duration: float) -> Motion:
    """Hold still."""
    ticks = round(duration / TICK)
    rest = np.zeros_like(q)
    return Motion(np.tile([chart.phi(q), rest, rest], (ticks, 1, 1)), np.tile([q, rest], (ticks, 1, 1)))


def circles(chart: oc.Chart, q: Array, count: int) -> Motion:
    """The flange follows a horizontal circle, from rest to rest in every cycle; xi, or the posture, stays constant."""
    still = held(chart, q, count * PERIOD + 1.0)
    moving = round(count * PERIOD / TICK)
    s = TICK * np.arange(moving) / PERIOD % 1
    angle = 2 * np.pi * s**3 * (10 - 15 * s + 6 * s**2)
    rate, bend = 60 * np.pi * (s * (1 - s)) ** 2, 120 * np.pi * s * (1 - s) * (1 - 2 * s)
    rate, bend = rate / PERIOD, bend / PERIOD**2
    towards, along = (
        np.stack(pair, axis=1) for pair in ((np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle)))
    )
    still.phi[:moving, 0, :2] += RADIUS * (towards - [1, 0])
    still.phi[:moving, 1, :2] = RADIUS * along * rate[:, None]
    still.phi[:moving, 2, :2] = RADIUS * (along * bend[:, None] - towards * rate[:, None] ** 2)
    return still


def flange_error(chart: oc.Chart, run: Run, motion: Motion) -> float:
    """Largest distance of the flange from its reference [mm]."""
    wanted = motion.phi[: len(run.q), 0, : chart.m]
    return float(1e3 * np.linalg.norm(chart.task(run.q) - wanted, axis=1).max())


def elbow_motion(chart: oc.Chart, run: Run) -> float:
    """Largest motion of a joint's origin [mm]."""
    points = chart.problem.robot.joint_points(run.q)
    return float(1e3 * np.linalg.norm(points - points[0], axis=2).max())


def pushed(law: Law, chart: oc.Chart, starts: Array) -> Array:
    """Motions of the flange along and across pushes, and across at rest, (starts, axes, 3) [mm]; NaN if it left."""
    found = np.full((len(starts), 3, 3), np.nan)
    for q, row in zip(starts, found, strict=True):
        for axis, push in enumerate(PUSH * np.eye(3)):
            run = followed(law, chart.problem.robot, q, held(chart, q, 2.0), Loop(push=tuple(push)))
            moved = 1e3 * (chart.task(run.q) - chart.task(q))
            across = np.linalg.norm(np.delete(moved, axis, axis=1), axis=1)
            if not run.status:
                row[axis] = np.abs(moved[:, axis]).max(), across.max(), across[-1]
    return found


def hidden_energy(law: Law, chart: oc.Chart, starts: Array) -> float:
    """Largest energy at rest after steps of 0.1 m in x, while xi or the posture stays where it was [J]."""
    found = []
    for q in starts:
        for label in chart.labels[: chart.m]:
            motion = step_of(chart, q, label, RADIUS)
            motion.posture[:] = [q, 0 * q]
            run = followed(law, chart.problem.robot, q, motion)
            found.append(law.hidden(run.q[-1], motion))
    return max(found)


def contradicted(law: Law, chart: oc.Chart, starts: Array) -> tuple[float, int]:
    """The same at the first start, when each of the others becomes the posture, or its xi; and how many runs left."""
    found, q = [], starts[0]
    for other in starts[1:]:
        motion = held(chart, q, 3.0)
        share = np.minimum(1, TICK * np.arange(len(motion.phi)))[:, None]
        motion.posture[:, 0] += share * (other - q)
        motion.phi[:, 0, chart.m :] += share * (chart.phi(other) - chart.phi(q))[chart.m :]
        run = followed(law, chart.problem.robot, q, motion)
        found += [] if run.status else [law.hidden(run.q[-1], motion)]
    return max(found, default=np.nan), len(starts) - 1 - len(found)


def against_textbook(chart: oc.Chart, laws: list[Law], starts: Array) -> list[str]:
    """The first table: what a law does to the flange. Pushes count if no law leaves the domain."""
    robot, xis = chart.problem.robot, chart.labels[chart.m :]
    rows = [
        "| | flange while xi moves | elbow | push: along | across | across at rest | left | noise |",
        "|" + " --- |" * 8,
    ]
    moves = [(q, step_of(chart, q, xi)) for q in starts for xi in xis]
    pushes = np.array([pushed(law, chart, starts) for law in laws])
    stayed = np.isfinite(pushes).all(axis=(0, 3))
    for law, push in zip(laws, pushes, strict=True):
        runs = [(motion, followed(law, robot, q, motion)) for q, motion in moves]
        noise = [followed(law, robot, q, motion, Loop(encoders=True)).noise for q, motion in moves[: len(xis)]]
        words = [
            f"{max(flange_error(chart, run, motion) for motion, run in runs):.3f} mm",
            f"{max(elbow_motion(chart, run) for _, run in runs):.0f} mm",
            *(f"{value:.1f} mm" for value in push[stayed].max(axis=0)),
            f"{np.isnan(push[..., 0]).sum()} of {stayed.size}",
            f"{np.sqrt(np.mean(np.square(noise))):.2f} N m",
        ]
        rows.append(f"| {law.name} | {' | '.join(words)} |")
    print("\n".join(rows), flush=True)
    return rows


def returning(chart: oc.Chart, laws: list[Law], starts: Array, cycles: int) -> list[str]:
    """The third table: drift after circles without stops, and energy in springs that the task does not feel."""
    rows = ["| | drift | largest flange error | hidden energy: steps | other posture |", "|" + " --- |" * 5]
    motion = circles(chart, starts[0], cycles)
    for law in laws:
        run = followed(law, chart.problem.robot, starts[0], motion, Loop(stops=False))
        drift = run.status or f"{np.linalg.norm(run.q[-1] - starts[0]):.1e} rad"
        energy, left = contradicted(law, chart, starts)
        words = [
            f"{drift}",
            f"{flange_error(chart, run, motion):.2f} mm",
            f"{hidden_energy(law, chart, starts):.2g} J",
            f"{energy:.2g} J{f', {left} left' if left else ''}",
        ]
        rows.append(f"| {law.name} | {' | '.join(words)} |")
        print("\n".join(rows[-1:] if law is not laws[0] else rows), flush=True)
    return rows


LOOPS = {
    "1 kHz": IDEAL,
    "delay 1 ms": Loop(delay=1),
    "delay 2 ms": Loop(delay=2),
    "delay 5 ms": Loop(delay=5),
    "200 Hz": Loop(every=5),
    "100 Hz": Loop(every=10),
    "14-bit encoders": Loop(encoders=True),
    "Coulomb friction": Loop(coulomb=1.0),
    "all: 200 Hz, 2 ms, encoders, friction": Loop(delay=2, every=5, encoders=True, coulomb=1.0),
}


def imperfect(chart: oc.Chart, laws: list[Law], starts: Array, loops: dict[str, Loop]) -> list[str]:
    """The second table: largest errors of the flange while x moves and while xi moves, and how many runs went wrong."""
    rows = [f"| | {' | '.join(law.name for law in laws)} |", "| --- |" + " --- |" * len(laws)]
    groups = ((chart.labels[: chart.m], STEP), (chart.labels[chart.m :], None))
    moves = [[(q, step_of(chart, q, label, size)) for q in starts for label in labels] for labels, size in groups]
    for name, loop in loops.items():
        words = [name, *(outcome(law, chart, moves, loop) for law in laws)]
        rows.append(f"| {' | '.join(words)} |")
        print("\n".join(rows[-1:] if len(rows) > 3 else rows), flush=True)
    return rows


def against_friction(chart: oc.Chart, laws: list[Law], starts: Array) -> list[str]:
    """The fourth table: what integral action and compensation do against Coulomb friction."""
    rows = ["| Coulomb friction | x moves: largest, at the end | xi moves |", "| --- | --- | --- |"]
    groups = ((chart.labels[: chart.m], STEP), (chart.labels[chart.m :], None))
    moves = [[(q, step_of(chart, q, label, size)) for q in starts for label in labels] for labels, size in groups]
    for law in laws:
        words = []
        for part in moves:
            runs = [(motion, followed(law, chart.problem.robot, q, motion, Loop(coulomb=1.0))) for q, motion in part]
            ends = [flange_error(chart, replace(run, q=run.q[-1:]), motion.at_end()) for motion, run in runs]
            words.append(f"{max(flange_error(chart, run, motion) for motion, run in runs):.2f}, {max(ends):.2f}")
            words[-1] += ", left" * any(run.status for _, run in runs)
        rows.append(f"| {law.name} | {' | '.join(words)} |")
        print("\n".join(rows[-1:] if len(rows) > 3 else rows), flush=True)
    return rows


def outcome(law: Law, chart: oc.Chart, moves: Moves, loop: Loop) -> str:
    """Errors of the flange, and what went wrong how often."""
    errors, bad = [], []
    for part in moves:
        runs = [(motion, followed(law, chart.problem.robot, q, motion, loop)) for q, motion in part]
        good = [flange_error(chart, run, motion) for motion, run in runs if not run.status]
        errors.append(max(good, default=np.nan))
        bad += [run.status for _, run in runs if run.status]
    told = "".join(f", {bad.count(why)} {why}" for why in sorted(set(bad)))
    return f"{errors[0]:.2f}, {errors[1]:.2f}{told}"


def main(quick: bool = False, robot: str = "iiwa") -> list[str]:
    """Print the tables; `quick` takes two starts, three circles and two loops."""
    rows, loops = [], dict(list(LOOPS.items())[:2]) if quick else LOOPS
    for metric in ("inertia", "euclidean"):
        chart = oc.fit(problem_of(robot, "position", metric), oc.Polynomial(3), weights=WEIGHTS).chart
        starts = starts_of(chart.problem, 2 if quick else 5)
        with laws_on(chart) as laws:
            if metric == "inertia":
                rows += against_textbook(chart, laws[:4], starts)
                rows += imperfect(chart, laws[:4], starts[:3], loops)
                rows += against_friction(chart, [laws[0], *laws[5:], laws[3]], starts[:1] if quick else starts[:3])
            else:
                rows += returning(chart, laws[:5], starts, 3 if quick else 50)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--robot", default="iiwa", choices=("iiwa", "panda", "xarm7"))
    arguments = parser.parse_args()
    main(arguments.quick, arguments.robot)
