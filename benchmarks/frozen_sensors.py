"""Sensors that stand still: how fast an arm gets in MuJoCo within 200 ms, with and without `stale_ticks` (5 min).

Under PD+ with the default gains of ready charts, all joints follow sines that begin at 0.2 or 0.5 rad/s; at 0.4 s, the
measured (q, dq) freezes. The fastest joint in the 200 ms after that counts, and arms that the law commanded until then.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.control import PDPlus, Safety
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array

ARMS = ("iiwa7", "panda", "xarm7", "ur5", "baxter-left", "z1")
TICK, FROZEN, END = 1e-3, 400, 600


def main(quick: bool = False) -> list[str]:
    """Print the table."""
    header = "| arm | joints [rad/s] | fastest within 200 ms [rad/s] | without the rule |\n| --- | --- | --- | --- |"
    return table(header, rows(ARMS[:1] if quick else ARMS, 1 if quick else 2))


def rows(arms: tuple[str, ...], seeds: int) -> Iterator[str]:
    """A row for each arm, speed and choice of directions."""
    for arm in arms:
        chart = oc.charts.load(f"{arm}-position")
        law = PDPlus.on_chart(chart)
        with TemporaryDirectory() as folder:
            path = compile_shared(oc.generate_c(chart, Path(folder), law, "arm"), Path(folder), ("-O1",))
            library = CompiledLibrary(path, "arm", chart.n)
            for speed, seed in product((0.2, 0.5), range(seeds)):
                signs = np.random.default_rng(seed).choice([-1.0, 1.0], chart.n)
                with_rule, without = (fastest(library, law, speed * signs, ticks) for ticks in (5, 10**6))
                yield f"| {arm} | {speed} | {with_rule:.2f} | {without:.2f} |"


def fastest(library: CompiledLibrary, law: PDPlus, dq: Array, stale_ticks: int) -> float:
    """The fastest joint after the measurements froze [rad/s]; NaN if the law did not command before."""
    chart, robot, domain = law.chart, law.problem.robot, law.problem.domain
    supervisor = Supervisor(library, law, Safety.of(law, stale_ticks=stale_ticks))
    plant = MuJoCoPlant(robot, stops=False)
    size, most = 0.3 * np.minimum(domain.half_width, 1.0), 0.0
    plant.reset(domain.centre, dq)
    supervisor.take_over(domain.centre, robot.gravity(domain.centre))
    for k in range(END):
        angle = np.abs(dq) / size * k * TICK
        wanted = motion(chart, domain.centre + np.sign(dq) * size * np.sin(angle), dq * np.cos(angle))
        if k <= FROZEN:
            seen = plant.q, plant.dq
        plant.step(supervisor.step(*seen, wanted, TICK)[0], TICK)
        if k == FROZEN and supervisor.mode != 0:
            return float("nan")
        most = max(most, float(np.abs(plant.dq).max())) if k >= FROZEN else 0.0
    return most


def motion(chart: oc.Chart, q: Array, dq: Array) -> Array:
    """The reference of a joint motion, without acceleration of the joints."""
    curvature = chart.function("second_derivative")(q, dq, dq).full().ravel()
    return np.concatenate([chart.phi(q), chart.jacobian(q) @ dq, curvature])


if __name__ == "__main__":
    run(main, __doc__)
