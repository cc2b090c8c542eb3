"""What goes wrong around the supervised law, in MuJoCo: sensors, blows, references, delays, brakes (10 min).

PD+ coupled of ready charts with default gains and settings, in C at 1 kHz, on arms without rotor inertia. Each case
runs 5 times, from random postures in the inner half of the domain:

- Sensors stand still: those of an arm that moves (its joints follow sines that begin at 0.2 rad/s), of one on its way
  back, of one at rest whose reference then moves at 2 cm/s, and of one with masses 20 % off and integral action. The
  fastest joint within 200 ms counts. Then those of a single joint of an arm that moves, and all speeds, which stay at
  0.
- Blows: the last joint turns at 32 to 60 times its limit.
- References: targets of 1e6, jumps to random postures, 5 a second along all quantities, such velocities without a
  motion, and streams at 50 Hz of random postures and of targets around 1e6, one in ten NaN. The fastest joint counts,
  in its limits.
- Delays of 0, 1, 3 and 5 ms from the measurement to the torque: the catcher holds arms anywhere in the joint range (at
  most half a turn) that move at up to 0.5 rad/s.
- Brakes hold for 2 s while the reference goes on.

All of this once with true positions and velocities, and once with encoders of 13 bits a turn, their differences as
velocities, and the observer of the supervised law; sliding joints turn them once in 5 cm. The second table is an arm
whose joints follow such sines, from rest and within the domain, with encoders of 12 to 14 bits, without and with the
observer, for 1.5 s; the same with masses 20 % off and torques 5 ms late, and with a force of 50 N at the tip for 0.1 s.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from benchmark import run, table
from numpy.typing import ArrayLike

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus, Safety
from orthocas.simulation import Friction, MuJoCoPlant
from orthocas.tools.checks import Array

ARMS = ("iiwa7-position", "panda-position", "xarm7-position", "tiago-pro-left-position", "panda-pose")
RUNS, TICK, SETTLED = 5, 1e-3, 400
LOOK = 0.2  # after sensors stand still [s]
REST = 0.05  # [rad/s]
HEAVIER = 1.2  # masses of an arm that the model does not know
OBSERVED = 12, 13, 14  # bits of encoders
TRAVEL = 0.05  # of a sliding joint in a turn of its encoder [m]
PUSH = 50.0, 500, 600  # [N], from and to a tick
HEADER = (
    "| chart | sensors stand still [rad/s] | of one joint; speeds [rad/s] "
    "| blow, at once and 1.5 s later [rad/s] | references [speed limit] "
    "| caught with 0 to 5 ms: at rest after, back | brakes open [rad/s] |\n| --- | --- | --- | --- | --- | --- | --- |"
)
OBSERVED_HEADER = (
    "| chart | bits | torque at its rate limit [% of ticks] | change a tick, rms [N m] | flange off [mm] "
    "| +20 %, 5 ms late: flange off [mm] | push: speed off 0.9 s later [rad/s] | caught, of 5 |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)


@dataclass
class Arm:
    """A chart, its law in C, and random numbers."""

    chart: oc.Chart
    law: PDPlus
    library: CompiledLibrary
    safety: Safety
    rng: np.random.Generator
    bits: int = 0  #: of the encoders, a turn; 0: no rounding
    before: Array | None = None  #: what they measured last
    friction: Friction | None = None  #: of the joints, beside what the settings take for possible

    @property
    def robot(self) -> oc.Robot:
        """The robot of the chart."""
        return self.chart.problem.robot

    @property
    def limits(self) -> Array:
        """Of speed, (n,)."""
        return self.safety.speed_limit

    def posture(self, share: float = 0.5) -> Array:
        """Within a share of the domain, and of 1.5 rad around its centre, where motors hold 20 % more, (n,)."""
        domain, robot = self.chart.problem.domain, self.robot
        while True:
            q = domain.centre + share * np.minimum(domain.half_width, 1.5) * self.rng.uniform(-1, 1, self.chart.n)
            if domain.contains(q) and (HEAVIER * np.abs(robot.gravity(q)) <= robot.effort_limits).all():
                return q

    def resting(self, q: Array) -> Array:
        """The reference at rest at q (n,), (3 n,)."""
        return np.concatenate([self.chart.phi(q), np.zeros(2 * self.chart.n)])

    def started(self, q: Array, robot: oc.Robot | None = None, **settings: Any) -> tuple[Supervisor, MuJoCoPlant]:
        """The law and its arm at rest at q (n,)."""
        supervisor = Supervisor(self.library, self.law, replace(self.safety, **settings))
        plant = MuJoCoPlant(robot := self.robot if robot is None else robot, friction=self.friction)
        plant.reset(q)
        # With the torque that holds it, as programs start: a lift with unknown loads sinks faster than its limit.
        supervisor.start(q, robot.gravity(q))
        self.before = None
        return supervisor, plant

    def with_encoders(self, bits: int, observed: bool = True) -> "Arm":
        """The same arm with encoders, and the observer for their step, or none."""
        arm = replace(self, rng=np.random.default_rng(7), bits=bits)
        return replace(arm, safety=Safety.of(self.law, encoder_step=arm.count)) if observed else arm

    @property
    def count(self) -> Array:
        """What the encoders count in, (n,) [rad] or [m]."""
        return np.where(self.robot.tree.prismatic, TRAVEL, 2 * np.pi) / 2**self.bits

    def seen(self, plant: MuJoCoPlant) -> tuple[Array, Array]:
        """Measured positions and velocities (n,), the differences of what encoders count."""
        if self.bits == 0:
            return plant.q, plant.dq
        q = self.count * np.round(plant.q / self.count)
        dq = 0 * q if self.before is None else (q - self.before) / TICK
        self.before = q
        return q, dq


def main(quick: bool = False) -> dict[str, int]:
    """Print the tables; return the number of runs."""
    arms, runs = (ARMS[:1], 1) if quick else (ARMS, RUNS)
    faults = table(HEADER, rows(arms, runs))
    observed = table(OBSERVED_HEADER, observed_rows(arms, runs))
    each = len(STANDING) + len(FREEZING) + 1 + len(ASKED) + len(DELAYS) + 1
    found = {"faults": runs * each * len(faults), "observed": 4 * runs * len(observed)}
    found["runs"] = sum(found.values())
    print(found)
    return found


@contextmanager
def arm_of(name: str, memory: Literal["none", "friction"] = "none") -> Iterator[Arm]:
    """An arm with its law in C."""
    chart = oc.charts.load(name)
    law = PDPlus.on_chart(chart, memory=memory)
    with TemporaryDirectory() as folder:
        path = compile_shared(oc.generate_c(chart, Path(folder), law, "arm"), Path(folder), ("-O1",))
        yield Arm(chart, law, CompiledLibrary(path, "arm", chart.n), Safety.of(law), np.random.default_rng(7))


def rows(arms: tuple[str, ...], runs: int) -> Iterator[str]:
    """Two rows for each arm, without and with encoders: the worst of all runs of each case."""
    for name in arms:
        with arm_of(name) as arm:
            yield row(arm, name, runs)
            yield row(arm.with_encoders(13), f"{name}, encoders", runs)
        with arm_of(name, "friction") as arm:
            yield row(arm, f"{name}, `FrictionObserver`", runs)
            yield row(arm.with_encoders(13), f"{name}, `FrictionObserver`, encoders", runs)


def row(arm: Arm, label: str, runs: int) -> str:
    """The worst of all runs of each case."""
    still = [max(stands_still(arm, case)[0] for _ in range(runs)) for case in STANDING]
    frozen = [max(stands_still(arm, case)[0] for _ in range(runs)) for case in FREEZING]
    blown = np.array([blow(arm) for _ in range(runs)]).max(axis=0)
    asked = [max(led(arm, case) for _ in range(runs)) for case in ASKED]
    held = np.array([caught(arm, delay) for delay in DELAYS for _ in range(runs)])
    opened = max(brakes(arm) for _ in range(runs))
    return (
        f"| {label} | {', '.join(f'{speed:.1f}' for speed in still)} "
        f"| {', '.join(f'{speed:.1f}' for speed in frozen)} | {blown[0]:.0f}, {blown[1]:.2f} "
        f"| {', '.join(f'{share:.2f}' for share in asked)} | {held[:, 0].max():.2f} s, "
        f"{int(held[:, 1].sum())} of {len(held)} | {opened:.3f} |"
    )


def observed_rows(arms: tuple[str, ...], runs: int) -> Iterator[str]:
    """A row for each arm and encoder: all runs without and with the observer, and with what else goes wrong."""
    for name in arms:
        with arm_of(name) as arm:
            for bits in OBSERVED:
                before, after, wrong, pushed = (
                    motions(arm.with_encoders(bits, observed), runs, **case)
                    for observed, case in (
                        (False, {}),
                        (True, {}),
                        (True, {"scale": 1.2, "delay": 5}),
                        (True, {"push": PUSH[0]}),
                    )
                )
                words = [f"{mean:{form}} -> {new:{form}}" for mean, new, form in compared(before, after)]
                lost = [sum(found.caught for found in case) for case in (before, after, wrong, pushed)]
                yield (
                    f"| {name} | {bits} | {' | '.join(words)} | {1e3 * max(found.away for found in wrong):.1f} "
                    f"| {max(found.last for found in pushed):.2f} | {', '.join(map(str, lost))} |"
                )


def compared(before: list["Motion"], after: list["Motion"]) -> Iterator[tuple[float, float, str]]:
    """Ticks at the limit of the rate [%], change of the torque in a tick [N m], flange [mm]; how to print them."""
    for take, form in (
        (lambda case: 100 * np.mean([found.cut for found in case]), ".0f"),
        (lambda case: np.sqrt(np.mean([found.noise**2 for found in case])), ".2f"),
        (lambda case: 1e3 * max(found.away for found in case), ".1f"),
    ):
        yield float(take(before)), float(take(after)), form


def motions(arm: Arm, runs: int, **case: Any) -> list["Motion"]:
    """Runs from one random posture after another."""
    return [moves(arm, **case) for _ in range(runs)]


@dataclass
class Motion:
    """What a motion with encoders was like."""

    cut: float  #: share of the ticks in which the torque changes as fast as it may
    noise: float  #: change of torques in a tick, root of the mean square [N m]
    away: float  #: largest distance of the flange from its reference [m]
    last: float  #: fastest joint at the end, less what the reference asks for [rad/s]
    caught: bool


def moves(arm: Arm, scale: float = 1.0, delay: int = 0, push: float = 0.0) -> Motion:
    """Sines of all joints, of up to 0.2 rad/s, half their limits, and 0.4 of the domain's half-width in all."""
    chart, q = arm.chart, arm.posture()
    robot = arm.robot.with_scaled_masses(scale)
    supervisor, plant = arm.started(q, robot)
    swing = np.minimum(np.minimum(0.1, 0.25 * arm.limits), 0.2 * chart.problem.domain.half_width)
    swing *= arm.rng.choice([-1.0, 1.0], chart.n)
    unit = arm.rng.normal(size=3)
    angle = 2 * TICK * np.arange(-SETTLED, 1500).clip(0)[:, None]
    wanted, speed = q + swing * (1 - np.cos(angle)), 2 * swing * np.sin(angle)
    asked = motion(chart, wanted, speed, 4 * swing * np.cos(angle) * (angle > 0))
    late, commands, path, caught = deque([arm.robot.gravity(q)] * delay), [], [], False
    for k, reference in enumerate(asked):
        if push and k - SETTLED == PUSH[1]:
            plant.push(push * unit / np.linalg.norm(unit))
        if k - SETTLED == PUSH[2]:
            plant.release()
        command, status = supervisor.step(*arm.seen(plant), reference, TICK)
        late.append(command)
        plant.step(late.popleft(), TICK)
        commands.append(command)
        path.append(plant.q)
        caught |= k >= SETTLED and status in (ControlStatus.CAUGHT, ControlStatus.RETURNING)
    steps = np.abs(np.diff(commands[SETTLED:], axis=0))
    away = np.linalg.norm((chart.phi(np.array(path)) - asked[:, : chart.n])[SETTLED:, :3], axis=1).max()
    cut = (steps >= (1 - 1e-9) * arm.safety.command_rate * TICK).any(axis=1).mean()
    return Motion(
        cut, float(np.sqrt(np.mean(steps**2))), float(away), float(np.abs(plant.dq - speed[-1]).max()), caught
    )


