"""Computing time for 10 s of closed loop: SUNDIALS and compiled C against SciPy, continuous and at 1 kHz (2 min).

The peer is solve_ivp (LSODA, SciPy's multi-step method, same tolerance) on the CasADi functions of controller and
robot, restarted at every step of the reference. Functions are built and compiled before the clock starts. Our times
include the check of the reference and the energy balance. Errors are distances from a run at tolerance 1e-12.
"""

import time
from collections.abc import Callable
from statistics import median

import numpy as np
from benchmark import run, timed
from scipy.integrate import solve_ivp

import orthocas as oc
from orthocas import problems
from orthocas.control import PDPlus, Reference
from orthocas.tools.checks import Array

TOLERANCE = 1e-8
DURATION = 10.0  # [s]
STIFFNESS = 100.0
WEIGHTS = (1000.0, 30.0, 150.0, 0.1)
HEADER = "| arm | SciPy | CVODES | compiled | at 1 kHz: CVODES | compiled |\n| --- | --- | --- | --- | --- | --- |"
SHOWN = ("SciPy LSODA", "continuous", "continuous, compiled", "sampled at 1 kHz", "sampled at 1 kHz, compiled")


def chart_of(name: str, degree: int) -> oc.Chart:
    """The named problem with A = M."""
    known = problems.get(name)
    problem = oc.Problem(known.robot, known.task, "inertia", known.domain, name)
    return oc.fit(problem, oc.Polynomial(degree), weights=WEIGHTS).chart


def interleaved(chart: oc.Chart) -> Reference:
    """Steps in x and xi1, forth and back."""
    start = chart.phi(chart.problem.domain.centre)
    changes = [(1.0, {"x": start[0] + 0.015}), (3.0, {"xi1": 0.02}), (5.0, {"x": start[0]}), (7.0, {"xi1": 0.0})]
    return Reference.steps(chart.labels, start, changes, DURATION)


def by_scipy(law: PDPlus, reference: Reference) -> Array:
    """Joint positions at the end."""
    robot, n = law.problem.robot, law.problem.n
    gains, forward = list(law.gains.values()), robot.function("forward_dynamics")

    def rate(t: float, state: Array, segment: int) -> Array:
        wanted = reference.profile(t - reference.times[segment], reference.parameters[segment])
        tau = law.function(state[:n], state[n:], *wanted, *gains)[0]
        return np.concatenate([state[n:], np.asarray(forward(state[:n], state[n:], tau)).ravel()])

    state = np.concatenate([law.problem.domain.centre, np.zeros(n)])
    for segment, span in enumerate(zip(reference.times[:-1], reference.times[1:], strict=True)):
        run = solve_ivp(rate, span, state, "LSODA", rtol=TOLERANCE, atol=TOLERANCE, args=(segment,))
        state = run.y[:, -1]
    return np.asarray(state[:n])


def of_robots(law: PDPlus, reference: Reference, q0: Array) -> tuple[oc.simulation.Trajectory, ...]:
    """Runs with 20 robots of different masses, the last one as in the law's model."""
    changes = [{"plant": law.problem.robot.with_scaled_masses(scale)} for scale in np.linspace(0.99, 1.0, 20)]
    return oc.simulate_many(law, reference, q0, changes, control_rate=1000.0, compiled=True)


def runs(law: PDPlus, reference: Reference, q0: Array) -> dict[str, Callable[[], Array]]:
    """The runs to time; each returns the joint positions at the end."""
    return {
        "continuous": lambda: oc.simulate(law, reference, q0).q[-1],
        "continuous, compiled": lambda: oc.simulate(law, reference, q0, compiled=True).q[-1],
        "sampled at 1 kHz": lambda: oc.simulate(law, reference, q0, control_rate=1000.0).q[-1],
        "sampled at 1 kHz, compiled": lambda: oc.simulate(law, reference, q0, control_rate=1000.0, compiled=True).q[-1],
        "20 robots at 1 kHz, compiled": lambda: of_robots(law, reference, q0)[-1].q[-1],
        "SciPy LSODA": lambda: by_scipy(law, reference),
    }


def main(quick: bool = False) -> dict[str, float]:
    """Print a table; return seconds for 10 s and errors [rad] by arm and kind of run."""
    found = {}
    rounds = 1 if quick else 5
    print(HEADER)
    for name, degree in (("planar_3r_x", 4 if quick else 8), *(() if quick else (("iiwa", 3),))):
        chart = chart_of(name, degree)
        law, reference, q0 = (
            PDPlus(chart, STIFFNESS, coupling="decoupled"),
            interleaved(chart),
            chart.problem.domain.centre,
        )
        law.function, law.energy  # noqa: B018 (built before the clock starts)
        begin = time.perf_counter()
        oc.simulate(law, reference, q0, compiled=True)
        found[f"{name} first compiled run"] = time.perf_counter() - begin
        exact = oc.simulate(law, reference, q0, tolerance=1e-12).q[-1]
        for kind, work in runs(law, reference, q0).items():
            each, end = timed(work, 1 if kind == "SciPy LSODA" else rounds)
            seconds = median(each)
            found[f"{name} {kind}"] = seconds
            found[f"{name} {kind} error"] = float(np.abs(end - exact).max())
        cells = " | ".join(f"{found[f'{name} {kind}']:.3f}" for kind in SHOWN)
        print(f"| {chart.problem.robot.n} joints, degree {degree} | {cells} |", flush=True)
    return found


if __name__ == "__main__":
    run(main, __doc__)
