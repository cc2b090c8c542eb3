"""Shared libraries of C sources: compiled for this process or an earlier one, kept by their content, and loaded."""

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
    """The shared library of C sources, compiled now or earlier: its name is a digest of sources, compiler and flags.

    Args:
        kind: begins the name of the library.
        sources: contents of the files by name.
        flags: of the compiler.
        folder: where libraries are kept; default `orthocas/libraries` in $XDG_CACHE_HOME or ~/.cache.

    Raises:
        CompileError: if there is no C compiler, or it fails, or there is no folder of the user's own.
        InvalidValueError: if the folder cannot be written.
    """
    compiler, options = _choose_compiler(), ("-std=c99", "-fPIC", "-shared", *flags)
    content = [*(text.encode() for text in sources.values()), repr((compiler, options)).encode()]
    name = f"{kind}-{hashlib.sha256(b'/'.join(content)).hexdigest()[:32]}.so"
    place = _find_cache() if folder is None else as_path("folder", folder)
    library = make_folder("folder", place, mode=0o700).resolve() / name
    _require_own(library.parent)
    # Draft and checksum appear together, so that other processes never see half a library.
    if not _is_whole(library):
        with open_draft_folder() as place, publish(library.parent) as drafts:
            for file, text in sources.items():
                (place / file).write_text(text, encoding="utf-8")
            # Files that others include are a part of those.
            included = {name for text in sources.values() for name in _INCLUDED.findall(text)}
            code = [str(place / file) for file in sources if file.endswith(".c") and file not in included]
            run_program([*compiler, *options, "-o", str(drafts / name), *code, "-lm"])
            if not (drafts / name).is_file():
                raise CompileError(f"{' '.join(compiler)} wrote no library, expected a compiler of C")
            (drafts / f"{name}.sha256").write_text(compute_digest(drafts / name))
    return library


def _choose_compiler() -> tuple[str, ...]:
    """The command that compiles C: a compiler on the PATH, or that of the package ziglang, which pip installs anywhere.

    Raises:
        CompileError: if there is neither.
    """
    try:
        return (find_compilers()[0],)
    except CompileError:
        if importlib.util.find_spec("ziglang") is None:
            raise
        return (sys.executable, "-m", "ziglang", "cc")


def find_compilers() -> tuple[str, ...]:
    """Compilers: those of gcc and clang that are on the PATH, or cc if neither is.

    Raises:
        CompileError: if there is no compiler.
    """
    result = [path for name in ("gcc", "clang") if (path := shutil.which(name)) is not None]
    result = result or [path for path in (shutil.which("cc"),) if path is not None]
    if not result:
        raise CompileError(
            "no C compiler found, expected gcc, clang or cc on the PATH: apt install gcc, xcode-select --install, or "
            "pip install ziglang, which suffices for all that is compiled while Python runs"
        )
    return tuple(result)


def _find_cache() -> Path:
    """Where libraries are kept by default.

    Raises:
        CompileError: if the user has no home.
    """
    # Relative paths in XDG_CACHE_HOME do not count, as its specification demands.
    place = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (place if place.is_absolute() else Path.home() / ".cache") / "orthocas" / "libraries"
    except RuntimeError:
        raise CompileError("no folder for compiled libraries: this user has no home, set XDG_CACHE_HOME") from None


def load_library(library: Path) -> ctypes.CDLL:
    """Load a library that was kept.

    Raises:
        CompileError: if it is damaged or missing, or others could have put it there.
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
    """Refuse libraries that others could have written: they would run with our rights.

    Raises:
        CompileError: if a folder or file belongs to somebody else but root, or others may write there.
    """
    # On Windows, the rights of a folder come from the one above.
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
    """Whether a library is complete: the system ends processes that load half of one."""
    try:
        return library.with_name(f"{library.name}.sha256").read_text() == compute_digest(library)
    except (OSError, ValueError):
        return False


def pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    """The place of an array, contiguous, that somebody else keeps until the call ends. `data_as` takes microseconds."""
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.__array_interface__["data"][0])
