"""The film of the README: one chart for a whole branch of a Panda, beside a pseudo-inverse (2 min; file: extra [test]).

First the hand holds its pose, and the coordinate xi swings the elbow from one end of its range to the other. Then the
hand draws the same circle again and again. With xi held the joints come back; least-norm steps leave them elsewhere.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rendering import Camera, Layer, on_ground, render
from scipy.spatial.transform import Rotation
from self_motion_picture import POSTURE, robot_file

import orthocas as oc
from orthocas.viewer.looks import BodyPoses, Look, Solid, build_capsule, build_stick_arm, read_urdf_look

RADIUS, LOOPS, STEPS = 0.1, 4, 400  #: of the circle [m]; circles; steps of each
SWING, LOOP, PAUSE = 36, 16, 8  #: pictures of the swing, of each circle, and at rest after it
SIZE, BARE, COLOURS = (340, 360), 40, 40  #: of a panel [pixels]; rows for the caption; of the film
SECONDS = 0.1  #: between pictures
CAMERA = Camera((2.9, -1.9, 1.35), (0.2, 0.0, 0.41), 15.5)
TRACE = (217, 95, 2)
GROUNDS = {"wide_chart": (255, 255, 255), "wide_chart_dark": (13, 17, 23)}  #: of light pages and of dark ones


def main(out: Path, quick: bool = False) -> dict[str, float]:
    """Compute both motions, and draw the film for light and for dark pages.

    Args:
        out: folder for `wide_chart.gif` and `wide_chart_dark.gif`.
        quick: small films of rods.

    Returns:
        How far the hand moves while the elbow swings [m, rad], how far the elbow moves [m], and how far the joints are
        from the start after all circles, with xi held and with the pseudo-inverse [rad].
    """
    out.mkdir(parents=True, exist_ok=True)
    chart = oc.charts.load("panda-wide")
    q, robot = np.array(POSTURE), chart.problem.robot
    swung, held, drifted = swing(chart, q), circles(chart, q), least_norm(chart, q)
    look = build_stick_arm(robot.tree)
    if not quick:
        look = read_urdf_look(robot_file("panda_description/urdf/panda.urdf"), robot.tree).look
    draw(out, robot, look, swung, held, drifted, 8 if quick else 1)
    return {
        "hand_moves": float(np.abs(chart.x(swung) - chart.x(q)).max()),
        "elbow_moves_m": float(np.ptp(robot.joint_points(swung), axis=0).max()),
        "left_by_chart_rad": float(np.abs(held[-1] - q).max()),
        "left_by_pseudo_inverse_rad": float(np.abs(drifted[-1] - q).max()),
    }


def swing(chart: oc.Chart, q: np.ndarray) -> np.ndarray:
    """From q to both ends of the range of xi at this pose, and back, (N, n)."""
    interval = chart.xi_range(q)[chart.labels[-1]]
    low, high = interval.low, interval.high
    phi = chart.phi(q)
    middle, half = (high + low) / 2, 0.95 * (high - low) / 2
    first = np.arcsin(np.clip((phi[-1] - middle) / half, -1, 1))
    wanted = np.tile(phi, (6 * SWING, 1))
    wanted[:, -1] = middle + half * np.sin(first + np.linspace(0, 2 * np.pi, len(wanted)))
    return tracked(chart, q, wanted)[:: len(wanted) // SWING]


def circle(chart: oc.Chart, q: np.ndarray) -> np.ndarray:
    """Task values of all circles, at constant orientation, (N, m)."""
    angle = 2 * np.pi * np.arange(1, LOOPS * STEPS + 1) / STEPS
    x = np.tile(chart.x(q), (len(angle), 1))
    x[:, 1] += RADIUS * np.sin(angle)
    x[:, 0] -= RADIUS * (1 - np.cos(angle))
    return x


def circles(chart: oc.Chart, q: np.ndarray) -> np.ndarray:
    """All circles with xi held, (N, n)."""
    x = circle(chart, q)
    return tracked(chart, q, np.hstack([x, np.tile(chart.xi(q), (len(x), 1))]))


def tracked(chart: oc.Chart, q: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Joint positions along phi (N, n), from q on."""
    tracker = chart.tracker(q)
    return np.array([q, *(tracker.step(wanted) for wanted in phi)])


