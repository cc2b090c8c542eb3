"""Two arms, humanoid upper bodies, long planar arms and a mobile base: fits, C, a push in MuJoCo, proofs, pick cycles.

Boxes have the half-width 0.3 around the postures below (0.1 for the longest arm, pr2's lift). The leak is that of
coordinates that are not joints themselves, on 20,000 samples of another seed; the least conditioning comes from a
search by descent. `--quick` takes one case.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmark import run, table

import orthocas as oc
from orthocas import bases
from orthocas.codegen import CompiledLibrary, compile_shared, generate_c
from orthocas.codegen.library import time_ticks
from orthocas.tools.checks import Array
from orthocas.tools.display import percent

BAXTER = [0.3, -0.4, -0.5, 1.2, 0.2, 0.8, 0.1, -0.3, -0.4, 0.5, 1.2, -0.2, 0.8, -0.1]
G1 = {"shoulder_pitch": -0.4, "elbow": 0.6, "wrist_pitch": 0.3}
G1_MIRRORED = {"shoulder_roll": 0.4, "shoulder_yaw": 0.3, "wrist_yaw": 0.3}
PR2 = {"shoulder_lift": 0.3, "elbow_flex": -1.2, "wrist_flex": -0.9, "torso": 0.15}
PR2_MIRRORED = {"shoulder_pan": 0.5, "upper_arm_roll": 0.6, "forearm_roll": 0.4}
TALOS = {"_4_": -1.3, "_6_": 0.1}
TALOS_MIRRORED = {"_1_": 0.3, "_2_": 0.5, "_3_": -0.5, "_5_": 0.2, "_7_": 0.3}
HALF_WIDTH = 0.3


@dataclass(frozen=True)
class Case:
    """A problem, the parametrisation, and how rows call it."""

    name: str
    problem: oc.Problem
    parametrisation: bases.Parametrisation


def robot(file: str, *tips: str, base: str | None = None) -> oc.Robot:
    """A robot of example-robot-data."""
    path = next(path.locate() for path in files("example-robot-data") or [] if path.name == file)
    return oc.Robot.from_urdf(str(path), tips=tips, base=base)


def posture(arms: oc.Robot, same: dict[str, float], mirrored: dict[str, float], left: str) -> Array:
    """Positions of joints by parts of their names; those of the right side have the other sign where mirrored."""
    q = np.zeros(arms.n)
    for k, name in enumerate(arms.joint_names):
        sign = 1 if left in name else -1
        q[k] = next((value for part, value in same.items() if part in name), 0.0)
        q[k] += next((sign * value for part, value in mirrored.items() if part in name and "waist" not in name), 0.0)
    return q


def cases(quick: bool) -> Iterator[Case]:
    """Of the table."""
    two = robot("baxter.urdf", "left_gripper", "right_gripper")
    grip = oc.Problem(two, oc.Task.relative_pose(two, *two.tips), domain=oc.Box(BAXTER, HALF_WIDTH))
    yield Case("baxter, relative pose of the hands", grip, oc.Polynomial(2))
    if quick:
        return
    for parametrisation in (oc.Polynomial(3), oc.Polynomial(3, joints=2), oc.Polynomial(4, joints=2)):
        yield Case("baxter, relative pose of the hands", grip, parametrisation)
    apart = oc.Problem(two, oc.Task.relative_position(two, *two.tips), domain=grip.domain)
    yield Case("baxter, relative position of the hands", apart, oc.Polynomial(2))
    for name, arms, centre in (
        ("g1", robot("g1_29dof_rev_1_0.urdf", "left_rubber_hand", "right_rubber_hand"), (G1, G1_MIRRORED, "left")),
        (
            "talos",
            robot("talos_reduced.urdf", "gripper_left_base_link", "gripper_right_base_link"),
            (TALOS, TALOS_MIRRORED, "left"),
        ),
        ("pr2", robot("pr2.urdf", "l_gripper_tool_frame", "r_gripper_tool_frame"), (PR2, PR2_MIRRORED, "l_")),
    ):
        widths = np.array(
            [0.1 if "lift_joint" in joint and "torso" in joint else HALF_WIDTH for joint in arms.joint_names]
        )
        box = oc.Box(np.clip(posture(arms, *centre), arms.lower + widths, arms.upper - widths), widths)
        both = oc.Task.stack(oc.Task.position(arms), oc.Task.position(arms, frame=arms.tips[1]))
        yield Case(
            f"{name}, relative pose of the hands",
            oc.Problem(arms, oc.Task.relative_pose(arms, *arms.tips), domain=box),
            oc.Polynomial(2),
        )
        yield Case(f"{name}, both hands", oc.Problem(arms, both, domain=box), oc.Polynomial(2))
    for n, width in ((12, HALF_WIDTH), (20, 0.1)):
        arm = oc.Robot.planar([3.0 / n] * n, [1.0] * n)
        box = oc.Box([HALF_WIDTH] * n, width)
        yield Case(f"planar, {n} joints", oc.Problem(arm, oc.Task.position(arm, "xy"), domain=box), oc.Polynomial(2))
    mobile = robot("panda.urdf", base="planar")
    home = np.array([0, 0, 0, 0, -0.6, 0, -2.1, 0, 1.5, 0.78])
    for task in (oc.Task.position(mobile), oc.Task.pose(mobile).with_reference_at(home)):
        everywhere = oc.Problem(mobile, task, domain=oc.Box(home, HALF_WIDTH))
        yield Case(f"mobile panda, {task.name.partition(':')[0]}", everywhere, oc.Mobile(oc.Polynomial(2)))


def fits(quick: bool) -> Iterator[tuple[str, oc.Chart]]:
    """Rows, and their charts."""
    for case in cases(quick):
        began = time.process_time()
        fit = oc.fit(case.problem, case.parametrisation)
        seconds = time.process_time() - began
        report = oc.evaluate(fit.chart, samples=20_000)
        leak = (report if report.without_idle is None else report.without_idle).leak.rms
        sizes = f"{case.problem.n}, {case.problem.m}, {case.problem.r}"
        least = report.worst.least if report.worst is not None else float("nan")
        yield (
            f"| {case.name} | {sizes} | {case.parametrisation.label} | {seconds:.1f} | {leak:.1f} | {least:.2f} |",
            fit.chart,
        )


def in_c(chart: oc.Chart) -> str:
    """Time to compile the library of PD+, and of a tick."""
    law = oc.control.PDPlus(chart, stiffness=oc.control.matched_stiffness(chart))
    with TemporaryDirectory() as folder:
        generated = generate_c(chart, Path(folder) / "c", law, "arms")
        began = time.perf_counter()
        library = CompiledLibrary(compile_shared(generated, Path(folder)), "arms", chart.n)
        compiled = time.perf_counter() - began
        (ticks,) = time_ticks([(law, library)], 2_000)
    return f"| {chart.n} | {compiled:.1f} | {ticks.median:.1f} |"


def laws(chart: oc.Chart) -> Iterator[tuple[str, oc.control.PDPlus]]:
    """PD+ with the default stiffness, and with one for a robot that answers within 1 ms."""
    for name, settings in (("default", {}), ("for 1 ms", {"fastest": np.inf, "delay": 1e-3})):
        yield name, oc.control.PDPlus(chart, stiffness=oc.control.matched_stiffness(chart, **settings))


def pushed(chart: oc.Chart, link: str, name: str, law: oc.control.PDPlus) -> str:
    """A push of 15 N at a link for 0.2 s under PD+ in MuJoCo at 1 kHz: how far the hands are off each other."""
    robot, home = chart.problem.robot, chart.problem.domain.centre
    stay = oc.control.Reference.steps(law.labels, chart.phi(home), [], duration=2.0)
    push = oc.simulation.Push(start=0.2, duration=0.2, force=(0, 12, 9), link=link)
    motion = oc.simulate(law, stay, home, control_rate=1000.0, pushes=[push], plant="mujoco")
    p, R = (
        function(motion.q, robot.tips[1], robot.tips[0]) for function in (robot.frame_position, robot.frame_rotation)
    )
    off = 1e3 * np.linalg.norm(p - p[0], axis=1)
    angle = np.degrees(np.arccos(np.clip((np.einsum("nij,ij->n", R, R[0]) - 1) / 2, -1, 1)))
    later = np.searchsorted(motion.times, 1.4)
    slowest = law.modes(home).frequencies.min()
    return (
        f"| {link} | {name} | {slowest:.2f} | {off.max():.1f} | {angle.max():.2f} "
        f"| {off[later]:.2f} | {angle[later]:.3f} |"
    )


def proved(name: str, chart: oc.Chart, seconds: float) -> str:
    """The share of a domain on which a proof finds no fold within some seconds."""
    began = time.process_time()
    certificate = oc.certify(chart, time_limit=seconds)
    return f"| {name} | {percent(certificate.share, 0)} | {certificate.boxes:,} | {time.process_time() - began:.0f} |"


def cycles(chart: oc.Chart, count: int) -> Iterator[str]:
    """Closed pick cycles of tool and base, in 200 steps each: what is left over of heading and joints after them."""
    home, steps = chart.problem.domain.centre, 200
    start, along = (
        chart.phi(home),
        chart.jacobian(home)[chart.m :, :2],
    )  # xi of a motion of the base with all it carries
    shifts, tools = np.zeros((steps, 2)), np.zeros((steps, chart.m))
    s = 2 * np.pi * np.arange(1, steps + 1) / steps
    shifts[:] = 2 * np.column_stack([np.cos(s) - 1, np.sin(s)])
    tools[:, :2] = shifts + 0.08 * np.column_stack([np.sin(2 * s), np.sin(s)])
    tools[:, 2] = 0.05 * np.sin(s) ** 2
    tracker = chart.tracker(home, largest_step=1.0)
    q = np.array(home)
    for _ in range(count):
        for tool, shift in zip(tools, shifts, strict=True):
            tracker.step(start + np.concatenate([tool, along @ shift]))
            q += np.linalg.pinv(chart.jacobian(q)[: chart.m]) @ (start[: chart.m] + tool - chart.x(q))
    for name, end in (("xi on a closed path", tracker.q), ("least-norm steps", q)):
        yield f"| {name} | {abs(end[2] - home[2]):.0e} | {np.abs(end - home).max():.0e} |"


def main(quick: bool = False) -> None:
    """Print the tables."""
    charts: list[oc.Chart] = []

    def rows() -> Iterator[str]:
        for row, chart in fits(quick):
            charts.append(chart)
            yield row

    table(
        "| robot and task | n, m, r | fit | time of a core [s] | leak rms [deg] | least conditioning |\n"
        + "|"
        + " --- |" * 6,
        rows(),
    )
    table("\n| joints | compile [s] | PD+ tick [us] |\n" + "|" + " --- |" * 3, [in_c(charts[0])])
    links = ["right_gripper"] if quick else ["right_gripper", "right_lower_forearm", "right_lower_elbow"]
    header = "\n| pushed at | stiffness | slowest mode [Hz] | largest error [mm] | [deg] | 1 s later [mm] | [deg] |\n"
    table(header + "|" + " --- |" * 7, (pushed(charts[0], link, *law) for law in laws(charts[0]) for link in links))
    grip, mobile = charts[0], charts[-1]
    proofs = [proved("baxter, relative pose of the hands", grip, 2 if quick else 60)]
    if not quick:
        proofs.append(proved("mobile panda, pose, at every place and heading", mobile, 60))
    table("\n| no fold | share proved | boxes judged | time of a core [s] |\n" + "|" + " --- |" * 4, proofs)
    if not quick:
        header = "\n| after 100 pick cycles | heading off [rad] | joints and base off [rad] or [m] |\n"
        table(header + "|" + " --- |" * 3, cycles(mobile, 100))


if __name__ == "__main__":
    run(main, __doc__)
