"""Make the ready charts of `oc.charts`: fit, proof, card and picture of each (about 12 min).

Robot files come with the extra [test], and that of Kinova's Gen3 with `pip install --no-deps robosuite==1.5.2`.

Each chart is made by the commands on its card. Charts whose commands have not changed are kept, so the script goes on
where it was stopped. `python examples/ready_charts.py NAME ...` makes some again.
"""

import shlex
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rendering import fan_picture, widest_coordinate
from self_motion_picture import robot_file, save_trimmed

import orthocas as oc
from orthocas.bases import cyclic_joints
from orthocas.charts import Card, Model
from orthocas.charts.chart_file import fingerprint
from orthocas.charts.self_motion import fan_along
from orthocas.tools.display import percent
from orthocas.viewer.looks import read_urdf_look

ROOT = Path(__file__).parent.parent
DATA = ROOT / "orthocas" / "charts" / "data"
PICTURES = ROOT / "docs" / "figures" / "charts"
SAMPLES, SEED = 100_000, 1  #: of the quality on the cards
WIDTH, HEIGHT, POSTURES = 420, 420, 61  #: of the pictures


@dataclass(frozen=True)
class Arm:
    """An arm: where its file lies in a package (a word: the arm of a named problem), and whose it is."""

    robot: str
    file: str
    options: str
    upstream: str
    licence: str
    holder: str
    package: str = "example-robot-data"

    @property
    def path(self) -> Path | None:
        """The robot file; None for a named problem."""
        return robot_file(self.file, self.package) if Path(self.file).suffix else None

    @property
    def model(self) -> Model:
        """What the cards say of the robot."""
        package = "orthocas" if self.path is None else f"{self.package} {metadata.version(self.package)}"
        file = "iiwa7_r800.urdf" if self.path is None else Path(self.file).name
        return Model(self.robot, file, package, self.upstream, self.licence, self.holder)


