"""Calls of the public functions, classes and methods that work, for the campaign that changes their arguments."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
from mujoco_arm import Arm
from public_objects import (
    BENT_POSTURE,
    HAS_COMPILER,
    arm,
    circle,
    clear,
    collisions,
    compiled,
    fitted,
    impedance,
    joint_motion,
    planar,
    steps,
    trajectory,
)

import orthocas as oc
from orthocas import bases, control, learn, problems, simulation, solvers, viewer
from orthocas.bases import cyclic_joints
from orthocas.certificates import check_certificate
from orthocas.charts.chart import GrownChart
from orthocas.charts.figures import quality_figure, self_motion_figure
from orthocas.charts.regular_part import RegularPart
from orthocas.codegen import CompiledLibrary, Supervisor, compile_shared
from orthocas.errors import CompileError
from orthocas.fitting.loss import loss
from orthocas.paths import corridor_problem, read_joints
from orthocas.robots.collisions import Collisions
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.domains import default_box
from orthocas.tasks.metric import Metric
from orthocas.viewer.session import Session

Call = tuple[Callable[..., Any], dict[str, Any]]  # a function, and arguments that it takes


@cache
def good_calls() -> dict[str, Call]:
    """What can be called, with arguments that work and take little time."""
    physics = {**_physics(), **_supervised()}
    found = {**_makers(), **_functions(), **_methods(), **_searches(), **_arms()}
    return {**found, **_control(), **physics, **_views()}


def _arms() -> dict[str, Call]:
    """Whole arms."""
    whole, q = arm(), BENT_POSTURE
    x, motions = whole.x(q), whole.self_motion(whole.x(q))
    tracker = whole.tracker(q)
    return {
        "Arm": (oc.Arm, {"task": whole.task, "charts": whole.charts}),
        "Arm.fit": (
            lambda **given: oc.Arm.fit(**{"robot": "none", **given}),
            {"robot": planar().robot, "task": planar().task, "metric": "euclidean", "seed": 0, "monitor": print},
        ),
        "Arm.load": (oc.Arm.load, {"path": "no.arm"}),
        "arm.save": (whole.save, {"path": "new.arm", "force": False}),
        "arm.x": (whole.x, {"q": q}),
        "arm.self_motion": (whole.self_motion, {"x": x}),
        "arm.solve": (whole.solve, {"x": x, "xi": 0.1, "start": q, "branch": "any", "all": True}),
        "arm.tracker": (whole.tracker, {"q": q, "period": 0.01, "velocity_limits": 1.0, "detours": True}),
        "arm.follow": (
            whole.follow,
            {"path": np.array([x, x + 0.01]), "xi": 0.1, "q": q, "period": 0.01, "velocity_limits": 1.0},
        ),
        "arm.tracker.step": (tracker.step, {"x": x, "xi": 0.1}),
        "arm.tracker.reset": (tracker.reset, {"q": q}),
        "motions.sample": (motions.sample, {"n": 5, "metric": "inertia"}),
        "motions.nearest": (motions.nearest, {"q": q}),
        "motions.best": (motions.best, {"f": lambda q: q[:, 0]}),
        "arc.at": (motions.components[0].at, {"place": [0.0, 0.5]}),
        "arc.sample": (motions.components[0].sample, {"n": 5, "metric": "euclidean"}),
    }


def _searches() -> dict[str, Call]:
    """What looks for branches, wide charts and charts along paths, registers, or compiles."""
    problem, chart, q = planar(), fitted().chart, np.array([0.3, 0.4, 0.5])
    robot, task = problem.robot, problem.task
    wide_box = oc.ClearBox(problem.domain, task, 0.1)
    return {
        "branches": (oc.branches, {"robot": robot, "task": task}),
        "ClearBox": (
            oc.ClearBox,
            {"box": problem.domain, "task": task, "least_singular_value": 0.1, "scale": None, "rows": "frame"},
        ),
        "RegularPart": (
            RegularPart,
            {"box": wide_box, "coordinates": chart.coordinates, "least_volume": 0.05},
        ),
        "fit_wide": (
            oc.fit_wide,
            {
                "robot": robot,
                "task": task,
                "branch": problem.domain,
                "metric": "euclidean",
                "clearance": 0.1,
                "parametrisation": oc.Polynomial(1),
                "home": q,
                "like": None,
                "samples": 100,
                "seed": 0,
            },
        ),
        "fit_wide, of a quantity": (
            oc.fit_wide,
            {"robot": robot, "task": task, "branch": problem.domain, "like": "q1", "exact": True},
        ),
        "chart.nearest_xi": (chart.nearest_xi, {"q_wish": q, "x": chart.x(q), "tolerance": 1e-9}),
        "chart_along": (oc.chart_along, {"problem": problem, "postures": [q, q + 0.1], "radius": 0.2}),
        "compile_inverse": (oc.compile_inverse, {"chart": chart, "folder": "kept"}),
        **(
            {
                "CompiledInverse.solve": (compiled().solve, {"phi": compiled().chart.phi(q), "tolerance": 1e-9}),
                "CompiledInverse.nearest_xi": (
                    compiled().nearest_xi,
                    {"q_wish": q, "x": compiled().chart.x(q), "tolerance": 1e-9},
                ),
            }
            if HAS_COMPILER
            else {}
        ),
        "progress": (lambda monitor: oc.fit(problem, oc.Linear(), samples=50, monitor=monitor), {"monitor": None}),
        "register_domain": (oc.register_domain, {"kind": oc.Box}),
        "register_metric": (oc.register_metric, {"name": "euclidean", "build": None}),
        "register_task": (oc.register_task, {"name": "pose", "build": None}),
        "Motion": (
            viewer.Motion,
            {"name": "a", "times": [0.0, 1.0], "q": [q, q], "labels": ("x",), "values": [[0.0], [1.0]]},
        ),
        "export_page": (viewer.export_page, {"shown": robot, "path": "page.html", "robot": None, "force": False}),
    }


def _physics() -> dict[str, Call]:
    """MuJoCo as plant."""
    robot, q = planar().robot, np.array([0.3, 0.4, 0.5])
    payload, wall = simulation.Payload(1.0), simulation.Wall([9.0, 0, 0], [-1.0, 0, 0])
    options = {"stops": True, "effort_limits": True, "payload": payload, "wall": wall, "timestep": 1e-3}
    return {
        "Stops": (lambda **given: _stopped(robot, simulation.Stops(**given)), {"stiffness": 1e4, "damping": [1.0] * 3}),
        "Payload": (simulation.Payload, {"mass": 1.0, "centre": q, "inertia": np.eye(3)}),
        "Wall": (simulation.Wall, {"point": q, "normal": q, "tip_radius": 0.1, "size": 1.0, "time_constant": 0.01}),
        "MuJoCo": (simulation.MuJoCo, {"robot": robot, **options}),
        "Elasticity": (
            lambda **given: simulation.MuJoCoPlant(robot, elasticity=simulation.Elasticity(**given)),
            {"stiffness": [8000.0, 5000.0, 5000.0], "inertia": 0.4, "damping": 5.0},
        ),
        "MuJoCoPlant": (simulation.MuJoCoPlant, {"robot": robot, "friction": simulation.Friction(0.1, 0.1), **options}),
        "StickingPlant": (
            simulation.StickingPlant,
            {"robot": robot, "friction": simulation.Friction(0.1, 0.1), "effort_limits": True, "timestep": 1e-3},
        ),
        "sticking.reset": (lambda **given: simulation.StickingPlant(robot).reset(**given), {"q": q, "dq": q}),
        "sticking.step": (
            lambda **given: simulation.StickingPlant(robot).step(**given),
            {"torque": q, "seconds": 0.01, "loads": q},
        ),
        "plant.reset": (lambda **given: _plant(robot).reset(**given), {"q": q, "dq": q}),
        "plant.push": (lambda **given: _plant(robot).push(**given), {"force": q, "link": 1, "point": q}),
        "plant.step": (lambda **given: _plant(robot).step(**given), {"torque": q, "seconds": 0.01, "loads": q}),
    }


def _views() -> dict[str, Call]:
    """What opens pages, and what stands behind them."""
    chart, q = fitted().chart, planar().domain.centre
    x = chart.x(q)
    session = Session(chart)
    return {
        "view": (
            lambda **given: oc.view(**given).close(),
            {"shown": chart, "host": "127.0.0.1", "port": 0},
        ),
        "cyclic_motions": (viewer.cyclic_motions, {"chart": chart, "path": [x, x + 0.05, x], "cycles": 1}),
        "Session": (Session, {"chart": chart, "q": q}),
        "session.wish": (session.wish, {"values": {"xi1": 0.1}}),
        "chart.plot": (lambda postures: self_motion_figure(chart, postures), {"postures": 3}),
    }


def _supervised() -> dict[str, Call]:
    """The supervised law of a compiled library, if there is a compiler."""
    law = impedance()
    with TemporaryDirectory() as folder:
        try:
            path = compile_shared(oc.generate_c(law.chart, folder, law, "arm"), Path(folder), ("-O0",))
        except CompileError:
            return {}
        library = CompiledLibrary(path, "arm", 3)
        library.check()  # it is loaded before its file goes
    q, reference = law.problem.domain.centre, np.zeros(9)
    supervisor = Supervisor(library, law)
    return {
        "supervisor": (Supervisor, {"library": library, "controller": law, "safety": control.Safety.of(law)}),
        "supervisor.check_start": (supervisor.check_start, {"q": q, "torque": q}),
        "supervisor.start": (supervisor.start, {"q": q, "command": q}),
        "supervisor.take_over": (supervisor.take_over, {"q": q, "command": q}),
        "supervisor.hold": (supervisor.hold, {"q": q, "command": q}),
        "supervisor.release": (supervisor.release, {"q": q, "command": q}),
        "supervisor.stream": (
            supervisor.stream,
            {"reference": reference, "target": np.zeros(3), "omega": 3.0, "period": 1e-3},
        ),
        "supervisor.pace": (supervisor.pace, {"reference": reference, "period": 1e-3}),
        "supervisor.step": (supervisor.step, {"q": q, "dq": q, "reference": reference, "period": 1e-3}),
    }


def _stopped(robot: oc.Robot, stops: simulation.Stops) -> ca.SX:
    return stops.torque(robot.tree, ca.SX.sym("q", 3), ca.SX.sym("dq", 3))


def _plant(robot: oc.Robot) -> simulation.MuJoCoPlant:
    return simulation.MuJoCoPlant(robot)


def _makers() -> dict[str, Call]:
    robot, problem, q = planar().robot, planar(), np.array([0.3, 0.4, 0.5])
    column = ca.vertcat
    return {
        "Robot.planar": (oc.Robot.planar, {"lengths": [1.0, 1.0], "masses": [1.0, 2.0]}),
        "Robot.from_urdf": (
            oc.Robot.from_urdf,
            {"path": "no.urdf", "tip": "a", "locked": {"a": 1.0}, "tool": q, "tips": ["a"]},
        ),
        "Robot.from_mjcf": (
            oc.Robot.from_mjcf,
            {"path": "no.xml", "tip": "a", "locked": {"a": 1.0}, "tool": q, "tips": ["a"]},
        ),
        "Robot.from_file": (oc.Robot.from_file, {"path": "no.xml", "tip": None}),
        "Robot.from_model": (oc.Robot.from_model, {"model": None, "tip": "tip", "locked": {}}),
        "Robot": (oc.Robot, {"tree": robot.tree, "homes": {"a": q}}),
        "Box": (oc.Box, {"centre": q, "half_width": 0.3, "unbounded": [0]}),
        "Corridor": (Corridor, {"box": oc.Box(q, 0.5), "postures": [q, q + 0.1], "radius": 0.2}),
        "corridor_problem": (
            corridor_problem,
            {"problem": planar(), "postures": [q, q + 0.1], "radius": 0.2, "margin_deg": 1.0},
        ),
        "Box.from_limits": (oc.Box.from_limits, {"lower": -q, "upper": q}),
        "Torus": (oc.Torus, {"n": 3}),
        "Polynomial": (oc.Polynomial, {"degree": 2, "cyclic": ["q1"]}),
        "Fourier": (oc.Fourier, {"degree": 2, "cyclic": "auto"}),
        "MLP": (oc.MLP, {"hidden": (3, 3), "raw": True, "cyclic": ["q1"], "without": ["q3"]}),
        "Mobile": (oc.Mobile, {"arm": oc.Polynomial(1), "base": ("a", "b", "c")}),
        "Circle": (oc.Circle, {"pairs": oc.Fourier(1)}),
        "SEW": (oc.SEW, {"kind": "stereographic"}),
        "Linear": (oc.Linear, {"base": (0.1, 0.2, 0.3), "normals": "orthonormal"}),
        "Given.from_function": (
            oc.Given.from_function,
            {"name": "g", "n": 3, "function": lambda q: column(q[0], q[1])},
        ),
        "Metric.from_spec": (Metric.from_spec, {"robot": robot, "spec": np.eye(3)}),
        "Metric.custom": (Metric.custom, {"robot": robot, "name": "m", "function": lambda q: ca.diag(2 + q**2)}),
        "Problem": (
            oc.Problem,
            {"robot": robot, "task": problem.task, "metric": "inertia", "domain": problem.domain, "name": "p"},
        ),
        "Chart": (oc.Chart, {"problem": problem, "coordinates": fitted().chart.coordinates, "notes": {"a": 1.0}}),
        "GrownChart": (GrownChart, {"problem": circle().problem, "coordinates": circle().coordinates, "notes": {}}),
        "Weights": (
            oc.Weights,
            {"task": 1.0, "regularity": 1.0, "length": 1.0, "folds": 1.0, "extra": {}, "angles": "paper"},
        ),
        "Task.position": (oc.Task.position, {"robot": robot, "axes": "x"}),
        "Task.polar": (oc.Task.polar, {"robot": robot}),
        "Task.orientation": (oc.Task.orientation, {"robot": robot, "reference": np.eye(3), "axis": "z"}),
        "Task.pose": (oc.Task.pose, {"robot": robot, "reference": np.eye(3), "axis": "z"}),
        "Task.axis": (oc.Task.axis, {"robot": robot, "axis": "z", "reference": q}),
        "Task.position_and_axis": (oc.Task.position_and_axis, {"robot": robot, "axis": "z", "reference": q}),
        "Task.relative_position": (
            oc.Task.relative_position,
            {"robot": robot, "base": "tip", "frame": "tip", "axes": "x"},
        ),
        "Task.relative_pose": (
            oc.Task.relative_pose,
            {"robot": robot, "base": "tip", "frame": "tip", "reference": np.eye(3), "axis": "z"},
        ),
        "Task.centre_of_mass": (oc.Task.centre_of_mass, {"robot": robot, "axes": "x"}),
        "Task.pointing": (oc.Task.pointing, {"robot": robot, "camera": "tip", "target": q, "axis": "x"}),
        "robot.pose": (robot.pose, {"q": q, "frame": "tip"}),
        "robot.jacobian": (robot.jacobian, {"q": q, "frame": "tip"}),
        "robot.sample": (robot.sample, {"count": 3, "seed": 0}),
        "domain.sample": (planar().domain.sample, {"count": 3, "seed": 0}),
        "task": (planar().task, {"q": q}),
        "task.target": (planar().task.target, {"pose": np.eye(4)}),
        "robot.frame_position": (robot.frame_position, {"q": q, "frame": "tip", "relative_to": "tip"}),
        "robot.frame_function": (
            robot.frame_function,
            {"quantity": "rotation", "frame": "tip", "relative_to": "tip"},
        ),
        "Task.named": (oc.Task.named, {"robot": robot, "kind": "position:x", "q_reference": q}),
        "Task.custom": (
            oc.Task.custom,
            {"robot": robot, "name": "t", "function": lambda q: q[0], "labels": ["a"], "units": ["m"]},
        ),
        **{
            f"{kind.__name__}": (kind, {"max_iterations": 5, "tolerance": 1e-3})
            for kind in (solvers.GaussNewton, solvers.QuasiNewton, solvers.LBFGS, solvers.Ipopt, solvers.GradientFlow)
        },
        "Adam": (solvers.Adam, {"epochs": 2, "steps": 3, "batch": 20, "learning_rate": 1e-3}),
    }


def _functions() -> dict[str, Call]:
    problem, chart, q = planar(), fitted().chart, np.array([0.3, 0.4, 0.5])
    box = {"problem": problem, "parametrisation": oc.Polynomial(1)}
    return {
        "fit of a robot": (
            oc.fit,
            {
                "problem": problem.robot,
                "task": problem.task,
                "parametrisation": oc.Linear(),
                "metric": "euclidean",
                "domain": problem.domain,
            },
        ),
        "fit": (
            oc.fit,
            {
                **box,
                "solver": solvers.GaussNewton(3),
                "weights": (10, 1, 1),
                "samples": 50,
                "seed": 0,
                "precision": "single",
            },
        ),
        "bounded fit": (oc.fit, {**box, "solver": None, "samples": 50, "max_mutual_deg": None}),
        "certify": (oc.certify, {"chart": chart, "bound": 0.0, "time_limit": 0.0, "executor": None, "resume": None}),
        "check_certificate": (check_certificate, {"chart": chart, "certificate": None, "executor": None}),
        "check": (oc.check, {"problem": problem, "samples": 50, "seed": 1}),
        "cyclic_joints": (cyclic_joints, {"problem": problem}),
        "suggest_domain": (
            oc.suggest_domain,
            {
                "robot": problem.robot,
                "task": problem.task,
                "home": q,
                "metric": "euclidean",
                "leak_deg": 5.0,
                "conditioning": 0.3,
                "parametrisation": oc.Polynomial(1),
                "seed": 0,
            },
        ),
        "default_box": (default_box, {"robot": problem.robot, "centre": q, "half_width": 0.2}),
        "distil": (
            oc.distil,
            {"chart": circle(), "parametrisation": oc.Polynomial(1), "solver": None, "samples": 30, "seed": 0},
        ),
        "evaluate": (oc.evaluate, {"chart": chart, "samples": 50, "seed": 1}),
        "evaluate points": (oc.evaluate, {"chart": chart, "samples": None, "seed": None, "points": [q, q]}),
        "export": (oc.export, {"chart": chart, "to": "numpy", "path": "module.py", "force": False}),
        "generate_c": (oc.generate_c, {"chart": chart, "out": "c", "controller": impedance(), "name": "arm"}),
        "fit_capsules": (oc.fit_capsules, {"collisions": Collisions(problem.robot.tree, collisions().parts[:3], ())}),
        "generate_c with settings": (
            oc.generate_c,
            {"chart": chart, "out": "c", "controller": impedance(), "safety": control.Safety.of(impedance())},
        ),
        "grow": (
            oc.grow,
            {"problem": problems.get("planar_2r"), "level": 1.0, "leaf": None, "origin": [1.0, 0.0], "cells": None},
        ),
        "grow linear": (oc.grow, {"problem": planar("euclidean"), "leaf": "linear", "level": 0.5, "region": None}),
        "involutivity": (oc.involutivity, {"problem": problem, "samples": 30, "seed": 1}),
        "load": (oc.load, {"path": "no.orthocas"}),
        "charts.load": (oc.charts.load, {"path": "ur5-position"}),
        "charts.card": (oc.charts.card, {"name": "ur5-position"}),
        "loss": (loss, {**box, "weights": (1, 1), "samples": 20, "seed": 0, "start": None}),
        "compare": (
            oc.compare,
            {
                "problem": problem,
                "parametrisations": [],
                "solvers": None,
                "branch": None,
                "weights": [(1.0, 0.1), (1.0, 1.0)],
                "seeds": 1,
                "samples": 50,
                "held_out": 50,
            },
        ),
        "register_parametrisation": (
            oc.register_parametrisation,
            {"name": "polynomial", "kind": oc.MLP, "parse": None},
        ),
        "register_loss_term": (oc.register_loss_term, {"term": None}),
        "parse": (bases.parse_parametrisation, {"label": "polynomial:2"}),
        "from data": (bases.parametrisation_from_data, {"data": {"name": "polynomial", "degree": 2}}),
        "to data": (bases.parametrisation_to_data, {"parametrisation": oc.Polynomial(2)}),
        "solvers.get": (solvers.get, {"name": "lbfgs"}),
        "problems.get": (problems.get, {"name": "planar_2r"}),
        "self_motion_figure": (self_motion_figure, {"chart": chart, "postures": 2}),
        "quality_figure": (quality_figure, {"report": None}),
    }


def _methods() -> dict[str, Call]:
    robot, chart, grown, q = planar().robot, fitted().chart, circle(), np.array([0.3, 0.4, 0.5])
    phi = chart.phi(q)
    states = {
        **{name: {"q": q} for name in ("mass_matrix", "gravity", "tip_position", "tip_rotation", "tip_jacobian")},
        "joint_points": {"q": q},
        "bias": {"q": q, "dq": q},
        "inverse_dynamics": {"q": q, "dq": q, "ddq": q},
        "forward_dynamics": {"q": q, "dq": q, "tau": q},
        "coriolis_product": {"q": q, "v": q, "w": q},
        "with_scaled_masses": {"factor": q},
        "with_tool": {"tool": q},
        "home": {"name": "h"},
        "function": {"name": "bias"},
    }
    evaluations = ("xi", "task", "phi", "jacobian")
    return {
        **{f"robot.{name}": (getattr(robot, name), arguments) for name, arguments in states.items()},
        **{f"chart.{name}": (getattr(chart, name), {"q": q}) for name in evaluations},
        **{f"grown.{name}": (getattr(grown, name), {"q": q[:2]}) for name in evaluations},
        "chart.quality": (chart.quality, {"q": q}),
        "grown.quality": (grown.quality, {"q": [q[:2], q[:2]]}),
        "chart.inverse": (chart.inverse, {"phi": phi, "q_start": q, "outside": False, "tolerance": 1e-9}),
        "chart.solve": (chart.solve, {"phi": phi, "q_start": q, "tolerance": 1e-9, "inside": True}),
        "chart.solutions": (chart.solutions, {"phi": phi, "tolerance": 1e-9}),
        "chart.tracker": (chart.tracker, {"q0": planar().domain.centre, "largest_step": 0.1}),
        "chart.tracker with collisions": (
            chart.tracker,
            {
                "q0": planar().domain.centre,
                "nearest": True,
                "collisions": collisions(),
                "margin": 0.001,
                "avoid": 0.002,
            },
        ),
        "chart.solve with collisions": (chart.solve, {"phi": phi, "all": True, "collisions": collisions()}),
        "tracker.step": (chart.tracker(planar().domain.centre).step, {"phi": phi}),
        "tracker.reset": (chart.tracker(planar().domain.centre).reset, {"q": q}),
        "grown.inverse": (grown.inverse, {"phi": grown.phi([1.0, 0.0]), "q_start": [1.0, 0.0], "tolerance": 1e-6}),
        "follow": (
            oc.follow,
            {
                "chart": clear(),
                "tool_path": clear().task([q, q + 0.05, q]),
                "xi": "hold",
                "q_start": q,
                "period": 0.05,
                "velocity_limits": 1.0,
                "acceleration_limits": 2.0,
                "clearance": 0.01,
                "collisions": collisions(),
            },
        ),
        "follow by objective": (
            oc.follow,
            {"chart": chart, "tool_path": chart.x([q, q + 0.05]), "xi": "objective", "velocity_limits": 1.0},
        ),
        "read_joints": (read_joints, {"path": "no.csv", "robot": robot, "topic": "/arm"}),
        "motion.save_csv": (joint_motion().save_csv, {"path": "motion.csv"}),
        "Sphere": (oc.obstacles.Sphere, {"centre": q, "radius": 0.1}),
        "Capsule": (oc.obstacles.Capsule, {"start": q, "end": -q, "radius": 0.1}),
        "Plane": (oc.obstacles.Plane, {"normal": q, "point": q}),
        "robot.with_rods": (robot.with_rods, {"radius": 0.1}),
        "obstacles.Box": (oc.obstacles.Box, {"size": q, "centre": q, "rotation": np.eye(3)}),
        "Mesh": (oc.obstacles.Mesh, {"points": np.eye(4, 3), "position": q, "rotation": np.eye(3), "scale": 0.5}),
        "PointCloud": (oc.obstacles.PointCloud, {"points": [q, -q], "cell": 0.1}),
        "Scene": (oc.Scene, {"solids": {"ball": oc.obstacles.Sphere(q, 0.1)}}),
        "Collisions": (
            Collisions,
            {"tree": robot.tree, "parts": collisions().parts, "pairs": collisions().pairs, "missing": ("hand",)},
        ),
        "collisions.distance": (collisions().distance, {"q": q}),
        "collisions.pair_distances": (collisions().pair_distances, {"q": q}),
        "collisions.check_free": (collisions().check_free, {"q": q}),
        "collisions.find_near": (collisions().find_near, {"q": q, "within": 2.0}),
        "collisions.find_contact": (collisions().find_contact, {"q": [q, -q], "clearance": 0.01, "bend": 0.001}),
        "collisions.with_scene": (
            collisions().with_scene,
            {"scene": oc.Scene({"ball": oc.obstacles.Sphere(q, 0.1)}), "allowed": [("link2", "ball")]},
        ),
        "collisions.with_attached": (
            collisions().with_attached,
            {"frame": robot.tips[0], "solids": {"ball": oc.obstacles.Sphere(q, 0.1)}, "allowed": [("link1", "ball")]},
        ),
        "evaluate with collisions": (oc.evaluate, {"chart": chart, "samples": 50, "collisions": collisions()}),
        "chart.manipulability": (chart.manipulability, {"q": q}),
        "chart.manipulability_gradient": (chart.manipulability_gradient, {"q": q, "along": "xi"}),
        "chart.solve x": (chart.solve, {"x": chart.x(q), "xi": chart.xi(q), "q_start": q}),
        "chart.xi_range": (chart.xi_range, {"q": q}),
        "chart.self_motion": (chart.self_motion, {"q": q, "samples": 20}),
        "curve of self_motion": (clear().self_motion, {"q": clear().problem.domain.centre, "step": 0.1}),
        "chart.function": (chart.function, {"name": "phi"}),
        "chart.save": (chart.save, {"path": "chart.orthocas"}),
        "run.save": (trajectory().save, {"path": "run.npz"}),
        "run.load": (simulation.Trajectory.load, {"path": "run.npz"}),
        "box.contains": (planar().domain.contains, {"q": q}),
        "task.with_reference_at": (oc.Task.axis(robot).with_reference_at, {"q": q}),
        "check_damping": (impedance().check_damping, {"samples": 10}),
    }


def _moved(action: Any) -> object:
    """What an environment with actions in (x, xi) makes of one."""
    env = learn.PhiActions(Arm(fitted().chart), fitted().chart, 0.01)
    env.reset()
    return env.step(action)


def _control() -> dict[str, Call]:
    chart, problem, reference, law = fitted().chart, planar(), steps(), impedance()
    centre = planar().domain.centre
    gains = {"chart": chart, "stiffness": 50.0, "damping_ratio": 0.7, "coupling": "coupled", "damping": "square_root"}
    changes = [(0.1, {"x": 0.5})]
    return {
        "Impedance": (control.Impedance, {**gains, "limit": None}),
        "Impedance with a free coordinate": (
            control.Impedance,
            {
                "chart": chart,
                "stiffness": [0.0, 50.0, 50.0],
                "damping_stiffness": 50.0,
                "model": control.RunTimeModel(payload=1.0),
            },
        ),
        "RunTimeModel": (
            control.RunTimeModel,
            {"source": "own", "gravity": "law", "payload": [1.0, 0, 0, 0.1], "wrench": [0.0] * 6, "extra_torque": 0.1},
        ),
        "with_payload": (problem.robot.with_payload, {"payload": [1.0, 0, 0, 0, 1, 0, 0, 1, 0, 1]}),
        "modes": (law.modes, {"q": centre}),
        "Safety.of": (
            control.Safety.of,
            {"controller": law, "fade_in": 0.1, "command_rate": 100.0, "error_limit": [0.1, 0.1, 0.1], "hold_ticks": 5},
        ),
        "MomentumObserver": (control.MomentumObserver, {"rate": 5.0, "bound": [1.0, 2.0, 3.0]}),
        "FrictionObserver": (control.FrictionObserver, {"rate": 5.0, "bound": [1.0, 2.0, 3.0], "tolerance": 1e-3}),
        "Adaptation": (control.Adaptation, {"rate": 5.0, "bound": 2.0}),
        "PDPlus with a memory": (
            control.PDPlus,
            {**gains, "limit": [1.0, 2.0, 3.0], "remembers": control.MomentumObserver(bound=[1.0, 2.0, 3.0])},
        ),
        "Remembering.tick": (
            control.Remembering(control.PDPlus(chart, 50.0, limit=9.0, remembers=control.Adaptation())).tick,
            {"q": centre, "dq": 0 * centre, "reference": np.zeros((3, 3)), "period": 1e-3},
        ),
        "Remembering.tick without a memory": (
            control.Remembering(control.PDPlus(chart, 50.0, limit=9.0)).tick,
            {"q": centre, "dq": 0 * centre, "reference": np.zeros((3, 3)), "period": 1e-3},
        ),
        "XiTask": (control.XiTask, {"chart": chart, "cost": 1.0, "gain": 0.5, "lm_damping": 0.1}),
        "PhiActions": (learn.PhiActions, {"env": Arm(chart), "chart": chart, "step": 0.01, "joints": [0, 1, 2]}),
        "actions.step": (_moved, {"action": [0.1, 0.0, -0.1]}),
        "coordinates_of": (learn.coordinates_of, {"chart": chart, "q": np.array([[0.6, 0.8, 0.8]])}),
        "joints_of": (
            learn.joints_of,
            {"chart": chart, "phi": chart.phi([[0.6, 0.8, 0.8]]), "q_start": np.array([0.6, 0.8, 0.8])},
        ),
        "PDPlus": (control.PDPlus, {**gains, "limit": [1.0, 2.0, 3.0]}),
        "Kinematic": (control.Kinematic, {"chart": chart, "feedback": 1.0, "limit": None}),
        "Reference.steps": (
            control.Reference.steps,
            {"labels": ("x", "y"), "start": [0.0, 0.0], "changes": changes, "duration": 0.5, "natural_frequency": 6.0},
        ),
        "Reference.jerk_limited": (
            control.Reference.jerk_limited,
            {
                "labels": ("x", "xi1"),
                "points": [[0.0, 0.0], [0.1, 0.2]],
                "velocity": 1.0,
                "acceleration": [2.0, 2.0],
                "jerk": 10.0,
                "pause": 0.1,
            },
        ),
        "Reference.through": (
            control.Reference.through,
            {"labels": ("x", "y"), "times": [0.0, 1.0, 2.0], "points": [[0.0, 1.0], [1.0, 1.0], [2.0, 0.0]]},
        ),
        "reference.sample": (reference.sample, {"times": np.array([0.1, 0.2])}),
        "joint_path": (control.joint_path, {"chart": chart, "reference": reference, "q_start": centre}),
        "matched_stiffness": (control.matched_stiffness, {"chart": chart}),
        "law_of": (control.law_of, {"name": "impedance"}),
        "control.register": (control.register, {"law": None}),
        "Push": (
            simulation.Push,
            {
                "start": 0.1,
                "duration": 0.1,
                "force": [1.0, 0, 0],
                "torque": [0.0, 0, 0],
                "link": 1,
                "point": [0.1, 0, 0],
            },
        ),
        "Friction": (simulation.Friction, {"viscous": [1.0, 1, 1], "coulomb": 0.1}),
        "Noise": (simulation.Noise, {"position": 0.1, "velocity": 0.1, "seed": 0}),
        "simulate": (
            oc.simulate,
            {"controller": law, "reference": reference, "q_start": centre, "step": 0.1, "pushes": (), "friction": None}
            | {"stops": None},
        ),
        "simulate in MuJoCo": (
            oc.simulate,
            {"controller": law, "reference": reference, "q_start": centre, "control_rate": 50.0, "plant": "mujoco"}
            | {"pushes": [simulation.Push(0.1, 0.1, [1.0, 0, 0], link=1)], "friction": simulation.Friction(0.1, 0.1)},
        ),
        "simulate sampled": (
            oc.simulate,
            {"controller": law, "reference": reference, "q_start": centre, "control_rate": 50.0, "dq_start": centre * 0}
            | {"noise": None, "plant": None, "compiled": False},
        ),
        "simulate_many": (
            oc.simulate_many,
            {"controller": law, "reference": reference, "q_start": centre, "changes": [{"step": 0.1}]}
            | {"executor": None, "control_rate": 50.0},
        ),
        "simulate supervised": (
            oc.simulate,
            {"controller": law, "reference": reference, "q_start": centre, "control_rate": 50.0, "resume_after": 1.0}
            | {"safety": control.Safety.of(law)},
        ),
        "coupling_index": (
            simulation.coupling_index,
            {"chart": chart, "reference": reference, "trajectory": trajectory()},
        ),
        "task_acceleration_breakdown": (
            simulation.task_acceleration_breakdown,
            {"chart": chart, "trajectory": trajectory()},
        ),
    }
