"""Atlases, many charts that cover the joint range of a robot in one file, and parts of them."""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlas.atlas_file import Stock, read_stock, require_whole
from orthocas.atlas.box_fit import chart_of, clipped, moved, part_near, steps_to
from orthocas.atlas.c_source import AtlasSource, check_c_of_atlas
from orthocas.atlas.evaluation import Evaluation
from orthocas.atlas.index import Index
from orthocas.atlas.lattice import Outcome
from orthocas.atlas.plan import AtlasSettings, Plan, is_turning
from orthocas.atlas.view_session import AtlasSession
from orthocas.charts.chart import Chart
from orthocas.charts.newton import Newton
from orthocas.charts.phi import Differences, PhiMap, largest
from orthocas.codegen.library import GeneratedC
from orthocas.codegen.proof import Proof
from orthocas.control.controller import Controller
from orthocas.errors import InvalidValueError, ShapeError
from orthocas.tasks.domains import Box
from orthocas.tasks.problem import Problem
from orthocas.tasks.relative import Relative
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import (
    Array,
    Indices,
    as_float_array,
    as_number,
    as_path,
    as_point,
    as_point_set,
    frozen_indices,
    require_count,
    require_kind,
    require_shape,
)
from orthocas.tools.display import Shown, listed, number_list

_ACCEPTED = 1e-10  # [m], [rad] and units of xi
_KEPT = 32  # charts that stay built, the last ones


def facts_of(stock: Stock, charts: int) -> dict[str, str]:
    """Charts, joints and what was asked of them."""
    plan, problem = stock.plan, stock.plan.problem
    names = problem.robot.joint_names
    counts = " x ".join(str(count) for count in plan.lattice.counts.tolist())
    asked = plan.settings
    return {
        "atlas": f"{charts} charts of {problem.heading}",
        "fitted": f"{len(stock.charts)} charts, {_proved(stock)} of them proved not to fold; "
        f"{len(plan.maps)} symmetries, the identity included",
        "task": problem.task.heading,
        "metric": problem.metric.name,
        "boxes": f"divide {listed(names[i] for i in plan.joints)}; {counts} tiles",
        "half-widths": f"of tiles {number_list(plan.lattice.width / 2)}, halved at most {asked.splits} times",
        "left out": f"cyclic {listed(names[i] for i in plan.cyclic) or 'none'}, "
        f"idle {listed(names[i] for i in plan.idle) or 'none'}",
        "asked": f"leak {asked.leak_deg:g} deg, conditioning {asked.conditioning:g}, "
        f"relative singular value above {asked.least_singular_value:g}",
        "file": f"{stock.contents.size / 2**20:.3g} MiB",
    }


def data_of(stock: Stock, charts: int) -> dict[str, Any]:
    """Plain data for JSON."""
    plan, problem = stock.plan, stock.plan.problem
    names = problem.robot.joint_names
    outcomes = np.bincount(stock.records["outcome"], minlength=len(Outcome))
    return {
        "charts": charts,
        "fitted": len(stock.charts),
        "bytes": stock.contents.size,
        "task": problem.task.name,
        "metric": problem.metric.name,
        "joints": [names[i] for i in plan.joints],
        "cyclic_joints": [names[i] for i in plan.cyclic],
        "idle_joints": [names[i] for i in plan.idle],
        "symmetries": len(plan.maps),
        "tiles": plan.lattice.counts.tolist(),
        "tile_half_widths": (plan.lattice.width / 2).tolist(),
        "settings": asdict(plan.settings),
        "boxes": {outcome.name.lower(): int(outcomes[outcome]) for outcome in Outcome},
        "certified": _proved(stock),
        "fit_seconds": float(stock.records["seconds"].sum()),
    }


def _proved(stock: Stock) -> int:
    return int((stock.records["certified"][stock.charts] > 0).sum())


