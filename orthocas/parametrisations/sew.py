"""The shoulder-elbow-wrist angle as a coordinate: the common choice for 7-joint arms with a pose task."""

from dataclasses import dataclass
from typing import ClassVar

from orthocas.checks import require_known
from orthocas.errors import InvalidValueError
from orthocas.parametrisations.family import ClosedForm, JointSpace
from orthocas.parametrisations.given import Given, GivenFamily
from orthocas.parametrisations.shoulder_elbow_wrist import SEW_KINDS, sew_angle
from orthocas.problem import Problem


@dataclass(frozen=True)
class SEW:
    """xi(q) = psi(q), the rotation of the elbow about the line from shoulder to wrist [EW2024].

    It is a baseline: it describes the self-motion well, but its gradient is not orthogonal to that of the task.

    Args:
        kind: "conventional" or "stereographic"; see `orthocas.parametrisations.shoulder_elbow_wrist.sew_angle`.
    """

    kind: str = "stereographic"
    linear: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_known("SEW angle", self.kind, SEW_KINDS)

    @property
    def label(self) -> str:
        """'sew:KIND'."""
        return f"sew:{self.kind}"

    def for_problem(self, problem: Problem) -> Given:
        """The angle of the problem's arm.

        Raises:
            InvalidValueError: if the degree of redundancy is not 1.
            RobotError: if the arm has no shoulder, elbow and wrist.
        """
        if problem.r != 1:
            raise InvalidValueError("r", problem.r, "1 for one SEW angle: use a pose task and a 7-joint arm")
        return Given.from_function(self.label, problem.n, sew_angle(problem.robot, self.kind))

    def closed_form(self, problem: Problem) -> ClosedForm:
        """There are no parameters."""
        return self.for_problem(problem).closed_form(problem)

    def family(self, space: JointSpace, outputs: int) -> GivenFamily:
        """Not available: call `for_problem` first.

        Raises:
            InvalidValueError: always, because the angle depends on the robot.
        """
        raise InvalidValueError("parametrisation", self.label, "the angle of a robot: for_problem(problem)")
