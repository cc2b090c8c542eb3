"""`orthocas codegen`: a chart, or the charts of an atlas, and a controller as a C library."""

from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.charts.chart import Chart
from orthocas.cli.controller_argument import (
    CONTROLLERS,
    Limit,
    build_controller,
    require_settings,
    with_settings,
)
from orthocas.cli.output import AsJson, Force, note, number, print_json, print_rows
from orthocas.codegen.generate import generate_c
from orthocas.codegen.library import GeneratedC
from orthocas.codegen.proof import Proof, check_c
from orthocas.errors import InvalidValueError, OptionError
from orthocas.robots.homes import read_postures
from orthocas.tools.interrupts import deferred
from orthocas.tools.plugins import opened

_NONE = "none"


@with_settings(for_codegen=True)
def codegen(
    chart: Annotated[Path, typer.Argument(metavar="CHART", help="A chart file, or an atlas file.")],
    controller: Annotated[str, typer.Option("--controller", help=f"Control law: {', '.join(CONTROLLERS)} or {_NONE}.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the generated library.")],
    settings: dict[str, str],
    name: Annotated[str | None, typer.Option("--name", help="Prefix of all C names; default: from the chart.")] = None,
    limit: Limit = None,
    along: Annotated[
        Path | None,
        typer.Option("--along", metavar="POSTURES.csv", help="Of an atlas: the charts of these postures."),
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option("--radius", parser=number, help="With --along: how far joints may leave them [rad or m]."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compile the C and compare it with Python on 1000 states.")
    ] = False,
    single_precision: Annotated[
        bool, typer.Option("--float", help="Numbers are float instead of double, for processors in single precision.")
    ] = False,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write a chart, the robot's dynamics, the inverse map and a controller as C99."""
    if controller != _NONE:
        require_settings(controller, settings)
    elif settings or limit is not None:
        raise OptionError("settings of a controller require a controller: --controller is none")
    with deferred():  # CasADi may lose Ctrl-C while it builds functions
        shown, loaded = _opened(chart, along, radius)
        loaded.function("xi")  # raises for grown charts
        law = None if controller == _NONE else build_controller(controller, loaded, settings, limit)
        generated = generate_c(shown, out, law, name, force, single_precision=single_precision)
        remarks = [] if law is None else law.remarks()
    proof = check_c(generated, shown, law) if check else None
    report = _report(generated, proof) | ({} if shown is loaded else {"charts": len(shown)})
    if json:
        print_json(report)
    else:
        print_rows(_rows(report))
    for remark in remarks:
        note(remark)


def _opened(path: Path, along: Path | None, radius: float | None) -> tuple[Any, Chart]:
    """What C is written from: the chart of a file, or a part of its charts; and the chart, or the first one."""
    several = opened(path)
    if several is None:
        for name, value in (("--along", along), ("--radius", radius)):
            if value is not None:
                raise InvalidValueError(name, value, "an atlas file to take a part of")
        chart = Chart.load(path)
        return chart, chart
    if along is None and radius is not None:
        raise OptionError("--radius requires --along: it is a distance from postures")
    part = several.part(None if along is None else read_postures(along, several.problem.robot), radius or 0.0)
    return part, part.first_chart


def _report(generated: GeneratedC, proof: Proof | None) -> dict[str, Any]:
    source = generated.folder / f"{generated.name}.c"
    return {
        "name": generated.name,
        "source": str(source),
        "lines": len(source.read_text().splitlines()),
        "stack_bytes": generated.stack_bytes,
        "checked_states": None if proof is None else proof.states,
        "compilers": None if proof is None else list(proof.compilers),
        "relative_differences": None if proof is None else proof.differences,
    }


def _rows(report: dict[str, Any]) -> dict[str, str]:
    rows = {
        "library": f"{report['name']}: {report['lines']} lines of C99, {report['source']}",
        "stack": f"{report['stack_bytes']} bytes at most per call",
    }
    if "charts" in report:
        rows["charts"] = str(report["charts"])
    if differences := report["relative_differences"]:
        worst = max(differences, key=differences.get)
        rows["checked"] = (
            f"{report['checked_states']} states with {' and '.join(report['compilers'])}, "
            f"largest relative difference {differences[worst]:.1e} ({worst})"
        )
    return rows