GITHUB = "https://github.com"
APACHE, BSD = "Apache-2.0", "BSD-3-Clause"
ARMS = {
    "iiwa7": Arm(
        "KUKA LBR iiwa 7 R800", "iiwa", "", f"{GITHUB}/lbr-stack/lbr_fri_ros2_stack", APACHE, "the authors of lbr-stack"
    ),
    "panda": Arm(
        "Franka Emika Panda",
        "panda_description/urdf/panda.urdf",
        "--tip panda_hand",
        f"{GITHUB}/frankaemika/franka_ros",
        APACHE,
        "Franka Emika GmbH",
    ),
    "xarm7": Arm(
        "UFACTORY xArm 7",
        "xarm_description/urdf/xarm7.urdf",
        "--tip link_eef",
        f"{GITHUB}/xArm-Developer/xarm_ros2",
        BSD,
        "UFACTORY Inc.",
    ),
    "j2s6s200": Arm(
        "Kinova JACO 2 (j2s6s200)",
        "kinova_description/robots/kinova.urdf",
        "--tip j2s6s200_end_effector",
        f"{GITHUB}/Kinovarobotics/kinova-ros",
        BSD,
        "Kinova Robotics inc.",
    ),
    "ur5": Arm(
        "Universal Robots UR5",
        "ur_description/urdf/ur5_robot.urdf",
        "--tip tool0",
        f"{GITHUB}/ros-industrial/universal_robot",
        BSD,
        "the authors of ur_description",
    ),
    "ur10": Arm(
        "Universal Robots UR10",
        "ur_description/urdf/ur10_robot.urdf",
        "--tip tool0",
        f"{GITHUB}/ros-industrial/universal_robot",
        BSD,
        "the authors of ur_description",
    ),
    "z1": Arm(
        "Unitree Z1",
        "z1_description/urdf/z1.urdf",
        "--tip link06",
        f"{GITHUB}/unitreerobotics/unitree_ros",
        "MPL-2.0",
        "Unitree Robotics",
    ),
    "tiago-pro-left": Arm(
        "PAL TIAGo Pro, torso and left arm",
        "tiago_pro_description/robots/tiago_pro.urdf",
        "--tip arm_left_tool_link",
        "https://pal-robotics.com/robot/tiago-pro",
        APACHE,
        "PAL Robotics S.L.",
    ),
    "baxter-left": Arm(
        "Rethink Baxter, left arm",
        "baxter_description/urdf/baxter.urdf",
        "--tip left_gripper_base_link",
        f"{GITHUB}/RethinkRobotics/baxter_common",
        BSD,
        "Rethink Robotics",
    ),
    "pr2-left": Arm(
        "Willow Garage PR2, torso and left arm",
        "pr2_description/urdf/pr2.urdf",
        "--tip l_gripper_tool_frame",
        f"{GITHUB}/pr2/pr2_common",
        BSD,
        "Willow Garage, Inc.",
    ),
    "gen3": Arm(
        "Kinova Gen3",
        "robots/kinova3/robot.xml",
        "--tip right_hand",
        f"{GITHUB}/ARISE-Initiative/robosuite",
        "MIT",
        "Stanford Vision and Learning Lab and UT Robot Perception and Learning Lab",
        "robosuite",
    ),
    "g1-left": Arm(
        "Unitree G1, left arm",
        "g1_description/urdf/g1_29dof_rev_1_0.urdf",
        "--tip left_rubber_hand --lock waist_yaw_joint=0 --lock waist_roll_joint=0 --lock waist_pitch_joint=0",
        f"{GITHUB}/unitreerobotics/unitree_ros/tree/master/robots/g1_description",
        BSD,
        "Unitree Robotics",
    ),
    "romeo-left": Arm(
        "Aldebaran Romeo, left arm",
        "romeo_description/urdf/romeo.urdf",
        "--tip l_gripper --lock TrunkYaw=0",
        f"{GITHUB}/ros-aldebaran/romeo_robot",
        BSD,
        "Aldebaran Robotics",
    ),
    "centauro-left": Arm(
        "IIT Centauro, torso and arm 1",
        "centauro_description/urdf/centauro.urdf",
        "--tip arm1_8",
        f"{GITHUB}/ADVRHumanoids/iit-centauro-ros-pkg",
        APACHE,
        "Istituto Italiano di Tecnologia",
    ),
}
WIDEST = "--domain auto --param polynomial:4:cyclic"  #: a leak of at most 8 deg, a conditioning of at least 0.2
TIGHT = f"{WIDEST} --leak-deg 5 --conditioning 0.4"
#: the paper's angles: with angles in the metric, domains are larger and one-to-one boxes narrower
POSE = "--task pose --domain auto --leak-deg 5 --param polynomial:4:cyclic --angles paper"
BRANCH = "--task pose --domain branch"
CONTROL = f"{BRANCH} --metric inertia"  #: for torques
RECIPES = {  #: arm and options of `orthocas fit`
    "iiwa7-position": ("iiwa7", WIDEST),
    "iiwa7-pose": ("iiwa7", POSE),
    "panda-position": ("panda", f"--home default {WIDEST}"),
    "panda-pose": ("panda", f"--home default {POSE}"),
    "xarm7-position": ("xarm7", WIDEST),
    "xarm7-pose": ("xarm7", POSE),
    "j2s6s200-position": ("j2s6s200", WIDEST),
    "ur5-position": ("ur5", WIDEST),
    "ur10-position": ("ur10", WIDEST),
    "z1-position": ("z1", WIDEST),
    "baxter-left-position": ("baxter-left", WIDEST),
    "baxter-left-pose": ("baxter-left", POSE),
    "pr2-left-position": ("pr2-left", WIDEST),
    "pr2-left-pose": ("pr2-left", POSE),
    "tiago-pro-left-position": ("tiago-pro-left", TIGHT),
    "tiago-pro-left-pose": ("tiago-pro-left", POSE),
    "iiwa7-wide": ("iiwa7", BRANCH),
    "panda-wide": ("panda", f"--home default {BRANCH}"),
    "xarm7-wide": ("xarm7", BRANCH),
    "baxter-left-wide": ("baxter-left", BRANCH),
    "pr2-left-wide": ("pr2-left", BRANCH),
    "tiago-pro-left-wide": ("tiago-pro-left", BRANCH),
    "gen3-wide": ("gen3", BRANCH),
    "g1-left-wide": ("g1-left", BRANCH),
    "romeo-left-wide": ("romeo-left", BRANCH),
    "centauro-left-wide": ("centauro-left", BRANCH),
    "iiwa7-wide-inertia": ("iiwa7", CONTROL),
    "panda-wide-inertia": ("panda", f"--home default {CONTROL}"),
    "xarm7-wide-inertia": ("xarm7", CONTROL),
    "baxter-left-wide-inertia": ("baxter-left", CONTROL),
    "pr2-left-wide-inertia": ("pr2-left", CONTROL),
    "gen3-wide-inertia": ("gen3", CONTROL),
    "g1-left-wide-inertia": ("g1-left", CONTROL),
    "romeo-left-wide-inertia": ("romeo-left", CONTROL),
}


def main(names: list[str], data: Path = DATA, pictures: Path = PICTURES) -> dict[str, Card]:
    """Make the charts of some names; of none: those that are missing, or whose recipe has changed.

    Args:
        names: ready charts.
        data: folder for charts and cards.
        pictures: folder for pictures.

    Returns:
        The cards of these charts.
    """
    data.mkdir(parents=True, exist_ok=True)
    pictures.mkdir(parents=True, exist_ok=True)
    for name in names or RECIPES:
        if names or not up_to_date(name, data):
            print(f"{make(name, data)}\n", flush=True)
        if names or not (pictures / f"{name}.png").exists():
            draw(name, data, pictures / f"{name}.png")
    return {name: Card.from_json((data / f"{name}.json").read_text(encoding="utf-8")) for name in names or RECIPES}


