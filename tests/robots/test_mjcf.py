"""MJCF files: mass matrix, bias and poses are MuJoCo's, or the file is refused by name and reason."""

from pathlib import Path

import gymnasium
import numpy as np
import pinocchio as pin
import pytest
import trimesh

import orthocas as oc
from orthocas.errors import InvalidValueError, RobotError, UnknownNameError
from orthocas.robots.mjcf import read_mjcf
from orthocas.robots.pinocchio_model import lock_joints

mujoco = pytest.importorskip("mujoco", minversion="4")  # older ones find principal axes to 1e-7 only

DATA = Path(__file__).parents[1] / "data" / "mjcf"
TIPS = {
    "arm_with_gripper": "attachment_site",
    "shapes": "tip",
    "joints": "end",
    "orientations": "tip",
    "corrected": "c",
}
TOLERANCE = 1e-10  # relative; both sides work in double precision, MuJoCo by way of principal axes


def mujoco_dynamics(model, q: np.ndarray, dq: np.ndarray):  # type: ignore[no-untyped-def]
    """MuJoCo's data after a forward pass, its mass matrix and its bias."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel = q, dq
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return data, M, data.qfrc_bias.copy()


def assert_close(got: np.ndarray, want: np.ndarray) -> None:
    np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE * max(1.0, np.abs(want).max()))


def assert_agrees(path: Path, states: int = 5) -> None:
    """Names, limits, mass matrix, bias, and the poses of all named bodies and sites."""
    theirs, ours = mujoco.MjModel.from_xml_path(str(path)), read_mjcf(path)[0]
    data = ours.createData()
    assert list(ours.names)[1:] == [theirs.joint(i).name or f"joint{i}" for i in range(theirs.njnt)]
    ranges = np.where(theirs.jnt_limited[:, None], theirs.jnt_range, [-np.inf, np.inf])
    np.testing.assert_allclose(np.column_stack([ours.lowerPositionLimit, ours.upperPositionLimit]), ranges)
    for q, dq in np.random.default_rng(7).uniform(-2, 2, (states, 2, ours.nq)):
        state, M, bias = mujoco_dynamics(theirs, q, dq)
        upper = np.triu(pin.crba(ours, data, q))
        assert_close(upper + np.triu(upper, 1).T, M)
        assert_close(pin.nonLinearEffects(ours, data, q, dq), bias)
        pin.framesForwardKinematics(ours, data, q)
        for kind, count in (("body", theirs.nbody), ("site", theirs.nsite)):
            for name in filter(None, (getattr(theirs, kind)(i).name for i in range(1 if kind == "body" else 0, count))):
                found = ours.getFrameId(name, pin.FrameType.BODY if kind == "body" else pin.FrameType.OP_FRAME)
                assert_close(data.oMf[found].translation, getattr(state, kind)(name).xpos)
                assert_close(data.oMf[found].rotation, getattr(state, kind)(name).xmat.reshape(3, 3))


@pytest.mark.parametrize("name", TIPS)
def test_robot_has_the_mass_matrix_bias_and_tip_pose_of_mujoco(name: str) -> None:
    path, tip = DATA / f"{name}.xml", TIPS[name]
    assert_agrees(path)
    robot, theirs = oc.Robot.from_model(read_mjcf(path)[0], tip), mujoco.MjModel.from_xml_path(str(path))
    for q, dq in np.random.default_rng(3).uniform(-2, 2, (5, 2, robot.n)):
        state, M, bias = mujoco_dynamics(theirs, q, dq)
        there = state.body(tip) if name in ("joints", "corrected") else state.site(tip)
        assert_close(robot.mass_matrix(q), M)
        assert_close(robot.bias(q, dq), bias)
        assert_close(robot.tip_position(q), there.xpos)
        assert_close(robot.tip_rotation(q), there.xmat.reshape(3, 3))


OTHERS = ("half_cheetah", "hopper", "inverted_double_pendulum", "inverted_pendulum", "point", "pusher", "pusher_v5")
OTHERS += ("reacher", "swimmer", "walker2d", "walker2d_v5")


@pytest.mark.parametrize("name", OTHERS)
def test_files_of_gymnasium_have_the_dynamics_of_mujoco(name: str) -> None:
    """Files that nobody here wrote: default classes, capsules by fromto, armatures, total masses, slides."""
    assert_agrees(Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / f"{name}.xml")


def test_included_arm_beside_free_bodies_has_the_dynamics_of_mujoco() -> None:
    path = DATA / "scene.xml"
    robot, theirs = oc.Robot.from_mjcf(path, "tool"), mujoco.MjModel.from_xml_path(str(path))
    assert robot.joint_names == ("shoulder_pan", "shoulder_lift", "elbow", "wrist1", "wrist2", "wrist3")
    np.testing.assert_allclose(robot.upper, [6.28319, 6.28319, 3.1415, 6.28319, 6.28319, 6.28319])
    for q, dq in np.random.default_rng(5).uniform(-2, 2, (5, 2, 6)):
        still = np.zeros(theirs.nv - 6)  # the box and the lamp come behind the arm
        state, M, bias = mujoco_dynamics(theirs, np.append(q, theirs.qpos0[6:]), np.append(dq, still))
        assert_close(robot.mass_matrix(q), M[:6, :6])
        assert_close(robot.bias(q, dq), bias[:6])
        assert_close(robot.tip_position(q), state.site("tool").xpos)
    with pytest.raises(RobotError, match="box.*FreeFlyer"):
        oc.Robot.from_model(read_mjcf(path)[0], "tool")


def test_locked_joints_keep_armatures_and_masses_of_the_others() -> None:
    path = DATA / "arm_with_gripper.xml"
    robot = oc.Robot.from_mjcf(path, "hand", {"finger_joint1": 0.01, "finger_joint2": 0.03})
    theirs = mujoco.MjModel.from_xml_path(str(path))
    for q, dq in np.random.default_rng(1).uniform(-2, 2, (5, 2, 7)):
        _, M, bias = mujoco_dynamics(theirs, np.append(q, [0.01, 0.03]), np.append(dq, [0.0, 0.0]))
        assert_close(robot.mass_matrix(q), M[:7, :7])
        assert_close(robot.bias(q, dq), bias[:7])


def test_total_mass_scales_every_body(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    text = (DATA / "shapes.xml").read_text().replace('<geom type="mesh" mesh="hull"/>', '<geom type="box"/>')
    path.write_text(text)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    mujoco.mj_setTotalmass(theirs, 14.0)
    path.write_text(text.replace("<compiler ", '<compiler settotalmass="14" '))
    ours = read_mjcf(path)[0]
    q, dq = np.random.default_rng(2).uniform(-2, 2, (2, 4))
    assert_close(pin.nonLinearEffects(ours, ours.createData(), q, dq), mujoco_dynamics(theirs, q, dq)[2])


def random_mjcf(rng: np.random.Generator) -> str:
    """A random robot out of hinges, slides, solids and sites, turned in every way that MJCF knows."""

    def vector(count: int, size: float = 0.5) -> str:
        return " ".join(str(x) for x in rng.uniform(-size, size, count))

    def turn(degrees: float) -> str:
        kind = rng.choice(["quat", "axisangle", "xyaxes", "zaxis", "euler", ""])
        turns = {
            "quat": vector(4),
            "axisangle": vector(3) + f" {rng.uniform(-3, 3) * degrees}",
            "xyaxes": vector(6),
            "zaxis": vector(3),
            "euler": vector(3, 3 * degrees),
        }
        return f'{kind}="{turns[kind]}"' if kind else ""

    def geom(degrees: float) -> str:
        kind = rng.choice(["sphere", "capsule", "cylinder", "ellipsoid", "box"])
        size = " ".join(str(x) for x in rng.uniform(0.02, 0.2, 3))
        mass = rng.choice(["", 'mass="0.7"', 'density="400"', 'class="heavy"'])
        if kind != "sphere" and rng.random() < 0.3:
            return f'<geom type="{kind}" fromto="{vector(6)}" size="{size}" {mass}/>'
        return f'<geom type="{kind}" pos="{vector(3)}" {turn(degrees)} size="{size}" {mass}/>'

    def body(depth: int, degrees: float) -> str:
        joints = ""
        for _ in range(rng.integers(0 if depth else 1, 3)):
            kind = rng.choice(["hinge", "slide"])
            ref = rng.uniform(-1, 1) * (degrees if kind == "hinge" else 1)
            joints += f'<joint type="{kind}" axis="{vector(3)}" pos="{vector(3)}" ref="{ref}" range="{-1} {ref + 90}"/>'
        inner = joints + geom(degrees) + (geom(degrees) if rng.random() < 0.5 else "")
        for k in range(rng.integers(0, 3) if depth < 4 else 0):
            child = body(depth + 1, degrees) + f'<site name="s{rng.integers(1 << 40)}" {turn(degrees)}/>'
            inner += f'<frame pos="{vector(3)}" {turn(degrees)}>{child}</frame>' if k else child
        return f'<body pos="{vector(3)}" {turn(degrees)}>{inner}</body>'

    angle, degrees = ("degree", 180 / np.pi) if rng.random() < 0.5 else ("radian", 1.0)
    sequence = "".join(rng.choice(list("xyzXYZ"), 3))
    return f"""<mujoco><compiler angle="{angle}" eulerseq="{sequence}"/><option gravity="{vector(3, 10)}"/>
    <default><joint armature="0.3"/><default class="heavy"><geom mass="3"/></default></default>
    <worldbody>{body(0, degrees)}</worldbody></mujoco>"""


@pytest.mark.parametrize("seed", range(25))
def test_random_robots_have_the_dynamics_of_mujoco(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "random.xml"
    path.write_text(random_mjcf(np.random.default_rng(seed)))
    assert_agrees(path, states=2)


def write(folder: Path, body: str = "", before: str = "", after: str = "") -> Path:
    """A file with one moving body b, and what is given in it, before and after the worldbody."""
    path = folder / "arm.xml"
    path.write_text(
        f'<mujoco>{before}<worldbody><body name="b"><joint name="j"/><geom size="0.1"/>{body}</body></worldbody>'
        f"{after}</mujoco>"
    )
    return path


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<site name="s" pos="0.4"/>', "attribute 'pos' does not have enough data Element 'site', line 1"),
        ('<joint range="l4"/>', "bad format in attribute 'range'"),
        ('<joint axis="0 0 0"/>', "axis too small in joint"),
        ('<joint axis="0 0 nan"/>', "axis of <joint> is '0 0 nan', expected finite numbers"),
        ('<joint class="none"/>', "unknown default class name 'none'"),
        ('<joint name="j"/>', "repeated name 'j' in joint"),
        ('<geom size="0.1" mas="2"/>', "unrecognized attribute: 'mas'"),
        ('<geom size="0.1" mass="1e999"/>', "number is too large in attribute 'mass'"),
        ('<geom type="mesh" mesh="m"/>', "mesh 'm' not found"),
        ('<inertial pos="0 0 0" mass="1" diaginertia="1 1 3"/>', r"inertia must satisfy A \+ B >= C"),
        ('<include file="nowhere.xml"/>', "Error opening file 'nowhere.xml'"),
        ('<include file="arm.xml"/>', "File 'arm.xml' already included"),
    ],
)
def test_what_mujoco_refuses_is_refused_with_its_reason(tmp_path: Path, body: str, message: str) -> None:
    with pytest.raises(RobotError, match=rf"arm\.xml: .*{message}"):
        oc.Robot.from_mjcf(write(tmp_path, body), "b")


@pytest.mark.parametrize(
    ("after", "message"),
    [
        ('<actuator><motor name="a" joint="j" armature="1"/></actuator>', "'a' of .*arm.xml has an armature"),
        ('<tendon><fixed name="t" armature="1"><joint joint="j" coef="1"/></fixed></tendon>', "'t' of .* an armature"),
    ],
)
def test_armatures_elsewhere_than_on_joints_are_refused_by_name(tmp_path: Path, after: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        oc.Robot.from_mjcf(write(tmp_path, after=after), "b")


@pytest.mark.filterwarnings("ignore:.*negative:RuntimeWarning")
def test_negative_armatures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="joint 'joint1' has armature -1, expected >= 0"):
        oc.Robot.from_mjcf(write(tmp_path, '<joint armature="-1" axis="1 0 0"/>'), "b")


def test_meshes_replicas_and_attached_bodies_have_the_dynamics_of_mujoco(tmp_path: Path) -> None:
    trimesh.creation.icosphere(1, 0.2).apply_scale([1, 2, 3]).export(tmp_path / "egg.stl")
    (tmp_path / "hand.xml").write_text(
        '<mujoco model="hand"><worldbody><body name="palm" pos="0 0 0.3"><joint name="wrist" axis="0 1 0"/>'
        '<geom type="capsule" size="0.03 0.1"/><site name="grip" pos="0 0.1 0"/></body></worldbody></mujoco>'
    )
    path = write(
        tmp_path,
        '<geom type="mesh" mesh="egg"/><replicate count="3" euler="0 0 1"><geom size="0.02" pos="0.3 0 0"/></replicate>'
        '<attach model="hand" body="palm" prefix="left_"/>',
        before='<asset><mesh name="egg" file="egg.stl"/><model name="hand" file="hand.xml"/></asset>',
    )
    assert_agrees(path)
    assert oc.Robot.from_mjcf(path, "left_grip").joint_names == ("j", "left_wrist")


def test_compiled_models_are_taken_as_they_are() -> None:
    """For example a model whose masses a program has changed."""
    path = DATA / "shapes.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    model.body_mass *= 2
    model.body_inertia *= 2
    q, dq = np.random.default_rng(4).uniform(-2, 2, (2, model.nv))
    _, M, bias = mujoco_dynamics(model, q, dq)
    robot = oc.Robot.from_mjcf(model, "tip")
    assert_close(robot.mass_matrix(q), M)
    assert_close(robot.bias(q, dq), bias)
    with pytest.raises(InvalidValueError, match=r"path is \[.*, expected a path"):
        oc.Robot.from_mjcf([1, 2])


def test_ranges_of_controls_limit_the_torque_of_motors(tmp_path: Path) -> None:
    """Torque = gear x control: what MuJoCo applies at the ends of the range."""
    motors = "".join(
        f'<motor joint="{joint}" gear="{gear}" ctrlrange="{ends}"/>'
        for joint, gear, ends in (("j", 50, "-1 1"), ("k", -3, "-2 4"), ("l", 1, "0 1"))
    )
    joints = (
        '<body><joint name="k" axis="1 0 0"/><geom size="0.1"/><body><joint name="l"/><geom size="1"/></body></body>'
    )
    path = write(tmp_path, joints, after=f"<actuator>{motors}</actuator>")
    limits = oc.Robot.from_mjcf(path).effort_limits
    np.testing.assert_array_equal(limits, [50, 6, np.inf])
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    reached = []
    for sign in (-1, 1):
        data.ctrl[:] = sign * np.array([1e6, -1e6, 0])
        mujoco.mj_forward(model, data)
        reached.append(sign * data.qfrc_actuator)
    np.testing.assert_array_equal(np.min(reached, axis=0)[:2], limits[:2])


def test_file_without_joints_says_so(tmp_path: Path) -> None:
    path = tmp_path / "props.xml"
    path.write_text('<mujoco><worldbody><body name="b"/></worldbody></mujoco>')
    with pytest.raises(RobotError, match=r"props\.xml has no joint"):
        oc.Robot.from_mjcf(path)


def test_body_wins_over_a_site_of_its_name_and_a_site_over_a_joint(tmp_path: Path) -> None:
    path = write(tmp_path, '<site name="b" pos="1 2 3"/><site name="j" pos="4 5 6"/>')
    np.testing.assert_array_equal(oc.Robot.from_mjcf(path, "b").tip_position(np.zeros(1)), np.zeros(3))
    np.testing.assert_array_equal(oc.Robot.from_mjcf(path, "j").tip_position(np.zeros(1)), [4, 5, 6])


def test_last_site_is_the_default_tip_and_wrong_tips_list_bodies_and_sites(tmp_path: Path) -> None:
    path = write(tmp_path, '<site name="flange" pos="1 2 3"/>')
    np.testing.assert_array_equal(oc.Robot.from_mjcf(path).tip_position(np.zeros(1)), [1, 2, 3])
    with pytest.raises(UnknownNameError, match="unknown frame 'hand'.*j, b, flange"):
        oc.Robot.from_mjcf(path, "hand")


def test_ball_joints_are_refused_unless_they_can_be_locked_off_the_chain(tmp_path: Path) -> None:
    path = write(tmp_path, '<body name="c"><joint name="neck" type="ball"/><geom size="0.1"/></body>')
    with pytest.raises(RobotError, match="neck.*Spherical"):
        oc.Robot.from_model(read_mjcf(path)[0], "b")
    assert oc.Robot.from_mjcf(path, "b").joint_names == ("j",)
    with pytest.raises(RobotError, match="neck.*degrees of freedom"):
        lock_joints(read_mjcf(path)[0], {"neck": 0.5})


BOMB = '<!DOCTYPE m [<!ENTITY a "ha">' + "".join(
    f'<!ENTITY a{i} "{(f"&a{i - 1};" if i else "&a;") * 10}">' for i in range(12)
)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize(("root", "read"), [("mujoco", oc.Robot.from_mjcf), ("robot", oc.Robot.from_urdf)])
def test_entity_bombs_are_refused_before_they_go_off(tmp_path: Path, encoding: str, root: str, read) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "bomb.xml"
    path.write_text(f'<?xml version="1.0" encoding="{encoding}"?>{BOMB}]><{root}>&a11;</{root}>', encoding=encoding)
    with pytest.raises(RobotError, match="declares a document type"):
        read(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<worldbody>" + "<body>" * 100_000 + "</body>" * 100_000 + "</worldbody>", "nest more than 200 deep"),
        ("<worldbody>" + "<body><joint/></body>" * 5_000 + "</worldbody>", "more than 1000 bodies"),
        ("<a/>" * 300_000, "more than 200000 elements"),
        (" " * 17 * 2**20, "more than 16777216 bytes"),
    ],
)
def test_files_larger_than_any_robot_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "huge.xml"
    path.write_text(f"<mujoco>{text}</mujoco>")
    with pytest.raises(RobotError, match=message):
        oc.Robot.from_mjcf(path, "b")


def test_long_chain_of_includes_ends_in_an_error(tmp_path: Path) -> None:
    for i in range(300):
        (tmp_path / f"{i}.xml").write_text(f'<mujoco><include file="{i + 1}.xml"/></mujoco>')
    with pytest.raises(RobotError, match=r"Error opening file .*300\.xml"):
        oc.Robot.from_mjcf(tmp_path / "0.xml", "b")


ACTUATORS = """<default><position forcerange="-3 3"/><default class="strong">
<general forcerange="-40 50"/></default></default>
<worldbody><body>{}<body>{}<body>{}<body>{}<body>{}</body></body></body></body></body></worldbody>
<actuator><general class="strong" joint="a" gear="2 0 0" gainprm="1e4"/><motor joint="b" gear="-4"/>
<general class="strong" joint="c" gainprm="1e4"/><motor joint="e" forcelimited="false"/></actuator>"""


def test_effort_limits_are_the_largest_forces_that_mujoco_applies(tmp_path: Path) -> None:
    """Defaults shared by kinds of actuators, gears, sides that differ, and a range at the joint."""
    extra = {"c": ' actuatorfrcrange="-25 30"', "d": ' actuatorfrcrange="-5 6"'}
    joints = [f'<joint name="{k}"{extra.get(k, "")}/><geom size="0.1" pos="0.1 0 0"/>' for k in "abcde"]
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco>{ACTUATORS.format(*joints)}</mujoco>")
    limits = oc.Robot.from_mjcf(path).effort_limits
    np.testing.assert_array_equal(limits, [80, 12, 25, 5, np.inf])  # two sides: what both reach
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    reached = []
    for sign in (-1, 1):
        data.ctrl[:] = sign * 1e6
        data.ctrl[1] *= -1  # its gear turns the sign
        mujoco.mj_forward(model, data)
        reached.append(sign * data.qfrc_actuator)
    np.testing.assert_array_equal(np.min(reached, axis=0)[[0, 1, 2]], limits[:3])


def test_forces_of_one_sign_are_no_limit_of_effort(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint actuatorfrcrange="0 10"/><geom size="1"/></body></worldbody></mujoco>'
    )
    assert np.isinf(oc.Robot.from_mjcf(path).effort_limits).all()


def test_names_in_other_encodings_than_utf_8_are_refused(tmp_path: Path) -> None:
    body = '<body><geom size="0.1"/><joint name="é" axis="0 1 0"/></body>'
    text = f'<?xml version="1.0" encoding="iso-8859-1"?><mujoco><worldbody>{body}</worldbody></mujoco>'
    (tmp_path / "arm.xml").write_text(text, encoding="iso-8859-1")
    with pytest.raises(RobotError, match=r"arm.xml has names that are not UTF-8"):
        oc.Robot.from_mjcf(tmp_path / "arm.xml")


COUPLED = """<mujoco><compiler angle="radian"/><worldbody>
<body><joint name="a" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 0.4 0 0.1" size="0.03" mass="2"/>
<body pos="0.4 0 0.1"><joint name="b" axis="0 1 0" ref="0.2"/>
<geom type="capsule" fromto="0 0 0 0.3 0.1 0" size="0.03" mass="1"/>
<body pos="0.3 0.1 0"><joint name="c" axis="0 1 0" ref="-0.1"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0.1" size="0.03" mass="0.5"/>
<body name="four" pos="0.2 0 0.1"><joint name="d" axis="1 0 0"/>
<geom type="box" size="0.05 0.03 0.02" pos="0.05 0 0.02" mass="0.3"/></body></body></body></body></worldbody>
<equality><joint joint1="c" joint2="b" polycoef="{coefficients}" active="{active}"/></equality></mujoco>"""


def test_linear_couplings_of_joints_are_mimic_joints(tmp_path: Path) -> None:
    """Mass matrix and bias are S^T M S and S^T b of MuJoCo's own, at joints that satisfy its constraint."""
    path = tmp_path / "coupled.xml"
    path.write_text(COUPLED.format(coefficients="0.05 -0.5 0 0 0", active="true"))
    robot, theirs = oc.Robot.from_mjcf(path, "four"), mujoco.MjModel.from_xml_path(str(path))
    assert robot.joint_names == ("a", "b", "d")
    S = np.array([[1.0, 0, 0], [0, 1, 0], [0, -0.5, 0], [0, 0, 1]])
    for q, dq in np.random.default_rng(3).uniform(-1, 1, (5, 2, 3)):
        state, M, bias = mujoco_dynamics(theirs, S @ q + [0, 0, -0.1 + 0.05 + 0.5 * 0.2, 0], S @ dq)
        assert abs(state.efc_pos[0]) < 1e-12  # MuJoCo's own constraint holds
        assert_close(robot.mass_matrix(q), S.T @ M @ S)
        assert_close(robot.bias(q, dq), S.T @ bias)
        assert_close(robot.tip_position(q), state.body("four").xpos)
    # A joint that is locked follows no more.
    assert oc.Robot.from_mjcf(path, "four", {"c": 0.3}).joint_names == ("a", "b", "d")
    assert oc.Robot.from_mjcf(path, "four", {"c": 0.3}).mimics == ()


