"""What task and extra coordinate feel of each other, A = I against A = M, in MuJoCo: three tables (10 min of one core).

Ready wide charts of poses with A = I against those with A = M, on the same branch of the same arm.
Ten starts of each arm, drawn from both domains. Either the elbow moves while the hand should rest: xi goes to the
posture that is 0.3 further in the ready chart's xi, the same one for both charts. Or the hand moves by 0.3 m in a
direction drawn at random while xi should rest; the postures then differ. Splines of degree 5, from rest to rest in 1 s,
compiled C at 1 kHz, default gains and no friction. Only motions count that the arm can do with the heaviest load and
without: within its limits of speed, and 0.9 of its torques.

The true arm has a load that the law does not know, a point at the tip, or other masses: of each link between 0.6 and
1.4 times what the law believes. The law is told what torque holds the true arm at rest, as robots do that compensate
gravity, but not its inertia. Otherwise all charts sag alike.

Errors are the largest of each run, then mean and largest of the motions that both charts ended; left: runs that left
the domain. An error of xi counts as the motion along the self-motion that it stands for, of the joint that moves most,
because xi has another scale in each chart.
"""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table
from numpy.typing import ArrayLike

import orthocas as oc
from orthocas.charts.trackers import TrackerStatus
from orthocas.codegen.library import CompiledLibrary, compile_shared, gain_numbers
from orthocas.control import Impedance, PDPlus, Reference
from orthocas.control.controller import FROM_THE_LAW
from orthocas.control.operational_space import Coupling
from orthocas.errors import LawWarning
from orthocas.simulation import MuJoCoPlant
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

ARMS = ("iiwa7", "panda", "xarm7", "baxter-left")
LOADS = (0.0, 1.0, 3.0, 5.0)  # [kg]
CASES = (*(f"{load:g} kg" for load in LOADS), "masses off")
WRONG = (0.6, 1.4)  # masses, times those that the law believes
TURN, WAY, LENGTH, TICK = 0.3, 0.3, 1.0, 1e-3  # of xi, of the hand [m], [s], [s]
RUNS, SAMPLES, GRID, ROOM, REST = 10, 5000, 101, 0.9, 0.2
METRICS = ("A = I", "A = M")
KINDS = ("xi", "x")
LAWS: dict[str, tuple[type[PDPlus | Impedance], Coupling]] = {
    "PD+ decoupled": (PDPlus, "decoupled"),
    "impedance": (Impedance, "coupled"),
    "PD+ coupled": (PDPlus, "coupled"),
}
LEAKS = f"| arm | {', '.join(CASES)}: leak rms [deg] |\n| --- | --- |"
MOTIONS = (
    "| arm, law | hand off [mm], most | hand off [deg], most | xi off [deg], most | left | torque [% of its limit] "
    "| energy, xi moves [J] | energy, x moves [J] |\n" + "| --- " * 8 + "|"
)
LOADED = f"| arm, law | {', '.join(CASES[1:])}: hand off [mm] | xi off [deg] |\n| --- | --- | --- |"

Pair = tuple[oc.Chart, oc.Chart]
Found = dict[tuple[str, str, str, str], list["Outcome | None"]]


@dataclass(frozen=True)
class Motion:
    """A motion from rest to rest."""

    q: Array  #: where it starts
    references: tuple[Reference, Reference]  #: phi of each chart


@dataclass(frozen=True)
class Outcome:
    """What happened in a run."""

    hand: float  #: largest error of its position [m]
    turn: float  #: largest error of its orientation [rad]
    xi: float  #: largest error, as a motion of the joint that moves most [rad]
    torque: float  #: largest, relative to its limit
    energy: float  #: integral of sum_i |tau_i dq_i| [J]


def main(quick: bool = False) -> list[str]:
    """Print the tables; `quick` takes one arm and one start."""
    arms, runs = (ARMS[:1], 1) if quick else (ARMS, RUNS)
    pairs = {name: charts_of(name) for name in arms}
    rows = table(LEAKS, (row for name, pair in pairs.items() for row in leak_rows(name, pair)))
    found = {name: outcomes_of(pair, runs) for name, pair in pairs.items()}
    rows += table(MOTIONS, (row for name in arms for row in motion_rows(name, found[name])))
    return rows + table(LOADED, (row for name in arms for row in load_rows(name, found[name])))


def true_robot(robot: oc.Robot, case: str) -> oc.Robot:
    """The robot with a load, or with other masses."""
    if case in CASES[: len(LOADS)]:
        return robot.with_payload(LOADS[CASES.index(case)])
    return robot.with_scaled_masses(np.random.default_rng(0).uniform(*WRONG, robot.n))


def charts_of(name: str) -> Pair:
    """The ready wide charts with A = I and with A = M, on the same branch."""
    return oc.load(f"{name}-wide"), oc.load(f"{name}-wide-inertia")


