"""Shared problems, charts and real robot descriptions."""

from importlib.metadata import files
from pathlib import Path

import pytest

import orthocas as oc
from orthocas import problems
from orthocas.fitting import Fit


def robot_data(relative: str) -> Path:
    """A file of the example-robot-data package."""
    for entry in files("example-robot-data") or []:
        if str(entry).endswith(f"robots/{relative}"):
            return Path(str(entry.locate())).resolve()
    raise FileNotFoundError(relative)


@pytest.fixture(scope="session")
def iiwa() -> oc.Problem:
    return problems.get("iiwa")


@pytest.fixture(scope="session")
def planar_x() -> oc.Problem:
    return problems.get("planar_3r_x")


@pytest.fixture(scope="session")
def planar_xy() -> oc.Problem:
    return problems.get("planar_3r_xy")


@pytest.fixture(scope="session")
def iiwa_fit(iiwa: oc.Problem) -> Fit:
    return oc.fit(iiwa, oc.Polynomial(degree=3))


@pytest.fixture(scope="session")
def planar_fit(planar_x: oc.Problem) -> Fit:
    return oc.fit(planar_x, oc.Polynomial(degree=4))


@pytest.fixture(scope="session")
def planar_chart(planar_x: oc.Problem) -> oc.Chart:
    """Task x, A = M, orthogonal to 0.2 degrees, with gradients of even lengths: for controllers."""
    return oc.fit(planar_x, oc.Polynomial(degree=8), weights=(1000, 30, 150, 0.1)).chart