def test_a_joint_that_follows_a_locked_one_keeps_its_place(tmp_path: Path) -> None:
    """d follows c, which follows b: with c locked, d is too, wherever b is."""
    path, second = tmp_path / "chain.xml", '<joint joint1="d" joint2="c" polycoef="0 1 0 0 0"/></equality>'
    chain = COUPLED.format(coefficients="0 1 0 0 0", active="true").replace("</equality>", second)
    path.write_text(chain)
    robot = oc.Robot.from_mjcf(path, "four", {"c": 0.3})
    assert robot.joint_names == ("a", "b")
    path.write_text(chain.replace('active="true"', 'active="false"').replace(second, "</equality>"))
    free = oc.Robot.from_mjcf(path, "four")
    ref = float(mujoco.MjModel.from_xml_string(chain).qpos0[2])
    assert_close(robot.tip_rotation([0.1, 0.7]), free.tip_rotation([0.1, 0.7, 0.3, 0.3 - ref]))


def test_two_couplings_of_one_joint_are_refused(tmp_path: Path) -> None:
    path, second = tmp_path / "twice.xml", '<joint joint1="c" joint2="a" polycoef="0 1 0 0 0"/></equality>'
    path.write_text(COUPLED.format(coefficients="0 1 0 0 0", active="true").replace("</equality>", second))
    with pytest.raises(RobotError, match="'c' is coupled to 'b' and, otherwise, to 'a', .* lock it with locked="):
        oc.Robot.from_mjcf(path, "four")
    assert oc.Robot.from_mjcf(path, "four", {"c": 0.3}).joint_names == ("a", "b", "d")


@pytest.mark.parametrize(("coefficients", "active"), [("0 1 0.2 0 0", "true"), ("0 1 0 0 0", "false")])
def test_other_equalities_leave_joints_free(coefficients: str, active: str, tmp_path: Path) -> None:
    path = tmp_path / "free.xml"
    path.write_text(COUPLED.format(coefficients=coefficients, active=active))
    assert oc.Robot.from_mjcf(path, "four").joint_names == ("a", "b", "c", "d")
