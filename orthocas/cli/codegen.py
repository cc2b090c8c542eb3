"""`orthocas codegen`: a chart, or the charts of an atlas, and a controller as a C library."""

from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.atlases.atlas import Atlas
from orthocas.atlases.atlas_file import ATLAS
from orthocas.atlases.part import AtlasPart
from orthocas.casadi_tools.interrupts import deferred
from orthocas.chart import Chart
from orthocas.cli.controller_argument import (
    CONTROLLERS,
    ControllerOptions,
    CouplingName,
    DampingName,
    DampingRatio,
    DampingStiffness,
    Feedback,
    GravityName,
    InputNames,
    Limit,
    ModelName,
    PostureStiffness,
    SecondName,
    Stiffness,
    build_controller,
    require_options,
)
from orthocas.cli.output import AsJson, Force, note, number, print_json, print_rows
from orthocas.codegen import GeneratedC, Proof, check_c, check_c_of_atlas, generate_c
from orthocas.control import Controller
from orthocas.errors import InvalidValueError
from orthocas.files.blocks import begins
from orthocas.robots.postures_file import read_postures

_NONE = "none"


def codegen(
    chart: Annotated[Path, typer.Argument(metavar="CHART", help="A chart file, or an atlas file.")],
    controller: Annotated[str, typer.Option("--controller", help=f"Control law: {', '.join(CONTROLLERS)} or {_NONE}.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the generated library.")],
    name: Annotated[str | None, typer.Option("--name", help="Prefix of all C names; default: from the chart.")] = None,
    stiffness: Stiffness = None,
    damping_ratio: DampingRatio = None,
    coupling: CouplingName = None,
    damping: DampingName = None,
    posture_stiffness: PostureStiffness = None,
    second: SecondName = None,
    feedback: Feedback = None,
    limit: Limit = None,
    damping_stiffness: DampingStiffness = None,
    model: ModelName = None,
    gravity: GravityName = None,
    inputs: InputNames = None,
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
    options = ControllerOptions(
        *(stiffness, damping_ratio, coupling, posture_stiffness, feedback),
        damping=damping,
        damping_stiffness=damping_stiffness,
        model=model,
        gravity=gravity,
        inputs=inputs,
        second=second,
    )
    if controller != _NONE:
        require_options(controller, options)
    elif options != ControllerOptions() or limit is not None:
        raise InvalidValueError("--controller", _NONE, "a controller, because a controller option was given")
    with deferred():  # CasADi may lose Ctrl-C while it builds functions
        part, loaded = _opened(chart, along, radius)
        loaded.function("xi")  # raises for grown charts
        law = None if controller == _NONE else build_controller(controller, loaded, options, limit)
        generated = generate_c(part or loaded, out, law, name, force, single_precision=single_precision)
        remarks = [] if law is None else law.remarks()
    proof = _proof(generated, part, loaded, law) if check else None
    report = _report(generated, proof) | ({} if part is None else {"charts": len(part)})
    if json:
        print_json(report)
    else:
        print_rows(_rows(report))
    for remark in remarks:
        note(remark)


def _opened(path: Path, along: Path | None, radius: float | None) -> tuple[AtlasPart | None, Chart]:
    """The part of an atlas, or None for the file of a chart; and the chart, or the first one of the part."""
    if not begins(path, ATLAS):
        for name, value in (("--along", along), ("--radius", radius)):
            if value is not None:
                raise InvalidValueError(name, value, "an atlas file to take a part of")
        return None, Chart.load(path)
    atlas = Atlas.load(path)
    if along is None:
        if radius is not None:
            raise InvalidValueError("--radius", radius, "--along, because it is a distance from postures")
        part = AtlasPart.whole(atlas)
    else:
        part = AtlasPart.along(atlas, read_postures(along, atlas.problem.robot), radius or 0.0)
    return part, atlas.chart(int(part.charts[0]))


def _proof(generated: GeneratedC, part: AtlasPart | None, chart: Chart, law: Controller | None) -> Proof:
    return check_c(generated, chart, law) if part is None else check_c_of_atlas(generated, part, law)


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
