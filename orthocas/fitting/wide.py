"""Wide charts: coordinates that are regular on a whole branch of the joint range."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from orthocas.bases.cyclic import keeps_self_motions, turns_tool, widen_over_cyclic_joints
from orthocas.bases.family import (
    CyclicParametrisation,
    JointSpace,
    LinearFamily,
    Parametrisation,
    require_parametrisation,
    warn_unless_savable,
)
from orthocas.bases.mlp import MLP
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.chart_file import FREE
from orthocas.charts.coordinates import Coordinates
from orthocas.charts.point_quality import worst_points
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import BranchWarning, DomainError, Interrupted, InvalidValueError, warn_caller
from orthocas.fitting.fit import Fit, fix_gauge, normalise
from orthocas.fitting.like import Like, Likeness, MeaningError, choose_quantities, take_exactly
from orthocas.fitting.terms import Weights, find_least_volume, find_term
from orthocas.fitting.wide_search import (
    RULES,
    Search,
    WideSettings,
    WideSolution,
    find_best,
    is_on_side_of_centre,
    list_left_out,
    sample_plain_frames,
    search_families,
)
from orthocas.robots.robot import Robot
from orthocas.robots.tree import require_driven
from orthocas.solvers.protocol import Status
from orthocas.tasks.branches import RULES as BRANCH_RULES
from orthocas.tasks.branches import Branch, branches, build_clear_box, sample_centres, sample_nonsingular
from orthocas.tasks.domains import Box
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tasks.problem import Problem, check
from orthocas.tasks.regular_box import find_home
from orthocas.tasks.samples import find_idle_joints, sample_problem, sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, as_number, require_count, require_kind
from orthocas.tools.display import listed, number_list, percent
from orthocas.tools.interrupts import remembered
from orthocas.tools.progress import Monitor, silent

CLEARANCE = RULES.clearance  #: default least relative singular value


def fit_wide(
    robot: Robot,
    task: Task,
    branch: Branch | Box | str | None = None,
    metric: Metric | MetricSpec = "euclidean",
    *,
    clearance: float = CLEARANCE,
    parametrisation: Parametrisation | None = None,
    home: ArrayLike | str | None = None,
    like: Likeness | None = None,
    exact: bool | None = None,
    weights: Weights | Mapping[str, float] | None = None,
    samples: int | None = None,
    seed: int = 0,
    collisions: bool = False,
    monitor: Monitor = silent,
) -> WideFit:
    """Find coordinates that are regular on a whole branch of the joint range, and as orthogonal as that permits.

    The parameters theta of a family minimise, over samples q of the branch that are clear of singular positions::

        L = mean_q [ max(0, 1 - v / t)^2 + w mean_j sin^2 a_j + 0.15 mean_jk cos^2 b_jk
                     + 0.03 sum_j log^2(l_j / L_j) + terms of `weights` ]

    w is 0.3 with A = I and 1 otherwise, a_j(q) the leak of coordinate j, b_jk the angle between the gradients of two
    coordinates. v(q) is the volume of coordinates: det of an orthonormal basis of the task's gradients and of the unit
    gradients of xi, all in the metric. Coordinates are regular where v is not zero; for r = 1 it is the cosine between
    the gradient and the self-motion. With another metric than the identity, the same term with the volume in the
    identity metric and a small t is added. The first term keeps coordinates regular, the next ones make them as
    orthogonal as that permits. l_j(q) is the length of the gradient of xi_j, and L_j its mean where the descent begins;
    the last term makes a unit of xi a motion of similar length everywhere. Half of the samples are uniform (70 % for
    networks), the others boundary-weighted. The numbers are those of `orthocas.fitting.wide_search.WideRules`.

    Families are tried until one leaves out little of the branch:

    1. If the task is a whole pose or orientation, families that do not depend on the last joint. Before these, if the
       first joint can turn fully, families that depend neither on the first nor on the last one. Then xi stays constant
       while base or tool turn about their own axes. With r = 1 these are small networks, which leak less than
       polynomials but cannot be certified in a useful time; with several coordinates or `like`, they are polynomials.
    2. Polynomials linear in each joint on whose position self-motions do not depend, such as the first and the last
       one. They are the easiest to certify, and hold at any turn of these joints.
    3. Polynomials in all joints, and a network, for arms whose axes do not meet. The network takes several times as
       long to evaluate, and is not tried with `like` or with slides without limits.

    Polynomials descend with L-BFGS from linear coordinates across the task at the centre of the branch. Networks
    descend with Adam from a random start or, in another metric than the identity with r = 1, from the result of A = I.
    Then the best family is improved: as long as coordinates are not regular enough at held-out samples and get better,
    the worst of many fresh samples join the loss. Once they are regular enough, a last descent gives leaks more weight;
    its result is kept if it stays regular enough.

    Results are ranked by regularity at the centre, then by the fewest bad positions, then by the largest 1 % quantile
    of the volume. The domain of the chart is the part of the branch where coordinates are regular with a margin in the
    identity metric, see `RegularPart`. With polynomials in all joints or networks, samples of a joint without limits
    lie in one turn; beyond it, positions belong to the domain wherever coordinates are regular.

    If r joints do not move the task at all, such as the last one under a tool with an axis, these joints are the
    coordinates, exact everywhere, unless `parametrisation` or `like` is given. Singular positions then divide the
    branch once more, by the sign of det of the other joints' columns. The chart is on the side of the centre.

    `regular_share` is the fraction of the branch's positions that lie in the domain, of those that `branches` counts as
    clear. If the chart leaves out the other side, or only covers a smaller box, `left_out` and a BranchWarning say so.

    Wide charts hold on most of what the arm reaches without passing a singular position, but their leaks are large, 8
    to 60 degrees on the arms that were measured. Use them for inverse kinematics, closed loops, trackers and laws with
    the whole inertia, best with A = M; see `fit` for decoupled control. A constant sign of det J does not mean that phi
    is one-to-one.

    Args:
        robot: the robot.
        task: a task of that robot. If it lacks a reference orientation, the one at the centre of the branch is taken.
        branch: a branch of `orthocas.branches`, its name, or a box of your own. Default: the branch of the home
            posture; the largest one if the home lies in none. If the centre of the branch is not clear, its place is
            taken by `domain.home`, the clear position with the most room around it. If coordinates then leave out much
            of the branch, the largest box around `domain.home` may replace it, see `left_out`.
        metric: as in `Problem`.
        clearance: least relative singular value of the task, > 0; see `orthocas.ClearBox`.
        parametrisation: a family, as in `fit`. Families that are not linear in their parameters are fitted like
            networks; families without parameters, such as `SEW` or `Given`, are taken as they are. Default: the first
            of those above that leaves out little.
        home: a posture (n,) or its name, whose branch is taken. Default: as for `suggest_domain`.
        like: quantities that the coordinates are, or follow: a function of an SX column q, the name of a joint, or
            "swivel", the angle of the elbow about the line from shoulder to wrist [rad]; with r > 1, several, or a task
            of lower priority. If r quantities are regular nearly everywhere, they are the coordinates, see `exact`.
            Otherwise the first coordinates follow them: the loss holds their gradients to those of the quantities,
            mainly along self-motions, at all samples. Default: none; then on arms with shoulder, elbow and wrist and
            r = 1, xi gets the scale and the direction of the swivel.
        exact: whether xi is the quantity itself, xi = y(q), on the part of the branch where it is regular. With True it
            is, even if the part is small; with False it never is. Default: it is if the part has 99.5 % of the
            nonsingular positions, and no `parametrisation` is given. A parametrisation without parameters, such as
            `SEW` or `Given`, counts as such a quantity with True. Then nothing is fitted, and `weights` and `samples`
            have no effect.
        weights: weights of terms that are added to the loss, such as `{"name": 0.1}` for a term of
            `register_loss_term`; or `Weights`, which also replace those of leaks and mutual angles:
            `Weights(task=10.0, mutual=1.0)`. Their angles are in the metric by default, where task 2 m w and mutual 0.3
            would be the usual weights. With polynomials, they act at the first samples only, because the worst samples
            only serve regularity. The weight of folds has no effect. Default: none.
        samples: number of samples. Default: 30 for each basis function, but 5,000 to 20,000; for networks 100,000, or
            50,000 if they leave out joints.
        seed: seed of the samples, and of the parameters with which networks begin.
        collisions: whether to leave out postures in self-collision, by `robot.collisions`. Their samples count neither
            in the loss nor in `regular_share`, which is that of the free part. Chart files then hold the solids, and
            `evaluate` measures free postures.
        monitor: called with progress.

    Returns:
        The chart, the branch, and the regular share.

    Raises:
        DomainError: if no position of the branch has a relative singular value of 1.5 times `clearance`; or if
            coordinates fold at the centre, or have another sign there than on most of the branch.
        InvalidValueError, UnknownNameError, NotRedundantError: if an argument is invalid.
        Interrupted: after Ctrl-C, once there are coordinates; before that, KeyboardInterrupt.

    Source:
        ours, docs/how-to/wide.md.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
        >>> bent = oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2])
        >>> found = oc.fit_wide(robot, oc.Task.position(robot, "xy"), bent)
        >>> found.regular_share > 0.99
        True
    """
    start = time.perf_counter()
    require_kind("robot", robot, Robot)
    require_driven("a wide fit", robot.tree)
    require_kind("task", task, Task)
    bound = as_number("clearance", clearance)
    if not 0 < bound < np.inf:
        raise InvalidValueError("clearance", clearance, "positive and finite")
    require_count("seed", seed, least=0)
    count = None if samples is None else require_count("samples", samples, least=2)
    terms = None if weights is None else _check_weights(weights)
    require_kind("collisions", collisions, bool)
    solids = robot.collisions if collisions else None

    # The branch, the posture at which xi equals its quantity, and clear positions that measure the regular share
    if isinstance(branch, Branch):
        chosen = branch
    elif isinstance(branch, Box):
        chosen = Branch("box", branch, branch.centre, float("nan"), float("nan"))
    else:
        # Default: the branch of the home posture, or the largest one
        parts = branches(robot, task)
        chosen = parts[branch] if branch is not None else parts.of(find_home(robot, task, home).q) or parts[0]
    posture = chosen.posture if home is None else find_home(robot, task, home).q
    counted = sample_nonsingular(robot, task, chosen.box, RULES.held_out, (seed, RULES.counted_tag))
    counted = counted if solids is None else counted[solids.check_free(counted)]
    finish = partial(_finish, branch=chosen, posture=posture, counted=counted, start=start)

    def fit_on(problem: Problem) -> WideFit:
        """The chart of one problem."""
        quantities, wanted = choose_quantities(problem, like, exact, parametrisation)
        settings = WideSettings(count, seed, monitor, terms, quantities, solids)
        solution = _solve_at_once(problem, quantities, parametrisation, wanted, counted, seed)
        if solution is not None:
            return finish(solution, settings=settings, interrupted=pressed())
        # The families to try. The domain of each covers all positions of its cyclic joints
        families = _choose_families(problem, like) if parametrisation is None else (parametrisation,)
        searches = [Search(*_prepare(problem, family, like), settings) for family in families]
        try:
            return finish(search_families(searches).solution, settings=settings, interrupted=pressed())
        except KeyboardInterrupt:
            if searches[0].best is None:
                raise
            return finish(find_best(searches).solution, settings=settings, interrupted=True)

    with remembered() as pressed:
        result = _fit_most(_build_problems(robot, task, metric, chosen, bound), fit_on)
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    if result.left_out:
        warn_caller(f"the chart of branch '{chosen.name}' leaves out {result.left_out}", BranchWarning)
    return result


def _check_weights(weights: Weights | Mapping[str, float]) -> Weights | Mapping[str, float]:
    """Check weights of terms that are added to the loss. The default angles of `Weights` are those in the metric."""
    if isinstance(weights, Weights):
        return replace(weights, angles=weights.angles or "metric")
    require_kind("weights", weights, Mapping)
    for name in weights:
        find_term(name)
    return Weights(extra=weights).extra


def _build_problems(
    robot: Robot, task: Task, metric: Metric | MetricSpec, branch: Branch, clearance: float
) -> tuple[Problem, ...]:
    """The problem on the clear part of a branch.

    If its centre is not clear, the home of the problem is the clear position with the most room around it. A second
    problem then has the box around this position, because singular positions at the centre may divide the branch.
    """
    box = branch.box

    def build(part: Box, home: Array | None = None) -> Problem:
        """The problem on the clear positions of a box, as `branches` counts them."""
        own = task.with_reference_at(part.centre if home is None else home)
        return Problem(robot, own, metric, build_clear_box(robot, own, part, clearance, home), branch.name)

    try:
        return (build(box),)
    except DomainError:
        points, values = sample_centres(robot, task, box)
    # Find the clear position with the most room around it
    clear = points[values > BRANCH_RULES.of_centre * clearance]
    room = box.half_width - np.abs(clear - box.centre)
    if not len(clear):
        missing = f"no position with a relative singular value of {BRANCH_RULES.of_centre * clearance:g}"
        most = f"clearance can be {math.floor(1e3 * float(values.max()) / BRANCH_RULES.of_centre) / 1e3:g} at most"
        raise DomainError(f"branch '{branch.name}' has {missing}, which clearance = {clearance:g} needs: {most}")
    best = int(np.argmax(np.log(room).sum(axis=1)))
    home, half_width, centre = clear[best], room[best], box.centre.copy()
    smaller = build(Box(home, half_width, box.unbounded))
    # Joints without limits lose nothing in a smaller box: their box is one turn, placed around the home
    if {*np.flatnonzero(half_width < box.half_width)} <= {*box.unbounded}:
        return (smaller,)
    centre[list(box.unbounded)] = home[list(box.unbounded)]
    return build(Box(centre, box.half_width, box.unbounded), home), smaller


def _fit_most(problems: tuple[Problem, ...], fit_on: Callable[[Problem], WideFit]) -> WideFit:
    """The chart of the whole branch, or that of the smaller box if there is one and it is regular on more of it."""
    whole, *smaller = problems
    try:
        result = fit_on(whole)
    except DomainError:
        if not smaller:
            raise
        return fit_on(smaller[0])
    if not smaller or result.regular_share >= RULES.divided or result.status is Status.INTERRUPTED:
        return result
    return max(result, fit_on(smaller[0]), key=lambda fit: fit.regular_share)


def _choose_families(problem: Problem, like: Likeness | None) -> tuple[Polynomial | MLP, ...]:
    """The families to try, in this order.

    1. Under a pose: families that leave out the joints that turn the base and the tool, then those that only leave out
       the tool's. They are small networks for r = 1 without `like`, else polynomials.
    2. Polynomials that are linear in the joints on whose position self-motions provably do not depend.
    3. If these include other joints than slides without limits: polynomials that are linear in such slides only. A
       revolute joint without limits then has one turn.
    4. A network, without `like` and without such slides.
    """
    robot = problem.robot
    # Joints that may enter linearly, and those that must: slides without limits
    free = [k for k in range(robot.n) if keeps_self_motions(problem, k)]
    slides = robot.tree.prismatic
    endless = [k for k in free if slides[k] and np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])]
    tool = [k for k in range(robot.n) if turns_tool(problem.task, k)] if like in (None, "swivel") else []
    base = [k for k in free if k not in tool]
    turns = [k for k in base if not slides[k] and robot.upper[k] - robot.lower[k] >= 2 * np.pi]
    names, fewer = (tuple(robot.joint_names[k] for k in part) for part in (free, endless))
    families: list[Polynomial | MLP] = []
    for left_out in [[*tool, *turns]] * bool(tool and turns) + [tool] * bool(tool):
        without = tuple(robot.joint_names[k] for k in sorted(left_out))
        linear = tuple(robot.joint_names[k] for k in base if k not in left_out)
        if len(linear) + len(without) >= robot.n - problem.r:
            continue
        if like is None and problem.r == 1:
            # Networks linear in a joint with limits have leaks up to 13 degrees larger, so only unlimited joints are
            unlimited = tuple(name for name in linear if np.isinf(robot.upper[robot.joint_names.index(name)]))
            families.append(replace(RULES.small_network, cyclic=unlimited, without=without))
        else:
            families.append(Polynomial(RULES.degree, linear, without=without))
    families.append(Polynomial(RULES.degree, names))
    if names != fewer:
        families.append(Polynomial(RULES.degree_of_all, fewer))
    if like is None and not endless:
        families.append(RULES.network)
    return tuple(families)


def _prepare(problem: Problem, family: Parametrisation, like: Likeness | None) -> tuple[Problem, Parametrisation]:
    """The family for the problem, and the problem with all positions of joints that are cyclic for the family.

    Raises:
        InvalidValueError: if the family has no parameters, or is not linear in them with `like`.
    """
    require_parametrisation(family)
    family = family.for_problem(problem)
    if isinstance(family, CyclicParametrisation):
        # A left-out joint that turns tool or base does not change regularity, so it may have any position
        names, task = problem.robot.joint_names, problem.task
        left_out = ((name, names.index(name)) for name in list_left_out(family) if name in names)
        free = (name for name, k in left_out if turns_tool(task, k) or keeps_self_motions(problem, k))
        problem = widen_over_cyclic_joints(problem, (*family.cyclic, *free))
    if family.closed_form is not None:
        expected = "a family to fit, such as a polynomial or an MLP, or one without parameters, such as Given"
        raise InvalidValueError("parametrisation", family.label, expected)
    if like is not None and not isinstance(family.family(JointSpace.of(problem), problem.r), LinearFamily):
        raise InvalidValueError("parametrisation", family.label, "one that is linear in its parameters, for like")
    warn_unless_savable(family)
    return problem, family


def _solve_at_once(
    problem: Problem,
    quantities: Like | None,
    parametrisation: Parametrisation | None,
    exact: bool | None,
    counted: Array,
    seed: int,
) -> WideSolution | None:
    """Coordinates that need no fit: quantities, or joints that do not move the task. None if a fit is needed."""
    coordinates: Coordinates | None
    if quantities is not None:
        coordinates = take_exactly(problem, quantities, exact, counted)
    else:
        idle = find_idle_joints(problem, sample_problem(problem, RULES.first, (seed, RULES.first_tag)))[-problem.r :]
        if len(idle) < problem.r or parametrisation is not None:
            return None
        problem, family = _prepare(problem, _choose_families(problem, None)[0], None)
        none = np.zeros(0)
        coordinates = Coordinates(family, JointSpace.of(problem), tuple(idle), none, none, none)
    return None if coordinates is None else WideSolution(problem, coordinates, "none", 0, ())


def _finish(
    solution: WideSolution,
    *,
    settings: WideSettings,
    branch: Branch,
    posture: Array,
    counted: Array,
    start: float,
    interrupted: bool,
) -> WideFit:
    """The chart of a solution, normalised and evaluated."""
    clear, seed = solution.problem, settings.seed
    status = Status.INTERRUPTED if interrupted else Status.CONVERGED
    if solution.misses_centre:
        if interrupted:
            raise KeyboardInterrupt
        wrong = f"at the centre of branch '{branch.name}', coordinates fold or have another sign than on most of it"
        raise DomainError(f"{wrong}: give a smaller box as branch, another branch, or another parametrisation")
    coordinates, quantities, meaning = _name_coordinates(solution, settings, posture)
    # The domain is where coordinates are regular. Measure its share of the branch, and the errors of the meaning
    domain = RegularPart(clear.domain, coordinates, find_least_volume(clear))
    problem = Problem(clear.robot, clear.task, clear.metric, domain, clear.name)
    share = float(domain.contains(counted).mean()) if len(counted) else float("nan")
    measured = quantities is not None and problem.r == 1
    error = quantities.measure_error(problem, coordinates, seed) if quantities is not None and measured else None
    followed = settings.quantities is not None and solution.coordinates.size > 0 and not measured
    worst = worst_points(problem, coordinates, seed)
    terms = settings.weights or {}
    users = terms.for_problem(clear).by_name if isinstance(terms, Weights) else terms
    notes: dict[str, str | float] = {
        "solver": solution.solver,
        "seed": seed,
        "samples": solution.samples,
        "status": status.value,
        "branch": branch.name,
        "share of the branch": share,
        "least conditioning": worst.least,
        **({} if settings.collisions is None else {FREE: settings.collisions.origin}),
        **meaning,
        **({} if error is None else error.write_notes()),
        **{f"weight of {name}": weight for name, weight in users.items() if weight},
    }
    return WideFit(
        chart=Chart(problem, coordinates, notes),
        stages=tuple(stage.mark_interrupted() if interrupted else stage for stage in solution.stages),
        problem_check=check(problem, seed=seed),
        idle_joints=tuple(problem.robot.joint_names[k] for k in coordinates.idle),
        worst=worst,
        seconds=time.perf_counter() - start,
        branch=branch,
        regular_share=share,
        left_out=_describe_left_out(clear, branch, counted, share),
        meaning=error,
        like=quantities.measure_distances(problem, coordinates, seed) if quantities is not None and followed else {},
        least_leak=_bound_leak(problem, list_left_out(coordinates.parametrisation), seed),
    )


def _bound_leak(problem: Problem, without: Sequence[str], seed: int) -> float:
    """Lower bound of the rms leak of any coordinate that does not depend on joints S [deg]; 0 for r > 1 or without S.

    Every gradient v with v_S = 0 has at least the leak a, where z is the self-motion::

        sin^2 a = (A z)_S^T (A_SS)^-1 (A z)_S / z^T A z        (A = I and the last joint: sin a = |z_n| / |z|)

    The rms is taken over samples of the domain.
    """
    if not without or problem.r > 1:
        return 0.0
    left_out = [problem.robot.joint_names.index(name) for name in without]
    points = sample_uniform(problem.domain, RULES.bounded, (seed, RULES.bounded_tag))
    A, z = problem.metric.evaluate(points), sample_plain_frames(problem, points).null_basis[:, :, 0]
    momentum = np.einsum("sij,sj->si", A, z)
    own = momentum[:, left_out]
    part = np.linalg.solve(A[:, left_out][:, :, left_out], own[:, :, None])[:, :, 0]
    squares = np.einsum("si,si->s", own, part) / np.einsum("si,si->s", momentum, z)
    return float(np.degrees(np.sqrt(np.mean(np.arcsin(np.sqrt(np.clip(squares, 0.0, 1.0))) ** 2))))


def _name_coordinates(
    solution: WideSolution, settings: WideSettings, posture: Array
) -> tuple[Coordinates, Like | None, dict[str, str]]:
    """Coordinates with scale, order and signs; the quantities that they are or follow; and notes that say so.

    Fitted coordinates have the units of their quantities; without these, the scale of the swivel if xi follows it well
    enough; else scale, order and signs as in `fit`.
    """
    problem, raw, quantities, seed = solution.problem, solution.coordinates, settings.quantities, settings.seed
    if not raw.size:
        return raw, quantities, {} if quantities is None else {"meaning": "; ".join(quantities.names), "exact": "yes"}
    first = sample_problem(problem, RULES.first, (seed, RULES.first_tag))
    coordinates = normalise(raw, problem.domain.home, first)
    if quantities is not None:
        return quantities.name_units(coordinates, posture), quantities, {"meaning": quantities.label}
    swivel = Like.by_default(problem)
    scaled = None if swivel is None else swivel.scale(coordinates, problem, posture, seed)
    if swivel is None or scaled is None:
        return fix_gauge(coordinates, problem.domain.home), None, {}
    return scaled, swivel, {"meaning": swivel.label}


def _describe_left_out(problem: Problem, branch: Branch, counted: Array, share: float) -> str:
    """Describe what a chart leaves out of a branch, from clear positions (N, n) of it; empty if it is nothing."""
    domain, reasons = problem.domain, []
    if share < RULES.divided and not np.array_equal(domain.home, domain.centre):
        reason = "its centre is not clear, and coordinates have one direction on a part of it only"
        return f"all but {percent(share)} of the clear positions: {reason}"
    inside = np.asarray(Box(domain.centre, domain.half_width, domain.unbounded).contains(counted))
    if not inside.all():
        box = f"around q = ({number_list(domain.centre)}) with half-widths ({number_list(domain.half_width)})"
        reasons.append(f"its centre is not clear, so the chart has a smaller box, {box}")
    beside = is_on_side_of_centre(problem, counted)
    if not beside.all():
        reasons.append("singular positions divide it, so the chart has one side of them")
    kept = percent(float((inside & beside).mean()))
    return f"all but {kept} of the clear positions: {'; '.join(reasons)}" if reasons else ""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class WideFit(Fit):
    """A chart of a branch, and how it was found."""

    branch: Branch
    regular_share: float = float("nan")  #: share of the branch's clear positions that lie in the domain, from samples
    left_out: str = ""  #: what the chart leaves out of the branch by its construction, and why
    meaning: MeaningError | None = None  #: how far xi is from the quantity that it follows, for r = 1
    least_leak: float = 0.0  #: least rms leak of any coordinate that leaves out the same joints [deg]

    def facts(self) -> dict[str, str]:
        """The facts of a fit, with branch and regular share."""
        facts = super().facts()
        share = percent(self.regular_share, 2)
        named, meaning = self.chart.parts.named_coordinates, ""
        joints = listed(list_left_out(getattr(self.chart.coordinates, "parametrisation", None)))
        clear = "clear and free" if FREE in self.chart.notes else "clear"
        if "exact" in self.chart.notes:
            meaning = f"{'; '.join(named)}, exactly"
        elif self.meaning is not None:
            meaning = f"{self.meaning.explained}: {named[0]}"
        own = {
            "branch": self.branch.name,
            "regular": f"{share} of the branch's {clear} positions (samples); the domain is this part",
            **({"left out": self.left_out} if self.left_out else {}),
            **(
                {"least leak": f"{self.least_leak:.1f} deg rms, of any coordinate without {joints}"}
                if self.least_leak
                else {}
            ),
            **({"meaning": meaning} if meaning else {}),
        }
        return {"fit": facts.pop("fit"), "problem": facts.pop("problem"), **own, **facts}
