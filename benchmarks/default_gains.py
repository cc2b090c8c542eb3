"""Default gains: modes of the closed loop, and what they hold when the model is wrong (PD+, MuJoCo, 1 kHz, 5 ms delay).

Three arms with cubic coordinates on boxes of about +-0.6 rad or the paper's. The robot in MuJoCo has other masses
than the law's model, or carries 1 kg that the law does not know, at the tip. Five starts in the inner 60 % of each box:
hold still for 1.5 s, then a step of 40 mm in x and one in the first extra coordinate, 1.5 s each, through the low pass
of the paper; smaller ones, or in the other direction, where these leave the domain. The last table is the supervised
law, which holds still, without and with integral action.

`--delays` prints how gains for a stated delay settle: seven ready charts, from the posture of the fastest mode and four
others in the domain, from slow motions (5 % of the domain's half-width a second), with torques that come so late.
Speed left: the fastest joint after 1.3 to 1.5 s, at worst.
"""

import argparse
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import table

import orthocas as oc
from orthocas import problems
from orthocas.codegen import Supervisor
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.control import ControlStatus, PDPlus, Reference, Safety, matched_stiffness
from orthocas.control.gains import compute_mobility, find_fastest_posture
from orthocas.errors import UnreachableReferenceError
from orthocas.problems import urdf_path
from orthocas.simulation import MuJoCoPlant
from orthocas.tasks.samples import sample_uniform

CASES = (  # robot, task, metric
    *(("iiwa", "position", "euclidean"), ("iiwa", "position", "inertia"), ("iiwa", "pose", "euclidean")),
    ("iiwa", "pose:z", "euclidean"),
    *(("panda", "position", "euclidean"), ("panda", "position", "inertia"), ("panda", "pose", "euclidean")),
    ("panda", "pose:z", "euclidean"),
    *(("xarm7", "position", "euclidean"), ("xarm7", "position", "inertia"), ("xarm7", "pose", "euclidean")),
    ("xarm7", "pose:z", "euclidean"),
)
ROBOTS = {  # of the package example-robot-data: file, tip, locked joints, centre and half-widths of the box
    "panda": (
        *("panda_description/urdf/panda.urdf", "panda_hand", {"panda_finger_joint1": 0.0}),
        (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4),
        (0.6, 0.6, 0.6, 0.6, 0.8, 0.6, 1.2),
    ),
    "xarm7": (
        *("xarm_description/urdf/xarm7.urdf", "link_eef", {}),
        (0.0, 0.0177, 0.0, 0.9119, 0.0, 0.7243, 0.0),
        (0.6, 0.6, 0.6, 0.6, 0.8, 0.6, 1.2),
    ),
}
PLANTS = {
    "-20 %": lambda robot: robot.with_scaled_masses(0.8),
    "+20 %": lambda robot: robot.with_scaled_masses(1.2),
    "1 kg": lambda robot: robot.with_payload(1.0),
}
RATE = 1000.0  # [Hz]
DELAY = 5  # ticks from the measurement to the torque
DELAYS, INNER = (5, 10), 0.9  # [ms], ticks; share of the domain of the postures
DELAY_HEADER = (
    "| chart | 5 ms: fastest mode [Hz] | speed left [rad/s] "
    "| 10 ms: fastest mode [Hz] | speed left [rad/s] |\n| --- | --- | --- | --- | --- |"
)
ARMS = (
    *("iiwa7-position", "panda-position", "panda-pose", "xarm7-position", "baxter-left-position"),
    *("tiago-pro-left-position", "ur5-position"),
)
INTEGRAL, LONG = 3.0, 2.0  # rate of the integral action [1/s], for the last table [s]
HOLD, STEP, XI = 1.5, 0.04, 0.15  # [s], [m], [1]


@contextmanager
def robot_file(name: str) -> Iterator[tuple[Path, str, dict[str, float]]]:
    """URDF file of an arm, its tip and its locked joints."""
    if name in problems.names():
        with urdf_path() as path:
            yield path, "link_ee", {}
        return
    file, tip, locked = ROBOTS[name][:3]
    yield (
        next(Path(str(f.locate())).resolve() for f in files("example-robot-data") or [] if str(f).endswith(file)),
        tip,
        locked,
    )


def problem_of(name: str, task: str, metric: str) -> oc.Problem:
    """An arm with its box."""
    with robot_file(name) as (path, tip, locked):
        robot = oc.Robot.from_file(path, tip, locked)
    box = problems.get(name).domain if name in problems.names() else oc.Box(*ROBOTS[name][3:])
    return oc.Problem(robot, oc.Task.named(robot, task, box.centre), metric, box, name)


