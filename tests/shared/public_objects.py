"""One of every public object, small and quick to build, and the numbers that tell whether two of them are equal."""

import copy
import shutil
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from functools import cache, singledispatch
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

import orthocas as oc
from orthocas import control, paths, problems, solvers
from orthocas.arms import Arc, ArmTracker, SelfMotions
from orthocas.charts.certificate import Certificate
from orthocas.charts.chart import GrownChart
from orthocas.charts.trackers import Tracker
from orthocas.codegen.compiled_inverse import CompiledInverse
from orthocas.control import Controller, Reference
from orthocas.fitting.compare import Comparison
from orthocas.fitting.fit import ClearPart, Fit
from orthocas.fitting.wide import WideFit
from orthocas.robots.collisions import Collisions, Part
from orthocas.robots.shapes import BallGeometry, Shape
from orthocas.robots.tree import place_on_base
from orthocas.simulation import (
    Elasticity,
    Friction,
    MuJoCo,
    Noise,
    Payload,
    Push,
    Stops,
    Trajectory,
    Wall,
    coupling_index,
    simulate,
)
from orthocas.tasks.branches import Branches
from orthocas.tasks.corridor import Corridor
from orthocas.tasks.metric import Metric
from orthocas.tasks.samples import sample_problem, sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array


@cache
def planar(metric: str = "inertia") -> oc.Problem:
    known = problems.get("planar_3r_x")
    return oc.Problem(known.robot, known.task, metric, known.domain, "planar_3r_x")


@cache
def fitted() -> Fit:
    return oc.fit(planar(), oc.Polynomial(degree=3), samples=500)


@cache
def linear() -> oc.Chart:
    return oc.fit(planar(), oc.Linear()).chart


@cache
def network() -> oc.Chart:
    return oc.fit(planar(), oc.MLP((6, 6)), solvers.LBFGS(max_iterations=10), samples=300).chart


@cache
def partly_linear() -> oc.Chart:
    """A network of one joint; the base enters linearly, and the last joint not at all."""
    known = problems.get("planar_3r_xy")
    network = oc.MLP((6, 6), raw=True, cyclic=["q1"], without=["q3"], activation="isru")
    return oc.fit(known, network, solvers.LBFGS(max_iterations=10), samples=300).chart


@cache
def with_idle_joint() -> oc.Chart:
    known = problems.get("planar_3r_x")
    task = oc.Task.custom(known.robot, "bent", lambda q: ca.sin(q[0]) + q[2] ** 2 * q[0])
    return oc.fit(oc.Problem(known.robot, task, domain=oc.Box(known.domain.centre, 0.3)), oc.Polynomial(2)).chart


@cache
def given() -> oc.Chart:
    return oc.fit(planar(), oc.Given.from_function("hand", 3, lambda q: ca.vertcat(q[1], ca.sin(q[2])))).chart


@cache
def cyclic() -> oc.Chart:
    known = problems.get("planar_3r_xy")
    return oc.fit(known, oc.Polynomial(2, cyclic="auto"), samples=300).chart


@cache
def clear() -> oc.Chart:
    known = problems.get("planar_3r_xy")
    problem = oc.Problem(known.robot, known.task, domain=known.domain, least_singular_value=0.1)
    return oc.fit(problem, oc.Polynomial(2), samples=300).chart


HAS_COMPILER = any(shutil.which(name) for name in ("gcc", "clang", "cc"))
_LIBRARIES = TemporaryDirectory()  # until this process ends: copies in others load from it


@cache
def compiled() -> Any:
    """The inverse of a chart with r = 1 and a condition in compiled C."""
    return oc.compile_inverse(clear(), _LIBRARIES.name)


BENT = oc.Box([0.0, 1.3, 1.3], [3.0, 1.2, 1.2])


@cache
def wide() -> WideFit:
    known = problems.get("planar_3r_xy")
    return oc.fit_wide(known.robot, known.task, BENT, parametrisation=oc.Polynomial(3, ["q1"]))


BENT_POSTURE = np.array([0.3, 0.9, 0.8])