def least_norm(chart: oc.Chart, q: np.ndarray) -> np.ndarray:
    """All circles by steps of least norm, (N, n)."""
    task, found = chart.problem.task, [q]
    for wanted in circle(chart, q):
        now = found[-1]
        for _ in range(3):
            J = task.batched_jacobian(now[None])[0].reshape(task.m, -1)
            now = now + np.linalg.pinv(J) @ (wanted - task.batched(now[None])[0].ravel())
        found.append(now)
    return np.array(found)


def draw(
    out: Path, robot: oc.Robot, look: Look, swung: np.ndarray, held: np.ndarray, drifted: np.ndarray, smaller: int
) -> None:
    """Write the films."""
    size = (SIZE[0] // smaller, SIZE[1] // smaller)
    at = [min(round(k * STEPS / LOOP), len(held) - 1) for k in range(1, LOOPS * LOOP + 1)]
    rows = [(a, swung[0], "xi swings the elbow, the hand stays", "") for a in swung]
    for k in at:
        back, off = "", ""
        if k % STEPS == 0:
            back, off = ": the joints are back", f": {np.abs(drifted[k] - drifted[0]).max():.2f} rad off"
        row = (held[k], drifted[k], f"xi held{back}", f"least norm{off}")
        rows += [row] * (1 + PAUSE * (k % STEPS == 0))
    hand = robot.tip_position(held[: STEPS + 1])
    memory: dict[bytes, np.ndarray] = {}
    for left, right, *_ in rows[::smaller]:
        for q in (left, right):
            if q.tobytes() not in memory:
                memory[q.tobytes()] = panel(robot, look, q, held[0], hand, size)
    for name, ground in GROUNDS.items():
        frames = [
            captioned([on_ground(memory[q.tobytes()], ground) for q in (left, right)], words, ground)
            for left, right, *words in rows[::smaller]
        ]
        palette = Image.fromarray(np.vstack([np.asarray(frame) for frame in frames[::9]])).quantize(COLOURS)
        first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
        path, pause = out / f"{name}.gif", round(1000 * SECONDS)
        first.save(path, save_all=True, append_images=rest, duration=pause, loop=0, optimize=True)


def panel(
    robot: oc.Robot, look: Look, q: np.ndarray, start: np.ndarray, hand: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """The arm at q, a ghost of it at the start, and the circle of the hand; (height, width, 4)."""
    ring = [build_capsule(a, b, (0.004, 0.004), TRACE, 6) for a, b in zip(hand[:-10:10], hand[10::10], strict=True)]
    layers = [Layer([*placed(robot, look, q), *ring]), Layer(placed(robot, look, start), 0.25)]
    return render(layers, CAMERA, *size)


def placed(robot: oc.Robot, look: Look, q: np.ndarray) -> list[Solid]:
    """The solids of the bodies at q."""
    positions, quaternions = BodyPoses(robot.tree)(q[None])
    turns = Rotation.from_quat(quaternions[0], scalar_first=True).as_matrix()
    places = zip(look, turns, positions[0], strict=True)
    return [solid.move(turn, place) for solids, turn, place in places for solid in solids]


def captioned(panels: list[np.ndarray], words: list[str], ground: tuple[int, int, int]) -> Image.Image:
    """Panels side by side, each with words below."""
    row = np.hstack(panels)
    below = np.broadcast_to(np.array(ground, dtype=np.uint8), (BARE, *row.shape[1:]))
    picture = Image.fromarray(np.vstack([row, below]))
    ink = (30, 30, 30) if sum(ground) > 384 else (220, 224, 230)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(19)
    for k, text in enumerate(words):
        pen.text((k * panels[0].shape[1] + 16, panels[0].shape[0] + 8), text, fill=ink, font=font)
    return picture


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    for name, value in main(arguments.out, arguments.quick).items():
        print(f"{name}: {value:.3g}")
