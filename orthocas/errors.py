"""The errors that orthocas raises on purpose. Each message is one line: what was given, and what was expected."""

import difflib
import math
import sys
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class MessageRules:
    """Numbers of messages, and of values that look like other units."""

    few_names: int = 10  #: names that are read at a glance, in their own order
    longest: int = 1500  #: characters of a message
    most_names: int = 30  #: that a message lists: those closest to the given name
    radians: float = 7.0  #: more than a turn: no bounded joint of an arm turns so far from its centre
    metres: float = 10.0  #: no tool is so long, and few arms


RULES = MessageRules()


def printable(text: str) -> str:
    """The text with escapes for control and bidi characters, which could change what a terminal shows."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """The text on one printable line of bounded length."""
    line = printable(" ".join(text.split()))
    return line if len(line) <= RULES.longest else f"{line[: RULES.longest // 2]} ... {line[-RULES.longest // 2 :]}"


class OrthocasError(Exception):
    """Base class of all errors that orthocas raises on purpose. The message is one printable line."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class Interrupted(KeyboardInterrupt):
    """Ctrl-C ended a long call early; `result` is what it has found so far.

    It ends a program as every Ctrl-C does, loops around the call included, unless the caller takes the result:

        try:
            fit = oc.fit(problem)
        except oc.errors.Interrupted as stop:
            fit = stop.result

    In an interactive session `sys.last_value.result` holds it afterwards.
    """

    def __init__(self, result: Any) -> None:
        super().__init__(result)
        self.result = result

    def __str__(self) -> str:
        return f"the {type(self.result).__name__} found so far is the attribute `result` of this exception"


class NotSavableWarning(UserWarning):
    """A chart file cannot store the coordinates that a fit is about to compute."""


class LawWarning(UserWarning):
    """A control law is built with settings that are hardly meant."""


class BranchWarning(UserWarning):
    """A wide chart leaves out a part of its branch from the start."""


class TipWarning(UserWarning):
    """A robot has several chains, and no tip was named."""


def warn_caller(text: str, category: type[Warning]) -> None:
    """Warn with the line outside this package that led here, however deep the call is."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).split(".")[0] == "orthocas":
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level)


class ShapeError(OrthocasError, ValueError):
    """An array has the wrong shape."""

    def __init__(self, name: str, got: tuple[int, ...], want: tuple[int | None, ...]) -> None:
        super().__init__(f"{name} has shape {got}, expected {tuple('any' if w is None else w for w in want)}")


class InvalidValueError(OrthocasError, ValueError):
    """A value is outside what the argument allows."""

    def __init__(self, name: str, got: object, want: str) -> None:
        super().__init__(f"{name} is {' '.join(str(got).split())}, expected {want}")


class OptionError(OrthocasError, ValueError):
    """Options of a command do not go together. The message says what to give, or to leave out."""


class UnknownNameError(OrthocasError, ValueError):
    """A name does not exist. The message lists the known names; of many, the most similar come first."""

    def __init__(self, what: str, got: str, known: Iterable[str]) -> None:
        names = list(known)
        if len(names) > RULES.few_names:
            near = difflib.get_close_matches(got, names, 3)
            names = [*near, *(name for name in names if name not in near)]
        if len(names) > RULES.most_names:
            close = difflib.get_close_matches(got, names, RULES.most_names, 0.0)
            names = [*close, f"and {len(names) - len(close)} more"]
        super().__init__(f"unknown {what} '{got[:80]}', known: {', '.join(names)}")


class RobotError(OrthocasError, ValueError):
    """A robot description cannot be read, or contains a joint that orthocas does not support."""


_SMALLER_TASKS = {"position+axis:z": 5, "position": 3, "orientation": 3, "position:xy": 2, "axis:z": 2, "position:x": 1}


def degrees_hint(*values: float) -> str:
    """The end of a message about joint positions that look like degrees; "" for others."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return "; are these degrees? Joint positions are in radians" if largest > RULES.radians else ""


def units_hint(units: Iterable[str], values: Iterable[float]) -> str:
    """The end of a message about values whose units are "m" or "rad", if they look like millimetres or degrees."""
    sized = [(unit, abs(value)) for unit, value in zip(units, values, strict=False) if math.isfinite(value)]
    long = any(unit == "m" and value > RULES.metres for unit, value in sized)
    far = any(unit == "rad" and value > RULES.radians for unit, value in sized)
    millimetres = "; are these millimetres? Lengths are in metres" if long else ""
    return millimetres + ("; are these degrees? Angles are in radians" if far else "")


class DomainError(OrthocasError, ValueError):
    """A joint-space domain is empty, or leaves the joint limits."""


