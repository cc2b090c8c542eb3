"""Graphs whose products NumPy evaluates give what CasADi's own graphs give, derivatives included."""

import casadi as ca
import numpy as np
import pytest

from orthocas.tools.blas_graph import NumpyGraph

RNG = np.random.default_rng(7)


def network(W: ca.MX, X: ca.MX) -> ca.MX:
    return ca.tanh(W.T @ ca.tanh(W @ X)) @ X.T


def arguments(shapes: list[tuple[int, int]]) -> list[np.ndarray]:
    return [RNG.normal(size=shape) for shape in shapes]


@pytest.mark.parametrize("derivative", [False, True])
def test_rewritten_graph_equals_the_plain_one(derivative: bool) -> None:
    W, X = ca.MX.sym("W", 4, 3), ca.MX.sym("X", 3, 6)
    out = network(W, X)
    if derivative:
        out = ca.gradient(ca.sumsqr(ca.jtimes(out, X, ca.sin(X))), W)  # forward, then reverse: second derivatives
    A, B = arguments([(4, 3), (3, 6)])
    (result,) = NumpyGraph("fast", [W, X], [out])(np.asfortranarray(A).T, np.asfortranarray(B).T)
    np.testing.assert_allclose(result.T, ca.Function("plain", [W, X], [out])(A, B).full(), rtol=1e-12)


@pytest.mark.parametrize("flip_a", [False, True])
@pytest.mark.parametrize("flip_b", [False, True])
def test_products_of_transposed_matrices_take_no_copies(flip_a: bool, flip_b: bool) -> None:
    A, B = arguments([(3, 4) if flip_a else (4, 3), (5, 3) if flip_b else (3, 5)])
    a, b = ca.MX.sym("a", *A.shape), ca.MX.sym("b", *B.shape)
    graph = NumpyGraph("product", [a, b], [(a.T if flip_a else a) @ (b.T if flip_b else b)])
    operations = [graph.function.instruction_id(k) for k in range(graph.function.n_instructions())]
    assert ca.OP_TRANSPOSE not in operations
    assert ca.OP_MTIMES not in operations
    (result,) = graph(np.asfortranarray(A).T, np.asfortranarray(B).T)
    np.testing.assert_allclose(result.T, (A.T if flip_a else A) @ (B.T if flip_b else B), rtol=1e-13)


def test_products_that_are_added_up_are_rewritten_too() -> None:
    a, b = ca.MX.sym("a", 3, 3), ca.MX.sym("b", 3, 3)
    graph = NumpyGraph("sum", [a, b], [ca.mac(a, b, ca.mac(b, a.T, a.T))])
    A, B = arguments([(3, 3), (3, 3)])
    (result,) = graph(np.asfortranarray(A).T, np.asfortranarray(B).T)
    np.testing.assert_allclose(result.T, A @ B + B @ A.T + A.T, rtol=1e-12)


def test_graph_without_products_stays_as_it_is() -> None:
    a = ca.MX.sym("a", 2, 2)
    np.testing.assert_allclose(NumpyGraph("sine", [a], [ca.sin(a)])(np.ones((2, 2)))[0], np.sin(1.0))
