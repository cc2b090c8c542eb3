"""Campaign of atlas files: a file opens and gives numbers, or one error says what is wrong with it."""

import hashlib
import json
import struct
import zlib
from base64 import b64decode, b64encode
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from public_objects import AROUND, atlas

import orthocas as oc
from fuzz.child import Finding, run
from fuzz.mutants import Rng, changed_array, changed_data, flipped, pick
from fuzz.sealed_files import judged
from orthocas.atlas.atlas_file import ATLAS, chart_type
from orthocas.atlas.coverage import evaluate_atlas
from orthocas.errors import AtlasFileError, OrthocasError
from orthocas.tools.block_file import scan, sealed

_PREFIX, _BLOCK, _CHECK = struct.Struct("<16sQ32s"), struct.Struct("<4sIQQ"), struct.Struct("<I")
VALUES = (0.0, -1.0, 0.5, 1e-320, 1e-9, 1e9, 1e300, 1e308, -1e308, np.nan, np.inf, -np.inf)


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
    """Open an atlas, evaluate it, go back to joint positions and into other charts, and go on building it."""
    before = path.read_bytes()
    _go_on(path)
    found = oc.Atlas.load(path)
    try:
        _evaluate(found)
    except OrthocasError as error:  # no file is to blame
        raise OrthocasError(f"mutant: {error}") from None
    assert path.read_bytes() == before


def _evaluate(found: oc.Atlas) -> None:
    n = found.problem.n
    q = found.problem.domain.centre + np.random.default_rng(0).uniform(-1, 1, (30, n)) * found.problem.domain.half_width
    numbers = found.chart_at(q)
    xi = found.xi(q, numbers)
    assert xi.shape == (30, found.problem.r)
    assert (np.isnan(xi).all(axis=1) == (numbers < 0)).all()
    assert len(repr(found)) < 10**4
    json.dumps(found.as_dict(), allow_nan=False)
    for number in sorted(set(numbers[numbers >= 0].tolist()))[:2]:
        found.chart(number)
    evaluate_atlas(found, 200, 0)


def _go_on(path: Path) -> None:
    """Go on building a copy: it is refused and stays as it is, or nothing of it is lost."""
    before, copy, plan = path.read_bytes(), path.with_name("mutant.copy"), atlas().plan
    copy.write_bytes(before)
    try:
        with ThreadPoolExecutor(1) as executor:
            again = oc.build_atlas(plan.problem, copy, plan.settings, time_limit=0, executor=executor, **AROUND)
    except AtlasFileError:
        assert copy.read_bytes() == before, "a refused file is changed"
        return
    rest = b"".join(other.read_bytes() for other in path.parent.glob("mutant.copy.rest*"))
    whole = before[: len(before) - len(rest)]
    assert copy.read_bytes()[: len(whole)] == whole, "bytes of the file are gone"
    assert rest == before[len(whole) :], "what was cut is not kept"
    assert len(rest) > 0 or len(again) == len(atlas()), "charts are gone"


def mutant(original: Path, rng: Rng) -> bytes:
    """A file with another header, other values, another head or body of a block, a bit turned, or cut off."""
    content, act = original.read_bytes(), rng.integers(14)
    found = scan(original, ATLAS)
    begin = len(sealed(found.header, ATLAS))
    if act < 3:
        header = found.header
        for _ in range(int(rng.integers(1, 3))):
            header = changed_data(rng, header)
        return _sealed(header) + content[begin:]
    if act < 7:
        arrays = dict(found.header["arrays"])
        name = pick(rng, sorted(arrays))
        arrays[name] = b64encode(changed_array(rng, b64decode(arrays[name]))).decode()
        return _sealed({**found.header, "arrays": arrays}) + content[begin:]
    block = found.blocks[int(rng.integers(len(found.blocks)))]
    start = block.body - len(block.head) - _BLOCK.size - _CHECK.size
    if act < 9:
        head = bytearray(block.head)
        for _ in range(int(rng.integers(1, 4))):
            head[int(rng.integers(len(head)))] = int(pick(rng, (0, 1, 2, 5, 127, 128, 255)))
        return content[:start] + header_of_block(block.tag, head, block.length) + bytes(head) + content[block.body :]
    if act < 10:
        lengths = [int(pick(rng, (0, 1, 2**31, 2**63, len(block.head), block.length))) for _ in range(2)]
        part = header_of_block(block.tag, block.head, lengths[1], lengths[0])
        return content[:start] + part + content[start + len(part) :]
    if act < 12:
        return content[:begin] + _with_values(rng, oc.Atlas.load(original), content[begin:], begin)
    return flipped(rng, content) if act < 13 else content[: int(rng.integers(len(content)))]


def header_of_block(tag: bytes, head: bytes | bytearray, length: int, head_length: int | None = None) -> bytes:
    """The header of a block, with checksums that match."""
    part = _BLOCK.pack(tag, zlib.crc32(head), len(head) if head_length is None else head_length, length)
    return part + _CHECK.pack(zlib.crc32(part))


def _with_values(rng: Rng, atlas: oc.Atlas, blocks: bytes, begin: int) -> bytes:
    """Blocks with another number in a chart, and a checksum that matches."""
    kind = chart_type(atlas.plan)
    place = int(pick(rng, atlas.stock.places.tolist())) - begin
    record = np.frombuffer(blocks, kind, 1, place).copy()
    numbers = record["numbers"].reshape(-1)
    numbers[int(rng.integers(numbers.size))] = pick(rng, VALUES)
    record["numbers"] = numbers.reshape(record["numbers"].shape)
    record["crc"] = zlib.crc32(record.tobytes()[4:])
    return blocks[:place] + record.tobytes() + blocks[place + kind.itemsize :]


def _sealed(header: Any) -> bytes:
    """A header that may be anything, with its checksum."""
    text = json.dumps(header).encode()
    return _PREFIX.pack(ATLAS.magic + bytes([ATLAS.version]), len(text), hashlib.sha256(text).digest()) + text
