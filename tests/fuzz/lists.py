"""Campaign of lists of what was written to a folder: only a file that is listed as it is now counts as ours."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fuzz.child import Finding, run, verdict
from fuzz.mutants import Rng, changed_data, flipped, pick
from orthocas.tools.files import LIST, compute_digest, is_listed, read_list, write_list


def lists(count: int) -> list[Finding]:
    """Judge so many mutants."""
    return run("lists", judge, range(count))


def judge(seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return verdict(lambda: _use(np.random.default_rng(seed)))


def _use(rng: Rng) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "arm.c"
        file.write_bytes(b"int answer;\n")
        file.with_name(LIST).write_text(write_list(file.parent, [file]), encoding="utf-8")
        assert is_listed(file)
        if rng.integers(2):
            file.write_bytes(flipped(rng, file.read_bytes()))
        file.with_name(LIST).write_bytes(_mutant(rng, file.with_name(LIST).read_bytes()))
        known = read_list(file.parent)
        assert all(isinstance(entry, str) for name in known for entry in (name, *known[name]))
        assert is_listed(file) == (compute_digest(file) in known.get(file.name, []))
        assert b"answer;" in file.read_bytes() or not is_listed(file), "a changed file counts as ours"
        assert json.loads(write_list(file.parent, [file]))["files"][file.name][-1] == compute_digest(file)


def _mutant(rng: Rng, content: bytes) -> bytes:
    """A list with other values, a byte turned, or something else."""
    if rng.integers(3):
        data: Any = json.loads(content)
        for _ in range(int(rng.integers(0, 3))):
            data = changed_data(rng, data)
        return json.dumps(data).encode()
    odd = (b"", b"\xff", b"[" * 10**5, b'{"files": []}', b'{"files": {"arm.c": 1}}', b"1" * 5000)
    coded = content.decode().encode("utf-16")
    return pick(rng, (flipped(rng, content), content[: int(rng.integers(len(content)))], coded, *odd))
