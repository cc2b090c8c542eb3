"""Control laws by name, for the command line, and how to add your own."""

from collections.abc import Mapping

from orthocas.control.controller import Law
from orthocas.control.gains import Setting
from orthocas.control.kinematic import Kinematic
from orthocas.control.operational_space import Impedance, PDPlus
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import require_known

_LAWS: dict[str, type[Law]] = {}


def register(law: type[Law]) -> None:
    """Register a law under its name, so that `orthocas simulate` and `orthocas codegen` can build it on a chart.

    Raises:
        InvalidValueError: if another law has that name.
    """
    named = isinstance(getattr(law, "name", None), str)
    if named and _LAWS.get(law.name, law) is not law:
        raise InvalidValueError("name", repr(law.name), f"a free name, because {_LAWS[law.name].__name__} has this one")
    if not named or not callable(getattr(law, "on_chart", None)):
        raise InvalidValueError("law", repr(law)[:80], "the class of a law")
    options = getattr(law, "options", None)
    if not isinstance(options, Mapping) or not all(isinstance(setting, Setting) for setting in options.values()):
        raise InvalidValueError(f"options of {law.__name__}", repr(options)[:80], "a dictionary of Setting by name")
    _LAWS[law.name] = law


def law_names() -> tuple[str, ...]:
    """Names of all registered laws."""
    return tuple(_LAWS)


def law_of(name: str) -> type[Law]:
    """The law with a name.

    Raises:
        UnknownNameError: if no law has that name.
    """
    require_known("controller", name, _LAWS)
    return _LAWS[name]


for _law in (Impedance, PDPlus, Kinematic):
    register(_law)
