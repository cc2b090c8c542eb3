"""[AS2023] Fig. 10: two paths in task space, lifted along the task gradients, end at different joint positions.

Derivation (ours). The lift of the unit field of task coordinate i is X_i = J^#A e_i. Moving by eps along X_1, then X_2,
ends at q0 + eps (X_1 + X_2) + eps^2 (X_1' X_1 / 2 + X_2' X_2 / 2 + X_2' X_1) + O(eps^3). In the other order, the last
term is X_1' X_2. So q_a - q_b = eps^2 [X_1, X_2] + O(eps^3). Both fields project to fields of the task plane that
commute, so the bracket lies in the kernel of J_x, and q_a and q_b are on one self-motion curve. The bracket modulo the
span is bilinear, so |[X_1, X_2]|_A = d / sqrt(det(J_x A^-1 J_x^T)) with the involutivity defect d, because det is the
squared area of the two gradients and X_1, X_2 are dual to them.
"""

import casadi as ca
import numpy as np
from matplotlib.patheffects import withStroke

from orthocas.bases import Polynomial
from orthocas.charts.chart import Chart
from orthocas.exact.flow import TaskFlow
from orthocas.exact.involutivity import TaskBrackets
from orthocas.tasks.problem import Problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import Batched, dense_function
from orthocas.tools.checks import Array

from .chosen_fit import USUAL, ChosenFit
from .drawing import Drawing
from .scene import Scene
from .section import curves_inside, isosurface, section, tilts, unit_gradients
from .style import EXTRA, INK, LABEL, TASK, add_3d, joint_cube, line_legend, new_figure

RED, GREEN = "#c8102e", "#2a9d4a"  #: gradients of x and y
_START = np.array([0.0, 1.6, 1.6])  # q0 [rad]
_DRAWN = -0.6  # change of x and y in the picture [m]
_STEPS = (0.04, 0.02, 0.01)  # steps for the numbers [m]
_TIGHT = 1e-13  # tolerance of the flow for the numbers
_LOW, _HIGH = np.array([-2, 3, 2]) * np.pi / 8, np.array([3, 7, 6]) * np.pi / 8
_DEGREE = 4
_LEAF = "#b4b8be"
_LABELS = {
    "$q_0$": (0.0, 0.13, 0.08),
    "$q_a$": (0.0, -0.04, -0.17),
    "$q_b$": (0.0, 0.16, -0.08),
}  # offsets of the labels [rad]
_ARROW = 0.22  # length of unit gradients in the picture [rad]
_VIEW = (20, 14)


def draw(quick: bool, chosen: ChosenFit = USUAL) -> Drawing:
    """Draw both paths, self-motion curves, gradients and a fitted leaf; the numbers tell how far apart the paths end.

    `quick` draws a coarser leaf.
    """
    problem = section(_LOW, _HIGH)
    chart = chosen.chart(problem, Polynomial(degree=_DEGREE), quick)
    ways = [way(problem, _START, order, _DRAWN) for order in ((0, 1), (1, 0))]
    figure = new_figure(4.6, layout=None)
    axes = add_3d(figure, 0.1, 0.1, 0.8, 0.89)
    joint_cube(axes, _LOW, _HIGH, parts=1, margin=np.pi / 8)
    _scene(problem, chart, ways, 30 if quick else 90).draw(axes, _VIEW, _LOW, _HIGH, 1.08)
    for place, (text, offset) in zip((_START, *(path[-1] for path in ways)), _LABELS.items(), strict=True):
        label = axes.text(*(place + offset), text, fontsize=LABEL + 2, ha="center", va="center", zorder=9)
        label.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    first, second = "$x$, then $y$", "$y$, then $x$"
    gradients = {r"$\nabla x$": RED, r"$\nabla y$": GREEN}
    line_legend(figure, {"self-motion curves": TASK, first: INK, second: EXTRA} | gradients | {r"$\xi$ = const": _LEAF})
    return Drawing({"": figure}, _numbers(problem, chart, ways))


def way(problem: Problem, start: Array, order: tuple[int, int], change: float, points: int = 40) -> Array:
    """The lift of a path in the task plane that changes one coordinate, then the other, (2 points - 1, 3)."""
    path = start[None]
    for k in order:
        dx = np.outer(np.linspace(0, change, points), np.eye(2)[k])[1:]
        path = np.concatenate([path, TaskFlow(problem).move(np.tile(path[-1], (len(dx), 1)), dx).points])
    return path


