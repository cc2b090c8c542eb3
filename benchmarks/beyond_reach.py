"""How much nearer a tool beyond reach could be than a tracker with `nearest=True` takes it (2 min).

On wide charts of eight arms, four hands each lead the tool 0.2 to 0.8 m outwards within 2 s, then 200 mm sideways
within 2 s, and wait, until the tracker's status is NEAREST, or for 10 s. SLSQP goes on from there, with the joints'
bounds and the domain's conditions as constraints, slopes by differences, and from three places nearby. What counts is
|D^-1 e_x| as the tracker weighs it, in metres of a place. `--quick` takes one arm and one hand.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from benchmark import run
from redundancy.arms import TICK, Arm
from scipy.optimize import minimize

import orthocas as oc
from orthocas.charts.regular_part import RegularPart
from orthocas.charts.trackers import RULES, TrackerStatus
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.checks import Array

READY = ("panda-wide", "iiwa7-wide", "xarm7-wide", "baxter-left-wide", "pr2-left-wide")
FITTED = ("tiago", "tiago-pro", "g1")  # of the redundancy benchmark
HANDS, TICKS, ASIDE, MOST = 4, 200, 0.2, 1000  # ticks of 10 ms of each way; [m]; ticks that a hand waits at most
NEARBY, STARTS, DIFFERENCE = 0.05, 3, 1e-6  # of other starts [rad]; their number; [rad]


def chart_of(name: str) -> oc.Chart:
    """A ready one, or one that is fitted now."""
    if name in READY:
        return oc.charts.load(name)
    arm = Arm(name)
    return oc.fit_wide(arm.robot, arm.task, home=arm.home).chart


def led(chart: oc.Chart, seed: int) -> tuple[Array, Array]:
    """A start (n,), and targets (2 TICKS, n): out of reach, then aside. Seed 0 begins at home, straight outwards."""
    domain, rng = chart.problem.domain, np.random.default_rng(seed)
    start = domain.centre + (0.3 * (sample_uniform(domain, 1, seed)[0] - domain.centre) if seed else 0.0)
    start = start if domain.contains(start) else domain.centre
    phi = chart.phi(start)
    out = rng.normal(size=3) if seed else phi[:3]
    out = out * np.sign(out @ phi[:3]) / np.linalg.norm(out)
    aside = np.cross(out, rng.normal(size=3))
    shares = (1 - np.cos(np.linspace(0, np.pi, TICKS))) / 2
    far = rng.uniform(0.2, 0.8) * out
    ways = [s * far for s in shares] + [far + s * ASIDE * aside / np.linalg.norm(aside) for s in shares]
    targets = np.tile(phi, (2 * TICKS, 1))
    targets[:, :3] += ways
    return start, targets


def slopes(f: Callable[[Array], Any], q: Array) -> Array:
    """Central differences."""
    ends = DIFFERENCE * np.eye(len(q))
    return np.stack([(np.asarray(f(q + d)) - np.asarray(f(q - d))) / (2 * DIFFERENCE) for d in ends], axis=-1)


def errors(chart: oc.Chart, phi: Array, q: Array) -> Array:
    """Weighted as the tracker's."""
    e = np.asarray(chart.parts.phi_map.difference(phi, chart.phi(q))) / chart.parts.phi_sizes
    return e * np.where(np.arange(chart.n) < chart.m, 1.0, RULES.xi_weight)


def rooms(chart: oc.Chart, q: Array) -> Array:
    """Of the domain's conditions, positive inside."""
    domain = chart.problem.domain
    assert isinstance(domain, RegularPart)
    clear = domain.singular_values(q) - domain.least_singular_value
    return np.array([clear, domain.volumes(q) - domain.least_volume])


def nearest(chart: oc.Chart, phi: Array, q: Array) -> Array:
    """The best of what SLSQP finds from q (n,) and from places nearby, and q."""
    rng, (low, high) = np.random.default_rng(0), chart.problem.domain.bounds

    def cost(q: Array) -> float:
        e = errors(chart, phi, q)
        return float(e @ e)

    scale, best = 1 / cost(q), q
    inside = {"type": "ineq", "fun": lambda q: rooms(chart, q), "jac": lambda q: slopes(lambda q: rooms(chart, q), q)}
    for shift in (0.0, *(NEARBY * rng.normal(size=(STARTS, len(q))))):
        found = minimize(
            lambda q: scale * cost(q),
            np.clip(q + shift, low, high),
            jac=lambda q: scale * slopes(cost, q),
            bounds=list(zip(low, high, strict=True)),
            constraints=[inside],
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 300},
        ).x
        if cost(found) < cost(best) and rooms(chart, found).min() > -1e-7:
            best = found
    return best


def hand(chart: oc.Chart, seed: int) -> dict[str, float]:
    """What a hand finds: metres nearer, the way of the tool while it went aside, the step at rest, and others."""
    start, targets = led(chart, seed)
    tracker = chart.tracker(start, TICK * chart.problem.robot.velocity_limits, nearest=True)
    began, path = time.process_time(), [tracker.step(phi) for phi in targets]
    each, waited = (time.process_time() - began) / len(targets), 0
    while tracker.status is TrackerStatus.NEARER and waited < MOST:
        path.append(tracker.step(targets[-1]))
        waited += 1
    phi, q = targets[-1], path[-1]
    best, m = nearest(chart, phi, q), chart.m
    x_error, least = (float(np.linalg.norm(errors(chart, phi, end)[:m])) for end in (q, best))
    places = chart.x(np.array(path))[:, :3]
    return {
        "nearer": (x_error - least) * float(chart.parts.phi_sizes[0]),
        "off": float(np.linalg.norm(places[-1] - phi[:3])),
        "way": float(np.linalg.norm(places[-1] - places[TICKS - 1])),
        "rest": float(np.abs(tracker.step(phi) - q).max()),
        "settled": float(tracker.status is not TrackerStatus.NEARER),
        "inside": float(chart.problem.domain.contains(np.array(path)).all()),
        "us": 1e6 * each,
    }


def main(quick: bool = False) -> dict[str, float]:
    """Print a table, and return its numbers."""
    found: dict[str, float] = {}
    columns = ("arm", "nearer it could be, largest [m]", "tool off the hand, median [mm]", "way aside, median [mm]")
    columns += ("at a minimum", "left the domain", "next step at rest, largest [rad]", "time of a tick [us]")
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}")
    for name in READY[:1] if quick else (*READY, *FITTED):
        chart = chart_of(name)
        hands = [hand(chart, seed) for seed in range(1 if quick else HANDS)]
        of = {key: np.array([one[key] for one in hands]) for key in hands[0]}
        settled, left = f"{of['settled'].sum():.0f} of {len(hands)}", int((1 - of["inside"]).sum())
        middle = {key: float(np.median(of[key])) for key in ("off", "way", "us")}
        print(
            f"| {name} | {of['nearer'].max():.0e} | {1e3 * middle['off']:.0f} | {1e3 * middle['way']:.0f} | {settled} "
            f"| {left} | {of['rest'].max():.0e} | {middle['us']:.0f} |",
            flush=True,
        )
        found |= {f"{name}, nearer [m]": float(of["nearer"].max()), f"{name}, way [m]": middle["way"]}
        found |= {f"{name}, settled": float(of["settled"].mean()), f"{name}, left": float(left)}
    return found


if __name__ == "__main__":
    run(main, __doc__)
