"""Actions in joints, in x, and in (x, xi): what imitation and reinforcement learning make of each, on three tasks.

A panda in MuJoCo, with position servos, 25 actions a second, and demonstrations by two experts that use the redundancy
differently: one moves xi to a value and the other pushes the elbow and pulls to a posture in the null space of the
tool. Policies see the same observations; their actions are changes of

- q: the joints,
- x, least norm: the tool's pose, by the pseudo-inverse,
- x, posture: the same, and a pull to the home posture in the null space,
- (x, xi): the tool's pose and the elbow, by the inverse of the wide chart.

Behaviour cloning fits a network (64, 64) to 48 demonstrations. Reinforcement learning is augmented random search (ARS,
version 2, [MGR2018]) on linear policies, from zero. All settings are the same for all action spaces.

    python benchmarks/learning_study.py                 # 10 seeds
    python benchmarks/learning_study.py --quick         # 1 seed, 1 task, a few iterations
    python benchmarks/learning_study.py --out FOLDER    # keeps each part, and resumes
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
from batches import exported

import orthocas as oc
from orthocas.tools.checks import Array

Part = dict[str, Any]
HOME = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.0])  # hand down, elbow up
PERIOD, SUBSTEPS, STEPS = 0.04, 10, 50  # [s], of physics in an action, actions in an episode
LARGEST = np.array([0.02] * 3 + [0.06] * 3)  # change of x by an action of 1 [m], [rad]
LARGEST_Q, LARGEST_XI, PULL = 0.08, 0.08, 0.1  # [rad], [rad], of the way to the posture in each action
STIFFNESS, DAMPING = (600.0,) * 4 + (300.0, 300.0, 150.0), (45.0,) * 4 + (15.0, 15.0, 8.0)  # [N m/rad], [N m s/rad]
ELBOW, OBSTACLE, PEG, PEG_RADIUS = 0.05, 0.04, 0.10, 0.01  # radii, length and radius [m]
HOLE, DEPTH = 0.016, 0.04  # half of its width, and how deep the peg goes [m]
FORCE = 10.0  # wanted in wiping [N]
NEAR_LIMIT = 0.01  # [rad]
DEMONSTRATIONS, TESTS, GROUP = 48, 32, 8  # episodes of a seed; starts with the same goal
UPDATES, BATCH, RATE = 800, 128, 3e-3  # of behaviour cloning
ITERATIONS, DIRECTIONS, BEST, STEP, NOISE = 60, 8, 4, 0.03, 0.05  # of ARS
CHECK_EVERY, CHECKS = 10, 16  # iterations, and episodes of a check


def scene(robot: oc.Robot) -> Any:
    """The arm with a peg in its hand, an obstacle for its elbow, a table and a hole; what is not used is far away."""
    tree, spec = robot.tree, mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = (0.0, 0.0, 0.0)  # the motors compensate it
    spec.option.timestep, spec.option.integrator = PERIOD / SUBSTEPS, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body = spec.worldbody
    for k in range(tree.n):
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, tree.rotations[k].ravel())
        body = body.add_body(name=f"body{k}", pos=tree.translations[k], quat=quaternion)
        body.explicitinertial, body.mass, body.ipos = True, tree.masses[k], tree.centres[k]
        body.fullinertia = tree.inertias[k][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        body.add_joint(name=f"joint{k}", axis=(0, 0, 1), range=(tree.lower[k], tree.upper[k]), armature=0.1)
        motor = spec.add_actuator(name=f"motor{k}", target=f"joint{k}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_position(kp=STIFFNESS[k], kv=DAMPING[k])
        if k == 3:
            body.add_geom(name="elbow", size=(ELBOW, 0, 0), contype=2, conaffinity=2, mass=0)
    tip = np.zeros(4)
    mujoco.mju_mat2Quat(tip, tree.tip_rotation.ravel())
    hand = body.add_body(name="hand", pos=tree.tip_translation, quat=tip)
    capsule, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
    hand.add_geom(type=capsule, fromto=(0, 0, 0, 0, 0, PEG - PEG_RADIUS), size=(PEG_RADIUS, 0, 0), mass=0.05)
    hand.add_site(name="end", pos=(0, 0, PEG - PEG_RADIUS), size=(2 * PEG_RADIUS, 0, 0))
    touch = spec.add_sensor(name="force", type=mujoco.mjtSensor.mjSENS_TOUCH, objname="end")
    touch.objtype = mujoco.mjtObj.mjOBJ_SITE
    obstacle = spec.worldbody.add_body(name="obstacle", mocap=True)
    obstacle.add_geom(size=(OBSTACLE, 0, 0), contype=2, conaffinity=2)
    table = spec.worldbody.add_body(name="table", mocap=True)
    plane, slippery = mujoco.mjtGeom.mjGEOM_PLANE, (0.1, 0.005, 0.0001)
    pad = table.add_geom(type=plane, quat=(0, 1, 0, 0), size=(0.5, 0.5, 0.1), friction=slippery, solref=(0.05, 1.0))
    pad.solimp, pad.priority = (0.01, 0.9, 0.01, 0.5, 2.0), 1  # gives way: a rigid one chatters
    hole, wide = spec.worldbody.add_body(name="hole", mocap=True), 0.03
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        size = (wide if x else HOLE, wide if y else HOLE + 2 * wide, DEPTH)
        place = (x * (HOLE + wide), y * (HOLE + wide), DEPTH)
        hole.add_geom(type=box, pos=place, size=size, friction=slippery)
    return spec.compile()


@dataclass(frozen=True, eq=False)
class Arm:
    """The chart, its exported module, and the scene."""

    chart: oc.Chart
    module: Any
    model: Any

    def elbow(self, q: Array) -> Array:
        """Places of elbows, (N, 3), of joints (N, n)."""
        points = self.chart.problem.robot.function("joint_points").map(len(q))(q.T)
        return np.array(points).reshape(3, len(q), -1)[:, :, 4].T

    def swivel(self, q: Array) -> Array:
        """dq/dxi where x stays, (N, n)."""
        return np.asarray(np.linalg.inv(self.module.jacobian(q))[:, :, -1])

    def moved(self, q: Array, phi: Array) -> Array:
        """Joints with other phi, from q; where there are none, q."""
        there, status = self.module.inverse(phi, q)
        return np.where((status == self.module.FOUND)[:, None], there, q)


@dataclass(eq=False)
class Conditions:
    """What differs between episodes: N rows."""

    start: Array  #: joints (N, n)
    goal: Array  #: wanted task values (N, 6); in wiping the middle of the path
    point: Array  #: the obstacle, or the wished place of the elbow (N, 3) [m]
    side: Array  #: to which side the elbow goes: sign of the change of xi (N,)

    def rows(self, k: Any) -> "Conditions":
        """Some of them."""
        return Conditions(self.start[k], self.goal[k], self.point[k], self.side[k])


def joined(parts: list[Conditions]) -> Conditions:
    """One after the other."""
    return Conditions(*(np.concatenate([getattr(part, name) for part in parts]) for name in Conditions.__annotations__))


# --- tasks


def drawn(arm: Arm, rng: Any, count: int, goal: tuple[Array, float], turn: float) -> tuple[Array, Array]:
    """Starts (N, n) and goals (N, 6) around home."""
    home = arm.chart.phi(HOME)
    start = home + rng.uniform(-1, 1, (count, 7)) * np.r_[[0.05] * 3, [0.1] * 3, 0.4]
    offset, turned = goal[0] * rng.uniform(-1, 1, (count, 3)), turn * rng.uniform(-1, 1, (count, 3))
    offset[:, 2] += goal[1]
    return arm.moved(np.tile(HOME, (count, 1)), start), home[:6] + np.hstack([offset, turned])


def along_least_norm(arm: Arm, q: Array, goal: Array) -> list[Array]:
    """Ten steps of resolved rates of least norm to the goal, (N, n) each."""
    way = [q]
    for share in 1 / np.arange(10, 0, -1):
        way.append(way[-1] + least_norm(arm, way[-1], share * (goal - arm.module.task(way[-1]))))
    return way


def at_goal(arm: Arm, q: Array, goal: Array) -> Array:
    """Joints at the goal, (N, n)."""
    q = along_least_norm(arm, q, goal)[-1]
    return arm.moved(q, np.hstack([goal, arm.chart.xi(q)]))


def least_norm(arm: Arm, q: Array, dx: Array) -> Array:
    """J^+ dx, (N, n)."""
    return np.asarray((np.linalg.pinv(arm.module.jacobian(q)[:, :6]) @ dx[:, :, None])[:, :, 0])


class Reach:
    """A pose; where a motion of least norm ends, the elbow would touch an obstacle."""

    name = "reach"
    lead = 0  #: by how many actions the reference of observations is ahead

    def conditions(self, arm: Arm, rng: Any, count: int) -> Conditions:
        """Obstacles in the way of the elbow at the end, which it can pass if xi moves in time."""
        found: list[Conditions] = []
        while sum(len(part.side) for part in found) < count:
            start, goal = drawn(arm, rng, 6 * count, (np.array([0.10, 0.22, 0.10]), 0.0), 0.2)
            way, side = along_least_norm(arm, start, goal), rng.choice([-1.0, 1.0], 6 * count)
            end, elbow = way[-1], arm.elbow(way[-1])
            away = arm.elbow(end - 0.1 * side[:, None] * arm.swivel(end)) - elbow
            point = elbow + 0.06 * away / np.linalg.norm(away, axis=1, keepdims=True)
            around = [
                arm.elbow(q + min(1.0, k / 4) * 0.5 * side[:, None] * arm.swivel(q)) - point for k, q in enumerate(way)
            ]
            clear = np.linalg.norm(around, axis=2).min(axis=0) > ELBOW + OBSTACLE + 0.02
            found.append(Conditions(start, goal, point, side).rows(clear))
        return joined(found).rows(slice(count))

    def wish(self, arm: Arm, c: Conditions) -> Array:
        """xi at the goal, for the first expert."""
        end = along_least_norm(arm, c.start, c.goal)[-1]
        return np.asarray(arm.chart.xi(end)[:, 0] + 0.5 * c.side)

    def place(self, data: Any, c: Conditions, k: int, hand: Array) -> None:
        """The scene of episode k."""
        data.mocap_pos[0] = c.point[k]

    def reference(self, c: Conditions, t: int) -> Array:
        """Wanted task values, (N, 6)."""
        return c.goal

    def eased(self, error: Array, force: Array) -> Array:
        """Errors that the experts reduce."""
        return error

    def push(self, arm: Arm, elbow: Array, point: Array) -> Array:
        """Where the second expert pushes the elbow, (N, 3)."""
        away = elbow - point
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        return np.asarray(away / distance * np.clip(0.16 - distance, 0, None) * 2)

    def bad(self, elbow: Array, point: Array, force: Array, error: Array) -> Array:
        """Whether a step spoils the episode, (N,)."""
        return np.asarray(np.linalg.norm(elbow - point, axis=1) < ELBOW + OBSTACLE + 0.001)

    def reward(self, error: Array, elbow: Array, point: Array, force: Array) -> Array:
        """Of a step, (N,)."""
        return -_size(error) - 1.0 * self.bad(elbow, point, force, error)

    def success(self, errors: Array, elbows: Array, point: Array, forces: Array) -> Array:
        """Of episodes, (N,): errors (T, N, 6), elbows (T, N, 3), forces (T, N)."""
        touched = np.any([self.bad(e, point, f, x) for e, f, x in zip(elbows, forces, errors, strict=True)], axis=0)
        return _arrived(errors[-1]) & ~touched


class Insert(Reach):
    """A peg into a hole, the elbow turned to a wished place."""

    name = "insert"

    def conditions(self, arm: Arm, rng: Any, count: int) -> Conditions:
        """Holes below the hand, and elbows to both sides."""
        start, goal = drawn(arm, rng, count, (np.array([0.06, 0.10, 0.02]), -0.16), 0.1)
        at = at_goal(arm, start, goal)
        at = arm.moved(at, np.hstack([goal, arm.chart.xi(HOME) + rng.uniform(-0.6, 0.6, (count, 1))]))
        return Conditions(start, goal, arm.elbow(at), np.sign(arm.chart.xi(at)[:, 0] - arm.chart.xi(HOME)))

    def wish(self, arm: Arm, c: Conditions) -> Array:
        """xi where the elbow is nearest to its wished place."""
        q = at_goal(arm, c.start, c.goal)
        for _ in range(6):
            v = arm.swivel(q)
            along = (arm.elbow(q + 1e-4 * v) - arm.elbow(q)) / 1e-4
            step = ((c.point - arm.elbow(q)) * along).sum(axis=1) / (along**2).sum(axis=1)
            q = arm.moved(q, np.hstack([c.goal, arm.chart.xi(q) + np.clip(step, -0.3, 0.3)[:, None]]))
        return arm.chart.xi(q)[:, 0]

    def place(self, data: Any, c: Conditions, k: int, hand: Array) -> None:
        """The hole: the goal has the end of the peg DEPTH below its rim."""
        data.mocap_pos[2], data.mocap_quat[2] = hand[:3] + (PEG - DEPTH) * hand[3:6], hand[6:]

    def eased(self, error: Array, force: Array) -> Array:
        """Stay above the hole until the peg is over it."""
        over = np.clip(np.linalg.norm(error[:, :2], axis=1) / 0.008 - 0.5, 0, 1)
        return error + np.outer(over, [0, 0, DEPTH + 0.02, 0, 0, 0])

    def push(self, arm: Arm, elbow: Array, point: Array) -> Array:
        """Towards the wished place."""
        return 0.3 * (point - elbow)

    def bad(self, elbow: Array, point: Array, force: Array, error: Array) -> Array:
        """Elbow more than 3 cm from its place; counts at the end only."""
        return np.asarray(np.linalg.norm(elbow - point, axis=1) > 0.03)

    def reward(self, error: Array, elbow: Array, point: Array, force: Array) -> Array:
        """Of a step, (N,)."""
        return -_size(error) - np.linalg.norm(elbow - point, axis=1) / 0.2

    def success(self, errors: Array, elbows: Array, point: Array, forces: Array) -> Array:
        """In the hole at the end, and the elbow where it should be."""
        return _arrived(errors[-1]) & ~self.bad(elbows[-1], point, forces[-1], errors[-1])


class Wipe(Reach):
    """To and fro on a table with a force of 10 N."""

    name = "wipe"
    lead = 5

    def conditions(self, arm: Arm, rng: Any, count: int) -> Conditions:
        """Tables below the hand."""
        start, goal = drawn(arm, rng, count, (np.array([0.05, 0.06, 0.02]), -0.08), 0.0)
        return Conditions(start, goal, arm.elbow(start), np.zeros(count))

    def wish(self, arm: Arm, c: Conditions) -> Array:
        """The elbow stays."""
        return arm.chart.xi(c.start)[:, 0]

    def place(self, data: Any, c: Conditions, k: int, hand: Array) -> None:
        """The table, below the end of the peg."""
        data.mocap_pos[1], data.mocap_quat[1] = hand[:3] + PEG * hand[3:6], hand[6:]

    def reference(self, c: Conditions, t: int) -> Array:
        """A path of 10 cm, there and back in an episode."""
        return c.goal + 0.05 * np.sin(2 * np.pi * t / STEPS) * np.eye(6)[1]

    def eased(self, error: Array, force: Array) -> Array:
        """Press."""
        return error + np.outer(0.006 * np.clip((force - FORCE) / FORCE, -1, 1), np.eye(6)[2])

    def push(self, arm: Arm, elbow: Array, point: Array) -> Array:
        """The elbow is free."""
        return np.zeros_like(elbow)

    def reward(self, error: Array, elbow: Array, point: Array, force: Array) -> Array:
        """Of a step, (N,)."""
        lateral = np.linalg.norm(error[:, :2], axis=1) / 0.05
        return -np.clip(lateral, 0, 4) - _size(error) / 2 - np.clip(np.abs(force - FORCE) / FORCE, 0, 2) / 2

    def success(self, errors: Array, elbows: Array, point: Array, forces: Array) -> Array:
        """After a fifth of the time: 5 to 20 N in four steps of five, and the path to 1 cm rms."""
        some = slice(STEPS // 5, None)
        pressed = ((forces[some] > 5) & (forces[some] < 20)).mean(axis=0) >= 0.8
        return pressed & (np.sqrt((errors[some, :, :2] ** 2).sum(axis=2).mean(axis=0)) < 0.01)


def _size(error: Array) -> Array:
    return np.asarray(np.linalg.norm(error[:, :3], axis=1) / 0.1 + np.linalg.norm(error[:, 3:], axis=1) / 1.0)


def _arrived(error: Array) -> Array:
    return np.asarray((np.linalg.norm(error[:, :3], axis=1) < 0.01) & (np.linalg.norm(error[:, 3:], axis=1) < 0.1))


TASKS = (Reach(), Wipe(), Insert())


# --- action spaces: commands (N, n) that follow from actions (N, k), and actions that lead from one command to another


@dataclass(frozen=True)
class Space:
    """An action space."""

    name: str
    size: int
    apply: Callable[[Arm, Array, Array], Array]  #: the arm, commands, actions -> commands
    label: Callable[[Arm, Array, Array], Array]  #: the arm, commands, next commands -> actions


def _in_q(arm: Arm, q: Array, a: Array) -> Array:
    return q + LARGEST_Q * a


def _in_x(arm: Arm, q: Array, a: Array) -> Array:
    return q + least_norm(arm, q, LARGEST * a)


def _in_x_posture(arm: Arm, q: Array, a: Array) -> Array:
    v = arm.swivel(q)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return _in_x(arm, q, a) + PULL * ((HOME - q) * v).sum(axis=1, keepdims=True) * v


def _in_phi(arm: Arm, q: Array, a: Array) -> Array:
    return arm.moved(q, arm.module.phi(q) + np.append(LARGEST, LARGEST_XI) * a)


def _label_x(arm: Arm, q: Array, after: Array) -> Array:
    return (arm.module.task(after) - arm.module.task(q)) / LARGEST


def _label_phi(arm: Arm, q: Array, after: Array) -> Array:
    return (arm.module.phi(after) - arm.module.phi(q)) / np.append(LARGEST, LARGEST_XI)


SPACES = (
    Space("q", 7, _in_q, lambda arm, q, after: (after - q) / LARGEST_Q),
    Space("x, least norm", 6, _in_x, _label_x),
    Space("x, posture", 6, _in_x_posture, _label_x),
    Space("(x, xi)", 7, _in_phi, _label_phi),
)


# --- episodes


class Episodes:
    """N episodes in lockstep."""

    def __init__(self, arm: Arm, task: Reach, c: Conditions) -> None:
        self.arm, self.task, self.c, self.t = arm, task, c, 0
        self.command, robot = c.start.copy(), arm.chart.problem.robot
        self.low, self.high = robot.lower, robot.upper
        self.q, self.force = c.start.copy(), np.zeros(len(c.start))
        self.data = [mujoco.MjData(arm.model) for _ in c.start]
        aside = mujoco.MjData(arm.model)
        at = at_goal(arm, c.start, c.goal)
        for k, data in enumerate(self.data):
            aside.qpos[:] = at[k]
            mujoco.mj_kinematics(arm.model, aside)
            hand = np.r_[aside.body("hand").xpos, aside.body("hand").xmat.reshape(3, 3)[:, 2], aside.body("hand").xquat]
            data.mocap_pos[:] = [[5, 5, k] for k in range(3)]
            task.place(data, c, k, hand)
            data.qpos[:], data.ctrl[:] = c.start[k], c.start[k]
            mujoco.mj_forward(arm.model, data)

    def error(self, lead: int = 0) -> Array:
        """Wanted task values, now or some actions ahead, less those that are, (N, 6)."""
        return np.asarray(self.task.reference(self.c, self.t + lead) - self.arm.module.task(self.q))

    def elbow(self) -> Array:
        """Places of the elbows, (N, 3)."""
        return np.array([data.xpos[4] for data in self.data])

    def observation(self) -> Array:
        """Joints, errors, the elbow and its point, the side, the force, xi, distance to limits, and phase, (N, 22)."""
        error, elbow = self.error(self.task.lead), self.elbow()
        distance = np.minimum(self.q - self.low, self.high - self.q).min(axis=1)
        return np.column_stack(
            [
                self.q - HOME,
                error / np.repeat([0.1, 0.3], 3),
                np.clip((self.c.point - elbow) / 0.1, -3, 3),
                self.c.side,
                np.clip(self.force / FORCE, 0, 4) - 1,
                self.arm.module.xi(self.q),
                distance,
                np.sin(2 * np.pi * self.t / STEPS) * np.ones(len(error)),
                np.cos(2 * np.pi * self.t / STEPS) * np.ones(len(error)),
            ]
        )

    def step(self, command: Array) -> None:
        """Hold commands for a period."""
        self.command = np.clip(command, self.low, self.high)
        for data, wanted in zip(self.data, self.command, strict=True):
            data.ctrl[:] = wanted
            mujoco.mj_step(self.arm.model, data, nstep=SUBSTEPS)
        self.q = np.array([data.qpos for data in self.data])
        self.force = np.array([data.sensordata[0] for data in self.data])
        self.t += 1

    def at_limit(self) -> Array:
        """Whether a joint is at its limit, (N,)."""
        return np.asarray(((self.q < self.low + NEAR_LIMIT) | (self.q > self.high - NEAR_LIMIT)).any(axis=1))


@dataclass
class Run:
    """What came of episodes."""

    success: Array  #: (N,)
    reward: Array  #: (N,), summed
    limit_hits: Array  #: share of steps (N,)
    q: Array  #: at the end (N, n)
    arrived: Array  #: whether the tool is within 2 cm at the end (N,)
    observations: list[Array] = field(default_factory=list)


def play(episodes: Episodes, act: Callable[[Array], Array], space: Space, steps: int = STEPS) -> Run:
    """Let a policy act."""
    errors, elbows, forces, hits, seen = [], [], [], [], []
    reward = np.zeros(len(episodes.q))
    for _ in range(steps):
        seen.append(episodes.observation())
        action = np.clip(act(seen[-1]), -1, 1)
        episodes.step(space.apply(episodes.arm, episodes.command, action))
        error, elbow = episodes.error(), episodes.elbow()
        reward += episodes.task.reward(error, elbow, episodes.c.point, episodes.force)
        for kept, value in ((errors, error), (elbows, elbow), (forces, episodes.force), (hits, episodes.at_limit())):
            kept.append(value)
    history = np.array(errors), np.array(elbows), episodes.c.point, np.array(forces)
    lateral = np.linalg.norm(error[:, : 2 if episodes.task.name == "wipe" else 3], axis=1)
    return Run(episodes.task.success(*history), reward, np.mean(hits, axis=0), episodes.q.copy(), lateral < 0.02, seen)


# --- demonstrations


def demonstrate(arm: Arm, task: Reach, c: Conditions, first: Array, rng: Any) -> tuple[Array, Array, Array, Array]:
    """Observations (T, N, o), commands and the next ones (T, N, n), and success (N,); rows `first` by the first expert.

    Commands that are held have noise, the next ones that are learned have none.
    """
    episodes, wish = Episodes(arm, task, c), task.wish(arm, c)
    seen, commands, after, errors, elbows, forces = [], [], [], [], [], []
    for _ in range(STEPS):
        error, elbow, q = episodes.error(task.lead), episodes.elbow(), episodes.command
        step = np.clip(0.25 * task.eased(error, episodes.force), -0.8 * LARGEST, 0.8 * LARGEST)
        change = np.clip(0.3 * (wish - arm.module.xi(q)[:, 0]), -0.6 * LARGEST_XI, 0.6 * LARGEST_XI)
        by_xi = arm.moved(q, arm.module.phi(q) + np.column_stack([step, change]))
        v = arm.swivel(q)
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        along = (arm.elbow(q + 1e-4 * v) - arm.elbow(q)) / 1e-4
        pushed = (task.push(arm, elbow, c.point) * along).sum(axis=1) / (along**2).sum(axis=1)
        pulled = 0.02 * ((HOME - q) * v).sum(axis=1)
        by_null_space = q + least_norm(arm, q, step) + np.clip(pushed + pulled, -0.05, 0.05)[:, None] * v
        wanted = np.where(first[:, None], by_xi, by_null_space)
        seen.append(episodes.observation())
        commands.append(q)
        after.append(wanted)
        episodes.step(wanted + 0.001 * rng.normal(size=q.shape))
        for kept, value in ((errors, episodes.error()), (elbows, episodes.elbow()), (forces, episodes.force)):
            kept.append(value)
    success = task.success(np.array(errors), np.array(elbows), c.point, np.array(forces))
    return np.array(seen), np.array(commands), np.array(after), success


# --- behaviour cloning, all seeds at once


def cloned(seen: Array, actions: Array, rng: Any, updates: int) -> Callable[[Array], Array]:
    """A policy of observations (S N, o), for each of S seeds a network fitted to (S, M, o) -> (S, M, k) by Adam."""
    seeds, rows, inputs = seen.shape
    mean, scale = seen.mean(axis=1, keepdims=True), seen.std(axis=1, keepdims=True) + 0.02
    sizes = (inputs, 64, 64, actions.shape[2])
    W = [rng.normal(size=(seeds, a, b)) / np.sqrt(a) for a, b in pairwise(sizes)]
    b = [np.zeros((seeds, 1, size)) for size in sizes[1:]]
    weights = [*W, *b]
    moments = [(np.zeros_like(w), np.zeros_like(w)) for w in weights]
    unit = (seen - mean) / scale

    def forward(x: Array) -> list[Array]:
        layers = [x]
        for k in range(3):
            x = layers[-1] @ weights[k] + weights[3 + k]
            layers.append(np.tanh(x) if k < 2 else x)
        return layers

    for update in range(1, updates + 1):
        some = rng.integers(rows, size=BATCH)
        layers = forward(unit[:, some])
        back, gradient = (layers[-1] - actions[:, some]) / BATCH, [np.zeros(0)] * 6
        for k in (2, 1, 0):
            gradient[k], gradient[3 + k] = layers[k].transpose(0, 2, 1) @ back, back.sum(axis=1, keepdims=True)
            back = (back @ weights[k].transpose(0, 2, 1)) * (1 - layers[k] ** 2) if k else back
        rate = RATE * min(1.0, 2 * (1 - update / (updates + 1)))
        for w, g, (m, s) in zip(weights, gradient, moments, strict=True):
            m[...] += 0.1 * (g - m)
            s[...] += 0.001 * (g * g - s)
            w[...] -= rate * (m / (1 - 0.9**update)) / (np.sqrt(s / (1 - 0.999**update)) + 1e-8)

    def act(observation: Array) -> Array:
        x = (observation.reshape(seeds, -1, inputs) - mean) / scale
        return forward(np.clip(x, -5, 5))[-1].reshape(len(observation), -1)

    return act


# --- augmented random search, all seeds at once


def searched(
    arm: Arm, task: Reach, space: Space, rngs: list[Any], iterations: int
) -> tuple[Callable[[Array], Array], Array]:
    """Policies after the search, and shares of success (checks, S) on the way."""
    seeds, inputs = len(rngs), 22
    W = np.zeros((seeds, inputs, space.size))
    count, mean, square = 1e-3, np.zeros((seeds, 1, inputs)), np.full((seeds, 1, inputs), 1e-3)

    def policy(weights: Array) -> Callable[[Array], Array]:
        scale = np.sqrt(square / count) + 0.02
        shift = mean.copy()

        def act(observation: Array) -> Array:
            groups = observation.reshape(len(weights), -1, inputs)
            repeat = len(weights) // seeds
            unit = (groups - np.repeat(shift, repeat, axis=0)) / np.repeat(scale, repeat, axis=0)
            return np.asarray(np.clip(unit, -5, 5) @ weights).reshape(len(observation), -1)

        return act

    checks = []
    for iteration in range(1, iterations + 1):
        noise = np.array([rng.normal(size=(DIRECTIONS, inputs, space.size)) for rng in rngs])
        tried = np.concatenate([W[:, None] + NOISE * noise, W[:, None] - NOISE * noise], axis=1)
        conditions = []
        for rng in rngs:
            c = task.conditions(arm, rng, DIRECTIONS)
            conditions += [c, c]
        run = play(Episodes(arm, task, joined(conditions)), policy(tried.reshape(-1, inputs, space.size)), space)
        reward = run.reward.reshape(seeds, 2, DIRECTIONS)
        order = np.argsort(-reward.max(axis=1), axis=1)[:, :BEST]
        for s in range(seeds):
            best = reward[s][:, order[s]]
            change = np.einsum("d,dio->io", best[0] - best[1], noise[s, order[s]])
            W[s] += STEP / (BEST * (best.std() + 1e-6)) * change
        seen = np.array(run.observations).reshape(STEPS, seeds, -1, inputs)
        added = seen.shape[0] * seen.shape[2]
        new_mean = seen.mean(axis=(0, 2))[:, None]
        square += ((seen - new_mean[:, :][None]) ** 2).sum(axis=(0, 2))[:, None]
        square += (new_mean - mean) ** 2 * count * added / (count + added)
        mean = mean + (new_mean - mean) * added / (count + added)
        count += added
        if iteration % CHECK_EVERY == 0 or iteration == iterations:
            c = joined([task.conditions(arm, rng, CHECKS) for rng in rngs])
            checks.append(play(Episodes(arm, task, c), policy(W), space).success.reshape(seeds, -1).mean(axis=1))
    return policy(W), np.array(checks)


# --- figures


def tested(arm: Arm, task: Reach, space: Space, act: Callable[[Array], Array], rngs: list[Any]) -> dict[str, list[Any]]:
    """Figures of a policy, a number for each seed.

    Groups of episodes have the same goal and obstacle, and other starts. Spread: rms distance of the joints at the end
    from their mean, in a group. Drift: rms change of the joints at the goal after a way home and back. Both among
    episodes that arrive.
    """
    groups = []
    for rng in rngs:
        c = task.conditions(arm, rng, TESTS)
        c.start = np.array(c.start)
        for k in range(0, TESTS, GROUP):
            same = slice(k, k + GROUP)
            for name in ("goal", "point", "side"):
                getattr(c, name)[same] = getattr(c, name)[k]
            if task.name == "reach":
                near = np.linalg.norm(arm.elbow(c.start[same]) - c.point[k], axis=1) < ELBOW + OBSTACLE + 0.02
                c.start[same][near] = c.start[k]
        groups.append(c)
    conditions = joined(groups)
    episodes = Episodes(arm, task, conditions)
    run = play(episodes, act, space)
    goal = conditions.goal
    if task.name != "wipe":  # whose path is closed
        episodes.c = Conditions(conditions.start, arm.module.task(conditions.start), conditions.point, conditions.side)
        play(episodes, act, space)
        episodes.c = Conditions(conditions.start, goal, conditions.point, conditions.side)
    again = play(episodes, act, space)
    both = run.arrived & again.arrived
    moved = np.where(both, np.sqrt(((again.q - run.q) ** 2).mean(axis=1)), np.nan)
    ends = np.where(run.arrived[:, None], run.q, np.nan).reshape(len(rngs), -1, GROUP, 7)
    found: dict[str, list[Any]] = {
        "success": _rows(run.success, rngs).mean(axis=1).tolist(),
        "limit hits": _rows(run.limit_hits, rngs).mean(axis=1).tolist(),
        "arrived": _rows(run.arrived, rngs).mean(axis=1).tolist(),
    }
    with np.errstate(all="ignore"):
        off = ends - _mean(ends, 2)[:, :, None]
        enough = np.isfinite(ends).all(axis=3).sum(axis=2) > 1
        spread = np.where(enough, np.sqrt(_mean(off**2, (2, 3))), np.nan)
    found["spread"] = _mean(spread, 1).tolist()
    found["drift"] = _mean(_rows(moved, rngs), 1).tolist()
    return found


def _rows(values: Array, rngs: list[Any]) -> Array:
    return np.asarray(values.reshape(len(rngs), -1))


def _mean(values: Array, axis: Any) -> Array:
    """Mean of what is finite; NaN where nothing is."""
    good = np.isfinite(values)
    with np.errstate(all="ignore"):
        return np.asarray(np.where(good, values, 0).sum(axis=axis) / good.sum(axis=axis))


def studied(arm: Arm, task: Reach, seeds: int, sizes: "Sizes", keep: Callable[[str], Path | None]) -> Iterator[Part]:
    """Parts of the study for a task: both ways of learning in every action space."""
    data: tuple[Array, Array, Array, Array] | None = None
    for space in SPACES:
        path = keep(f"{task.name} {space.name}".replace(", ", " ").replace(" ", "_"))
        if path is not None and path.exists():
            yield json.loads(path.read_text())
            continue
        data = demonstrations(arm, task, seeds, sizes.demonstrations) if data is None else data
        start = time.process_time()
        seen, commands, after, shown = data
        labels = np.array([space.label(arm, a, b) for a, b in zip(commands, after, strict=True)])
        wanted = np.clip(_by_seed(labels, seeds), -1, 1)
        act = cloned(_by_seed(seen, seeds), wanted, np.random.default_rng(5), sizes.updates)
        part: Part = {"task": task.name, "space": space.name, "demonstrations": float(shown.mean())}
        part["cloning"] = tested(arm, task, space, act, _rngs(seeds, 1))
        act, checks = searched(arm, task, space, _rngs(seeds, 2), sizes.iterations)
        part["search"] = tested(arm, task, space, act, _rngs(seeds, 1))
        part["checks"] = checks.T.tolist()
        part["seconds"] = time.process_time() - start
        if path is not None:
            path.write_text(json.dumps(part))
        yield part


def _by_seed(rows: Array, seeds: int) -> Array:
    """(T, S N, k) -> (S, T N, k)."""
    split = rows.reshape(len(rows), seeds, -1, rows.shape[2])
    return np.asarray(split.transpose(1, 0, 2, 3)).reshape(seeds, -1, rows.shape[2])


def _rngs(seeds: int, purpose: int) -> list[Any]:
    return [np.random.default_rng((seed, purpose)) for seed in range(seeds)]


def demonstrations(arm: Arm, task: Reach, seeds: int, count: int) -> tuple[Array, Array, Array, Array]:
    """Of all seeds, half by each expert."""
    c = joined([task.conditions(arm, rng, count) for rng in _rngs(seeds, 0)])
    return demonstrate(arm, task, c, np.arange(len(c.side)) % 2 == 0, np.random.default_rng(4))


@dataclass(frozen=True)
class Sizes:
    """How much is done."""

    demonstrations: int = DEMONSTRATIONS
    updates: int = UPDATES
    iterations: int = ITERATIONS


def row(part: Part, way: str) -> str:
    """A row of the table."""
    found, percent = part[way], {"success": 100, "limit hits": 100}
    cells = [part["task"], part["space"], "cloning" if way == "cloning" else "search"]
    for name in ("success", "limit hits", "drift", "spread"):
        values = np.array(found[name], dtype=float)
        good = values[np.isfinite(values)] * percent.get(name, 1)
        digits = 0 if name == "success" else 1 if name == "limit hits" else 2
        cells.append(f"{good.mean():.{digits}f} ± {good.std():.{digits}f}" if len(good) else "-")
    checks = np.array(part["checks"])
    cells.append(samples(checks) if way == "search" else "-")
    return f"| {' | '.join(cells)} |"


def samples(checks: Array) -> str:
    """Median over seeds of the episodes until a check shows success in half of its episodes."""
    reached = checks >= 0.5
    first = np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, np.inf)
    median = float(np.median(first)) * CHECK_EVERY * 2 * DIRECTIONS
    return f"{median:.0f}" if np.isfinite(median) else f"> {checks.shape[1] * CHECK_EVERY * 2 * DIRECTIONS}"


def main(quick: bool = False, out: Path | None = None, seeds: int = 10) -> list[Part]:
    """Print the table, and return its parts.

    Args:
        quick: one seed of one task, and few iterations.
        out: a folder that keeps parts, for a run that goes on.
        seeds: how many.
    """
    chart = oc.charts.load("panda-wide")
    sizes = Sizes(8, 100, 1) if quick else Sizes()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    print(
        "| task | actions | learned by | success [%] | at joint limits [% of steps] | drift [rad] | spread [rad] "
        "| episodes to 50 % |\n| --- | --- | --- | --- | --- | --- | --- | --- |"
    )
    parts = []
    with TemporaryDirectory() as folder:
        arm = Arm(chart, exported(chart, "numpy", Path(folder)), scene(chart.problem.robot))
        for task in TASKS[: 1 if quick else None]:
            for part in studied(
                arm, task, 1 if quick else seeds, sizes, lambda name: None if out is None else out / f"{name}.json"
            ):
                parts.append(part)
                for way in ("cloning", "search"):
                    print(row(part, way), flush=True)
    return parts


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small case, to see that it works")
    parser.add_argument("--out", type=Path, help="folder that keeps parts")
    parser.add_argument("--seeds", type=int, default=10)
    arguments = parser.parse_args()
    main(arguments.quick, arguments.out, arguments.seeds)
