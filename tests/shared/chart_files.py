"""Chart files to take apart and to put together again."""

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path

from orthocas.tools import archive


def rewritten(path: Path, changes: dict[str, bytes], honest: bool = True, without: Sequence[str] = ()) -> Path:
    """Replace entries and drop some; honest repairs the header's checksum, as a newer program would write it."""
    with zipfile.ZipFile(path) as source:
        entries = {name: source.read(name) for name in source.namelist() if name not in without} | changes
    if honest:
        entries["digest.txt"] = archive._compute_digest(entries["header.json"]).encode()
    with zipfile.ZipFile(path, "w") as target:
        for name, content in entries.items():
            target.writestr(name, content)
    return path


def header_of(path: Path) -> dict[str, object]:
    with zipfile.ZipFile(path) as source:
        return dict(json.loads(source.read("header.json")))


def polynomial(degree: int, idle: list[object] | None = None) -> dict[str, object]:
    return {"parametrisation": "Polynomial", "settings": {"degree": degree}, "idle": idle or []}


def resealed(path: Path, header: dict[str, object] | None = None, **arrays: object) -> Path:
    """Another header, or other arrays, with checksums that match."""
    contents = {
        f"{name}.npy": value if isinstance(value, bytes) else archive.write_npy(value) for name, value in arrays.items()
    }  # type: ignore[arg-type]
    header = header or header_of(path)
    sums = {**header["sha256"], **{name: archive._compute_digest(text) for name, text in contents.items()}}  # type: ignore[dict-item]
    return rewritten(path, {"header.json": json.dumps({**header, "sha256": sums}).encode(), **contents})
