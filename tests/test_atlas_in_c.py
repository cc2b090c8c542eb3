"""An atlas in C: the chart that Python finds, its values, small tables, and nothing that traps."""

import json
from pathlib import Path

import numpy as np
import pytest
from programs import Run, built, needs_c, output_of

import orthocas as oc
from orthocas.codegen import CompiledLibrary, GeneratedC, check_c, compile_shared
from orthocas.control import ControlStatus
from orthocas.errors import InvalidValueError, ProofError
from orthocas.tools.checks import Array

pytestmark = needs_c

WAY = np.linspace([0.6, 2.6, 0.9], [0.6, 3.6, -0.9], 40)  # through half a turn of the second joint


@pytest.fixture(scope="module")
def whole(way_atlas: oc.Atlas, tmp_path_factory: pytest.TempPathFactory) -> GeneratedC:
    return oc.generate_c(way_atlas, tmp_path_factory.mktemp("whole"), name="arm")


@pytest.fixture(scope="module")
def library(whole: GeneratedC) -> CompiledLibrary:
    return CompiledLibrary(compile_shared(whole, whole.folder), "arm", 3, r=2)


@pytest.fixture(scope="module")
def positions(way_atlas: oc.Atlas) -> Array:
    """Positions around the way, and on boundaries of cells and of boxes."""
    rng = np.random.default_rng(5)
    somewhere = WAY[rng.integers(len(WAY), size=2500)] + rng.uniform(-0.7, 0.7, (2500, 3))
    somewhere += 2 * np.pi * rng.integers(-1, 2, somewhere.shape)
    return np.vstack([somewhere, *(on_boundaries(way_atlas, number, rng) for number in range(len(way_atlas)))])


def on_boundaries(way_atlas: oc.Atlas, number: int, rng: np.random.Generator) -> Array:
    """Positions of a box with one joint or all on a boundary of the box or of its cell, (20, n)."""
    box, shares = way_atlas.box(number), rng.uniform(-1, 1, (20, 3))
    cell = 1 / (1 + way_atlas.settings.overlap)
    for row in range(20):
        shares[row, rng.integers(3, size=1 + 2 * (row % 2))] = rng.choice([-1.0, -cell, cell, 1.0])
    return np.asarray(box.centre + box.half_width * shares)


def holds(way_atlas: oc.Atlas, number: int, q: Array) -> bool:
    box = way_atlas.box(number, near=q)
    return bool((np.abs(q - box.centre) <= box.half_width * (1 + 1e-9)).all())


@pytest.mark.slow
def test_chart_in_c_is_the_one_that_python_finds(
    way_atlas: oc.Atlas, library: CompiledLibrary, positions: Array
) -> None:
    """On boundaries both may be right: rounding decides."""
    assert len(way_atlas) > 10
    rng = np.random.default_rng(2)
    for current in (np.full(len(positions), -1), rng.integers(-1, len(way_atlas), len(positions))):
        wanted = way_atlas.chart_at(positions, current)
        found = np.array([library.chart_at(*pair) for pair in zip(positions, current.tolist(), strict=True)])
        assert (found[:2500] == wanted[:2500]).all()
        for row in np.flatnonzero(found != wanted):
            assert all(number < 0 or holds(way_atlas, number, positions[row]) for number in (found[row], wanted[row]))
        assert (found != wanted).mean() < 0.01
    assert (wanted[:2500] >= 0).mean() > 0.5
    assert (wanted[:2500] < 0).sum() > 100


@pytest.mark.slow
def test_values_in_c_are_those_of_python(way_atlas: oc.Atlas, library: CompiledLibrary, positions: Array) -> None:
    charts = way_atlas.chart_at(positions)
    q, charts = positions[charts >= 0], charts[charts >= 0]
    assert len(q) > 2000
    xi, J = way_atlas.xi(q, charts), way_atlas.jacobian(q, charts)
    found = [library.xi(point, int(chart)) for point, chart in zip(q, charts, strict=True)]
    assert {row[2] for row in found} == {ControlStatus.OK}
    scale = np.abs(J).max(axis=(1, 2))
    assert (np.abs(np.array([row[0] for row in found]) - xi).max(axis=1) <= 1e-12 * np.abs(xi).max()).all()
    assert (np.abs(np.array([row[1] for row in found]) - J).max(axis=(1, 2)) <= 1e-12 * scale).all()


