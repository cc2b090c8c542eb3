"""Closed loops of the planar arm with three joints: the common part of Figs. 22 to 26 and 30 of [AS2023] (Sec. 8).

From the paper: uniform links of 3 kg, gravity along -y, A = M, steps through the low-pass filter with omega0 = 2 pi
rad/s and zeta = 0.7, and the controllers (33) and (35). The constants in capitals, except MASS, are ours, because the
paper does not state them.

The controllers are decoupled: the command is the sum of one controller for the task and one for the extra coordinates,
each with its own inertia, as in the paper. With the full inertia M_phi, tracking would be exact in any regular chart,
which would hide the effect that the figures show.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from orthocas.bases import CombinableFamily, Linear, Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.quality import evaluate
from orthocas.control import Impedance, PDPlus, Reference
from orthocas.control.linear_algebra import DampingDesign
from orthocas.fitting.fit import fit
from orthocas.robots import Robot
from orthocas.simulation import Coupling, Trajectory, coupling_index, simulate
from orthocas.tasks.domains import Box, Domain, Torus
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array

from .chosen_fit import USUAL, ChosenFit

Axes = Literal["x", "xy"]
Moves = tuple[dict[str, float], ...]  #: steps in order, each with new targets relative to the start [m] or [1]


@dataclass(frozen=True)
class Place:
    """A base with its tip straight above joint 1, and a box around the motions from there."""

    q2: float  #: of the base [rad]
    q3: float
    low: tuple[float, float, float]  #: corners of the box relative to the base [rad]
    high: tuple[float, float, float]


LENGTHS = (1.0, 1.0, 1.0)  #: of the links [m]
MASS = 3.0  #: of a link [kg], from the paper
STIFFNESS = 100.0  #: K: [N/m] for x and y, [J] for xi
DAMPING_RATIO = 0.7  #: Z
PAUSE = 2.0  #: time between steps [s]; the first step is at 1 s

GENTLE = Place(2.8, -1.9, (-0.35, -0.25, -0.8), (0.4, 0.3, 0.6))  #: leaves of x with low curvature
STRONG = Place(2.07, 2.07, (-0.5, -0.4, -1.6), (0.15, 0.35, 0.45))  #: ten times the curvature
FOLDED = Place(1.2, -2.9, (-0.55, -0.15, -0.15), (0.15, 0.9, 0.5))  #: for the task (x, y)

INTERLEAVED: Moves = ({"x": 0.25}, {"xi1": 0.3}, {"x": 0.0}, {"xi1": -0.3}, {"x": 0.25}, {"xi1": 0.0})  #: 22, 23, 25
ALL_OF_X: Moves = ({"x": 0.25}, {"xi1": 0.3}, {"xi2": -0.3}, {"x": 0.0}, {"xi1": 0.0}, {"xi2": 0.0})  #: Fig. 24
LARGE: Moves = ({"x": 0.35}, {"xi1": 0.5}, {"x": 0.0}, {"xi1": 0.0})  #: Fig. 26
SMALL: Moves = ({"x": 0.1}, {"xi1": 0.15}, {"x": 0.0}, {"xi1": 0.0})  #: Fig. 26
ALL_OF_XY: Moves = ({"x": 0.25}, {"y": 0.25}, {"xi1": 0.4}, {"x": 0.0}, {"y": 0.0}, {"xi1": 0.0})  #: Fig. 30


_GRID, _STARTS = 101, 5  # grid points and starts of the search for postures


@dataclass(frozen=True)
class Arm:
    """The planar arm, and its charts around a place."""

    lengths: tuple[float, ...] = LENGTHS

    def problem(self, axes: Axes, domain: Domain) -> Problem:
        """Task x or (x, y) of the tip, A = M."""
        robot = Robot.planar(lengths=self.lengths, masses=[MASS] * 3)
        return Problem(robot, Task.position(robot, axes), "inertia", domain)

    def base(self, place: Place) -> Array:
        """Joint positions with the tip at x = 0, y > 0, (3,)."""
        tip = np.dot(self.lengths, np.exp(1j * np.array([0.0, place.q2, place.q2 + place.q3])))
        return np.array([np.pi / 2 - np.angle(tip), place.q2, place.q3])

    def box(self, place: Place) -> Box:
        """The box on which coordinates are fitted and evaluated."""
        low, high = np.array(place.low), np.array(place.high)
        return Box(self.base(place) + (low + high) / 2, (high - low) / 2)

    def linear(self, axes: Axes, place: Place) -> Chart:
        """The coordinates (37) or (39) for all angles, so that the controller never leaves the domain."""
        base = tuple(self.base(place).tolist())
        return fit(self.problem(axes, Torus(3)), Linear(base, "paper")).chart

    def fitted(self, axes: Axes, place: Place, quick: bool, chosen: ChosenFit = USUAL) -> Chart:
        """Coordinates fitted on the box of the place, in the combination that agrees with `linear` at the base.

        The same steps then begin with the same motion. Linear combinations of coordinates stay orthogonal to the task.
        """
        return _fitted(self, axes, place, quick, chosen)


@lru_cache(maxsize=16)
def _fitted(arm: Arm, axes: Axes, place: Place, quick: bool, chosen: ChosenFit) -> Chart:
    """Fit a chart once, because several figures share it."""
    degree = 8 if axes == "x" and not quick else 6
    samples = 3000 if quick else 4000  # with 1500, rounding decides which minimum a fit of degree 6 ends in
    chart = chosen.chart(arm.problem(axes, arm.box(place)), Polynomial(degree), quick, samples)
    base = arm.base(place)
    return combined(chart, base, arm.linear(axes, place).jacobian(base)[chart.m :])


def combined(chart: Chart, base: Array, gradients: Array) -> Chart:
    """The chart of B (xi - xi(base)), with the constant B for which B J_xi(base) is nearest to `gradients` (r, n)."""
    old = chart.coordinates
    assert isinstance(old, Coordinates)
    assert isinstance(old.family, CombinableFamily)
    B = gradients @ np.linalg.pinv(chart.jacobian(base)[chart.m :])
    theta = old.family.combined(old.theta, B * old.scale)  # xi = scale (family - offset)
    offset = B @ (old.scale * old.offset + chart.xi(base))
    return replace(chart, coordinates=replace(old, theta=theta, offset=offset, scale=np.ones(chart.r)))


@dataclass(frozen=True, eq=False)
class Run:
    """A chart, a reference, and the measured trajectory."""

    chart: Chart
    reference: Reference
    trajectory: Trajectory

    @cached_property
    def coupling(self) -> Coupling:
        """Coupling indices of all pairs."""
        return coupling_index(self.chart, self.reference, self.trajectory)

    @property
    def missed(self) -> Array:
        """Largest distance from the targets at the end of a step, (n,). It stays large if targets are contradictory."""
        times = self.trajectory.times
        ends = np.searchsorted(times, self.reference.times[1:] - 1e-9).clip(max=len(times) - 1)
        return np.asarray(np.abs(self.trajectory.value[ends] - self.reference.targets).max(axis=0))

    @property
    def share_not_ok(self) -> float:
        """Share of instants at which the controller used its fallback."""
        return float(np.mean(self.trajectory.fell_back))

    def numbers(self, prefix: str = "") -> dict[str, float]:
        """Coupling indices, errors and missed targets of each coordinate, fallbacks, and the size of the motion."""
        labels, index = self.chart.labels, self.coupling.index
        pairs = [(i, j) for i, j in np.ndindex(index.shape) if np.isfinite(index[i, j])]
        values = {f"coupling_{labels[i]}_from_{labels[j]}": float(index[i, j]) for i, j in pairs}
        for name, each in (("tracking_error", self.trajectory.tracking_error), ("missed", self.missed)):
            values |= {f"{name}_{label}": float(error) for label, error in zip(labels, each, strict=True)}
        values["share_not_ok"] = self.share_not_ok
        values["largest_joint_motion_rad"] = float(np.abs(self.trajectory.q - self.trajectory.q[0]).max())
        return {f"{prefix}{key}": value for key, value in values.items()}


def follow(
    chart: Chart,
    start: Array,
    moves: Moves,
    feed_forward: bool = True,
    stiffness: ArrayLike = STIFFNESS,
    damping_ratio: ArrayLike = DAMPING_RATIO,
    damping: DampingDesign = "square_root",
) -> Run:
    """Follow the steps from a start (n,), with tau_2 (35) or with the feedback tau_1 (33) only."""
    labels, phi = chart.labels, chart.phi(start)
    changes = [
        (1 + PAUSE * k, {label: phi[labels.index(label)] + to for label, to in move.items()})
        for k, move in enumerate(moves)
    ]
    reference = Reference.steps(labels, phi, changes, 1 + PAUSE * len(moves))
    law = PDPlus if feed_forward else Impedance
    controller = law(chart, stiffness, damping_ratio, "decoupled", damping)
    return Run(chart, reference, simulate(controller, reference, start, must_be_reachable=False))


def task_angle_std(chart: Chart, box: Box, quick: bool) -> float:
    """Standard deviation of the angles between task and coordinate gradients over a box [deg], on held-out samples."""
    problem = Problem(chart.problem.robot, chart.problem.task, chart.problem.metric, box)
    return evaluate(Chart(problem, chart.coordinates), 5_000 if quick else 50_000).task_angle.std


def out_of_reach(run: Run) -> float:
    """Smallest distance of the task from its target over all postures where linear xi meets its targets [m].

    The worst step counts. These postures form a line (m = 1) or plane (m = 2), which is searched within half a turn
    around the start, first on a grid and then by least squares from the best grid points.
    """
    chart, start = run.chart, run.trajectory.q[0]
    normals = chart.jacobian(start)[chart.m :]
    along = np.linalg.svd(normals)[2][chart.r :]
    sides = np.meshgrid(*chart.m * [np.linspace(-np.pi, np.pi, _GRID)])
    grid = np.stack([side.ravel() for side in sides], axis=1)
    worst = 0.0
    for target in run.reference.targets:
        foot = start + np.linalg.pinv(normals) @ (target - run.reference.start)[chart.m :]

        def error(s: Array, foot: Array = foot, target: Array = target) -> Array:
            return chart.x(np.asarray(foot + s @ along)) - target[: chart.m]

        nearest = grid[np.argsort(np.linalg.norm(error(grid), axis=1))[:_STARTS]]
        worst = max(worst, min(float(np.linalg.norm(least_squares(error, s).fun)) for s in nearest))
    return worst
