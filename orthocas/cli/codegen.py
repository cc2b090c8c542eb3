"""`orthocas codegen`: a chart and a controller as a C library."""

from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.charts.chart import Chart
from orthocas.cli.codegen import CONTROLLERS, Limit, add_law_options, build_controller, require_settings
from orthocas.cli.output import AsJson, Force, note, print_json, print_rows
from orthocas.codegen.check import AgreementCheck, check_c
from orthocas.codegen.generate import GeneratedC, generate_c
from orthocas.errors import OptionError
from orthocas.tools.interrupts import deferred

_NONE = "none"


@add_law_options(for_codegen=True)
def codegen(
    chart: Annotated[Path, typer.Argument(metavar="CHART", help="A chart file.")],
    controller: Annotated[str, typer.Option("--controller", help=f"Control law: {', '.join(CONTROLLERS)} or {_NONE}.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the generated library.")],
    settings: dict[str, str],
    name: Annotated[str | None, typer.Option("--name", help="Prefix of all C names; default: from the chart.")] = None,
    limit: Limit = None,
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
        loaded = Chart.load(chart)
        loaded.function("xi")  # raises for grown charts
        law = None if controller == _NONE else build_controller(controller, loaded, settings, limit)
        generated = generate_c(loaded, out, law, name, force, single_precision=single_precision)
        remarks = [] if law is None else law.remarks()
    agreement = check_c(generated, loaded, law) if check else None
    report = _report(generated, agreement)
    if json:
        print_json(report)
    else:
        print_rows(_rows(report))
    for remark in remarks:
        note(remark)


def _report(generated: GeneratedC, agreement: AgreementCheck | None) -> dict[str, Any]:
    source = generated.folder / f"{generated.name}.c"
    return {
        "name": generated.name,
        "source": str(source),
        "lines": len(source.read_text().splitlines()),
        "stack_bytes": generated.stack_bytes,
        "checked_states": None if agreement is None else agreement.states,
        "compilers": None if agreement is None else list(agreement.compilers),
        "relative_differences": None if agreement is None else agreement.differences,
    }


def _rows(report: dict[str, Any]) -> dict[str, str]:
    rows = {
        "library": f"{report['name']}: {report['lines']} lines of C99, {report['source']}",
        "stack": f"{report['stack_bytes']} bytes at most per call",
    }
    if differences := report["relative_differences"]:
        worst = max(differences, key=differences.get)
        rows["checked"] = (
            f"{report['checked_states']} states with {' and '.join(report['compilers'])}, "
            f"largest relative difference {differences[worst]:.1e} ({worst})"
        )
    return rows
