"""Mass matrix and bias of the 7-DoF arm in compiled C: ours against adam-robotics and Pinocchio's C++ from Python."""

import tempfile
import time
from pathlib import Path

import adam
import casadi as ca
import numpy as np
import pinocchio as pin
from adam.casadi import KinDynComputations
from benchmark import run
from c_timing import nanoseconds_per_call

import orthocas as oc
from orthocas.problems import iiwa

WORDS = {
    "orthocas": "orthocas",
    "adam_robotics": "adam-robotics 0.5, compiled the same way",
    "generated_library": "the library that `orthocas codegen` writes, with gravity and a status beside them",
    "pinocchio_from_python": "Pinocchio 4.1, C++ called from Python (call overhead included)",
}


def main(quick: bool = False) -> dict[str, float]:
    """Print nanoseconds per call, medians of 9 alternating rounds in one process; `quick`: few calls of Pinocchio."""
    robot = iiwa.robot()
    q, dq = ca.SX.sym("q", robot.n), ca.SX.sym("dq", robot.n)
    ours = [robot.function("mass_matrix")(q), robot.function("bias")(q, dq)]
    with iiwa.urdf_path() as path:
        peer = KinDynComputations(str(path), list(robot.joint_names))
        model = pin.buildModelFromUrdf(str(path))
    peer.set_frame_velocity_representation(adam.Representations.MIXED_REPRESENTATION)
    base, still = ca.SX.eye(4), ca.SX.zeros(6)
    M = ca.SX(peer.mass_matrix_fun()(base, q))[6:, 6:]
    bias = ca.SX(peer.bias_force_fun()(base, q, still, dq))[6:]
    functions = {
        "orthocas": ca.Function("orthocas", [q, dq], ours),
        "adam_robotics": ca.Function("adam_robotics", [q, dq], [M, bias]),
    }
    state = np.full(robot.n, 0.3)
    np.testing.assert_allclose(
        functions["orthocas"](state, state)[0].full(), functions["adam_robotics"](state, state)[0].full(), atol=1e-10
    )
    functions["generated_library"] = ca.Function("generated_library", [q, dq], [*ours, robot.function("gravity")(q)])
    with tempfile.TemporaryDirectory() as folder:
        times = nanoseconds_per_call(functions, sources={"generated_library": _generated(Path(folder))})
    times["pinocchio_from_python"] = _pinocchio_nanoseconds(model, 100 if quick else 20_000)
    times["ratio"] = times["orthocas"] / times["adam_robotics"]
    print("| library | ns per call |\n| --- | --- |")
    for name, words in WORDS.items():
        print(f"| {words} | {times[name]:.0f} |")
    return times


def _generated(folder: Path) -> str:
    """C that calls the functions of `orthocas codegen`: mass matrix, bias and gravity, with a status."""
    chart = oc.fit(iiwa.iiwa(), oc.Linear()).chart
    generated = oc.generate_c(chart, folder, None, "arm")
    return f"""
#include "{generated.folder / "arm.c"}"
int generated_library(const double** arg, double** res, long long* iw, double* w, int mem) {{
  return arm_dynamics(arg[0], arg[1], res[0], res[1], res[2]) > ARM_OUTSIDE_DOMAIN;
}}
"""


def _pinocchio_nanoseconds(model: pin.Model, calls: int) -> float:
    data, q = model.createData(), np.full(model.nq, 0.3)
    start = time.perf_counter()
    for _ in range(calls):
        pin.crba(model, data, q)
        pin.nonLinearEffects(model, data, q, q)
    return (time.perf_counter() - start) / calls * 1e9


if __name__ == "__main__":
    run(main, __doc__)