def leak_rows(name: str, pair: Pair) -> Iterator[str]:
    """Leaks in the inertia metric of each true arm, at positions of both domains."""
    points = common_points(pair)
    robots = [true_robot(pair[0].problem.robot, case) for case in CASES]
    for metric, chart in zip(METRICS, pair, strict=True):
        leaks = [np.degrees(np.sqrt(np.mean(leaks_of(chart, points, robot) ** 2))) for robot in robots]
        yield f"| {name}, {metric} | {', '.join(f'{leak:.1f}' for leak in leaks)} |"


def leaks_of(chart: oc.Chart, points: Array, robot: oc.Robot) -> Array:
    """Angle between the gradient of xi and the orthogonal complement of the task's, in the metric of a robot, (N,).

    sin^2 a = J_xi W J_x^T (J_x W J_x^T)^-1 J_x W J_xi^T / (J_xi W J_xi^T) with W = M^-1.
    """
    J_x, J_xi = robot.tip_jacobian(points), chart.coordinates.jacobian(points)
    M = robot.mass_matrix(points)
    W_x, W_xi = np.linalg.solve(M, np.swapaxes(J_x, 1, 2)), np.linalg.solve(M, np.swapaxes(J_xi, 1, 2))
    across = J_x @ W_xi
    lean = np.swapaxes(across, 1, 2) @ np.linalg.solve(J_x @ W_x, across)
    return np.asarray(np.arcsin(np.sqrt(np.clip(lean / (J_xi @ W_xi), 0.0, 1.0))).ravel())


def outcomes_of(pair: Pair, runs: int) -> Found:
    """Outcomes of the runs of each law, chart, load and kind of motion."""
    motions = dict(zip(KINDS, zip(*draw_motions(pair, runs), strict=True), strict=True))
    found: Found = {}
    for name, (kind, coupling) in LAWS.items():
        for k, (metric, chart) in enumerate(zip(METRICS, pair, strict=True)):
            with warnings.catch_warnings(), TemporaryDirectory() as folder:
                warnings.simplefilter("ignore", LawWarning)  # of A = I
                law = kind.on_chart(chart, coupling=coupling, inputs="extra_torque")
                generated = oc.generate_c(chart, Path(folder), law, "law")
                library = CompiledLibrary(compile_shared(generated, Path(folder), ("-O1",)), "law", chart.n)
                for case in CASES:
                    robot = true_robot(chart.problem.robot, case)
                    for moved, chosen in motions.items():
                        results = [outcome(law, library, robot, m.references[k], m.q) for m in chosen]
                        found[name, metric, case, moved] = results
    return found


def outcome(
    law: PDPlus | Impedance, library: CompiledLibrary, robot: oc.Robot, reference: Reference, q: Array
) -> Outcome:
    """One run on the true robot; None if the law leaves the domain."""
    chart, gains, plant = law.chart, gain_numbers(law), MuJoCoPlant(robot)
    times = TICK * np.arange(round((LENGTH + REST) / TICK))
    phi = np.stack(reference.sample(np.minimum(times, LENGTH)), axis=1)
    path, speeds, torques = [], [], []
    plant.reset(q)
    for wanted in phi:
        path.append(plant.q)
        speeds.append(plant.dq)
        gains[-chart.n :] = robot.gravity(plant.q) - chart.problem.robot.gravity(plant.q)
        command, status = library.control(plant.q, plant.dq, wanted, gains)
        if status not in FROM_THE_LAW:
            return None
        torques.append(command)
        plant.step(command, TICK)
    positions = np.array(path)
    trace = np.einsum("sij,ij->s", robot.tip_rotation(positions), robot.tip_rotation(q))
    J = np.concatenate([robot.tip_jacobian(positions), chart.coordinates.jacobian(positions)], axis=1)
    error = chart.coordinates.xi(positions) - phi[:, 0, chart.m :]
    return Outcome(
        float(np.linalg.norm(robot.tip_position(positions) - phi[:, 0, :3], axis=1).max()),
        float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)).max()),
        float(np.abs(np.linalg.inv(J)[:, :, -1] * error).max()),
        float(np.max(np.abs(torques) / robot.effort_limits)),
        float(TICK * np.sum(np.abs(np.multiply(torques, speeds)))),
    )


def draw_motions(pair: Pair, count: int) -> list[tuple[Motion, Motion]]:
    """Starts at which both kinds of motion are possible."""
    rng, found, points, robot = np.random.default_rng(0), [], common_points(pair), pair[0].problem.robot
    held = (np.abs(robot.with_payload(LOADS[-1]).gravity(points)) < robot.effort_limits).all(axis=1)
    for q, is_held in zip(points, held, strict=True):
        turn, way = rng.choice([-TURN, TURN]), rng.normal(size=3)
        elbow = turn_elbow(pair, q, turn) if is_held else None
        hand = None if elbow is None else move_hand(pair, q, WAY * way / np.linalg.norm(way))
        if elbow is not None and hand is not None:
            found.append((elbow, hand))
        if len(found) == count:
            break
    return found


