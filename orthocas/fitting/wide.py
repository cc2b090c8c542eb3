"""Wide charts: coordinates that are regular on a whole branch of the joint range."""

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from orthocas.bases.cyclic import leaves_stay, over_cyclic_joints
from orthocas.bases.family import ArrayFamily, CyclicParametrisation, JointSpace, LinearFamily, Parametrisation
from orthocas.bases.mlp import MLP
from orthocas.bases.products import Polynomial
from orthocas.charts.chart import Chart
from orthocas.charts.point_quality import worst_points
from orthocas.charts.regular_part import RegularPart
from orthocas.errors import BranchWarning, DomainError, Interrupted, InvalidValueError
from orthocas.fitting.fit import Fit, fix_gauge, normalise
from orthocas.fitting.like import Like, Likeness
from orthocas.fitting.meaning import Meaning, MeaningError
from orthocas.fitting.regular_search import (
    JUDGED,
    BasisSearch,
    IdleSearch,
    NetworkSearch,
    Search,
    beside_the_middle,
)
from orthocas.fitting.settings import require_parametrisation
from orthocas.fitting.volume_loss import LEAST_VOLUME
from orthocas.robots.robot import Robot
from orthocas.robots.tree import require_driven
from orthocas.solvers.protocol import Status
from orthocas.tasks.branches import RULES as BRANCH_RULES
from orthocas.tasks.branches import Branch, Branches, branches, sample_centres, sample_nonsingular
from orthocas.tasks.domains import Box
from orthocas.tasks.metric import Metric, MetricSpec
from orthocas.tasks.problem import Problem, check
from orthocas.tasks.regular_box import find_home
from orthocas.tasks.samples import find_idle_joints, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.checks import Array, as_number, require_count, require_kind
from orthocas.tools.display import number_list, percent
from orthocas.tools.interrupts import remembered
from orthocas.tools.progress import Monitor, silent

CLEARANCE = 0.1  #: default least relative singular value
DEGREE = 6
_DEGREE_OF_ALL = 5  # where base and tool joints count like all others
_NETWORK = MLP((64, 64, 64), raw=True)
_FIRST, _FIRST_TAG = 200, 1000  # samples that scale coordinates, and their seed tag
# of the positions that judge coordinates, those that are not regular; above these shares another family is tried:
_POOR, _POOR_SEVERAL = 1e-3, 4e-3  # polynomials in all joints; the same with r > 1
_VERY_POOR = 2e-2  # a network in place of these
_STILL_POOR = 6e-3  # a network after these
_STAGE = "whole branch"  # begins the names of stages
_COUNTED_TAG = 3003  # seed tag of the positions of the branch that count for its share


