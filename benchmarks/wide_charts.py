"""Wide charts of arms that nobody tuned: time, regular share, quality, targets found, loops closed (20 min)."""

import time
from importlib.metadata import files
from pathlib import Path

import casadi as ca
import numpy as np
from benchmark import run, table
from c_timing import nanoseconds_per_call
from numpy.typing import NDArray

import orthocas as oc
from orthocas.charts.trackers import TrackerStatus
from orthocas.errors import DomainError, PathError
from orthocas.native.kernels import generate_kernels, share_sines
from orthocas.tasks.problem import relative_singular_values
from orthocas.tasks.regular_box import find_joint_range
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.display import percent

Numbers = NDArray[np.float64]
DATA, SUITE = "example-robot-data", "robosuite"
TORSO = {"torso_1_joint": 0.0, "torso_2_joint": 0.0}
ROBOTS: dict[str, tuple[str, str, str, dict[str, float]]] = {  # package, file, tip, locked joints
    "panda": (DATA, "panda_description/urdf/panda.urdf", "panda_hand", {}),
    "xarm7": (DATA, "xarm_description/urdf/xarm7.urdf", "link_eef", {}),
    "baxter, left": (DATA, "baxter_description/urdf/baxter.urdf", "left_gripper_base_link", {}),
    "sawyer": (SUITE, "sawyer_description/urdf/sawyer_arm.urdf", "right_l6", {}),
    "gen3": (SUITE, "robots/kinova3/robot.xml", "right_hand", {}),
    "tiago": (DATA, "tiago_description/robots/tiago_no_hand.urdf", "arm_7_link", {"torso_lift_joint": 0.1}),
    "pr2, left": (DATA, "pr2_description/urdf/pr2.urdf", "l_gripper_tool_frame", {"torso_lift_joint": 0.1}),
    "talos, left": (DATA, "talos_data/robots/talos_reduced.urdf", "arm_left_7_link", TORSO),
    "z1": (DATA, "z1_description/urdf/z1.urdf", "link06", {}),
    "tiago pro, lift and left": (DATA, "tiago_pro_description/robots/tiago_pro.urdf", "arm_left_tool_link", {}),
    "centauro, torso and arm": (DATA, "centauro_description/urdf/centauro.urdf", "arm1_8", {}),
}
OTHER_TASKS = {"z1": "position+axis:x"}  # of an arm with six joints and a tool that may turn about its axis
ACROSS = ("z1", "position+axis:z")  # the axis of the tool lies across that of the last joint
ARMS = ("iiwa", "panda", "xarm7", "baxter, left", "gen3", "sawyer", "tiago", "pr2, left", "talos, left")
CONTROL = tuple(name for name in ARMS if name != "pr2, left")  # one coordinate, in the inertia metric
POSITIONS = (*ARMS, "z1")
WHOLE = (("iiwa", "pose"), ("panda", "pose"), ("xarm7", "pose"), ("iiwa", "position"), ("panda", "position"))
NEARER = 0.05  # clearance
HEADER = (
    "| arm, task | branch, its share | fit [s CPU] | regular share | leak rms [deg] | conditioning mean, 1 % "
    "| targets found | C of phi, J [us] |\n|" + " --- |" * 8
)
CLEARER = "| arm, pose | branch | regular share | conditioning mean, 1 % |\n|" + " --- |" * 4
TARGETS = "| arm, task | branches | targets | found, of all clear ones |\n|" + " --- |" * 4
LOOPS = (
    "| arm | radius [m] | closed, xi held | left over [rad] | closed, xi held or scheduled | left over at most [rad] "
    "| closed, pseudo-inverse | it leaves over [rad] |\n|" + " --- |" * 8
)
STEPS, WAYPOINTS = 300, 30  #: of a circle


def robot_of(name: str) -> oc.Robot:
    """The 7-DoF arm, or a robot of a package."""
    if name not in ROBOTS:
        return oc.problems.get(name).robot
    package, file, tip, locked = ROBOTS[name]
    path = next(Path(str(f.locate())).resolve() for f in files(package) or [] if str(f).endswith(file))
    return oc.Robot.from_file(path, tip, locked or None)