def inverse_in_charts(evaluation: Evaluation, phi: Array, charts: Indices, starts: Array) -> Array:
    """Solve (h, xi_k)(q) = phi near given joint positions, in chart k of each row.

    Args:
        evaluation: coordinates of the atlas.
        phi: task values and coordinates, (N, n).
        charts: the chart of each row, (N,); -1 for none.
        starts: joint positions, (N, n).

    Returns:
        q, (N, n); NaN where Newton's method fails, or leads out of the box of the chart.
    """
    index, found = evaluation.index, np.full_like(starts, np.nan)
    good = (charts >= 0) & np.isfinite(phi).all(axis=1) & np.isfinite(starts).all(axis=1)
    for chart in np.unique(charts[good]).tolist():
        rows = np.flatnonzero(good & (charts == chart))
        search = Newton(_phi_map(evaluation, chart))(phi[rows], starts[rows])
        found[rows] = np.where((largest(search.residual) < _ACCEPTED)[:, None], search.q, np.nan)
    solved = np.flatnonzero(np.isfinite(found).all(axis=1))
    inside = index.in_boxes(found[solved][:, list(index.plan.joints)], charts[solved])
    found[solved[~inside]] = np.nan
    return found


def _phi_map(evaluation: Evaluation, chart: int) -> PhiMap:
    """(h, xi) in one chart."""
    relative = Relative(task := evaluation.index.plan.problem.task)

    def charts(q: Array) -> Indices:
        return np.full(len(q), chart)

    def phi(q: Array) -> Array:
        return np.hstack([task.batched(q)[0], evaluation.xi(q, charts(q))])

    def jacobian(q: Array) -> Array:
        J_x = relative.batched_rates(q)[0].reshape(len(q), task.m, -1)
        return np.concatenate([J_x, evaluation.jacobian(q, charts(q))], axis=1)

    n = evaluation.index.plan.problem.n
    return PhiMap(phi, jacobian, np.ones(n), Differences(np.zeros(n), relative))


Turns = tuple[int, ...]  #: full turns of each joint that boxes divide; then steps of cyclic ones, for orientations


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
        the current chart as long as its box holds q. So the chart does not change back and forth at a boundary.

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
            near: a joint position (n,). Boxes repeat every full turn of joints that can turn so far; this selects one.

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
        task = known.task.without_reference().with_reference_at(at)
        plan = replace(plan, problem=Problem(known.robot, task, known.metric, known.domain, known.name))
        return type(self)(replace(self._stock, plan=plan))

    def box(self, number: int, near: ArrayLike | None = None) -> Box:
        """The box of a chart within the joint limits; see `chart`."""
        return clipped(self._stock.plan, *self._boundaries(*self._numbered(number, near)))

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

    def part(self, postures: ArrayLike | None = None, radius: float = 0.0) -> "AtlasPart":
        """The charts along postures (N, n), as `AtlasPart.along` finds them; all charts without postures."""
        return AtlasPart.whole(self) if postures is None else AtlasPart.along(self, postures, radius)

    def c_source(self) -> AtlasSource:
        """What `orthocas.generate_c` writes C from: all charts."""
        return self.part().c_source()

    def check_c(self, generated: GeneratedC, controller: Controller | None, states: int, seed: int) -> Proof:
        """The comparison of `orthocas.codegen.check_c`, with all charts."""
        return self.part().check_c(generated, controller, states, seed)

    def view_session(self) -> AtlasSession:
        """What `orthocas.view` shows: a session that goes on in the next chart."""
        return AtlasSession(self)

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
        boundaries, active = self._boundaries(number, turns), list(plan.active)
        whole, box = plan.box_around(*boundaries), clipped(plan, *boundaries)
        if is_turning(plan.problem.task):
            box = part_near(plan, box, turns[len(plan.joints) :])
        shift = ((box.centre - whole.centre) / whole.half_width)[active]
        scale = (box.half_width / whole.half_width)[active]
        if shift.any() or (scale != 1).any():
            values = moved(values, self._evaluation.basis.exponents.astype(int), shift, scale)
        clear = float(self._stock.records["clear"][self._stock.charts[fitted[0]]])
        return chart_of(plan, box, values, clear, plan.problem)

    def _boundaries(self, number: int, turns: Turns) -> tuple[Array, Array]:
        """Boundaries of the box of a chart in the joints that boxes divide, also beyond the limits."""
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


