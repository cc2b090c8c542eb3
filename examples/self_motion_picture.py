"""The picture of the README: a Panda, its hand held, and everything else that can move (10 s; file: extra [test])."""

import argparse
from importlib.metadata import files
from pathlib import Path

import numpy as np
from PIL import Image
from rendering import Picture, fan_picture

import orthocas as oc
from orthocas.viewer.looks import read_urdf_look

POSTURE = (0.0, -0.5, 0.0, -2.2, 0.0, 1.7, np.pi / 4)  #: of the solid arm [rad]
WIDTH, HEIGHT, MARGIN = 1000, 780, 16  #: [pixels]
POSTURES = 61  #: along the curve


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Follow the self-motion of the pose to the joint limits, and draw it.

    Args:
        out: folder for the picture.
        quick: a small picture, without meshes.

    Returns:
        How far the hand moves [m, rad] and the elbow [m], and the largest range of a joint [rad].
    """
    out.mkdir(parents=True, exist_ok=True)
    file = robot_file("panda_description/urdf/panda.urdf")
    robot = oc.Robot.from_urdf(file, "panda_hand")
    q = np.array(POSTURE)
    domain = oc.Box(q, np.minimum(robot.upper - q, q - robot.lower))
    chart = oc.fit(oc.Problem(robot, oc.Task.pose(robot), domain=domain), oc.Linear()).chart
    motion = chart.self_motion(q)
    curve = motion.q[np.round(np.linspace(0, len(motion.q) - 1, POSTURES)).astype(int)]
    size = (WIDTH // 4, HEIGHT // 4) if quick else (WIDTH, HEIGHT)
    look = None if quick else read_urdf_look(file, robot.tree).look
    picture = fan_picture(robot, q, curve, *size, look)
    save_trimmed(picture, out / "self_motion.png")
    elbows = robot.joint_points(curve)
    return {
        "hand_moves": float(np.abs(chart.x(curve) - chart.x(q)).max()),
        "elbow_moves_m": float(np.ptp(elbows, axis=0).max()),
        "largest_range_rad": float(np.ptp(curve, axis=0).max()),
    }


def robot_file(path: str, package: str = "example-robot-data") -> Path:
    """A robot file of a package."""
    for entry in files(package) or []:
        if str(entry).endswith(f"/{path}"):
            return Path(str(entry.locate())).resolve()
    raise FileNotFoundError(f"{path} of {package} (pip install orthocas[test])")


def save_trimmed(picture: Picture, path: Path) -> None:
    """Save a picture without its empty boundaries, except for a margin."""
    whole = Image.fromarray(picture)
    left, upper, right, lower = whole.getchannel("A").getbbox() or (0, 0, *whole.size)
    whole.crop((left - MARGIN, upper - MARGIN, right + MARGIN, lower + MARGIN)).save(path, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    print(main(arguments.out, arguments.quick))