DELAYS = 0, 1, 3, 5  # [ms]
WATCHED, BACK = 2.5, 0.5  # of a caught arm, until it is asked back and then [s]
STANDING = ("moving", "way back", "reference", "integral")
FREEZING = ("one joint", "speeds")


def stands_still(arm: Arm, case: str) -> tuple[float, float]:
    """The fastest joint within 0.2 s after the sensors stood still [rad/s], and in its own limit of speed."""
    wrong = case == "integral"
    q, domain = arm.posture(), arm.chart.problem.domain
    if case == "way back":
        # Outside a tight domain, but within the joint's stops.
        q[1] = min(
            domain.centre[1] + 1.25 * min(domain.half_width[1], 2.0), arm.safety.upper[1] - arm.safety.stop_zone[1]
        )
    supervisor, plant = arm.started(
        q,
        arm.robot.with_scaled_masses(HEAVIER) if wrong else None,
        integral_rate=np.full(arm.chart.n, 3.0 if wrong else 0.0),
    )
    reference, signs, most = arm.resting(q), arm.rng.choice([-1.0, 1.0], arm.chart.n), np.zeros(arm.chart.n)
    # Integral action takes longer to come to rest.
    settled = 5 * SETTLED if wrong else SETTLED
    froze = np.arange(arm.chart.n) == (arm.rng.integers(arm.chart.n) if case == "one joint" else -1)
    for k in range(settled + round(LOOK / TICK)):
        if k <= settled:
            q_seen, dq_seen = arm.seen(plant)
            seen = q_seen, dq_seen if case in ("moving", *FREEZING) else (k < settled) * dq_seen
        elif case == "one joint":
            now = arm.seen(plant)
            seen = tuple(np.where(froze, *pair) for pair in zip(seen, now, strict=True))
        elif case == "speeds":
            seen = arm.seen(plant)[0], 0 * dq_seen
        if case in ("moving", *FREEZING):
            angle = 2 * k * TICK
            reference = motion(arm.chart, q + 0.1 * signs * (1 - np.cos(angle)), 0.2 * signs * np.sin(angle))
        if k == settled and case == "way back":
            supervisor.resume()
        if k >= settled and case == "reference":
            reference[0] += 0.02 * TICK
        plant.step(supervisor.step(*seen, reference, TICK)[0], TICK)
        if k >= settled:
            most = np.maximum(most, np.abs(plant.dq))
    return float(most.max()), float((most / arm.limits).max())


