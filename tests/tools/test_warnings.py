"""Warnings during tests: ours are errors, what other packages announce to each other is not."""

import warnings

import pytest

ANNOUNCEMENTS = (DeprecationWarning, PendingDeprecationWarning, FutureWarning)


def warn(category: type[Warning], module: str) -> None:
    warnings.warn_explicit("told by a test", category, "file.py", 1, module)


@pytest.mark.parametrize("module", ["orthocas.charts.chart", "orthocas.solvers.minimisers", "test_chart", "conftest"])
def test_announcements_to_us_are_errors(module: str) -> None:
    for category in ANNOUNCEMENTS:
        with pytest.raises(category):
            warn(category, module)


@pytest.mark.parametrize("module", ["skimage.measure._marching_cubes_lewiner", "numpy.lib", "trimesh.orthocas"])
def test_announcements_to_others_are_shown(module: str) -> None:
    for category in ANNOUNCEMENTS:
        with warnings.catch_warnings(record=True) as shown:
            warn(category, module)
        assert [warning.category for warning in shown] == [category]


@pytest.mark.parametrize("module", ["orthocas.charts.chart", "numpy._core._methods"])
def test_trouble_with_numbers_is_an_error_wherever_it_is_found(module: str) -> None:
    """NumPy warns of the mean of nothing in its own name."""
    with pytest.raises(RuntimeWarning):
        warn(RuntimeWarning, module)
