"""Every controller on the same steps: how much does a commanded coordinate disturb the others? (30 s).

The arms are planar_3r_x (exact coordinates exist) and planar_3r_xy (they do not), with interleaved steps as in Sec. 8
of the paper. Projectors follow the posture of the same motion. The coupling index is the largest deviation of a
coordinate from its reference while only another is commanded, divided by the commanded step.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.control import Controller, Impedance, Kinematic, PDPlus, Reference
from orthocas.simulation import coupling_index

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))

from baselines import KinematicProjector, Projector, posture_reference

STIFFNESS = 200.0  # of x [N/m], of xi [N m], and of postures [N m/rad]
STEPS = {  # [m], [rad]: small enough for the boxes of the problems
    "planar_3r_x": {"x": 0.1, "xi1": -0.05, "xi2": -0.03},
    "planar_3r_xy": {"x": 0.1, "y": 0.1, "xi1": -0.05},
}
PAUSE = 4.0  # [s] between steps, in which even slow springs come to rest
WEIGHTS = (1000.0, 30.0, 150.0, 0.1)  # the last keeps gradients even (docs/explanation/derivations_meaning.md#lengths)


def main(quick: bool = False) -> dict[str, float]:
    """Print a table for each arm.

    Returns:
        Worst coupling of the task by the extra coordinates, by arm and controller, and the angle of each fit.
    """
    found = {}
    for name in ("planar_3r_x",) if quick else ("planar_3r_x", "planar_3r_xy"):
        problem = problems.get(name)
        linear = oc.fit(problem, oc.Linear()).chart
        fitted = oc.fit(problem, oc.Polynomial(6 if quick else 8), weights=WEIGHTS, align_to=linear)
        chart = fitted.chart  # in the order and with the signs of the linear coordinates: a step means the same motion
        labels, angle = chart.problem.task.labels, oc.evaluate(chart, 20_000).task_angle.std
        found[f"{name} fitted, task angle std [deg]"] = angle
        print(f"\n{name}: task {', '.join(labels)}; fitted {angle:.2f} deg off\n")
        print("| controller | task <- xi | xi <- task | x <-> y | xi <-> xi |\n| --- | --- | --- | --- | --- |")
        for title, judged, law, reference in laws(chart, linear):
            run = oc.simulate(law, reference, problem.domain.centre, must_be_reachable=False)
            bad = np.flatnonzero(run.status)
            remark = f" (left the domain after {run.times[bad[0]]:.1f} s)" if bad.size else ""
            cells = worst_by_kind(coupling_index(judged, steps(judged), run).index, chart.m)
            row = " | ".join("-" if np.isnan(cell) else f"{cell:.2%}" for cell in cells)
            print(f"| {title}{remark} | {row} |", flush=True)
            found[f"{name} {title}"] = cells[0]
    return found


def laws(chart: oc.Chart, linear: oc.Chart) -> Iterator[tuple[str, oc.Chart, Controller, Reference]]:
    """Title, chart for the evaluation, controller and its reference, for fitted and linear coordinates."""
    problem, q0 = chart.problem, chart.problem.domain.centre
    for coupling in ("coupled", "decoupled"):
        yield f"PD+ {coupling}, fitted", chart, PDPlus(chart, STIFFNESS, coupling=coupling), steps(chart)
        yield f"PD+ {coupling}, linear", linear, PDPlus(linear, STIFFNESS, coupling=coupling), steps(linear)
        yield f"impedance {coupling}, fitted", chart, Impedance(chart, STIFFNESS, coupling=coupling), steps(chart)
    yield "kinematic, fitted", chart, Kinematic(chart, 0.0), steps(chart)
    posture = posture_reference(chart, steps(chart), q0)
    for metric, letter in (("euclidean", "I"), ("inertia", "M")):
        other = oc.Problem(problem.robot, problem.task, metric, problem.domain)
        yield f"projector, A = {letter}", chart, Projector(other, STIFFNESS, STIFFNESS), posture
        yield f"kinematic projector, A = {letter}", chart, KinematicProjector(other), posture


def steps(chart: oc.Chart) -> Reference:
    """Steps of one coordinate after the other, forth and back, interleaved."""
    start = chart.phi(chart.problem.domain.centre)
    changes, time = [], 0.5
    for back in (False, True):
        for k, label in enumerate(chart.labels):
            changes.append((time, {label: start[k] + (0.0 if back else STEPS[chart.problem.name][label])}))
            time += PAUSE
    return Reference.steps(chart.labels, start, changes, time)


def worst_by_kind(index: np.ndarray, m: int) -> list[float]:
    """Largest entries of the blocks task <- xi, xi <- task, task <-> task and xi <-> xi; NaN for empty ones."""
    blocks = (index[:m, m:], index[m:, :m], index[:m, :m], index[m:, m:])
    return [float(np.nanmax(block)) if np.isfinite(block).any() else np.nan for block in blocks]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    main(parser.parse_args().quick)
