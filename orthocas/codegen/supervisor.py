"""Calls the supervised law of a compiled library from Python, for simulations and tests."""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.codegen.library import CompiledLibrary, gain_numbers
from orthocas.codegen.precision import Precision
from orthocas.control.controller import Controller, ControlStatus, require_controller
from orthocas.control.memory import memory_of
from orthocas.control.safety import Safety
from orthocas.tools.checks import Array, as_float_array, as_number, as_point, require_kind, require_shape

_POINTER = ctypes.c_void_p


class Supervisor:
    """One supervised law: the state in C, and the functions that change it.

    Args:
        library: a compiled library with this controller.
        controller: the law.
        safety: other settings than those that the library was generated with.
    """

    def __init__(self, library: CompiledLibrary, controller: Controller, safety: Safety | None = None) -> None:
        require_kind("library", library, CompiledLibrary)
        require_controller(controller)
        self._n, self._k, self._library = library.n, len(controller.labels), library
        self._functions = {
            name: library.function(name) for name in ("start", "take_over", "resume", "hold", "release", "step")
        }
        self._functions["step"].argtypes = [*[_POINTER] * 6, library.precision.c_type, _POINTER]
        stream, pace = (library.function(f"reference_{name}") for name in ("stream", "pace"))
        stream.argtypes = [*[_POINTER] * 3, *[library.precision.c_type] * 2]
        pace.argtypes, pace.restype = [_POINTER, _POINTER, library.precision.c_type], library.precision.c_type
        self._functions |= {"stream": stream, "pace": pace}
        if safety is not None:
            require_kind("safety", safety, Safety)
        values = (safety or Safety.of(controller)).in_c(controller.command)
        settings = _settings_type(values, library.precision)
        self._safety = library.address("default_safety") if safety is None else _packed(values, settings)
        memory = memory_of(controller)
        remembered = {} if memory is None else {name: len(value) for name, value in memory.start.items()}
        self._state = _state_type(self._n, self._k, library.precision, settings, remembered)()
        self._command = library.numbers(np.zeros(self._n))
        self.gains = gain_numbers(controller)  #: numbers of the gains in the order of the C struct

    def start(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Begin at joint positions (n,), with the command (n,) that the robot executes now; default the fallback."""
        self._begin("start", q, command)

    def take_over(self, q: ArrayLike, command: ArrayLike) -> None:
        """Take over from another controller while the arm moves."""
        points = self._point("q", q), self._point("command", command)
        self._functions["take_over"](self._here, *map(_pointer, points))

    def resume(self) -> None:
        """Ask for the law again."""
        self._functions["resume"](self._here)

    def hold(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Brakes hold the arm at joint positions (n,); what the motors do now (n,), default the last command."""
        self._begin("hold", q, command)

    def release(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Brakes open: the catcher holds the arm until `resume`."""
        self._begin("release", q, command)

    def step(self, q: Array, dq: Array, reference: Array, period: float = 1e-3) -> tuple[Array, ControlStatus]:
        """Command (n,) and status of one control period.

        Args:
            q: joint positions (n,).
            dq: joint velocities (n,).
            reference: [value, velocity, acceleration], (3 k,).
            period: time since the last call [s].
        """
        inputs = [self._numbers(name, value, self._n) for name, value in (("q", q), ("dq", dq))]
        inputs += [self._reference(reference), self._library.numbers(self.gains)]
        time, command = as_number("period", period), _pointer(self._command)
        status = self._functions["step"](self._here, self._safety, *map(_pointer, inputs), time, command)
        return self._command.copy(), ControlStatus(status)

    def stream(self, reference: Array, target: ArrayLike, omega: float, period: float = 1e-3) -> ControlStatus:
        """Move a reference by one tick towards a target (k,), with poles at omega [1/s]; the status.

        OK, NEAR_BOUNDARY if the target lies beyond the boundary, so that the stream stops before it, or NOT_FINITE.
        """
        numbers = self._reference(reference)
        wanted, speed, time = (
            self._numbers("target", target, self._k),
            as_number("omega", omega),
            as_number("period", period),
        )
        status = self._functions["stream"](self._here, _pointer(numbers), _pointer(wanted), speed, time)
        reference[:] = numbers
        return ControlStatus(status)

    def pace(self, reference: Array, period: float = 1e-3) -> float:
        """Scale the derivatives of a reference to what joints can follow; the pace at which time goes on, 0 to 1."""
        numbers = self._reference(reference)
        pace = float(self._functions["pace"](self._here, _pointer(numbers), as_number("period", period)))
        reference[:] = numbers
        return pace

    def __getattr__(self, name: str) -> Any:
        """The fields of the state in C: mode, cause, weight, anchor, ...; `memory` is a dictionary of arrays."""
        if name.startswith("_"):
            raise AttributeError(name)
        value = getattr(self._state, name)
        if name == "memory":
            return {field[0]: np.array(getattr(value, field[0])) for field in value._fields_}
        return np.array(value) if isinstance(value, ctypes.Array) else value

    def _reference(self, reference: Array) -> Array:
        return self._numbers("reference", reference, 3 * self._k)

    def _begin(self, name: str, q: ArrayLike, command: ArrayLike | None) -> None:
        point, given = self._point("q", q), None if command is None else self._point("command", command)
        self._functions[name](self._here, _pointer(point), None if given is None else _pointer(given))

    def _numbers(self, name: str, values: ArrayLike, size: int) -> Array:
        """Numbers of the library's type, which may be NaN or infinite."""
        array = as_float_array(name, values)
        require_shape(name, array.shape, (size,))  # C would read beyond the end
        return self._library.numbers(array)

    def _point(self, name: str, values: ArrayLike) -> Array:
        return self._library.numbers(as_point(name, values, self._n))

    @property
    def _here(self) -> Any:
        return ctypes.byref(self._state)


def _state_type(
    n: int,
    k: int,
    precision: Precision,
    settings: type[ctypes.Structure],
    remembered: dict[str, int],
) -> type[ctypes.Structure]:
    joints, quantities = precision.c_type * n, precision.c_type * k
    names = ("q", "dq", "seen_q", "seen_dq", "command", "led", "impulse", "impulse_from", "law", "anchor", "safe")
    has_spring = any(field[0] == "brake_stiffness" for field in settings._fields_)
    layout = [
        *(
            (name, ctypes.c_int)
            for name in ("mode", "cause", "asked", "bad_ticks", "fresh", "stale_ticks", "same_ticks")
        ),
        *((name, precision.c_type) for name in ("weight", "brake", "unseen")),
        *((name, joints) for name in names),
        *((name, quantities) for name in ("offset", "integral")),
        *((name, joints) for name in ("load", "drive", "speed") if has_spring),
        *(("inertia", precision.c_type * n**2) for _ in range(has_spring)),
        *((name, joints) for name in ("expected", "unexplained") if has_spring),
        *(("memory", _memory_type(remembered, precision)) for _ in range(bool(remembered))),
        *((name, quantities) for name in ("value", "velocity", "acceleration")),
        ("safety", settings),
        ("limit", joints),
    ]
    return type("State", (ctypes.Structure,), {"_fields_": layout})


def _memory_type(remembered: dict[str, int], precision: Precision) -> type[ctypes.Structure]:
    """The struct of what a law remembers."""
    layout = [(name, precision.c_type * size) for name, size in remembered.items()]
    return type("Memory", (ctypes.Structure,), {"_fields_": layout})


def _settings_type(values: dict[str, Any], precision: Precision) -> type[ctypes.Structure]:
    """The struct of settings in C."""
    layout = [(name, _kind(value, precision)) for name, value in values.items()]
    return type("Safety", (ctypes.Structure,), {"_fields_": layout})


def _packed(values: dict[str, Any], settings: type[ctypes.Structure]) -> Any:
    """The settings as the C struct."""
    struct: Any = settings()
    for name, value in values.items():
        setattr(struct, name, tuple(value.tolist()) if isinstance(value, np.ndarray) else value)
    return ctypes.pointer(struct)


def _kind(value: Any, precision: Precision) -> Any:
    if isinstance(value, np.ndarray):
        return precision.c_type * value.size
    return ctypes.c_int if isinstance(value, int) else precision.c_type


def _pointer(array: Array) -> Any:
    """The address of an array, which must live until C has read it. `data_as` would keep it, and takes microseconds."""
    return _POINTER(array.ctypes.data)
