"""When does fitting pay, compared with linear xi behind a projector? The paper leaves this open (Sec. 10) (10 min).

Three second tasks are compared: linear xi, fitted xi and joint springs, all with A = M. The force in xi acts directly
(impedance control or PD+, decoupled) or behind the projector P^T, which removes what is left of the coupling. Motions
start at random postures in the inner 30 % or 80 % of the domain:

- removed: share of a force in the second task that the projector takes away, rms over postures and over all forces of
  the same size in the metric, sin of the angle between the gradients of xi and the null space;
- x <- xi: largest error of the task while xi moves, without and with feed-forward (PD+);
- xi <- x: the same for the posture while x moves, e = J^-1 [0; xi - xi_d], as the largest joint angle and in the
  metric, |e|_M = sqrt(e^T M e), which does not count what light joints do;
- V: runs with constant targets in which the energy of robot and springs rises, and what is left of it at the end;
- drift: distance of the joints from their start after 50 circles of the task under velocity control;
- hidden: energy left in the second spring in the scene of `hidden_spring.py`.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import hidden_spring
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from paper.hidden_spring import POSTURE_STIFFNESS, HiddenSpring

import orthocas as oc
from orthocas.control import Controller, Impedance, Kinematic, PDPlus, Reference
from orthocas.simulation import Trajectory
from orthocas.tasks.samples import sample_uniform

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))

from baselines import KinematicProjector, Projector

SIZES = (0.3, 0.8)  # of the part of the domain, relative to its half-widths
BOXES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
STEP = 0.3  # length of a motion, the largest joint angle over the half-width of the domain
WEIGHTS = oc.Weights(1000.0, 30.0, 150.0, 0.1, 1000.0, angles="metric")  # the angle that counts for A = M
DAMPING_RATIOS = (0.7, 0.1)  # for the energy of runs
DURATION = 3.0  # of a run [s]
CYCLES, PERIOD, POINTS = 50, 4.0, 16
FEEDBACK = 1.0  # of velocity laws [1/s]
RISE = 1e-6  # smallest rise of V that counts, relative to V(0)
COLOURS = {"linear": "#1f5fa8", "fitted": "#1b9e77", "joints": "#d95f02"}


@dataclass(frozen=True)
class Case:
    """A problem, and how it is controlled."""

    name: str
    degree: int
    stiffness: tuple[float, float]  #: of the task [N/m], and of xi and of the joints, which have the same scale
    radii: tuple[float, float]  #: of the circles for both sizes [m]
    runs: int
    room: tuple[float, ...] = ()  #: other half-widths of the domain [rad]


CASES = (
    Case("planar_3r_x", 6, (200.0, 200.0), (0.05, 0.12), 40),
    Case("planar_3r_xy", 6, (200.0, 200.0), (0.05, 0.1), 40),
    Case("iiwa", 3, (500.0, 30.0), (0.02, 0.04), 10, (*[np.pi / 4] * 6, 2.0)),  # A = M turns the light flange most
)


@dataclass(frozen=True)
class Arm:
    """A problem with A = M, and both charts. A step in xi means the same motion in both."""

    case: Case
    problem: oc.Problem
    charts: dict[str, oc.Chart]

    def laws(self, feed_forward: bool, damping: float = 0.7) -> Iterator[tuple[str, Controller]]:
        """Second task and whether it acts directly or behind the projector, with the law."""
        task, xi = self.case.stiffness
        stiffness = [task] * self.problem.m + [xi] * self.problem.r
        direct = PDPlus if feed_forward else Impedance
        for name, chart in self.charts.items():
            yield f"{name} direct", direct(chart, stiffness, damping, "decoupled", limit=np.inf)
            law = Projector(self.problem, task, xi, damping, np.inf, chart, feed_forward=feed_forward)
            yield f"{name} projected", law
        yield "joints projected", Projector(self.problem, task, xi, damping, np.inf, feed_forward=feed_forward)


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Measure everything, print a table, and draw what the projector removes and what remains of the coupling.

    Args:
        out: folder for the picture.
        quick: the planar arm with task (x, y), a coarse chart, few runs and circles.

    Returns:
        All numbers, by arm, size, second task and kind of law.
    """
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, float] = {}
    cases = CASES[1:2] if quick else CASES
    for case in cases:
        arm = build(case, 3 if quick else case.degree)
        found |= removed_shares(arm, 300 if quick else 2000)
        for size, radius in zip(SIZES, case.radii, strict=True):
            found |= couplings(arm, size, 2 if quick else 8)
            for damping in DAMPING_RATIOS:
                found |= energies(arm, size, damping, 3 if quick else case.runs)
            found |= drifts(arm, size, radius, 3 if quick else CYCLES)
    print_table(cases, found)
    found |= hidden(quick)
    draw(found).savefig(out / "projected_coordinates.png", dpi=130)
    return found


