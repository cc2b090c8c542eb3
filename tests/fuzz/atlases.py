"""Campaign of atlas files: a file opens and gives numbers, or one error says what is wrong with it."""

import hashlib
import json
import struct
import zlib
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from public_objects import atlas

import orthocas as oc
from fuzz.child import Finding, run
from fuzz.mutants import Rng, changed_data, flipped, pick
from fuzz.sealed_files import judged
from orthocas.atlases.atlas_file import ATLAS
from orthocas.files.blocks import scan, sealed

_PREFIX, _BLOCK = struct.Struct("<16sQ32s"), struct.Struct("<4sIQQ")


def atlases(count: int) -> list[Finding]:
    """Judge so many mutants."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "arm"
        path.write_bytes(atlas().path.read_bytes())
        return run("atlases", partial(judge, path), range(count))


def judge(original: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return judged(partial(mutant, original), use, seed)


def use(path: Path) -> None:
    """Open an atlas and evaluate it."""
    found = oc.Atlas.load(path)
    n = found.problem.n
    q = found.problem.domain.centre + np.random.default_rng(0).uniform(-1, 1, (30, n)) * found.problem.domain.half_width
    numbers = found.chart_at(q)
    xi = found.xi(q, numbers)
    assert xi.shape == (30, found.problem.r)
    assert np.isnan(xi[numbers < 0]).all()
    assert len(repr(found)) < 10**4
    for number in sorted(set(numbers[numbers >= 0].tolist()))[:2]:
        found.chart(number)


def mutant(original: Path, rng: Rng) -> bytes:
    """A file with another header, another head or body of a block, a bit turned, or cut off."""
    content, act = original.read_bytes(), rng.integers(10)
    found = scan(original, ATLAS)
    begin = len(sealed(found.header, ATLAS))
    if act < 4:
        header = found.header
        for _ in range(int(rng.integers(1, 3))):
            header = changed_data(rng, header)
        return _sealed(header) + content[begin:]
    block = found.blocks[int(rng.integers(len(found.blocks)))]
    start = block.body - len(block.head) - _BLOCK.size
    if act < 7:
        head = bytearray(block.head)
        for _ in range(int(rng.integers(1, 4))):
            head[int(rng.integers(len(head)))] = int(pick(rng, (0, 1, 2, 5, 127, 128, 255)))
        part = _BLOCK.pack(block.tag, zlib.crc32(head), len(head), block.length) + bytes(head)
        return content[:start] + part + content[block.body :]
    if act < 8:
        lengths = [int(pick(rng, (0, 1, 2**31, 2**63, len(block.head), block.length))) for _ in range(2)]
        return content[:start] + _BLOCK.pack(block.tag, zlib.crc32(block.head), *lengths) + content[start + 24 :]
    return flipped(rng, content) if act < 9 else content[: int(rng.integers(len(content)))]


def _sealed(header: Any) -> bytes:
    """A header that may be anything, with its checksum."""
    text = json.dumps(header).encode()
    return _PREFIX.pack(ATLAS.magic + bytes([ATLAS.version]), len(text), hashlib.sha256(text).digest()) + text
