"""How small a leak can be: the mean that vanishes, and the bound beside a fit."""

import leak_bound
import numpy as np
import pytest


def test_the_mean_of_a_gradient_along_a_rotation_vanishes_on_a_ball() -> None:
    """For xi = sin(a x1) exp(b x2) + x3^2 x1, whatever the rotation."""
    x = 0.7 * leak_bound.ball(3, 400_000, 1)
    a, b = 1.3, 0.8
    gradient = np.stack(
        [
            a * np.cos(a * x[:, 0]) * np.exp(b * x[:, 1]) + x[:, 2] ** 2,
            b * np.sin(a * x[:, 0]) * np.exp(b * x[:, 1]),
            2 * x[:, 2] * x[:, 0],
        ],
        axis=1,
    )
    W = np.array([[0, 1.0, -0.5], [-1.0, 0, 0.3], [0.5, -0.3, 0]])
    products = (gradient * (x @ W.T)).sum(axis=1)
    assert abs(products.mean()) < 4 * products.std() / np.sqrt(len(x))
    assert abs((gradient * (x @ np.abs(W).T)).sum(axis=1).mean()) > 0.1  # not for fields that are no rotations


@pytest.mark.slow
def test_a_fit_leaks_at_least_as_much_as_the_bound_and_hardly_more_on_a_small_ball() -> None:
    (ratio,) = [value for key, value in leak_bound.main(quick=True).items() if "position" in key]
    assert 1.0 <= ratio < 1.3
