"""A law across the charts of an atlas in C: that of each chart, and hand-overs that ask for the same posture."""

import re
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import atlas_corridor
import numpy as np
import pytest
from programs import built, needs_c, output_of
from supervised import TICK, Arm

import orthocas as oc
from orthocas.codegen import ChartReference, CompiledLibrary, GeneratedC, Supervisor, compile_shared, gain_numbers
from orthocas.codegen.library import STRICT, compilers
from orthocas.control import Controller, ControlStatus, Kinematic, PDPlus, Projector
from orthocas.errors import InvalidValueError
from orthocas.tools.checks import Array

pytestmark = needs_c

START, END = np.array([0.6, 2.7, 0.8]), np.array([0.6, 3.11, 0.1])


@pytest.fixture(scope="module")
def law(way_atlas: oc.Atlas) -> Controller:
    return PDPlus.on_chart(way_atlas.chart(0), limit=150.0)


@pytest.fixture(scope="module")
def generated(way_atlas: oc.Atlas, law: Controller, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    return oc.generate_c(way_atlas, tmp_path_factory.mktemp("law"), law, "arm")


@pytest.fixture(scope="module")
def library(generated: GeneratedC) -> CompiledLibrary:
    return CompiledLibrary(compile_shared(generated, generated.folder), "arm", 3, r=2)


def places(atlas: oc.Atlas, count: int) -> Iterator[tuple[Array, int]]:
    """Positions around the way and their charts."""
    rng = np.random.default_rng(3)
    for share in rng.uniform(size=count):
        q = START + share * (END - START) + rng.uniform(-0.15, 0.15, 3)
        yield q, atlas.chart_at(q)


@pytest.fixture(scope="module")
def moving(way_atlas: oc.Atlas, tmp_path_factory: pytest.TempPathFactory) -> tuple[Controller, CompiledLibrary]:
    """A velocity law."""
    law, folder = Kinematic.on_chart(way_atlas.chart(3), feedback=1.0, limit=2.0), tmp_path_factory.mktemp("moving")
    generated = oc.generate_c(way_atlas, folder, law, "arm")
    return law, CompiledLibrary(compile_shared(generated, folder), "arm", 3, r=2)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["torque", "velocity"])
def test_law_of_each_chart_is_that_of_python(
    way_atlas: oc.Atlas, command: str, law: Controller, library: CompiledLibrary, request: pytest.FixtureRequest
) -> None:
    """Also its status beyond the box of the chart, where the fallback comes, and for bad numbers."""
    given: Any = law
    if command == "velocity":
        given, library = request.getfixturevalue("moving")
    assert library.check() < 1e-10
    rng, seen = np.random.default_rng(4), set()
    for q, number in places(way_atlas, 3):
        chart = way_atlas.chart(number, near=q)
        of_chart, gains = replace(given, chart=chart), gain_numbers(given)
        dq, reference = rng.normal(size=3), np.concatenate([chart.phi(q) + 0.02, rng.normal(size=6)])
        outside = chart.problem.domain.centre + 1.1 * chart.problem.domain.half_width
        for position, asked in ((q, reference), (outside, reference), (q, reference * [np.nan, *np.ones(8)])):
            wanted, status = of_chart.function(position, dq, *np.split(asked, 3), *given.gains.values())
            found, got = library.control(position, dq, asked, gains, number)
            assert got == float(status)
            assert np.abs(found - wanted.full()[:, 0]).max() <= 1e-10 * max(1.0, np.abs(wanted.full()).max())
            seen.add(ControlStatus(got))
    assert seen >= {ControlStatus.OUTSIDE_DOMAIN, ControlStatus.NOT_FINITE}
    assert seen & {ControlStatus.OK, ControlStatus.SATURATED}