def build(case: Case, degree: int) -> Arm:
    """The problem with A = M, linear coordinates at its centre, and fitted ones of the same scale and signs."""
    known = oc.problems.get(case.name)
    domain = oc.Box(known.domain.centre, case.room) if case.room else known.domain
    problem = oc.Problem(known.robot, known.task, "inertia", domain, case.name)
    linear = oc.fit(problem, oc.Linear()).chart
    fitted = oc.fit(problem, oc.Polynomial(degree), weights=WEIGHTS, align_to=linear).chart
    return Arm(case, problem, {"linear": linear, "fitted": fitted})


def removed_shares(arm: Arm, samples: int) -> dict[str, float]:
    """The rms share of a force in the second task that the projector removes, on boxes of growing size."""
    found, problem = {}, arm.problem
    for size in BOXES:
        points = sample_uniform(oc.Box(problem.domain.centre, size * problem.domain.half_width), samples, 1)
        half = np.linalg.cholesky(problem.metric.evaluate(points))
        for name, chart in arm.charts.items():
            unit = np.linalg.solve(half, chart.jacobian(points).transpose(0, 2, 1))  # gradients where A is I
            task, xi = (np.linalg.qr(part)[0] for part in (unit[:, :, : problem.m], unit[:, :, problem.m :]))
            square = (task.transpose(0, 2, 1) @ xi) ** 2
            found[f"{problem.name} {size} {name}: removed"] = float(np.sqrt(square.sum((1, 2)).mean() / problem.r))
        found[f"{problem.name} {size} joints: removed"] = float(np.sqrt(problem.m / problem.n))
    return found


def couplings(arm: Arm, size: float, moves: int) -> dict[str, float]:
    """Mean over random motions of the largest error of what should rest, and the number of runs that left."""
    found: dict[str, float] = {}
    for feed_forward in (False, True):
        for name, law in arm.laws(feed_forward):
            key = f"{arm.case.name} {size} {name} {'PD+' if feed_forward else 'impedance'}"
            left = 0
            for along_task in (False, True):
                runs = [step(arm, law, *motion(arm, size, along_task, seed), along_task) for seed in range(moves)]
                errors = [error(law, run, along_task) for run in runs if not run.status.any()]
                left += moves - len(errors)
                found |= {f"{key}: {what}": float(np.mean([e[what] for e in errors])) for what in errors[0]}
            found[f"{key}: runs that left"] = float(left)
    return found