def row(name: str, task: str, metric: str, quick: bool, charts: dict[str, oc.Chart]) -> str:
    """One row of the table: the chart of the home's branch, default settings. Charts of poses with A = I are kept."""
    robot, start = robot_of(name), time.process_time()
    polynomial = oc.Polynomial(3, ["A1", "A7"]) if quick else None
    samples = 3000 if quick else None
    fit = oc.fit_wide(robot, oc.Task.named(robot, task), None, metric, parametrisation=polynomial, samples=samples)
    seconds, chart, branch = time.process_time() - start, fit.chart, fit.branch
    assert branch is not None
    words = f"{name}, {task}"
    if metric == "inertia":
        words += ", A = M"
    elif task == "pose":
        charts[name] = chart
    report = oc.evaluate(chart, 2000 if quick else 20_000, seed=1)
    targets = chart.phi(sample_uniform(chart.problem.domain, 50 if quick else 2000, 2))
    share, regular = percent(branch.share, 0), percent(fit.regular_share, 3)
    return (
        f"| {words} | {branch.name}, {share} | {seconds:.1f} | {regular} "
        f"| {report.leak.rms:.1f} | {report.conditioning.mean:.2f}, {report.conditioning.p01:.2f} "
        f"| {percent(chart.solve(targets).found.mean(), 2)} | {time_in_c(chart, quick):.2f} |"
    )


def time_in_c(chart: oc.Chart, quick: bool) -> float:
    """Time of phi and J as in generated files, by gcc -O3 [us]."""
    q = ca.MX.sym("q", chart.n)
    both = ca.Function("both", [q], [chart.function("phi")(q), chart.function("jacobian")(q).T])
    code = generate_kernels(share_sines([both]), "own").code
    call = "int chart(const double** arg, double** res, long long* iw, double* w, int mem)"
    source = f"#include <math.h>\n{code}\n{call} {{ return own_both(arg, res, (int*)iw, w, mem); }}\n"
    times = nanoseconds_per_call({"chart": both}, 3 if quick else 15, 2000, {"chart": source})
    return times["chart"] / 1e3


def nearer(name: str, quick: bool) -> str:
    """One row: a chart that goes nearer to singular positions."""
    robot = robot_of(name)
    polynomial = oc.Polynomial(3, ["A1", "A7"]) if quick else None
    fit = oc.fit_wide(robot, oc.Task.pose(robot), clearance=NEARER, parametrisation=polynomial)
    found = oc.evaluate(fit.chart, 2000 if quick else 20_000, seed=1).conditioning
    assert fit.branch is not None
    return f"| {name} | {fit.branch.name} | {percent(fit.regular_share, 3)} | {found.mean:.2f}, {found.p01:.2f} |"


def everywhere(name: str, task: str, quick: bool) -> str:
    """One row: (x, xi) of clear positions of the joint range, each solved from no start by the chart of its branch."""
    robot = robot_of(name)
    whole = oc.branches(robot, oc.Task.named(robot, task))
    box, wanted = find_joint_range(robot, 0), 40 if quick else 10_000
    q = sample_uniform(oc.Box(box.centre, box.half_width), 4 * wanted, 3)
    judge = oc.Problem(robot, oc.Task.named(robot, task), domain=oc.Box(box.centre, box.half_width))
    q = q[relative_singular_values(judge, q) > 0.1][:wanted]
    polynomial = oc.Polynomial(3, ["A1", "A7"]) if quick else None
    found = 0
    for branch in list(whole)[:1] if quick else whole:
        own = q[branch.box.contains(q)]
        try:
            chart = oc.fit_wide(robot, oc.Task.named(robot, task), branch, parametrisation=polynomial).chart
        except DomainError:
            continue  # none of its targets is found
        found += int(chart.solve(chart.phi(own)).found.sum())
    return f"| {name}, {task} | {len(whole)} | {len(q):,} | {percent(found / len(q), 2)} |"


def circle(robot: oc.Robot, q: Numbers, radius: float) -> Numbers:
    """Positions of a circle in the y-z plane that begins and ends at the tip, (STEPS, 3)."""
    angles = np.linspace(0, 2 * np.pi, STEPS + 1)[1:]
    around = np.stack([0 * angles, 1 - np.cos(angles), np.sin(angles)], axis=1)
    return np.asarray(robot.tip_position(q) + radius * around)


