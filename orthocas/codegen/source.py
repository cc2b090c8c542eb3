"""What generated C is written from: one chart, or the charts of an atlas."""

from collections.abc import Mapping
from typing import Protocol

import casadi as ca

from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.codegen.precision import Precision
from orthocas.control import Controller, Safety
from orthocas.domains import Conditioned


class Source(Protocol):
    """A chart or several ones, as templates see them."""

    @property
    def chart(self) -> Chart:
        """The chart that kernels and sizes are taken from."""
        ...

    @property
    def own_code(self) -> Mapping[str, str]:
        """C bodies by name of the functions that are written by hand; the number of the chart is `mem`."""
        ...

    @property
    def condition(self) -> Conditioned | None:
        """The condition of the domain beside its box, if there is one."""
        ...

    @property
    def somewhere(self) -> Array:
        """A position of the domain at which the library checks itself, (n,)."""
        ...

    @property
    def title(self) -> str:
        """What kind of coordinates."""
        ...

    def law(self, controller: Controller) -> Controller:
        """The law on `chart`, for one of the charts; raises InvalidValueError for a law of another chart."""
        ...

    def safety(self, controller: Controller) -> Safety:
        """The default settings of the supervised law."""
        ...

    def law_values(self, controller: Controller, known: Mapping[str, str]) -> dict[str, str]:
        """Values of the placeholders in the templates of laws that depend on the border or on the chart."""
        ...

    def graph(self, graph: ca.Function) -> ca.Function:
        """The graph of a law, less the border of a domain that C code looks after."""
        ...

    def stack_bytes(self, size: int) -> int:
        """Additional use of the stack by functions of the domain and the charts, with numbers of a size [bytes]."""
        ...

    def values(self, known: Mapping[str, str], precision: Precision) -> dict[str, str]:
        """Values of the placeholders that describe domain and charts, and of the code that belongs to them.

        Args:
            known: values of the other placeholders.
            precision: the number type.
        """
        ...
