"""A planar arm follows a closed tool path past a post: xi held, and chosen by objective (5 s)."""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import orthocas as oc
from orthocas.paths import JointMotion
from orthocas.robots.collisions import Collisions

START = np.array([0.6, 0.8, 0.8])
RADIUS = 0.35  # of the tool path [m]
POST, POST_RADIUS = np.array([0.94, 1.88]), 0.12  # [m]
LINK_RADIUS, CLEARANCE = 0.04, 0.03  # [m]
COLOURS = {"hold": "#d95f02", "objective": "#1b9e77"}


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Follow the path in both ways, and draw arms and margins.

    Args:
        out: folder for the picture.
        quick: a coarser chart.

    Returns:
        Smallest distance from the post [m] and from the boundary of the domain [half-widths], and duration [s].
    """
    out.mkdir(parents=True, exist_ok=True)
    robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box(START, 0.75))
    chart = oc.fit(problem, oc.Polynomial(3 if quick else 5), samples=500 if quick else None).chart
    post = oc.obstacles.Capsule([*POST, -1.0], [*POST, 1.0], POST_RADIUS)
    around = robot.with_rods(LINK_RADIUS).collisions.with_scene(oc.Scene({"post": post}))
    angle = np.linspace(0, 2 * np.pi, 100)
    path = chart.x(START) + RADIUS * np.column_stack([np.cos(angle) - 1, np.sin(angle)])
    motions = {
        "hold": oc.follow(chart, path, velocity_limits=1.0),
        "objective": oc.follow(
            chart,
            path,
            "objective",
            velocity_limits=1.0,
            collisions=around,
            clearance=CLEARANCE,
        ),
    }
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 1.1))
    for ax, (name, motion) in zip(axes, motions.items(), strict=False):
        draw_arms(ax, robot, motion, name)
    draw_distances(axes[2], motions, around)
    figure.savefig(out / "follow_path.png", dpi=150)
    found: dict[str, float] = {}
    for name, motion in motions.items():
        found[f"{name}: distance from the post [m]"] = float(around.distance(motion.q).distance.min())
        found[f"{name}: distance from the boundary [half-widths]"] = motion.margins.boundary
        found[f"{name}: duration [s]"] = motion.duration
        found[f"{name}: joints away from their start at the end [rad]"] = float(
            np.abs(motion.q[-1] - motion.q[0]).max()
        )
    return found


def draw_arms(ax: Axes, robot: oc.Robot, motion: JointMotion, name: str) -> None:
    """Postures along the path, the path, and the post."""
    for row in robot.joint_points(motion.q[:: max(1, len(motion.q) // 14)]):
        ax.plot(row[:, 0], row[:, 1], color=COLOURS[name], lw=1.2, alpha=0.6, marker="o", ms=2)
    ax.plot(motion.x[:, 0], motion.x[:, 1], color="black", lw=1.5)
    ax.add_patch(Circle(tuple(POST), POST_RADIUS, color="#555555"))
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.set_title("xi held" if name == "hold" else "xi by objective")


def draw_distances(ax: Axes, motions: dict[str, JointMotion], around: Collisions) -> None:
    """Distance of the links from the post along the path."""
    for name, motion in motions.items():
        values = 1e3 * around.distance(motion.q).distance
        ax.plot(motion.s, values, color=COLOURS[name], label="xi held" if name == "hold" else "xi by objective")
    ax.axhline(1e3 * CLEARANCE, color="black", ls=":", lw=1)
    ax.text(0.01, 1e3 * CLEARANCE, "clearance", va="bottom", fontsize=8)
    ax.set_xlabel("place on the path s")
    ax.set_ylabel("distance of the links from the post [mm]")
    ax.legend()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for what, value in main(arguments.out, arguments.quick).items():
        print(f"{what:<60}{value:.4g}")
