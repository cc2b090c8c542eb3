"""The choice of cyclic joints in a basis: the basis contains only the linear term of each."""

from typing import TYPE_CHECKING, Any, Literal

from orthocas.errors import InvalidValueError
from orthocas.parametrisations.cyclic_joints import cyclic_joints
from orthocas.parametrisations.family import JointSpace

if TYPE_CHECKING:
    from orthocas.problem import Problem

Cyclic = tuple[str, ...] | Literal["auto"]  #: names of joints; "auto" for all cyclic joints of the problem
_WORD = "cyclic"


def checked_cyclic(value: Any) -> Cyclic:
    """The value as names, or "auto".

    Raises:
        InvalidValueError: if it is neither, or a name appears twice.
    """
    if isinstance(value, str) and value == "auto":
        return "auto"
    known = isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
    if not known or len(set(value)) != len(value):
        raise InvalidValueError("cyclic", repr(value)[:80], "a list of different joint names, or 'auto'")
    return tuple(value)


def suffix(cyclic: Cyclic) -> str:
    """What a label adds for cyclic joints: '', ':cyclic' for "auto", or ':cyclic=NAME,NAME'."""
    if not cyclic:
        return ""
    return f":{_WORD}" if cyclic == "auto" else f":{_WORD}={','.join(cyclic)}"


def parse_suffix(text: str) -> Cyclic:
    """Parse what follows the degree in a label: '', 'cyclic' or 'cyclic=NAME,NAME'."""
    word, equals, names = text.partition("=")
    if not text:
        return ()
    if word != _WORD or (equals and not names):
        raise InvalidValueError("parametrisation", repr(text), "'cyclic' or 'cyclic=JOINT,JOINT' after the degree")
    return tuple(names.split(",")) if equals else "auto"


def resolved(cyclic: Cyclic, problem: "Problem") -> tuple[str, ...]:
    """The names of the cyclic joints of a problem that are meant.

    Raises:
        InvalidValueError: if a named joint is not cyclic.
    """
    if not cyclic:
        return ()
    known = cyclic_joints(problem)
    if cyclic == "auto":
        return known
    wrong = [name for name in cyclic if name not in known]
    if wrong:
        raise InvalidValueError("cyclic", repr(wrong[0]), f"one of the cyclic joints: {', '.join(known) or 'none'}")
    return tuple(name for name in known if name in cyclic)


def indices(cyclic: Cyclic, space: JointSpace) -> list[int]:
    """The cyclic joints of a space, in order.

    Raises:
        InvalidValueError: if a name is not among the joints, or "auto" has not been resolved.
    """
    if cyclic == "auto":
        raise InvalidValueError("cyclic", "'auto'", "joint names: for_problem(problem) finds them")
    for name in cyclic:
        if name not in space.joint_names:
            raise InvalidValueError("cyclic", repr(name), f"joints of {', '.join(space.joint_names)}")
    return [k for k, name in enumerate(space.joint_names) if name in cyclic]


def count(cyclic: Cyclic) -> int:
    """Number of cyclic joints; 0 as long as "auto" has not been resolved."""
    return 0 if cyclic == "auto" else len(cyclic)
