"""Collision models against MuJoCo's own collision detection of the same files (2 minutes; `--quick`: 5 s).

MJCF files are those of robosuite (`pip install --no-deps robosuite==1.5.2`), URDF files those of example-robot-data,
read by MuJoCo's own reader. MuJoCo looks for contacts at random postures, and those of the checked pairs are compared
with distances below zero, pair by pair. Where the two differ, the pair may be nearer to touching than a micrometre by
both: pairs that are built to touch are such. Distances are those of `mj_geomDistance` between all geoms of a pair, and
those above a millimetre are compared.
"""

import itertools
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas.robots.collisions import Collisions
from orthocas.robots.urdf import find_robot_file
from orthocas.tools.checks import Array

MJCF = {"jaco": (), "panda": (), "sawyer": (), "spot_arm": (), "xarm7": (), "ur5e": (), "tiago": ()} | {
    "baxter": ("left_hand", "right_hand")  # tips
}
URDF = ("panda", "xarm7", "ur5", "ur10", "z1", "talos_left_arm")
CONTACTS, DISTANCES = 10_000, 200  # postures of each file
SHALLOW = 1e-6  # [m]
APART = 1e-3  # [m]: distances of pairs beyond this are compared
TOLERANCE, ITERATIONS = 1e-12, 500  # of MuJoCo's distances
HEADER = (
    "| robot | file | pairs | touching postures [%] | contacts | that differ | by more than 1 um "
    "| largest difference of distances [m] |\n|" + " --- |" * 8
)


class Peer:
    """MuJoCo's model of a robot file.

    Args:
        model: the compiled file.
        collisions: ours, of which pairs count.
    """

    def __init__(self, model: Any, collisions: Collisions) -> None:
        self.model, self.pairs = model, collisions.pairs
        model.opt.ccd_tolerance, model.opt.ccd_iterations = TOLERANCE, ITERATIONS
        self.data, self.ends = mujoco.MjData(model), np.zeros(6)
        self.places = [int(model.joint(name).qposadr[0]) for name in collisions.tree.joint_names]
        # Joints that our robot does not have are at zero, or at the limit closest to it.
        for k in range(model.njnt):
            low, high = model.jnt_range[k] if model.jnt_limited[k] else (-np.inf, np.inf)
            self.data.qpos[model.jnt_qposadr[k]] = np.clip(0.0, low, high)
        solid = [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
        numbers = {frozenset(pair): k for k, pair in enumerate(self.pairs)}
        #: pairs by numbers of their geoms
        self.owners = dict[frozenset[int], int]()
        for i, k in itertools.combinations(solid, 2):
            names = frozenset((self.name(i), self.name(k)))
            if names in numbers:
                self.owners[frozenset((i, k))] = numbers[names]

    def name(self, geom: int) -> str:
        """Of the body, or of a geom of the world."""
        body = int(self.model.geom_bodyid[geom])
        return str(self.model.body(body).name if body else self.model.geom(geom).name or "world")

    def place(self, q: Array) -> None:
        """Place all geoms at a posture (n,)."""
        self.data.qpos[self.places] = q
        mujoco.mj_kinematics(self.model, self.data)

    def find_contacts(self, q: Array) -> dict[tuple[int, int], float]:
        """Distances [m] of all contacts at postures (N, n), by the numbers of posture and pair."""
        found = dict[tuple[int, int], float]()
        for row, posture in enumerate(q):
            self.place(posture)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_collision(self.model, self.data)
            contacts = self.data.contact
            for (i, k), distance in zip(contacts.geom.tolist(), contacts.dist.tolist(), strict=True):
                if distance < 0 and (owner := self.owners.get(frozenset((i, k)))) is not None:
                    found[row, owner] = min(distance, found.get((row, owner), 0.0))
        return found

    def measure(self, q: Array) -> Array:
        """Distances of all pairs at postures (N, n), (N, K)."""
        found = np.full((len(q), len(self.pairs)), np.inf)
        for row, posture in zip(found, q, strict=True):
            self.place(posture)
            for geoms, owner in self.owners.items():
                row[owner] = min(
                    row[owner], mujoco.mj_geomDistance(self.model, self.data, *sorted(geoms), 10.0, self.ends)
                )
        return found


def load_mjcf(name: str) -> tuple[Any, Collisions]:
    """MuJoCo's model and ours, of a file of robosuite."""
    suite = find_spec("robosuite")
    assert suite is not None, "pip install --no-deps robosuite==1.5.2"
    assert suite.origin is not None
    path = Path(suite.origin).parent / "models" / "assets" / "robots" / name / "robot.xml"
    tips = MJCF[name]
    return mujoco.MjModel.from_xml_path(str(path)), oc.Robot.from_mjcf(
        path, **({"tips": tips} if tips else {})
    ).collisions


def load_urdf(name: str) -> tuple[Any, Collisions]:
    """MuJoCo's model and ours, of a file of example-robot-data."""
    path = find_robot_file(name)
    root = ElementTree.parse(path).getroot()
    extra = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    settings = {"fusestatic": "false", "strippath": "false", "balanceinertia": "true", "boundmass": "1e-6"}
    for key, value in (settings | {"boundinertia": "1e-9"}).items():
        extra.set(key, value)
    # Packages are folders beside each other.
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(mesh.get("filename")).replace("package://example-robot-data", str(path.parents[3])))
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    # Neighbours too, where our pairs have them.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    return model, oc.Robot.from_urdf(path).collisions


def compare(kind: str, name: str, count: int, found: dict[str, float]) -> str:
    """A row of the table."""
    model, collisions = (load_mjcf if kind == "MJCF" else load_urdf)(name)
    assert not collisions.missing
    peer, robot = Peer(model, collisions), oc.Robot(collisions.tree)
    q = robot.sample(count, seed=7)
    theirs = peer.find_contacts(q)
    rows = np.flatnonzero(~collisions.check_free(q))
    ours = {(int(rows[k]), int(pair)) for k, pair in np.argwhere(collisions.pair_distances(q[rows]) < 0)}
    # where only one sees a contact, both distances have to be small
    differ = sorted(ours ^ theirs.keys())
    depths = [
        max(abs(collisions.pair_distances(q[row])[pair]), abs(theirs.get((row, pair), peer.measure(q[[row]])[0, pair])))
        for row, pair in differ
    ]
    deep = [depth for depth in depths if depth > SHALLOW]
    some = robot.sample(count * DISTANCES // CONTACTS, seed=8)
    expected = peer.measure(some)
    apart = expected > APART
    largest = float(np.abs(collisions.pair_distances(some) - expected)[apart].max())
    touching = 100 * len(rows) / count
    found |= {f"{name}, {kind}, deep": len(deep), f"{name}, {kind}, apart [m]": largest}
    cells = len(collisions.pairs), f"{touching:.1f}", len(ours), len(differ), len(deep), f"{largest:.0e}"
    return f"| {name} | {kind} | {' | '.join(map(str, cells))} |"


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; the numbers of a test."""
    found = dict[str, float]()
    robots = [("MJCF", name) for name in MJCF] + [("URDF", name) for name in URDF]
    if quick:
        robots = [("URDF", "panda")]
    table(HEADER, (compare(kind, name, 500 if quick else CONTACTS, found) for kind, name in robots))
    return found


if __name__ == "__main__":
    run(main, __doc__)
