"""Display of an object's facts as lines of text and as an HTML table."""

import html
import math
import textwrap
from collections.abc import Iterable, Mapping
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import TYPE_CHECKING, Any

# Characters per line.
_WIDTH = 100
# Largest number of lines, with the heading.
_LINES = 9


class Shown:
    """An object that displays its facts when printed, and in notebooks. The first fact is the heading.

    Dataclasses that derive from it need `repr=False`.
    """

    def facts(self) -> dict[str, str]:
        """Facts about the object by name, the most important first."""
        raise NotImplementedError

    @property
    def heading(self) -> str:
        """One line that describes the object."""
        return next(iter(self.facts().values()))

    # Otherwise type checkers would accept every name.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raise AttributeError, with a hint for names that people often guess."""
            owners = [kind.__name__ for kind in type(self).__mro__ if name in GUESSES.get(kind.__name__, ())]
            raise AttributeError(explain_missing((owners or [type(self).__name__])[0], name), name=name, obj=self)

    def __repr__(self) -> str:
        return as_text(type(self).__name__, self.facts())

    def _repr_html_(self) -> str:
        return as_html(type(self).__name__, self.facts())


def as_text(title: str, facts: Mapping[str, str]) -> str:
    """Title and heading in the first line, then one fact per line: at most 9 lines of 100 characters."""
    (_, heading), *others = facts.items()
    width = max((len(name) for name, _ in others), default=0) + 2
    lines = [f"{title}: {heading}", *(f"  {name:<{width}}{value}" for name, value in others[: _LINES - 1])]
    # Remove control characters, and cut lines between words if possible.
    for k, line in enumerate(lines):
        indent = line[: len(line) - len(line.lstrip())]
        words = "".join(letter if letter.isprintable() else " " for letter in line.strip())
        if len(words) > _WIDTH:
            words = f"{textwrap.shorten(words, _WIDTH - 4, placeholder='') or words[: _WIDTH - 4]} ..."
        lines[k] = indent + words
    return "\n".join(lines)


def as_html(title: str, facts: Mapping[str, str]) -> str:
    """A table with a caption. Names and values are escaped, so they are shown as text."""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
        f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
        for name, value in facts.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{rows}</table>"


def percent(share: float, digits: int = 1, *, fault: bool = False) -> str:
    """A fraction in percent, rounded down: 0.99999 is '99.9%', and only 1 is '100.0%'.

    Fractions of faults, such as folded samples, are rounded up, so that rounding never improves a result. NaN is
    'unknown'.

    Args:
        share: a fraction from 0 to 1.
        digits: digits after the decimal point.
        fault: whether smaller is better.
    """
    if math.isnan(share):
        return "unknown"
    step = Decimal(1).scaleb(-digits)
    return f"{(100 * Decimal(repr(float(share)))).quantize(step, ROUND_CEILING if fault else ROUND_FLOOR)}%"


def listed(words: Iterable[str], most: int = 10) -> str:
    """Join at most `most` words with commas, and state how many more there are."""
    known = list(words)
    more = f", and {len(known) - most} more" if len(known) > most else ""
    return ", ".join(known[:most]) + more


def number_list(values: Iterable[float]) -> str:
    """Join numbers with four digits like `listed`. If all numbers are equal, one is shown."""
    known = [f"{value:.4g}" for value in values]
    return known[0] if len(set(known)) == 1 else listed(known)


_SOLVE = "chart.solve(x=..., xi=...), or chart.nearest_xi(q, x), with a chart of oc.load or oc.fit_wide"
_VIEW = "oc.view(chart)"
_POSE = "robot.pose(q, frame), or chart.x(q) for the task"
_LAW = "law.function(q, dq, phi, dphi, ddphi, *gains), and gains of law.gains.values()"
_GENERATE = "oc.generate_c(chart, folder, law)"