def motion(chart: oc.Chart, q: Array, dq: Array, ddq: ArrayLike = 0.0) -> Array:
    """References of joint motions (..., n), (..., 3 n)."""
    curvature = chart.function("second_derivative")(q.T, dq.T, dq.T).full().T.reshape(q.shape)
    J = chart.jacobian(q)
    velocity, bend = (np.einsum("...ij,...j", J, rate) for rate in (dq, np.broadcast_to(ddq, q.shape)))
    return np.concatenate([chart.phi(q), velocity, curvature + bend], axis=-1)


def blow(arm: Arm) -> tuple[float, float]:
    """The fastest joint of all times, and the last one [rad/s]."""
    q, dq = arm.posture(), np.zeros(arm.chart.n)
    dq[-1] = arm.rng.uniform(32, 60) * arm.limits[-1]
    supervisor, plant = arm.started(q)
    reference, speeds = arm.resting(q), []
    for k in range(SETTLED + 1500):
        if k == SETTLED:
            plant.reset(plant.q, dq)
        plant.step(supervisor.step(*arm.seen(plant), reference, TICK)[0], TICK)
        speeds.append(np.abs(plant.dq).max())
    return max(speeds), speeds[-1]


Asking = Callable[
    [Arm, Supervisor, int, Array, Array, Array], None
]  # changes the reference, and the target of a stream


