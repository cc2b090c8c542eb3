"""Fits of linear families give the same numbers for any number of threads, and BLAS has its own back afterwards."""

import os
import subprocess
import sys
import time
from pathlib import Path
from threading import Barrier, Thread

import numpy as np
import pytest
from threadpoolctl import threadpool_info

import orthocas as oc
from orthocas import solvers
from orthocas.fitting import basis_objective
from orthocas.solvers.protocol import Solver
from orthocas.tools.batch import one_blas_thread, run_in_threads, run_in_threads_with, use_threads


def blas_threads() -> list[int]:
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


@pytest.mark.parametrize("count", [1, 3])
def test_results_come_in_order(count: int) -> None:
    def late(k: int) -> int:
        time.sleep(0.01 * (k == 0))
        return k * k

    with use_threads(count):
        assert run_in_threads(late, range(7)) == [k * k for k in range(7)]
        assert run_in_threads(late, []) == []
        with pytest.raises(ZeroDivisionError):
            run_in_threads(lambda k: 1 // k, range(3))


def test_after_an_exception_no_piece_is_at_work() -> None:
    """Scratch memory can be used again at once."""
    busy: list[int] = []

    def work(k: int) -> None:
        if k == 0:
            raise KeyError
        busy.append(k)
        time.sleep(0.05)
        busy.remove(k)

    with use_threads(3):
        for _ in range(3):
            with pytest.raises(KeyError):
                run_in_threads(work, range(20))
            assert not busy


def test_threads_within_threads_do_not_wait_for_each_other() -> None:
    with use_threads(2):
        found = run_in_threads(lambda k: sum(run_in_threads(lambda i: i, range(k))), range(6))
    assert found == [0, 0, 1, 3, 6, 10]


def test_a_tool_serves_one_piece_at_a_time() -> None:
    tools: list[list[int]] = [[], [], []]

    def work(tool: list[int], piece: int) -> int:
        tool.append(piece)
        time.sleep(0.001)
        assert tool.pop() == piece
        return piece

    with use_threads(3):
        assert run_in_threads_with(tools, work, range(60)) == list(range(60))


def test_normal_blocks_are_sums_of_products() -> None:
    """Against the dense sum in double precision; and 1, 2 and 5 threads agree to the last bit."""
    rng, K = np.random.default_rng(5), 23
    gradients = [rng.normal(size=(1300, 4, width)).astype(np.float32) for width in (K, 9)]
    derivatives = [rng.normal(size=(1300, 3, 4)).astype(np.float32) for _ in range(2)]
    X = [D.astype(float) @ G.astype(float) for D, G in zip(derivatives, gradients, strict=True)]
    found = []
    for count in (1, 2, 5):
        with use_threads(count):
            found.append(basis_objective.build_normal_matrix(derivatives, gradients, [(1, 0, 2, 1)]))
    for j, part in enumerate((slice(K), slice(K, None))):
        np.testing.assert_allclose(found[0][part, part], np.einsum("srk,srl->kl", X[j], X[j]), rtol=0, atol=5e-2)
    np.testing.assert_allclose(found[0][K:, :K], X[1][:, 2].T @ X[0][:, 1], rtol=0, atol=5e-2)  # of sums near 1e4
    np.testing.assert_array_equal(found[0][:K, K:], found[0][K:, :K].T)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [solvers.GaussNewton(), solvers.LBFGS(max_iterations=20), solvers.Adam(epochs=2), solvers.GradientFlow(8)],
    ids=lambda solver: solver.name,
)
def test_threads_do_not_change_a_fit(planar_x: oc.Problem, solver: Solver) -> None:
    found = []
    for count in (1, 2, 5):
        fit = oc.fit(planar_x, oc.Polynomial(3), solver, samples=3000, weights=(1000, 30, 150, 0.1), threads=count)
        found.append(fit.chart.coordinates.theta)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.slow
def test_threads_do_not_change_a_network(planar_x: oc.Problem) -> None:
    """Pieces of samples in a fixed order, more than one, in both precisions."""
    settings = {"samples": 1000, "weights": (1000, 30)}
    for precision in ("double", "single"):
        found = [
            oc.fit(planar_x, oc.MLP((300, 4)), solvers.LBFGS(4), **settings, threads=count, precision=precision)
            for count in (1, 3)
        ]
        np.testing.assert_array_equal(*(fit.chart.coordinates.theta for fit in found))


