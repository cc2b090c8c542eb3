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
from orthocas.tasks.branches import Branch, Branches, branches, build_clear_box, sample_centres, sample_nonsingular
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
    the gradient and the self-motion. With another metric than the identity, the same term for the volume in the
    identity metric and a small t joins. The first term keeps coordinates regular, the next ones make them as orthogonal
    as that permits. l_j(q) is the length of the gradient of xi_j, L_j its mean where the descent begins: xi is a
    similar motion everywhere. Half of the samples are uniform, of networks 70 %, the others boundary-weighted. The
    numbers are those of `orthocas.fitting.wide_search.WideRules`.

    Families are tried until one leaves out little of the branch:

    1. Under a whole pose or orientation, those without the last joint, and before them those without the first one too,
       if it can turn fully. Then xi stays while base or tool turn about their own axes. With r = 1 they are small
       networks, which lean less into the task than polynomials but have no proof in a useful time; with several
       coordinates or `like`, polynomials.
    2. Polynomials linear in each joint on whose position self-motions do not depend, such as the first and the last
       one. They are best to prove, and hold at any turn of these joints.
    3. Polynomials in all joints, and a network, as on arms whose axes pass each other at a distance. It takes several
       times as long to evaluate, and is not tried with `like` or with slides without limits.

    Polynomials descend with L-BFGS from linear coordinates across the task at the centre of the branch; networks with
    Adam from a random start, or from the result of A = I in another metric with r = 1. The best ones go on: as long as
    they are not regular enough at other samples, and get better, the worst of many fresh samples join. Once they are,
    leaks weigh more in a last descent, kept if coordinates stay regular enough.

    The best result is kept: regular at the centre, with the fewest bad positions, then with the largest 1 % quantile of
    the volume. The domain of the chart is the part of the branch where coordinates are regular with a margin in the
    identity metric, see `RegularPart`. With polynomials in all joints or networks, a joint without limits has one turn
    in which samples lie; beyond it, positions belong to the domain as far as coordinates are regular there.

    If r joints do not move the task at all, such as the last one under a tool with an axis, they are the coordinates,
    exact everywhere, unless `parametrisation` or `like` is given. Singular positions then divide the branch once more,
    by the sign of det of the other joints' columns. The chart is on the centre's side.

    `regular_share` is of the branch: of all its positions that `branches` counts as clear, the fraction in the domain.
    If the chart leaves out the other side, or can only serve a smaller box, `left_out` and a BranchWarning say so.

    Wide charts hold on most of what the arm reaches without passing a singular position, but their leaks are large, 8
    to 60 degrees on the arms that were measured. They serve inverse kinematics, closed loops, trackers and laws with
    the whole inertia, best with A = M; see `fit` for decoupled control. That det J keeps its sign does not mean that
    phi is one-to-one.

    Args:
        robot: the robot.
        task: a task of that robot. A missing reference orientation is taken at the centre of the branch.
        branch: a branch of `orthocas.branches`, its name, or a box of your own. Default: the branch of the home; with
            none there, the largest. If its middle is not clear, signs and references begin at `domain.home`, the clear
            position with the most room. If coordinates then leave out much, the largest box around it may take the
            place of the branch, see `left_out`.
        metric: as in `Problem`.
        clearance: least relative singular value of the task, > 0; see `orthocas.ClearBox`.
        parametrisation: a family, as in `fit`. Those that are not linear in their parameters descend like networks;
            those without parameters, such as `SEW` or `Given`, are taken as they are.
            Default: the first of those above that leaves out little.
        home: posture whose branch is meant, (n,) or its name. Default: as for `suggest_domain`.
        like: what coordinates are to be, or to be like: a function of an SX column q, the name of a joint, or "swivel",
            the angle of the elbow about the line from shoulder to wrist [rad]; with r > 1, several, or a task of lower
            priority. r quantities that are regular nearly everywhere are the coordinates themselves, see `exact`.
            Otherwise the first coordinates follow them: the loss holds their gradients against those of the quantities
            along self-motions, at all samples. Default: none; with shoulder, elbow and wrist and r = 1, xi gets the
            scale and the direction of the swivel.
        exact: whether xi is the quantity itself, xi = y(q), on the part of the branch where it is regular. With True it
            is, however small the part; with False it never is. Default: where the part has 99.5 % of the nonsingular
            positions, if no `parametrisation` is given. A parametrisation without parameters, such as `SEW` or
            `Given`, is a quantity that is taken with True. Nothing is fitted then, so `weights` and `samples` do not
            count.
        weights: weights of terms that join the loss, such as `{"name": 0.1}` for a term of `register_loss_term`; or
            `Weights`, which also take the place of those of leaks and mutual angles: `Weights(task=10.0, mutual=1.0)`.
            They are weights of angles in the metric by default; without them, task is 2 m w and mutual 0.3.
            They are means over the first samples; the worst ones of polynomials only ask for regular coordinates. A
            search for folds has no place here. Default: none.
        samples: number of samples. Default: 30 for each function, 5,000 to 20,000; 100,000 for a network.
        seed: seed of the samples, and of the first network.
        collisions: whether the arm may leave postures in self-collision aside, by `robot.collisions`: their samples
            do not count, neither in the loss nor in `regular_share`, which is that of the free part. Chart files hold
            the solids then, and `evaluate` measures free postures.
        monitor: called with progress.

    Returns:
        The chart, the branch, and the regular share.

    Raises:
        DomainError: if no position of the branch is clear by 1.5 times `clearance`, or if coordinates are not regular
            in the middle with the sign that they have on most of the branch; with `exact`, not in the middle.
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

    # Positions of the branch that count for its share, and the posture at which xi has the value of its quantity
    chosen = _choose_branch(robot, task, branch, home)
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
        # Families to try; the domain of each covers all positions of its cyclic joints
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
    """Weights of terms that join the loss; those of angles are of leaks, and of mutual angles in the metric."""
    if isinstance(weights, Weights):
        return replace(weights, angles=weights.angles or "metric")
    require_kind("weights", weights, Mapping)
    for name in weights:
        find_term(name)
    return Weights(extra=weights).extra


