"""A satellite with a Panda: coordinates that leave the hand while the satellite turns (20 s).

Nothing holds the satellite of 200 kg, and its momentum is zero. Coordinates xi of the arm's joints are orthogonal to
the generalised Jacobian of the hand's position in the generalised inertia. A simulation of all 13 joints, whose first
six have no motor, moves one coordinate while a law holds the hand by the seven torques of the arm.
"""

import argparse
import re
import time
from importlib.metadata import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import orthocas as oc
from orthocas.tools.checks import Array

SATELLITE = """<link name="satellite"><inertial><mass value="200"/>
<inertia ixx="33" iyy="33" izz="33" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="mount" type="fixed"><parent link="satellite"/><child link="panda_link0"/><origin xyz="0.3 0 0.5"/></joint>
</robot>"""
ARM = [0, -0.6, 0, -2.1, 0, 1.5, 0.78]
HALF_WIDTH = 0.3
FREQUENCY, DAMPING = 8.0, 0.8  # of the law [rad/s]
STEP, MOVE, DURATION = 0.35, 2.0, 4.0  # of xi, and the times for it and for all [s]


def satellite() -> oc.Robot:
    """The Panda of example-robot-data on a cube of 1 m, which floats."""
    path = next(path.locate() for path in files("example-robot-data") or [] if path.name == "panda.urdf")
    text = re.sub(r"</robot>\s*$", SATELLITE, Path(str(path)).read_text(encoding="utf-8"))
    with TemporaryDirectory() as folder:
        file = Path(folder) / "satellite.urdf"
        file.write_text(text, encoding="utf-8")
        return oc.Robot.from_urdf(file, tip="panda_hand", base="floating")


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Fit, evaluate and simulate; draw the motion.

    Args:
        out: folder for the picture.
        quick: coordinates of degree 2, and fewer samples.

    Returns:
        Seconds of the fit, leak and least conditioning, and of the motion: how far the hand is off at most and at its
        end [mm], what is left of the wanted xi, the turn of the satellite [deg], and its largest momentum.
    """
    out.mkdir(parents=True, exist_ok=True)
    robot = satellite()
    home = np.concatenate([np.zeros(6), ARM])
    problem = oc.Problem(robot, oc.Task.position(robot), "inertia", oc.Box(home, HALF_WIDTH, unbounded=range(6)))
    began = time.process_time()
    chart = oc.fit(problem, oc.Polynomial(2 if quick else 3)).chart
    seconds = time.process_time() - began
    report = oc.evaluate(chart, samples=2_000 if quick else 20_000)
    assert report.without_idle is not None
    times, q, dq = simulated(chart, home)
    off = 1e3 * np.linalg.norm(robot.tip_position(q) - robot.tip_position(home), axis=1)
    momentum = np.einsum("nij,nj->ni", robot.mass_matrix(q)[:, :6], dq)
    turn = np.degrees(Rotation.from_euler("ZYX", q[:, 3:6]).magnitude())
    draw(times, off, chart.xi(q)[:, 0], turn).savefig(out / "satellite.png", dpi=150)
    return {
        "fit_s": seconds,
        "leak_rms_deg": report.without_idle.leak.rms,
        "least_conditioning": report.conditioning.min,
        "hand_off_mm": float(off.max()),
        "hand_off_at_the_end_mm": float(off[-1]),
        "xi_left": float(abs(chart.xi(q[-1])[0] - chart.xi(home)[0] - STEP)),
        "satellite_turned_deg": float(turn[-1]),
        "momentum": float(np.abs(momentum).max()),
    }


def torque(chart: oc.Chart, q: Array, dq: Array, wanted: Array, rate: Array) -> Array:
    """Springs and dampers in x and xi, each with its own generalised inertia, (13,): zeros, and the arm's torques."""
    robot, m = chart.problem.robot, chart.m
    k = m + chart.r - 6  # without the coordinates of the base
    H = robot.zero_momentum(q)
    J = chart.jacobian(q)[:k] @ H
    mobility = J @ np.linalg.solve(H.T @ robot.mass_matrix(q) @ H, J.T)
    pull = FREQUENCY**2 * (wanted - chart.phi(q)[:k]) + 2 * DAMPING * FREQUENCY * (rate - J @ dq[6:])
    force = np.concatenate([np.linalg.solve(mobility[part, part], pull[part]) for part in (slice(m), slice(m, k))])
    return np.concatenate([np.zeros(6), J.T @ force])


def simulated(chart: oc.Chart, home: Array) -> tuple[Array, Array, Array]:
    """Times, positions and velocities of all joints while the first coordinate moves by `STEP`, from rest."""
    robot, k = chart.problem.robot, chart.m + chart.r - 6
    start, moving = chart.phi(home)[:k], np.eye(k)[chart.m]

    def motion(t: float, state: Array) -> Array:
        s = min(t / MOVE, 1.0)
        smooth, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / MOVE
        q, dq = state[:13], state[13:]
        tau = torque(chart, q, dq, start + STEP * smooth * moving, STEP * slope * moving)
        return np.concatenate([dq, robot.forward_dynamics(q, dq, tau)])

    times = np.linspace(0, DURATION, 201)
    found = solve_ivp(motion, (0, DURATION), [*home, *np.zeros(13)], t_eval=times, rtol=1e-8, atol=1e-9)
    return times, found.y[:13].T, found.y[13:].T


def draw(times: Array, off: Array, xi: Array, turn: Array) -> Figure:
    """How far the hand is off, the coordinate, and the turn of the satellite over time."""
    figure = Figure(figsize=(6, 5), layout="constrained")
    labels = ("hand off [mm]", "ξ₁", "satellite turned [deg]")
    for axes, values, label in zip(figure.subplots(3, sharex=True), (off, xi, turn), labels, strict=True):
        axes.plot(times, values, color="#1b9e77")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    figure.axes[-1].set_xlabel("time [s]")
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for key, number in main(arguments.out, arguments.quick).items():
        print(f"{key:>30}: {number:.4g}")
