"""What the boxes of an atlas share: problem, tiles, symmetries, and what is asked for."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocas.atlas.lattice import Lattice, Symmetries, find_symmetries, identity_only, make_lattice
from orthocas.bases.cyclic import leaf_cyclic_joints, over_cyclic_joints
from orthocas.errors import InvalidValueError
from orthocas.robots.tree import require_driven
from orthocas.tasks.clear_box import row_scale
from orthocas.tasks.domains import Box, sample_uniform
from orthocas.tasks.problem import Problem, task_jacobians
from orthocas.tasks.regular_box import joint_range
from orthocas.tasks.samples import idle_joints, sample_problem
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_number, require_at_least, require_count, require_kind

_SCALE_SAMPLES, _FIRST_SAMPLES, _SEED = 2000, 200, 0
_MOST_SPLITS = 16  # addresses of boxes in files have as many bits
_MOST_TILES = 10**12


def is_turning(task: Task) -> bool:
    """Whether a task compares the tip's orientation with a reference."""
    return task.turn is not None


def local_problem(problem: Problem) -> Problem:
    """The same problem with a `LocalTask`, if its task compares orientations; the problem itself otherwise."""
    if not is_turning(problem.task):
        return problem
    task = LocalTask.from_recipe(problem.robot, problem.task.without_reference().recipe)
    return Problem(problem.robot, task, problem.metric, problem.domain, problem.name)


@dataclass(frozen=True, eq=False, repr=False)
class LocalTask(Task):
    """A task of the tip's orientation whose J_x at each q is that for the reference orientation at q itself.

    J_x(q; R) for a reference R is T J_x(q; R(q)) with an invertible T(q) less than half a turn from R. So the rows span
    the same space, and leaves do not depend on R. Singular values of J_x(q; R(q)) do not depend on a base joint that
    turns or shifts everything. The task values of a LocalTask have no meaning.
    """

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """q (n, 1) -> J_x(q; R(q)) (m, n)."""
        q = ca.SX.sym("q", self.robot.n)
        return dense_function("local_task_jacobian", [q], [self.centred_jacobian_function(q, q)])

    def with_reference_at(self, q: ArrayLike) -> Self:
        """The task itself, which has no reference."""
        return self


@dataclass(frozen=True)
class AtlasSettings:
    """What is asked of the charts of an atlas.

    Args:
        degree: degree of the polynomials.
        leak_deg: largest leak of a chart, root mean square over its box and coordinates without idle joints [deg].
        conditioning: least conditioning of a chart at samples of its box, many near faces and corners.
        least_singular_value: relative singular value of the task that charts keep away from; see `orthocas.ClearBox`.
            Rows of J_x are scaled over the whole region.
        half_width: largest half-width of boxes [rad]; prismatic joints have a quarter of it [m].
        overlap: how far a box reaches into its neighbours, as a share of its half-widths.
        splits: how often a tile may be halved.
        symmetric: fit one of several boxes that are images of each other.
        certify_seconds: processor time for the proof that a chart does not fold; 0 for no proofs. A box without a
            proof is halved while splits are left.
    """

    degree: int = 3
    leak_deg: float = 5.0
    conditioning: float = 0.3
    least_singular_value: float = 0.1
    half_width: float = 1.1
    overlap: float = 0.1
    splits: int = 14
    symmetric: bool = True
    certify_seconds: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", require_count("degree", self.degree, most=8))
        object.__setattr__(self, "splits", require_count("splits", self.splits, least=0, most=_MOST_SPLITS))
        require_kind("symmetric", self.symmetric, bool)
        for name, least, most in (
            ("leak_deg", 0.0, 90.0),
            ("conditioning", 0.0, 1.0),
            ("least_singular_value", 0.0, 1.0),
            ("half_width", 0.0, np.pi),
            ("overlap", 0.0, 1.0),
        ):
            value = as_number(name, getattr(self, name))
            if not least < value < most:
                raise InvalidValueError(name, value, f"a number between {least:g} and {most:g}")
            object.__setattr__(self, name, value)
        require_at_least("certify_seconds", self.certify_seconds, 0)
        object.__setattr__(self, "certify_seconds", as_number("certify_seconds", self.certify_seconds))


