"""orthocas: joint-space coordinates that a redundant robot's task does not disturb, with CasADi."""

import os as _os

_FOLDER = _os.path.dirname(__file__)

# In a checkout, problems/ and solvers/ lie beside this folder, not inside it. Looking one level up keeps
# `orthocas.problems` importable there, whether or not an installed copy exists; a wheel does not run this line.
if not _os.path.isdir(_os.path.join(_FOLDER, "problems")):
    __path__.append(_os.path.dirname(_FOLDER))

_HOMES: dict[str, tuple[str, str]] = {}  # of the public names: module and name there; filled on first use


def __getattr__(name: str) -> object:
    """A public name, imported on first use: all of them take half a second, and few programs need all."""
    from importlib import import_module  # late, because the command line watches for Ctrl-C only after this file

    homes = {**_read_homes(), "__version__": ("orthocas.version", "VERSION")}
    if name == "__all__":
        return sorted(_HOMES, key=lambda public: (not public.isupper(), not public[0].isupper(), public))
    if name not in homes:
        guesses = import_module("orthocas.tools.display")
        raise AttributeError(guesses.explain_missing("orthocas", name))
    home, own_name = homes[name]
    members = vars(import_module(home))
    globals()[name] = members[own_name] if own_name in members else import_module(f"{home}.{own_name}")
    return globals()[name]


def _read_homes() -> dict[str, tuple[str, str]]:
    """The homes of the public names, as `__init__.pyi` states them."""
    import ast  # late, as above

    if not _HOMES:
        with open(_os.path.join(_FOLDER, "__init__.pyi"), encoding="utf-8") as file:
            lines = [line for line in ast.parse(file.read()).body if isinstance(line, ast.ImportFrom)]
        _HOMES.update(
            {name.asname or name.name: (line.module or "", name.name) for line in lines for name in line.names}
        )
    return _HOMES


def __dir__() -> list[str]:
    """The public names; internal modules are imported by their full names."""
    return [*sorted(_read_homes()), "__version__"]
