"""Campaign of files of joint motions: what is read moves the robot, or the error names the file and what is wrong."""

import struct
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from public_objects import joint_motion, planar

from fuzz.child import Finding, run
from fuzz.mutants import TEXTS, Rng, flipped, pick
from fuzz.sealed_files import judged
from orthocas.paths.joint_motion import read_joints
from orthocas.viewer.motion import read_joint_motion

_CELLS = ("0", "nan", "-1e999", "1e300", "", " ", "a", '"1"', '"1', "1_0", "0x10", "time_s", "q1", "d_q1", *TEXTS)


def motions(count: int) -> list[Finding]:
    """Judge so many mutants."""
    return run("motions", judge, range(count))


def judge(seed: int) -> str | None:
    """What is wrong with the treatment of a mutant, as a motion to show or as a recording."""
    return judged(_mutant, use, seed) if seed % 2 else judged(_recording if seed % 4 else _mutant, use_recording, seed)


def use_recording(path: Path) -> None:
    """Read recorded joints; they have to be finite, at times that do not decrease."""
    times, q = read_joints(path, planar().robot)
    assert len(times) == len(q)
    assert np.isfinite(q).all()
    assert (np.diff(times) >= 0).all()


def use(path: Path) -> None:
    """Read a motion; it has to have a joint position at every time."""
    motion = read_joint_motion(path, planar().robot)
    assert motion.values.shape == (len(motion.times), len(motion.labels))
    for seconds in (0.0, motion.duration / 2, 1e9):
        assert np.isfinite(motion.at(seconds)).all()
        assert 0 <= motion.index(seconds) < len(motion.times)


@cache
def _text() -> str:
    with TemporaryDirectory() as folder:
        joint_motion().save_csv(Path(folder, "q.csv"))
        return Path(folder, "q.csv").read_text()


def _recording(rng: Rng) -> bytes:
    """What begins as an MCAP file, with damaged bytes."""
    length = struct.pack("<Q", int(rng.integers(0, 2**40)))
    content = bytes(rng.integers(256, size=200, dtype=np.uint8))
    return b"\x89MCAP0\r\n" + pick(rng, (content, b"\x01" + length + content, b"\x06" + length, b""))


def _mutant(rng: Rng) -> bytes:
    table = [line.split(",") for line in _text().splitlines()[: int(rng.integers(2, 9))]]
    for _ in range(int(rng.integers(0, 3))):
        row = table[0] if rng.random() < 0.3 else table[int(rng.integers(len(table)))]
        k = int(rng.integers(len(row)))
        row[k : k + int(rng.integers(2))] = [pick(rng, _CELLS)] * int(rng.integers(2))
    content = "\n".join(",".join(row) for row in table).encode(errors="surrogatepass")
    odd = (
        flipped(rng, content),
        content[: int(rng.integers(len(content)))],
        content.replace(b",", b";"),
        content.decode(errors="replace").encode("utf-16"),
        b"\n" * 10**6,
        bytes(10**5),
        content + b"\n" + b"1," * 10**6,
        b"",
    )
    return content if rng.random() < 0.7 else bytes(odd[int(rng.integers(len(odd)))])
