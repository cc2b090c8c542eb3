"""Shared libraries that are compiled once and kept in the user's cache (ours)."""

import ctypes
import hashlib
import os
import subprocess
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path

from orthocas.checks import as_path
from orthocas.codegen.library import compilers
from orthocas.errors import CompileError
from orthocas.files.atomic import made_folder, published
from orthocas.files.drafts import draft_folder


def kept_library(kind: str, sources: Mapping[str, str], flags: Sequence[str], folder: str | Path | None = None) -> Path:
    """The shared library of C sources, compiled now or earlier: its name is a digest of sources, compiler and flags.

    Args:
        kind: begins the name of the library.
        sources: contents of the files by name.
        flags: of the compiler.
        folder: where libraries are kept; default `orthocas` in $XDG_CACHE_HOME or ~/.cache.

    Raises:
        CompileError: if there is no C compiler, or it fails.
        InvalidValueError: if the folder cannot be written.
    """
    compiler, options = compilers()[0], ("-std=c99", "-fPIC", "-shared", *flags)
    content = [*(text.encode() for text in sources.values()), repr((compiler, options)).encode()]
    name = f"{kind}-{hashlib.sha256(b'/'.join(content)).hexdigest()[:32]}.so"
    library = made_folder("folder", _cache() if folder is None else as_path("folder", folder)).resolve() / name
    if not library.exists():
        with draft_folder() as place, published(library.parent) as drafts:
            for file, text in sources.items():
                (place / file).write_text(text, encoding="utf-8")
            code = [str(place / file) for file in sources if file.endswith(".c")]
            _compile([compiler, *options, "-o", str(drafts / name), *code, "-lm"])
    return library


def loaded(library: Path) -> ctypes.CDLL:
    """Load a library that was kept.

    Raises:
        CompileError: if it is damaged.
    """
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise CompileError(f"cannot load {library}: {error}; delete it and compile again") from None


def template(name: str) -> str:
    """A file of `templates/`."""
    return (files(__package__) / "templates" / name).read_text()


def _compile(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise CompileError(f"{' '.join(command)} failed: {done.stderr[:500]}")


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "orthocas"