def test_functions_of_the_chart_in_c_are_those_of_the_single_charts(
    way_atlas: oc.Atlas, library: CompiledLibrary, positions: Array
) -> None:
    numbers = way_atlas.chart_at(positions[:400])
    v, w = np.random.default_rng(1).normal(size=(2, 3))
    seen = set()
    for q, number in zip(positions[:400], numbers.tolist(), strict=True):
        if number < 0 or number in seen:
            continue
        seen.add(number)
        chart = way_atlas.chart(number, near=q)
        phi, J, status = library.chart(q, number)
        assert status == ControlStatus.OK
        assert np.abs(phi - chart.phi(q)).max() < 1e-12
        assert np.abs(J - chart.jacobian(q)).max() < 1e-12
        bend = chart.function("second_derivative")(q, v, w).full()[:, 0]
        assert np.abs(library.curvature(q, v, w, number)[0] - bend).max() < 1e-11
        back, status = library.inverse(phi, q + 0.01, number)
        assert status == ControlStatus.OK
        assert np.abs(back - q).max() < 1e-8
    assert len(seen) > 10
    assert library.check() < 1e-12


@pytest.mark.slow
def test_hostile_numbers_give_statuses_under_sanitizers(whole: GeneratedC, tmp_path: Path) -> None:
    flags = ("-O0", "-DCALLS=40000", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert int(output_of(built(whole, "atlas_calls.c", tmp_path, *flags))) > 300


@pytest.mark.slow
def test_fused_products_change_values_by_rounding_only(
    whole: GeneratedC, library: CompiledLibrary, way_atlas: oc.Atlas, positions: Array, tmp_path: Path
) -> None:
    """Processors with fused multiply-add round once where others round twice, if the compiler may."""
    fused = CompiledLibrary(
        compile_shared(whole, tmp_path, ("-O2", "-march=native", "-ffp-contract=fast")), "arm", 3, r=2
    )
    for q in positions[::7]:
        chart = library.chart_at(q)
        other = fused.chart_at(q, chart)
        if other != chart:
            assert all(number < 0 or holds(way_atlas, number, q) for number in (chart, other))
        elif chart >= 0:
            assert np.abs(fused.xi(q, chart)[1] - library.xi(q, chart)[1]).max() < 1e-12


def test_part_has_the_charts_of_a_way_with_their_images(way_atlas: oc.Atlas, tmp_path: Path) -> None:
    way = WAY[:15]
    part = oc.AtlasPart.along(way_atlas, way, radius=0.05)
    on_the_way = set(way_atlas.chart_at(way).tolist())
    assert on_the_way <= set(part.charts.tolist())
    assert len(part) < len(way_atlas)
    generated = oc.generate_c(part, tmp_path, name="arm")
    library = CompiledLibrary(compile_shared(generated, tmp_path), "arm", 3, r=2)
    for q in way:
        assert part.charts[library.chart_at(q)] == way_atlas.chart_at(q)
    far = [library.chart_at(q) for q in WAY[25:]]
    assert max(far) == -1  # not in the part
    assert f"#define ARM_CHARTS {len(part)}\n" in (tmp_path / "arm.h").read_text()


def test_command_writes_the_charts_along_postures(way_atlas: oc.Atlas, run: Run, tmp_path: Path) -> None:
    rows = [",".join(way_atlas.problem.robot.joint_names), *(",".join(map(str, q)) for q in WAY[:10])]
    (tmp_path / "way.csv").write_text("\n".join(rows) + "\n")
    words = ("codegen", str(way_atlas.path), "--controller", "none", "--out", "c", "--name", "arm")
    code, out, err = run(*words, "--along", "way.csv", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["charts"] == len(oc.AtlasPart.along(way_atlas, WAY[:10]))
    code, _, err = run(*words, "--radius", "0.1")
    assert (code, err) == (
        2,
        "orthocas: --radius requires --along: it is a distance from postures\n",
    )


@pytest.mark.slow
def test_proof_finds_a_wrong_coefficient(way_atlas: oc.Atlas, tmp_path: Path) -> None:
    part = oc.AtlasPart.along(way_atlas, WAY[:10])
    generated = oc.generate_c(part, tmp_path, name="arm")
    assert max(check_c(generated, part, states=200).differences.values()) < 1e-12
    code = (tmp_path / "arm.c").read_text()
    fitted = part.index.rows(part.charts)[1][-1:]
    number = repr(float(part.evaluation.numbers(fitted)[0, 0, 1]))
    assert code.count(number) == 1
    (tmp_path / "arm.c").write_text(code.replace(number, "0.5"))
    with pytest.raises(ProofError, match="differs from Python by .* in xi"):
        check_c(generated, part, states=200)


def test_charts_of_another_atlas_and_rows_are_refused(way_atlas: oc.Atlas, tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="rows is True, expected False for an atlas"):
        oc.generate_c(way_atlas, tmp_path, rows=True)
    with pytest.raises(InvalidValueError, match="charts"):
        oc.AtlasPart(way_atlas, [len(way_atlas)])
    with pytest.raises(InvalidValueError, match="at least one chart of the atlas"):
        oc.AtlasPart(way_atlas, [])
    with pytest.raises(InvalidValueError, match=r"q\[0\] is .*, expected a position with a chart"):
        oc.AtlasPart.along(way_atlas, [[0.6, 0.5, 0.9]])
