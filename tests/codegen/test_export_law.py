"""Laws in exported modules: the torques and statuses of the law that C is generated from, in batches."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from public_objects import clear, fitted, ring, wide
from test_export import array_of, module_of

import orthocas as oc
from orthocas import control
from orthocas.control import ControlStatus
from orthocas.errors import InvalidValueError
from orthocas.tasks.samples import sample_uniform
from orthocas.tools.batch import Batched
from orthocas.tools.checks import Array

LAWS: dict[str, Callable[[], Any]] = {
    "PD+": lambda: control.PDPlus(clear(), 50.0, limit=200.0),
    "decoupled": lambda: control.PDPlus(wide().chart, [50.0, 40.0, 30.0], coupling="decoupled", damping="square_root"),
    "damping of its own": lambda: control.PDPlus(fitted().chart, 50.0, damping_stiffness=[50.0, 1e-9, 20.0]),
    "impedance": lambda: control.Impedance(ring(), 20.0, 0.4),
    "pose": lambda: control.PDPlus(oc.charts.load("panda-wide"), 200.0),
}


def arguments_of(law: Any, count: int = 60) -> list[Array]:
    """Positions inside and outside the domain, velocities and a reference nearby; numbers of one are not finite."""
    chart, rng = law.chart, np.random.default_rng(2)
    q = sample_uniform(chart.problem.domain, count, 3)
    phi_d = chart.phi(q) + 0.05 * rng.normal(size=q.shape)
    q[::10] += 3.0
    dq, dphi_d, ddphi_d = rng.normal(size=(3, *q.shape))
    dq[5, 0] = np.nan
    return [q, dq, phi_d, dphi_d, ddphi_d]


def own(law: Any, arguments: list[Array]) -> tuple[Array, Array]:
    """Torques and status of the law's function."""
    gains = [np.tile(value, (len(arguments[0]), 1)) for value in law.gains.values()]
    torque, status = Batched(law.function)(*arguments, *gains)
    return torque, status[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_commands_are_those_of_the_law(tmp_path: Path, library: str, name: str) -> None:
    array, law = array_of(library), LAWS[name]()
    module, arguments = module_of(law, library, tmp_path), arguments_of(law)
    found, status = map(np.asarray, module.command(*map(array, arguments)))
    torque, want = own(law, arguments)
    np.testing.assert_array_equal(status, want)
    np.testing.assert_allclose(found, torque, rtol=1e-10, atol=1e-10 * np.abs(torque).max())
    assert {ControlStatus.OK, ControlStatus.NOT_FINITE} <= set(status.tolist())
    one = [array(rows[1]) for rows in arguments]
    np.testing.assert_allclose(np.asarray(module.command(*one)[0]), found[1], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_commands_are_differentiable(tmp_path: Path, library: str) -> None:
    """The derivative of a sum against differences of the law; 0, not NaN, where numbers are not finite."""
    array, law = array_of(library), LAWS["PD+"]()
    module, arguments = module_of(law, library, tmp_path), arguments_of(law, 40)
    weights = np.random.default_rng(1).normal(size=arguments[0].shape)

    def summed(*given: Any) -> Any:
        return (module.command(*given)[0] * array(weights)).sum()

    library_own = sys.modules["torch"].func if library == "torch" else sys.modules["jax"]
    found = library_own.grad(summed, argnums=tuple(range(5)))(*map(array, arguments))
    _, status = own(law, arguments)
    inside = status == ControlStatus.OK
    assert inside.sum() > 5
    for k, slopes in enumerate(map(np.asarray, found)):
        want = np.zeros_like(slopes)
        for j, aside in enumerate(1e-4 * np.eye(3)):
            sides = []
            for times in (2, 1, -1, -2):
                moved = [rows + times * aside if i == k else rows for i, rows in enumerate(arguments)]
                sides.append((own(law, moved)[0] * weights).sum(axis=1))
            want[:, j] = (-sides[0] + 8 * sides[1] - 8 * sides[2] + sides[3]) / (12 * 1e-4)
        np.testing.assert_allclose(slopes[inside], want[inside], rtol=1e-6, atol=1e-6 * np.abs(want[inside]).max())
        np.testing.assert_array_equal(slopes[status == ControlStatus.NOT_FINITE], 0.0)
        assert np.isfinite(slopes).all()


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_commands_compile_whole(tmp_path: Path, library: str) -> None:
    array, law = array_of(library), LAWS["PD+"]()
    module, arguments = module_of(law, library, tmp_path), arguments_of(law, 20)
    command = module.command
    if library == "torch":
        command = sys.modules["torch"].compile(command, fullgraph=True, backend="aot_eager")
    else:
        command = sys.modules["jax"].jit(command)
    found, status = map(np.asarray, command(*map(array, arguments)))
    torque, want = own(law, arguments)
    np.testing.assert_array_equal(status, want)
    np.testing.assert_allclose(found, torque, rtol=1e-10, atol=1e-10 * np.abs(torque).max())


def test_what_cannot_be_exported_of_a_law_is_named(tmp_path: Path) -> None:
    law = LAWS["PD+"]()
    with pytest.raises(InvalidValueError, match="library is 'numpy', expected 'torch' or 'jax'"):
        oc.export(law, "numpy", tmp_path / "arm.py")
    loaded = control.PDPlus(clear(), 50.0, model=control.RunTimeModel(payload=[1.0, 0, 0, 0]))
    with pytest.raises(InvalidValueError, match="model of the law is payload, expected"):
        oc.export(loaded, "torch", tmp_path / "arm.py")
    with pytest.raises(InvalidValueError, match="chart is a Kinematic, expected a Chart"):
        oc.export(control.Kinematic(clear()), "torch", tmp_path / "arm.py")  # type: ignore[arg-type]
