"""Chart files that are damaged, foreign or made up: one error each, and nothing in them is executed."""

import io
import json
import os
import tracemalloc
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from chart_files import header_of, polynomial, resealed, rewritten

import orthocas as oc
from orthocas.errors import ChartFileError, TrajectoryFileError
from orthocas.fitting.fit import Fit
from orthocas.simulation import Trajectory
from orthocas.tools import archive


def test_links_other_files_and_odd_targets_are_refused(planar_fit: Fit, tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    for force in (False, True):
        with pytest.raises(ChartFileError, match="it is a symbolic link"):
            planar_fit.chart.save(tmp_path / "link", force)
    with pytest.raises(ChartFileError, match=r"orthocas did not write the file that is there.*force"):
        planar_fit.chart.save(tmp_path / "real")
    assert (tmp_path / "real").read_text() == "old"
    for _ in range(2):  # the second time it replaces a chart, which needs no force
        planar_fit.chart.save(tmp_path / "real", force=not zipfile.is_zipfile(tmp_path / "real"))
        assert oc.load(tmp_path / "real").n == 3
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ChartFileError, match="not a writable file"):
        planar_fit.chart.save(tmp_path / "pipe")
    with pytest.raises(ChartFileError, match="File name too long"):
        planar_fit.chart.save(tmp_path / ("x" * 300))


def test_missing_foreign_and_truncated_files_are_named(saved: Path, tmp_path: Path) -> None:
    with pytest.raises(ChartFileError, match="does not exist"):
        oc.load(tmp_path / "nothing")
    with pytest.raises(ChartFileError, match="cannot read"):
        oc.load(tmp_path)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(ChartFileError, match="truncated, damaged or not a chart"):
        oc.load(tmp_path / "text")
    for begin in ("<?xml version='1.0'?><robot/>", "\ufeff  <robot name='a'>", "<mujoco/>"):
        (tmp_path / "arm.urdf").write_text(begin, encoding="utf-8")
        with pytest.raises(ChartFileError, match=r"XML file, perhaps of a robot \(Robot.from_file\), expected a chart"):
            oc.load(tmp_path / "arm.urdf")
    with zipfile.ZipFile(tmp_path / "zip", "w") as other:
        other.writestr("a.txt", "a")
    with pytest.raises(ChartFileError, match="not a chart file: it has no entry header.json"):
        oc.load(tmp_path / "zip")
    content = saved.read_bytes()
    for length in range(0, len(content), 997):
        saved.write_bytes(content[:length])
        with pytest.raises(ChartFileError):
            oc.load(saved)


def test_any_flipped_byte_is_an_error_or_harmless(planar_fit: Fit, saved: Path) -> None:
    content = saved.read_bytes()
    q = np.array([0.6, 0.8, 0.8])
    for place in np.random.default_rng(0).integers(0, len(content), 60):
        broken = bytearray(content)
        broken[place] ^= 0x41
        saved.write_bytes(bytes(broken))
        try:
            chart = oc.load(saved)
        except ChartFileError:
            continue
        np.testing.assert_array_equal(chart.phi(q), planar_fit.chart.phi(q))  # zip padding and time stamps


def test_array_that_numpy_cannot_read_is_an_error_of_ours(saved: Path) -> None:
    """Its checksum is right: whoever edited the file knew how."""
    garbled, header = np.lib.format.magic(1, 0) + b"\x0b\x00{'descr': (", header_of(saved)
    header["sha256"] = {**header["sha256"], "offset.npy": archive._compute_digest(garbled)}  # type: ignore[dict-item]
    with pytest.raises(ChartFileError, match="contains an array that cannot be read"):
        oc.load(rewritten(saved, {"offset.npy": garbled, "header.json": json.dumps(header).encode()}))