@dataclass(frozen=True, eq=False, repr=False)
class WideFit(Fit):
    """A chart of a branch, and how it was found."""

    branch: Branch | None = None  #: the branch of the chart
    regular_share: float = float("nan")  #: of the clear positions of the branch, the share in the domain, from samples
    left_out: str = ""  #: what the fit left out of the branch from the start, and why
    meaning: MeaningError | None = None  #: how far xi is from what it is like, for r = 1

    def facts(self) -> dict[str, str]:
        """The facts of a fit, with branch and regular share."""
        known = super().facts()
        branch = "" if self.branch is None else self.branch.name
        share = percent(self.regular_share, 2)
        own = {
            "branch": branch,
            "regular": f"{share} of the branch's clear positions (samples); the domain is this part",
            **({"left out": self.left_out} if self.left_out else {}),
            **({"meaning": f"{self.meaning.explained}: xi1, {self.chart.notes['meaning']}"} if self.meaning else {}),
        }
        return {"fit": known.pop("fit"), "problem": known.pop("problem"), **own, **known}


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
    samples: int | None = None,
    seed: int = 0,
    monitor: Monitor = silent,
) -> WideFit:
    """Find coordinates that are regular on a whole branch of the joint range, and as orthogonal as that permits.

    Coordinates are regular where their volume v(q) is not zero: det of an orthonormal basis of the task's gradients and
    of the unit gradients of xi, all in the metric; for r = 1 it is the cosine between the gradient and the self-motion.
    The fit looks for the least

        mean max(0, 1 - v(q) / t)^2 + 0.03 mean |log(l(q) / L)|^2

    over samples of the branch that are clear of singular positions, half of them uniform and half boundary-heavy. The
    second mean keeps the lengths l of gradients near one length, so that xi is a similar motion everywhere. The fit
    descends with L-BFGS from linear coordinates across the task in the middle of the branch, first with t = 0.5. As
    long as more than 0.05 % of other samples are not regular after that, or 1 % of them have a volume below 0.28 / r,
    the worst of 50,000 fresh samples join and t = 0.3, three times at most, and no more once that makes coordinates
    worse. The best of these results is kept: regular in the middle, fewest bad positions, as far as these are more than
    0.05 %, then the largest 1 % quantile of the volume. The domain of the chart is the part of the branch where
    coordinates are regular with a margin, see `RegularPart`. It is judged in the identity metric; with another one, the
    first mean for the volume in the identity metric and t = 0.06 / r is added.

    Coordinates that are linear in the first and the last joint are best to prove and hold at any turn of them. They ask
    that self-motions turn base and tool in one sense on the whole branch, as far as the other joints do not outweigh
    that. Without `parametrisation`, if more than 0.1 % of these samples (0.4 % with r > 1) are bad before the worst
    ones join, polynomials of degree 5 in all joints are tried, too. If more than 0.6 % are bad with these, or more than
    2 % with the first ones, as on arms whose axes pass each other at a distance, it is a network,
    MLP((64, 64, 64), raw=True), but not with `like` or slides without limits: it takes several times as long to
    evaluate. The best ones are kept. Where these are not the first, a joint without limits has one turn in which
    samples lie; beyond it, positions belong to the domain as far as coordinates are regular there.

    Networks begin at random. 4,000 steps of Adam in single precision, each with 512 of the samples, lower the same two
    means with t = 0.3. If coordinates are not regular enough then, the worst 30,000 of 200,000 fresh samples join for
    4,000 more steps.

    If r joints do not move the task at all, such as the last one under a tool with an axis, they are the coordinates,
    exact everywhere, unless `parametrisation` or `like` is given. Singular positions then divide the branch once more,
    by the sign of det of the other joints' columns. The chart is on the middle's side.

    `regular_share` is of the branch: of all its positions that `branches` counts as clear, the share in the domain. If
    the chart leaves out the other side, or can only serve a smaller box, `left_out` and a BranchWarning say so.

    Wide charts hold on most of what the arm reaches without passing a singular position (`regular_share`), but their
    leaks are large, 20 to 70 degrees on the arms that were measured. They serve inverse kinematics, closed loops,
    trackers and laws with the whole inertia; see `fit` for decoupled control. That det J keeps its sign does not mean
    that phi is one-to-one.

    Args:
        robot: the robot.
        task: a task of that robot. A missing reference orientation is taken at the centre of the branch.
        branch: a branch of `orthocas.branches`, its name, or a box of your own. Default: the branch of the home; with
            none there, the largest. If its middle is not clear, the largest box around a clear position takes its
            place, see `left_out`.
        metric: as in `Problem`.
        clearance: least relative singular value of the task, > 0; see `orthocas.ClearBox`.
        parametrisation: a family that is linear in its parameters, or an MLP. Default: Polynomial(6), with one linear
            term for each joint on whose position self-motions do not depend, such as the first and the last one; or
            another one, see above.
        home: posture whose branch is meant, (n,) or its name. Default: as for `suggest_domain`.
        like: what coordinates are to be like: a function of an SX column q, the name of a joint, or "swivel", the angle
            of the elbow about the line from shoulder to wrist [rad]. With r = 1, xi then has nearly the values of that
            quantity along the self-motion of the home, or else of the branch's posture, as far as these are monotone
            there. With r > 1, several are allowed, or a task of lower priority: the gradients of the first coordinates
            are held against the parts of theirs that are orthogonal to the task. Default: with shoulder, elbow and
            wrist and r = 1, the scale and the sense of the swivel there.
        samples: number of samples. Default: 30 for each function, 5,000 to 20,000; 100,000 for a network.
        seed: seed of the samples, and of the first network.
        monitor: called with progress.

    Returns:
        The chart, the branch, and the regular share.

    Raises:
        DomainError: if no position of the branch is clear by 1.5 times `clearance`, or if coordinates are not regular
            in the middle with the sign that they have on most of the branch.
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
    chosen = _chosen(robot, task, branch, home)
    problem = _problem(robot, task, metric, chosen, bound)
    meant = like is not None
    wanted = _families(problem, meant) if parametrisation is None else (parametrisation,)
    cases = [_case(problem, family, meant) for family in wanted]
    problem, _ = cases[0]
    count = None if samples is None else require_count("samples", samples, least=2)
    posture = chosen.posture if home is None else find_home(robot, task, home).q
    meaning, quantities = None, None
    if problem.r == 1:
        meaning = Meaning.by_default(problem, posture) if like is None else Meaning.of(problem, like, posture)
    elif like is not None:
        quantities = Like.of(problem, like)
        quantities.require_at_most(problem.r)
    idle = find_idle_joints(problem, sample_problem(problem, _FIRST, (seed, _FIRST_TAG)))[-problem.r :]
    if len(idle) == problem.r and parametrisation is None and not meant:
        meaning = None
        searches: list[Search] = [IdleSearch(problem, cases[0][1], tuple(idle), seed, monitor)]
    else:
        searches = [_search(*case, count, seed, monitor, meaning, quantities) for case in cases]
    with remembered() as pressed:
        finish = partial(_finished, searches, meaning, quantities, chosen, start)
        try:
            _run(searches)
            result = finish(interrupted=pressed())
        except KeyboardInterrupt:
            if searches[0].best is None:
                raise
            result = finish(interrupted=True)
        if result.status is Status.INTERRUPTED or pressed():
            raise Interrupted(result)
    if result.left_out:
        warnings.warn(f"the chart of branch '{chosen.name}' leaves out {result.left_out}", BranchWarning, stacklevel=2)
    return result


def _case(problem: Problem, family: Parametrisation, meant: bool) -> tuple[Problem, Parametrisation]:
    """A problem and a family that suit each other."""
    require_parametrisation(family)
    family = family.for_problem(problem)
    if isinstance(family, CyclicParametrisation):
        problem = over_cyclic_joints(problem, tuple(family.cyclic))
    kind = None if family.closed_form is not None else family.family(JointSpace.of(problem), problem.r)
    if not isinstance(kind, LinearFamily | ArrayFamily):
        known = "one that is linear in its parameters, or an MLP"
        raise InvalidValueError("parametrisation", family.label, known)
    if meant and not isinstance(kind, LinearFamily):
        raise InvalidValueError("parametrisation", family.label, "one that is linear in its parameters, for like")
    return problem, family


def _search(
    problem: Problem,
    family: Parametrisation,
    samples: int | None,
    seed: int,
    monitor: Monitor,
    meaning: Meaning | None,
    quantities: Like | None,
) -> Search:
    """The search of a family."""
    if isinstance(family.family(JointSpace.of(problem), problem.r), LinearFamily):
        return BasisSearch(problem, family, samples, seed, monitor, meaning, quantities)
    return NetworkSearch(problem, family, samples, seed, monitor)


def _run(searches: Sequence[Search]) -> None:
    """Search in the first family and, as long as results are poor, in others, then go on in the best one."""
    first, *others = searches
    first.begin(_STAGE)
    missed, bad, _ = first.rank
    if missed or bad > (_POOR if first.problem.r == 1 else _POOR_SEVERAL):
        networks = [search for search in others if isinstance(search, NetworkSearch)]
        polynomials = [search for search in others if isinstance(search, BasisSearch)]
        for search in (*networks, *polynomials) if bad > _VERY_POOR else (*polynomials, *networks):
            search.begin(f"{_STAGE}, network" if search in networks else f"{_STAGE}, all joints")
            missed, bad, _ = search.rank
            if not missed and (search in networks or bad <= _STILL_POOR):
                break
    _better(searches).go_on()


def _better(searches: Sequence[Search]) -> Search:
    """The search with the best coordinates."""
    return min((search for search in searches if search.best is not None), key=lambda search: search.rank)


def _finished(
    searches: Sequence[Search],
    meaning: Meaning | None,
    quantities: Like | None,
    branch: Branch,
    start: float,
    *,
    interrupted: bool,
) -> WideFit:
    """The result of the best search, normalised and judged."""
    search = _better(searches)
    assert search.best is not None
    clear, seed = search.problem, search.seed
    centre, status = clear.domain.centre, Status.INTERRUPTED if interrupted else Status.CONVERGED
    if search.rank[0]:
        if interrupted:
            raise KeyboardInterrupt
        wrong = f"in the middle of branch '{branch.name}', coordinates fold or have another sign than on most of it"
        raise DomainError(f"{wrong}: give a smaller box as branch, another branch, or another parametrisation")
    first = sample_problem(clear, _FIRST, (seed, _FIRST_TAG))
    raw = search.coordinates(search.best)
    if meaning is not None:
        coordinates = meaning.named(raw)
    elif quantities is not None:
        coordinates = quantities.named(normalise(raw, centre, first), clear)
    else:
        coordinates = fix_gauge(normalise(raw, centre, first), centre) if len(raw.offset) else raw
    domain = RegularPart(clear.domain, coordinates, LEAST_VOLUME / clear.r)
    problem = Problem(clear.robot, clear.task, clear.metric, domain, clear.name)
    counted = sample_nonsingular(clear.robot, clear.task, branch.box, JUDGED, (seed, _COUNTED_TAG))
    share = float(domain.contains(counted).mean()) if len(counted) else float("nan")
    error = None if meaning is None else meaning.error(problem, coordinates, seed)
    worst = worst_points(problem, coordinates, seed, thorough=True)
    notes: dict[str, str | float] = {
        "solver": search.solver,
        "seed": seed,
        "samples": search.samples,
        "status": status.value,
        "branch": branch.name,
        "share of the branch": share,
        "least conditioning": worst.least,
        **({} if meaning is None or error is None else {"meaning": meaning.label, **error.notes()}),
        **({} if quantities is None else {"meaning": quantities.label}),
    }
    return WideFit(
        chart=Chart(problem, coordinates, notes),
        stages=tuple(stage.interrupted() if interrupted else stage for stage in search.stages),
        problem_check=check(problem, seed=seed),
        idle_joints=tuple(problem.robot.joint_names[k] for k in coordinates.idle),
        worst=worst,
        seconds=time.perf_counter() - start,
        branch=branch,
        regular_share=share,
        left_out=_left_out(clear, branch, counted),
        meaning=error,
        like={} if quantities is None else quantities.distances(problem, coordinates, seed),
    )


def _chosen(robot: Robot, task: Task, branch: Branch | Box | str | None, home: ArrayLike | str | None) -> Branch:
    """The branch that is meant."""
    if isinstance(branch, Branch):
        return branch
    if isinstance(branch, Box):
        return Branch("box", branch, branch.centre, float("nan"), float("nan"))
    found: Branches = branches(robot, task)
    if branch is not None:
        return found[branch]
    return found.of(find_home(robot, task, home).q) or found[0]


def _families(problem: Problem, meant: bool) -> tuple[Polynomial | MLP, ...]:
    """Polynomials that are linear in the joints on whose position the self-motions do not depend, by proof.

    Then those that are so in such slides without limits only, if there are others: a joint that turns has one turn.
    Then a network, but not for coordinates that are to mean something, nor with slides without limits.
    """
    robot = problem.robot
    free = [k for k in range(robot.n) if leaves_stay(problem, k)]
    slides = robot.tree.prismatic
    endless = [k for k in free if slides[k] and np.isinf(robot.lower[k]) and np.isinf(robot.upper[k])]
    names, fewer = (tuple(robot.joint_names[k] for k in joints) for joints in (free, endless))
    found: list[Polynomial | MLP] = [Polynomial(DEGREE, names)]
    if names != fewer:
        found.append(Polynomial(_DEGREE_OF_ALL, fewer))
    if not (meant or endless):
        found.append(_NETWORK)
    return tuple(found)


def _problem(robot: Robot, task: Task, metric: Metric | MetricSpec, branch: Branch, clearance: float) -> Problem:
    """The problem on the clear part of a branch; if its middle is not clear, of the largest box whose middle is."""
    box = branch.box
    try:
        return Problem(robot, task, metric, box, branch.name, clearance)
    except DomainError:
        points, values = sample_centres(robot, task, box)
    clear = points[values > BRANCH_RULES.of_centre * clearance]
    room = box.half_width - np.abs(clear - box.centre)
    if not len(clear):
        missing = f"no position clear by {BRANCH_RULES.of_centre * clearance:g}"
        most = f"at most {math.floor(1e3 * float(values.max()) / BRANCH_RULES.of_centre) / 1e3:g} can serve it"
        raise DomainError(f"branch '{branch.name}' has {missing}, expected one for clearance = {clearance:g}: {most}")
    best = int(np.argmax(np.log(room).sum(axis=1)))
    domain = Box(clear[best], room[best], box.unbounded)
    return Problem(robot, task, metric, domain, branch.name, clearance)


def _left_out(problem: Problem, branch: Branch, counted: Array) -> str:
    """What a problem leaves out of a branch, of which some positions (N, n) are clear; empty for nothing."""
    domain, reasons = problem.domain, []
    inside = np.asarray(Box(domain.centre, domain.half_width, domain.unbounded).contains(counted))
    if not inside.all():
        box = f"around q = ({number_list(domain.centre)}) with half-widths ({number_list(domain.half_width)})"
        reasons.append(f"its middle is not clear, so the chart has a smaller box, {box}")
    beside = beside_the_middle(problem, counted)
    if not beside.all():
        reasons.append("singular positions divide it, so the chart has one side of them")
    kept = percent(float((inside & beside).mean()))
    return f"all but {kept} of the clear positions: {'; '.join(reasons)}" if reasons else ""
