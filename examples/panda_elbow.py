"""A Panda from its URDF: PD+ at 1 kHz with gravity and torque limits; the elbow moves, the hand stays (20 s).

The example fits coordinates for the hand position with A = M, then commands steps in every xi while x stays constant,
and finally a step in x. The decoupled law relies on orthogonal coordinates, the coupled law does not. The URDF comes
from the package example-robot-data.
"""

import argparse
from importlib.metadata import files
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import orthocas as oc
from orthocas.control import PDPlus, Reference
from orthocas.simulation import Noise, Trajectory

READY = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)  # [rad]
HALF_WIDTH = (0.6, 0.6, 0.6, 0.6, 0.8, 0.6, 1.2)  # [rad]; with A = M the light wrist moves most
TORQUE_LIMITS = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # [N m], from the manufacturer
STIFFNESS = (400.0, 400.0, 400.0, 20.0, 20.0, 20.0, 20.0)  # [N/m], then [N m] because the xi are in radians
STEPS = (
    (0.5, {"xi2": 0.2}),
    (2.5, {"xi2": 0.0}),
    (4.5, {"xi1": 0.25}),
    (6.5, {"xi1": 0.0}),
    (8.5, {"xi3": -0.2}),
    (10.5, {"xi3": 0.0}),
    (12.5, {"xi4": 0.2}),
    (14.5, {"xi4": 0.0}),
)
HELD = 16.5  # [s] until this time, the hand is to stay at rest
RATE = 1000.0  # [Hz]
OF_XI = ("#d94801", "#1b7837", "#c51b7d", "#c9a000")  # no colour means two things
OF_JOINTS = ("#000000", "#4d4d4d", "#999999", "#762a83", "#af8dc3", "#8c510a", "#d8b365")
HAND_COLOUR, ELBOW_COLOUR = "#1f5fa8", "#5ec4d4"
ELBOW = 4  # of `Robot.joint_points`: the origin of joint 4


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Fit, run both laws and save a picture.

    Args:
        out: folder for the picture.
        quick: a coarser chart and a shorter run.

    Returns:
        Quality of the chart, deviation of the hand and motion of the elbow [m], largest torque as a share of its limit.
    """
    out.mkdir(parents=True, exist_ok=True)
    chart = panda_chart(degree=2 if quick else 3)
    report = oc.evaluate(chart, 20_000, seed=1)
    found = {"task_std_deg": report.task_angle.std, "mutual_std_deg": report.mutual_angle.std}
    runs = {}
    for coupling in ("coupled", "decoupled"):
        law = PDPlus(chart, STIFFNESS, 0.7, coupling=coupling, limit=TORQUE_LIMITS)
        run = oc.simulate(law, reference(chart, quick), READY, control_rate=RATE, noise=Noise(1e-5, 1e-4))
        hand, elbow = displacements(chart.problem.robot, run)
        held = run.times <= HELD
        found[f"{coupling}_hand_m"], found[f"{coupling}_elbow_m"] = hand[held].max(), elbow[held].max()
        found[f"{coupling}_share_of_limit"] = float((np.abs(run.command) / TORQUE_LIMITS).max())
        found[f"{coupling}_ticks_not_ok"] = int((run.status != 0).sum())
        runs[coupling] = run
    figure(chart, runs).savefig(out / "panda_elbow.png", dpi=110)
    return found


def panda_chart(degree: int) -> oc.Chart:
    """Coordinates for the hand position with A = M, on a box around the ready posture."""
    robot = oc.Robot.from_urdf(_urdf(), tip="panda_hand", locked={"panda_finger_joint1": 0.0})
    problem = oc.Problem(robot, oc.Task.position(robot), "inertia", oc.Box(READY, HALF_WIDTH), "panda")
    return oc.fit(problem, oc.Polynomial(degree), weights=(1000, 30, 150, 1)).chart


def reference(chart: oc.Chart, quick: bool) -> Reference:
    """Steps in xi with the hand at rest, then a step in x."""
    start = chart.phi(READY)
    steps = STEPS[:1] if quick else (*STEPS, (HELD, {"x": start[0] - 0.06}))
    return Reference.steps(chart.labels, start, steps, 1.5 if quick else HELD + 2.0)


def displacements(robot: oc.Robot, run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Distances of hand and elbow from their starts, (N,) each [m]."""
    points = robot.joint_points(run.q)
    hand, elbow = (np.linalg.norm(points[:, k] - points[0, k], axis=1) for k in (-1, ELBOW))
    return hand, elbow


def figure(chart: oc.Chart, runs: dict[str, Trajectory]) -> Figure:
    """Draw coordinates, hand and elbow, and torques."""
    picture = Figure(figsize=(8.0, 7.2), layout="constrained")
    rows = picture.subplots(3, 1, sharex=True)
    run = runs["decoupled"]
    for k, colour in zip(range(chart.m, chart.n), OF_XI, strict=True):
        rows[0].plot(run.times, run.value[:, k], color=colour, label=rf"$\xi_{k - chart.m + 1}$")
        rows[0].plot(run.times, run.reference[:, k], "--", color=colour, linewidth=0.8)
    rows[0].set_ylabel("extra coordinates [rad]\n(dashed: desired)")
    for (name, each), style in zip(runs.items(), ("-", "--"), strict=True):
        hand, elbow = displacements(chart.problem.robot, each)
        rows[1].semilogy(each.times, 1e3 * elbow + 1e-4, style, color=ELBOW_COLOUR, label=f"elbow, {name}")
        rows[1].semilogy(each.times, 1e3 * hand + 1e-4, style, color=HAND_COLOUR, label=f"hand, {name}")
    rows[1].set_ylabel("distance from start [mm]")
    rows[1].set_ylim(1e-3, 1e3)
    rows[1].axvspan(HELD, run.times[-1], color="0.9", label="step in x")
    for torque, joint, colour in zip(run.command.T, chart.problem.robot.joint_names, OF_JOINTS, strict=True):
        rows[2].plot(run.times, torque, color=colour, label=joint.removeprefix("panda_"))
    rows[2].set(ylabel="torque [N m], decoupled", xlabel="time [s]", xlim=(0, run.times[-1]))
    for axes in rows:
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes.grid(alpha=0.3)
    rows[0].set_title("Panda at 1 kHz: the elbow moves on command, the hand stays")
    return picture


def _urdf() -> Path:
    for entry in files("example-robot-data") or []:
        if str(entry).endswith("robots/panda_description/urdf/panda.urdf"):
            return Path(str(entry.locate())).resolve()
    raise FileNotFoundError("panda.urdf of example-robot-data (pip install example-robot-data)")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name:<28}{value:.4g}")