def test_threads_do_not_change_a_bounded_fit(planar_x: oc.Problem) -> None:
    found = []
    for count in (1, 3):
        fit = oc.fit(planar_x, oc.Polynomial(2), samples=1500, max_mutual_deg=3.0, threads=count)
        found.append(fit.chart.coordinates.theta)
    np.testing.assert_array_equal(found[1], found[0])


def test_blas_has_its_threads_back() -> None:
    """Two blocks that overlap in two threads: one thread until the end of the second, whichever began first."""
    before, gate, seen = blas_threads(), Barrier(2), []

    def first() -> None:
        with one_blas_thread():
            gate.wait(60)  # the second has begun

    other = Thread(target=first)
    other.start()
    with one_blas_thread():
        gate.wait(60)
        other.join()
        seen = blas_threads()
    assert seen == [1] * len(before)
    assert blas_threads() == before
    with pytest.raises(KeyError), one_blas_thread():
        raise KeyError
    assert blas_threads() == before


CODE = """
import os, sys
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = sys.argv[1]
import numpy as np
import orthocas as oc
from orthocas import problems, solvers
from orthocas.tools.batch import THREADS
from threadpoolctl import threadpool_info

assert THREADS == int(sys.argv[1])
assert {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"} == {THREADS}
iiwa, planar = problems.get("iiwa"), problems.get("planar_3r_x")
fits = [
    oc.fit(iiwa, oc.Polynomial(3), solvers.GaussNewton(max_iterations=2), samples=2000),
    oc.fit(iiwa, oc.Polynomial(2), solvers.GaussNewton(max_iterations=2), weights=(1000, 30, 150, 0.1)),
    oc.fit(iiwa, oc.Polynomial(2), solvers.LBFGS(max_iterations=5), samples=2000),
    oc.fit(planar, oc.Polynomial(5), solvers.GradientFlow(max_iterations=3), samples=3000),
    oc.fit(planar, oc.Polynomial(5), solvers.Adam(epochs=1), samples=3000),
]
np.savez(sys.argv[2], *(fit.chart.coordinates.theta for fit in fits))
"""


FORKED = """
import os, sys, warnings
import numpy as np
import orthocas as oc
from orthocas import problems

warnings.simplefilter("ignore")  # Python's warning about processes that fork while they have threads
problem = problems.get("planar_3r_xy")
fits = [oc.fit(problem, oc.Polynomial(2), samples=2000, threads=2).chart.coordinates.theta]
child = os.fork()
if not child:
    fits.append(oc.fit(problem, oc.Polynomial(2), samples=2000, threads=2).chart.coordinates.theta)
    os._exit(0 if np.array_equal(*fits) else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_starts_threads_of_its_own() -> None:
    assert subprocess.run([sys.executable, "-c", FORKED], check=False, timeout=60).returncode == 0


@pytest.mark.nightly
def test_processes_with_one_and_two_threads_find_the_same(tmp_path: Path) -> None:
    """Whole processes, BLAS and all, to 1e-12: rounding in single precision would show at 1e-5."""
    for count in ("1", "2"):
        subprocess.run([sys.executable, "-c", CODE, count, str(tmp_path / f"{count}.npz")], check=True)
    with np.load(tmp_path / "1.npz") as one, np.load(tmp_path / "2.npz") as two:
        assert len(one.files) == 5
        for name in one.files:
            np.testing.assert_allclose(two[name], one[name], rtol=0, atol=1e-12 * np.abs(one[name]).max())


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_workers_of_a_scheduler_keep_freed_memory() -> None:
    """Dask starts workers with a low threshold; each freed array was mapped anew, page by page."""
    code = (
        "import resource; import numpy as np; from orthocas.tools.processes import keep_freed_memory\n"
        "keep_freed_memory() if {} else None\n"
        "for _ in range(300): np.ones(100_000)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "for _ in range(300): np.ones(100_000)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)"
    )
    environment = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}
    faults = []
    for keep in (True, False):
        words = [sys.executable, "-c", code.format(keep)]
        faults.append(int(subprocess.run(words, env=environment, capture_output=True, check=True).stdout))
    assert faults[0] < 1000
    assert faults[1] > 10_000