def chart_of(name: str, task: str, metric: str) -> oc.Chart:
    """Cubic coordinates."""
    return oc.fit(problem_of(name, task, metric), oc.Polynomial(3), weights=(1000, 30, 150, 1)).chart


def modes_row(label: str, law: PDPlus) -> str:
    """Medians of slowest and fastest mode, the fastest found, and the same with springs of 2 Hz at single inertias."""
    chart, points = law.chart, sample_uniform(law.problem.domain, 256, 0)
    W, m = compute_mobility(chart, points, chart.problem.robot), chart.m
    blocks = [np.diagonal(np.linalg.inv(W[:, part, part]), axis1=1, axis2=2) for part in (slice(m), slice(m, None))]
    before = PDPlus(chart, (4 * np.pi) ** 2 * np.median(np.hstack(blocks), axis=0))
    words = [label]
    for modes in (before.modes(), law.modes()):  # at the samples, and where a search finds the fastest mode
        low, high = np.median(modes.frequencies[:-1, [0, -1]], axis=0)
        words += [f"{low:.1f} to {high:.1f}", f"{modes.frequencies.max():.1f}", f"{1e3 * modes.delays.min():.1f}"]
    return f"| {' | '.join(words)} |"


def sag_row(label: str, law: PDPlus, starts: int) -> str:
    """Largest distances from the reference at rest and in motion [mm], and ticks in which the law had to give up."""
    words = [label]
    with compiled(law) as library:
        for make in PLANTS.values():
            plant = MuJoCoPlant(make(law.problem.robot))
            found = np.array([followed(law, library, plant, start) for start in starts_of(law.problem, starts)])
            held, moving, lost = found[:, 0].max(), found[:, 1].max(), int((found[:, 2] > 0).sum())
            words.append(f"{1e3 * held:.1f}, {1e3 * moving:.1f}" + (f", {lost} left" if lost else ""))
    return f"| {' | '.join(words)} |"


def integral_row(label: str, law: PDPlus, starts: int) -> str:
    """Distance from the reference after holding for 2 s without and with integral action [mm], and catches."""
    words = [label]
    with compiled(law) as library:
        for make in PLANTS.values():
            plant, ends = MuJoCoPlant(make(law.problem.robot)), []
            for rate in (0.0, INTEGRAL):
                supervisor = Supervisor(library, law, Safety.of(law, integral_rate=min(rate, law.integral_bound)))
                found = [held(law, supervisor, plant, start) for start in starts_of(law.problem, starts)]
                caught = sum(np.isinf(found))
                ends.append(f"{1e3 * max(np.compress(np.isfinite(found), found), default=np.nan):.2f}")
                ends[-1] += f" ({caught} caught)" if caught else ""
            words.append(" -> ".join(ends))
    return f"| {' | '.join(words)} |"


def held(law: PDPlus, supervisor: Supervisor, plant: MuJoCoPlant, q: np.ndarray) -> float:
    """Distance of the tip from where it is to stay, 2 s after the supervised law began [m]; infinite if caught."""
    m = min(3, law.chart.m)
    plant.reset(q)
    supervisor.start(q)
    late = deque([law.problem.robot.gravity(q)] * DELAY)
    reference = np.concatenate([law.chart.phi(q), np.zeros(2 * law.chart.n)])
    for _ in range(round(LONG * RATE)):
        command, status = supervisor.step(plant.q, plant.dq, reference, 1 / RATE)
        if status is ControlStatus.CAUGHT:
            return np.inf
        late.append(command)
        plant.step(late.popleft(), 1 / RATE)
    return float(np.linalg.norm(law.chart.phi(plant.q)[:m] - reference[:m]))


@contextmanager
def compiled(law: PDPlus) -> Iterator[CompiledLibrary]:
    """The law in C."""
    with TemporaryDirectory() as folder:
        generated = oc.generate_c(law.chart, folder, law, "law")
        yield CompiledLibrary(compile_shared(generated, Path(folder), ("-O1",)), "law", law.problem.n)


def starts_of(problem: oc.Problem, count: int) -> np.ndarray:
    """Postures in the inner 60 % of the domain, the first at its centre."""
    domain = problem.domain
    places = np.random.default_rng(3).uniform(-0.6, 0.6, (count, problem.n))
    places[0] = 0
    return np.asarray(domain.centre + domain.half_width * places)


