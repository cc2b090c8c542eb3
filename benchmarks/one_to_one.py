"""An attack on one-to-one proofs: Newton's method looks for second solutions in proved boxes of random arms.

`python benchmarks/one_to_one.py [--quick]` prints how many boxes are proved, and a pair of points with the same phi for
each box that has one. There should be none. 200 arms and the ready charts, with 20,000 starts each; quick: 10 arms and
one chart with 2,000 starts.
"""

import sys
import time
from pathlib import Path

import numpy as np

import orthocas as oc
from orthocas.certificates.one_to_one import choose_one_to_one_check
from orthocas.certificates.rows import build_chart_rows
from orthocas.certificates.search import Limits, Search
from orthocas.charts.certificate import Subdivision
from orthocas.errors import OrthocasError

sys.path.append(str(Path(__file__).parent.parent / "tests" / "shared"))
from random_arms import SPATIAL_TASKS, random_arm, second_solutions

_BOXES = 300  # judged for one box of an arm
_SCALES = (1.0, 0.7, 0.5, 0.35, 0.25)


def random_chart(seed: int) -> oc.Chart:
    """A fit of a random arm with a random task and a random box."""
    rng = np.random.default_rng(seed)
    task = SPATIAL_TASKS[seed % len(SPATIAL_TASKS)]
    m = {"position": 3, "position:xy": 2, "orientation": 3, "axis": 2, "axis:y": 2, "position+axis": 5}.get(task, 6)
    robot = random_arm(rng, m + int(rng.integers(1, 3 if m < 5 else 2)))
    box = oc.Box(rng.uniform(-2, 2, robot.n), rng.uniform(0.1, 1.0) * rng.uniform(0.3, 1.5, robot.n))
    problem = oc.Problem(robot, oc.Task.named(robot, task, box.centre), domain=box)
    return oc.fit(problem, oc.Polynomial(int(rng.integers(1, 4))), samples=300, seed=seed).chart


def proved_box(chart: oc.Chart) -> Subdivision | None:
    """The largest of some boxes around the centre that a few parts prove."""
    domain, rows = chart.problem.domain, build_chart_rows(chart)
    for scale in _SCALES:
        box = Subdivision.whole(*(domain.centre + scale * domain.half_width * sign for sign in (-1, 1)))
        judge = choose_one_to_one_check(chart, rows, box)
        if judge is None:
            return None
        search = Search(judge, box, Limits(boxes=_BOXES))
        search.run(lambda _: None)
        if search.finished:
            return box
    return None


def main(quick: bool = False) -> dict[str, int]:
    """Attack so many arms."""
    arms, starts = (10, 2_000) if quick else (200, 20_000)
    begin = time.process_time()
    proved = false = refused = 0
    for seed in range(arms):
        try:
            chart = random_chart(seed)
        except OrthocasError as error:  # a singular task at the centre, for example
            refused += 1
            print(f"seed {seed}: {error}", file=sys.stderr)
            continue
        if (box := proved_box(chart)) is None:
            continue
        proved += 1
        pairs = second_solutions(chart, box.low, box.high, starts, seed)
        if len(pairs):
            false += 1
            print(f"seed {seed}, {chart.problem.task.name}: phi is the same at {pairs[0].tolist()}")
    names = oc.charts.names()[:1] if quick else oc.charts.names()
    for name in names:
        known = oc.charts.load(name)
        assert known.certificate is not None
        if (certified := known.certificate.injective) is not None:
            proved += 1
            pairs = second_solutions(known, certified.low, certified.high, starts, 0)
            false += bool(len(pairs))
            print(f"{name}: {len(pairs)} second solutions")
    seconds = time.process_time() - begin
    print(f"{arms} arms ({refused} refused) and {len(names)} ready charts in {seconds:.0f} CPU s:")
    print(f"{proved} boxes proved, {false} of them falsely")
    return {"arms": arms, "refused": refused, "proved": proved, "false": false}


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
