"""Signatures as `help` shows them."""

import inspect

import pytest

import orthocas as oc


@pytest.mark.parametrize(
    "function",
    [
        *(oc.fit, oc.fit_wide, oc.evaluate, oc.follow, oc.simulate, oc.Box, oc.Task.pose, oc.Robot.from_urdf),
        *(oc.Chart.solve, oc.Chart.xi_range, oc.Chart.nearest_xi, oc.Chart.tracker, oc.control.PDPlus, oc.Arm.solve),
    ],
    ids=lambda function: function.__qualname__,
)
def test_signatures_name_types_and_do_not_write_them_out(function: object) -> None:
    """NumPy's ArrayLike is a union of sixteen lines."""
    text = str(inspect.signature(function))  # type: ignore[arg-type]
    assert "numpy._typing" not in text
    assert len(text) < 1500
