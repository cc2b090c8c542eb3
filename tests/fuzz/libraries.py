"""Campaign of kept libraries: one that is not as it was compiled, or that others could have written, is not loaded."""

import os
import subprocess
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fuzz.child import Finding, run, verdict
from fuzz.mutants import Rng, flipped, pick
from orthocas.native.libraries import find_compilers, keep_library, load_library

_SOURCE = "int answer(void) { return 42; }\n"


def libraries(count: int) -> list[Finding]:
    """Judge so many mutants."""
    with TemporaryDirectory() as folder:
        return run("libraries", partial(judge, Path(folder)), range(count))


def judge(folder: Path, seed: int) -> str | None:
    """What is wrong with the treatment of a mutant."""
    return verdict(lambda: _load(folder, np.random.default_rng(seed)))


@cache
def originals(folder: Path) -> tuple[bytes, bytes, str]:
    """A library, another one, and the checksum of the first."""
    library = keep_library("answer", {"answer.c": _SOURCE}, (), folder)
    other = folder / "other.so"
    source = folder / "other.c"
    source.write_text(_SOURCE.replace("42", "43"))
    subprocess.run([find_compilers()[0], "-fPIC", "-shared", "-o", str(other), str(source)], check=True)
    return library.read_bytes(), other.read_bytes(), library.with_name(f"{library.name}.sha256").read_text()


def _load(folder: Path, rng: Rng) -> None:
    """Each mutant has a folder of its own, since libraries stay loaded under their names."""
    content, other, checksum = originals(folder)
    with TemporaryDirectory(dir=folder) as place:
        library = Path(place) / "answer.so"
        written = pick(
            rng, (content, content, flipped(rng, content), content[: int(rng.integers(len(content)))], other)
        )
        given = pick(rng, (checksum, checksum, checksum.upper(), checksum[:-1], checksum + "\n", "", "\x00", "é" * 64))
        library.write_bytes(written)
        library.with_name("answer.so.sha256").write_bytes(given.encode())
        library.chmod(mode := pick(rng, (0o600, 0o755, 0o622, 0o666, 0o777)))
        Path(place).chmod(open_to := pick(rng, (0o700, 0o755, 0o770, 0o777)))
        answer = load_library(library).answer()
        assert (written, given) == (content, checksum), "a library is loaded that was changed"
        assert not (mode | open_to) & 0o022, "a library is loaded that others may write"
        assert os.name != "posix" or answer == 42
