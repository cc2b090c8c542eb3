"""References of supervised laws of an atlas: values, and the chart that they belong to."""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocas.checks import Array, as_float_array, require_shape
from orthocas.codegen.library import CompiledLibrary

_POINTER = ctypes.c_void_p


class ChartReference:
    """A reference (3 k,) in one chart. `Supervisor.step` changes it when the arm goes over to another chart.

    Args:
        library: a compiled library of an atlas with a controller.
        values: [value, velocity, acceleration].
        chart: the number of the chart in C.
    """

    def __init__(self, library: CompiledLibrary, values: ArrayLike, chart: int) -> None:
        number, given = library.precision.c_type, as_float_array("values", values)
        require_shape("values", given.shape, (3 * library.n,))
        layout = [("values", number * (3 * library.n)), ("chart", ctypes.c_int)]
        self._library = library
        self._struct = type("Reference", (ctypes.Structure,), {"_fields_": layout})(tuple(given), chart)

    @classmethod
    def at(cls, library: CompiledLibrary, q: Array, chart: int) -> "ChartReference":
        """At rest at joint positions (n,)."""
        reference, point = cls(library, np.zeros(3 * library.n), chart), library.numbers(q)
        require_shape("q", point.shape, (library.n,))
        library.function("reference_at")(chart, point.ctypes.data_as(_POINTER), reference.address)
        return reference

    @property
    def values(self) -> Array:
        """The numbers (3 k,); changes go to C."""
        found: Array = np.ctypeslib.as_array(self._struct.values)
        return found

    @property
    def chart(self) -> int:
        """The chart that xi and its derivatives belong to."""
        return int(self._struct.chart)

    @property
    def address(self) -> Any:
        """The C struct."""
        return ctypes.byref(self._struct)

    def hand_over(self, chart: int, q: Array) -> int:
        """Ask for the same posture and motion in another chart, found from joint positions (n,); the status."""
        point = self._library.numbers(q)
        require_shape("q", point.shape, (self._library.n,))
        return int(self._library.function("hand_over")(self.address, chart, point.ctypes.data_as(_POINTER)))
