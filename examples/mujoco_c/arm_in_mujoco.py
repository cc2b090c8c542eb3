"""A complete program in C around the supervised law, with MuJoCo as the robot (30 s; quick, without the film: 15 s).

This script fits coordinates for the 7-DoF arm, generates C, writes the scene, builds `main.c` with CMake and runs it.
The program holds the arm, moves it, is pushed at the elbow until the arm leaves the domain, leads it back, and touches
a wall. The script draws its log and a film. Needs cmake, a C compiler and the extra `orthocas[mujoco]`.
"""

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from arm_film import save_drawing, save_film
from arm_log import Log, figure
from arm_scene import HAND_RADIUS, write_scene

import orthocas as oc
from orthocas import problems
from orthocas.control import ControlStatus, PDPlus, matched_stiffness

HERE = Path(__file__).parent
WEIGHTS = (1000, 30, 150, 1, 1000)
GAP = 0.02  # between hand and wall at the start [m]
PUSH_START, PUSH_END, PUSH = 7.0, 7.5, np.array([0.0, 120.0, 0.0])  # as in main.c [s], [N]
EVERY, PERIOD = 200, 0.1  # the film shows every 200th tick for 0.1 s: twice as fast as the run


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Build and run the program, draw its log.

    Args:
        out: folder for everything that is made.
        quick: few samples, and no film.

    Returns:
        See `findings`.
    """
    out.mkdir(parents=True, exist_ok=True)
    problem = problems.get("iiwa")
    problem = oc.Problem(problem.robot, problem.task, "inertia", problem.domain, "iiwa")
    chart = oc.fit(problem, oc.Polynomial(3), weights=WEIGHTS, samples=1500 if quick else None).chart
    # Constant springs, which people and walls can push back.
    oc.generate_c(chart, out / "generated", PDPlus(chart, matched_stiffness(chart)), name="arm")
    x, _, z = chart.phi(problem.domain.centre)[: chart.m]
    write_scene(problem.robot.tree, out / "scene.xml", x + HAND_RADIUS + GAP, z)
    subprocess.run([build(out), out / "scene.xml", out / "log.csv"], check=True)
    log = Log.read(out / "log.csv", chart.n)
    figure(log, chart.m).savefig(out / "arm_in_mujoco.png", dpi=100)
    if not quick:
        draw_film(log, chart, out)
    return findings(log, chart)


def build(out: Path) -> Path:
    """Build main.c with the generated library and with libmujoco; the path of the program."""
    spec = find_spec("mujoco")
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit("this example needs MuJoCo: pip install orthocas[mujoco]")
    folders = {"ARM_FOLDER": out / "generated", "MUJOCO_FOLDER": Path(spec.submodule_search_locations[0])}
    settings = [f"-D{name}={folder.resolve()}" for name, folder in folders.items()]
    subprocess.run(["cmake", "-S", HERE, "-B", out / "build", *settings], check=True, stdout=subprocess.DEVNULL)
    subprocess.run(["cmake", "--build", out / "build"], check=True, stdout=subprocess.DEVNULL)
    return (out / "build" / "arm_in_mujoco").resolve()


def draw_film(log: Log, chart: oc.Chart, out: Path) -> None:
    """Draw a film with MuJoCo's renderer, or with lines where it cannot draw."""
    ticks = np.arange(0, len(log.time), EVERY)
    pushes = (log.push[ticks] > 0)[:, None] * PUSH
    path = out / "arm_in_mujoco.gif"
    try:
        save_film(path, out / "scene.xml", log.q[ticks], pushes, [log.caption(int(k)) for k in ticks], PERIOD)
    except Exception as error:  # renderers raise all kinds of errors
        print(f"MuJoCo cannot draw here ({error}); the film shows lines instead", file=sys.stderr)
        save_drawing(path, log, ticks, chart)


def findings(log: Log, chart: oc.Chart) -> dict[str, float]:
    """What the run shows.

    Returns:
        largest_change: of a torque in one tick [N m].
        settled_s: time after the push from which no joint is faster than 2 rad/s, until the law is back [s].
        left_domain: 1 if the push drove the arm out of the domain; caught, returning: 1 for these statuses.
        back_s: time after the push when the law is back [s].
        end_inside, end_speed, end_error: in the last tick: 1 inside the domain, speed [rad/s], largest error.
        flange_mm: largest error of the flange while it and the elbow move, before the push [mm].
        wall_N: largest force on the wall [N].
    """
    time, domain = log.time, chart.problem.domain
    law = np.isin(log.status, (ControlStatus.OK, ControlStatus.SATURATED, ControlStatus.NEAR_BOUNDARY))
    first_caught = int(np.argmax((log.status == ControlStatus.CAUGHT) & (time >= PUSH_START)))
    back = first_caught + int(np.argmax(law[first_caught:]))
    fast = time[(log.speed > 2.0) & (time < time[back])]
    moving, pushed = time < PUSH_START, (time >= PUSH_START) & (time < time[back])
    error = np.abs(log.phi - log.reference)
    return {
        "largest_change": float(np.abs(np.diff(log.torque, axis=0)).max()),
        "settled_s": float(max(0.0, fast.max(initial=0.0) - PUSH_END)),
        "left_domain": float(not np.all(domain.contains(log.q[pushed]))),
        "caught": float((log.status == ControlStatus.CAUGHT).any()),
        "returning": float((log.status == ControlStatus.RETURNING).any()),
        "back_s": float(time[back] - PUSH_END),
        "end_inside": float(law[-1] and bool(np.all(domain.contains(log.q[-1:])))),
        "end_speed": float(log.speed[-1]),
        "end_error": float(error[-1].max()),
        "flange_mm": float(1e3 * error[moving, : chart.m].max()),
        "wall_N": float(log.contact.max()),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/mujoco_c"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name:<16}{value:.4g}")
