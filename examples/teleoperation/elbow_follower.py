"""The elbows of a humanoid follow a person's, while its hands follow the person's hands, 100 times a second.

A recording has shoulder, elbow and wrist of both arms of a person. The robot's hands move as the wrists do, times the
ratio of the arms' lengths, and keep their orientation; its elbows are to move as the person's. The arms differ, so an
elbow cannot be everywhere that this asks for: with the hand in place it can move along the self-motion only. On a wide
chart of pose and elbow, each tick takes one Gauss-Newton step of xi towards the wished elbow, and `Chart.solve` with
`inside=True` finds the joints that have the hand in place, and the nearest xi that the joint limits allow.

No method that keeps the hand in place can bring the elbow nearer than the nearest point of the self-motion. A search of
the whole curve finds that, and judges the result.

    python examples/teleoperation/elbow_follower.py            # both arms of Talos; two fits of half a minute
    python examples/teleoperation/elbow_follower.py --quick    # Baxter's left arm, a ready chart
    python examples/teleoperation/elbow_follower.py --points recording.csv

Rows of a recording are x, y, z [m] of shoulder, elbow and wrist, left arm and then right arm: 18 numbers, at 100 Hz,
with x to the front, y to the left and z up. Without one, a motion of 20 s is made of sines.
"""

import argparse
import time
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import files
from pathlib import Path

import casadi as ca
import numpy as np

import orthocas as oc
from orthocas.tools.checks import Array

PERIOD, SECONDS = 0.01, 20.0  # [s]
UPPER_ARM, FOREARM = 0.31, 0.27  # of the person [m]
LARGEST_STEP = 0.1  # of xi in a tick
SHOULDER, ELBOW, WRIST = 2, 4, 6  # origins of these joints, among `Robot.joint_points`
STARTS = {  # forearm forward
    "left": (-0.5, 0.6, 0.4, -1.5, 0.3, 0.3, 0.2),
    "right": (0.5, -0.6, -0.4, -1.5, -0.3, -0.3, -0.2),
    "baxter": (-0.3, -0.5, -1.2, 1.5, 0.6, 1.0, -0.5),
}


@dataclass(frozen=True, eq=False)
class Arm:
    """A chart of the pose and the elbow of an arm, and the posture where it starts."""

    chart: oc.Chart
    start: Array

    @cached_property
    def elbow(self) -> ca.Function:
        """q (n, 1) -> place of the elbow (3, 1) [m] and its Jacobian (3, n)."""
        q = ca.SX.sym("q", self.chart.n)
        place = self.chart.problem.robot.function("joint_points")(q)[:, ELBOW]
        return ca.Function("elbow", [q], [place, ca.jacobian(place, q)])

    @property
    def length(self) -> float:
        """From shoulder over elbow to wrist [m]."""
        points = self.chart.problem.robot.joint_points(self.start)
        return float(sum(np.linalg.norm(np.diff(points[[SHOULDER, ELBOW, WRIST]], axis=0), axis=1)))


def made_up(seconds: float = SECONDS) -> Array:
    """A recording of both arms, (T, 2, 3, 3): shoulder, elbow and wrist, made of sines."""
    t = np.arange(0.0, seconds, PERIOD)
    arms = []
    for side, phase in ((1.0, 0.0), (-1.0, 1.3)):
        swing, lift, turn, bend = (
            centre + size * (np.sin(2 * np.pi * t / period + phase) - np.sin(phase))
            for centre, size, period in ((0.2, 0.15, 5.0), (0.3, 0.12, 7.0), (0.5, 0.35, 3.1), (1.5, 0.15, 4.3))
        )
        down = np.stack([np.sin(swing), side * np.sin(lift), -np.sqrt(1 - np.sin(swing) ** 2 - np.sin(lift) ** 2)], 1)
        front = np.cross(np.cross(down, [1.0, 0.0, 0.0]), down)
        front /= np.linalg.norm(front, axis=1, keepdims=True)
        inwards = front * np.cos(turn)[:, None] + np.cross(down, front) * (side * np.sin(turn))[:, None]
        elbow = UPPER_ARM * down
        wrist = elbow + FOREARM * (np.cos(bend)[:, None] * down + np.sin(bend)[:, None] * inwards)
        arms.append(np.stack([np.zeros_like(elbow), elbow, wrist], axis=1))
    return np.stack(arms, axis=1)


def wishes_of(arm: Arm, points: Array) -> tuple[Array, Array]:
    """What the arm is to do: task values (T, m) and elbows (T, 3) [m], for points (T, 3, 3) of a person's arm."""
    moved = points - points[:, :1]
    moved = (moved - moved[0]) * arm.length / np.linalg.norm(np.diff(points[0], axis=0), axis=1).sum()
    x = np.tile(arm.chart.x(arm.start), (len(points), 1))
    x[:, :3] += moved[:, 2]
    return x, np.array(arm.elbow(arm.start)[0]).ravel() + moved[:, 1]


