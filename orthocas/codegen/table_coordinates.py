"""Coordinates whose functions generated C takes from tables of many charts (ours)."""

from dataclasses import dataclass

import casadi as ca

from orthocas.casadi_tools.batch import dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.checks import Array
from orthocas.coordinates.map import CoordinateMap

#: C bodies of the functions; `mem` is the number of the chart, and templates/tables.c.in has what they call
TABLE_CODE = {
    "table_xi": "{ (void)iw; (void)w; if (res[0] != 0) xi_at(mem, arg[0], res[0]); return 0; }",
    "table_jacobian": "{ (void)iw; (void)w; if (res[0] != 0) jacobian_at(mem, arg[0], res[0]); return 0; }",
    "table_second_derivative": (
        "{ (void)iw; (void)w; if (res[0] != 0) bend_at(mem, arg[0], arg[1], arg[2], res[0]); return 0; }"
    ),
}


@dataclass(frozen=True, eq=False)
class TableCoordinates:
    """The coordinates of one chart, which stand for those of all charts of an atlas.

    In Python they are those of the one chart. Their functions have names by which generated C replaces them.
    """

    own: CoordinateMap

    @property
    def r(self) -> int:
        """Number of coordinates."""
        return self.own.r

    @property
    def label(self) -> str:
        """That of the one chart."""
        return self.own.label

    @property
    def size(self) -> int:
        """Number of parameters of the one chart."""
        return self.own.size

    @cached_property
    def functions(self) -> dict[str, ca.Function]:
        """The functions of the one chart, each in a call that can be replaced."""
        found = {}
        for name, function in self.own.functions.items():
            inputs = function.mx_in()
            found[name] = dense_function(f"table_{name}", inputs, [function(*inputs)])
        return found

    def xi(self, points: Array) -> Array:
        """Coordinates (N, r) of the one chart at points (N, n)."""
        return self.own.xi(points)

    def jacobian(self, points: Array) -> Array:
        """J_xi (N, r, n) of the one chart at points (N, n)."""
        return self.own.jacobian(points)
