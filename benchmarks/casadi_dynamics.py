"""CasADi dynamics of robot files: operations and times of orthocas and adam-robotics in C, and of Pinocchio in C++.

All in one run, on one core. The CasADi functions are compiled together (gcc -O3 -march=native). Pinocchio's program is
compiled with -O3 against the headers and libraries of the wheel, whose processor is the common one, so without
-march=native; `--quick` leaves it out, and needs adam-robotics only if it is there.
"""

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from benchmark import run, table
from c_timing import nanoseconds_per_call

import orthocas as oc
from orthocas.robots.urdf import find_robot_file

ROOT = Path(__file__).parent.parent
HEADER = (
    "| robot | function | operations: orthocas | adam | ns: orthocas | adam | Pinocchio, C++ |\n" + "| --- " * 7 + "|"
)
#: as Pinocchio itself is compiled
_DEFINED = (
    *("-DNDEBUG", "-DPINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION", "-DBOOST_MPL_LIMIT_LIST_SIZE=30"),
    *("-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS", "-DBOOST_FUSION_INVOKE_MAX_ARITY=12"),
)
ROUNDS = 300  #: of 1000 calls; the fastest counts, so other work on the machine does not
LARGEST = 60_000  #: operations of a function that is compiled; gcc takes many minutes for more
FUNCTIONS = ("mass matrix", "inverse dynamics", "its derivatives", "forward dynamics", "tip Jacobian")


@dataclass(frozen=True)
class Case:
    """A robot file with its tips."""

    name: str
    file: str  #: in this repository, or a name of example-robot-data
    tips: tuple[str, ...]

    @property
    def path(self) -> Path:
        """The URDF file."""
        return ROOT / self.file if "/" in self.file else find_robot_file(self.file)


CASES = (
    Case("iiwa, 7 joints", "problems/data/iiwa7_r800.urdf", ("link_ee",)),
    Case("panda, 7 joints", "panda", ("panda_hand",)),
    Case(
        "talos, 28 joints",
        "talos_full_v2",
        ("gripper_left_base_link", "gripper_right_base_link", "left_sole_link", "right_sole_link"),
    ),
)
_PROGRAM = r"""
#include <chrono>
#include <iostream>
#include <string>
#include "pinocchio/multibody.hpp"
#include "pinocchio/serialization.hpp"
#include "pinocchio/algorithm/aba.hpp"
#include "pinocchio/algorithm/crba.hpp"
#include "pinocchio/algorithm/frames.hpp"
#include "pinocchio/algorithm/rnea.hpp"
#include "pinocchio/algorithm/rnea-derivatives.hpp"

template <class F> void time_calls(F f) {
  double best = 1e300;
  for (int round = 0; round < 300; ++round) {
    auto start = std::chrono::steady_clock::now();
    for (int k = 0; k < 1000; ++k) f(k % 64);
    std::chrono::duration<double, std::nano> passed = std::chrono::steady_clock::now() - start;
    best = std::min(best, passed.count() / 1000);
  }
  std::cout << best << std::endl;
}

int main(int, char** argv) {
  pinocchio::Model model;
  model.loadFromText(argv[1]);
  pinocchio::Data data(model);
  auto tip = model.getFrameId(argv[2]);
  std::vector<Eigen::VectorXd> q, v, a;
  for (int k = 0; k < 64; ++k) {
    q.push_back(Eigen::VectorXd::Random(model.nq));
    v.push_back(Eigen::VectorXd::Random(model.nv));
    a.push_back(Eigen::VectorXd::Random(model.nv));
  }
  Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, model.nv);
  time_calls([&](int k) { pinocchio::crba(model, data, q[k]); });
  time_calls([&](int k) { pinocchio::rnea(model, data, q[k], v[k], a[k]); });
  time_calls([&](int k) { pinocchio::computeRNEADerivatives(model, data, q[k], v[k], a[k]); });
  time_calls([&](int k) { pinocchio::aba(model, data, q[k], v[k], a[k]); });
  time_calls([&](int k) {
    pinocchio::computeFrameJacobian(model, data, q[k], tip, pinocchio::LOCAL_WORLD_ALIGNED, J);
  });
}
"""


