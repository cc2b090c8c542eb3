"""Ten questions that newcomers ask, each with the page and the sentence that answer it, and the site's search."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
SITE = DOCS.parent / "build" / "docs"  #: what `make docs` has built
ANSWERS = {
    "How do I keep the elbow up?": (
        "how-to/elbow",
        "Hold ξ while the hand moves, at the value it has where the elbow is up.",
    ),
    "Does it work with my mobile base?": (
        "how-to/mobile_base",
        "One chart then holds at every place and every heading.",
    ),
    "What if the robot is pushed out of the chart?": (
        "how-to/stops",
        "| the arm leaves the domain, or comes near a singular position | the catcher stops and holds it |",
    ),
    "How do I keep joint and velocity limits?": ("how-to/limits", "Generated C keeps them by itself"),
    "How do I drive it with a joystick?": ("how-to/joystick", "Add the joystick's speed to a **target** in (x, ξ)"),
    "Is there a plug-in for MoveIt?": ("how-to/coming_from", "orthocas has no plug-in of its own for MoveIt"),
    "My task needs all joints. What now?": (
        "how-to/tasks",
        "take as few components as the tool needs, because each one costs a coordinate",
    ),
    "What does pose:z mean?": ("how-to/tasks", "**`pose:z`** holds what `pose` holds: position and whole orientation."),
    "Which of the three angles matters?": (
        "explanation/angles",
        "`oc.fit` minimises the **leak**, the angle in the metric, by default for A = M",
    ),
    "Does one (x, ξ) mean one posture?": ("how-to/inverse", "**No fold is not one solution.**"),
}
SEARCHED = {
    "joint limits": "how-to/limits",
    "ROS": "how-to/robots",
    "ROS 2": "how-to/robots",
    "ROS2": "how-to/robots",
    "redundancy": "explanation/ideas",
    "Windows": "how-to/install",
    "mass matrix": "how-to/casadi_dynamics",
    "inverse dynamics": "how-to/casadi_dynamics",
    "pinocchio.casadi": "how-to/casadi_dynamics",
    "velocity limit": "how-to/limits",
    "elbow": "how-to/elbow",
    "null space": "how-to/coming_from",
    "dual arm": "how-to/two_arms",
    "IK": "how-to/inverse",
    "singularity": "how-to/domains",
    "gravity compensation": "how-to/robots",
    "torque": "explanation/control",
    "gripper": "tutorials/own_arm",
    "URDF": "tutorials/own_arm",
    "Jacobian": "how-to/casadi_dynamics",
    "stiffness": "explanation/control",
    "Panda": "how-to/ready_charts",
    "gravity": "how-to/robots",
    "manipulability": "how-to/manipulability",
    "C code": "how-to/c_code",
    "real time": "how-to/c_code",
    "MoveIt": "how-to/coming_from",
    "nullspace": "how-to/coming_from",
    "collision": "how-to/collisions",
    "collision avoidance": "how-to/collisions",
    "install": "how-to/install",
    "xacro": "tutorials/own_arm",
    "self-motion": "how-to/paths",
    "trajectory": "how-to/paths",
    "arm angle": "how-to/elbow",
    "redundancy resolution": "explanation/ideas",
    "mobile manipulator": "how-to/mobile_base",
    "Franka": "how-to/robots",
    "self-collision": "how-to/collisions",
    "forward kinematics": "how-to/casadi_dynamics",
    "jerk": "how-to/limits",
    "TCP": "tutorials/own_arm",
    "operational space": "explanation/projectors",
    "nullspace projector": "explanation/projectors",
    "elbow angle": "how-to/elbow",
    "secondary task": "how-to/elbow",
    "getting started": "tutorials/own_arm",
    "my own robot": "tutorials/own_arm",
    "visualize": "how-to/view",
    "rosbag": "how-to/paths",
    "friction": "how-to/wrong_model",
    "export C code": "how-to/c_code",
    "Raspberry Pi": "how-to/c_code",
    "velocity control": "how-to/interfaces",
    "closed chain": "explanation/limits",
    "mimic joint": "explanation/limits",
}
#: words that are no entry of the index as they stand
TYPED = {
    "7 dof inverse kinematics": "how-to/inverse",
    "admittance control": "how-to/interfaces",
    "arduino": "how-to/c_code",
    "c code generation": "how-to/c_code",
    "call from julia": "how-to/c_code",
    "cartesian path planning": "how-to/paths",
    "center of mass": "how-to/casadi_dynamics",
    "chart folds over": "how-to/certify",
    "citation": "reference/references",
    "collision checking": "how-to/collisions",
    "compare with other methods": "which_tool",
    "compiler not found": "how-to/install",
    "custom task": "how-to/tasks",
    "drake": "how-to/coming_from",
    "emergency stop": "how-to/stops",
    "fit takes too long": "explanation/how_a_fit_runs",
    "gazebo": "how-to/coming_from",
    "gym environment": "how-to/learning",
    "how do I keep the elbow up": "how-to/elbow",
    "how to install": "how-to/install",
    "IKFast": "how-to/arm",
    "imitation learning": "how-to/learning",
    "joint limit avoidance": "how-to/limits",
    "julia": "how-to/c_code",
    "keep elbow up": "how-to/elbow",
    "kinova gen3": "how-to/ready_charts",
    "kuka iiwa": "how-to/robots",
    "license": "policies",
    "linear rail": "how-to/mobile_base",
    "load chart": "reference/files",
    "matlab": "how-to/c_code",
    "mobile robot": "how-to/mobile_base",
    "model predictive control": "how-to/optimal_control",
    "null space control": "explanation/projectors",
    "null space projection": "how-to/coming_from",
    "operational space control": "explanation/projectors",
    "orthogonality": "explanation/angles",
    "parallel gripper": "tutorials/own_arm",
    "passivity": "explanation/control",
    "payload": "how-to/wrong_model",
    "pip install orthocas": "how-to/install",
    "pybullet": "how-to/coming_from",
    "python bindings": "reference/api",
    "qp": "how-to/qp",
    "record motion": "how-to/paths",
    "reinforcement learning": "how-to/learning",
    "RRT": "how-to/planning",
    "rviz": "how-to/view",
    "simulink": "how-to/c_code",
    "slow fit": "explanation/how_a_fit_runs",
    "so101": "tutorials/own_arm",
    "spacemouse": "how-to/joystick",
    "swivel angle": "how-to/elbow",
    "teleoperation": "how-to/joystick",
    "tip frame": "tutorials/own_arm",
    "torque control": "explanation/control",
    "trajectory optimization": "how-to/paths",
    "visual servoing": "how-to/pointing",
    "visualize robot": "how-to/view",
    "what is a chart": "explanation/ideas",
    "what is leak": "explanation/angles",
    "what is xi": "explanation/ideas",
    "whole body control": "explanation/limits",
    "windows install": "how-to/install",
}


@pytest.mark.parametrize("question", ANSWERS)
def test_a_page_answers(question: str) -> None:
    page, sentence = ANSWERS[question]
    assert sentence in " ".join((DOCS / f"{page}.md").read_text().split())


@pytest.mark.parametrize("words", SEARCHED)
def test_the_search_finds_the_page_among_the_first_three(words: str) -> None:
    """Sphinx ranks main entries of the index (!) first, above titles and text."""
    assert [page for page, entries in index().items() if words.lower() in entries][:3] == [SEARCHED[words]]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="no node")
def test_the_search_of_the_built_site_finds_each_page_first() -> None:
    """By the site's own code and index, as a browser runs them."""
    found, newest = SITE / "searchindex.js", max(path.stat().st_mtime for path in DOCS.rglob("*.md"))
    if not found.exists() or found.stat().st_mtime < newest:
        pytest.skip("no site of these pages: make docs")
    wanted = SEARCHED | TYPED
    program = ["node", Path(__file__).with_name("ask_site.js"), SITE]
    done = subprocess.run(program, input="\n".join(wanted), capture_output=True, text=True, check=True, timeout=60)
    first = {words: pages[:1] for words, pages in zip(wanted, json.loads(done.stdout), strict=True)}
    assert first == {words: [page] for words, page in wanted.items()}


def index() -> dict[str, list[str]]:
    """The entries of the index that pages name at their head."""
    found = {}
    for path in sorted(DOCS.rglob("*.md")):
        lines = re.findall(r"^```\{index\} (! .*)$", path.read_text(), flags=re.MULTILINE)
        found[str(path.relative_to(DOCS).with_suffix(""))] = [
            word.strip("! ").lower() for word in ",".join(lines).split(",")
        ]
    return found
