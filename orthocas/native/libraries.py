"""Shared libraries from C sources: compiled once, stored under a digest of their sources, and loaded."""

import ctypes
import hashlib
import importlib.util
import os
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from orthocas.errors import CompileError
from orthocas.tools.checks import as_path
from orthocas.tools.files import compute_digest, make_folder, open_draft_folder, publish
from orthocas.tools.processes import run_program

_INCLUDED = re.compile(r'^#include "(\w+\.c)"', re.MULTILINE)


def keep_library(kind: str, sources: Mapping[str, str], flags: Sequence[str], folder: str | Path | None = None) -> Path:
    """Path of the shared library of C sources. It is compiled unless there is one from an earlier call.

    Its name contains a digest of sources, compiler and flags.

    Args:
        kind: first part of the library's name.
        sources: contents of the files by name.
        flags: flags of the compiler.
        folder: folder of the libraries. Default: `orthocas/libraries` in $XDG_CACHE_HOME or ~/.cache.

    Raises:
        CompileError: if there is no C compiler, it fails, or the folder is not the user's own.
        InvalidValueError: if the folder cannot be written.
    """
    # The compiler is one on the PATH, else that of the pip package ziglang.
    compiler: tuple[str, ...]
    try:
        compiler = (find_compilers()[0],)
    except CompileError:
        if importlib.util.find_spec("ziglang") is None:
            raise
        compiler = (sys.executable, "-m", "ziglang", "cc")
    options = ("-std=c99", "-fPIC", "-shared", *flags)
    content = [*(text.encode() for text in sources.values()), repr((compiler, options)).encode()]
    name = f"{kind}-{hashlib.sha256(b'/'.join(content)).hexdigest()[:32]}.so"
    place = _find_cache() if folder is None else as_path("folder", folder)
    library = make_folder("folder", place, mode=0o700).resolve() / name
    _require_own(library.parent)
    # Publish library and checksum together, so that other processes never see half a library.
    if not _is_whole(library):
        with open_draft_folder() as place, publish(library.parent) as drafts:
            for file, text in sources.items():
                (place / file).write_text(text, encoding="utf-8")
            # Files that are included by others are not compiled on their own.
            included = {name for text in sources.values() for name in _INCLUDED.findall(text)}
            code = [str(place / file) for file in sources if file.endswith(".c") and file not in included]
            run_program([*compiler, *options, "-o", str(drafts / name), *code, "-lm"])
            if not (drafts / name).is_file():
                raise CompileError(f"{' '.join(compiler)} wrote no library, expected a C compiler")
            (drafts / f"{name}.sha256").write_text(compute_digest(drafts / name))
    return library


def find_compilers() -> tuple[str, ...]:
    """C compilers on the PATH: gcc and clang, or cc if there is neither.

    Raises:
        CompileError: if there is no compiler.
    """
    result = [path for name in ("gcc", "clang") if (path := shutil.which(name)) is not None]
    result = result or [path for path in (shutil.which("cc"),) if path is not None]
    if not result:
        raise CompileError(
            "no C compiler found, expected gcc, clang or cc on the PATH: apt install gcc, xcode-select --install, or "
            "pip install ziglang, which is enough for C that orthocas compiles for its own use"
        )
    return tuple(result)


def _find_cache() -> Path:
    """Default folder of the libraries.

    Raises:
        CompileError: if the user has no home.
    """
    # Ignore relative paths in XDG_CACHE_HOME, as its specification demands.
    place = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (place if place.is_absolute() else Path.home() / ".cache") / "orthocas" / "libraries"
    except RuntimeError:
        raise CompileError("no folder for compiled libraries: this user has no home, set XDG_CACHE_HOME") from None


def load_library(library: Path) -> ctypes.CDLL:
    """Load a library of `keep_library`.

    Raises:
        CompileError: if it is damaged or missing, or other users could have written it.
    """
    _require_own(library.parent)
    if not _is_whole(library):
        raise CompileError(f"cannot load {library}: it does not match its checksum; compile again")
    _require_own(library)
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        raise CompileError(f"cannot load {library}: {error}; delete it and compile again") from None


def _require_own(place: Path) -> None:
    """Refuse a folder or file that other users could have written, because its code would run with our rights.

    Raises:
        CompileError: if it belongs to another user than this one or root, or others may write there.
    """
    # On Windows, folders inherit their rights, and there is no such check.
    if not hasattr(os, "geteuid"):
        return
    try:
        result = place.stat()
    except OSError as error:
        raise CompileError(f"cannot load {place}: {error.strerror}") from None
    if result.st_uid not in (os.geteuid(), 0):
        raise CompileError(f"no library is loaded from {place}: it belongs to user {result.st_uid}, expected your own")
    if result.st_mode & 0o022:
        raise CompileError(f"no library is loaded from {place}: others may write there, expected your own (chmod go-w)")


def _is_whole(library: Path) -> bool:
    """Whether a library matches its checksum. Loading an incomplete one would kill the process."""
    try:
        return library.with_name(f"{library.name}.sha256").read_text() == compute_digest(library)
    except (OSError, ValueError):
        return False


def pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    """Address of a contiguous array, faster than `data_as`. The caller must keep the array alive during the call."""
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.__array_interface__["data"][0])
