"""The part of a clear box where coordinates do not fold: the domain of wide charts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.bases.family import JointSpace, parametrisation_from_data, parametrisation_to_data
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import triangle
from orthocas.errors import DomainError, InvalidValueError
from orthocas.tasks.clear_box import ClearBox
from orthocas.tasks.domains import Box, Domain, StopKind, Wall, register_domain
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_number, as_point_set, freeze_array, require_kind
from orthocas.tools.json import get_part

REGULAR_PART = "regular part"  #: name of this kind of domain
_ARRAYS = ("theta", "space_centre", "space_half_width")


@register_domain
@dataclass(frozen=True, eq=False, init=False, kw_only=True)
class RegularPart(ClearBox):
    """The part of a clear box on which the volume v(q) of coordinates has the sign of the home, and |v| > bound.

    v = det [N; G], with an orthonormal basis N of the row space of the task's frame Jacobian, and the unit gradients G
    of the coordinates. For r = 1, |v| is the cosine of the angle between gradient and self-motion. v has the sign of
    det J, so a chart with these coordinates has no fold on this domain. `fit_wide` builds it.

    Args:
        box: a clear box.
        coordinates: the coordinates; their offset and the size of their scale do not matter.
        least_volume: the bound, > 0 and < 1.

    Raises:
        InvalidValueError: if an argument has the wrong type or value, or the coordinates do not fit the box.
        DomainError: if |v| is not above the bound at the home of the box.
    """

    name: str = REGULAR_PART
    coordinates: Coordinates
    least_volume: float
    orientation: float

    def __init__(self, box: Domain, coordinates: Coordinates, least_volume: float) -> None:
        require_kind("box", box, ClearBox)
        assert isinstance(box, ClearBox)
        require_kind("coordinates", coordinates, Coordinates)
        # check the bound, and that the coordinates fit the box
        bound = as_number("least_volume", least_volume)
        if not 0 < bound < 1:
            raise InvalidValueError("least_volume", least_volume, "a number > 0 and < 1")
        if coordinates.space.n != len(box.centre) or coordinates.r + box.task.m != len(box.centre):
            got = f"{coordinates.r} coordinates of {coordinates.space.n} joints"
            n = len(box.centre)
            raise InvalidValueError("coordinates", got, f"{n - box.task.m} coordinates of {n} joints")
        # `orientation` is the sign of v at home; the parent class needs it to check that home lies inside
        object.__setattr__(self, "coordinates", coordinates)
        object.__setattr__(self, "least_volume", bound)
        object.__setattr__(self, "orientation", 1.0)
        whole = Box(box.centre, box.half_width, box.unbounded)
        at_home = float(_volume(box.task, coordinates)(box.home))
        object.__setattr__(self, "orientation", -1.0 if at_home < 0 else 1.0)
        if not abs(at_home) > bound:
            place = "centre" if box.posture is None else "home"
            raise DomainError(
                f"coordinates have the volume {at_home:.3g} at the {place}, expected |volume| > {bound:g}"
            )
        super().__init__(whole, box.task, box.least_singular_value, box.scale, box.rows, box.posture)

    @property
    def heading(self) -> str:
        """The kind of domain with both of its conditions, in one line."""
        return f"{super().heading}, and volume of the coordinates above {self.least_volume:g}"

    def report_condition(self) -> dict[str, Any]:
        """The condition of the clear box, and the bound of the volume, for reports."""
        return {**super().report_condition(), "least_volume": self.least_volume}

    def to_data(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """Header data and arrays for a chart file: those of the clear box, the bound, and the coordinates."""
        data, arrays = super().to_data()
        own, space = self.coordinates, self.coordinates.space
        numbers = dict(zip(_ARRAYS, (own.theta, space.centre, space.half_width), strict=True))
        kind = {**parametrisation_to_data(own.parametrisation), "idle": list(own.idle)}
        return {**data, "least_volume": self.least_volume, "regular": kind}, {**arrays, **numbers}

    @classmethod
    def from_data(cls, task: Task, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
        """Read the domain from the data and arrays of a chart file."""
        box = ClearBox.from_data(task, data, arrays)
        kind, robot = get_part(data, "regular", dict), task.robot
        # the coordinates that define the volume, with their own joint space; offset 0 and scale 1 do not change it
        theta, centre, half_width = (get_part(arrays, name, np.ndarray) for name in _ARRAYS)
        n = robot.n
        centre, half_width = (
            freeze_array("space_centre", centre, (n,)),
            freeze_array("space_half_width", half_width, (n,)),
        )
        space = JointSpace(centre, half_width, robot.tree.prismatic, robot.joint_names)
        if not space.half_width.min() > 0:
            raise InvalidValueError("space_half_width", space.half_width.min(), "positive numbers")
        idle = tuple(get_part(kind, "idle", list))
        fitted = n - task.m - len(idle)
        own = Coordinates(parametrisation_from_data(kind), space, idle, theta, np.zeros(fitted), np.ones(fitted))
        return cls(box, own, get_part(data, "least_volume", float))

    def explain(self, q: Array) -> str:
        """Say which condition a position q (n,) of the box violates."""
        if self.singular_values(q) <= self.least_singular_value:
            return super().explain(q)
        bound = f"expected one above least_volume = {self.least_volume:g}"
        return f"the coordinates have a volume of {self.volumes(q):.3g}, {bound}"

    def apply_to(self, box: Box) -> RegularPart:
        """The same conditions on another box."""
        return RegularPart(super().apply_to(box), self.coordinates, self.least_volume)

    def volumes(self, q: ArrayLike) -> Any:
        """v at points (n,) or (N, n), times its sign at home: a number, or (N,)."""
        points, single = as_point_set("q", q, len(self.centre))
        values: NDArray[np.float64] = self.orientation * self._batched_volume(points)[0][:, 0]
        return values[0] if single else values

    @property
    def walls(self) -> tuple[Wall, ...]:
        """The walls of the clear box, then v - bound."""
        return (*super().walls, Wall(StopKind.FOLD, lambda q: float(self.room_to_fold(q)), self.volumes, self.heading))

    @property
    def fold_bound(self) -> Self:
        """This domain itself: it has the parts of `room_to_fold`."""
        return self

    @property
    def gradients(self) -> ca.Function:
        """Function q (n, 1) -> J_xi (r, n)."""
        return self.coordinates.functions["jacobian"]

    @property
    def pivots(self) -> ca.Function:
        """Function q (n, 1) -> the pivots of the clear box, then v - bound, (m + 1, 1)."""
        return self._all_pivots

    @cached_property
    def _all_pivots(self) -> ca.Function:
        """The value of `pivots`, cached under another name, because the parent class caches its own by that name."""
        q = ca.MX.sym("q", len(self.centre))
        return dense_function("pivots", [q], [ca.vertcat(super().pivots(q), self.room_to_fold(q))])

    @cached_property
    def room_to_fold(self) -> ca.Function:
        """Function q (n, 1) -> v - bound, (1, 1), with v times its sign at home."""
        q = ca.MX.sym("q", len(self.centre))
        volume = _volume(self.task, self.coordinates)(q)
        return dense_function("room_to_fold", [q], [self.orientation * volume - self.least_volume])

    @cached_property
    def _batched_volume(self) -> Batched:
        """v for many points."""
        return Batched(_volume(self.task, self.coordinates))


def _volume(task: Task, coordinates: Coordinates) -> ca.Function:
    """Function q (n, 1) -> v (1, 1), the volume of the coordinates."""
    n, m, r = task.robot.n, task.m, coordinates.r
    rows, gradients = ca.SX.sym("rows", m, n), ca.SX.sym("gradients", r, n)
    # v is the product of the diagonal of a triangular form of [rows; unit gradients]; its task entries count as signs
    diagonal = triangle(ca.vertcat(rows, gradients))
    value = ca.SX(1)
    for k in range(n):
        value *= ca.sign(diagonal[k]) if k < m else diagonal[k] / ca.norm_2(gradients[k - m, :])
    volume = ca.Function("volume", [rows, gradients], [value])
    q = ca.MX.sym("q", n)
    found = volume(task.frame_jacobian_function(q), coordinates.functions["jacobian"](q))
    return dense_function("volume", [q], [found])