def test_edited_header_and_array_are_noticed(saved: Path) -> None:
    header = header_of(saved)
    header["problem"] = {**header["problem"], "name": "other"}  # type: ignore[dict-item]
    with pytest.raises(ChartFileError, match="edited: its header"):
        oc.load(rewritten(saved, {"header.json": json.dumps(header).encode()}, honest=False))
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3))
    with pytest.raises(ChartFileError, match=r"edited: entry offset\.npy"):
        oc.load(rewritten(saved, {"offset.npy": buffer.getvalue(), "header.json": json.dumps(header).encode()}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "version 99, this orthocas reads up to 1"),
        ({"format": "other"}, "has format 'other'"),
        ({"robot": {}}, "inconsistent: field 'joint_names' is missing, expected a list"),
        ({"coordinates": {"parametrisation": "Spline"}}, "inconsistent: unknown parametrisation"),
        ({"coordinates": polynomial(9)}, "inconsistent: theta has shape"),
        ({"coordinates": polynomial(4, idle=[0.0])}, "idle joint is 0.0"),
        ({"coordinates": {"parametrisation": 3}}, "inconsistent: unknown parametrisation '3'"),
        ({"robot": [1]}, r"inconsistent: field 'robot' is \[1\], expected an object"),
        ({"version": 0}, "version 0, expected 1"),
        ({"version": 1e999}, "not an orthocas chart"),
        (
            {"problem": {"name": "x", "task": {"kind": 3}, "metric": {}, "domain": "box"}},
            "field 'kind' is 3, expected text",
        ),
        (
            {
                "problem": {
                    "name": "x",
                    "task": {"kind": "position:x"},
                    "metric": {"kind": "euclidean"},
                    "domain": "sphere",
                }
            },
            "unknown domain 'sphere'",
        ),
        ({"coordinates": polynomial(4, idle=[77])}, "expected different indices below 3"),
        (
            {"problem": {"name": "x", "task": {"kind": "import os"}, "metric": {"kind": "euclidean"}, "domain": "box"}},
            "task",
        ),
        ({"sha256": "none"}, "not an orthocas chart"),
    ],
)
def test_newer_foreign_and_inconsistent_headers_are_refused(
    saved: Path, change: dict[str, object], message: str
) -> None:
    header = json.dumps(header_of(saved) | change).encode()
    with pytest.raises(ChartFileError, match=message):
        oc.load(rewritten(saved, {"header.json": header}))