def common_points(pair: Pair) -> Array:
    """Positions of both domains, (N, n)."""
    points = sample_uniform(pair[0].problem.domain, SAMPLES, 0)
    return np.asarray(points[pair[1].problem.domain.contains(points)])


def turn_elbow(pair: Pair, q: Array, turn: float) -> Motion | None:
    """The ready chart's xi moves, and that of the other one to the same posture."""
    ready = pair[0]
    path = follow(ready, straight(ready, q, [*np.zeros(ready.m), turn]), q)
    if path is None:
        return None
    changes = [np.append(np.zeros(c.m), (c.phi(path[-1]) - c.phi(q))[c.m :]) for c in pair]
    return possible(pair, q, changes)


def move_hand(pair: Pair, q: Array, way: Array) -> Motion | None:
    """The hand moves along a line and keeps its orientation."""
    return possible(pair, q, [np.append(way, np.zeros(c.n - 3)) for c in pair])


def possible(pair: Pair, q: Array, changes: Sequence[Array]) -> Motion | None:
    """The motion of both charts, if speeds and torques permit it."""
    references = [straight(chart, q, change) for chart, change in zip(pair, changes, strict=True)]
    fine = all(is_possible(chart, reference, q) for chart, reference in zip(pair, references, strict=True))
    return Motion(q, (references[0], references[1])) if fine else None


def straight(chart: oc.Chart, q: Array, change: ArrayLike) -> Reference:
    """From phi(q) to phi(q) + change."""
    start = chart.phi(q)
    return Reference.through(chart.labels, [0.0, LENGTH], [start, start + change])


def follow(chart: oc.Chart, reference: Reference, q: Array) -> Array | None:
    """Joint positions along a reference, (GRID, n), or None if they leave the domain."""
    tracker, path = chart.tracker(q), []
    for phi in reference.sample(np.linspace(0.0, LENGTH, GRID))[0]:
        path.append(tracker.step(phi))
        if tracker.status != TrackerStatus.OK:
            return None
    return np.array(path)


def is_possible(chart: oc.Chart, reference: Reference, q: Array) -> bool:
    """Whether the joints follow within their limits of speed and torque, with all loads."""
    path = follow(chart, reference, q)
    if path is None:
        return False
    robot, step = chart.problem.robot, LENGTH / (GRID - 1)
    dq = np.gradient(path, step, axis=0)
    ddq = np.gradient(dq, step, axis=0)
    torques = [robot.with_payload(load).inverse_dynamics(path, dq, ddq) for load in (LOADS[0], LOADS[-1])]
    slow = (np.abs(dq) < robot.velocity_limits).all()
    return bool(slow and (np.abs(torques) < ROOM * robot.effort_limits).all())


def motion_rows(name: str, found: Found) -> Iterator[str]:
    """Means and maxima of the runs with a perfect model, A = I before A = M."""
    for law in LAWS:
        xi, x = (completed(found, law, CASES[0], kind) for kind in KINDS)
        left = [sum(run is None for kind in KINDS for run in found[law, metric, CASES[0], kind]) for metric in METRICS]
        cells = [
            arrow([1e3 * spread([run.hand for run in runs]) for runs in xi], ".2f"),
            arrow([np.degrees(spread([run.turn for run in runs])) for runs in xi], ".2f"),
            arrow([np.degrees(spread([run.xi for run in runs])) for runs in x], ".2f"),
            arrow([[count] for count in left], "d"),
            arrow([[100 * max(run.torque for run in a + b)] for a, b in zip(xi, x, strict=True)], ".0f"),
            *(arrow([[np.mean([run.energy for run in runs])] for runs in kind], ".1f") for kind in (xi, x)),
        ]
        yield f"| {name}, {law} | {' | '.join(cells)} |"


def load_rows(name: str, found: Found) -> Iterator[str]:
    """Means of the runs with wrong models."""
    for law in LAWS:
        moved = [[completed(found, law, case, kind) for case in CASES[1:]] for kind in KINDS]
        hand, posture = (
            [[np.mean([getattr(run, field) for run in runs[k]]) for runs in kind] for k in range(len(METRICS))]
            for kind, field in zip(moved, ("hand", "xi"), strict=True)
        )
        yield f"| {name}, {law} | {arrow(1e3 * np.array(hand), '.2f')} | {arrow(np.degrees(posture), '.2f')} |"


def completed(found: Found, law: str, case: str, kind: str) -> list[list[Outcome]]:
    """Outcomes with A = I and with A = M, of the motions that both charts ended."""
    pairs = zip(*(found[law, metric, case, kind] for metric in METRICS), strict=True)
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    return [[pair[k] for pair in both] for k in range(len(METRICS))]


def spread(values: Sequence[float]) -> Array:
    """Mean and maximum."""
    return np.array([np.mean(values), np.max(values)])


def arrow(before_after: Sequence[ArrayLike], form: str) -> str:
    """For example '2.00, 3.00 → 1.00, 1.50'."""
    return " → ".join(", ".join(f"{value:{form}}" for value in np.asarray(part)) for part in before_after)


if __name__ == "__main__":
    run(main, __doc__)
