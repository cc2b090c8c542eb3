"""Functions of one sample, called with many: chunks and threads change nothing."""

import os
import pickle
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest

from orthocas.tools import batch
from orthocas.tools.batch import Batched, dense_function


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("N", [1, 64, 65, 512, 1300])
def test_many_samples_give_what_numpy_gives(monkeypatch: pytest.MonkeyPatch, N: int, threads: int) -> None:
    monkeypatch.setattr(batch, "THREADS", threads)
    A, b = ca.SX.sym("A", 2, 3), ca.SX.sym("b", 3)
    function = Batched(dense_function("f", [A, b], [A @ b, ca.diag(b)]))
    rng = np.random.default_rng(7)
    matrices, vectors = rng.normal(size=(N, 2, 3)), rng.normal(size=(N, 3))
    products, diagonals = function(matrices, vectors)
    np.testing.assert_allclose(products, np.einsum("nij,nj->ni", matrices, vectors), rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(diagonals, vectors[:, :, None] * np.eye(3))


@pytest.mark.parametrize(("told", "threads"), [("3", 3), ("1", 1)])
def test_the_environment_tells_how_many_threads(monkeypatch: pytest.MonkeyPatch, told: str, threads: int) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", told)
    assert batch._count_cores() == threads


def test_without_a_wish_every_core_gets_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 2, 5}, raising=False)
    for told in ("", "0", "-2", "many"):
        monkeypatch.setenv("OMP_NUM_THREADS", told)
        assert batch._count_cores() == 3


def test_results_of_single_calls_stay_when_the_next_one_comes() -> None:
    """Memory is kept from call to call, for each thread its own."""
    x = ca.SX.sym("x", 2)
    batched = Batched(dense_function("f", [x], [ca.vertcat(x[0] + x[1], x[0] * x[1]), x @ x.T]))
    again = pickle.loads(pickle.dumps(batched))
    points = np.random.default_rng(0).normal(size=(200, 1, 2))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda k: (batched, again)[k % 2](points[k]), range(200)))
    for point, (both, outer) in zip(points[:, 0], found, strict=True):
        np.testing.assert_array_equal(both, [[point.sum(), point.prod()]])
        np.testing.assert_array_equal(outer, [np.outer(point, point)])