def follow(arm: Arm, x: Array, elbows: Array) -> tuple[Array, Array]:
    """Joints (T, n) that follow task values and elbows, and the time of each tick [s]."""
    chart, q, found, took = arm.chart, arm.start, [], []
    for target, elbow in zip(x, elbows, strict=True):
        start = time.perf_counter()
        place, jacobian = (np.array(value) for value in arm.elbow(q))
        along = jacobian @ np.linalg.inv(chart.jacobian(q))[:, chart.m]  # of the elbow with xi, where x stays
        step = along @ (elbow - place.ravel()) / (along @ along)
        xi = chart.xi(q)[0] + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        solution = chart.solve(np.r_[target, xi], q, inside=True)
        if solution.status[0] in (oc.InverseStatus.FOUND, oc.InverseStatus.NEAREST):
            q = solution.q[0]
        found.append(q)
        took.append(time.perf_counter() - start)
    return np.array(found), np.array(took)


def least_error(arm: Arm, q: Array, elbow: Array) -> float:
    """Distance of a place from the elbow's way along the self-motion through q, within the domain [m]."""
    curve = arm.chart.self_motion(q, step=0.02).q
    places = np.array(arm.elbow.map(len(curve))(curve.T)[0]).T
    first, along = places[:-1], np.diff(places, axis=0)
    share = ((elbow - first) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-18)
    nearest = first + np.clip(share, 0, 1)[:, None] * along
    return float(np.linalg.norm(nearest - elbow, axis=1).min())


def judge(arm: Arm, x: Array, elbows: Array, q: Array, took: Array) -> dict[str, float]:
    """The figures of an arm."""
    errors = np.linalg.norm(np.array(arm.elbow.map(len(q))(q.T)[0]).T - elbows, axis=1)
    some = np.arange(10, len(q), 25)
    least = np.array([least_error(arm, q[k], elbows[k]) for k in some])
    return {
        "travel_mm": float(1e3 * np.linalg.norm(np.ptp(elbows, axis=0))),
        "error_mm": float(1e3 * np.sqrt((errors[some] ** 2).mean())),
        "least_error_mm": float(1e3 * np.sqrt((least**2).mean())),
        "hand_error_m": float(np.abs(arm.chart.x(q) - x).max()),
        "fastest_rad_s": float(np.abs(np.diff(q, axis=0)).max() / PERIOD),
        "tick_ms": float(1e3 * np.median(took)),
    }


def talos(side: str, folder: Path) -> Arm:
    """An arm of Talos, its torso locked; the chart is fitted once and kept in a folder."""
    path = folder / f"talos_{side}.orthocas"
    if not path.exists():
        name = "talos_data/robots/talos_reduced.urdf"
        urdf = next(file for file in files("example-robot-data") or [] if str(file).endswith(f"robots/{name}"))
        lock = {"torso_1_joint": 0.0, "torso_2_joint": 0.0}
        robot = oc.Robot.from_urdf(str(urdf.locate()), f"gripper_{side}_base_link", lock)
        oc.fit_wide(robot, oc.Task.pose(robot)).chart.save(path)
    return Arm(oc.load(path), np.array(STARTS[side]))


def main(out: Path = Path("out"), quick: bool = False, points: Path | None = None) -> dict[str, dict[str, float]]:
    """Follow a recording with one or two arms, and print the figures of each.

    Args:
        out: folder of the fitted charts.
        quick: one arm with a ready chart, 3 s.
        points: a recording, see above.

    Returns:
        For each arm: how far the elbow is asked to move, its error rms and the least possible, the largest error of the
        hand, the fastest joint, and the median time of a tick.
    """
    out.mkdir(parents=True, exist_ok=True)
    recording = made_up(3.0 if quick else SECONDS) if points is None else read(points)
    if quick:
        arms = {"left": Arm(oc.charts.load("baxter-left-wide"), np.array(STARTS["baxter"]))}
    else:
        arms = {side: talos(side, out) for side in ("left", "right")}
    found = {}
    print(
        "| arm | elbow asked to move by [mm] | off, rms [mm] | least possible [mm] | hand off [m] "
        "| fastest joint [rad/s] | tick [ms] |\n| --- | --- | --- | --- | --- | --- | --- |"
    )
    for k, (side, arm) in enumerate(arms.items()):
        wishes = wishes_of(arm, recording[:, k])
        found[side] = judge(arm, *wishes, *follow(arm, *wishes))
        travel, error, least, hand, fastest, tick = found[side].values()
        print(f"| {side} | {travel:.0f} | {error:.2f} | {least:.2f} | {hand:.0e} | {fastest:.1f} | {tick:.1f} |")
    return found


def read(path: Path) -> Array:
    """A recording of both arms, (T, 2, 3, 3)."""
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    if rows.shape[1] != 18 or not np.isfinite(rows).all():
        raise SystemExit(f"{path}: rows have {rows.shape[1]} numbers, expected 18 finite ones")
    return rows.reshape(-1, 2, 3, 3)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--points", type=Path, help="a recording, 18 columns")
    arguments = parser.parse_args()
    main(arguments.out, arguments.quick, arguments.points)
