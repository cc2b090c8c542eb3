"""Generated C on an emulated Cortex-M4F, in floats: near Python, equal to the host, within the stack it states."""

from pathlib import Path

import numpy as np
import pytest
from programs import needs_c, output_of
from small_processors import Found, States, built, emulated, missing_tools

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, Supervisor, compile_shared, gain_numbers
from orthocas.control import ControlStatus, PDPlus

ITERATIONS = 4
missing = missing_tools()
pytestmark = [
    needs_c,
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing), reason=f"no {' and no '.join(missing)}: see CONTRIBUTING.md"),
]


@pytest.fixture(scope="module")
def law() -> PDPlus:
    return PDPlus.on_chart(oc.charts.load("iiwa7-position"))


@pytest.fixture(scope="module")
def states(law: PDPlus) -> States:
    return States.of(law.chart, 24)


@pytest.fixture(scope="module")
def generated(law: PDPlus, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    return oc.generate_c(law.chart, tmp_path_factory.mktemp("arm"), law, "arm", single_precision=True)


@pytest.fixture(scope="module")
def program(generated: GeneratedC, states: States) -> Path:
    return built(generated, states, generated.folder, ITERATIONS)


@pytest.fixture(scope="module")
def found(program: Path) -> Found:
    return emulated(program, single=True)


def test_check_passes_on_the_target(found: Found) -> None:
    assert 0 < found.check < 1e-4  # it computes in single precision


def test_instructions_are_counted(found: Found) -> None:
    """A loop of 100,000 times two instructions."""
    assert found.loop == pytest.approx(200_000, abs=80)


def test_law_is_near_its_python(law: PDPlus, states: States, found: Found) -> None:
    """Singular places are no part of these states; a saturated torque equals its limit on both sides."""
    for k, q in enumerate(states.q):
        reference = states.reference[k].reshape(3, -1)
        command, status = law.function(q, states.dq[k], *reference, *law.gains.values())
        assert found.status["law"][k] == int(status)
        wanted = command.full().ravel()
        np.testing.assert_allclose(found.values["law"][k], wanted, rtol=0, atol=1e-4 * np.abs(wanted).max())


def test_ticks_of_the_supervised_law_are_those_of_the_host(
    law: PDPlus, states: States, generated: GeneratedC, found: Found, tmp_path: Path
) -> None:
    """The law has just taken over, with its own command; host and board round in their own ways."""
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", law.problem.n, single_precision=True)
    supervisor, seen = Supervisor(library, law), set()
    for k, (q, dq) in enumerate(zip(states.q, states.dq, strict=True)):
        before, _ = library.control(q, dq, states.reference[k], gain_numbers(law))
        supervisor.take_over(q, before)
        command, status = supervisor.step(q, dq, states.reference[k])
        assert found.status["tick"][k] == int(status)
        np.testing.assert_allclose(found.values["tick"][k], command, rtol=0, atol=1e-4 * np.abs(command).max())
        seen.add(status)
    assert {ControlStatus.CAUGHT, ControlStatus.NEAR_BOUNDARY} < seen


def test_inverse_stops_when_it_has_to(law: PDPlus, states: States, found: Found) -> None:
    """Both ends occur: solved, and stopped early with the best position so far, from which a search may go on."""
    stopped = found.status["inverse"] == ControlStatus.STOPPED_EARLY
    assert 0 < stopped.sum() < len(stopped)
    wanted = law.chart.phi(states.q)
    error = np.abs((law.chart.phi(found.values["inverse"]) - wanted) / law.chart.parts.phi_sizes).max(axis=1)
    before = np.abs((law.chart.phi(states.start) - wanted) / law.chart.parts.phi_sizes).max(axis=1)
    assert error[~stopped].max() < 1e-4
    assert (error[stopped] < before[stopped]).all()


def test_iterations_bound_the_time(generated: GeneratedC, states: States, found: Found, tmp_path: Path) -> None:
    twice = emulated(built(generated, states, tmp_path, 2 * ITERATIONS), single=True)
    one = found.instructions["inverse"].max() / ITERATIONS
    assert twice.instructions["inverse"].max() <= 2.1 * ITERATIONS * one


def test_stack_is_what_the_header_says(generated: GeneratedC, found: Found) -> None:
    used = max(stack.max() for stack in found.stack.values())
    assert 1000 < used <= generated.stack_bytes


def test_nothing_calls_pow_or_emulates_double_precision(program: Path) -> None:
    """Powers are in the code of this chart: the guard has a root of a determinant."""
    symbols = output_of("arm-none-eabi-nm", program.parent / "arm.o")
    assert "_kernel_power(" in (program.parent / "arm.c").read_text()
    undefined = {line.split()[-1] for line in symbols.splitlines() if " U " in line}
    assert undefined <= {f"{name}f" for name in ("sin", "cos", "sqrt", "exp", "log", "floor", "fmax", "fmin")} | {
        *("memcpy", "memmove", "memset")
    }
