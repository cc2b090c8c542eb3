"""Planning among obstacles with OMPL: in the coordinates of a chart, on the constraint, and in joint space.

At a constant tool position, the 7-DoF arm moves its elbow from one posture to another, between spheres that close the
straight way. RRT-Connect plans

- in xi: the state is xi (4 numbers) without constraints; the inverse map of the chart gives the joints, with x exact;
- on the constraint h(q) = x, by OMPL's `ProjectedStateSpace` and `AtlasStateSpace`: the state is q (7 numbers), and
  every new state is projected.

With a tool that moves as well, it plans in (x, xi) and in q, both 7 numbers.

All use the same clearance of links and spheres, the same step between checks, and one thread. The time in xi includes
the search for postures from which the inverse map starts. Needs `ompl` (the extra `peers`) and a C compiler.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from ompl import base, geometric, util
from spheres import Evaluator, Places, Query, World

import orthocas as oc
from orthocas.tools.checks import Array

STEP = 0.05  # longest joint motion between two checks [rad]
LIMIT = 10.0  # [s] for one plan


@dataclass(frozen=True)
class Plan:
    """What a planner found."""

    seconds: float
    path: Array | None  #: joint positions (N, n), every STEP, or None


class InCoordinates:
    """Plans in xi at the x of the query's start, or in (x, xi)."""

    def __init__(self, world: World, query: Query, constant_x: bool) -> None:
        self.clear, self.places = world.clearance(query), Places(world, query, constant_x)
        self.size = self.places.size

    def setup(self) -> geometric.SimpleSetup:
        """States in a box around all known postures."""
        space, bounds = base.RealVectorStateSpace(self.size), base.RealVectorBounds(self.size)
        for i, (low, high) in enumerate(zip(*self.places.box, strict=True)):
            bounds.setLow(i, low)
            bounds.setHigh(i, high)
        space.setBounds(bounds)
        setup = geometric.SimpleSetup(space)
        setup.setStateValidityChecker(self._valid)
        setup.getSpaceInformation().setStateValidityCheckingResolution(STEP / space.getMaximumExtent())
        ends = [space.allocState(), space.allocState()]
        for state, place in zip(ends, (self.places.start, self.places.goal), strict=True):
            state[0 : self.size] = place.tolist()
        setup.setStartAndGoalStates(*ends)
        return setup

    def joints(self, state: base.State) -> Array | None:
        """The joint position inside the domain, or None."""
        return self.places.joints(np.array(state[0 : self.size]))

    def _valid(self, state: base.State) -> bool:
        q = self.joints(state)
        return q is not None and self.clear(q) > 0


class InJoints:
    """Plans in q: on the constraint that the tool stays, in one of OMPL's spaces, or without a constraint."""

    def __init__(self, world: World, query: Query, kind: type[base.ConstrainedStateSpace] | None) -> None:
        self.world, self.query, self.kind, self.clear = world, query, kind, world.clearance(query)

    def setup(self) -> geometric.SimpleSetup:
        """States in the domain."""
        n, (low, high) = self.world.chart.n, self.world.domain.bounds
        space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
        for i in range(n):
            bounds.setLow(i, low[i])
            bounds.setHigh(i, high[i])
        space.setBounds(bounds)
        if self.kind is None:
            setup = geometric.SimpleSetup(space)
            setup.getSpaceInformation().setStateValidityCheckingResolution(STEP / space.getMaximumExtent())
            ends = [space.allocState(), space.allocState()]
            for state, q in zip(ends, (self.query.start, self.query.goal), strict=True):
                state[0:n] = q.tolist()
        else:
            self.constraint = OnPosition(self.world.chart, self.world.chart.x(self.query.start))
            constrained = self.kind(space, self.constraint)
            setup = geometric.SimpleSetup(base.ConstrainedSpaceInformation(constrained))
            constrained.setDelta(STEP)
            ends = [constrained.allocState(), constrained.allocState()]
            for state, q in zip(ends, (self.query.start, self.query.goal), strict=True):
                state.copy(q.tolist())
                if self.kind is base.AtlasStateSpace:
                    constrained.anchorChart(state)
        setup.setStateValidityChecker(self._valid)
        setup.setStartAndGoalStates(*ends)
        return setup

    def joints(self, state: base.State) -> Array:
        """The joint position."""
        return np.array([state[i] for i in range(self.world.chart.n)])

    def _valid(self, state: base.State) -> bool:
        q = self.joints(state)
        return self.clear(q) > 0 and bool(self.world.domain.contains(q))


