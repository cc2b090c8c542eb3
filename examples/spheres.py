"""An arm with a chart in compiled C, and queries: two postures with spheres where a link would pass between them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

import orthocas as oc
from orthocas.codegen.library import CompiledLibrary, compile_shared
from orthocas.control import ControlStatus
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

INNER = 0.9  # share of the domain for random postures
BLOCKED = 0.7  # radius of the spheres, as a share of how far the link there is from where it is at the ends
KNOWN = 60  # samples for known postures
LEAST = 0.03  # of that distance [m]


@dataclass(frozen=True)
class Query:
    """A start and a goal at the same tool position, and spheres between them."""

    start: Array  #: (n,)
    goal: Array  #: (n,)
    spheres: Array  #: centres (k, 3) [m]
    radius: float  #: of the spheres and a link together [m]


class World:
    """The arm with its chart, in C."""

    def __init__(self, chart: oc.Chart, folder: Path) -> None:
        self.chart, self.domain = chart, chart.problem.domain
        generated = oc.generate_c(chart, folder, name="arm")
        self.library = CompiledLibrary(compile_shared(generated, folder), "arm", chart.n)

    def query(self, seed: int, stays: bool) -> Query | None:
        """Two random postures, and spheres where a link would be half way between them; None if these are in the way.

        Args:
            seed: of the postures.
            stays: whether the tool is at the same place in both.
        """
        rng = np.random.default_rng(seed)
        start, goal = self.domain.centre + INNER * self.domain.half_width * rng.uniform(-1, 1, (2, self.chart.n))
        ends, path = self.chart.phi(np.array([start, goal])), [start]
        if stays:
            ends[1, : self.chart.m] = ends[0, : self.chart.m]
        for share in np.linspace(0, 1, 61)[1:]:
            q, status = self.library.inverse((1 - share) * ends[0] + share * ends[1], path[-1])
            if status != ControlStatus.OK or not self.domain.contains(q):
                return None
            path.append(q)
        points = self.chart.problem.robot.joint_points(np.array([path[k] for k in (0, 24, 30, 36, 60)]))
        moved = np.minimum(*(np.linalg.norm(points[2] - points[end], axis=1) for end in (0, 4)))
        joint = int(np.argmax(moved[:-1]))
        query = Query(start, path[-1], points[1:4, joint], BLOCKED * moved[joint])
        clear = self.clearance(query)
        return query if min(clear(query.start), clear(query.goal)) > 0 and moved[joint] > LEAST else None

    def clearance(self, query: Query) -> Callable[[Array], float]:
        """The least distance of links and spheres at q [m]; links are capsules between the joints."""
        q = ca.MX.sym("q", self.chart.n)
        robot = self.chart.problem.robot
        joints = robot.function("joint_points")(q)
        distances = []
        for i in range(2, joints.shape[1] - 1):
            a, b = joints[:, i], joints[:, i + 1]
            for centre in query.spheres:
                along = ca.dot(centre - a, b - a) / (ca.sumsqr(b - a) + 1e-12)
                nearest = a + ca.fmin(ca.fmax(along, 0), 1) * (b - a)
                distances.append(ca.norm_2(centre - nearest) - query.radius)
        values = Evaluator(ca.Function("clearance", [q], [ca.mmin(ca.vertcat(*distances))]))
        return lambda q: float(values(q)[0])


class Places:
    """The joint positions of xi at the x of a query's start, or of (x, xi).

    Newton starts at the nearest of some postures, found before: those of random points of the domain.
    """

    def __init__(self, world: World, query: Query, constant_x: bool) -> None:
        self.world, chart = world, world.chart
        self.x = chart.x(query.start) if constant_x else np.empty(0)
        self.size = chart.n - len(self.x)
        points = sample_uniform(world.domain, KNOWN, 0)
        moved = [self._solved(chart.phi(point)[-self.size :], point) for point in points]
        self._known = np.array([query.start, query.goal, *(q for q in moved if q is not None)])
        self._places = chart.phi(self._known)[:, -self.size :]
        self.start, self.goal = self._places[:2]
        self.box = self._places.min(axis=0), self._places.max(axis=0)

    def joints(self, place: Array) -> Array | None:
        """The joint position inside the domain, or None."""
        return self._solved(place, self._known[np.argmin(((self._places - place) ** 2).sum(axis=1))])

    def _solved(self, place: Array, start: Array) -> Array | None:
        q, status = self.world.library.inverse(np.concatenate([self.x, place]), start)
        return q if status == ControlStatus.OK and self.world.domain.contains(q) else None


class Evaluator:
    """A function of q (n,) with its own memory, several times faster than a call: all entries, column by column."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function.expand()  # kept: the buffer does not
        self._buffer, self._run = self._function.buffer()
        self._point, self._value = np.empty(function.numel_in(0)), np.empty(function.numel_out(0))
        self._buffer.set_arg(0, memoryview(self._point))
        self._buffer.set_res(0, memoryview(self._value))

    def __call__(self, q: Array) -> Array:
        """The entries; the next call overwrites them."""
        self._point[:] = q
        self._run()
        return self._value
