"""The gradients of orientation tasks without a reference orientation, which their leaves do not depend on (ours)."""

from dataclasses import dataclass
from typing import Self

import casadi as ca
from numpy.typing import ArrayLike

from orthocas.casadi_tools.batch import dense_function
from orthocas.casadi_tools.cached import cached_property
from orthocas.problem import Problem
from orthocas.tasks import Task


def is_turning(task: Task) -> bool:
    """Whether a task compares the tip's orientation with a reference."""
    return task.turn is not None


def local_problem(problem: Problem) -> Problem:
    """The same problem with a `LocalTask`, if its task compares orientations; the problem itself otherwise."""
    if not is_turning(problem.task):
        return problem
    task = LocalTask.named(problem.robot, problem.task.recipe["kind"])
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
