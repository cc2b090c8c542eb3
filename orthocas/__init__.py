"""orthocas: joint-space coordinates that a redundant robot's task does not disturb, with CasADi."""

import os as _os
import sys as _sys
from itertools import pairwise as _pairwise
from types import TracebackType as _TracebackType


def _is_command_line() -> bool:
    """Whether this process is the command `orthocas` or `python -m orthocas`, not a program that imports orthocas."""
    words = _sys.orig_argv[1:]
    script = _sys.argv[0] if _sys.argv else ""
    as_script = _os.path.splitext(_os.path.basename(script))[0] == "orthocas" and script in words
    return as_script or ("-m", "orthocas") in _pairwise(words)


def _leave(kind: type[BaseException], error: BaseException, trace: _TracebackType | None) -> None:
    """End the process after Ctrl-C without a traceback, until `leave_on_ctrl_c` does."""
    if issubclass(kind, KeyboardInterrupt):
        _os.write(2, b"orthocas: interrupted\n")
        _os._exit(130)
    _sys.__excepthook__(kind, error, trace)


if _is_command_line():
    _sys.excepthook = _leave  # at once: whatever is imported takes milliseconds, in which Ctrl-C may come
    from orthocas.cli.entry import leave_on_ctrl_c as _leave_on_ctrl_c
    from orthocas.cli.entry import open_closed_streams as _open_closed_streams

    _open_closed_streams()
    _leave_on_ctrl_c()  # what a command imports takes half a second
    _sys.excepthook = _sys.__excepthook__

import ast as _ast  # noqa: E402
from importlib import import_module as _import_module  # noqa: E402
from pathlib import Path as _Path  # noqa: E402

from orthocas.version import VERSION as _VERSION  # noqa: E402

if "ORTHOCAS_PARENT" in _os.environ:  # a process that shares work of another one
    from orthocas.tools.processes import end_early_with_parent as _end_early_with_parent

    _end_early_with_parent()

# In a checkout, problems/ and solvers/ lie beside this folder, not inside it. Looking one level up keeps
# `orthocas.problems` importable there, whether or not an installed copy exists; a wheel does not run this line.
if not (_Path(__file__).parent / "problems").is_dir():
    __path__.append(str(_Path(__file__).parent.parent))

__version__ = _VERSION


def _stated() -> dict[str, tuple[str, str]]:
    """The public names of `__init__.pyi`, each with its module and its name there."""
    text = _Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    lines = [line for line in _ast.parse(text).body if isinstance(line, _ast.ImportFrom)]
    return {name.asname or name.name: (line.module or "", name.name) for line in lines for name in line.names}


_HOMES = _stated()
_FORMER = {"parametrisations": "bases", "following": "paths"}  # names of packages until version 0.1
__all__ = sorted(_HOMES, key=lambda name: (not name.isupper(), not name[0].isupper(), name))  # noqa: PLE0605


def __getattr__(name: str) -> object:
    """A public name, imported on first use: all of them take half a second, and few programs need all."""
    if name in _FORMER:
        return __getattr__(_FORMER[name])
    if name not in _HOMES:
        raise AttributeError(f"module 'orthocas' has no attribute '{name}'")
    home, own_name = _HOMES[name]
    known = vars(_import_module(home))
    globals()[name] = known[own_name] if own_name in known else _import_module(f"{home}.{own_name}")
    return globals()[name]


def __dir__() -> list[str]:
    """The public names; internal modules are imported by their full names."""
    return [*__all__, "__version__"]
