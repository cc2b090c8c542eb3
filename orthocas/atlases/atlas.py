"""Atlases: many charts that cover the joint range of a robot, in one file (ours)."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlases.atlas_facts import data_of, facts_of
from orthocas.atlases.atlas_file import Stock, read_stock, require_whole
from orthocas.atlases.chart_of_box import chart_of, clipped, moved, part_near, steps_to
from orthocas.atlases.evaluation import Evaluation
from orthocas.atlases.index import Index
from orthocas.atlases.inverse import inverse_in_charts
from orthocas.atlases.local_task import is_turning
from orthocas.atlases.plan import AtlasSettings, Plan
from orthocas.casadi_tools.cached import cached_property
from orthocas.chart import Chart
from orthocas.checks import (
    Array,
    Indices,
    as_float_array,
    as_path,
    as_point,
    as_point_set,
    require_count,
    require_shape,
)
from orthocas.domains import Box
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.problem import Problem
from orthocas.showing import Shown
from orthocas.tasks import Task

Turns = tuple[int, ...]  #: full turns of each joint that boxes divide; then steps of cyclic ones, for orientations
_KEPT = 32  # charts that stay built, the last ones


@dataclass(frozen=True, eq=False, repr=False)
class Atlas(Shown):
    """Charts of overlapping boxes that cover a region of joint space, opened from a file without reading them all.

    Charts have numbers from 0 on. Neighbours have the same order and signs of coordinates. Charts that are images of
    others in a symmetry of the arm count as charts of their own, but share the numbers in the file.

    `build_atlas` builds one.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> with TemporaryDirectory() as folder:
        ...     atlas = oc.build_atlas(
        ...         problems.get("planar_3r_xy"),
        ...         Path(folder) / "arm.orthocas-atlas",
        ...         region=[[0.6, 0.8, 0.8]],
        ...         radius=0.2,
        ...         jobs=1,
        ...     )
        ...     number = atlas.chart_at([0.6, 0.8, 0.8])
        ...     xi = atlas.xi([0.6, 0.8, 0.8])
        >>> number >= 0, xi.shape
        (True, (1,))
    """

    _stock: Stock
    _kept: dict[tuple[int, Turns], Chart] = field(default_factory=dict)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Open an atlas file. Loading never runs code from the file.

        Raises:
            AtlasFileError: if the file is missing, truncated, foreign, damaged, or from a newer version.
        """
        return cls(require_whole(read_stock(as_path("path", path).absolute())))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._stock,)

    def __len__(self) -> int:
        """Number of charts, images included."""
        return self._index.count

    @property
    def path(self) -> Path:
        """The file."""
        return self._stock.path

    @property
    def stock(self) -> Stock:
        """What the file holds, for the other modules of atlases."""
        return self._stock

    @property
    def plan(self) -> Plan:
        """What the boxes share."""
        return self._stock.plan

    @property
    def index(self) -> Index:
        """The search for charts."""
        return self._index

    @property
    def problem(self) -> Problem:
        """Robot, task and metric; its domain is the joint range that tiles were laid over."""
        return self._stock.plan.problem

    @property
    def settings(self) -> AtlasSettings:
        """What was asked of the charts."""
        return self._stock.plan.settings

    @property
    def fitted(self) -> int:
        """Number of charts that were fitted; the others are images."""
        return len(self._stock.charts)

    def facts(self) -> dict[str, str]:
        """Charts, joints and what was asked of them."""
        return facts_of(self.stock, len(self))

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return data_of(self.stock, len(self))

    def chart_at(self, q: ArrayLike, current: ArrayLike | None = None) -> Any:
        """The number of the chart for joint positions (n,) or (N, n): an int, or (N,); -1 where there is none.

        It is the chart whose cell holds q; near holes, a neighbour whose box reaches so far. With `current`, it stays
        the current chart as long as its box holds q. So the chart does not change back and forth at a border.

        Args:
            q: joint positions [rad] or [m].
            current: numbers of the charts used so far, one or (N,); -1 for none.

        Raises:
            ShapeError, InvalidValueError: if q has another number of joints or is not finite, or a number is no chart.
        """
        points, single = as_point_set("q", q, self.problem.n)
        divided = np.ascontiguousarray(points[:, list(self._stock.plan.joints)])
        if current is None:
            found = self._index.find(divided)
        else:
            found = self._numbers("current", current, len(points)).copy()
            known = np.flatnonzero(found >= 0)
            known = known[self._index.in_boxes(divided[known], found[known])]
            left = np.ones(len(points), dtype=bool)
            left[known] = False
            found[left] = self._index.find(divided[left])
        return int(found[0]) if single else found

    def xi(self, q: ArrayLike, charts: ArrayLike | None = None) -> Array:
        """Extra coordinates, (r,) or (N, r), of joint positions (n,) or (N, n); NaN where there is no chart.

        Args:
            q: joint positions [rad] or [m].
            charts: the charts to use, one or (N,). Default: `chart_at(q)`.
        """
        points, single = as_point_set("q", q, self.problem.n)
        numbers = self._chosen(points, charts)
        found = np.full((len(points), self.problem.r), np.nan)
        known = numbers >= 0
        found[known] = self._evaluation.xi(points[known], numbers[known])
        return found[0] if single else found

    def jacobian(self, q: ArrayLike, charts: ArrayLike | None = None) -> Array:
        """J_xi = dxi/dq, (r, n) or (N, r, n), as `xi`."""
        points, single = as_point_set("q", q, self.problem.n)
        numbers = self._chosen(points, charts)
        found = np.full((len(points), self.problem.r, self.problem.n), np.nan)
        known = numbers >= 0
        found[known] = self._evaluation.jacobian(points[known], numbers[known])
        return found[0] if single else found

    def inverse(self, x: ArrayLike, xi: ArrayLike, charts: ArrayLike, q_start: ArrayLike) -> Array:
        """Joint positions with task values x and coordinates xi, (n,) or (N, n); NaN where none is found.

        Newton's method from q_start, in the chart of each row. Solutions lie in the box of that chart.

        Args:
            x: task values, (m,) or (N, m).
            xi: coordinates in the charts, (r,) or (N, r).
            charts: numbers of the charts, one or (N,); -1 for none.
            q_start: where to begin, (n,) or (N, n) [rad] or [m].

        Raises:
            ShapeError, InvalidValueError: for arguments of the wrong shape, or a number that is no chart.
        """
        starts, single = as_point_set("q_start", q_start, self.problem.n)
        sizes = {"x": self.problem.m, "xi": self.problem.r}
        parts = [as_float_array(name, value) for name, value in (("x", x), ("xi", xi))]
        for part, (name, size) in zip(parts, sizes.items(), strict=True):
            require_shape(name, part.shape, (size,) if single else (len(starts), size))
        phi = np.hstack([np.atleast_2d(part) for part in parts])
        found = inverse_in_charts(self._evaluation, phi, self._numbers("charts", charts, len(starts)), starts)
        return np.asarray(found[0] if single else found)

    def chart(self, number: int, near: ArrayLike | None = None) -> Chart:
        """A chart as all of orthocas takes it: its domain is the box, less what lies beyond the joint limits.

        If the task compares orientations, the domain has all positions clear of singular ones, and so those far enough
        from half a turn; in cyclic joints, it reaches about 1 rad to both sides of `near`.

        Args:
            number: the number of the chart.
            near: a joint position (n,). Boxes repeat every full turn of joints that can turn so far; this tells which.

        Raises:
            InvalidValueError: if there is no such chart.
            DomainError: if the box lies beyond joint limits, as images of others may, or about half a turn from the
                reference orientation; see `with_reference`.
        """
        which = self._numbered(number, near)
        chart = self._kept.get(which)
        if chart is None:  # other threads may make it as well, or throw it out
            chart = self._kept[which] = self._made(*which)
            for oldest in list(self._kept)[:-_KEPT]:
                self._kept.pop(oldest, None)
        return chart

    def with_reference(self, q: ArrayLike) -> Self:
        """The same atlas, whose task compares the tip's orientation with that at q (n,).

        Charts do not depend on the reference orientation, only the task's own coordinates do, and they end half a turn
        away from it. Tasks without orientation stay as they are.
        """
        plan, at = self._stock.plan, as_point("q", q, self.problem.n)
        known = plan.problem
        if not is_turning(known.task):
            return self
        task = Task.named(known.robot, known.task.recipe["kind"], at)
        plan = replace(plan, problem=Problem(known.robot, task, known.metric, known.domain, known.name))
        return type(self)(replace(self._stock, plan=plan))

    def box(self, number: int, near: ArrayLike | None = None) -> Box:
        """The box of a chart within the joint limits; see `chart`."""
        return clipped(self._stock.plan, *self._borders(*self._numbered(number, near)))

    def handed_over(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike, number: int) -> tuple[Array, Array, Array]:
        """What a chart asks for at a desired motion of the joints: phi, its velocity and its acceleration, (n,) each.

        A controller that changes to this chart goes on from there, so the posture asked for does not jump:
        phi = phi(q), dphi = J dq, ddphi = J ddq + dJ/dt dq.
        """
        chart = self.chart(number, q)
        (q0,), (v,), (a,) = (as_point_set(name, x, chart.n)[0] for name, x in (("q", q), ("dq", dq), ("ddq", ddq)))
        J = chart.jacobian(q0)
        bend = np.array(chart.function("second_derivative")(q0, v, v))[:, 0]
        return chart.phi(q0), J @ v, J @ a + bend

    def _numbered(self, number: int, near: ArrayLike | None) -> tuple[int, Turns]:
        """The number of a chart, checked, and the full turns of its box towards a position."""
        number = require_count("number", number, least=0, most=len(self) - 1)
        plan = self._stock.plan
        q = plan.problem.domain.centre if near is None else as_point("near", near, plan.problem.n)
        apart = (q[list(plan.joints)] - self._index.image_centres(np.array([number]))[0][0]) / (2 * np.pi)
        turns = tuple(np.where(plan.lattice.endless, np.round(apart), 0.0).astype(int).tolist())
        return number, turns + (steps_to(plan, q) if is_turning(plan.problem.task) else ())

    def _made(self, number: int, turns: Turns) -> Chart:
        plan, index, numbers = self._stock.plan, self._index, np.array([number])
        fitted = index.rows(numbers)[1]
        signs = index.map_signs(numbers)[0]
        own = self._evaluation.numbers(fitted)[0] * np.append(
            1.0, np.prod(signs**self._evaluation.basis.exponents, axis=1)
        )
        values = self._evaluation.turned(own[None], numbers)[0]
        if self._evaluation.turns is not None:
            values[:, 0] += self._evaluation.turns.constants[number]
        borders, active = self._borders(number, turns), list(plan.active)
        whole, box = plan.box_around(*borders), clipped(plan, *borders)
        if is_turning(plan.problem.task):
            box = part_near(plan, box, turns[len(plan.joints) :])
        shift = ((box.centre - whole.centre) / whole.half_width)[active]
        scale = (box.half_width / whole.half_width)[active]
        if shift.any() or (scale != 1).any():
            values = moved(values, self._evaluation.basis.exponents.astype(int), shift, scale)
        clear = float(self._stock.records["clear"][self._stock.charts[fitted[0]]])
        return chart_of(plan, box, values, clear, plan.problem)

    def _borders(self, number: int, turns: Turns) -> tuple[Array, Array]:
        """Borders of the box of a chart in the joints that boxes divide, also beyond the limits."""
        numbers = np.array([number])
        centre = self._index.image_centres(numbers)[0][0] + 2 * np.pi * np.array(
            turns[: self._index.plan.lattice.low.size]
        )
        half = self._index.box_half_widths[self._index.rows(numbers)[1]][0]
        return centre - half, centre + half

    def _chosen(self, points: Array, charts: ArrayLike | None) -> Indices:
        if charts is None:
            return self._index.find(np.ascontiguousarray(points[:, list(self._stock.plan.joints)]))
        return self._numbers("charts", charts, len(points))

    def _numbers(self, name: str, value: ArrayLike, count: int) -> Indices:
        """Numbers of charts, or -1 for none, (count,); one number counts for all positions."""
        given = as_float_array(name, value)
        if given.ndim > 1 or given.size not in (1, count):
            raise ShapeError(name, given.shape, (count,))
        wrong = given[~((given >= -1) & (given < len(self)) & (given == np.floor(given)))]
        if wrong.size:
            raise InvalidValueError(name, wrong.flat[0], f"whole numbers from 0 to {len(self) - 1}, or -1 for no chart")
        return np.broadcast_to(given, (count,)).astype(np.int64)

    @cached_property
    def _index(self) -> Index:
        return Index(self._stock)

    @cached_property
    def _evaluation(self) -> Evaluation:
        turns = self._stock.turns
        if turns is not None and len(turns.order) != self._index.count:
            turns = None  # of an unfinished build
        return Evaluation(self._index, turns)
