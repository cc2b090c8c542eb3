"""Circles of the tool that cross charts of an atlas, and what is left over of the posture after one turn (2 min).

Each circle is run three times: with steps of the pseudo-inverse, through the charts of the atlas with hand-overs, and
in one chart that `orthocas.chart_along` fits to the surroundings of the postures found in the atlas. In charts, xi is
held.

- hand_overs: of all circles together, in the atlas;
- pseudo_inverse_rad, atlas_rad, one_chart_rad: largest joint difference between end and start, of all circles;
- worst_ratio: largest quotient of what the one chart and the pseudo-inverse leave over on the same circle.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.atlas.chart_along import follow_in_atlas
from orthocas.tools.checks import Array


@dataclass(frozen=True)
class Case:
    """A problem, radii of circles [m], circles of each radius, and what an atlas around them is asked for."""

    name: str
    sizes: tuple[float, ...]
    circles: int
    asked: oc.AtlasSettings
    reach: float  #: of the atlas around the postures of the pseudo-inverse [rad]


CASE = Case("iiwa", (0.05, 0.1, 0.2), 2, oc.AtlasSettings(half_width=0.4), 0.3)
QUICK = Case("planar_3r_xy", (0.15,), 1, oc.AtlasSettings(2, 14.0, half_width=0.25, splits=2), 0.3)
HEADER = (
    "| circle | hand-overs | pseudo-inverse [rad] | atlas with hand-overs [rad] | one chart [rad] |\n"
    "| --- | --- | --- | --- | --- |"
)


def main(quick: bool = False) -> dict[str, float]:
    """Build an atlas around circles, and run them."""
    case = QUICK if quick else CASE
    problem = problems.get(case.name)
    loops = {
        f"{size:g} m, plane {k}": loop
        for size in case.sizes
        for k, loop in enumerate(circles(problem, size, case.circles), 1)
    }
    around = np.vstack([pseudo_inverse(problem, q, x) for q, x in loops.values()])
    print(HEADER)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "loops.orthocas-atlas"
        atlas = oc.build_atlas(problem, path, case.asked, region=around, radius=case.reach, jobs=1)
        rows = [row(atlas, name, q, x) for name, (q, x) in loops.items()]
    hand_overs, least, across, one = np.array(rows).T
    return {
        "hand_overs": float(hand_overs.sum()),
        "pseudo_inverse_rad": float(least.max()),
        "atlas_rad": float(across.max()),
        "one_chart_rad": float(one.max()),
        "worst_ratio": float((one / least).max()),
    }


def circles(problem: oc.Problem, size: float, count: int) -> Iterator[tuple[Array, Array]]:
    """Starts near the centre of the domain, and circles of the tool from there in random planes."""
    rng = np.random.default_rng(5)
    for _ in range(count):
        q = problem.domain.centre + rng.uniform(-0.2, 0.2, problem.n)
        yield q, circle(problem.task.batched(q[None])[0][0], size, rng)


def row(atlas: oc.Atlas, name: str, q: Array, x: Array) -> tuple[float, ...]:
    """Hand-overs and what is left over, printed too."""
    motion = follow_in_atlas(atlas, x, q)
    chart = oc.chart_along(atlas, x, q)
    ends = (pseudo_inverse(atlas.problem, q, x)[-1], motion.q[-1], held(chart, q, x))
    left = [float(np.abs(end - q).max()) for end in ends]
    print(f"| {name} | {motion.hand_overs} | {left[0]:.2g} | {left[1]:.2g} | {left[2]:.1g} |", flush=True)
    return motion.hand_overs, *left


def circle(x: Array, size: float, rng: np.random.Generator) -> Array:
    """A circle through x in a random plane, with its middle nearer to the base."""
    first, second = np.linalg.qr(rng.normal(size=(len(x), 2)))[0].T
    first = first * np.sign(first @ x)
    turn = np.linspace(0, 2 * np.pi, 161)[:, None]
    return np.asarray(x + size * ((np.cos(turn) - 1) * first + np.sin(turn) * second))


def pseudo_inverse(problem: oc.Problem, q: Array, x: Array) -> Array:
    """Postures along task values, by steps of least norm."""
    postures = []
    for wanted in x:
        for _ in range(3):
            J = problem.task.batched_jacobian(q[None])[0].reshape(problem.m, problem.n)
            q = q + np.linalg.pinv(J) @ (wanted - problem.task.batched(q[None])[0][0])
        postures.append(q)
    return np.array(postures)


def held(chart: oc.Chart, q: Array, x: Array) -> Array:
    """The last posture along task values with the coordinates of one chart held."""
    xi = chart.xi(q)
    for wanted in x:
        q = chart.inverse(np.concatenate([wanted, xi]), q_start=q, outside=True)  # charts of an atlas overlap
    return q


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    for key, number in main(parser.parse_args().quick).items():
        print(f"{key:>20}: {number:.4g}")