def with_chart(chart: oc.Chart, q: Numbers, path: Numbers) -> float:
    """What a circle with xi held leaves over in the joints; NaN if it cannot be followed inside the domain."""
    tracker, phi = chart.tracker(q), chart.phi(q)
    for position in path:
        now = tracker.step(np.concatenate([position, phi[3:]]))
        if tracker.status != TrackerStatus.OK:
            return float("nan")
    return float(np.abs(now - q).max())


def with_schedule(chart: oc.Chart, q: Numbers, path: Numbers) -> float:
    """The same with xi chosen along the circle."""
    x = chart.x(q)
    tips = path[STEPS // WAYPOINTS - 1 :: STEPS // WAYPOINTS]
    waypoints = np.vstack([x, np.column_stack([tips, np.tile(x[3:], (WAYPOINTS, 1))])])
    try:
        motion = oc.follow(chart, waypoints, "objective", q_start=q)
    except PathError:
        return float("nan")
    return float(np.abs(motion.q[-1] - motion.q[0]).max())


def with_pseudo_inverse(chart: oc.Chart, q: Numbers, path: Numbers) -> float:
    """The same with steps of least norm."""
    task, domain, x = chart.problem.task, chart.problem.domain, chart.phi(q)[:6]
    clear = oc.ClearBox(oc.Box(domain.centre, domain.half_width), task, 0.1, domain.scale)  # type: ignore[attr-defined]
    now = q.copy()
    for position in path:
        for _ in range(4):
            error = np.concatenate([position, x[3:]]) - task.batched(now[None])[0].ravel()
            now = now + np.linalg.pinv(task.batched_jacobian(now[None])[0].reshape(6, -1)) @ error
        if not clear.contains(now):
            return float("nan")
    return float(np.abs(now - q).max())


def loops(name: str, chart: oc.Chart, radius: float, starts: int) -> str:
    """One row: circles of one radius at constant orientation, from starts in the inner three quarters."""
    domain = chart.problem.domain
    drawn = sample_uniform(domain, 40 * starts, 5)
    inner = drawn[(np.abs(drawn - domain.centre) < 0.75 * domain.half_width).all(axis=1)][:starts]
    paths = [circle(chart.problem.robot, q, radius) for q in inner]
    held, least_norm = (
        np.array([follow(chart, q, path) for q, path in zip(inner, paths, strict=True)])
        for follow in (with_chart, with_pseudo_inverse)
    )
    chosen = np.array(
        [h if np.isfinite(h) else with_schedule(chart, q, path) for h, q, path in zip(held, inner, paths, strict=True)]
    )
    words = []
    for left, of_known in ((held, np.median), (chosen, np.max), (least_norm, np.median)):
        known = left[np.isfinite(left)]
        words.append(f"{len(known)} of {len(inner)} | {of_known(known) if len(known) else np.nan:.1e}")
    return f"| {name} | {radius:g} | {' | '.join(words)} |"


def main(quick: bool = False) -> list[str]:
    """All rows; `quick` takes one arm, cubic coordinates and few samples."""
    cases = [(name, OTHER_TASKS.get(name, "pose"), "euclidean") for name in ("iiwa", *ROBOTS)]
    cases += [(name, "pose", "inertia") for name in CONTROL]
    cases += [(*ACROSS, "euclidean"), *((name, "position", "euclidean") for name in POSITIONS)]
    charts: dict[str, oc.Chart] = {}
    rows = table(HEADER, (row(*case, quick, charts) for case in (cases[:1] if quick else cases)))
    rows += table(CLEARER, (nearer(name, quick) for name in (ARMS[:1] if quick else ARMS)))
    rows += table(TARGETS, (everywhere(*case, quick) for case in (WHOLE[:1] if quick else WHOLE)))
    arms = [(name, radius) for name in ("iiwa", "panda") for radius in (0.05, 0.1, 0.2, 0.3)]
    count = 3 if quick else 30
    return rows + table(LOOPS, (loops(name, charts[name], radius, count) for name, radius in arms[: 1 if quick else 8]))


if __name__ == "__main__":
    run(main, __doc__)
