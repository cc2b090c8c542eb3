"""Which positions of a wide branch a ClearBox takes for clear, against a frame Jacobian from Pinocchio."""

import numpy as np
import pinocchio as pin
from benchmark import run, table
from numpy.typing import NDArray

import orthocas as oc
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.display import percent

Numbers = NDArray[np.float64]
HEADER = (
    "| rows that judge | share of the box kept | truly clear positions left out | unclear ones among those kept |\n"
    "| --- | --- | --- | --- |"
)
BOUND, MARGIN = 0.1, np.radians(5)  # relative singular value; distance from the joint limits [rad]
SIGNS = {1: 1, 3: -1, 5: 1}  # the branch: q2 > 0, q4 < 0, q6 > 0
WORDS = {"x": "J_x, as in older chart files", "frame": "the frame Jacobian"}


def branch() -> oc.Box:
    """The joint limits of the 7-DoF arm less 5 degrees, cut where signs change."""
    robot = oc.problems.get("iiwa").robot
    low, high = robot.lower + MARGIN, robot.upper - MARGIN
    for joint, sign in SIGNS.items():
        low[joint], high[joint] = (0.0, high[joint]) if sign > 0 else (low[joint], 0.0)
    return oc.Box((low + high) / 2, (high - low) / 2)


def true_values(robot: oc.Robot, box: oc.Box, points: Numbers) -> Numbers:
    """Relative singular values of Pinocchio's geometric Jacobian in world axes, (N,); lengths are means over the box.

    Both are computed without the package: rows of position over their root mean square, and so for the orientation.
    """
    model = pinocchio_model(robot)
    data = model.createData()
    tip = model.getFrameId("tip")

    def jacobians(at: Numbers) -> Numbers:
        return np.array([pin.computeFrameJacobian(model, data, q, tip, pin.LOCAL_WORLD_ALIGNED) for q in at])

    drawn = np.random.default_rng(11).uniform(-1, 1, (20_000, robot.n))
    J = jacobians(box.centre + box.half_width * drawn)
    lengths = np.sqrt((J.reshape(-1, 2, 3, robot.n) ** 2).sum(axis=3).mean(axis=(0, 2)))
    values: Numbers = np.linalg.svd(jacobians(points) / np.repeat(lengths, 3)[:, None], compute_uv=False)[:, -1]
    return values


def pinocchio_model(robot: oc.Robot) -> pin.Model:
    """The chain of a robot with revolute joints as a Pinocchio model with the frame 'tip'."""
    tree, model = robot.tree, pin.Model()
    ids: list[int] = []
    for k, name in enumerate(tree.joint_names):
        parent = ids[tree.parents[k]] if tree.parents[k] >= 0 else 0
        place = pin.SE3(np.array(tree.rotations[k]), np.array(tree.translations[k]))
        ids.append(model.addJoint(parent, pin.JointModelRZ(), place, name))
    place = pin.SE3(np.array(tree.tip_rotation), np.array(tree.tip_translation))
    model.addFrame(pin.Frame("tip", ids[tree.tip_parent], 0, place, pin.FrameType.OP_FRAME))
    return model


def main(quick: bool = False) -> list[str]:
    """Both rows; `quick` takes few samples."""
    robot, box = oc.problems.get("iiwa").robot, branch()
    points = sample_uniform(box, 500 if quick else 20_000, 1)
    clear = true_values(robot, box, points) > BOUND
    return table(HEADER, (row(rows, robot, box, points, clear) for rows in ("x", "frame")))


def row(rows: str, robot: oc.Robot, box: oc.Box, points: Numbers, clear: NDArray[np.bool_]) -> str:
    """What a ClearBox of the pose keeps, and what it gets wrong."""
    kept = oc.ClearBox(box, oc.Task.pose(robot), BOUND, rows=rows).contains(points)
    missed, wrong = (clear & ~kept).sum() / clear.sum(), (kept & ~clear).sum() / kept.sum()
    return f"| {WORDS[rows]} | {percent(kept.mean())} | {percent(missed, fault=True)} | {percent(wrong, fault=True)} |"


if __name__ == "__main__":
    run(main, __doc__)
