"""Facts about an object by name, as lines of text and as an HTML table."""

import html
import math
import textwrap
from collections.abc import Iterable, Mapping
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from typing import TYPE_CHECKING, Any

_WIDTH = 100  # characters per line
_LINES = 9  # at most, including the heading


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

    if not TYPE_CHECKING:  # type checkers would take every name for known

        def __getattr__(self, name: str) -> Any:
            """Say what to use where a name is one that people try first."""
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
    # Without control characters, and cut to the width between two words, where there are any.
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
    """A share in percent, rounded down: 0.99999 is '99.9%', and only 1 is '100.0%'.

    Shares of faults, such as folded samples, are rounded up, so that neither reads better than it is. NaN is 'unknown'.

    Args:
        share: a number, 1 for all.
        digits: after the decimal point.
        fault: whether a smaller share would be better.
    """
    if math.isnan(share):
        return "unknown"
    step = Decimal(1).scaleb(-digits)
    return f"{(100 * Decimal(repr(float(share)))).quantize(step, ROUND_CEILING if fault else ROUND_FLOOR)}%"


def listed(words: Iterable[str], most: int = 10) -> str:
    """Join words with commas, and say how many more there are."""
    known = list(words)
    more = f", and {len(known) - most} more" if len(known) > most else ""
    return ", ".join(known[:most]) + more


def number_list(values: Iterable[float]) -> str:
    """Join numbers of four digits like `listed`. Equal numbers are shown once."""
    known = [f"{value:.4g}" for value in values]
    return known[0] if len(set(known)) == 1 else listed(known)


_SOLVE = "chart.solve(x=..., xi=...), or chart.nearest_xi(q, x), with a chart of oc.load or oc.fit_wide"
_POSE = "robot.pose(q, frame), or chart.x(q) for the task"
_MASS = "robot.mass_matrix(q)"
_SAMPLE = "robot.sample(count, seed)"
_VIEW = "oc.view(chart)"
_GENERATE = "oc.generate_c(chart, folder, law)"
_SHAPES = "oc.obstacles, in oc.Scene({name: solid})"
_LAW = "law.function(q, dq, phi, dphi, ddphi, *gains), and gains of law.gains.values()"
_LIMITS = "robot.lower and robot.upper"

