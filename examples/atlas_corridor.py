"""A corridor of charts in C: the tool goes along a path of 1 m and back in MuJoCo, from chart to chart (4 min).

An atlas is built around the path, and its charts become a C library with PD+ under supervision. The program leads the
tool along the path and holds xi. When the box of a chart is left, the library hands over: the reference then asks for
the same posture, velocity and acceleration in the next chart, and the program brings xi to rest there.

- hand_overs: changes of the chart;
- posture_jump_rad, speed_jump: what the reference asks for after a hand-over less what it asked for before it;
- torque_step: largest change of a torque in a tick with a hand-over [N m]; torque_step_else: in the other ticks;
- tool_error_m: largest distance of the tool from the path;
- left_over_rad: how far the joints are from where they began, after the way back;
- library_kib: the shared library.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import orthocas as oc
from orthocas import problems
from orthocas.codegen import ChartReference, CompiledLibrary, Supervisor, compile_shared
from orthocas.control import ControlStatus, PDPlus
from orthocas.simulation import MuJoCoPlant
from orthocas.tools.checks import Array

TICK = 1e-3
OMEGA = 12.0  # with which xi comes to rest after a hand-over [rad/s]
FADE_IN = 0.5  # [s]


@dataclass(frozen=True)
class Case:
    """A problem, corners of the tool's way from where the arm is at the centre of its domain [m], and the atlas."""

    name: str
    corners: tuple[tuple[float, ...], ...]
    seconds: float  #: from corner to corner
    asked: oc.AtlasSettings
    radius: float  #: of the surroundings of the path [rad]


CASE = Case("iiwa", ((0, 0, -0.5), (-0.25, 0.45, -0.5)), 2.5, oc.AtlasSettings(half_width=0.55), 0.3)
QUICK = Case("planar_3r_xy", ((-0.5, 0.2),), 1.2, oc.AtlasSettings(2, 14.0, half_width=0.2, splits=2), 0.25)


def main(quick: bool = False) -> dict[str, float]:
    """Build, compile, run."""
    case = QUICK if quick else CASE
    known = problems.get(case.name)
    start = known.domain.centre
    corners = known.task.batched(start[None])[0][0] + np.array([np.zeros(known.m), *case.corners])
    path = postures(known, start, corners)
    with TemporaryDirectory() as place:
        folder = Path(place)
        atlas = oc.build_atlas(
            known, folder / "corridor.orthocas-atlas", case.asked, region=path, radius=case.radius, jobs=1
        )
        part = oc.AtlasPart.along(atlas, path, case.radius)
        law = PDPlus.on_chart(atlas.chart(int(part.charts[0])), coupling="coupled")
        compiled = compile_shared(oc.generate_c(part, folder / "c", law, "arm"), folder)
        library = CompiledLibrary(compiled, "arm", known.n, r=known.r)
        rows = list(
            ticks(part, library, Supervisor(library, law), path[0], np.vstack([corners, corners[-2::-1]]), case)
        )
        found = summary(rows, part) | {"library_kib": compiled.stat().st_size / 1024}
        return found | {"left_over_rad": float(np.abs(rows[-1].q - path[0]).max())}


def postures(problem: oc.Problem, start: Array, corners: Array) -> Array:
    """Joint positions along straight lines between task values, by steps of the pseudo-inverse."""
    q, rows = start.copy(), []
    for begin, end in pairwise(corners):
        for share in np.linspace(0, 1, 26):
            for _ in range(3):
                J = problem.task.batched_jacobian(q[None])[0][0].reshape(-1, problem.n)
                q = q + np.linalg.pinv(J) @ (begin + share * (end - begin) - problem.task.batched(q[None])[0][0])
            rows.append(q)
    return np.array(rows)


@dataclass(frozen=True)
class Tick:
    """What happened in a tick."""

    q: Array
    status: ControlStatus
    torque_step: float
    tool_error: float
    jumps: tuple[float, float] | None  #: of posture and speed asked for, if there was a hand-over


def ticks(
    part: oc.AtlasPart, library: CompiledLibrary, supervisor: Supervisor, start: Array, corners: Array, case: Case
) -> Iterator[Tick]:
    """Run the law along the corners and back."""
    problem, plant = part.atlas.problem, MuJoCoPlant(part.atlas.problem.robot)
    m, n = problem.m, problem.n
    plant.reset(start)
    supervisor.start(start)
    reference = ChartReference.at(library, start, supervisor.chart)
    torque, _ = supervisor.step(plant.q, plant.dq, reference, TICK)
    for _ in range(round(FADE_IN / TICK)):
        plant.step(torque, TICK)
        torque, _ = supervisor.step(plant.q, plant.dq, reference, TICK)
    target = reference.values[:n].copy()
    for k in range(round(case.seconds * (len(corners) - 1) / TICK)):
        x = way(corners, case.seconds, (k + 1) * TICK)
        plant.step(torque, TICK)
        target[:m] = x[0]
        supervisor.stream(reference, target, OMEGA, TICK)
        for place, values in zip((0, n, 2 * n), x, strict=True):
            reference.values[place : place + m] = values
        before, chart, last = reference.values.copy(), reference.chart, torque
        torque, status = supervisor.step(plant.q, plant.dq, reference, TICK)
        jumps = None
        if reference.chart != chart:
            target = reference.values[:n] + 2 * reference.values[n : 2 * n] / OMEGA  # where xi comes to rest
            then, now = asked(part, plant.q, before, chart), asked(part, plant.q, reference.values, reference.chart)
            jumps = (float(np.abs(now[0] - then[0]).max()), float(np.abs(now[1] - then[1]).max()))
        error = float(np.linalg.norm(problem.task.batched(plant.q[None])[0][0] - x[0]))
        yield Tick(plant.q, status, float(np.abs(torque - last).max()), error, jumps)


def way(corners: Array, seconds: float, time: float) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration at a time, at rest in each corner."""
    leg = min(int(time / seconds), len(corners) - 2)
    s, a, b = min(time / seconds - leg, 1.0), corners[leg], corners[leg + 1]
    share, rate = s**3 * (10 - 15 * s + 6 * s**2), 30 * (s * (1 - s)) ** 2 / seconds
    return a + share * (b - a), rate * (b - a), 60 * s * (1 - s) * (1 - 2 * s) / seconds**2 * (b - a)


def asked(part: oc.AtlasPart, near: Array, values: Array, number: int) -> tuple[Array, Array]:
    """Posture and joint velocity that a reference asks for in a chart, found in Python."""
    chart = part.atlas.chart(int(part.charts[number]), near=near)
    q = chart.inverse(
        values[: chart.n], q_start=near, outside=True, tolerance=1e-11
    )  # a reference may lead a little outside
    return q, np.linalg.solve(chart.jacobian(q), values[chart.n : 2 * chart.n])


def summary(rows: list[Tick], part: oc.AtlasPart) -> dict[str, float]:
    """The numbers of a run."""
    handed = [row for row in rows if row.jumps is not None]
    return {
        "charts": len(part),
        "hand_overs": len(handed),
        "share_ok": float(np.mean([row.status == ControlStatus.OK for row in rows])),
        "posture_jump_rad": max((row.jumps[0] for row in handed if row.jumps), default=np.nan),
        "speed_jump": max((row.jumps[1] for row in handed if row.jumps), default=np.nan),
        "torque_step": max((row.torque_step for row in handed), default=np.nan),
        "torque_step_else": max(row.torque_step for row in rows if row.jumps is None),
        "tool_error_m": max(row.tool_error for row in rows),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    for key, number in main(parser.parse_args().quick).items():
        print(f"{key:>20}: {number:.4g}")