class MetricError(OrthocasError, ValueError):
    """The metric A(q) is not symmetric positive definite."""


class NotRedundantError(OrthocasError, ValueError):
    """The task leaves no freedom: m >= n. The message names tasks that leave some."""

    def __init__(self, m: int, n: int) -> None:
        smaller = [f"{task} (m = {size})" for task, size in _SMALLER_TASKS.items() if size < min(m, n)][:3]
        advice = f"; redundant tasks are, for example, {', '.join(smaller)}" if smaller else ""
        super().__init__(f"the task has m = {m} components and the robot n = {n} joints, expected m < n{advice}")


class SingularTaskError(OrthocasError, ValueError):
    """The task Jacobian loses rank all over the domain."""


class MemoryNeedError(OrthocasError, MemoryError):
    """A fit would need more memory than the machine has."""

    def __init__(self, what: str, needed: float, available: float) -> None:
        super().__init__(
            f"{what} would need {needed / 2**30:.3g} GiB, this machine has {available / 2**30:.3g} GiB: "
            "lower the degree or the number of samples"
        )


class NotADiskError(OrthocasError, ValueError):
    """A surface mesh is not a topological disk."""

    def __init__(self, components: int, loops: int, euler: int, clashing_edges: int) -> None:
        super().__init__(
            f"the mesh has {components} components, {loops} boundary loops, Euler characteristic {euler} and "
            f"{clashing_edges} non-manifold edges, expected a disk: 1, 1, 1 and 0"
        )


class FoldedMapError(OrthocasError, ValueError):
    """A map of a mesh to the plane flips triangles."""

    def __init__(self, folded: int, triangles: int) -> None:
        super().__init__(f"the map folds {folded} of {triangles} triangles, expected 0: improve the mesh (more cells)")


class MissingExtraError(OrthocasError, ImportError):
    """A package that only some features need is not installed."""

    def __init__(self, feature: str, package: str, extra: str) -> None:
        super().__init__(f"{feature} needs the package {package}: install it with pip install 'orthocas[{extra}]'")


class SolveError(OrthocasError, RuntimeError):
    """A minimiser stopped without a usable result."""


class SimulationError(OrthocasError, RuntimeError):
    """An integrator failed during a closed-loop simulation."""


class CompileError(OrthocasError, RuntimeError):
    """The generated C code cannot be compiled on this machine."""


class AgreementError(OrthocasError, RuntimeError):
    """The compiled C code disagrees with the Python function that it was generated from."""


class InfeasibleError(SolveError):
    """The constraints of a fit cannot be met."""


class InverseError(OrthocasError, RuntimeError):
    """The inverse map q(x, xi) has no solution, only one outside the domain, or meets a singular Jacobian.

    Args:
        message: what failed, and for which rows.
        nearest: joint positions inside the domain instead, of the shape that was asked for: those with the same x and
            the nearest xi that was found. None unless solutions lie outside.
    """

    def __init__(self, message: str, nearest: "NDArray[np.float64] | None" = None) -> None:
        super().__init__(message)
        self.nearest = nearest


class ArchiveError(OrthocasError, ValueError):
    """A file written by orthocas cannot be written or read."""


class TrajectoryFileError(ArchiveError):
    """A trajectory file is missing, damaged, not a trajectory file, or from a newer version."""


class ChartFileError(ArchiveError):
    """A chart file is missing, truncated, edited, not a chart file, or from a newer version."""


class StepsFileError(OrthocasError, ValueError):
    """A steps file is missing, is not valid JSON, or contains invalid steps."""


class UnreachableReferenceError(OrthocasError, ValueError):
    """A reference leaves what the robot can reach inside the domain."""


class PathError(OrthocasError, ValueError):
    """A tool path cannot be followed: it leaves the reach, a limit, or the space between obstacles."""


class PathFileError(ArchiveError):
    """A file of a tool path or of joint positions cannot be read or written."""


class ViewError(OrthocasError, RuntimeError):
    """A page in the browser cannot be opened: its port is taken, or its address is not one of this machine."""


class GrowError(OrthocasError, ValueError):
    """Coordinates cannot be grown with the given arguments."""


class NotInvolutiveError(GrowError):
    """The task gradients are not involutive, so grown coordinates would depend on the path."""


class NoExpressionError(OrthocasError, TypeError):
    """A chart has no closed-form CasADi expression."""


class SchedulerError(OrthocasError, RuntimeError):
    """Dask is not installed, or its scheduler does not answer."""


class CertifyError(OrthocasError, ValueError):
    """A chart cannot be certified, or a stored certificate does not belong to it."""