@dataclass(frozen=True, eq=False, repr=False)
class AtlasPart(Shown):
    """Some charts of an atlas, for `orthocas.generate_c`.

    A part consists of tiles and of fitted charts: with the charts that were asked for come the images of these charts
    in the same tiles, which cost next to nothing.

    Args:
        atlas: the atlas.
        charts: numbers of charts in the atlas.

    Raises:
        InvalidValueError: if there are none, or one is no chart of the atlas.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import orthocas as oc
        >>> from orthocas import problems
        >>> path = [[0.6, 0.8, 0.8], [0.7, 0.8, 0.8]]
        >>> with TemporaryDirectory() as folder:
        ...     atlas = oc.build_atlas(
        ...         problems.get("planar_3r_xy"), Path(folder) / "arm.orthocas-atlas", region=path, radius=0.2, jobs=1
        ...     )
        ...     part = oc.AtlasPart.along(atlas, path, radius=0.1)
        >>> bool((part.charts >= 0).all())
        True
    """

    atlas: Atlas
    charts: Indices  #: numbers in the atlas, ascending; in C they count from 0 on, in this order

    def __post_init__(self) -> None:
        require_kind("atlas", self.atlas, Atlas)
        given = np.unique(frozen_indices("charts", self.charts, (None,), len(self.atlas)))
        if not given.size:
            raise InvalidValueError("charts", "none", "at least one chart of the atlas")
        object.__setattr__(self, "charts", _with_images(self.index, given))

    def __len__(self) -> int:
        """Number of charts, images included."""
        return len(self.charts)

    @classmethod
    def whole(cls, atlas: Atlas) -> Self:
        """All charts of an atlas."""
        require_kind("atlas", atlas, Atlas)
        return cls(atlas, np.arange(len(atlas)))

    @classmethod
    def along(cls, atlas: Atlas, q: ArrayLike, radius: float = 0.0) -> Self:
        """The charts that joint positions run through.

        Args:
            atlas: the atlas.
            q: joint positions (N, n) [rad] or [m], in steps that are small against the boxes.
            radius: how far single joints may leave the positions [rad] or [m]; charts found there are taken as well.

        Raises:
            InvalidValueError: if the atlas has no chart at one of the positions.
        """
        require_kind("atlas", atlas, Atlas)
        points = as_point_set("q", q, atlas.problem.n)[0]
        reach = as_number("radius", radius)
        if not 0 <= reach < np.pi:
            raise InvalidValueError("radius", radius, "a number from 0 to below pi")
        found = atlas.chart_at(points)
        if (found < 0).any():
            row = int(np.argmin(found))
            raise InvalidValueError(f"q[{row}]", np.round(points[row], 3).tolist(), "a position with a chart")
        steps = reach * np.eye(atlas.problem.n) if reach else np.zeros((0, atlas.problem.n))
        around = [atlas.chart_at(points + side * step) for step in steps for side in (-1, 1)]
        charts = np.unique(np.concatenate([found, *around]))
        return cls(atlas, charts[charts >= 0])

    def c_source(self) -> AtlasSource:
        """What `orthocas.generate_c` writes C from."""
        return AtlasSource.of(self)

    def check_c(self, generated: GeneratedC, controller: Controller | None, states: int, seed: int) -> Proof:
        """The comparison of `orthocas.codegen.check_c`."""
        return check_c_of_atlas(generated, self, controller, states, seed)

    @property
    def first_chart(self) -> Chart:
        """Chart 0 in C."""
        return self.atlas.chart(int(self.charts[0]))

    def facts(self) -> dict[str, str]:
        """Charts and the atlas."""
        fitted = len(np.unique(self.index.rows(self.charts)[1]))
        return {"part": f"{len(self)} charts, {fitted} of them fitted", **self.atlas.facts()}

    @property
    def plan(self) -> Plan:
        """The plan of the atlas."""
        return self.atlas._stock.plan

    @property
    def index(self) -> Index:
        """The search of the atlas."""
        return self.atlas._index

    @property
    def evaluation(self) -> Evaluation:
        """The numbers of the atlas."""
        return self.atlas._evaluation

    def certified(self, fitted: Indices) -> int:
        """How many of some fitted charts are proved not to fold."""
        stock = self.atlas._stock
        return int((stock.records["certified"][stock.charts[fitted]] > 0).sum())

    def clear_shares(self, fitted: Indices) -> Any:
        """Shares of the samples of fitted charts that are clear of singular positions, (fitted,)."""
        stock = self.atlas._stock
        return stock.records["clear"][stock.charts[fitted]]


def _with_images(index: Index, charts: Indices) -> Indices:
    """All charts of the same tiles that share their numbers with one of the given."""
    tiles, fitted = index.rows(charts)
    every = np.arange(index.count)
    all_tiles, all_fitted = index.rows(every)
    return np.asarray(every[np.isin(all_tiles, tiles) & np.isin(all_fitted, fitted)])
