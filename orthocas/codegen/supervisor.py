"""Calls the supervised law of a compiled library from Python, for simulations and tests."""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.codegen.library import ChartReference, CompiledLibrary, gain_numbers
from orthocas.codegen.precision import Precision
from orthocas.control.controller import Controller, ControlStatus, require_controller
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
        self._functions = {name: library.function(name) for name in ("start", "take_over", "resume", "step")}
        self._functions["step"].argtypes = [*[_POINTER] * 6, library.precision.c_type, _POINTER]
        if safety is not None:
            require_kind("safety", safety, Safety)
        values = (safety or Safety.of(controller)).in_c(controller.command)
        settings = _settings_type(values, library.precision)
        self._safety = library.address("default_safety") if safety is None else _packed(values, settings)
        self._state = _state_type(self._n, self._k, library.precision, library.of_atlas, settings)()
        self._command = library.numbers(np.zeros(self._n))
        self.gains = gain_numbers(controller)  #: numbers of the gains in the order of the C struct

    def start(self, q: ArrayLike, command: ArrayLike | None = None) -> None:
        """Begin at joint positions (n,), with the command (n,) that the robot executes now; default the fallback."""
        given = None if command is None else _pointer(self._point("command", command))
        self._functions["start"](self._here, _pointer(self._point("q", q)), given)

    def take_over(self, q: ArrayLike, command: ArrayLike) -> None:
        """Take over from another controller while the arm moves."""
        points = self._point("q", q), self._point("command", command)
        self._functions["take_over"](self._here, *map(_pointer, points))

    def resume(self) -> None:
        """Ask for the law again."""
        self._functions["resume"](self._here)

    def step(
        self, q: Array, dq: Array, reference: Array | ChartReference, period: float = 1e-3
    ) -> tuple[Array, ControlStatus]:
        """Command (n,) and status of one control period.

        Args:
            q: joint positions (n,).
            dq: joint velocities (n,).
            reference: [value, velocity, acceleration], (3 k,); of an atlas a `ChartReference`, which goes over to
                another chart with the arm.
            period: time since the last call [s].
        """
        inputs = [self._numbers(name, value, self._n) for name, value in (("q", q), ("dq", dq))]
        gains, time = self._library.numbers(self.gains), as_number("period", period)
        if self._library.of_atlas:
            require_kind("reference", reference, ChartReference)
        if isinstance(reference, ChartReference):
            asked = reference.address
        else:
            inputs.append(self._numbers("reference", reference, 3 * self._k))
            asked = _pointer(inputs[2])
        status = self._functions["step"](
            self._here, self._safety, *map(_pointer, inputs[:2]), asked, _pointer(gains), time, _pointer(self._command)
        )
        return self._command.copy(), ControlStatus(status)

    def __getattr__(self, name: str) -> Any:
        """The fields of the state in C: mode, cause, weight, anchor, ..."""
        if name.startswith("_"):
            raise AttributeError(name)
        value = getattr(self._state, name)
        return np.array(value) if isinstance(value, ctypes.Array) else value

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
    n: int, k: int, precision: Precision, of_atlas: bool, settings: type[ctypes.Structure]
) -> type[ctypes.Structure]:
    joints, quantities = precision.c_type * n, precision.c_type * k
    names = ("q", "dq", "seen_q", "seen_dq", "command", "law", "anchor", "safe")
    layout = [
        *(
            (name, ctypes.c_int)
            for name in ("mode", "cause", "asked", "bad_ticks", "fresh", "stale_ticks", "same_ticks")
        ),
        *((name, ctypes.c_int) for name in ("chart", "hand_overs") if of_atlas),
        *((name, precision.c_type) for name in ("weight", "brake", "drawn")),
        *((name, joints) for name in names),
        *((name, quantities) for name in ("offset", "integral", "drawn_from")),
        *((name, joints) for name in ("carry",) if of_atlas),
        *((name, quantities) for name in ("value", "velocity", "acceleration")),
        *((name, ctypes.c_int) for name in ("reference_chart",) if of_atlas),
        ("safety", settings),
        ("limit", joints),
    ]
    return type("State", (ctypes.Structure,), {"_fields_": layout})


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
    return array.ctypes.data_as(_POINTER)
