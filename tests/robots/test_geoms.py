"""Solids of MJCF files: distances are MuJoCo's own, and so are the pairs."""

import itertools
from pathlib import Path

import numpy as np
import pytest

import orthocas as oc
from orthocas.errors import RobotError
from orthocas.tools.checks import Array

mujoco = pytest.importorskip("mujoco")

ARM = """<mujoco><compiler angle="radian" autolimits="true"/>
<asset><mesh name="hull" vertex="0 0 0  0.1 0 0  0 0.12 0  0 0 0.15  0.1 0.1 0.1"/></asset>
<worldbody>
  <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.35" euler="0.1 0.05 0"/>
  <geom name="post" type="cylinder" size="0.05 0.3" pos="0.6 0.3 0.2"/>
  <geom name="ghost" type="box" size="1 1 1" contype="0" conaffinity="0"/>
  <body name="a" pos="0 0 0.2"><joint name="q1" axis="0 0 1" range="-2 2"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.04"/>
    <body name="b" pos="0.35 0 0"><joint name="q2" axis="0 1 0" range="-2 2"/>
      <geom type="ellipsoid" size="0.12 0.05 0.04" pos="0.12 0 0"/>
      <body name="fixed" pos="0.2 0 0" euler="0.3 0.2 0.1"><geom type="box" size="0.03 0.04 0.05"/></body>
      <body name="c" pos="0.3 0 0"><joint name="q3" axis="0 0 1" range="-2 2"/>
        <geom type="mesh" mesh="hull" pos="0.02 0 0" euler="0 0.4 0"/>
        <body name="d" pos="0.15 0 0"><joint name="q4" axis="0 1 0" range="-2.5 2.5"/>
          <geom type="sphere" size="0.05" pos="0.1 0 0"/><site name="tip" pos="0.2 0 0"/>
        </body>
      </body>
    </body>
  </body>
</worldbody>
<contact><exclude body1="b" body2="d"/></contact></mujoco>"""


def measure(compiled: object, q: Array) -> dict[tuple[str, str], Array]:
    """Least distances of MuJoCo between the named bodies or world solids, of pairs of geoms that it lets collide."""
    data, found = mujoco.MjData(compiled), dict[tuple[str, str], Array]()
    names = []
    for i in range(compiled.ngeom):  # type: ignore[attr-defined]
        body = compiled.geom_bodyid[i]  # type: ignore[attr-defined]
        names.append(compiled.body(body).name if body else compiled.geom(i).name)  # type: ignore[attr-defined]
    for row, posture in enumerate(q):
        data.qpos = posture
        mujoco.mj_forward(compiled, data)
        for i, k in itertools.combinations(range(len(names)), 2):
            ends = np.zeros(6)
            value = mujoco.mj_geomDistance(compiled, data, i, k, 10.0, ends)
            known = found.setdefault((names[i], names[k]), np.full(len(q), np.inf))
            known[row] = min(known[row], value)
    return found


def test_distances_and_pairs_are_those_of_mujoco(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    robot = oc.Robot.from_mjcf(path, "tip")
    collisions = robot.collisions
    assert collisions.origin == "from arm.xml"
    assert {frozenset(pair) for pair in collisions.pairs} == {
        frozenset(pair)
        for pair in (
            *(("floor", name) for name in ("a", "b", "fixed", "c", "d")),
            *(("post", name) for name in ("a", "b", "fixed", "c", "d")),
            *(("a", name) for name in ("c", "d")),
            ("fixed", "d"),
        )
    }
    q = robot.sample(150, seed=3)
    theirs = measure(mujoco.MjModel.from_xml_path(str(path)), q)
    own = collisions.pair_distances(q)
    for pair, column in zip(collisions.pairs, own.T, strict=True):
        wanted = theirs.get(pair, theirs.get(pair[::-1]))
        assert wanted is not None
        apart = wanted > 1e-3
        assert apart.any()
        np.testing.assert_allclose(column[apart], wanted[apart], atol=2e-6)
        np.testing.assert_array_equal(column > 1e-5, wanted > 1e-5)


def test_contacts_of_random_postures_are_those_that_mujoco_finds(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    robot, compiled = oc.Robot.from_mjcf(path, "tip"), mujoco.MjModel.from_xml_path(str(path))
    data, touching = mujoco.MjData(compiled), []
    q = robot.sample(500, seed=4)
    for posture in q:
        data.qpos = posture
        mujoco.mj_forward(compiled, data)
        touching.append(any(contact.dist < -1e-5 for contact in data.contact))
    free = robot.collisions.distance(q).distance > -1e-5
    assert 0.03 < np.mean(touching) < 0.9
    assert np.mean(free == ~np.array(touching)) > 0.995  # but for contacts as shallow as both tolerances


def test_locked_joints_and_what_cannot_be_read_are_said(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    robot = oc.Robot.from_mjcf(path, "tip", locked={"q2": 0.5})
    whole = oc.Robot.from_mjcf(path, "tip")
    q = robot.sample(20, seed=5)
    full = np.insert(q, 1, 0.5, axis=1)
    pairs = [pair for pair in robot.collisions.pairs if pair in whole.collisions.pairs]
    assert len(pairs) > 8
    own, all_ = (
        dict(zip(c.pairs, c.pair_distances(p).T, strict=True))
        for c, p in ((robot.collisions, q), (whole.collisions, full))
    )
    for pair in pairs:
        np.testing.assert_allclose(own[pair], all_[pair], atol=3e-6)
    hills = ARM.replace("</asset>", '<hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>').replace(
        '<geom name="post"', '<geom name="hills" type="hfield" hfield="h" pos="9 9 0"/><geom name="post"'
    )
    path.write_text(hills)
    assert oc.Robot.from_mjcf(path, "tip").collisions.missing == ("hills",)
    bare = path.with_name("bare.xml")
    bare.write_text(
        '<mujoco><worldbody><body><joint/><geom size="0.1" contype="0" conaffinity="0"/></body></worldbody></mujoco>'
    )
    with pytest.raises(RobotError, match="no geom that can collide"):
        _ = oc.Robot.from_mjcf(bare).collisions
    with pytest.raises(RobotError, match="expected a URDF file"):
        _ = robot.with_solids(path, path).collisions
    model = oc.Robot.from_mjcf(mujoco.MjModel.from_xml_path(str(path)), "tip")
    with pytest.raises(RobotError, match="URDF or MJCF file"):
        _ = model.collisions
