"""The internal parts of a chart for solvers, laws and generated code: functions, differences, and searches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.charts.coordinates import Coordinates, InvertibleMap, fill_coordinates
from orthocas.charts.curve_tracer import CurveTracer, MotionKernel, SearchKernel, has_library
from orthocas.charts.curves import SelfMotionCurves
from orthocas.charts.descent import RULES, BoxedPhi, InDomain
from orthocas.charts.inside import Inside
from orthocas.charts.inverse import Inverse
from orthocas.charts.newton import (
    NEWTON,
    Continuation,
    Differences,
    FewRows,
    Newton,
    OwnInverse,
    PhiMap,
    PointFunctions,
    Starts,
    inverse_function,
)
from orthocas.charts.trackers import leave_over, near_function
from orthocas.tasks.problem import measure_task_sizes
from orthocas.tasks.relative import Relative
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.cached import BuiltOnUse, cached_property
from orthocas.tools.checks import Array, as_point, require_shape
from orthocas.tools.expressions import choose_form

if TYPE_CHECKING:
    from orthocas.charts.chart import Chart

FUNCTIONS = ("xi", "phi", "jacobian", "second_derivative", "task", "task_jacobian", "manipulability", "inverse")


@dataclass(frozen=True, eq=False)
class ChartParts:
    """The parts of a chart that solvers, laws and generated code use, built on first use. Not for users."""

    chart: Chart

    @cached_property
    def functions(self) -> BuiltOnUse[str, ca.Function]:
        """The CasADi functions of `Chart.function` by name."""
        return BuiltOnUse(self._build_function)

    def express(self, name: str, q: Any) -> Any:
        """The named function at a CasADi column q (n, 1), as an expression."""
        require_shape("q", q.shape, (self.chart.n, 1))
        return self.functions[name](q)

    def _build_function(self, name: str) -> ca.Function:
        """Build the function with a name of `FUNCTIONS`."""
        task = self.chart.problem.task
        if name == "task":
            return task.function
        if name == "task_jacobian":
            return task.jacobian_function
        if name == "manipulability":
            return task.manipulability_function
        q, v, w = (ca.MX.sym(symbol, self.chart.n) for symbol in ("q", "v", "w"))
        inputs = {"q": q}
        # stack the rows of the task and those of the coordinates
        own = self.chart.coordinates.functions
        if name == "inverse":
            return inverse_function(self.functions["phi"], self.phi_sizes, self.phi_map.difference)
        if name == "xi":
            value = own["xi"](q)
        elif name == "phi":
            value = ca.vertcat(task.function(q), own["xi"](q))
        elif name == "jacobian":
            value = ca.vertcat(task.jacobian_function(q), own["jacobian"](q))
        else:
            # d^2 phi [v, w] with two directions, because C evaluates it with different ones
            value = ca.vertcat(task.second_derivative_function(q, v, w), own["second_derivative"](q, v, w))
            inputs |= {"v": v, "w": w}
        return ca.Function(name, list(inputs.values()), [ca.densify(value)], list(inputs), [name])

    @cached_property
    def phi_sizes(self) -> Array:
        """Sizes of the components of phi, (n,): the range of each task component over the domain, and 1 for xi."""
        return np.concatenate([measure_task_sizes(self.chart.problem), np.ones(self.chart.r)])

    @property
    def turns(self) -> Array:
        """Periods of the components of phi, (n,): 2 pi for circle-valued coordinates, 0 where there is none."""
        own, chart = self.chart.coordinates, self.chart
        periods = own.turns if isinstance(own, Coordinates) else np.full(chart.r, getattr(own, "turn", 0.0))
        return np.concatenate([np.zeros(chart.m), periods])

    @property
    def named_coordinates(self) -> tuple[str, ...]:
        """Labels of the coordinates, with their meaning if it is known, such as 'xi1: like swivel [rad]'."""
        labels, notes = self.chart.labels[self.chart.m :], self.chart.notes
        meaning, exact = notes.get("meaning"), "exact" in notes
        named = meaning.split("; ") if isinstance(meaning, str) else []
        # notes of older charts omit "like"
        named = [name if exact or name.startswith("like ") else f"like {name}" for name in named]
        return (*(f"{label}: {name}" for label, name in zip(labels, named, strict=False)), *labels[len(named) :])

    def runnable(self, graph: ca.Function) -> ca.Function:
        """The form of one of this chart's functions that runs fast: scalar code.

        For networks, and for robots with more than 10 joints, it is the given graph itself.
        """
        own = self.chart.coordinates
        return graph if isinstance(own, Coordinates) and own.as_matrices else choose_form(graph, self.chart.n)

    def left_over(self, q_start: ArrayLike, q: ArrayLike, tolerance: float = 1e-9) -> Array | None:
        """Change of the joints q - q_start after a loop in (x, xi), without full turns of unbounded joints.

        phi is one-to-one only locally, so x and xi may return to their start while the joints do not. After a loop that
        can be contracted to a point within the domain, the change is 0. A loop around a full turn of the tool or the
        base cannot be contracted; its change is 0 only if xi does not depend on the joint that turns.

        Args:
            q_start: joint position at the start of the loop, (n,).
            q: joint position at its end, (n,).
            tolerance: largest difference of phi at both ends, relative to `phi_sizes`.

        Returns:
            The change, (n,) [rad] or [m]; None if phi differs at both ends, so that the path is open.
        """
        start, end = as_point("q_start", q_start, self.chart.n), as_point("q", q, self.chart.n)
        apart = self.phi_map.difference(self.chart.phi(end), self.chart.phi(start)) / self.phi_sizes
        return leave_over(float(np.abs(apart).max()), tolerance, end - start, self.chart.problem.turning)

    @cached_property
    def relative(self) -> Relative:
        """Errors and rates of the task relative to a target, see `Relative`."""
        return Relative(self.chart.problem.task)

    @cached_property
    def rates(self) -> ca.Function:
        """Function q (n, 1) -> J (n, n) with `Relative.rates` as task rows, for solvers and laws."""
        chart = self.chart
        if not self.relative.turned:
            return chart.function("jacobian")
        q = ca.MX.sym("q", chart.n)
        rows = ca.vertcat(self.relative.rates(q), chart.coordinates.functions["jacobian"](q))
        return ca.Function("rates", [q], [ca.densify(rows)], ["q"], ["rates"])

    def batched_rates(self, points: Array) -> Array:
        """J of `rates` at points (N, n), (N, n, n); NaN where the task Jacobian is not finite."""
        chart = self.chart
        J = np.empty((len(points), chart.n, chart.n))
        J[:, : chart.m] = self.relative.batched_rates(points)[0].reshape(-1, chart.m, chart.n)
        fill_coordinates(chart.coordinates, "jacobian", J[:, chart.m :], points)
        return J

    @cached_property
    def phi_map(self) -> PhiMap:
        """phi, J and scaled errors for solvers of phi(q) = phi."""
        chart = self.chart
        return PhiMap(chart.phi, self.batched_rates, self.phi_sizes, Differences(self.turns, self.relative))

    @cached_property
    def boxed(self) -> BoxedPhi:
        """phi in the box of the domain, for descents and searches."""
        return BoxedPhi(self.chart.problem.task, self.chart.problem.domain, self.phi_map, self.chart.xi)

    @cached_property
    def tracer(self) -> CurveTracer:
        """The tracer of self-motion curves, for r = 1."""
        return CurveTracer(self.boxed)

    @cached_property
    def motion_kernel(self) -> MotionKernel | None:
        """The C kernel that follows self-motions, for r = 1; None if it cannot be used, so that Python does it."""
        kernel = MotionKernel(self.chart)
        return kernel if has_library(kernel) else None

    @cached_property
    def turn_shifts(self) -> dict[str, Array]:
        """Changes of xi by a full turn of each unbounded joint, (r,), by the joint's name.

        Each posture then has several values of xi, which differ by multiples of this change. Left out are joints whose
        turns do not change xi, and joints whose turns change it by different amounts in different postures.
        """
        chart, shifts = self.chart, {}
        q = sample_uniform(chart.problem.domain, 8, 0)
        for k in chart.problem.turning:
            turned = chart.phi(q + 2 * np.pi * np.eye(chart.n)[k])
            shift = self.phi_map.difference(turned, chart.phi(q))[:, chart.m :]
            if np.abs(shift[0]).max() > RULES.same and np.ptp(shift, axis=0).max() < RULES.same:
                shifts[chart.problem.robot.joint_names[k]] = np.asarray(shift[0])
        return shifts

    @cached_property
    def inverse(self) -> Inverse:
        """The searches of `Chart.solve`."""
        chart, phi_map, domain = self.chart, self.phi_map, self.chart.problem.domain
        # grown coordinates have an inverse map of their own
        starts = Starts(phi_map, domain)
        if isinstance(chart.coordinates, InvertibleMap):
            own = OwnInverse(chart.coordinates, phi_map)
            return Inverse(chart.problem, phi_map, own, own, starts)
        boxed = self.boxed
        local, brief = (
            FewRows(phi_map, self.point_functions, Newton(phi_map, k)) for k in (NEWTON.halvings, NEWTON.brief)
        )
        in_domain, inside = InDomain(boxed, starts), Inside(boxed, starts)
        curves = SelfMotionCurves(boxed, starts, self.tracer, SearchKernel(chart)) if chart.r == 1 else None
        return Inverse(chart.problem, phi_map, local, brief, starts, Continuation(phi_map), in_domain, inside, curves)

    @cached_property
    def point_functions(self) -> PointFunctions:
        """The functions that trackers, and `solve` for few rows, call for one joint position."""
        phi_map = self.phi_map
        phi = self.chart.function("phi")
        return PointFunctions.of(phi, self.rates, phi_map.sizes, phi_map.difference, self.chart.problem.turning)

    @cached_property
    def reaching(self) -> ca.Function:
        """The function of errors and constraints for `ReachingTracker`, see `near_function`."""
        chart = self.chart
        return near_function(chart.function("phi"), self.rates, chart.m, self.phi_map, chart.problem.domain)