@pytest.mark.slow
def test_hand_over_asks_for_the_same_posture_velocity_and_acceleration(
    way_atlas: oc.Atlas, library: CompiledLibrary
) -> None:
    """Against `Atlas.handed_over`, with the arm somewhere near the posture asked for."""
    rng, pairs = np.random.default_rng(6), set()
    for q, number in places(way_atlas, 100):
        dq, ddq = rng.normal(size=(2, 3))
        others = [k for k in range(len(way_atlas)) if k != number and way_atlas.box(k, near=q).contains(q)]
        for other in others[:1]:
            asked = np.concatenate(way_atlas.handed_over(q, dq, ddq, number))
            reference = ChartReference(library, asked, number)
            assert reference.hand_over(other, q + 0.01 * rng.normal(size=3)) == ControlStatus.OK
            assert reference.chart == other
            assert np.abs(reference.values - np.concatenate(way_atlas.handed_over(q, dq, ddq, other))).max() < 1e-8
            assert (reference.values[[0, 3, 6]] == asked[[0, 3, 6]]).all()  # those of the task
            pairs.add((number, other))
    assert len(pairs) > 4


def test_hand_over_of_bad_numbers_changes_nothing(library: CompiledLibrary) -> None:
    for values, chart, status in (
        (np.full(9, np.nan), 1, ControlStatus.NOT_FINITE),
        (np.zeros(9), -1, ControlStatus.OUTSIDE_DOMAIN),
        (np.zeros(9), 10_000, ControlStatus.OUTSIDE_DOMAIN),
    ):
        reference = ChartReference(library, values, 0)
        assert reference.hand_over(chart, START) == status
        assert reference.chart == 0
        np.testing.assert_array_equal(reference.values, values)


def room(atlas: oc.Atlas, q: Array) -> float:
    """Distance to the boundary of the box that holds a position best, in its half-widths."""
    found = []
    for number in range(len(atlas)):
        box = atlas.box(number, near=q)
        share = 1 - np.abs(q - box.centre) / box.half_width
        found.append(float(np.delete(share, list(box.unbounded)).min()))
    return max(found)


def led(supervisor: Supervisor, library: CompiledLibrary, q: Array, dq: Array, ticks: int) -> list[ControlStatus]:
    """Statuses of an arm that is exactly where its reference is, on a straight line, until it is caught."""
    supervisor.start(q)
    for _ in range(100):
        supervisor.step(q, np.zeros(3), ChartReference.at(library, q, supervisor.chart), TICK)
    statuses: list[ControlStatus] = []
    while len(statuses) < ticks and ControlStatus.CAUGHT not in statuses:
        here = q + len(statuses) * TICK * dq
        statuses.append(supervisor.step(here, dq, ChartReference.at(library, here, supervisor.chart), TICK)[1])
    return statuses


def test_the_boundary_of_all_charts_has_a_zone_before_it_and_boundaries_between_charts_have_none(
    way_atlas: oc.Atlas, law: Controller, library: CompiledLibrary
) -> None:
    supervisor = Supervisor(library, law)
    within = led(supervisor, library, START, END - START, 1000)
    assert supervisor.hand_overs >= 2
    assert set(within) <= {ControlStatus.OK, ControlStatus.SATURATED}
    start, out = START + np.array([0.0, -0.55, 0.14]), np.array([0.0, -0.4, 0.1])
    statuses = led(Supervisor(library, law), library, start, out, 1000)
    near, caught = (statuses.index(status) for status in (ControlStatus.NEAR_BOUNDARY, ControlStatus.CAUGHT))
    assert set(statuses[near:caught]) == {ControlStatus.NEAR_BOUNDARY}
    overlap = way_atlas.settings.overlap / (1 + way_atlas.settings.overlap)
    margins = 0.6 * overlap, 0.1 * overlap
    for k, margin, ahead in ((near, margins[0], 0.0), (caught, margins[1], 0.03)):  # caught before it gets there
        before, after = (room(way_atlas, start + ((k - j) * TICK + ahead) * out) for j in (1, 0))
        assert after < margin + 1e-9
        assert before > margin - 1e-9