@dataclass(frozen=True, eq=False)
class Plan:
    """All that determines the boxes of an atlas and their charts."""

    problem: Problem  #: its domain is the whole region, with all positions of cyclic joints
    settings: AtlasSettings
    idle: tuple[int, ...]  #: joints that are coordinates themselves
    cyclic: tuple[int, ...]  #: joints in which coordinates are linear
    lattice: Lattice  #: of the other joints
    maps: Symmetries  #: of all joints but the idle ones
    scale: Array  #: of the rows of J_x, (m,)

    @property
    def active(self) -> tuple[int, ...]:
        """The joints that fitted coordinates depend on."""
        return tuple(i for i in range(self.problem.n) if i not in self.idle)

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints that boxes divide."""
        return tuple(i for i in self.active if i not in self.cyclic)

    @property
    def fitted(self) -> int:
        """Number of coordinates to fit."""
        return self.problem.r - len(self.idle)

    @property
    def cyclic_names(self) -> tuple[str, ...]:
        """Names of the cyclic joints."""
        return tuple(self.problem.robot.joint_names[i] for i in self.cyclic)

    def singular_values(self, points: Array) -> Array:
        """Relative singular values of the task at points (N, n), (N,)."""
        J = task_jacobians(self.local, points) / self.scale[:, None]
        squares = np.linalg.eigvalsh(J @ J.transpose(0, 2, 1))[:, 0]
        return np.asarray(np.sqrt(np.maximum(squares, 0.0)))

    @cached_property
    def local(self) -> Problem:
        """The problem with gradients that do not depend on a reference orientation."""
        return local_problem(self.problem)

    def box_around(self, low: Array, high: Array) -> Box:
        """The box of all joints with these boundaries in the joints that boxes divide, (k,) each."""
        domain = self.problem.domain
        centre, half_width = domain.centre.copy(), domain.half_width.copy()
        joints = list(self.joints)
        centre[joints], half_width[joints] = (low + high) / 2, (high - low) / 2
        unbounded = [i for i in domain.unbounded if i not in self.joints]
        return Box(centre, half_width, unbounded)


def make_plan(problem: Problem, settings: AtlasSettings, margin_deg: float) -> Plan:
    """The plan for the whole joint range of a problem's robot.

    Args:
        problem: robot, task and metric; its domain does not matter.
        settings: what is asked of the charts.
        margin_deg: distance to the joint limits [deg]; for prismatic joints it is 2 % of their range.

    Raises:
        DomainError: if a joint has no range left.
        InvalidValueError: if boxes would divide no joint, too many tiles would be needed, or a proof is asked for
            charts of an orientation task.
    """
    require_kind("problem", problem, Problem)
    require_driven("an atlas", problem.robot.tree)
    if settings.certify_seconds and is_turning(problem.task):
        raise InvalidValueError("certify_seconds", settings.certify_seconds, "0 for a task that compares orientations")
    region = joint_range(problem.robot, margin_deg)
    problem = Problem(problem.robot, problem.task, problem.metric, region, problem.name)
    names = problem.robot.joint_names
    cyclic_names = leaf_cyclic_joints(local_problem(problem))
    problem = over_cyclic_joints(problem, cyclic_names)
    local = local_problem(problem)
    idle = tuple(idle_joints(problem, sample_problem(local, _FIRST_SAMPLES, _SEED))[-problem.r :])
    cyclic = tuple(names.index(name) for name in cyclic_names)
    active = tuple(i for i in range(problem.n) if i not in idle)
    joints = tuple(i for i in active if i not in cyclic)
    if not joints or problem.r == len(idle):
        raise InvalidValueError("problem", f"one whose chart holds everywhere ({problem.name})", "one for oc.fit")
    maps = find_symmetries(local, active, cyclic) if settings.symmetric else identity_only(active)
    points = sample_uniform(problem.domain, _SCALE_SAMPLES, _SEED)
    scale = row_scale(task_jacobians(local, points), problem.task.units)
    return Plan(problem, settings, idle, cyclic, lattice_of(problem, joints, maps, settings), maps, scale)


def lattice_of(problem: Problem, joints: tuple[int, ...], maps: Symmetries, settings: AtlasSettings) -> Lattice:
    """The tiles over a problem's domain, in the joints that boxes divide.

    Args:
        problem: its domain is the whole joint range.
        joints: those that boxes divide.
        maps: symmetries, of these joints and others.
        settings: what is asked of the charts.

    Raises:
        InvalidValueError: if there are too many.
    """
    chosen, domain = list(joints), problem.domain
    low, high = (domain.centre - domain.half_width)[chosen], (domain.centre + domain.half_width)[chosen]
    prismatic = np.array(problem.robot.tree.prismatic)[chosen]
    widest = np.where(prismatic, settings.half_width / 4, settings.half_width) * 2
    endless = ~prismatic & (high - low >= 2 * np.pi - 1e-9)
    lattice = make_lattice(low, high, endless, widest, maps.of(joints))
    if lattice.counts.astype(float).prod() > _MOST_TILES:
        raise InvalidValueError("half_width", settings.half_width, "a larger number: there would be too many tiles")
    return lattice
