"""Which parametrisation and solver? The named problems, and the 7-DoF arm with a pose task against the SEW angle.

Every fit runs in its own process with one thread. All fits together take about 6 minutes on 2 cores (quick: one small
grid, 10 s). The example writes a front and a convergence picture, a CSV and a JSON for every problem.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import orthocas as oc
from orthocas import bases, problems, solvers
from orthocas.cli.output import terminal_monitor
from orthocas.fitting.compare import Comparison
from orthocas.fitting.comparison_figures import convergence_figure, front_figure
from orthocas.solvers.protocol import Solver
from orthocas.tools.progress import Monitor, silent

Parametrisations = Sequence[bases.Parametrisation | oc.SEW]

WEIGHTS = oc.Weights(folds=0.0, angles="paper")  # angles alone, so that families differ in nothing else
ADAM = solvers.Adam(epochs=60, learning_rate=5e-3)
FOR_BASES: tuple[Solver, ...] = (solvers.GaussNewton(), solvers.LBFGS(), solvers.Ipopt(), ADAM)
FOR_NETWORKS: tuple[Solver, ...] = (solvers.LBFGS(), ADAM)
BASES: dict[str, Parametrisations] = {
    "planar_2r": (oc.Linear(base=(0.6, 0.8)), oc.Polynomial(4), oc.Fourier(1), oc.Fourier(2), oc.Fourier(3)),
    "planar_3r_x": (oc.Linear(), oc.Polynomial(2), oc.Polynomial(4), oc.Polynomial(6), oc.Fourier(2)),
    "planar_3r_xy": (oc.Linear(), oc.Polynomial(2), oc.Polynomial(4), oc.Polynomial(6), oc.Fourier(2)),
    "iiwa": (oc.Linear(), oc.Polynomial(2), oc.Polynomial(3), oc.Polynomial(4), oc.Fourier(1), oc.Fourier(2)),
    "iiwa_pose": (oc.SEW("conventional"), oc.SEW(), oc.Linear(), oc.Polynomial(2), oc.Polynomial(3), oc.Polynomial(4)),
}
NETWORKS: dict[str, Parametrisations] = {
    "planar_2r": (oc.MLP((16, 16)), oc.MLP((32, 32))),
    "planar_3r_x": (oc.MLP((16, 16)), oc.MLP((32, 32))),
    "planar_3r_xy": (oc.MLP((16, 16)), oc.MLP((32, 32))),
    "iiwa": (oc.MLP((16, 16)), oc.MLP((32, 32)), oc.MLP((64, 64))),
    "iiwa_pose": (oc.MLP((16, 16)), oc.MLP((32, 32))),
}


def build(name: str) -> oc.Problem:
    """A named problem, or the 7-DoF arm with its flange pose as the task, which leaves one extra coordinate."""
    if name != "iiwa_pose":
        return problems.get(name)
    base = problems.get("iiwa")
    task = oc.Task.named(base.robot, "pose", base.domain.centre)
    return oc.Problem(base.robot, task, base.metric, base.domain, name)


def compared(name: str, charts: Path, quick: bool, monitor: Monitor) -> Comparison:
    """Compare bases with every solver, and networks with the solvers that can fit them."""
    problem = build(name)
    if quick:
        return oc.compare(problem, BASES[name][:2], weights=WEIGHTS, samples=200, held_out=2_000, monitor=monitor)
    settings: dict[str, Any] = {"charts": charts, "control_ticks": True, "monitor": monitor}
    bases = oc.compare(problem, BASES[name], FOR_BASES, weights=WEIGHTS, **settings)
    networks = oc.compare(problem, NETWORKS[name], FOR_NETWORKS, weights=WEIGHTS, **settings)
    return Comparison(bases.results + networks.results)


def ticks(found: Comparison) -> str:
    """Parameters and control ticks of the parametrisations, as a table with a column each."""
    each = {summary.parametrisation: summary for summary in found.summaries()}
    rows = [
        ["", *each],
        ["---"] * (1 + len(each)),
        ["parameters", *(str(summary.parameters) for summary in each.values())],
        ["control tick [us]", *(f"{summary.control_tick_us:.2g}" for summary in each.values())],
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main(out: Path, quick: bool = False, monitor: Monitor = silent) -> dict[str, dict[str, float]]:
    """Compare and draw; print the ticks of the 7-DoF arm.

    Returns:
        Deviations [deg], folded samples and seconds of every fit, by problem, then "parametrisation solver what".
    """
    numbers: dict[str, dict[str, float]] = {}
    for name in ("planar_3r_xy",) if quick else BASES:
        folder = out / name
        (folder / "charts").mkdir(parents=True, exist_ok=True)
        found = compared(name, folder / "charts", quick, monitor)
        found.write(folder)
        front_figure(found).savefig(folder / "front.png", dpi=110)
        convergence_figure(found).savefig(folder / "convergence.png", dpi=110)
        (folder / "table.txt").write_text("\n".join(" | ".join(row) for row in found.rows()) + "\n")
        numbers[name] = {
            f"{summary.parametrisation} {summary.solver} {what}": float(getattr(summary, what))
            for summary in found.summaries()
            for what in ("task_std_deg", "mutual_std_deg", "conditioning_p01", "folded_samples", "seconds")
        }
        if name == "iiwa":
            print(ticks(found))
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/comparison"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    with terminal_monitor() as shown:
        for problem_name, numbers in main(arguments.out, arguments.quick, shown).items():
            least = min(value for name, value in numbers.items() if name.endswith("task_std_deg"))
            print(f"{problem_name:>14}: best task deviation {least:.3f} deg")