class OnPosition(base.Constraint):
    """h(q) = x, with OMPL's tolerance and its projection."""

    def __init__(self, chart: oc.Chart, x: Array) -> None:
        super().__init__(chart.n, chart.m, 1e-4)
        self.n, self.x = chart.n, x
        self.values = [Evaluator(chart.function(name)) for name in ("task", "task_jacobian")]

    def function(self, q: Array, out: Array) -> None:
        """The residual."""
        out[:] = self.values[0](q).ravel() - self.x

    def jacobian(self, q: Array, out: Array) -> None:
        """Of the residual."""
        out[:, :] = self.values[1](q).reshape(self.n, -1).T


SPACES: dict[str, tuple[bool, Callable[[World, Query], InCoordinates | InJoints]]] = {  # whether the tool stays
    "xi": (True, lambda world, query: InCoordinates(world, query, constant_x=True)),
    "projection": (True, lambda world, query: InJoints(world, query, base.ProjectedStateSpace)),
    "atlas": (True, lambda world, query: InJoints(world, query, base.AtlasStateSpace)),
    "(x, xi)": (False, lambda world, query: InCoordinates(world, query, constant_x=False)),
    "q": (False, lambda world, query: InJoints(world, query, None)),
}


def planned(build: Callable[[World, Query], InCoordinates | InJoints], world: World, query: Query) -> Plan:
    """Plan with RRT-Connect, and sample the path."""
    start = time.perf_counter()
    planner = build(world, query)
    setup = planner.setup()
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    setup.setup()
    setup.solve(LIMIT)
    seconds = time.perf_counter() - start
    if not setup.haveExactSolutionPath():
        return Plan(seconds, None)
    path = setup.getSolutionPath()
    path.interpolate()
    joints = [planner.joints(state) for state in path.getStates()]
    return Plan(seconds, None if any(q is None for q in joints) else np.array(joints))


def row(name: str, world: World, queries: list[Query]) -> str:
    """Plans found, their times and lengths, and how far the tool is from where it should stay."""
    stays, build = SPACES[name]
    plans = [planned(build, world, query) for query in queries]
    found = [(plan.path, query) for plan, query in zip(plans, queries, strict=True) if plan.path is not None]
    seconds = [plan.seconds for plan in plans]
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path, _ in found]
    errors = [np.abs(world.chart.x(path) - world.chart.x(query.start)).max() for path, query in found]
    tool = f"{max(errors, default=np.nan):.0e}" if stays else ""
    return (
        f"| {name} | {len(found)} of {len(plans)} | {np.median(seconds):.3f} | {max(seconds):.2f} "
        f"| {np.median(lengths):.2f} | {tool} |"
    )


def main(quick: bool = False, count: int = 30) -> list[str]:
    """Print both tables; `quick` takes two queries."""
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(1)
    chart, rows = oc.fit(oc.problems.get("iiwa"), oc.Polynomial(4)).chart, []
    with TemporaryDirectory() as folder:
        world = World(chart, Path(folder))
        for stays in (True, False):
            found = (query for seed in itertools.count() if (query := world.query(seed, stays)) is not None)
            queries = list(itertools.islice(found, 2 if quick else count))
            print(f"\ntool {'at rest' if stays else 'moves'}\n")
            print("| states | found | median [s] | longest [s] | length [rad] | tool error [m] |")
            print("| --- | --- | --- | --- | --- | --- |")
            for name in (name for name, (rests, _) in SPACES.items() if rests is stays):
                rows.append(row(name, world, queries))
                print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--queries", type=int, default=30)
    options = parser.parse_args()
    main(options.quick, options.queries)
