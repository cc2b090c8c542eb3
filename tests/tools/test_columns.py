"""A function replayed on columns of samples gives what it gives one sample after the other."""

import casadi as ca
import numpy as np
import pytest

from orthocas.tools.batch import use_threads
from orthocas.tools.columns import COLUMNS, ColumnFunction, arrange_blocks, build_weights, split_by_sample


def example() -> ca.Function:
    A, b = ca.SX.sym("A", 2, 3), ca.SX.sym("b", 3)
    return ca.Function("f", [A, b], [A @ b, ca.sin(A.T) * b[1] + 2, ca.fmax(b, 0)])


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("N", [1, 7, COLUMNS, COLUMNS + 1, 3 * COLUMNS - 5])
def test_columns_agree_with_single_samples(N: int, threads: int) -> None:
    rng = np.random.default_rng(3)
    A, b = rng.normal(size=(N, 2, 3)), rng.normal(size=(N, 3))
    f = example()
    with use_threads(threads):
        outputs = ColumnFunction(f)(arrange_blocks(A), arrange_blocks(b))
    assert [out.shape for out in outputs] == [(-(-N // COLUMNS), size, COLUMNS) for size in (2, 6, 3)]
    matrices = split_by_sample(outputs[1].reshape(len(outputs[1]), 2, 3, COLUMNS), N)
    assert matrices.shape == (N, 3, 2)
    for k in {0, N // 2, N - 1}:
        want = [np.array(out) for out in f(A[k], b[k])]
        np.testing.assert_allclose(outputs[0][k // COLUMNS, :, k % COLUMNS], want[0].ravel(), rtol=1e-14)
        np.testing.assert_allclose(matrices[k], want[1], rtol=1e-14)
        np.testing.assert_allclose(outputs[2][k // COLUMNS, :, k % COLUMNS], want[2].ravel(), rtol=1e-14)


def test_shares_make_a_mean_over_real_samples() -> None:
    values = np.random.default_rng(4).normal(size=(COLUMNS + 9, 1))
    mean = float((arrange_blocks(values)[:, 0] * build_weights(len(values))).sum())
    np.testing.assert_allclose(mean, values.mean(), rtol=1e-12)


def test_every_second_sample_is_counted_across_blocks() -> None:
    values = np.arange(float(COLUMNS + 9))[:, None]
    blocks = arrange_blocks(values).reshape(2, 1, 1, COLUMNS)
    np.testing.assert_array_equal(split_by_sample(blocks, len(values), every=2)[:, 0, 0], values[::2, 0])