#: by class, or "orthocas" for the package: the name, and what to use
GUESSES: Mapping[str, Mapping[str, str]] = {
    "orthocas": {
        "solve": _SOLVE,
        "solve_ik": _SOLVE,
        "inverse_kinematics": _SOLVE,
        "ik": _SOLVE,
        "load_robot": "oc.Robot.from_file(path)",
        "load_urdf": "oc.Robot.from_urdf(path)",
        "load_chart": "oc.load(path or name)",
        "Model": "oc.Robot",
        "FrameTask": "oc.Task.pose(robot)",
        "SE3": "a 4 x 4 matrix, pinocchio.SE3, or (position, quaternion)",
        "PDPlus": "oc.control.PDPlus(chart)",
        "Impedance": "oc.control.Impedance(chart)",
        "Safety": "oc.control.Safety.of(law)",
        "Tracker": "chart.tracker(q)",
        "Viewer": _VIEW,
        "visualize": _VIEW,
        "show": _VIEW,
        "plot": "chart.plot()",
        "codegen_c": _GENERATE,
        "export_c": _GENERATE,
        "load_robot_description": "oc.Robot.from_name(name)",
        "models": "oc.Robot.from_name(name)",
        "Manipulator": "oc.Robot.from_urdf(path)",
        "RobotWrapper": "oc.Robot.from_urdf(path)",
        "buildModelFromUrdf": "oc.Robot.from_urdf(path)",
        "Configuration": "postures are arrays: oc.Robot.from_urdf(path), robot.pose(q, frame)",
        "Solver": _SOLVE,
        "IK": _SOLVE,
        "PostureTask": "chart.nearest_xi(q, x), or chart.tracker(q, nearest=True)",
        "ComTask": "oc.Task.centre_of_mass(robot)",
        "RelativeFrameTask": "oc.Task.relative_pose(robot)",
        "NullspaceTask": "oc.control.XiTask(chart)",
        "DampingTask": "oc.control.XiTask(chart)",
        "limits": "limits are those of the robot file: robot.lower and robot.upper",
        "barriers": "robot.collisions, and chart.tracker(q, collisions=..., margin=...)",
        "integrate": "q + dq dt: joint positions are plain numbers",
        "self_motion": "chart.self_motion(q)",
        "xi_range": "chart.xi_range(q)",
        "animate": _VIEW,
        "save": "chart.save(path)",
        "Obstacle": _SHAPES,
        "Sphere": _SHAPES,
        "Capsule": _SHAPES,
        "Polytope": "oc.Box(centre, half_width)",
        "Trajectory": "oc.simulate(law, reference, q) returns one, and oc.follow(chart, path) makes a path of joints",
        "null_space": "chart.self_motion(q)",
    },
    "Robot": {
        "fk": _POSE,
        "fkine": _POSE,
        "forward_kinematics": _POSE,
        "forwardKinematics": _POSE,
        "framePlacement": _POSE,
        "ik": _SOLVE,
        "ikine": _SOLVE,
        "inverse_kinematics": _SOLVE,
        "jacob0": "robot.jacobian(q, frame)",
        "frame_jacobians": "robot.jacobian(q, frame)",
        "dof": "robot.n",
        "nq": "robot.n",
        "nv": "robot.n",
        "qlim": _LIMITS,
        "joint_limits": _LIMITS,
        "limits": _LIMITS,
        "crba": _MASS,
        "inertia": _MASS,
        "M": _MASS,
        "rnea": "robot.inverse_dynamics(q, dq, ddq)",
        "aba": "robot.forward_dynamics(q, dq, tau)",
        "nle": "robot.bias(q, dq)",
        "coriolis": "robot.bias(q, dq), or robot.coriolis_product(q, v, w)",
        "random": _SAMPLE,
        "random_configuration": _SAMPLE,
        "random_q": _SAMPLE,
        "neutral": "robot.home(name)",
        "q0": "robot.home(name)",
        "frames": "robot.frame_names",
        "joints": "robot.joint_names",
        "manipulability": "chart.manipulability(q)",
        "com": "robot.centre_of_mass(q)",
        "forward": _POSE,
        "frame_pose": _POSE,
        "frame_placement": _POSE,
        "get_transform": _POSE,
        "get_transform_frame_to_world": _POSE,
        "oMf": _POSE,
        "ets": "robot.pose(q), with q of CasADi for expressions",
        "jacobe": "robot.jacobian(q, frame), in axes of the world",
        "jacobm": "chart.manipulability_gradient(q)",
        "hessian0": "ca.jacobian of robot.jacobian(q) with q of CasADi",
        "computeJointJacobians": "robot.jacobian(q, frame)",
        "get_frame_jacobian": "robot.jacobian(q, frame)",
        **dict.fromkeys(("ikine_LM", "ik_LM", "ik_GN", "ikine_a", "solve", "solve_ik"), _SOLVE),
        "gravload": "robot.gravity(q)",
        "inertia_x": "robot.mass_matrix(q) and robot.jacobian(q)",
        "links": "robot.frame_names",
        "link_names": "robot.frame_names",
        **dict.fromkeys(("ee_links", "ee_frame", "tip", "tip_name", "end_effector"), "robot.tips"),
        "base": "oc.Robot.from_urdf(path, base=...)",
        "tool": "robot.with_tool(tool)",
        "payload": "robot.with_payload(payload)",
        "qr": "robot.homes",
        "qz": "robot.homes",
        "qd_limits": "robot.velocity_limits",
        "vellim": "robot.velocity_limits",
        "velocity_limit": "robot.velocity_limits",
        "torque_limits": "robot.effort_limits",
        **dict.fromkeys(("teach", "plot", "show", "view", "display"), "oc.view(robot)"),
        "integrate": "q + dq dt: joint positions are plain numbers",
        "difference": "q1 - q0: joint positions are plain numbers",
        "kinetic_energy": "dq @ robot.mass_matrix(q) @ dq / 2",
        "potential_energy": "robot.centre_of_mass(q) and the mass",
        "data": "robot.tree",
        "model": "robot.tree",
        "name": "robot.heading",
        **dict.fromkeys(("self_collision", "in_collision", "collision_free"), "robot.collisions.check_free(q)"),
        "distance": "robot.collisions.distance(q)",
    },
    "Chart": {
        "fk": "chart.x(q), or chart.phi(q) with xi",
        "forward": "chart.phi(q)",
        "ik": _SOLVE,
        "inverse_kinematics": _SOLVE,
        "solve_ik": _SOLVE,
        "follow": "oc.follow(chart, path)",
        "evaluate": "oc.evaluate(chart)",
        "certify": "oc.certify(chart)",
        "view": _VIEW,
        "show": _VIEW,
        "simulate": "oc.simulate(law, ...) with a law of oc.control on the chart",
        "generate_c": _GENERATE,
        "codegen": _GENERATE,
        "export": "oc.export(chart, path)",
        "null_space": "chart.self_motion(q)",
        "nullspace": "chart.self_motion(q)",
        "range": "chart.xi_range(q)",
        "limits": "chart.xi_range(q), or chart.domain.bounds",
        "sample": "chart.domain.sample(count, seed)",
        "nearest": "chart.nearest_xi(q, x)",
        "closest": "chart.nearest_xi(q, x)",
        "track": "chart.tracker(q)",
        "metric": "chart.problem.metric",
        "J": "chart.jacobian(q)",
        "jac": "chart.jacobian(q)",
        "jacobian_xi": "chart.jacobian(q): the task's rows come first, then those of xi",
        "gradient": "chart.jacobian(q): the task's rows come first, then those of xi",
        "pose": "chart.robot.pose(q), or chart.x(q) for the task",
        "velocity": "chart.jacobian(q) @ dq",
        "dxi": "chart.jacobian(q) @ dq",
        "rates": "chart.jacobian(q) @ dq",
        **dict.fromkeys(("ik_all", "solve_all", "all_solutions"), "chart.solutions(phi), or oc.Arm for all branches"),
        "solve_nearest": "chart.nearest_xi(q, x)",
        **dict.fromkeys(("nullspace_basis", "null_space_basis"), "chart.jacobian(q): the columns of its inverse"),
        **dict.fromkeys(("null_space_projector", "projector"), "oc.control.XiTask(chart), or chart.jacobian(q)"),
        "redundancy": "chart.r",
        **dict.fromkeys(("redundancy_parameter", "elbow", "swivel", "psi", "arm_angle"), "chart.xi(q)"),
        "xi_limits": "chart.xi_range(q)",
        "bounds": "chart.domain.bounds",
        "names": "chart.labels",
        "dof": "chart.n",
        "to_casadi": "chart.function(name)",
        "casadi": "chart.function(name)",
        "to_c": _GENERATE,
        "to_torch": "oc.export(chart, 'torch', path)",
        "to_jax": "oc.export(chart, 'jax', path)",
        **dict.fromkeys(("interpolate", "path", "plan"), "oc.follow(chart, path)"),
        "step": "chart.tracker(q), whose step(phi) it is",
        "controller": "oc.control.PDPlus(chart)",
        **dict.fromkeys(("info", "summary"), "print(chart)"),
        "report": "oc.evaluate(chart)",
        **dict.fromkeys(("is_valid", "contains", "inside"), "chart.domain.contains(q)"),
        "branch": "oc.Arm, whose charts cover all branches",
        "branches": "oc.Arm, whose charts cover all branches",
    },
    "LawOfChart": {
        **dict.fromkeys(("step", "torque", "compute", "update", "command_at", "call"), _LAW),
        "simulate": "oc.simulate(law, reference, q)",
        "codegen": _GENERATE,
        "generate_c": _GENERATE,
    },
}


def explain_missing(owner: str, name: str) -> str:
    """The message of an AttributeError: what does not exist, and what serves in its place if that is known."""
    what = "module 'orthocas'" if owner == "orthocas" else f"'{owner}' object"
    instead = GUESSES.get(owner, {}).get(name)
    return f"{what} has no attribute '{name}'" + (f": use {instead}" if instead else "")