def _scene(problem: Problem, chart: Chart, ways: list[Array], cells: int) -> Scene:
    scene = Scene()
    scene.add_cube(_LOW, _HIGH, 0.01)
    leaf = isosurface(chart, float(chart.xi(_START)[0]), cells)
    scene.add_surface(leaf.vertices, leaf.faces, _LEAF, 0.5)
    corners = np.array([_START, ways[0][len(ways[0]) // 2], ways[1][len(ways[1]) // 2], ways[0][-1]])
    for curve in curves_inside(problem, corners, 0.03):
        scene.add_tube(curve, 0.014, TASK)
    for path, colour in zip(ways, (INK, EXTRA), strict=True):
        scene.add_tube(path, 0.018, colour)
        places = path[[0, len(path) // 4, len(path) // 2, 3 * len(path) // 4, -1]]
        for q, units in zip(places, unit_gradients(problem, places), strict=True):
            for unit, paint in zip(units, (RED, GREEN), strict=True):
                scene.add_arrow(q, _ARROW * unit, 0.011, paint)
        scene.add_ball(path[-1], 0.06, colour)
    scene.add_ball(_START, 0.06, TASK)
    return scene


def _numbers(problem: Problem, chart: Chart, ways: list[Array]) -> dict[str, float]:
    """Gaps of ever smaller paths compared with the bracket, and gaps for a pair of fields that commute."""
    gaps = np.array([_gap(problem, _START, eps) for eps in _STEPS])
    bracket, defect = _bracket(problem, _START)
    ends = np.array([path[-1] for path in ways])
    (curve,) = curves_inside(problem, ends[:1], 0.02)
    tips = problem.task.batched(ends)[0]
    return {
        "gap_drawn": float(np.linalg.norm(ends[0] - ends[1])),
        "task_difference_of_ends": float(np.abs(tips[0] - tips[1]).max()),
        "distance_of_qb_from_curve_through_qa": _distance(ends[1], curve),
        **{f"gap_at_{eps:g}": float(gap) for eps, gap in zip(_STEPS, gaps, strict=True)},
        "order_of_gap": float(np.log2(gaps[1] / gaps[2])),
        "gap_over_bracket_prediction": float(gaps[2] / (_STEPS[2] ** 2 * bracket)),
        "bracket_norm": bracket,
        "bracket_over_defect_formula": bracket / defect,
        "gap_of_commuting_pair": _gap(_elbow(problem), _START, _DRAWN),
        "mean_tilt_along_paths_deg": float(tilts(chart, np.concatenate(ways)).mean()),
    }


def _distance(point: Array, curve: Array) -> float:
    """Distance of a point from a polyline (P, 3)."""
    edges, away = np.diff(curve, axis=0), point - curve[:-1]
    shares = np.clip(np.sum(edges * away, axis=1) / np.sum(edges**2, axis=1), 0, 1)
    return float(np.linalg.norm(away - shares[:, None] * edges, axis=1).min())


def _gap(problem: Problem, start: Array, change: float) -> float:
    """Distance between the ends of both paths [rad]."""
    ends = []
    for order in ((0, 1), (1, 0)):
        q = start[None]
        for k in order:
            q = TaskFlow(problem).move(q, change * np.eye(2)[k : k + 1], _TIGHT).points
        ends.append(q[0])
    return float(np.linalg.norm(ends[0] - ends[1]))


def _bracket(problem: Problem, at: Array) -> tuple[float, float]:
    """|[X_1, X_2]| of the lifts at a point, and its expected value d / sqrt(det(J J^T))."""
    q = ca.SX.sym("q", problem.n)
    f, g = (TaskFlow(problem).field(q, ca.DM.eye(2)[:, k]) for k in range(2))
    commutator = ca.jtimes(g, q, f) - ca.jtimes(f, q, g)  # (dg/dq) f - (df/dq) g
    J = problem.task.jacobian_function(q)
    defect = TaskBrackets.build(problem).build_defect_function()(q)
    evaluate = dense_function("bracket", [q], [ca.norm_2(commutator), defect / ca.sqrt(ca.det(J @ J.T))])
    bracket, formula = Batched(evaluate)(at[None])
    return float(bracket[0, 0]), float(formula[0, 0])


def _elbow(problem: Problem) -> Problem:
    """The same arm with the end of link 2 as its task. Two joints move it, and the gradients span their plane."""

    def end(q: ca.SX) -> ca.SX:
        return ca.vertcat(ca.cos(q[0]) + ca.cos(q[0] + q[1]), ca.sin(q[0]) + ca.sin(q[0] + q[1]))

    return Problem(problem.robot, Task.custom(problem.robot, "elbow", end), "euclidean", problem.domain, "elbow")