#: class, or "orthocas" for the package -> hint -> names that people often guess
_NAMES: Mapping[str, Mapping[str, str]] = {
    "orthocas": {
        _SOLVE: "solve solve_ik inverse_kinematics ik Solver IK",
        "oc.Robot.from_file(path)": "load_robot",
        "oc.Robot.from_urdf(path)": "load_urdf Manipulator RobotWrapper buildModelFromUrdf",
        "oc.load(path or name)": "load_chart",
        "oc.Robot": "Model",
        "oc.Task.pose(robot)": "FrameTask",
        "a 4 x 4 matrix, pinocchio.SE3, or (position, quaternion)": "SE3",
        "oc.control.PDPlus(chart)": "PDPlus",
        "oc.control.Impedance(chart)": "Impedance",
        "oc.control.Safety.of(law)": "Safety",
        "chart.tracker(q)": "Tracker",
        _VIEW: "Viewer visualize show animate",
        "chart.plot()": "plot",
        _GENERATE: "codegen_c export_c",
        "oc.Robot.from_name(name)": "load_robot_description models",
        "postures are arrays: oc.Robot.from_urdf(path), robot.pose(q, frame)": "Configuration",
        "chart.nearest_xi(q, x), or chart.tracker(q, nearest=True)": "PostureTask",
        "oc.Task.centre_of_mass(robot)": "ComTask",
        "oc.Task.relative_pose(robot)": "RelativeFrameTask",
        "oc.control.XiTask(chart)": "NullspaceTask DampingTask",
        "limits are those of the robot file: robot.lower and robot.upper": "limits",
        "robot.collisions, and chart.tracker(q, collisions=..., margin=...)": "barriers",
        "q + dq dt: joint positions are plain numbers": "integrate",
        "chart.self_motion(q)": "self_motion null_space",
        "chart.xi_range(q)": "xi_range",
        "chart.save(path)": "save",
        "oc.obstacles, in oc.Scene({name: solid})": "Obstacle Sphere Capsule",
        "oc.Box(centre, half_width)": "Polytope",
        "oc.simulate(law, reference, q) returns one, and oc.follow(chart, path) makes a path of joints": "Trajectory",
    },
    "Robot": {
        _POSE: "fk fkine forward_kinematics forwardKinematics framePlacement forward frame_pose frame_placement "
        "get_transform get_transform_frame_to_world oMf",
        _SOLVE: "ik ikine inverse_kinematics ikine_LM ik_LM ik_GN ikine_a solve solve_ik",
        "robot.jacobian(q, frame)": "jacob0 frame_jacobians computeJointJacobians get_frame_jacobian",
        "robot.n": "dof nq nv",
        "robot.lower and robot.upper": "qlim joint_limits limits",
        "robot.mass_matrix(q)": "crba inertia M",
        "robot.inverse_dynamics(q, dq, ddq)": "rnea",
        "robot.forward_dynamics(q, dq, tau)": "aba",
        "robot.bias(q, dq)": "nle",
        "robot.bias(q, dq), or robot.coriolis_product(q, v, w)": "coriolis",
        "robot.sample(count, seed)": "random random_configuration random_q",
        "robot.home(name)": "neutral q0",
        "robot.frame_names": "frames links link_names",
        "robot.joint_names": "joints",
        "chart.manipulability(q)": "manipulability",
        "robot.centre_of_mass(q)": "com",
        "robot.pose(q), with q of CasADi for expressions": "ets",
        "robot.jacobian(q, frame), in axes of the world": "jacobe",
        "chart.manipulability_gradient(q)": "jacobm",
        "ca.jacobian of robot.jacobian(q) with q of CasADi": "hessian0",
        "robot.gravity(q)": "gravload",
        "robot.mass_matrix(q) and robot.jacobian(q)": "inertia_x",
        "robot.tips": "ee_links ee_frame tip tip_name end_effector",
        "oc.Robot.from_urdf(path, base=...)": "base",
        "robot.with_tool(tool)": "tool",
        "robot.with_payload(payload)": "payload",
        "robot.homes": "qr qz",
        "robot.velocity_limits": "qd_limits vellim velocity_limit",
        "robot.effort_limits": "torque_limits",
        "oc.view(robot)": "teach plot show view display",
        "q + dq dt: joint positions are plain numbers": "integrate",
        "q1 - q0: joint positions are plain numbers": "difference",
        "dq @ robot.mass_matrix(q) @ dq / 2": "kinetic_energy",
        "robot.centre_of_mass(q) and the mass": "potential_energy",
        "robot.tree": "data model",
        "robot.heading": "name",
        "robot.collisions.check_free(q)": "self_collision in_collision collision_free",
        "robot.collisions.distance(q)": "distance",
    },
    "Chart": {
        "chart.x(q), or chart.phi(q) with xi": "fk",
        "chart.phi(q)": "forward",
        _SOLVE: "ik inverse_kinematics solve_ik",
        "oc.follow(chart, path)": "follow interpolate path plan",
        "oc.evaluate(chart)": "evaluate report",
        "oc.certify(chart)": "certify",
        _VIEW: "view show",
        "oc.simulate(law, ...) with a law of oc.control on the chart": "simulate",
        _GENERATE: "generate_c codegen to_c",
        "oc.export(chart, path)": "export",
        "chart.self_motion(q)": "null_space nullspace",
        "chart.xi_range(q)": "range xi_limits",
        "chart.xi_range(q), or chart.domain.bounds": "limits",
        "chart.domain.sample(count, seed)": "sample",
        "chart.nearest_xi(q, x)": "nearest closest solve_nearest",
        "chart.tracker(q)": "track",
        "chart.problem.metric": "metric",
        "chart.jacobian(q)": "J jac",
        "chart.jacobian(q): the task's rows come first, then those of xi": "jacobian_xi gradient",
        "chart.robot.pose(q), or chart.x(q) for the task": "pose",
        "chart.jacobian(q) @ dq": "velocity dxi rates",
        "chart.solutions(phi), or oc.Arm for all branches": "ik_all solve_all all_solutions",
        "chart.jacobian(q): the columns of its inverse": "nullspace_basis null_space_basis",
        "oc.control.XiTask(chart), or chart.jacobian(q)": "null_space_projector projector",
        "chart.r": "redundancy",
        "chart.xi(q)": "redundancy_parameter elbow swivel psi arm_angle",
        "chart.domain.bounds": "bounds",
        "chart.labels": "names",
        "chart.n": "dof",
        "chart.function(name)": "to_casadi casadi",
        "oc.export(chart, 'torch', path)": "to_torch",
        "oc.export(chart, 'jax', path)": "to_jax",
        "chart.tracker(q), whose step(phi) it is": "step",
        "oc.control.PDPlus(chart)": "controller",
        "print(chart)": "info summary",
        "chart.domain.contains(q)": "is_valid contains inside",
        "oc.Arm, whose charts cover all branches": "branch branches",
    },
    "LawOfChart": {
        _LAW: "step torque compute update command_at call",
        "oc.simulate(law, reference, q)": "simulate",
        _GENERATE: "codegen generate_c",
    },
}
#: class -> name -> hint
GUESSES = {
    owner: {name: use for use, names in answers.items() for name in names.split()} for owner, answers in _NAMES.items()
}


def explain_missing(owner: str, name: str) -> str:
    """The message of an AttributeError: the missing name, and the right one if it is known."""
    what = "module 'orthocas'" if owner == "orthocas" else f"'{owner}' object"
    instead = GUESSES.get(owner, {}).get(name)
    return f"{what} has no attribute '{name}'" + (f": use {instead}" if instead else "")