def test_tapes_with_unknown_steps_are_refused(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    problem = oc.Problem(robot, oc.Task.custom(robot, "t", lambda q: q[0] ** 2 + q[1]))
    path = tmp_path / "c.orthocas"
    oc.fit(problem, oc.Polynomial(1)).chart.save(path)
    header = header_of(path)
    header["problem"]["task"]["tape"]["steps"][0][0] = "system"  # type: ignore[index]
    with pytest.raises(ChartFileError, match=r"step 0 of a tape is \['system', .*, expected a known operation"):
        oc.load(rewritten(path, {"header.json": json.dumps(header).encode()}))


def test_arrays_are_never_unpickled(saved: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    header = header_of(saved)
    header["sha256"] = {**header["sha256"], "theta.npy": archive._compute_digest(buffer.getvalue())}  # type: ignore[dict-item]
    with pytest.raises(ChartFileError, match="cannot be read"):
        oc.load(rewritten(saved, {"theta.npy": buffer.getvalue(), "header.json": json.dumps(header).encode()}))


def test_failed_write_leaves_the_old_file(planar_fit: Fit, saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()

    def full_disk(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("orthocas.tools.files.os.fsync", full_disk)
    with pytest.raises(ChartFileError, match="No space left"):
        planar_fit.chart.save(saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_bad_output_places_are_refused(planar_fit: Fit, tmp_path: Path) -> None:
    with pytest.raises(ChartFileError, match="does not exist"):
        planar_fit.chart.save(tmp_path / "no" / "chart")
    with pytest.raises(ChartFileError, match="is a folder"):
        planar_fit.chart.save(tmp_path)
    with pytest.raises(ChartFileError, match="cannot write /proc/chart"):  # a folder where even root cannot write
        planar_fit.chart.save("/proc/chart")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="POSIX")
def test_devices_and_pipes_are_not_read(tmp_path: Path) -> None:
    """Some of them never end, and some never begin."""
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/full"), Path("/dev/zero"), tmp_path / "pipe"):
        with pytest.raises(ChartFileError, match=f"cannot read chart file {path}: it is a device or a pipe"):
            oc.load(path)
        with pytest.raises(TrajectoryFileError, match="it is a device or a pipe"):
            Trajectory.load(path)
        with pytest.raises(ChartFileError, match="it is not a writable file"):
            oc.fit(oc.problems.get("planar_3r_x"), oc.Linear()).chart.save(path)


def test_a_huge_degree_is_compared_with_the_parameters_before_a_basis_is_built(saved: Path) -> None:
    header = header_of(saved) | {"coordinates": polynomial(10**9)}
    with pytest.raises(ChartFileError, match="theta has shape"):  # building it would take gigabytes and hours
        oc.load(resealed(saved, header))


@pytest.mark.slow
def test_entries_that_the_header_does_not_list_are_left_alone(saved: Path, planar_fit: Fit) -> None:
    with zipfile.ZipFile(saved, "a", zipfile.ZIP_DEFLATED) as file:
        file.writestr("unlisted.npy", bytes(2**26))
    tracemalloc.start()
    chart = oc.load(saved)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24
    np.testing.assert_array_equal(chart.phi([0.6, 0.8, 0.8]), planar_fit.chart.phi([0.6, 0.8, 0.8]))


@pytest.mark.slow
def test_a_listed_entry_that_unpacks_to_far_more_than_the_file_is_refused(saved: Path) -> None:
    resealed(saved, theta=np.zeros(2**22))
    with zipfile.ZipFile(saved) as source:
        entries = {name: source.read(name) for name in source.namelist()}
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as target:
        for name, content in entries.items():
            target.writestr(name, content)
    with pytest.raises(ChartFileError, match="unpacks to 32 MiB, expected at most 8 MiB"):
        oc.load(saved)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_unusual_packings_and_entries_that_come_twice_are_refused(saved: Path, method: int) -> None:
    with zipfile.ZipFile(saved) as source:
        entries = {name: source.read(name) for name in source.namelist()}
    with zipfile.ZipFile(saved, "w", method) as target:
        for name, content in entries.items():
            target.writestr(name, content)
    with pytest.raises(ChartFileError, match="packed otherwise than stored or deflated"):
        oc.load(saved)
    with zipfile.ZipFile(saved, "a") as target, pytest.warns(UserWarning, match="Duplicate name"):
        target.writestr("theta.npy", b"")
    with pytest.raises(ChartFileError, match="entries, .* of them different"):
        oc.load(saved)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('"notes": {"a": NaN', "it holds NaN, expected finite numbers"),
        ('"notes": {"a": 1e999', "it holds 1e999, expected finite numbers"),
        ('"notes": {"a": 1, "a": 2', "the key 'a' appears twice in one object"),
        ('"notes": {"a": "\\ud800"', "it holds half a surrogate pair"),
        ('"notes": {"a": [1]', r"note 'a' is \[1\], expected text or a number"),
        ('"notes": {"\\u202e": 1', "name of a note is '.u202e', expected printable text"),
    ],
)
def test_notes_hold_texts_and_finite_numbers(saved: Path, text: str, message: str) -> None:
    header = json.dumps(header_of(saved) | {"notes": {}}).replace('"notes": {', text)
    with pytest.raises(ChartFileError, match=message):
        oc.load(rewritten(saved, {"header.json": header.encode()}))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"robot_masses": [1.0, -1.0, 1.0]}, "has mass -1 kg, expected >= 0"),
        ({"robot_armatures": [0.0, 0.0, -1.0]}, "joint 'q3' has armature -1, expected >= 0"),
        ({"robot_inertias": -np.stack([np.eye(3)] * 3)}, "principal moment of inertia -1 kg m.2, expected >= 0"),
        ({"robot_inertias": np.stack([np.triu(np.ones((3, 3)))] * 3)}, "inertia matrix that is not symmetric"),
        ({"robot_rotations": np.zeros((3, 3, 3))}, r"rotations\[0\] is .*, expected a rotation matrix"),
        ({"robot_rotations": -np.stack([np.eye(3)] * 3)}, r"rotations\[0\] is .*, expected a rotation matrix"),
        ({"robot_translations": np.full((3, 3), 1e300)}, r"largest entry of translations at joint .* is 1e\+300"),
        ({"robot_lower": [np.inf] * 3, "robot_upper": [np.inf] * 3}, r"limits \[inf, inf\]"),
        ({"theta": np.zeros(34, dtype=complex) * 2}, "contains an array that cannot be read: theta.npy"),
        ({"theta": archive.write_npy(np.zeros(3))[:-1]}, "23 bytes for the shape"),
        ({"scale": np.full(2, 1e308), "offset": np.full(2, -1e308)}, "xi is not finite at any of 8 points"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_numbers_that_no_chart_has_are_refused(saved: Path, arrays: dict[str, object], message: str) -> None:
    with pytest.raises(ChartFileError, match=message):
        oc.load(resealed(saved, **{k: v if isinstance(v, bytes) else np.array(v) for k, v in arrays.items()}))


def test_tapes_of_given_coordinates_are_checked(planar_x: oc.Problem, tmp_path: Path) -> None:
    given = oc.Given.from_function("hand", 3, lambda q: ca.vertcat(q[1], ca.sin(q[2])))
    path = tmp_path / "chart"
    for step, change in (("const", ["const", 0, 1e301]), ("input", ["input", 0, 3]), ("sin", ["sin", 0, 99])):
        oc.fit(planar_x, given).chart.save(path)
        header = header_of(path)
        header["coordinates"]["settings"]["tape"]["steps"][0] = change  # type: ignore[index]
        with pytest.raises(ChartFileError, match=rf"step 0 of a tape is \['{step}', .*, expected a known operation"):
            oc.load(resealed(path, header))


def test_tasks_that_are_nowhere_finite_are_refused(tmp_path: Path) -> None:
    robot = oc.Robot.planar([1.0, 1.0], [1.0, 1.0])
    path = tmp_path / "chart"
    oc.fit(oc.Problem(robot, oc.Task.custom(robot, "t", lambda q: q[0] - 99 + q[1])), oc.Polynomial(1)).chart.save(path)
    header = header_of(path)
    steps = header["problem"]["task"]["tape"]["steps"]  # type: ignore[index]
    steps.insert(-1, ["log", steps[-1][2], steps[-1][2]])
    with pytest.raises(ChartFileError, match="the task is not finite at any of 8 points"):
        oc.load(resealed(path, header))
