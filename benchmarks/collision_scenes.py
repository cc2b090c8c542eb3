"""Three scenes, lines of the hand past what the elbow would meet: our tracker, a barrier, a sphere cost (10 min).

Lines of 0.2 m of the hand that a search of all postures finds to be possible (elbow_lines.py). Past a post beside the
elbow of a panda, and past baxter's right arm, which reaches across the front, an elbow at rest in xi has a contact. In
the third scene, two plates stand beside a free posture at the end of a line, and the elbow begins outside of the slot
between them. A line takes 200 ticks of 10 ms, and 50 more at its end.

- ours, planned: `oc.follow(..., "objective")` before the motion;
- ours: `chart.tracker(..., nearest=True, margin=0.01, avoid=0.05)`, x of the line and xi of the start;
- barrier: pink with `SelfCollisionBarrier` for the ten nearest pairs of the same hulls, d_min = 0.01, and daqp;
- spheres: resolved rates, and in the null space the gradient of cuRobo's cost of spheres around the links,
  quadratic below 0.05 m. Spheres cover the fitted capsules; without a time, as ours of them would not be theirs.

A line is done if its end is reached to 1 mm, without a contact of hulls at ticks or between them.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin
from benchmark import run, table
from collisions import load
from elbow_lines import LENGTH, Line, Search, draw_lines, follow

import orthocas as oc
from orthocas.errors import PathError
from orthocas.robots.capsules import FittedCapsules
from orthocas.robots.collision_files import CollisionSource
from orthocas.robots.collisions import Collisions, Part
from orthocas.robots.shapes import BallGeometry, Shape
from orthocas.robots.urdf import find_robot_file
from orthocas.tools.checks import Array

TICK, TICKS, REST, STEP = 0.01, 200, 50, 0.05  # [s]; of a line; at its end; largest of a joint in a tick [rad]
MARGIN, AVOID, PAIRS = 0.01, 0.05, 10  # [m]; [m]; of the barrier
GAIN, DAMPING, PUSH = 0.5, 1e-3, 0.5  # of errors in a tick; of rates; of the cost's gradient
APART, THICK, WIDE = 0.15, 0.02, 0.3  # [m] of a plate of the slot from the elbow; its thickness and width
MOVED = 0.1  # [m] of the elbow, at least, on its way into the slot
NEAR = 0.15  # [m] from the other arm at the start, at most
RIGHT = {"right_s0": 1.2, "right_s1": -0.2, "right_e1": 0.6}  # the other arm, across the front [rad]

Tick = Callable[[Array, Array], Array]  # posture and x -> the next posture


def draw_slots(chart: oc.Chart, own: Collisions) -> Iterator[Line]:
    """Lines at whose end a posture with the elbow between two plates is free; they begin outside, with another xi."""
    rng = np.random.default_rng(12)
    for end in chart.domain.sample(20_000, 12):
        side = rng.uniform(-np.pi, np.pi)
        elbow = chart.robot.frame_position(end, "panda_link4")
        across = np.array([np.cos(side), np.sin(side), 0.0])
        plates = {
            f"plate {k}": oc.obstacles.Box(
                [THICK, WIDE, WIDE], elbow + sign * APART * across, pin.utils.rotate("z", side)
            )
            for k, sign in enumerate((-1, 1))
        }
        around = own.with_scene(oc.Scene(plates))
        if not around.distance(end).distance > 0.02:
            continue
        # Starts with another xi and the elbow elsewhere.
        for _ in range(20):
            direction = rng.normal(size=3)
            x = np.tile(chart.x(end), (31, 1))
            x[:, :3] += np.linspace(LENGTH, 0.0, 31)[:, None] * direction / np.linalg.norm(direction)
            found = chart.solve(np.append(x[0], chart.xi(end) + rng.uniform(-1.0, 1.0))[None], end)
            start = found.q[0]
            moved = found.found[0] and np.linalg.norm(elbow - chart.robot.frame_position(start, "panda_link4")) > MOVED
            if moved and around.distance(start).distance > 0.02:
                yield Line(around, start, x)
                break


def draw_crossings(chart: oc.Chart, own: Collisions) -> Iterator[Line]:
    """Lines of baxter's left hand along which its arm would meet the right one."""
    rng = np.random.default_rng(13)
    postures = chart.domain.sample(20_000, 13)
    found = own.distance(postures)
    near = [any(name.startswith("right") for name in pair) for pair in found.pair]
    for q in postures[np.array(near) & (found.distance > 0.02) & (found.distance < NEAR)]:
        direction = rng.normal(size=3)
        x = np.tile(chart.x(q), (31, 1))
        x[:, :3] += np.linspace(0.0, LENGTH, 31)[:, None] * direction / np.linalg.norm(direction)
        try:
            held = oc.follow(chart, x, "hold", q_start=q).q
        except PathError:
            continue
        contact = own.find_contact(held)
        if contact is not None and any(name.startswith("right") for name in contact.pair):
            yield Line(own, q, x)