def motion(arm: Arm, size: float, along_task: bool, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Start and goal in a part of the box, by self-motion, or by motion of the task without self-motion."""
    rng, box = np.random.default_rng(seed), arm.problem.domain
    while True:
        start = box.centre + size * box.half_width * rng.uniform(-1, 1, arm.problem.n)
        goal = walk(arm.problem, start, rng.normal(size=arm.problem.n) * box.half_width, along_task)
        if np.abs((goal - box.centre) / box.half_width).max() <= size:
            return start, goal


def walk(problem: oc.Problem, start: np.ndarray, direction: np.ndarray, along_task: bool) -> np.ndarray:
    """Follow a direction, projected again and again with A = M, until a joint has moved by STEP of its half-width."""
    q, task = start.copy(), problem.task
    held = task.batched(q[None])[0][0]
    while np.abs((q - start) / problem.domain.half_width).max() < STEP:
        J, M = task.batched_jacobian(q[None])[0].reshape(problem.m, -1), problem.robot.mass_matrix(q)
        sharp = np.linalg.solve(M, J.T) @ np.linalg.inv(J @ np.linalg.solve(M, J.T))
        tangent = sharp @ (J @ direction) if along_task else direction - sharp @ (J @ direction)
        direction = tangent / np.linalg.norm(tangent)
        q = q + 0.01 * direction
        if not along_task:
            q = q - sharp @ (task.batched(q[None])[0][0] - held)
    return q


def step(arm: Arm, law: Controller, start: np.ndarray, goal: np.ndarray, along_task: bool) -> Trajectory:
    """A filtered step of either the task or the second task from start to goal."""
    first, last = (law.measured(q).full().ravel() for q in (start, goal))
    moved = slice(None, arm.problem.m) if along_task else slice(arm.problem.m, None)
    change = dict(zip(law.labels[moved], last[moved].tolist(), strict=True))
    reference = Reference.steps(law.labels, first, [(0.0, change)], DURATION)
    return oc.simulate(law, reference, start, must_be_reachable=False)


def error(law: Controller, run: Trajectory, along_task: bool) -> dict[str, float]:
    """Largest error of the task [m], or of the posture [rad] and in the metric; NaN for joint springs."""
    off, m = run.value - run.reference, law.problem.m
    if not along_task:
        return {"x <- xi": float(np.linalg.norm(off[:, :m], axis=1).max())}
    if law.chart is None:
        return {"xi <- x": np.nan, "xi <- x in the metric": np.nan}
    off[:, :m] = 0.0
    e = np.linalg.solve(law.chart.jacobian(run.q), off[:, :, None])
    square = e.transpose(0, 2, 1) @ law.problem.metric.evaluate(run.q) @ e
    return {"xi <- x": float(np.abs(e).max()), "xi <- x in the metric": float(np.sqrt(square.max()))}


def energies(arm: Arm, size: float, damping: float, runs: int) -> dict[str, float]:
    """Rises of V and V at the end, over V(0), from random postures to the task of a second and the rest of a third.

    Runs that leave the domain do not count.
    """
    found = {}
    for name, law in arm.laws(False, damping):
        rises, rests = [], []
        for start, task, rest in targets(arm, size, runs):
            first, second = (law.measured(q).full().ravel() for q in (task, rest))
            target = np.concatenate([first[: arm.problem.m], second[arm.problem.m :]])
            reference = Reference.steps(law.labels, target, [], DURATION)
            run = oc.simulate(law, reference, start, must_be_reachable=False, tolerance=1e-9)
            if not run.status.any():
                rises.append(run.storage_rise / run.storage[0])
                rests.append(run.storage[-1] / run.storage[0])
        key = f"{arm.case.name} {size} {name}, damping {damping:g}"
        found[f"{key}: runs with a rise"] = float(np.count_nonzero(np.array(rises) > RISE))
        found |= {f"{key}: runs": float(len(rises)), f"{key}: largest rise": max(rises, default=np.nan)}
        found[f"{key}: V left"] = float(np.mean(rests)) if rests else np.nan
    return found


def targets(arm: Arm, size: float, runs: int) -> list[np.ndarray]:
    """Random start, posture of the task's target, and posture of the other target, which both charts can combine."""
    rng, box, m = np.random.default_rng(1), arm.problem.domain, arm.problem.m
    chosen: list[np.ndarray] = []
    while len(chosen) < runs:
        three = box.centre + size / 4 * box.half_width * rng.uniform(-1, 1, (3, len(box.centre)))
        for chart in arm.charts.values():
            _, task, rest = chart.phi(three)
            try:
                end = chart.inverse(np.concatenate([task[:m], rest[m:]]), three[1])
            except oc.errors.InverseError:
                break
            if np.abs((end - box.centre) / box.half_width).max() > size:
                break
        else:
            chosen.append(three)
    return chosen


def drifts(arm: Arm, size: float, radius: float, cycles: int) -> dict[str, float]:
    """Distance of the joints from their start after the last circle of the task, velocity laws [rad]."""
    found = {}
    for feedback in (0.0, FEEDBACK):
        laws: dict[str, Controller] = {
            f"{name} direct": Kinematic(c, feedback, np.inf) for name, c in arm.charts.items()
        }
        for name, second in (*arm.charts.items(), ("joints", None)):
            laws[f"{name} projected"] = KinematicProjector(arm.problem, feedback, feedback, np.inf, second)
        for name, law in laws.items():
            found[f"{arm.case.name} {size} {name}: drift, feedback {feedback:g}"] = drift(law, radius, cycles)
    return found


def drift(law: Controller, radius: float, cycles: int) -> float:
    """Distance of the joints from their start after circles of the task at constant x_2d; NaN if the arm left [rad]."""
    start, m = law.measured(law.problem.domain.centre).full().ravel(), law.problem.m
    share = np.linspace(0, 1, POINTS, endpoint=False)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    angle = 2 * np.pi * np.append(smooth + np.arange(cycles)[:, None], cycles)
    points = np.tile(start, (len(angle), 1))
    points[:, :m] += radius * np.stack([np.cos(angle) - 1, np.sin(angle), 0 * angle], axis=1)[:, :m]
    reference = Reference.through(law.labels, PERIOD / POINTS * np.arange(len(angle)), points)
    run = oc.simulate(law, reference, law.problem.domain.centre, step=0.05, tolerance=1e-9, must_be_reachable=False)
    return np.nan if run.status.any() else float(np.linalg.norm(run.q[-1] - run.q[0]))


def hidden(quick: bool) -> dict[str, float]:
    """Energy left in the second spring before the tip of `hidden_spring.py` moves [J]."""
    spring = HiddenSpring()
    charts = {"linear": oc.fit(spring.problem, oc.Linear()).chart, "fitted": spring.chart}
    found = {}
    for name, second in (*charts.items(), ("joints", None)):
        stiffness = np.array(POSTURE_STIFFNESS if second is None else [20.0])
        law = Projector(spring.problem, hidden_spring.TASK_STIFFNESS, stiffness, second=second)
        start, goal = (law.measured(q).full().ravel() for q in (spring.start, spring.goal))
        reference = hidden_spring.steps(law.labels, start, dict(zip(law.labels[2:], goal[2:].tolist(), strict=True)))
        run = oc.simulate(law, reference, spring.start, step=0.05 if quick else 0.01, must_be_reachable=False)
        before = np.searchsorted(run.times, hidden_spring.TIP_AT - 1e-9)
        error = (run.value - run.reference)[before, 2:]
        found[f"hidden spring, {name}: energy [J]"] = float(error**2 @ stiffness / 2)
        found[f"hidden spring, {name}: instants without command"] = float(np.count_nonzero(run.status))
    return found


ROWS = (  # of the table: title, name of the number, unit of print, format
    ("removed: linear ξ", "linear: removed", 100, ".2g", "%"),
    ("removed: fitted ξ", "fitted: removed", 100, ".2g", "%"),
    ("removed: joint springs", "joints: removed", 100, ".2g", "%"),
    ("x <- ξ, PD+ decoupled, linear", "linear direct PD+: x <- xi", 1e3, ".2g", "mm"),
    ("x <- ξ, PD+ decoupled, fitted", "fitted direct PD+: x <- xi", 1e3, ".1g", "mm"),
    ("x <- ξ, projector with feed-forward, linear ξ", "linear projected PD+: x <- xi", 1e3, ".0e", "mm"),
    ("ξ <- x, projector with feed-forward, linear", "linear projected PD+: xi <- x in the metric", 1e3, ".2g", ""),
    ("ξ <- x, projector with feed-forward, fitted", "fitted projected PD+: xi <- x in the metric", 1e3, ".2g", ""),
    ("drift, fitted ξ direct", "fitted direct: drift, feedback 1", 1, ".0e", "rad"),
    ("drift, linear ξ projected", "linear projected: drift, feedback 1", 1, ".1g", "rad"),
    ("drift, fitted ξ projected", "fitted projected: drift, feedback 1", 1, ".1g", "rad"),
    ("drift, joint springs", "joints projected: drift, feedback 1", 1, ".1g", "rad"),
    ("drift without feedback, joint springs", "joints projected: drift, feedback 0", 1, ".2g", "rad"),
)


def print_table(cases: Sequence[Case], found: dict[str, float]) -> None:
    """Print what the page shows: a row for each kind of number, a cell for each arm, with both sizes."""
    sizes = " / ".join(f"{size:.0%}" for size in SIZES)
    print(f"| {sizes} of the domain | {' | '.join(case.name for case in cases)} |")
    print("| --- " * (1 + len(cases)) + "|")
    for title, name, factor, form, unit in ROWS:
        pairs = [[f"{found[f'{case.name} {size} {name}'] * factor:{form}}" for size in SIZES] for case in cases]
        cells = [" / ".join(dict.fromkeys(pair)) + f" {unit}".rstrip() for pair in pairs]
        print(f"| {title} | {' | '.join(cells)} |")


def draw(found: dict[str, float]) -> Figure:
    """What the projector removes, by size of the box, and how far a moving task disturbs the posture."""
    names = [case.name for case in CASES if f"{case.name} 0.1 linear: removed" in found]
    figure = Figure(figsize=(3.6 * len(names), 6.2), layout="constrained")
    grid = figure.subplots(2, len(names), squeeze=False)
    for column, name in enumerate(names):
        top, bottom = grid[:, column]
        for second, colour in COLOURS.items():
            share = [100 * found[f"{name} {size} {second}: removed"] for size in BOXES]
            top.plot(BOXES, share, "-o", color=colour, markersize=3, label=second.replace("joints", "joint springs"))
        top.set_yscale("log")
        top.set_ylim(0.1, 100)
        top.set_title(name, fontsize=10)
        top.set_xlabel("part of the domain", fontsize=9)
        draw_bars(bottom, name, found)
        for axes in (top, bottom):
            axes.grid(alpha=0.3, axis="y")
            axes.tick_params(labelsize=8)
    grid[0, 0].set_ylabel("force removed by the projector [%]", fontsize=9)
    grid[1, 0].set_ylabel("posture error while x moves, PD+ [√kg m]", fontsize=9)
    grid[0, 0].legend(fontsize=8)
    grid[1, 0].legend(fontsize=8)
    return figure


def draw_bars(axes: Axes, name: str, found: dict[str, float]) -> None:
    """Draw xi <- x under PD+ for both charts, direct (pale) and behind the projector."""
    kinds = [(second, kind) for second in ("linear", "fitted") for kind in ("direct", "projected")]
    for k, (second, kind) in enumerate(kinds):
        values = [found[f"{name} {size} {second} {kind} PD+: xi <- x in the metric"] for size in SIZES]
        places = np.arange(len(SIZES)) + 0.2 * (k - 1.5)
        strength = 0.45 if kind == "direct" else 1.0
        axes.bar(places, values, 0.18, color=COLOURS[second], alpha=strength, label=f"{second}, {kind}")
    axes.set_xticks(np.arange(len(SIZES)), [f"inner {size:.0%}" for size in SIZES])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, number in main(arguments.out, arguments.quick).items():
        print(f"{key:>70}: {number:.4g}")