def motion(law: PDPlus, q: np.ndarray) -> Reference:
    """The steps, in the directions and sizes that stay within the domain."""
    start, x, xi = law.chart.phi(q), 0, law.chart.m
    for size in (1.0, -1.0, 0.5, -0.5, 0.25, -0.25):
        changes = [(HOLD, {law.labels[x]: start[x] + size * STEP}), (2 * HOLD, {law.labels[xi]: start[xi] + size * XI})]
        reference = Reference.steps(law.labels, start, changes, 3 * HOLD)
        with suppress(UnreachableReferenceError):
            law.require_reachable(reference, q)
            return reference
    return Reference.steps(law.labels, start, [], 3 * HOLD)


def followed(law: PDPlus, library: CompiledLibrary, plant: MuJoCoPlant, q: np.ndarray) -> list[float]:
    """Distance of the tip from the reference: at rest after holding, and the largest of all; ticks without the law."""
    gains, m = gain_numbers(law), min(3, law.chart.m)
    reference = np.hstack(motion(law, q).sample(np.arange(0, 3 * HOLD, 1 / RATE)))
    plant.reset(q)
    late = deque([law.problem.robot.gravity(q)] * DELAY)
    distances, lost = [], 0
    for row in reference:
        command, status = library.control(plant.q, plant.dq, row, gains)
        lost += status not in (ControlStatus.OK, ControlStatus.SATURATED)
        distances.append(np.linalg.norm(law.chart.phi(plant.q)[:m] - row[:m]))
        late.append(command)
        plant.step(late.popleft(), 1 / RATE)
        if lost > 100:
            break
    return [distances[min(len(distances), round(HOLD * RATE)) - 1], max(distances), lost]


def delay_row(name: str) -> str:
    """For each delay: fastest mode [Hz], and the fastest joint in the end, with default gains and matched ones."""
    chart = oc.charts.load(name)
    words = [name]
    default = PDPlus(chart, matched_stiffness(chart))
    with compiled(default) as library:  # gains are arguments
        for delay in DELAYS:
            law = PDPlus(chart, matched_stiffness(chart, delay=delay / RATE))
            ends = [settled(each, library, delay) for each in (default, law)]
            words += [f"{law.modes().frequencies.max():.1f}", " -> ".join(f"{end:.3f}" for end in ends)]
    return f"| {' | '.join(words)} |"


def settled(law: PDPlus, library: CompiledLibrary, delay: int) -> float:
    """The fastest joint of the last of 1.5 s, at the worst of five postures [rad/s]."""
    domain, rng, plant = law.problem.domain, np.random.default_rng(5), MuJoCoPlant(law.problem.robot)
    fastest = find_fastest_posture(law.chart, law.stiffness, law.problem.robot)
    inner = sample_uniform(domain, 4, 1)
    gains, most = gain_numbers(law), 0.0
    for q in domain.centre + INNER * (np.vstack([fastest, inner]) - domain.centre):
        plant.reset(q, 0.05 * domain.half_width * rng.uniform(-1, 1, law.chart.n))
        late = deque([law.problem.robot.gravity(q)] * (delay - 1))  # half a tick of holding, half of computing
        reference = np.concatenate([law.chart.phi(q), np.zeros(2 * law.chart.n)])
        speeds = []
        for _ in range(round(HOLD * RATE)):
            late.append(library.control(plant.q, plant.dq, reference, gains)[0])
            plant.step(late.popleft(), 1 / RATE)
            speeds.append(np.abs(plant.dq).max())
        most = max(most, *speeds[-200:])
    return most


def main(quick: bool = False, modes_alone: bool = False, delays: bool = False) -> list[str]:
    """Print the tables; `quick` takes one arm and one start, `modes_alone` and `delays` each one table."""
    if delays:
        return table(DELAY_HEADER, map(delay_row, ARMS[:1] if quick else ARMS))
    charts = {", ".join(case): chart_of(*case) for case in (CASES[:1] if quick else CASES)}
    laws = {name: PDPlus(chart, matched_stiffness(chart)) for name, chart in charts.items()}
    rows = [modes_row(label, law) for label, law in laws.items()]
    print("\n".join(rows), flush=True)
    for row in () if modes_alone else (sag_row, integral_row):
        for label, law in laws.items():
            rows.append(row(label, law, 1 if quick else 5))
            print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one arm and one start")
    parser.add_argument("--modes", action="store_true", help="the first table alone (40 s)")
    parser.add_argument("--delays", action="store_true", help="gains for stated delays (5 min)")
    options = parser.parse_args()
    main(options.quick, options.modes, options.delays)