def track(chart: oc.Chart, line: Line) -> Tick:
    """Our tracker."""
    tracker = chart.tracker(line.start, STEP, nearest=True, collisions=line.around, margin=MARGIN, avoid=AVOID)
    xi = chart.xi(line.start)
    return lambda q, x: tracker.step(np.append(x, xi))


def solve_barrier(chart: oc.Chart, line: Line) -> Tick:
    """Pink's program of each tick, with the hulls of the line's scene."""
    pink: Any = import_module("pink")
    barriers: Any = import_module("pink.barriers")
    tree, (plain, geometry) = chart.robot.tree, line.around._models
    model = plain.copy()
    model.lowerPositionLimit, model.upperPositionLimit = tree.lower, tree.upper
    model.velocityLimit = np.full(chart.n, STEP / TICK)
    tip = tree.tip
    place = pin.SE3(np.asarray(tip.rotation), np.asarray(tip.translation))
    model.addFrame(pin.Frame("hand", tip.parent + 1, 0, place, pin.FrameType.OP_FRAME))
    configuration = pink.Configuration(
        model, model.createData(), line.start, collision_model=geometry, collision_data=geometry.createData()
    )
    hand, posture = pink.tasks.FrameTask("hand", 1.0, 1.0), pink.tasks.PostureTask(cost=1e-3)
    posture.set_target(line.start)
    barrier = barriers.SelfCollisionBarrier(min(PAIRS, len(geometry.collisionPairs)), gain=20.0, d_min=MARGIN)

    turn = chart.robot.frame_rotation(line.start, tip.name)

    def step(q: Array, x: Array) -> Array:
        hand.set_target(pin.SE3(turn, x[:3]))
        limits = [pink.limits.ConfigurationLimit(model), pink.limits.VelocityLimit(model)]
        velocity = pink.solve_ik(
            configuration, [hand, posture], TICK, "daqp", damping=1e-9, limits=limits, barriers=[barrier]
        )
        configuration.integrate_inplace(velocity, TICK)
        return np.array(configuration.q)

    return step


def cover_with_spheres(fitted: FittedCapsules, line: Line) -> Collisions:
    """Spheres that cover the capsules of the links, against each other and the line's scene."""
    parts = []
    for part in fitted.collisions.parts:
        corners, radius = part.shape.list_corners()
        length = float(np.linalg.norm(corners[-1] - corners[0]))
        count = 1 + round(length / (2 * radius))
        wide = float(np.hypot(radius, length / (count - 1) / 2)) if count > 1 else radius + length / 2
        for share in np.linspace(0.0, 1.0, count):
            centre = (1 - share) * corners[0] + share * corners[-1]
            parts.append(Part(part.name, part.body, Shape(BallGeometry(wide), np.eye(3), centre)))
    known = {part.name for part in parts}
    parts += [part for part in line.around.parts if part.name not in known]
    return Collisions(fitted.collisions.tree, parts, line.around.pairs)