@cache
def arm() -> oc.Arm:
    return oc.Arm(wide().chart.problem.task, (wide().chart,))


def hand_direction(q: ca.SX) -> ca.SX:
    """The angle of the last link, which jumps by whole turns."""
    return ca.atan2(ca.sin(ca.sum1(q)), ca.cos(ca.sum1(q)))


@cache
def exact() -> WideFit:
    known = problems.get("planar_3r_xy")
    return oc.fit_wide(known.robot, known.task, BENT, like=hand_direction, exact=True)


@cache
def suggestion() -> Any:
    known = problems.get("planar_3r_xy")
    parametrisation = oc.Polynomial(2, cyclic="auto")
    return oc.suggest_domain(known.robot, known.task, known.domain.centre, parametrisation=parametrisation)


@cache
def ring() -> oc.Chart:
    """Circle-valued coordinates on the torus."""
    solver = solvers.LBFGS(max_iterations=10)
    return oc.fit(problems.get("planar_2r"), oc.Circle(oc.Fourier(1)), solver, samples=200).chart


@cache
def circle() -> oc.Chart:
    return oc.grow(problems.get("planar_2r"), 1.0, origin=[np.pi / 3, 0.0])


@cache
def disk() -> oc.Chart:
    problem = oc.Problem(
        planar().robot, planar().task, "euclidean", oc.Box([np.pi / 2, 0, 0], [np.pi / 2, np.pi, np.pi])
    )
    return oc.grow(problem, 0.0, cells=20)


@cache
def on_planes() -> oc.Chart:
    return oc.grow(planar("euclidean"), leaf="linear")


@cache
def impedance() -> control.Impedance:
    return control.Impedance(fitted().chart, 60.0, limit=90.0)


@cache
def second() -> oc.Task:
    """A second task for projectors."""
    return oc.Task.custom(planar().robot, "tilt", lambda q: q[0] + q[1] + q[2])


@cache
def steps() -> Reference:
    phi = fitted().chart.phi(planar().domain.centre)
    return Reference.steps(fitted().chart.labels, phi, [(0.1, {"x": float(phi[0]) + 0.02})], 0.5)


@cache
def trajectory() -> Trajectory:
    return simulate(impedance(), steps(), planar().domain.centre, step=0.05)


@cache
def distilled() -> Any:
    return oc.distil(on_planes(), oc.Polynomial(3), samples=200)


@cache
def comparison() -> Comparison:
    return oc.compare(planar(), [oc.Linear(), oc.Polynomial(1)], samples=200, held_out=500, jobs=1)


def generated_c() -> Any:
    with TemporaryDirectory() as folder:
        return oc.generate_c(fitted().chart, Path(folder) / "c")


@cache
def branches() -> Branches:
    return oc.branches(problems.get("iiwa").robot)


@cache
def certificate() -> Certificate:
    return oc.certify(fitted().chart)


@cache
def joint_motion() -> paths.JointMotion:
    x = fitted().chart.x(planar().domain.centre)
    return oc.follow(fitted().chart, [x, x + 0.05, x], velocity_limits=1.0, period=0.05)


def collisions() -> Collisions:
    """Balls on the base and on two links, and a scene."""
    ball = Shape(BallGeometry(0.1), np.eye(3), np.zeros(3))
    parts = [Part(f"link{body}", body, ball) for body in (-1, 1, 2)]
    return Collisions(planar().robot.tree, parts, [("link-1", "link2")]).with_scene(scene())


def scene() -> oc.Scene:
    cloud = oc.obstacles.PointCloud([[1.5, 0.0, 0.0], [1.5, 0.5, 0.0]], 0.1)
    return oc.Scene({"box": oc.obstacles.Box([0.2, 0.2, 0.2], [0.0, 2.0, 0.0]), "mesh": mesh(), "cloud": cloud})


def mesh() -> oc.obstacles.Mesh:
    return oc.obstacles.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [3.0, 0.0, 0.0], scale=0.3)


def run_time_model() -> control.RunTimeModel:
    return control.RunTimeModel(payload=1.0, wrench=np.zeros(6), extra_torque=0.1)


