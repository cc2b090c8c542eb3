"""Files of simulated runs: they keep everything, and damaged ones are refused with the field."""

import json
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import public_objects
import pytest

from orthocas.errors import TrajectoryFileError
from orthocas.simulation import (
    Trajectory,
)


def test_trajectory_file_keeps_everything(tmp_path: Path) -> None:
    run = public_objects.trajectory()
    run.save(tmp_path / "run.npz")
    again = Trajectory.load(tmp_path / "run.npz")
    for name in ("times", "q", "dq", "command", "status", "value", "reference", "storage", "dissipated_power"):
        np.testing.assert_array_equal(getattr(again, name), getattr(run, name))
    assert (again.controller, again.kind, again.outcome, again.labels) == (
        "impedance",
        "torque",
        run.outcome,
        run.labels,
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.npz"]
    whole = (tmp_path / "run.npz").read_bytes()
    for bad in (b"", whole[: len(whole) // 2], b"not a zip"):
        (tmp_path / "bad.npz").write_bytes(bad)
        with pytest.raises(TrajectoryFileError, match="not a trajectory file"):
            Trajectory.load(tmp_path / "bad.npz")
    rng = np.random.default_rng(6)
    for _ in range(60):  # flipped bytes: an error of ours, or the same run
        spoiled = bytearray(whole)
        spoiled[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
        (tmp_path / "bad.npz").write_bytes(bytes(spoiled))
        with suppress(TrajectoryFileError):
            np.testing.assert_array_equal(Trajectory.load(tmp_path / "bad.npz").q, run.q)
    np.savez(tmp_path / "foreign.npz", header="{}", q=run.q)
    with pytest.raises(TrajectoryFileError, match="not a trajectory file"):
        Trajectory.load(tmp_path / "foreign.npz")
    with pytest.raises(TrajectoryFileError, match="does not exist"):
        Trajectory.load(tmp_path / "none.npz")
    with pytest.raises(TrajectoryFileError, match="does not exist"):
        run.save(tmp_path / "no" / "run.npz")


def test_encrypted_and_garbled_arrays_are_damage(tmp_path: Path) -> None:
    """NumPy raises RuntimeError for the first and TokenError for the second."""
    file = tmp_path / "run.npz"
    np.savez(file, header="{}")
    whole = file.read_bytes()
    flags = whole.index(b"PK\x01\x02") + 8
    file.write_bytes(whole[:flags] + b"\x01" + whole[flags + 1 :])
    with pytest.raises(TrajectoryFileError, match="not a trajectory file"):
        Trajectory.load(file)
    public_objects.trajectory().save(file, force=True)
    with np.load(file) as arrays:
        names = arrays.files
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(f"{name}.npy", np.lib.format.magic(1, 0) + b"\x0b\x00{'descr': (")
    with pytest.raises(TrajectoryFileError, match="contains an array or a header that cannot be read"):
        Trajectory.load(file)


def resealed(run: Trajectory, path: Path, header: dict[str, Any], **arrays: Any) -> Path:
    """The file of a run with another header, or other arrays."""
    run.save(path)
    with np.load(path) as file:
        known = {name: file[name] for name in file.files}
    text = json.dumps(json.loads(str(known.pop("header"))) | header)
    np.savez(path, header=text, **known | arrays)
    return path


@pytest.mark.parametrize(
    ("header", "arrays", "message"),
    [
        ({"labels": "xyz"}, {}, "field 'labels' is 'xyz', expected a list"),
        ({"labels": []}, {}, "labels is empty, expected at least one name"),
        ({"joint_names": [1, 2, 3]}, {}, r"joint_names\[0\] is 1, expected printable text"),
        ({"kind": "force"}, {}, "unknown kind of command 'force'"),
        ({"outcome": []}, {}, r"field 'outcome' is \[\], expected text"),
        ({"controller": "a\u202eb"}, {}, "controller is 'a.u202eb', expected printable text"),
        ({"version": 2}, {}, "has version 2, this orthocas reads 1"),
        ({}, {"dq": np.zeros((2, 2))}, r"dq has shape \(2, 2\)"),
        ({}, {"storage": np.zeros(0)}, r"storage has shape \(0,\)"),
        ({}, {"status": np.full(51, 99)}, "status is 99, expected whole numbers from 0 to 14"),
        ({}, {"times": np.zeros(51)}, "times is empty or not increasing"),
        ({}, {"q": np.zeros((51, 3), dtype=complex)}, "contains an array or a header that cannot be read: no array"),
    ],
)
def test_inconsistent_trajectory_files_are_refused_with_the_field(
    tmp_path: Path, header: dict[str, Any], arrays: dict[str, Any], message: str
) -> None:
    run = public_objects.trajectory()
    assert len(run.times) == 51
    with pytest.raises(TrajectoryFileError, match=message):
        Trajectory.load(resealed(run, tmp_path / "run.npz", header, **arrays))
