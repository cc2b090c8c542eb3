"""Names that people try first, from habit with other libraries, and what serves here.

Pinocchio, Pink, mink, the Robotics Toolbox and ssik gave the names. An attribute that does not exist is looked up here,
and the AttributeError says what to use.
"""

from collections.abc import Mapping

_SOLVE = "chart.solve(x=..., xi=...), or chart.nearest_xi(q, x), with a chart of oc.load or oc.fit_wide"
_POSE = "robot.pose(q, frame), or chart.x(q) for the task"
_MASS = "robot.mass_matrix(q)"
_SAMPLE = "robot.sample(count, seed)"
_VIEW = "oc.view(chart)"
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
        "codegen_c": "oc.generate_c(law, path)",
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
        "generate_c": "oc.generate_c(law, path) with a law of oc.control on the chart",
        "codegen": "oc.generate_c(law, path) with a law of oc.control on the chart",
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
    },
}


def explain_missing(owner: str, name: str) -> str:
    """The message of an AttributeError: what does not exist, and what serves in its place if that is known."""
    what = "module 'orthocas'" if owner == "orthocas" else f"'{owner}' object"
    instead = GUESSES.get(owner, {}).get(name)
    return f"{what} has no attribute '{name}'" + (f": use {instead}" if instead else "")
