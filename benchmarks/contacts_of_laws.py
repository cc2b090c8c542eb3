"""The supervised law in C without and with distances of links, under hostile streams in MuJoCo (3 min).

PD+ coupled of ready wide charts with default gains and settings, at 1 kHz. Every 1.5 s the target of the stream jumps
to a posture of the domain in contact, with itself or a ball of 24 cm where the flange is at home. Contacts are ticks in
which the hulls of two links, or of a link and the ball, overlap, by coal; the law knows capsules, and nothing in MuJoCo
stops the arm. When the catcher has the arm at rest, the program asks for the law again. The arm starts anew every 10 s
from a posture with 5 cm of room, with the same targets for both laws. A tick is one of `arm_step` with the law in
command, at 64 states, without and with distances in the same run.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table
from supervised_tick import supervised_library
from wide_charts import robot_of

import orthocas as oc
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared, time_ticks
from orthocas.control import ControlStatus, PDPlus
from orthocas.robots.capsules import FittedCapsules
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array

ARMS = {"panda-wide": "panda", "xarm7-wide": "xarm7"}
TICK, AGAIN, JUMP = 1e-3, 10_000, 1500  # [s], ticks until the arm starts anew, and until the target jumps
APART, RADIUS = 0.05, 0.12  # of links at a start, of the ball [m]
HEADER = "| chart | distances | ticks | contacts | nearest [mm] | under the law [%] | tick us |\n|" + " --- |" * 7


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; return contacts without and with distances, and the factor of a tick."""
    found = {"ticks": 0.0, "without": 0.0, "apart": 0.0, "slower": 0.0}

    def rows() -> Iterator[str]:
        for name, robot in list(ARMS.items())[: 1 if quick else None]:
            chart, model = oc.load(name), robot_of(robot)
            ball = oc.obstacles.Sphere(model.tip_position(chart.problem.domain.home), RADIUS)
            collisions = model.collisions.with_scene(oc.Scene({"ball": ball}))
            laws = {"without": None, "apart": oc.fit_capsules(collisions)}
            times = []
            for kind, capsules in laws.items():
                gaps, lead, time = measure(chart, collisions, capsules, 1 if quick else 6)
                times.append(time)
                found["ticks"] += len(gaps)
                found[kind] += float((gaps < 0).sum())
                yield (
                    f"| {name} | {'without' if capsules is None else 'with'} | {len(gaps):,} | {(gaps < 0).sum():,} "
                    f"| {1e3 * gaps.min():.1f} | {100 * lead:.0f} | {time:.2f} |"
                )
            found["slower"] = max(found["slower"], times[1] / times[0])

    table(HEADER, rows())
    print(found)
    return found


def measure(
    chart: oc.Chart, collisions: oc.robots.collisions.Collisions, capsules: FittedCapsules | None, starts: int
) -> tuple[Array, float, float]:
    """Distances of links in each tick (ticks,) [m], the share under the law, and the median time of a tick [us]."""
    law, rng, domain = PDPlus.on_chart(chart), np.random.default_rng(11), chart.problem.domain
    postures = domain.sample(20_000, 0)
    apart = collisions.distance(postures).distance
    free, hostile = postures[apart > APART], postures[apart < 0]
    path, led = [], 0
    with TemporaryDirectory() as folder:
        generated = oc.generate_c(chart, folder, law, "arm", capsules=capsules)
        library = CompiledLibrary(compile_shared(generated, Path(folder)), "arm", chart.n)
        time = time_ticks([(law, supervised_library(Path(folder), library)[0])], 20_000)[0].median
        for _ in range(starts):
            supervisor, plant, q = Supervisor(library, law), MuJoCoPlant(chart.problem.robot), rng.choice(free)
            plant.reset(q)
            supervisor.start(q)
            reference = np.concatenate([chart.phi(q), np.zeros(2 * chart.n)])
            for k in range(AGAIN):
                if k % JUMP == 0:
                    target = chart.phi(rng.choice(hostile))
                supervisor.stream(reference, target, 6.0, TICK)
                command, status = supervisor.step(plant.q, plant.dq, reference, TICK)
                plant.step(command, TICK)
                path.append(plant.q)
                led += supervisor.mode == 0
                if status is ControlStatus.CAUGHT and np.abs(plant.dq).max() < 0.01:
                    # At rest: the law again, from where the arm is.
                    supervisor.resume()
                    reference = np.concatenate([chart.phi(plant.q), np.zeros(2 * chart.n)])
    return collisions.distance(np.array(path)).distance, led / len(path), time


if __name__ == "__main__":
    run(main, __doc__)
