"""Computing time of `orthocas.follow` for 1,000 poses, what is kept, and that of reach (1 min).

Times are the best of three calls of the same chart; charts are fitted before. A closed path ends where it began, so
"closed to" is the distance of the last joint position from the first.
"""

import numpy as np
from benchmark import run, timed

import orthocas as oc
from orthocas import problems
from orthocas.paths import JointMotion
from orthocas.robots.collisions import Collisions
from orthocas.robots.obstacles import Sphere
from orthocas.tools.checks import Array

HEADER = (
    "| chart, path | xi | seconds | duration [s] | share of speed, acceleration limits | boundary [half-widths] "
    "| obstacle [m] | tool error | closed to [rad] |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)
BALL = Sphere([0.2, 0.15, 0.6], 0.1)


def iiwa(task: str, degree: int) -> oc.Chart:
    """The 7-DoF arm."""
    known = problems.get("iiwa")
    if task == "position":
        return oc.fit(known, oc.Polynomial(degree)).chart
    domain = oc.Box(known.domain.centre, 0.5)
    return oc.fit(oc.Problem(known.robot, oc.Task.pose(known.robot), domain=domain), oc.Polynomial(degree)).chart


def circle(chart: oc.Chart, radius: float, poses: int) -> Array:
    """A closed circle of the tool in the y-z plane."""
    angle, path = np.linspace(0, 2 * np.pi, poses), np.tile(chart.x(chart.problem.domain.centre), (poses, 1))
    path[:, 1] += radius * np.sin(angle)
    path[:, 2] += radius * (1 - np.cos(angle))
    return path


def raster(chart: oc.Chart, poses: int) -> Array:
    """Eight lines, 24 cm long and 3 cm apart."""
    share = np.linspace(-1, 1, poses // 8)
    lines = [np.column_stack([0 * share - 0.05, 0.12 * (-1) ** k * share, 0 * share + 0.03 * k]) for k in range(8)]
    return np.asarray(chart.x(chart.problem.domain.centre) + np.vstack(lines))


def row(name: str, chart: oc.Chart, path: Array, xi: str, around: Collisions | None, calls: int) -> str:
    """One path; the least time of some calls."""
    clearance = 0.0 if around is None else 0.01
    each, motion = timed(lambda: oc.follow(chart, path, xi, collisions=around, clearance=clearance), calls)
    seconds = min(each)
    kept = motion.margins
    distance = "-" if around is None else f"{kept.distance:.3f}"
    return (
        f"| {name} | {xi}{'' if around is None else ', a ball in the way'} | {seconds:.2f} | {motion.duration:.2f} "
        f"| {100 * kept.velocity:.0f} %, {100 * kept.acceleration:.0f} % | {kept.boundary:.3f} | {distance} "
        f"| {_tool_error(chart, motion):.1e} | {_closed(motion)} |"
    )


def reach_row(name: str, chart: oc.Chart, calls: int) -> str:
    """Ranges and self-motion from the centre of the domain."""
    q = chart.problem.domain.centre
    alone, _ = timed(lambda: chart.xi_range(q), calls)
    whole, motion = timed(lambda: chart.self_motion(q), calls)
    return f"| {name} | {1e3 * min(alone):.0f} | {1e3 * min(whole):.0f} | {len(motion.q)} |"


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes few poses and a coarse chart, and one call of each."""
    poses, degree, calls = (100, 2, 1) if quick else (1000, 4, 3)
    chart = iiwa("position", degree)
    around = chart.robot.with_rods(0.05).collisions.with_scene(oc.Scene({"ball": BALL}))
    ways: list[tuple[str, Collisions | None]] = [("hold", None), ("objective", None), ("objective", around)]
    rows = [row(f"iiwa, degree {degree}, circle", chart, circle(chart, 0.12, poses), *way, calls) for way in ways]
    rows += [row(f"iiwa, degree {degree}, raster", chart, raster(chart, poses), *way, calls) for way in ways[:2]]
    if not quick:
        pose = iiwa("pose", 3)
        rows += [row("iiwa, pose, degree 3, circle", pose, circle(pose, 0.05, poses), *way, calls) for way in ways[:2]]
    print("\n".join([HEADER, *rows]), flush=True)
    reach = [reach_row(f"iiwa, degree {degree}, r = 4", chart, calls)]
    print("\n| chart | xi_range [ms] | self_motion [ms] | points |\n| --- | --- | --- | --- |")
    print("\n".join(reach))
    return rows + reach


def _tool_error(chart: oc.Chart, motion: JointMotion) -> float:
    return float(np.abs(chart.x(motion.q) - motion.x).max())


def _closed(motion: JointMotion) -> str:
    return f"{np.abs(motion.q[-1] - motion.q[0]).max():.1e}" if motion.closed else "-"


if __name__ == "__main__":
    run(main, __doc__)