def main(quick: bool = False) -> dict[str, float]:
    """Print operations and nanoseconds of each function of each robot; nanoseconds of ours by robot and function."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        program = None if quick else build_program(Path(folder))
        cases = CASES[: 1 if quick else None]
        table(HEADER, (row for case in cases for row in measure(case, program, found)))
    return found


def measure(case: Case, program: Path | None, found: dict[str, float]) -> Iterator[str]:
    """The rows of one robot. orthocas and adam are compared at a random state before they are timed."""
    path = case.path
    robot = oc.Robot.from_urdf(path, tips=case.tips)
    ours = list(build_ours(robot, case.tips[0]))
    peers = list(build_adam(path, robot, case.tips[0])) if find_spec("adam") else [None] * len(ours)
    state = np.random.default_rng(0).uniform(-1, 1, (3, robot.n))
    for mine, other in zip(ours, peers, strict=True):
        if other is not None:
            for a, b in zip(mine.call(list(state)), other.call(list(state)), strict=True):
                np.testing.assert_allclose(np.array(a), np.array(b), atol=1e-9)
    functions = {f"ours_{k}": mine for k, mine in enumerate(ours)}
    functions |= {f"adam_{k}": other for k, other in enumerate(peers) if other is not None}
    functions = {name: each for name, each in functions.items() if each.n_instructions() <= LARGEST}
    times = nanoseconds_per_call(functions, rounds=ROUNDS if program else 9, calls=1000, pick=min)
    cpp = ["-"] * len(ours)
    if program:
        cpp = [f"{ns:.0f}" for ns in time_pinocchio(program, path, robot, case.tips[0])]
    for k, name in enumerate(FUNCTIONS):
        other = peers[k]
        mine, theirs = (f"{times[key]:.0f}" if key in times else "-" for key in (f"ours_{k}", f"adam_{k}"))
        found[f"{case.name}, {name}"] = times.get(f"ours_{k}", float("nan"))
        yield (
            f"| {case.name} | {name} | {ours[k].n_instructions():,} "
            f"| {'fails' if other is None else f'{other.n_instructions():,}'} | {mine} | {theirs} | {cpp[k]} |"
        )


def build_ours(robot: oc.Robot, tip: str) -> Iterator[ca.Function]:
    """Functions of (q, dq, ddq or torque), in the order of FUNCTIONS."""
    q, dq, a = (ca.SX.sym(name, robot.n) for name in ("q", "dq", "a"))
    tau = robot.function("inverse_dynamics")(q, dq, a)
    yield ca.Function("mass", [q, dq, a], [robot.function("mass_matrix")(q)])
    yield ca.Function("inverse", [q, dq, a], [tau])
    yield ca.Function("derivatives", [q, dq, a], [ca.densify(ca.jacobian(tau, s)) for s in (q, dq)])
    yield ca.Function("forward", [q, dq, a], [robot.function("forward_dynamics")(q, dq, a)])
    yield ca.Function("jacobian", [q, dq, a], [robot.frame_function("jacobian", tip)(q)])


def build_adam(path: Path, robot: oc.Robot, tip: str) -> Iterator[ca.Function | None]:
    """The same by adam-robotics, with a base at rest; None for what it raises on."""
    import adam  # only here: the quick mode does without
    from adam.casadi import KinDynComputations

    q, dq, a = (ca.SX.sym(name, robot.n) for name in ("q", "dq", "a"))
    peer = KinDynComputations(str(path), list(robot.joint_names), gravity=np.array([0, 0, -9.81, 0, 0, 0]))
    peer.set_frame_velocity_representation(adam.Representations.MIXED_REPRESENTATION)
    base, still = ca.SX.eye(4), ca.SX.zeros(6)

    def torque() -> Any:
        M, h = ca.SX(peer.mass_matrix_fun()(base, q)), ca.SX(peer.bias_force_fun()(base, q, still, dq))
        return M[6:, 6:] @ a + h[6:]

    def forward() -> Any:
        M, h = ca.SX(peer.mass_matrix_fun()(base, q)), ca.SX(peer.bias_force_fun()(base, q, still, dq))
        return ca.solve(M[6:, 6:], a - h[6:])

    expressions: tuple[Callable[[], list[Any]], ...] = (
        lambda: [ca.SX(peer.mass_matrix_fun()(base, q))[6:, 6:]],
        lambda: [torque()],
        lambda: [ca.densify(ca.jacobian(torque(), s)) for s in (q, dq)],
        lambda: [forward()],
        lambda: [ca.SX(peer.jacobian_fun(tip)(base, q))[:, 6:]],
    )
    for expression in expressions:
        try:
            yield ca.Function("peer", [q, dq, a], expression())
        except RuntimeError:
            yield None


def time_pinocchio(program: Path, path: Path, robot: oc.Robot, tip: str) -> list[float]:
    """Nanoseconds per call of Pinocchio's algorithms in C++, in the order of FUNCTIONS."""
    whole, model = pin.buildModelFromUrdf(str(path)), program.with_name("model.txt")
    locked = [k for k in range(1, whole.njoints) if whole.names[k] not in robot.joint_names]
    pin.buildReducedModel(whole, locked, pin.neutral(whole)).saveToText(str(model))
    printed = subprocess.run([str(program), str(model), tip], check=True, capture_output=True, text=True).stdout
    return [float(line) for line in printed.split()]


def build_program(folder: Path) -> Path:
    """The program of Pinocchio, compiled in a folder; takes a minute or more."""
    prefix = next(root for root in Path(pin.__file__).parents if (root / "include" / "pinocchio").exists())
    eigen = next(root for root in (Path("/usr/include/eigen3"), prefix.parent / "include") if (root / "Eigen").exists())
    source, program = folder / "time.cpp", folder / "time"
    source.write_text(_PROGRAM)
    libraries = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", "-lpinocchio_default", "-lboost_serialization"]
    command = ["g++", "-std=c++17", "-O3", *_DEFINED, f"-I{prefix / 'include'}", f"-I{eigen}"]
    subprocess.run([*command, str(source), "-o", str(program), *libraries], check=True)
    return program


if __name__ == "__main__":
    run(main, __doc__)