def _far(arm: Arm, _law: Supervisor, _k: int, reference: Array, target: Array, home: Array) -> None:
    reference[: arm.chart.n] = home + 1e6 * np.sign(target - home + 1e-9)


def _jumps(arm: Arm, _law: Supervisor, k: int, reference: Array, _target: Array, _home: Array) -> None:
    if k % 300 == 0:
        reference[: arm.chart.n] = arm.chart.phi(arm.posture(0.8))


def _fast(arm: Arm, _law: Supervisor, _k: int, reference: Array, target: Array, home: Array) -> None:
    n, rate = arm.chart.n, 5 * np.sign(target - home + 1e-9)
    reference[:n] += rate * TICK
    reference[n : 2 * n] = rate


def _claimed(arm: Arm, _law: Supervisor, k: int, reference: Array, target: Array, home: Array) -> None:
    n = arm.chart.n
    reference[:n] = home + 1e-6 * (k % 2)
    reference[n : 2 * n] = 5 * np.sign(target - home + 1e-9)


def _streamed(far: float) -> Asking:
    def ask(arm: Arm, law: Supervisor, k: int, reference: Array, target: Array, home: Array) -> None:
        if k % 20 == 0:
            target[:] = arm.chart.phi(arm.posture(0.8)) if far == 0 else home + far * arm.rng.normal(size=arm.chart.n)
            if arm.rng.uniform() < 0.1:
                target[:] = np.nan
        law.stream(reference, target, 6.0, TICK)

    return ask


