"""A reader of chart files by what docs/reference/files.md says: NumPy and zipfile alone, nothing of orthocas."""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import orthocas as oc
from orthocas.tasks.samples import sample_uniform

Array = np.ndarray
Header = dict[str, Any]
DATA = Path(oc.charts.__file__).parent / "data"


class Reader:
    """phi(q) = [x; xi] of a chart file, for q (n,)."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            text = archive.read("header.json")
            assert hashlib.sha256(text).hexdigest().encode() == archive.read("digest.txt")
            self.header: Header = json.loads(text)
            entries = {name: archive.read(name) for name in self.header["sha256"]}
        assert all(hashlib.sha256(entries[name]).hexdigest() == sum_ for name, sum_ in self.header["sha256"].items())
        self.arrays = {name.removesuffix(".npy"): np.load(io.BytesIO(entry)) for name, entry in entries.items()}
        self.names: list[str] = self.header["robot"]["joint_names"]
        self.idle: list[int] = self.header["coordinates"]["idle"]
        self.active = [i for i in range(len(self.names)) if i not in self.idle]

    def phi(self, q: Array) -> Array:
        return np.concatenate([self.task(q), self.xi(q)])

    def tip(self, q: Array) -> tuple[Array, Array]:
        robot, arrays = self.header["robot"], self.arrays
        places: list[tuple[Array, Array]] = []
        for i, (kind, parent) in enumerate(zip(robot["joint_kinds"], robot["parents"], strict=True)):
            R, p = places[parent] if parent >= 0 else (np.eye(3), np.zeros(3))
            p = p + R @ arrays["robot_translations"][i]
            R = R @ arrays["robot_rotations"][i]
            if kind == "revolute":
                c, s = np.cos(q[i]), np.sin(q[i])
                R = R @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            else:
                p = p + q[i] * R[:, 2]
            places.append((R, p))
        R, p = places[robot["tip_parent"]] if robot["tip_parent"] >= 0 else (np.eye(3), np.zeros(3))
        return R @ arrays["robot_tip_rotation"], p + R @ arrays["robot_tip_translation"]

    def task(self, q: Array) -> Array:
        task, (R, p) = self.header["problem"]["task"], self.tip(q)
        kind, _, axes = task["kind"].partition(":")
        if kind == "position":
            return p[["xyz".index(axis) for axis in axes]]
        if kind == "polar":
            return np.array([np.hypot(p[0], p[1]), np.arctan2(p[1], p[0])])
        E = np.array(task["reference"]).T @ R
        if axes:
            a = "xyz".index(axes)
            i, j = (a + 1) % 3, (a + 2) % 3
            turn = np.delete(E[:, a], a) * np.sqrt(2 / (1 + E[a, a]))
            if kind in ("orientation", "pose"):
                turn = np.append(turn, np.arctan2(E[j, i] - E[i, j], E[i, i] + E[j, j]))
        else:
            turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / np.sqrt(1 + np.trace(E))
        return np.concatenate([p, turn]) if kind in ("pose", "position+axis") else turn

    def xi(self, q: Array) -> Array:
        theta, offset, scale = (self.arrays[name] for name in ("theta", "offset", "scale"))
        own = np.zeros(0)
        if len(offset):
            family: Callable[..., Array] = getattr(self, self.header["coordinates"]["parametrisation"].lower())
            own = scale * (family(q[self.active], theta, **self.header["coordinates"]["settings"]) - offset)
        return np.concatenate([own, q[self.idle] - self.arrays["domain_centre"][self.idle]])

    def linear(self, q: Array, theta: Array, **_: Any) -> Array:
        return theta.reshape(-1, len(q)) @ (q - self.arrays["domain_centre"][self.active])

    def polynomial(self, q: Array, theta: Array, degree: int, cyclic: list[str], without: Any = ()) -> Array:
        u = (q - self.arrays["domain_centre"][self.active]) / self.arrays["domain_half_width"][self.active]
        P = np.array([np.polynomial.legendre.legval(u, np.eye(degree + 1)[k]) for k in range(degree + 1)])
        return self.products(
            P * np.sqrt(2 * np.arange(degree + 1) + 1)[:, None], range(degree + 1), degree, cyclic, without, theta
        )

    def fourier(self, q: Array, theta: Array, degree: int, cyclic: list[str], without: Any = ()) -> Array:
        waves = [np.sqrt(2) * wave(k * q) for k in range(1, degree + 1) for wave in (np.cos, np.sin)]
        for i in self.places(cyclic):
            waves[0][i] = q[i] - self.arrays["domain_centre"][self.active][i]
        degrees = [0, *(k for k in range(1, degree + 1) for _ in range(2))]
        return self.products(np.array([np.ones(len(q)), *waves]), degrees, degree, cyclic, without, theta)

    def places(self, names: Any) -> list[int]:
        return [i for i, joint in enumerate(self.active) if self.names[joint] in names]

    def products(self, f: Array, degrees: Any, total: int, cyclic: Any, without: Any, theta: Array) -> Array:
        n, linear, none = f.shape[1], self.places(cyclic), self.places(without)

        def terms(joint: int, left: int) -> Iterator[tuple[int, ...]]:
            if joint == n:
                yield ()
                return
            for k, degree in enumerate([0] if joint in linear + none else degrees):
                if degree <= left:
                    yield from ((k, *rest) for rest in terms(joint + 1, left - degree))

        chosen = [term for term in terms(0, total) if any(term)]
        chosen += [tuple(int(i == k) for i in range(n)) for k in linear]
        psi = np.array([np.prod(f[list(term), range(n)]) for term in chosen])
        return theta.reshape(-1, len(psi)) @ psi

    def mlp(
        self, q: Array, theta: Array, hidden: list[int], raw: bool, activation: str = "tanh", **others: list[str]
    ) -> Array:
        cyclic, without = others.get("cyclic", []), others.get("without", [])
        of = np.tanh if activation == "tanh" else lambda z: z / np.sqrt(1 + z**2)
        kinds = [self.header["robot"]["joint_kinds"][i] for i in self.active]
        linear = self.places(cyclic)
        inputs = [i for i in range(len(q)) if i not in linear + self.places(without)]
        turning = [i for i in inputs if kinds[i] == "revolute" and not raw]
        direct = [i for i in inputs if i not in turning]
        y, used = np.concatenate([np.sin(q[turning]), np.cos(q[turning]), q[direct]]), 0
        widths = [len(y), *hidden, len(self.arrays["offset"])]
        for layer, (width, out) in enumerate(pairwise(widths)):
            W = theta[used : used + out * width].reshape(width, out).T
            y = W @ y + theta[used + out * width :][:out]
            y, used = y if layer == len(hidden) else of(y), used + out * (width + 1)
        return y + theta[used:].reshape(len(linear), len(y)).T @ q[linear]


def require_equal(path: Path, chart: oc.Chart) -> None:
    reader = Reader(path)
    for q in sample_uniform(chart.problem.domain, 20, 3):
        np.testing.assert_allclose(reader.phi(q), chart.phi(q), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["panda-position", "iiwa7-pose", "pr2-left-position", "ur5-position"])
def test_reader_from_the_page_gives_phi_of_ready_charts(name: str) -> None:
    """Idle and cyclic joints, a prismatic joint, and a reference rotation are among them."""
    require_equal(DATA / f"{name}.orthocas", oc.charts.load(name))


@pytest.mark.slow
@pytest.mark.parametrize("family", [oc.Linear(), oc.Fourier(2), oc.MLP((4, 3)), oc.MLP((4,), raw=True)])
def test_reader_from_the_page_gives_phi_of_all_families(family: Any, planar_xy: oc.Problem, tmp_path: Path) -> None:
    chart = oc.fit(planar_xy, family, samples=100).chart
    chart.save(tmp_path / "arm.orthocas")
    require_equal(tmp_path / "arm.orthocas", chart)


@pytest.mark.parametrize("kind", ["orientation", "orientation:y", "pose:z", "axis:x", "position+axis:z", "polar"])
def test_reader_from_the_page_gives_the_tasks(kind: str, iiwa: oc.Problem, tmp_path: Path) -> None:
    task = oc.Task.named(iiwa.robot, kind, iiwa.domain.centre)
    box = oc.Box(iiwa.domain.centre + 0.1, 0.2)
    chart = oc.fit(oc.Problem(iiwa.robot, task, domain=box), oc.Linear()).chart
    chart.save(tmp_path / "arm.orthocas")
    require_equal(tmp_path / "arm.orthocas", chart)


def test_reader_from_the_page_reads_joints_that_enter_linearly_or_not_at_all(
    planar_xy: oc.Problem, tmp_path: Path
) -> None:
    robot = planar_xy.robot
    problem = oc.Problem(robot, oc.Task.position(robot, "xy"), domain=oc.Box([0.6, 0.8, 0.8], [0.3, 0.2, 0.2]))
    rest: dict[str, Any] = {"cyclic": "auto", "without": ["q3"]}
    network = oc.MLP((4, 3), **rest, activation="isru")
    for family in (oc.Polynomial(3, **rest), oc.Fourier(2, **rest), network):
        chart = oc.fit(problem, family, samples=100).chart
        chart.save(tmp_path / f"{family.label[:4]}.orthocas")
        settings = Reader(tmp_path / f"{family.label[:4]}.orthocas").header["coordinates"]["settings"]
        assert (settings["cyclic"], settings["without"]) == (["q1"], ["q3"])
        require_equal(tmp_path / f"{family.label[:4]}.orthocas", chart)
