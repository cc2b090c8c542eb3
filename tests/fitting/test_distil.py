"""Closed expressions for grown coordinates, and what they lose."""

import numpy as np
import pytest

import orthocas as oc
from orthocas import problems, solvers
from orthocas.errors import InvalidValueError, MemoryNeedError

ARM = oc.Robot.planar(lengths=[1.0, 1.0, 1.0], masses=[3.0, 3.0, 3.0])
BOX = oc.Box([0.6, 0.8, 0.8], np.pi / 8)


def grown(metric: str = "euclidean", leaf: str = "linear", half_width: float = np.pi / 8) -> oc.Chart:
    box = oc.Box(BOX.centre, half_width)
    return oc.grow(oc.Problem(ARM, oc.Task.position(ARM, "x"), metric, box), leaf=leaf)


@pytest.mark.slow
def test_polynomials_keep_nearly_everything() -> None:
    chart = grown()
    lost = {degree: oc.distil(chart, oc.Polynomial(degree)) for degree in (2, 4, 6)}
    assert lost[2].distilled.task_angle.std > 5 * lost[4].distilled.task_angle.std
    assert lost[4].distilled.task_angle.std > 5 * lost[6].distilled.task_angle.std
    assert lost[6].distilled.task_angle.std < 0.05
    assert lost[6].value_rms.max() < 1e-4
    assert lost[6].gradient_rms.max() < 1e-3
    assert lost[6].grown.task_angle.std < 1e-9


@pytest.mark.slow
def test_the_result_is_an_expression() -> None:
    chart = oc.distil(grown(), oc.Polynomial(3)).chart
    q = BOX.centre
    np.testing.assert_allclose(np.array(chart.function("phi")(q))[:, 0], chart.phi(q), atol=1e-12)
    assert chart.notes["distilled from"] == "grown:linear"


@pytest.mark.slow
def test_inertia_metric_and_meshes_distil_too() -> None:
    assert oc.distil(grown("inertia", half_width=0.1), oc.Polynomial(5)).distilled.task_angle.std < 0.2
    on_mesh = oc.distil(grown(leaf="disk"), oc.Polynomial(5))
    assert on_mesh.distilled.task_angle.std < 1.0  # the gradients of a mesh are those of its triangles
    assert on_mesh.value_rms.max() < 0.01


@pytest.mark.slow
def test_networks_and_fourier_series_distil() -> None:
    chart = grown(half_width=0.2)
    for parametrisation, solver in ((oc.MLP((8,)), solvers.LBFGS(max_iterations=150)), (oc.Fourier(2), None)):
        lost = oc.distil(chart, parametrisation, solver, samples=400)
        assert lost.value_rms.max() < 0.02
        assert lost.distilled.conditioning.p01 > 0.8


@pytest.mark.slow
def test_what_is_not_grown_is_refused() -> None:
    fitted = oc.fit(problems.get("planar_3r_x"), oc.Polynomial(2)).chart
    with pytest.raises(InvalidValueError, match="expected a grown chart"):
        oc.distil(fitted)
    with pytest.raises(InvalidValueError, match="samples is 1, expected more"):
        oc.distil(grown(), oc.Polynomial(6), samples=1)
    with pytest.raises(InvalidValueError, match="bases are fitted by least squares"):
        oc.distil(grown(), oc.Polynomial(2), solver=solvers.LBFGS())
    with pytest.raises(MemoryNeedError):
        oc.distil(grown(), oc.Polynomial(90))
    with pytest.raises(InvalidValueError, match="a family with parameters to fit"):
        oc.distil(grown(), oc.Linear())