@pytest.mark.slow
def test_beyond_all_charts_the_arm_is_caught_and_returns_when_asked(
    way_atlas: oc.Atlas, law: Controller, library: CompiledLibrary
) -> None:
    supervisor, arm = Supervisor(library, law), Arm(way_atlas.problem.robot, START)
    supervisor.start(START)
    reference = ChartReference.at(library, START, supervisor.chart)
    push, statuses = np.array([0.0, -80.0, 0.0]), []
    for k in range(1500):
        command, status = supervisor.step(arm.q, arm.dq, reference, TICK)
        arm.move(command + push * (300 < k < 600))
        statuses.append(status)
        if k == 1100:
            supervisor.resume()
    assert statuses[250] == ControlStatus.OK
    assert ControlStatus.CAUGHT in statuses
    assert ControlStatus.RETURNING in statuses
    assert supervisor.cause in (ControlStatus.OUTSIDE_DOMAIN, ControlStatus.TOO_FAST)


def test_away_from_all_charts_the_catcher_holds_the_arm(
    way_atlas: oc.Atlas, law: Controller, library: CompiledLibrary
) -> None:
    supervisor, q = Supervisor(library, law), np.array([0.6, -1.0, 1.5])
    assert way_atlas.chart_at(q) == -1
    supervisor.start(q)
    assert supervisor.chart == -1
    reference = ChartReference(library, np.zeros(9), 0)
    command, status = supervisor.step(q, np.zeros(3), reference, TICK)
    assert status == ControlStatus.CAUGHT
    np.testing.assert_allclose(command, way_atlas.problem.robot.gravity(q), atol=1e-9)


@pytest.mark.slow
def test_arm_follows_a_corridor_in_mujoco_without_a_step_in_posture_or_torque() -> None:
    """A small case of the example: the reference is in C, what it asks for is found in Python."""
    found = atlas_corridor.main(quick=True)
    assert found["hand_overs"] >= 2
    assert found["posture_jump_rad"] < 1e-9
    assert found["speed_jump"] < 1e-9
    assert found["torque_step"] < 0.1
    assert found["tool_error_m"] < 1e-3
    assert found["share_ok"] > 0.99


@pytest.mark.slow
def test_hand_over_keeps_to_the_stack_that_the_header_states(generated: GeneratedC, tmp_path: Path) -> None:
    program = built(generated, "stack_use.c", tmp_path, "-O0", f"-DPOSITION={','.join(map(str, START))}")
    used = [int(word) for word in output_of(program).split()]
    assert len(used) == 5  # one more number if the chart did not change
    assert 1000 < max(used) <= generated.stack_bytes


@pytest.mark.slow
def test_hostile_ticks_give_statuses_under_sanitizers(generated: GeneratedC, tmp_path: Path) -> None:
    flags = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    middle = ",".join(str(x) for x in (START + END) / 2)
    program = built(
        generated, "supervised_ticks.c", tmp_path, "-DTICKS=45000L", "-DLIMIT=150.0", f"-DMIDDLE={middle}", *flags
    )
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.returncode}: {done.stderr}"
    *counts, hand_overs = map(int, done.stdout.split())
    assert sum(counts) == 45_000
    assert counts[ControlStatus.CAUGHT] > 300
    assert counts[ControlStatus.OK] > 300
    assert hand_overs > 10


def test_laws_without_a_chart_are_refused(way_atlas: oc.Atlas, planar_fit: Any, tmp_path: Path) -> None:
    for law in (Projector(way_atlas.problem, 80.0, 10.0), PDPlus(planar_fit.chart, 50.0)):
        with pytest.raises(InvalidValueError, match="expected a law on a chart of the atlas"):
            oc.generate_c(way_atlas, tmp_path, law)


def test_program_of_the_page_on_atlases_in_c_compiles(generated: GeneratedC, tmp_path: Path) -> None:
    """With C99 and every warning an error."""
    page = (Path(__file__).parent.parent / "docs" / "how-to" / "atlas_in_c.md").read_text()
    (code,) = re.findall(r"```c\n(.*?)```", page, flags=re.DOTALL)
    declared = code[code.index("arm_status tick(") : code.index(") {") + 1] + ";\n"
    (tmp_path / "page.c").write_text(code.replace("/* One tick", f"{declared}\n/* One tick", 1))
    output_of(compilers()[0], *STRICT, "-fsyntax-only", f"-I{generated.folder}", tmp_path / "page.c")