def _choose_branch(robot: Robot, task: Task, branch: Branch | Box | str | None, home: ArrayLike | str | None) -> Branch:
    """The branch itself, by its name, or that of the home."""
    if isinstance(branch, Branch):
        return branch
    if isinstance(branch, Box):
        return Branch("box", branch, branch.centre, float("nan"), float("nan"))
    parts: Branches = branches(robot, task)
    if branch is not None:
        return parts[branch]
    return parts.of(find_home(robot, task, home).q) or parts[0]


def _build_problems(
    robot: Robot, task: Task, metric: Metric | MetricSpec, branch: Branch, clearance: float
) -> tuple[Problem, ...]:
    """The problem on the clear part of a branch.

    If its middle is not clear, its home is the clear position with the most room around it. The box around this
    position is a second problem, because a singular middle may part the branch.
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
    # Of the clear positions, the one with the most room around it
    clear = points[values > BRANCH_RULES.of_centre * clearance]
    room = box.half_width - np.abs(clear - box.centre)
    if not len(clear):
        missing = f"no position clear by {BRANCH_RULES.of_centre * clearance:g}"
        most = f"at most {math.floor(1e3 * float(values.max()) / BRANCH_RULES.of_centre) / 1e3:g} can serve it"
        raise DomainError(f"branch '{branch.name}' has {missing}, expected one for clearance = {clearance:g}: {most}")
    best = int(np.argmax(np.log(room).sum(axis=1)))
    home, half_width, centre = clear[best], room[best], box.centre.copy()
    smaller = build(Box(home, half_width, box.unbounded))
    # A smaller box leaves nothing out of joints without limits; these have their turn around the home
    if {*np.flatnonzero(half_width < box.half_width)} <= {*box.unbounded}:
        return (smaller,)
    centre[list(box.unbounded)] = home[list(box.unbounded)]
    return build(Box(centre, box.half_width, box.unbounded), home), smaller


def _fit_most(problems: tuple[Problem, ...], fit_on: Callable[[Problem], WideFit]) -> WideFit:
    """The chart of the whole branch; of a smaller box, if its middle is singular and this is regular on more of it."""
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
    """Under a pose, families without the turn of the tool; first without that of the base, too, if it can turn fully.

    These are small networks for one coordinate, and polynomials for several, or if they are to mean something.

    Then come polynomials that are linear in the joints on whose position the self-motions do not depend, by proof. Then
    those that are so in such slides without limits only, if there are others: a joint that turns has one turn.
    Then a network, but not for coordinates that are to mean something, nor with slides without limits.
    """
    robot = problem.robot
    # Joints that may enter linearly, and those of them that must, since they have no ends
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
            # A joint with limits enters a network like others: linear in it, coordinates lean by up to 13 degrees more
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
    """A problem and a family that suit each other."""
    require_parametrisation(family)
    family = family.for_problem(problem)
    if isinstance(family, CyclicParametrisation):
        # A family that does without joints that turn tool or base is regular at any turn of them, or at none
        names, task = problem.robot.joint_names, problem.task
        left_out = ((name, names.index(name)) for name in list_left_out(family) if name in names)
        free = (name for name, k in left_out if turns_tool(task, k) or keeps_self_motions(problem, k))
        problem = widen_over_cyclic_joints(problem, (*family.cyclic, *free))
    if family.closed_form is not None:
        expected = "one that is fitted, such as a polynomial or an MLP, or one without parameters, such as Given"
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
    """Coordinates that need no fit: quantities, or joints that do not move the task; None if there are none."""
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
        wrong = f"in the middle of branch '{branch.name}', coordinates fold or have another sign than on most of it"
        raise DomainError(f"{wrong}: give a smaller box as branch, another branch, or another parametrisation")
    coordinates, quantities, meaning = _name_coordinates(solution, settings, posture)
    # The domain is where coordinates are regular; how much of the branch that is, and how good they are there
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
    """Bound of the rms leak of one coordinate that does not depend on some joints S [deg]; 0 if nothing is known.

    Of gradients v with v_S = 0, the nearest one to the self-motion z has the leak a, and none has a smaller one::

        sin^2 a = (A z)_S^T (A_SS)^-1 (A z)_S / z^T A z        (A = I and the last joint: sin a = |z_n| / |z|)
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
    """Coordinates with scale, order and signs; the quantities that they are, or are like; and the note that says so.

    Fitted ones have the units of their quantities, or of the swivel if that suits, or else the gauge of `fit`.
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
    """Describe what a chart leaves out of a branch, judged by its clear positions (N, n); empty if that is little."""
    domain, reasons = problem.domain, []
    if share < RULES.divided and not np.array_equal(domain.home, domain.centre):
        reason = "its middle is not clear, and coordinates have one direction on a part of it only"
        return f"all but {percent(share)} of the clear positions: {reason}"
    inside = np.asarray(Box(domain.centre, domain.half_width, domain.unbounded).contains(counted))
    if not inside.all():
        box = f"around q = ({number_list(domain.centre)}) with half-widths ({number_list(domain.half_width)})"
        reasons.append(f"its middle is not clear, so the chart has a smaller box, {box}")
    beside = is_on_side_of_centre(problem, counted)
    if not beside.all():
        reasons.append("singular positions divide it, so the chart has one side of them")
    kept = percent(float((inside & beside).mean()))
    return f"all but {kept} of the clear positions: {'; '.join(reasons)}" if reasons else ""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class WideFit(Fit):
    """A chart of a branch, and how it was found."""

    branch: Branch
    regular_share: float = float("nan")  #: of the clear positions of the branch, the share in the domain, from samples
    left_out: str = ""  #: what the fit left out of the branch from the start, and why
    meaning: MeaningError | None = None  #: how far xi is from what it is like, for r = 1
    least_leak: float = 0.0  #: no coordinate without the joints that this one leaves out has a smaller leak, rms [deg]

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
