"""The part of a box that stays away from near-singular positions of a task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self, cast

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocas.errors import DomainError, InvalidValueError, OrthocasError, SingularTaskError
from orthocas.robots.robot import Robot
from orthocas.tasks.domains import Box, Domain, StopKind, Wall, register_domain, require_within_limits
from orthocas.tasks.regular_box import regular_box
from orthocas.tasks.samples import compute_row_scale, sample_evenly, sample_uniform
from orthocas.tasks.task import Task
from orthocas.tools.batch import dense_function
from orthocas.tools.cached import cached_property
from orthocas.tools.checks import Array, as_number, as_point_set, freeze_array, require_kind, require_known
from orthocas.tools.columns import BlockedFunction
from orthocas.tools.json import get_part

CLEAR_BOX = "clear box"  #: name of the kind
ROWS = ("frame", "x")  #: Jacobians whose rows may define the singular values


@dataclass(frozen=True, slots=True)
class ClearBoxRules:
    """Sample sizes of a `ClearBox`."""

    samples: int = 256  #: of the box, to find the scale of the rows
    fraction_samples: int = 20_000  #: of the box, to find the clear fraction
    default_samples: int = 4096  #: of the default box, to find near-singular positions
    #: relative singular value below which a position is near-singular: charts of the whole box would fold there
    near: float = 0.03
    #: bound of a default domain with near-singular positions, relative to the value at the centre ...
    centre_share: float = 0.6
    largest_bound: float = 0.2  #: ... and the largest such bound
    seed: int = 0


RULES = ClearBoxRules()


@register_domain
@dataclass(frozen=True, eq=False, init=False, kw_only=True)
class ClearBox(Box):
    """All q of a box at which the relative singular value of a task is above a bound (ours).

    The relative singular value s(q) is the smallest singular value of D^-1 J(q), without units. For orientation, pose
    and axis tasks, J is the frame Jacobian: velocity and angular velocity of the tip in its own axes. So s(q) depends
    on the robot only, and not on a reference orientation. For other tasks, J is J_x. D is diagonal: it divides rows
    with the same unit by their root mean square length over the box. So s = 1 is as regular as usual for the task, and
    s = 0 is singular. A prismatic joint's 1 m counts like 1 rad. s(q) > bound holds exactly where D^-1 J J^T D^-1 -
    bound^2 I is positive definite, so checks test the signs of its m elimination pivots.

    Half a turn away from the reference, x itself ends and J_x loses rank, although the robot may be in a clear
    position. Laws for tasks of one axis report SINGULAR close to it. With rows="x" the domain keeps away from it.

    `Problem(..., least_singular_value=bound)` builds it.

    Args:
        box: the boundaries.
        task: the task.
        least_singular_value: the bound, > 0.
        scale: the diagonal of D, (m,) > 0, in m and rad per rad. Default: from 256 samples of the box.
        rows: "frame" for the rows J above; "x" for J_x of every task, which also excludes positions near half a turn
            from the reference. Older chart files use "x".
        home: a clear position of the box, (n,), where motions and references start. Default: the centre.

    Raises:
        DomainError: if the home lies outside the box or is not clear.
        UnknownNameError: for other rows.

    Example:
        >>> import orthocas as oc
        >>> robot = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
        >>> clear = oc.ClearBox(oc.Box([0.6, 0.8, 0.8], 0.8), oc.Task.position(robot, "xy"), 0.1)
        >>> clear.contains([[0.6, 0.8, 0.8], [0.6, 0.05, 0.05]]).tolist()  # the arm is bent, and nearly straight
        [True, False]
    """

    name: str = CLEAR_BOX
    is_box = False
    task: Task
    least_singular_value: float
    scale: Array
    rows: str
    posture: Array | None  #: the home; None: the centre

    def __init__(
        self,
        box: Box,
        task: Task,
        least_singular_value: float,
        scale: ArrayLike | None = None,
        rows: str = "frame",
        home: ArrayLike | None = None,
    ) -> None:
        require_kind("box", box, Box)
        require_kind("task", task, Task)
        require_known("rows", rows, ROWS)
        super().__init__(box.centre, box.half_width, box.unbounded)
        posture = None if home is None else freeze_array("home", home, self.centre.shape)
        object.__setattr__(self, "posture", posture)
        task = task.with_reference_at(self.home)
        object.__setattr__(self, "task", task)
        object.__setattr__(self, "rows", rows)
        # By default the scale comes from the finite rows at samples of the box.
        if scale is None:
            J = self._evaluate_jacobians(sample_uniform(Box(self.centre, self.half_width), RULES.samples, RULES.seed))
            finite = np.isfinite(J).all(axis=(1, 2))
            if not finite.any():
                raise SingularTaskError(
                    f"the Jacobian of task '{task.name}' is not finite at any of {RULES.samples} samples"
                )
            scale = compute_row_scale(J[finite], task.units)
        sizes = freeze_array("scale", scale, (task.m,))
        bound = as_number("least_singular_value", least_singular_value)
        for name, value in (("least_singular_value", bound), ("scale", sizes.min())):
            if not 0 < value < np.inf:
                raise InvalidValueError(name, value, "positive and finite")
        for field, value in (("least_singular_value", bound), ("scale", sizes)):
            object.__setattr__(self, field, value)
        if not Box.contains(self, self.home):
            raise DomainError("the home of the domain lies outside its box")
        if not self.is_clear(self.home[None])[0]:
            name = "centre" if posture is None else "home"
            raise DomainError(f"the {name} of the domain {self._describe_value(self.home)}")

    @property
    def home(self) -> Array:
        """A clear position of the box, (n,)."""
        return self.centre if self.posture is None else self.posture

    @property
    def heading(self) -> str:
        """The condition in one line, with the scale of the rows."""
        rows = "J_x" if self.jacobian_function is self.task.jacobian_function else "the frame Jacobian"
        # For example '0.41 m, 1.53 rad'; one number per row if units are unknown or a unit has several scales.
        sizes = [f"{size:.3g} {unit}".strip() for size, unit in zip(self.scale, self.task.units, strict=True)]
        lengths = ", ".join(dict.fromkeys(sizes) if all(self.task.units) else sizes)
        bound = f"relative singular value of the task above {self.least_singular_value:g}"
        return f"{bound} (rows of {rows} over {lengths})"

    @property
    def condition(self) -> Self:
        """The domain itself, which is its own condition."""
        return self

    @property
    def singular_bound(self) -> Self:
        """The domain itself, which bounds singular values."""
        return self

    @property
    def walls(self) -> tuple[Wall, ...]:
        """s(q) - bound."""
        room = lambda q: float(self.singular_values(q)) - self.least_singular_value  # noqa: E731
        return (Wall(StopKind.NEAR_SINGULAR, room, self.singular_values, self.heading),)

    def describe_condition(self) -> dict[str, str]:
        """The condition in one line."""
        return {"clear": self.heading}

    def report_condition(self) -> dict[str, Any]:
        """Bound, rows and their scale, and the clear fraction of the box."""
        return {
            "least_singular_value": self.least_singular_value,
            "judged_rows": self.rows,
            "row_scale": self.scale.tolist(),
            "clear_share": self.share,
        }

    def to_data(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """The bound and the kind of rows. Files without a kind are older and mean "x", so "x" is not written."""
        of_x = self.jacobian_function is self.task.jacobian_function
        rows = {} if of_x else {"judged_rows": self.rows}
        home = {} if self.posture is None else {"home": self.posture}
        data = {**super().to_data()[0], "least_singular_value": self.least_singular_value, **rows}
        return data, {"row_scale": self.scale, **home}

    @classmethod
    def from_data(cls, task: Task, data: Mapping[str, Any], arrays: Mapping[str, Any]) -> Domain:
        """Rebuild the domain from a file. The box is checked before the task is evaluated there."""
        box = Box.from_data(task, data, arrays)
        require_kind("box", box, Box)
        require_within_limits(task.robot, box)
        rows = get_part(data, "judged_rows", str) if "judged_rows" in data else "frame" if task.turn is None else "x"
        bound = get_part(data, "least_singular_value", float)
        home = get_part(arrays, "home", np.ndarray) if "home" in arrays else None
        return cls(cast("Box", box), task, bound, get_part(arrays, "row_scale", np.ndarray), rows, home)

    @property
    def jacobian_function(self) -> ca.Function:
        """q (n, 1) -> J (m, n), the rows whose singular values are bounded."""
        return self.task.jacobian_function if self.rows == "x" else self.task.frame_jacobian_function

    def explain(self, q: Array) -> str:
        """Say why a position (n,) is not clear."""
        return f"the task {self._describe_value(q)}"

    def _describe_value(self, q: Array) -> str:
        bound = f"expected one above least_singular_value = {self.least_singular_value:g}"
        return f"has a relative singular value of {self.singular_values(q):.3g}, {bound}"

    def apply_to(self, box: Box) -> ClearBox:
        """The same condition on another box. The home is kept if it lies in that box."""
        kept = self.posture if self.posture is not None and Box.contains(box, self.posture) else None
        return ClearBox(box, self.task, self.least_singular_value, self.scale, self.rows, kept)

    def contains(self, q: ArrayLike) -> Any:
        """Whether points (n,) or (N, n) lie in the box and are clear of singular positions: a bool, or (N,)."""
        points, single = as_point_set("q", q, len(self.centre))
        inside = np.asarray((np.abs(points - self.centre) <= self.reach).all(axis=1))
        if inside.any():
            inside[inside] = self.is_clear(points[inside])
        return inside[0] if single else inside

    def is_clear(self, points: Array) -> NDArray[np.bool_]:
        """Whether s(q) > bound at points (N, n), (N,); points may lie outside the box."""
        return np.asarray((self._batched_pivots(points)[0] > 0).all(axis=1))

    def singular_values(self, q: ArrayLike) -> Any:
        """s(q) at points (n,) or (N, n): a number, or (N,); NaN where the task has no finite Jacobian."""
        points, single = as_point_set("q", q, len(self.centre))
        J = self._evaluate_jacobians(points) / self.scale[:, None]
        finite = np.isfinite(J).all(axis=(1, 2))
        values = np.full(len(points), np.nan)
        values[finite] = np.linalg.svd(J[finite], compute_uv=False)[:, -1]
        return values[0] if single else values

    @cached_property
    def share(self) -> float:
        """Fraction of the box that is clear, from 20,000 samples."""
        points = sample_evenly(Box(self.centre, self.half_width), RULES.fraction_samples, RULES.seed)
        return float(self.is_clear(points).mean())

    @cached_property
    def gram(self) -> ca.Function:
        """q (n, 1) -> D^-1 J J^T D^-1 (m, m), whose smallest eigenvalue is s(q)^2."""
        q = ca.SX.sym("q", len(self.centre))
        J = self.jacobian_function(q) / ca.repmat(ca.DM(self.scale), 1, len(self.centre))
        return dense_function("gram", [q], [J @ J.T])

    @cached_property
    def pivots(self) -> ca.Function:
        """q (n, 1) -> pivots (m, 1) of D^-1 J J^T D^-1 - bound^2 I; q is clear exactly if all of them are positive."""
        q = ca.SX.sym("q", len(self.centre))

        # Multiply, because ** raises OverflowError for bounds in damaged files.
        square = self.least_singular_value * self.least_singular_value
        left = self.gram(q) - square * ca.SX.eye(self.task.m)
        # Pivots of Gaussian elimination without exchanges.
        pivots = []
        for _ in range(self.task.m):
            pivots.append(left[0, 0])
            left = left[1:, 1:] - left[1:, 0] @ left[0, 1:] / left[0, 0]
        return dense_function("pivots", [q], [ca.vertcat(*pivots)])

    @cached_property
    def _batched_pivots(self) -> BlockedFunction:
        return BlockedFunction(self.pivots)

    def _evaluate_jacobians(self, points: Array) -> Array:
        """J at points (N, n), (N, m, n)."""
        batched = self.task.batched_jacobian if self.rows == "x" else self.task.batched_frame_jacobian
        J: Array = batched(points)[0].reshape(len(points), self.task.m, len(self.centre))
        return J


def default_domain(robot: Robot, task: Task) -> Box:
    """The default domain of a problem: `regular_box`, or its clear part if it contains near-singular positions.

    Coordinates of the whole box would fold there. The bound is 60 % of the relative singular value at the centre, and
    at most 0.2.

    Args:
        robot: the robot.
        task: a task of that robot. A missing reference is taken at the centre of the box.

    Raises:
        NotRedundantError: if the task has as many components as the robot has joints.
    """
    box = regular_box(robot, task)
    try:
        measured = ClearBox(box, task, np.finfo(float).tiny)
        values = measured.singular_values(sample_evenly(box, RULES.default_samples, RULES.seed))
        if np.nanmin(values) >= RULES.near:
            return box
        bound = min(RULES.largest_bound, RULES.centre_share * measured.singular_values(box.centre))
        return ClearBox(box, task, round(bound, 2), measured.scale)
    # The task is singular at the centre or everywhere; `check` reports this.
    except OrthocasError:
        return box


def exclude_singular(domain: Domain, task: Task, least_singular_value: float | None) -> Domain:
    """The part of a domain where a task is clear of singular positions: a ClearBox of this task, if a bound is given.

    Raises:
        InvalidValueError: for a bound with a torus.
        DomainError: if the centre is not clear.
    """
    if least_singular_value is not None:
        if not isinstance(domain, Box) or not (domain.is_box or domain.singular_bound):
            raise InvalidValueError(
                "least_singular_value",
                least_singular_value,
                f"no bound, because the domain is a {domain.name}: use a Box",
            )
        return ClearBox(domain, task, least_singular_value)
    if isinstance(domain, ClearBox) and domain.task is not task:
        return ClearBox(domain, task, domain.least_singular_value, rows=domain.rows, home=domain.posture)
    return domain