ASKED: tuple[Asking, ...] = (_far, _jumps, _fast, _claimed, _streamed(0.0), _streamed(1e6))


def led(arm: Arm, ask: Asking) -> float:
    """The fastest joint, in its limit of speed."""
    q = arm.posture()
    supervisor, plant = arm.started(q)
    reference, worst = arm.resting(q), 0.0
    home, target = arm.chart.phi(q), arm.chart.phi(arm.posture())
    for k in range(SETTLED + 1600):
        if k >= SETTLED:
            ask(arm, supervisor, k, reference, target, home)
        plant.step(supervisor.step(*arm.seen(plant), reference, TICK)[0], TICK)
        worst = max(worst, float((np.abs(plant.dq) / arm.limits).max()))
    return worst


def caught(arm: Arm, delay: int) -> tuple[float, bool]:
    """The time until all joints rest, at most `WATCHED` [s], and whether the catcher then goes on when asked."""
    robot, n = arm.robot, arm.chart.n
    q = arm.rng.uniform(np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi))
    supervisor, plant = arm.started(q, return_margin=0.99, near_margin=0.98)  # as if nothing were inside
    plant.reset(q, arm.rng.uniform(-0.5, 0.5, n))
    late = deque([robot.gravity(q)] * round(1e-3 * delay / TICK))
    last, watched, asked = 0, round(WATCHED / TICK), arm.resting(arm.chart.problem.domain.centre)
    for k in range(watched + round(BACK / TICK)):
        if k == watched:
            supervisor.resume()
        command, status = supervisor.step(*arm.seen(plant), asked, TICK)
        late.append(command)
        plant.step(late.popleft(), TICK)
        if k < watched and np.abs(plant.dq).max() > REST:
            last = k + 1
    return last * TICK, status is not ControlStatus.CAUGHT


def brakes(arm: Arm) -> float:
    """The fastest joint in the second after brakes open [rad/s]."""
    q = arm.posture()
    supervisor, plant = arm.started(q)
    reference, target, most = arm.resting(q), arm.chart.phi(arm.posture()), 0.0
    for k in range(SETTLED + 3000):
        holds = SETTLED <= k < SETTLED + 2000
        if k == SETTLED:
            plant.reset(plant.q)
            supervisor.hold(plant.q)
        if k == SETTLED + 2000:
            supervisor.release(plant.q)
        if k >= SETTLED:
            supervisor.stream(reference, target, 6.0, TICK)
        command, _ = supervisor.step(*arm.seen(plant), reference, TICK)
        if not holds:
            plant.step(command, TICK)
        most = max(most, float(np.abs(plant.dq).max())) if k > SETTLED + 2000 else 0.0
    return most


if __name__ == "__main__":
    run(main, __doc__)
