"""`nearest_xi` of exported modules: rows a second, and whether the answers are those of `chart.nearest_xi`.

Wishes are uniform in the domain, task values those of postures up to a share of the half-widths away. Answers count as
the chart's if they are within 1e-7 rad, or nearer. The chart also searches other pieces of the self-motion; its answer
is elsewhere if a joint is more than 0.5 rad away. `--quick` takes 100 rows and the small box.
"""

import importlib
import importlib.util
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from batches import exported
from benchmark import run

import orthocas as oc
from orthocas.charts.inverse import InverseStatus
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

CHARTS, ROWS, RUNS = {"iiwa7-pose": 0.3, "iiwa7-wide": 0.1, "panda-wide": 0.1}, 5000, 3
AGREED, ELSEWHERE, LIBRARIES = 1e-7, 0.5, ("numpy", "torch")


def wishes_of(chart: oc.Chart, away: float, count: int) -> tuple[Array, Array]:
    """Wishes, and task values of postures nearby, inside the domain."""
    domain, rng = chart.problem.domain, np.random.default_rng(1)
    wishes = sample_uniform(domain, count, 3)
    others = wishes + away * domain.half_width * rng.uniform(-1, 1, wishes.shape)
    kept = domain.contains(others)
    return wishes[kept], chart.x(others[kept])


def compared(chart: oc.Chart, wishes: Array, x: Array, q: Array, status: Array) -> dict[str, float]:
    """Shares of rows [%]: the chart's answer or a nearer one, the chart's lies elsewhere, reported, none of these."""
    known = chart.nearest_xi(wishes, x)
    target = np.concatenate([x, chart.xi(wishes)], axis=1)
    away = np.linalg.norm(chart.parts.phi_map.difference(target, chart.phi(q))[:, chart.m :], axis=1)
    apart, ended = np.abs(q - known.q).max(axis=1), status <= InverseStatus.NEAREST
    same = ended & ((apart < AGREED) | (away <= known.distance + AGREED))
    elsewhere = ended & ~same & (apart > ELSEWHERE)
    shares = {"as the chart": same, "elsewhere": elsewhere, "not found": ~ended, "other": ended & ~same & ~elsewhere}
    return {name: 100 * float(rows.mean()) for name, rows in shares.items()}


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    found: dict[str, float] = {}
    names = "as the chart or nearer [%] | the chart's lies elsewhere [%] | not found [%] | other [%]"
    print(f"| chart | library | rows | time of a core, a row [us] | {names} |\n|{' --- |' * 8}")
    with TemporaryDirectory() as folder:
        for name in list(CHARTS)[: 1 if quick else None]:
            chart = oc.charts.load(name)
            wishes, x = wishes_of(chart, CHARTS[name], 100 if quick else ROWS)
            shares: dict[str, float] = {}
            for library in LIBRARIES:
                if importlib.util.find_spec(library) is None:
                    continue
                module, seconds = exported(chart, library, Path(folder)), []
                array = importlib.import_module(library).asarray
                for _ in range(RUNS):
                    start = time.process_time()
                    q, status = module.nearest_xi(array(wishes), array(x))
                    seconds.append(time.process_time() - start)
                shares = shares or compared(chart, wishes, x, np.asarray(q), np.asarray(status))
                each, case = min(seconds) / len(x) * 1e6, f"{name}, {library}"
                columns = " | ".join(f"{share:.2f}" for share in shares.values())
                print(f"| {name} | {library} | {len(x)} | {each:.0f} | {columns} |", flush=True)
                found |= {
                    f"{case}, time [us]": each,
                    **{f"{case}, {what} [%]": share for what, share in shares.items()},
                }
                Path(folder, f"arm_{library}.py").unlink()
    return found


if __name__ == "__main__":
    run(main, __doc__)
