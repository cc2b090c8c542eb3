"""Lines with the elbow free to move past a post: found by `follow`, of those a search of all postures finds (10 min).

The panda's hand goes 0.2 m along a straight line with its orientation held, and with xi held the elbow would meet a
post. `oc.follow(..., "objective")` against a search of all postures: from every posture with the x of the start, a
flood fill over the free part of all self-motions at 60 stations, by steps along the null space and Newton's method.
"""

import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.errors import PathError
from orthocas.robots.collisions import Collisions
from orthocas.robots.urdf import find_robot_file
from orthocas.tools.checks import Array

LENGTH, STATIONS, STEP = 0.2, 60, 0.04  # [m]; of the search; along self-motions [rad]
LATTICE, NEWTON, LONGEST = 48, 6, 0.3  # values of xi at the start; steps; a joint between stations at most [rad]
BESIDE, POST = 0.1, 0.03  # [m] of a post from the way of the elbow, at most; its radius


@dataclass(frozen=True)
class Line:
    """A path of the hand among obstacles."""

    around: Collisions
    start: Array  #: (n,)
    x: Array  #: (N, m)


def load_panda() -> tuple[oc.Chart, Collisions]:
    """The ready chart and the solids of its robot."""
    chart = oc.load("panda-wide")
    return chart, chart.robot.with_solids(find_robot_file("panda")).collisions


def draw_lines(chart: oc.Chart, own: Collisions) -> Iterator[Line]:
    """Seeded lines from free postures, along which an elbow at rest in xi meets a post."""
    rng = np.random.default_rng(11)
    for q in chart.domain.sample(20_000, 11):
        direction, side = rng.normal(size=3), rng.uniform(-np.pi, np.pi)
        x = np.tile(chart.x(q), (31, 1))
        x[:, :3] += np.linspace(0.0, LENGTH, 31)[:, None] * direction / np.linalg.norm(direction)
        try:
            held = oc.follow(chart, x, "hold", q_start=q, collisions=own).q
        except PathError:
            continue
        # Where the elbow is on its way, or beside that.
        elbow = chart.robot.frame_position(held[rng.integers(len(held) // 3, len(held))], "panda_link4")
        place = elbow + rng.uniform(0.0, BESIDE) * np.array([np.cos(side), np.sin(side), 0.0])
        up = np.array([0.0, 0.0, 0.5])
        around = own.with_scene(oc.Scene({"post": oc.obstacles.Capsule(place - up, place + up, POST)}))
        if around.distance(q).distance > 0.01 and around.find_contact(held) is not None:
            yield Line(around, q, x)


class Search:
    """All postures along a line, without the coordinates of the chart: only its x and its domain count."""

    def __init__(self, chart: oc.Chart, line: Line) -> None:
        self.chart, self.line = chart, line
        shares = np.linspace(0.0, 1.0, STATIONS)[:, None]
        self.x = (1 - shares) * line.x[0] + shares * line.x[-1]

    def find(self) -> bool:
        """Whether free postures lead from the start of the line to its end."""
        chart = self.chart
        xi = chart.xi(chart.domain.sample(2000, 0))[:, 0]
        lattice = np.linspace(xi.min(), xi.max(), LATTICE)
        found = chart.solve(np.column_stack([np.tile(self.x[0], (LATTICE, 1)), lattice]))
        some = np.vstack([found.q[found.found], self.line.start[None]])
        reached = self.spread(some[self.allow(some)], self.x[0])
        for x in self.x[1:]:
            moved = self.correct(reached, x)
            reached = self.spread(moved[self.allow(moved) & (np.abs(moved - reached).max(axis=1) < LONGEST)], x)
            if not len(reached):
                return False
        return True

    def allow(self, q: Array) -> Array:
        """Whether postures (N, n) are in the domain and free."""
        good = np.isfinite(q).all(axis=1)
        good[good] = self.chart.domain.contains(q[good])
        good[good] = self.line.around.check_free(q[good])
        return good

    def differentiate(self, q: Array) -> Array:
        """How velocities of joints move the tip, (N, m, n), at postures (N, n)."""
        rates: Array = self.chart.parts.relative.batched_rates(q)[0]
        return rates.reshape(len(q), self.chart.m, self.chart.n)

    def correct(self, q: Array, x: Array) -> Array:
        """Postures (N, n) with a task value near others, by Newton's method of least norm; NaN where it fails."""
        relative = self.chart.parts.relative
        for _ in range(NEWTON):
            J = self.differentiate(q)
            errors = relative.difference(np.tile(x, (len(q), 1)), self.chart.x(q))
            q = q + np.einsum("nij,nj->ni", np.linalg.pinv(J), errors)
        good = np.abs(relative.difference(np.tile(x, (len(q), 1)), self.chart.x(q))).max(axis=1, initial=0.0) < 1e-6
        return np.where(good[:, None], q, np.nan)

    def spread(self, seeds: Array, x: Array) -> Array:
        """All postures at steps along the free arcs of seeds (K, n) with a task value."""
        known, front = seeds[:0], seeds
        while len(front):
            # No two postures nearer than two thirds of a step.
            for q in front:
                if not len(known) or np.linalg.norm(known - q, axis=1).min() > STEP * 2 / 3:
                    known = np.vstack([known, q])
            fresh = known[-len(front) :] if len(known) else known
            along = np.linalg.svd(self.differentiate(fresh))[2][:, -1]
            new = self.correct(np.vstack([fresh + STEP * along, fresh - STEP * along]), x)
            new = new[self.allow(new)]
            if not len(new):
                break
            far = np.linalg.norm(new[:, None] - known[None], axis=2).min(axis=1) > STEP * 2 / 3
            front = new[far]
        return known


def follow_lines(count: int, found: dict[str, float]) -> Iterator[str]:
    """The row of the lines, of which the search finds `count` to be possible."""
    chart, own = load_panda()
    possible, ours, lines = 0, 0, 0
    for line in draw_lines(chart, own):
        lines += 1
        if not Search(chart, line).find():
            continue
        possible += 1
        ours += follow(chart, line)
        print(f"{ours} of {possible}, {lines} lines", file=sys.stderr, flush=True)
        if possible == count:
            break
    found |= {"lines, possible": possible, "lines, ours": ours}
    yield f"| {lines} | {possible} | {ours} | {100 * ours / possible:.1f} |"


def follow(chart: oc.Chart, line: Line) -> bool:
    """Whether a motion is found, which is checked by other means: at ten times as many postures."""
    try:
        motion = oc.follow(chart, line.x, "objective", q_start=line.start, collisions=line.around)
    except PathError:
        return False
    times = np.linspace(0, len(motion.q) - 1, 10 * len(motion.q))
    q = np.column_stack([np.interp(times, np.arange(len(motion.q)), column) for column in motion.q.T])
    assert line.around.check_free(q).all()
    return True


def main(quick: bool = False) -> dict[str, float]:
    """Print the tables; the numbers of a test."""
    found = dict[str, float]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        head = "lines | possible by the search | of these by `follow` | share [%]"
        print(f"| {head} |")
        table("| --- " * (head.count("|") + 1) + "|", follow_lines(2 if quick else 50, found))
    return found


if __name__ == "__main__":
    run(main, __doc__)
