"""Robot files: URDF with an SRDF beside it, and MJCF, well formed or not, that describe robots or nonsense."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

import orthocas as oc
from fuzz.child import Finding, run, verdict
from fuzz.words import NAMES, NUMBERS, VECTORS, Rng, pick
from orthocas.tasks.domains import default_box
from orthocas.viewer.looks import read_urdf_look

_CORNERS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_MESH = "solid m\n{}endsolid m\n".format(
    "".join(
        "facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n".format(
            "".join("vertex {} {} {}\n".format(*_CORNERS[k]) for k in range(4) if k != left)
        )
        for left in range(4)
    )
)
_COLLIDED = 10  # joints of robots whose pairs are found
_EVALUATED = 30  # joints of robots whose dynamics are built: it takes long for many
_KINDS = (
    "revolute",
    "continuous",
    "prismatic",
    "fixed",
    "floating",
    "planar",
    "spherical",
    "hinge",
    "ball",
    "",
    "Revolute",
)
_HEADS = (
    '<?xml version="1.0" encoding="utf-16"?>',
    '<?xml version="1.0" encoding="ebcdic-cp-us"?>',
    '<?xml version="1.0" encoding="rot13"?>',
    '<?xml version="9"?>',
    '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>',
    '<!DOCTYPE r SYSTEM "file:///etc/passwd">',
    '<?xml-stylesheet href="x"?>',
    "<!-- -- -->",
    "\ufeff",
    "garbage",
)


def robots(count: int) -> list[Finding]:
    """The campaign."""
    return run("robots", judge, range(count))


def judge(seed: int) -> str | None:
    """Write the files of a seed, read them, and use the robot that comes out."""
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        path = write(rng, Path(folder))
        tip = pick(rng, (None, None, "l2", "site", "nowhere", *NAMES[:3]))
        locked = pick(rng, ({}, {}, {"j1": 0.1}, {"l1": 0.1}, {"nowhere": 0.0}, {"j2": np.nan}, {"universe": 0.0}))
        return verdict(partial(use, path, tip, locked))


def use(path: Path, tip: str | None, locked: dict[str, float]) -> None:
    """Read a robot; what it computes must be finite."""
    robot = oc.Robot.from_file(path, tip, locked)
    shown = repr(robot)
    if not all(line.isprintable() for line in shown.splitlines()):
        raise AssertionError(f"repr is not printable: {shown!r:.100}")
    if robot.n > _EVALUATED:
        return
    if path.suffix == ".urdf":
        read_urdf_look(path, robot.tree, locked)
    middle = default_box(robot).centre
    if path.suffix == ".urdf" and robot.n <= _COLLIDED:
        found = robot.collisions.distance(middle)
        if np.isnan(found.distance) or not np.isfinite(found.gradient).all():
            raise AssertionError("a least distance that is no number")
    for q in (middle, middle + 0.1):
        values = (robot.tip_position(q), robot.mass_matrix(q), robot.gravity(q), robot.bias(q, q))
        if not all(np.isfinite(value).all() for value in values):
            raise AssertionError("a robot with dynamics that are not finite")
        if np.linalg.eigvalsh(values[1])[0] < -1e-9 * np.abs(values[1]).max():
            raise AssertionError("a mass matrix with a negative eigenvalue")


def write(rng: Rng, folder: Path) -> Path:
    """The mutant of a seed, with what lies beside it."""
    mjcf = rng.random() < 0.5
    root = (mjcf_chain if mjcf else urdf_chain)(rng, int(rng.integers(1, 5)))
    for _ in range(int(rng.integers(1, 4))):
        pick(rng, _MJCF_CHANGES if mjcf else _URDF_CHANGES)(rng, root)
    path = folder / ("arm.xml" if mjcf else "arm.urdf")
    path.write_bytes(text_of(rng, root))
    if mjcf:
        (folder / "part.xml").write_bytes(text_of(rng, mjcf_chain(rng, 1)))
    elif rng.random() < 0.6:
        (folder / "m.stl").write_text(_MESH[: int(rng.integers(len(_MESH) // 2, 2 * len(_MESH)))])
        path.with_suffix(".srdf").write_bytes(text_of(rng, srdf(rng)))
    return path


def text_of(rng: Rng, root: Element) -> bytes:
    """The bytes of a tree, now and then damaged."""
    data = ElementTree.tostring(root, "utf-8", xml_declaration=False)
    chance = rng.random()
    if chance < 0.06:
        data = data[: int(rng.integers(len(data)))]
    elif chance < 0.12:
        flipped = bytearray(data)
        for place in rng.integers(len(data), size=3):
            flipped[place] = rng.integers(256)
        data = bytes(flipped)
    elif chance < 0.18:
        data = pick(rng, _HEADS).encode() + data
    elif chance < 0.19:
        head = '<?xml version="1.0" encoding="iso-8859-1"?>'
        data = f"{head}{data.decode()}".replace("j1", "é").replace("l1", "ü").encode("iso-8859-1", "replace")
    elif chance < 0.20:
        data = data.decode().encode(pick(rng, ("utf-16", "utf-32", "cp037")), "replace")
    elif chance < 0.21:
        data = pick(rng, (b"", b"\0" * 1000, b"<" * 100_000, b"<a>" * 100_000, b"<robot " + b"a" * 10**6))
    return data


def urdf_chain(rng: Rng, joints: int) -> Element:
    """A chain of revolute and prismatic joints."""
    root = Element("robot", name="r")
    SubElement(root, "link", name="l0")
    for i in range(1, joints + 1):
        link = SubElement(root, "link", name=f"l{i}")
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz="0 0 0.1", rpy="0 0 0.2")
        SubElement(inertial, "mass", value="1.5")
        SubElement(inertial, "inertia", ixx="0.1", ixy="0", ixz="0", iyy="0.1", iyz="0", izz="0.1")
        if rng.random() < 0.8:
            collision = SubElement(link, "collision")
            SubElement(collision, "origin", xyz="0 0 0.1", rpy="0 0 0.2")
            kind = pick(rng, ("box", "sphere", "cylinder", "capsule", "mesh", "mesh", "mesh"))
            sizes = (
                {"size": "0.1 0.1 0.3"} if kind == "box" else {"radius": "0.1", "length": "0.2", "filename": "m.stl"}
            )
            SubElement(SubElement(collision, "geometry"), kind, sizes)
        joint = SubElement(root, "joint", name=f"j{i}", type=pick(rng, _KINDS[:3]))
        SubElement(joint, "parent", link=f"l{i - 1}")
        SubElement(joint, "child", link=f"l{i}")
        SubElement(joint, "origin", xyz="0.3 0 0.1", rpy="0.1 0 0")
        SubElement(joint, "axis", xyz=pick(rng, ("0 0 1", "0 1 0", "1 1 0")))
        SubElement(joint, "limit", lower="-1", upper="1", effort="10", velocity="3")
    return root


def mjcf_chain(rng: Rng, joints: int) -> Element:
    """The same as MJCF, with a default class, a site and a keyframe."""
    root = Element("mujoco", model="r")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    SubElement(root, "option", gravity="0 0 -9.81")
    SubElement(SubElement(root, "default"), "joint", armature="0.01")
    body = SubElement(root, "worldbody")
    for i in range(1, joints + 1):
        body = SubElement(body, "body", name=f"l{i}", pos="0.3 0 0.1", euler="0.1 0 0")
        kind = pick(rng, ("hinge", "slide"))
        SubElement(body, "joint", name=f"j{i}", type=kind, axis="0 1 1", range="-1 1", pos="0 0 0")
        if rng.random() < 0.5:
            SubElement(body, "inertial", pos="0 0 0.1", mass="1.5", diaginertia="0.1 0.1 0.1")
        else:
            SubElement(body, "geom", type=pick(rng, ("box", "sphere", "capsule")), size="0.1 0.1 0.1", mass="1")
    SubElement(body, "site", name="site", pos="0 0 0.1")
    keyframe = SubElement(root, "keyframe")
    SubElement(keyframe, "key", name="home", qpos=" ".join(["0.1"] * joints))
    return root


def srdf(rng: Rng) -> Element:
    """Group states and disabled pairs, some of them of joints and links that are not there."""
    root = Element(pick(rng, ("robot", "robot", "sdf")), name="r")
    state = SubElement(root, "group_state", name=pick(rng, NAMES), group="arm")
    for i in range(int(rng.integers(5))):
        SubElement(state, "joint", name=pick(rng, (f"j{i + 1}", *NAMES[:4])), value=pick(rng, ("0.1", *NUMBERS)))
    if rng.random() < 0.8:
        SubElement(root, "disable_collisions", link1="l1", link2=pick(rng, ("l2", *NAMES[:3])))
    if rng.random() < 0.3:
        _drop_attribute(rng, root)
    return root


def _anywhere(rng: Rng, root: Element) -> Element:
    found: Element = pick(rng, list(root.iter()))
    return found


def _change_attribute(rng: Rng, root: Element) -> None:
    element = _anywhere(rng, root)
    if element.attrib:
        name = pick(rng, sorted(element.attrib))
        element.set(name, pick(rng, pick(rng, (NUMBERS, VECTORS, NAMES, _KINDS))))


def _drop_attribute(rng: Rng, root: Element) -> None:
    element = _anywhere(rng, root)
    if element.attrib:
        del element.attrib[pick(rng, sorted(element.attrib))]


def _add_attribute(rng: Rng, root: Element) -> None:
    known = (
        "name",
        "type",
        "class",
        "childclass",
        "pos",
        "quat",
        "euler",
        "axisangle",
        "xyaxes",
        "zaxis",
        "fromto",
        "ref",
    )
    known += (
        "limited",
        "armature",
        "density",
        "mass",
        "size",
        "fullinertia",
        "mesh",
        "xyz",
        "rpy",
        "multiplier",
        "link",
    )
    _anywhere(rng, root).set(pick(rng, known), pick(rng, pick(rng, (NUMBERS, VECTORS, NAMES))))


def _change_name(rng: Rng, root: Element) -> None:
    """A new name, everywhere it is referred to."""
    named = [element for element in root.iter() if element.get("name")]
    old, new = pick(rng, named).get("name"), pick(rng, NAMES)
    for element in root.iter():
        for key in ("name", "link", "joint"):
            if element.get(key) == old:
                element.set(key, new)


def _share_name(rng: Rng, root: Element) -> None:
    """One name for a link, a joint, a site, and for all that refers to them."""
    new = pick(rng, ("universe", "l1", "world"))
    for old in pick(rng, (("j1",), ("l1", "j1"), ("j2", "l2"), ("l1", "j1", "site"))):
        for element in root.iter():
            for key in ("name", "link", "joint"):
                if element.get(key) == old:
                    element.set(key, new)


def _change_number(rng: Rng, root: Element) -> None:
    """One entry of one vector."""
    numeric = [(e, k) for e in root.iter() for k, v in e.attrib.items() if v and v[0] in "-.0123456789"]
    element, name = pick(rng, numeric)
    words = element.attrib[name].split() or [""]
    words[int(rng.integers(len(words)))] = pick(rng, NUMBERS)
    element.set(name, " ".join(words))


def _drop_element(rng: Rng, root: Element) -> None:
    parent = _anywhere(rng, root)
    if len(parent):
        parent.remove(pick(rng, list(parent)))


def _double_element(rng: Rng, root: Element) -> None:
    parent = _anywhere(rng, root)
    if len(parent):
        parent.append(pick(rng, list(parent)))


def _rename_element(rng: Rng, root: Element) -> None:
    tags = (
        "link",
        "joint",
        "body",
        "geom",
        "site",
        "inertial",
        "frame",
        "freejoint",
        "mimic",
        "include",
        "replicate",
        "x",
    )
    _anywhere(rng, root).tag = pick(rng, tags)


def _self_child(rng: Rng, root: Element) -> None:
    """A joint whose parent is its own child, or any other link: loops and two parents."""
    for joint in root.findall("joint")[-int(rng.integers(1, 3)) :]:
        for end in joint:
            if end.tag in ("parent", "child") and rng.random() < 0.7:
                end.set("link", pick(rng, ("l0", "l1", "l2", "l3", "l4", "nowhere")))


def _mimic(rng: Rng, root: Element) -> None:
    """Mimic joints, chains and loops of them too."""
    for joint in root.findall("joint"):
        if rng.random() < 0.7:
            values = {"joint": pick(rng, ("j1", "j2", "j3", "j4", "nowhere")), "multiplier": pick(rng, ("1", *NUMBERS))}
            SubElement(joint, "mimic", values)


def _looks(rng: Rng, root: Element) -> None:
    """Shapes and colours that are not URDF, which kinematics does not use."""
    colour, shape = ("material", "texture", "color"), ("geometry", "mesh", "capsule", "box", "origin")
    for link in root.findall("link"):
        look = SubElement(link, pick(rng, ("visual", "collision", "sensor")))
        for tag in pick(rng, (colour, shape, (*shape, *colour))):
            inner = SubElement(pick(rng, list(look.iter())), tag)
            inner.set(pick(rng, ("name", "filename", "size", "rgba")), pick(rng, pick(rng, (NUMBERS, VECTORS, NAMES))))
    for _ in range(int(rng.integers(3))):
        SubElement(root, "material", name=pick(rng, NAMES[:3]))


def _inertia(rng: Rng, root: Element) -> None:
    """Masses and inertias that no body has."""
    for element in root.iter():
        for name in ("value", "mass", "ixx", "iyy", "ixy", "diaginertia", "density"):
            if name in element.attrib and rng.random() < 0.3:
                element.set(name, pick(rng, ("0", "-1", "1e-300", "1e20", "1e-9", "-0.0", "0 0 0", "-1 1 1", "1 2 9")))


def _many(rng: Rng, root: Element) -> None:
    """More links than a robot has."""
    count = int(pick(rng, (60, 999, 1001, 5000)))
    if root.tag == "mujoco":
        world = root.find("worldbody")
        for i in range(count):
            child = SubElement(root if world is None else world, "body", name=f"m{i}")
            SubElement(child, "geom", size="0.1", mass="1")
            SubElement(child, "joint", name=f"mj{i}")
        return
    kind = pick(rng, _KINDS)
    for i in range(count):
        SubElement(root, "link", name=f"m{i}")
        joint = SubElement(root, "joint", name=f"mj{i}", type=kind)
        SubElement(joint, "parent", link=f"m{i - 1}" if i else "l0")
        SubElement(joint, "child", link=f"m{i}")


def _nest(rng: Rng, root: Element) -> None:
    """Elements inside one another, deeper than any robot."""
    inner = _anywhere(rng, root)
    tag = pick(rng, ("body", "frame", "link", "joint", "default"))
    for _ in range(int(pick(rng, (5, 150, 250)))):
        inner = SubElement(inner, tag)


def _include(rng: Rng, root: Element) -> None:
    file = pick(
        rng, ("part.xml", "arm.xml", "../arm.xml", "/etc/passwd", "/dev/zero", ".", "", "no\x00thing", "x" * 5000)
    )
    SubElement(_anywhere(rng, root), "include", file=file.replace("\x00", "\x7f"))


_Change = Callable[[Rng, Element], None]
_ANY: tuple[_Change, ...] = (
    *(_change_attribute, _drop_attribute, _add_attribute, _change_name, _share_name, _change_number),
    *(_drop_element, _double_element, _rename_element, _inertia, _nest),
)
_URDF_CHANGES: tuple[_Change, ...] = (*_ANY, _self_child, _self_child, _mimic, _looks, _many)
_MJCF_CHANGES: tuple[_Change, ...] = (*_ANY, _include, _many)