CHARTS: dict[str, Callable[[], oc.Chart]] = {
    "certified chart": lambda: replace(fitted().chart, certificate=certificate()),
    "polynomial chart": lambda: fitted().chart,
    "linear chart": lambda: oc.fit(planar(), oc.Linear()).chart,
    "Fourier chart": lambda: oc.fit(planar(), oc.Fourier(1), samples=300).chart,
    "circle-valued chart": ring,
    "network chart": network,
    "network beside linear joints": partly_linear,
    "given chart": given,
    "chart with an idle joint": with_idle_joint,
    "cyclic chart": cyclic,
    "chart of a clear box": clear,
    "wide chart": lambda: wide().chart,
    "wide chart of an exact quantity": lambda: exact().chart,
    "circle chart": circle,
    "disk chart": disk,
    "linear leaf chart": on_planes,
}
CONTROLLERS: dict[str, Callable[[], Controller]] = {
    "impedance": impedance,
    "PD+": lambda: control.PDPlus(fitted().chart, 60.0, coupling="decoupled", damping="double_diagonal"),
    "PD+ with inputs": lambda: control.PDPlus(fitted().chart, 60.0, damping_stiffness=50.0, model=run_time_model()),
    "PD+ of a given model": lambda: control.PDPlus(fitted().chart, 60.0, model=control.RunTimeModel("given", "robot")),
    "PD+ with a memory": lambda: control.PDPlus(fitted().chart, 60.0, limit=50.0, remembers=control.MomentumObserver()),
    "PD+ that adapts": lambda: control.PDPlus(fitted().chart, 60.0, limit=50.0, remembers=control.Adaptation()),
    "PD+ of a network": lambda: control.PDPlus(network(), 60.0),
    "kinematic": lambda: control.Kinematic(fitted().chart, 1.0),
}
OBJECTS: dict[str, Callable[[], Any]] = {
    **CHARTS,
    **CONTROLLERS,
    "certificate": certificate,
    "card of a ready chart": lambda: oc.charts.card("ur5-position"),
    "fit": fitted,
    "robot": lambda: planar().robot,
    "task": lambda: planar().task,
    "run-time model": run_time_model,
    "momentum observer": control.MomentumObserver,
    "friction observer": control.FrictionObserver,
    "ticks of a law without a memory": lambda: control.Remembering(control.Kinematic(fitted().chart, 1.0)),
    "law in ticks": lambda: control.Remembering(CONTROLLERS["PD+ with a memory"]()),
    **({"compiled inverse": compiled} if HAS_COMPILER else {}),
    "safety": lambda: control.Safety.of(impedance(), fade_in=0.1),
    "modes": lambda: impedance().modes(),
    "custom task": lambda: with_idle_joint().problem.task,
    "inertia metric": lambda: planar().metric,
    "custom metric": lambda: Metric.from_spec(planar().robot, lambda q: ca.diag(2 + ca.cos(q))),
    "problem": planar,
    "check of a problem": lambda: oc.check(planar(), 100),
    "box": lambda: planar().domain,
    "unbounded box": lambda: cyclic().problem.domain,
    "clear box": lambda: clear().problem.domain,
    "regular part": lambda: wide().chart.problem.domain,
    "wide fit": wide,
    "regular part of an exact quantity": lambda: exact().chart.problem.domain,
    "wide fit of an exact quantity": exact,
    "branches": branches,
    "branch": lambda: branches()[0],
    "corridor": lambda: Corridor(oc.Box([0.0, 0.9], 0.8), [[0.0, 0.5], [0.3, 1.2]], [np.inf, 0.2]),
    "clear part of a domain": lambda: ClearPart(0.1, 0.95),
    "torus": lambda: oc.Torus(3),
    "suggestion of a domain": suggestion,
    "width of a joint": lambda: suggestion().joints[0],
    "polynomial": lambda: oc.Polynomial(3),
    "cyclic polynomial": lambda: oc.Polynomial(3, cyclic="auto"),
    "sparse polynomial": lambda: oc.Polynomial(3, joints=2),
    "linear": oc.Linear,
    "Fourier": lambda: oc.Fourier(2),
    "network": oc.MLP,
    "circle-valued": lambda: oc.Circle(oc.Fourier(2)),
    "task of a frame in another": lambda: oc.Task.relative_pose(planar().robot, "tip", "tip"),
    "stacked tasks": lambda: oc.Task.stack(oc.Task.position(planar().robot, "x"), oc.Task.axis(planar().robot)),
    "fit with a meaning": lambda: oc.fit(planar(), oc.Polynomial(1), like="q3", samples=200),
    "robot on a rail": lambda: oc.Robot(place_on_base(planar().robot.tree, "rail:x", 1.0, np.zeros(3), np.eye(3))),
    "robot that floats": lambda: oc.Robot(
        place_on_base(planar().robot.tree, "floating:xy", 1.0, np.zeros(3), np.eye(3))
    ),
    "task of a quadratic program": lambda: oc.control.XiTask(fitted().chart, cost=1.0),
    "mobile": lambda: oc.Mobile(oc.Polynomial(2)),
    "SEW": oc.SEW,
    "given coordinates": lambda: given().coordinates.parametrisation,  # type: ignore[attr-defined]
    "solver": solvers.GaussNewton,
    "quasi-Newton solver": solvers.QuasiNewton,
    "samples": lambda: sample_problem(planar(), 20, 0),
    "report": lambda: oc.evaluate(fitted().chart, 500),
    "quality of a point": lambda: fitted().chart.quality(planar().domain.centre),
    "quality of points": lambda: fitted().chart.quality(points_of(fitted().chart)),
    "range of coordinates": lambda: fitted().chart.xi_range(planar().domain.centre),
    "interval": lambda: fitted().chart.xi_range(planar().domain.centre)["xi1"],
    "joint motion": joint_motion,
    "margins": lambda: joint_motion().margins,
    "sphere": lambda: oc.obstacles.Sphere([0.5, 0.0, 0.5], 0.1),
    "capsule": lambda: oc.obstacles.Capsule([0.5, 0.0, 0.0], [0.5, 0.0, 1.0], 0.1),
    "plane": lambda: oc.obstacles.Plane([0.0, 0.0, 1.0], [0.0, 0.0, -0.1]),
    "solid box": lambda: oc.obstacles.Box([0.2, 0.2, 0.2], [0.0, 2.0, 0.0]),
    "mesh": mesh,
    "point cloud": lambda: oc.obstacles.PointCloud([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 0.1),
    "scene": scene,
    "collisions": collisions,
    "capsules": lambda: oc.fit_capsules(Collisions(planar().robot.tree, collisions().parts[:3], ())),
    "near pairs": lambda: collisions().find_near(np.zeros(3), 5.0),
    "least distance": lambda: collisions().distance(np.linspace(-1, 1, 6).reshape(2, 3)),
    "self-motion": lambda: fitted().chart.self_motion(planar().domain.centre, samples=30),
    "self-motion curve": lambda: cyclic().self_motion(cyclic().problem.domain.centre),
    "solutions": lambda: fitted().chart.solve([[1.6, 0.1, 0.1], [9.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]),
    "tracker": lambda: fitted().chart.tracker(planar().domain.centre),
    "tracker with collisions": lambda: fitted().chart.tracker(
        planar().domain.centre, collisions=collisions(), margin=0.001, avoid=0.002
    ),
    "arm": arm,
    "arm without charts": lambda: oc.Arm(problems.get("planar_3r_xy").task),
    "postures of an arm": lambda: arm().solve(arm().x(BENT_POSTURE), start=BENT_POSTURE),
    "self-motions of an arm": lambda: arm().self_motion(arm().x(BENT_POSTURE)),
    "arc of an arm": lambda: arm().self_motion(arm().x(BENT_POSTURE)).components[0],
    "tracker of an arm": lambda: arm().tracker(BENT_POSTURE),
    "nearest tracker": lambda: fitted().chart.tracker(planar().domain.centre, nearest=True),
    "involutivity": lambda: oc.involutivity(planar(), 100),
    "distilled": distilled,
    "steps": steps,
    "spline": lambda: Reference.through(("a", "b"), [0.0, 1.0, 2.0], [[0.0, 1.0], [1.0, 0.5], [0.0, 2.0]]),
    "damping check": lambda: impedance().check_damping(50),
    "trajectory": trajectory,
    "coupling": lambda: coupling_index(fitted().chart, steps(), trajectory()),
    "push": lambda: Push(0.5, 1.0, [1.0, 0.0, 0.0]),
    "push at a link": lambda: Push(0.5, 1.0, [1.0, 0.0, 0.0], link="q2", point=[0.5, 0.0, 0.0]),
    "friction": lambda: Friction([1.0, 2.0, 3.0]),
    "stops": lambda: Stops([1e4, 2e4, 3e4]),
    "elasticity": lambda: Elasticity([8000.0, 5000.0], [0.4, 0.2], 5.0),
    "payload": lambda: Payload(1.0, [0.0, 0.0, 0.1], np.diag([0.1, 0.2, 0.25])),
    "wall": lambda: Wall([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]),
    "MuJoCo": lambda: MuJoCo(planar().robot, payload=Payload(1.0), wall=Wall([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0])),
    "noise": lambda: Noise(1e-3),
    "comparison": comparison,
    "generated C": generated_c,
}


def numbers(thing: Any) -> list[Array]:
    """Everything that can be computed with an object, and all numbers and words it holds."""
    return [np.asarray(part) for part in _numbers(thing)]


def points_of(chart: oc.Chart) -> Array:
    """Joint positions near the middle of the domain, (6, n)."""
    domain = chart.problem.domain
    return np.asarray(domain.centre + 0.2 * domain.half_width * np.random.default_rng(3).uniform(-1, 1, (6, chart.n)))


def states_of(law: Controller) -> list[Array]:
    """Inputs of a controller at four states, (4, .) each."""
    rng = np.random.default_rng(4)
    n, k, domain = law.problem.n, len(law.labels), law.problem.domain
    q = domain.centre + 0.2 * domain.half_width * rng.uniform(-1, 1, (4, n))
    wanted = Batched(law.measured)(q)[0] + 1e-2
    gains = [np.tile(gain, (4, 1)) for gain in law.gains.values()]
    return [q, rng.normal(size=(4, n)), wanted, *rng.normal(size=(2, 4, k)), *gains]


@singledispatch
def _numbers(thing: Any) -> Iterator[Any]:
    """Of data: what it holds."""
    if is_dataclass(thing):
        yield type(thing).__name__
        for part in fields(thing):
            yield from _numbers(getattr(thing, part.name))
    elif isinstance(thing, tuple | list | dict):
        for part in thing.values() if isinstance(thing, dict) else thing:
            yield from _numbers(part)
    elif thing is not None:
        yield str(thing) if isinstance(thing, Path | Enum) else thing


@_numbers.register
def _of_chart(chart: oc.Chart) -> Iterator[Any]:
    q = points_of(chart)
    phi = chart.phi(q)
    yield from (phi, chart.xi(q[0]), chart.jacobian(q), chart.labels, str(dict(chart.notes)))
    known = np.isfinite(phi).all(axis=1)
    yield chart.inverse(phi[known], q[known] + 1e-3)
    if not isinstance(chart, GrownChart):
        yield from (np.asarray(chart.function(name)(q[0])) for name in ("xi", "phi", "jacobian"))


@_numbers.register
def _of_compiled(inverse: CompiledInverse) -> Iterator[Any]:
    q = points_of(inverse.chart)
    x, wishes = inverse.chart.x(q), q[::-1] + 2.0
    for solutions in (inverse.solve(inverse.chart.phi(q)), inverse.nearest_xi(wishes, x)):
        yield from (solutions.q, solutions.status)


@_numbers.register
def _of_tracker(tracker: Tracker) -> Iterator[Any]:
    q = tracker.q
    yield from (q, tracker.step(fitted().chart.phi(q) + 1e-3), tracker.status, tracker.largest_step)
    tracker.reset(q)


@_numbers.register
def _of_arm(arm: oc.Arm) -> Iterator[Any]:
    x = arm.x(BENT_POSTURE)
    yield from (x, arm.branch_names, arm.robot.joint_names, arm.solve([x, x + 0.1], start=BENT_POSTURE).q)
    if arm.charts:
        yield arm.solve(x, 0.1).q


@_numbers.register
def _of_motions(motions: SelfMotions) -> Iterator[Any]:
    yield from (motions.x, motions.length, motions.curves)
    for arc in motions:
        yield from _numbers(arc)


@_numbers.register
def _of_arc(arc: Arc) -> Iterator[Any]:
    yield from (arc.target, arc.q, arc.at(0.3), arc.length, arc.closed, *map(str, arc.ends))


@_numbers.register
def _of_arm_tracker(tracker: ArmTracker) -> Iterator[Any]:
    mine, x = copy.deepcopy(tracker), arm().x(BENT_POSTURE)
    yield from (mine.q, mine.step(x + 1e-3), mine.step(x + 9.0), mine.status, mine.xi, mine.branch)


@_numbers.register
def _of_robot(robot: oc.Robot) -> Iterator[Any]:
    q = np.linspace(-1, 1, 2 * robot.n).reshape(2, robot.n)
    yield from (robot.joint_names, robot.mass_matrix(q), robot.bias(q, q), robot.tip_position(q), robot.upper)


@_numbers.register
def _of_task(task: oc.Task) -> Iterator[Any]:
    q = np.linspace(-1, 1, 2 * task.robot.n).reshape(2, task.robot.n)
    yield from (task.name, task.labels, task.batched(q)[0], task.batched_jacobian(q)[0])


@_numbers.register
def _of_problem(problem: oc.Problem) -> Iterator[Any]:
    yield from (*_numbers(problem.task), *_numbers(problem.robot), *_numbers(problem.domain), problem.name)
    yield problem.metric.evaluate(sample_uniform(problem.domain, 5, 0))


@_numbers.register
def _of_domain(domain: oc.Box | oc.Torus) -> Iterator[Any]:
    yield from (domain.name, sample_uniform(domain, 5, 0))


@_numbers.register
def _of_collisions(found: Collisions) -> Iterator[Any]:
    yield from (found.pairs, found.distance(np.linspace(-1, 1, 6).reshape(2, 3)).distance)


@_numbers.register
def _of_scene(found: oc.Scene) -> Iterator[Any]:
    yield from found.facts().items()


@_numbers.register
def _of_reference(reference: Reference) -> Iterator[Any]:
    yield from (*reference.sample(reference.grid()), reference.labels)


@_numbers.register
def _of_ticks(ticks: control.Remembering) -> Iterator[Any]:
    mine, q = copy.deepcopy(ticks), planar().domain.centre  # threads share the object, and each tick changes it
    for _ in range(3):
        yield mine.tick(q, 0.1 + 0 * q, np.zeros((3, 3)), 1e-3)[0]
    yield from mine.fields.values()


class _Configuration:
    """What MuJoCo and mink show of a robot, for `XiTask`."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.nv, self.njnt, self.model = names, len(names), len(names), self
        self.q = np.linspace(0.6, 0.8, self.nv)

    def joint(self, which: str | int) -> Any:
        k = which if isinstance(which, int) else self.names.index(which)
        return SimpleNamespace(name=self.names[k], qposadr=np.array([k]), dofadr=np.array([k]))


@_numbers.register
def _of_xi_task(task: oc.control.XiTask) -> Iterator[Any]:
    configuration = _Configuration(task.joints)
    task.set_target(np.zeros(task.chart.r))
    yield from (*task.compute_qp_objective(configuration), task.cost, task.gain, task.lm_damping, task.joints)


@_numbers.register
def _of_function(function: ca.Function) -> Iterator[Any]:
    yield from (np.asarray(out) for out in function.call([0.1] * function.n_in()))


def _of_controller(law: Controller) -> Iterator[Any]:
    states = states_of(law)
    yield from (law.name, law.labels, *Batched(law.function)(*states))
    if law.energy is not None:
        yield from Batched(law.energy)(*states)


for _law in (control.Impedance, control.PDPlus, control.Kinematic):
    _numbers.register(_law, _of_controller)
