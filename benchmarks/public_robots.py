"""How many public robot files open without a second try: `Robot.from_urdf(FILE)`, with no other argument.

The files are those of github.com/Daniella1/urdf_files_dataset, at commit 81f4cdac: arms, hands, grippers, legged and
mobile robots, from ROS packages, Drake, Matlab and manufacturers. Their folder is the argument. Tips of files that
Pinocchio reads as they are must be where Pinocchio places them.
"""

import argparse
import logging
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin

import orthocas as oc
from orthocas.errors import OrthocasError, TipWarning


def main(folder: Path) -> dict[str, float]:
    """Open all files, print why some do not open; numbers by name."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore", TipWarning)
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() == ".urdf")
    opened, apart = 0, []
    for path in files:
        try:
            robot = oc.Robot.from_urdf(path)
            opened += 1
        except OrthocasError as error:
            print(f"{path.relative_to(folder)}: {str(error).removeprefix(str(path))}")
            continue
        distance = find_distance(path, robot)
        apart += [] if distance is None else [distance]
    print(f"{opened} of {len(files)} files open; {len(apart)} tips are at most {max(apart):.0e} from Pinocchio's")
    return {"opened": opened, "files": len(files), "compared": len(apart), "apart": max(apart)}


def find_distance(path: Path, robot: oc.Robot) -> float | None:
    """Largest difference of the tip's pose and Pinocchio's, other joints at 0 or the nearest limit; None if unread."""
    try:
        model = pin.buildModelFromUrdf(str(path))
    except (ValueError, RuntimeError):
        return None
    if not all(map(model.existJointName, robot.joint_names)) or not model.existFrame(robot.tips[0]):
        return None
    q, full = robot.sample(1, seed=3)[0], pin.neutral(model)
    for joint in model.joints[1:]:
        if joint.nq == 1:
            low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
            full[joint.idx_q] = np.clip(0.0, low, high)
    tree = robot.tree
    for name, value in zip(tree.body_joints, tree.expand(q), strict=True):
        joint = model.joints[model.getJointId(name)]
        full[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else value
    data = model.createData()
    pin.framesForwardKinematics(model, data, full)
    places = [place for frame, place in zip(model.frames, data.oMf, strict=True) if frame.name == robot.tips[0]]
    return min(float(np.abs(place.homogeneous - robot.pose(q)).max()) for place in places)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="a checkout of the collection")
    main(parser.parse_args().folder)
