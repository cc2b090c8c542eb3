"""What the projectors share: a task, and a second task in its null space."""

from abc import ABC, abstractmethod

import casadi as ca

from orthocas.casadi_tools.cached import cached_property
from orthocas.chart import Chart
from orthocas.checks import Array
from orthocas.control.reference import Reference
from orthocas.control.second_task import SecondTask
from orthocas.control.second_tasks import second_task
from orthocas.problem import Problem
from orthocas.showing import Shown
from orthocas.tasks import Task


class TwoTaskLaw(Shown, ABC):
    """A law for the task x of a problem, and a second task x_2 in its null space."""

    problem: Problem
    second: Task | Chart | None  #: default: the joints

    def remarks(self) -> list[str]:
        """No warnings."""
        return []

    @property
    def chart(self) -> Chart | None:
        """The chart of the second task, if it is one."""
        return self._second.chart

    @property
    def labels(self) -> tuple[str, ...]:
        """Task labels, then those of the second task."""
        return self._second.labels

    @property
    def measured(self) -> ca.Function:
        """[h(q); x_2(q)]."""
        return self._second.measured

    @cached_property
    def function(self) -> ca.Function:
        """q, dq (n, 1), reference and its derivatives (m + k_2, 1), gains -> command (n, 1), status (1, 1)."""
        return self._second.runnable(self.graph)

    @cached_property
    @abstractmethod
    def graph(self) -> ca.Function:
        """The same function as a graph with shared subexpressions; C is generated from it."""

    def require_reachable(self, reference: Reference, q_start: Array) -> None:
        """Raise UnreachableReferenceError if the reference leaves the joint limits (joints) or the domain (xi).

        Nothing is checked for a second task of your own.
        """
        self._second.require_reachable(reference, q_start)

    @cached_property
    def _second(self) -> SecondTask:
        return second_task(self.problem, self.second)
