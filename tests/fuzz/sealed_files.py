"""Mutants of our container files, of which a campaign says how they are made and used."""

import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fuzz.child import verdict
from fuzz.mutants import (
    Entries,
    Rng,
    bombed,
    changed_array,
    changed_data,
    changed_value,
    entries_of,
    flipped,
    packed,
    pick,
    sealed,
    with_tricks,
)
from orthocas.errors import OrthocasError


def judged(make: Callable[[Rng], bytes], read: Callable[[Path], object], seed: int) -> str | None:
    """Write the mutant of a seed, read it, and say what is wrong with its treatment: errors name the file too."""

    def call() -> None:
        try:
            read(path)
        except OrthocasError as error:
            if "mutant" not in str(error):
                raise AssertionError(f"an error that does not name the file: {error}") from None
            raise

    with TemporaryDirectory() as folder:
        path = Path(folder) / "mutant"
        path.write_bytes(make(np.random.default_rng(seed)))
        return verdict(call)


def mutant(original: Path, rng: Rng) -> bytes:
    """A file changed in its header, in its arrays, in the zip around them, or in any byte."""
    entries = entries_of(original)
    header = json.loads(entries["header.json"])
    arrays = {name: content for name, content in entries.items() if name.endswith(".npy")}
    act = rng.integers(20)
    if act < 9:
        for _ in range(int(rng.integers(1, 3))):
            header = changed_data(rng, header)
        return packed(sealed(header, arrays))
    if act < 16:
        for _ in range(int(rng.integers(1, 3))):
            arrays = changed_arrays(rng, arrays)
        return packed(sealed(header, arrays))
    if act < 17:
        header = {**header, pick(rng, ("version", "format", "sha256", "new")): changed_value(rng, 1)}
        return packed(sealed(header, arrays))
    if act < 18:
        return packed({**entries, (name := pick(rng, list(entries))): flipped(rng, entries[name])})
    return with_tricks(rng, sealed(header, arrays))


def changed_arrays(rng: Rng, arrays: Entries) -> Entries:
    """One array changed, left out, put in place of another, or added."""
    if not arrays:
        return {"new.npy": b""}
    name, act = pick(rng, list(arrays)), rng.integers(12)
    if act == 0:
        return {key: value for key, value in arrays.items() if key != name}
    if act == 1:
        return {**arrays, pick(rng, ("robot_new.npy", "leaf_new.npy", "new.npy", "theta")): arrays[name]}
    if act == 2:
        return {**arrays, name: arrays[pick(rng, list(arrays))]}
    return {**arrays, name: changed_array(rng, arrays[name])}


def bomb(original: Path, listed: bool, size: int) -> bytes:
    """A file with an entry of zeros of that size: a listed array, or one that the header does not know."""
    entries = entries_of(original)
    return bombed(entries, next(name for name in entries if name.endswith(".npy")) if listed else "bomb.npy", size)