def draw(name: str, data: Path, path: Path) -> None:
    """Draw the arm along the coordinate that moves it farthest."""
    chart, file = oc.load(data / f"{name}.orthocas"), ARMS[RECIPES[name][0]].path
    robot, centre = chart.problem.robot, chart.problem.domain.centre
    look = read_urdf_look(file, robot.tree).look if file is not None and file.suffix == ".urdf" else None
    curve = fan_along(chart, centre, widest_coordinate(chart, centre)).spread(POSTURES)
    save_trimmed(fan_picture(robot, centre, curve, WIDTH, HEIGHT, look), path)


def commands(name: str) -> tuple[str, ...]:
    """The commands that make a chart."""
    arm, options = RECIPES[name]
    known = ARMS[arm]
    words = " ".join(filter(None, (Path(known.file).name, known.options, options)))
    fit = f"orthocas fit {words} --out {name}.orthocas"
    return (fit,) if is_wide(name) else (fit, f"orthocas certify {name}.orthocas")


def is_wide(name: str) -> bool:
    """Whether a chart holds on a whole branch. Its domain keeps folds out; a proof would be a megabyte."""
    return BRANCH in RECIPES[name][1]


def table(data: Path = DATA) -> list[str]:
    """The rows of the tables in docs/reference/ready_charts.md: charts with a proof, then wide ones."""
    rows = []
    for name in RECIPES:
        card = Card.from_json((data / f"{name}.json").read_text(encoding="utf-8"))
        if card.branch:
            quality = card.quality
            rows.append(
                f"| `{name}` | {quality['n']}, {quality['m']}, {quality['r']} | {card.branch} "
                f"| {percent(card.regular_share, 2)} | {quality['leak_deg']['rms']:.0f} "
                f"| {quality['conditioning']['mean']:.2f}, "
                f"{quality['conditioning']['p01']:.2f} | {card.model.licence} |"
            )
            continue
        quality, width = card.quality, np.round(card.half_width, 2)
        mutual = "-" if quality["r"] == 1 else f"{quality['mutual_angle_deg']['std']:.2f}"
        rows.append(
            f"| `{name}` | {quality['n']}, {quality['m']}, {quality['r']} | {quality['leak_deg']['rms']:.2f} "
            f"| {quality['task_angle_deg']['std']:.2f}, {mutual} "
            f"| {quality['conditioning']['mean']:.2f}, {quality['conditioning']['min']:.2f} "
            f"| {', '.join(f'{value:g}' for value in width)} | {card.proved_parts:,} | {card.model.licence} |"
        )
    return rows


def up_to_date(name: str, data: Path) -> bool:
    """Whether there is a chart that the present commands made."""
    path = data / f"{name}.json"
    return path.exists() and Card.from_json(path.read_text(encoding="utf-8")).commands == commands(name)


def make(name: str, data: Path) -> Card:
    """Fit, prove and judge a chart. Its files appear when everything is done, the card last."""
    known = ARMS[RECIPES[name][0]]
    with TemporaryDirectory() as folder:
        for line in commands(name):
            words = [
                str(known.path) if word == Path(known.file).name and known.path else word for word in shlex.split(line)
            ]
            subprocess.run([sys.executable, "-m", *words], cwd=folder, check=True, stdout=subprocess.PIPE)
        chart = oc.load(Path(folder) / f"{name}.orthocas")
    card = card_of(name, chart)
    chart.save(data / f"{name}.orthocas")
    (data / f"{name}.json").write_text(card.to_json(), encoding="utf-8")
    return card


def card_of(name: str, chart: oc.Chart) -> Card:
    """The card of a chart that is proved."""
    proof, domain, wide = chart.certificate, chart.problem.domain, is_wide(name)
    assert wide or (proof is not None and proof.proved)
    return Card(
        name=name,
        model=ARMS[RECIPES[name][0]].model,
        task=chart.problem.task.name,
        coordinates=chart.coordinates.label,
        joints=chart.problem.robot.joint_names,
        cyclic_joints=cyclic_joints(chart.problem),
        centre=tuple(domain.centre.tolist()),
        half_width=tuple(domain.half_width.tolist()),
        quality=oc.evaluate(chart, SAMPLES, SEED).as_dict(),
        proved_parts=0 if proof is None else proof.regular.proved_count,
        fingerprint=fingerprint(chart.problem, chart.coordinates),
        commands=commands(name),
        branch=str(chart.notes.get("branch", "")),
        regular_share=float(chart.notes.get("share of the branch", 1.0)),
    )


if __name__ == "__main__":
    main(sys.argv[1:])