def descend_spheres(fitted: FittedCapsules) -> Callable[[oc.Chart, Line], Tick]:
    """Resolved rates with the gradient of the cost in the null space."""

    def build(chart: oc.Chart, line: Line) -> Tick:
        spheres, relative = cover_with_spheres(fitted, line), chart.parts.relative

        def step(q: Array, x: Array) -> Array:
            J = relative.batched_rates(q[None])[0].reshape(chart.m, chart.n)
            inverse = J.T @ np.linalg.inv(J @ J.T + DAMPING**2 * np.eye(chart.m))
            near = spheres.find_near(q, AVOID)
            deep = AVOID - near.distance
            slope = -np.where(deep > AVOID, 1.0, deep / AVOID) @ near.gradient if len(deep) else np.zeros(chart.n)
            inner = -PUSH * (slope - np.linalg.pinv(J) @ (J @ slope))
            change = inverse @ relative.difference(x, chart.x(q)) + inner
            change *= min(1.0, STEP / max(float(np.abs(change).max()), 1e-12))
            return np.asarray(np.clip(q + change, chart.robot.lower, chart.robot.upper))

        return step

    return build


def drive(chart: oc.Chart, line: Line, step: Tick) -> tuple[bool, bool, float, float]:
    """Whether a line is done, whether it has a contact, largest error of the hand [mm], and [ms] of a tick."""
    shares = np.append(np.linspace(0.0, 1.0, TICKS), np.ones(REST))[:, None]
    way, errors, seconds = [line.start], list[float](), 0.0
    for x in (1 - shares) * line.x[0] + shares * line.x[-1]:
        begin = time.process_time()
        way.append(step(way[-1], x))
        seconds += time.process_time() - begin
        errors.append(float(np.linalg.norm(chart.x(way[-1])[:3] - x[:3])))
    q = np.array(way)
    contact = not line.around.check_free(q).all() or line.around.find_contact(q) is not None
    return errors[-1] < 1e-3 and not contact, contact, 1e3 * max(errors), 1e3 * seconds / len(shares)


def compare(names: Sequence[str], count: int, found: dict[str, float]) -> Iterator[str]:
    """Rows: scenes by every method."""
    panda, own = load("panda")
    baxter = oc.load("baxter-left-wide")
    pair = oc.Robot(baxter.robot.tree, solids=CollisionSource(find_robot_file("baxter"), None, RIGHT)).collisions
    scenes = {
        "past a post": (panda, draw_lines(panda, own), own),
        "into a slot": (panda, draw_slots(panda, own), own),
        "past the other arm": (baxter, draw_crossings(baxter, pair), pair),
    }
    for name in names or scenes:
        chart, lines, alone = scenes[name]
        methods = {"ours": track, "barrier": solve_barrier, "spheres": descend_spheres(oc.fit_capsules(alone))}
        some = list[Line]()
        for line in lines:
            if Search(chart, line).find():
                some.append(line)
            if len(some) == count:
                break
        planned = sum(follow(chart, line) for line in some)
        found[f"{name}, planned, done"] = planned
        yield f"| {name} | ours, planned | {len(some)} | {planned} | 0 | 0 | - |"
        for method, build in methods.items():
            done, touched, off, times = 0, 0, list[float](), list[float]()
            for line in some:
                try:
                    good, contact, error, ms = drive(chart, line, build(chart, line))
                except Exception as failure:  # of their solvers, which then have no answer
                    warnings.warn(f"{method}: {type(failure).__name__} {failure}", stacklevel=1)
                    good, contact, error, ms = False, False, np.nan, np.nan
                done, touched = done + good, touched + contact
                off.append(error)
                times.append(ms)
            ms_text = "-" if method == "spheres" else f"{np.nanmedian(times):.1f}"
            found |= {f"{name}, {method}, done": done, f"{name}, {method}, contacts": touched}
            yield f"| {name} | {method} | {len(some)} | {done} | {touched} | {np.nanmedian(off):.2g} | {ms_text} |"


def main(quick: bool = False) -> dict[str, float]:
    """Print the table; the numbers of a test."""
    found = dict[str, float]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        head = "scene | method | lines | done | with a contact | hand off at most, median [mm] | time of a tick [ms]"
        print(f"| {head} |")
        asked = (("into a slot",), 1) if quick else ((), 4)
        table("| --- " * (head.count("|") + 1) + "|", compare(*asked, found))
    return found


if __name__ == "__main__":
    run(main, __doc__)
