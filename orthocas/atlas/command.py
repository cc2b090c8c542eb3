"""`orthocas atlas`: build, evaluate and show charts that cover the joint range of an arm."""

from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from orthocas.atlas.atlas import Atlas
from orthocas.atlas.building import MARGIN_DEG, RADIUS, build_atlas
from orthocas.atlas.coverage import draw_coverage, evaluate_atlas
from orthocas.atlas.plan import AtlasSettings
from orthocas.cli.output import (
    AsJson,
    Force,
    Scheduler,
    note,
    number,
    print_json,
    print_rows,
    terminal_monitor,
    whole_number,
)
from orthocas.cli.problem_argument import CHAIN, ProblemName, ProblemOptions, build_problem, with_options
from orthocas.errors import Interrupted
from orthocas.robots.homes import read_postures
from orthocas.tools.checks import require_count
from orthocas.tools.files import output_folder
from orthocas.tools.processes import scheduler_executor

atlas = typer.Typer(
    help="Build, evaluate and show atlases: charts that cover the joint range of an arm.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
AtlasPath = Annotated[Path, typer.Argument(metavar="FILE", help="An atlas file.")]
_ASKED = AtlasSettings()


@atlas.command("build")
@with_options(*CHAIN)
def build(
    problem: ProblemName,
    out: Annotated[Path, typer.Option("--out", help="Atlas file; if it exists, the build goes on from it.")],
    words: ProblemOptions,
    region: Annotated[
        str,
        typer.Option(
            "--region", metavar="limits|POSTURES.csv", help="The joint range, or the surroundings of postures."
        ),
    ] = "limits",
    radius: Annotated[
        float, typer.Option("--radius", parser=number, help="Of the surroundings of postures [rad or m].")
    ] = RADIUS,
    margin_deg: Annotated[
        float, typer.Option("--margin-deg", parser=number, help="Distance of the joint range to the limits [deg].")
    ] = MARGIN_DEG,
    degree: Annotated[int, typer.Option("--degree", parser=whole_number, help="Of the polynomials.")] = _ASKED.degree,
    leak_deg: Annotated[
        float, typer.Option("--leak-deg", parser=number, help="Largest root mean square leak of a chart [deg].")
    ] = _ASKED.leak_deg,
    conditioning: Annotated[
        float, typer.Option("--conditioning", parser=number, help="Least conditioning of a chart.")
    ] = _ASKED.conditioning,
    least_singular_value: Annotated[
        float,
        typer.Option(
            "--least-singular-value", parser=number, help="Relative singular value of the task that charts keep from."
        ),
    ] = _ASKED.least_singular_value,
    half_width: Annotated[
        float, typer.Option("--half-width", parser=number, help="Of the largest boxes [rad]; a quarter of it in m.")
    ] = _ASKED.half_width,
    splits: Annotated[
        int, typer.Option("--splits", parser=whole_number, help="How often a tile may be halved.")
    ] = _ASKED.splits,
    certify: Annotated[
        float,
        typer.Option(
            "--certify", metavar="SECONDS", parser=number, help="Processor time for each proof; 0 for no proofs."
        ),
    ] = _ASKED.certify_seconds,
    share: Annotated[float, typer.Option("--share", parser=number, help="Build this share of the tiles only.")] = 1.0,
    seconds: Annotated[
        float | None, typer.Option("--seconds", parser=number, help="Time limit; the same command goes on.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", parser=whole_number, help="Number of processes; default: one per core.")
    ] = None,
    scheduler: Scheduler = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Fit charts of overlapping boxes over the joint range of an arm; a build that was killed goes on."""
    if workers is not None:
        require_count("--workers", workers)
    built = build_problem(problem, words)
    asked = AtlasSettings(
        degree, leak_deg, conditioning, least_singular_value, half_width, splits=splits, certify_seconds=certify
    )
    postures = None if region == "limits" else read_postures(Path(region), built.robot)
    interrupted = False
    with _executor(scheduler) as executor, terminal_monitor() as monitor:
        try:
            found = build_atlas(
                built,
                out,
                asked,
                region=postures,
                radius=radius,
                margin_deg=margin_deg,
                share=share,
                time_limit=seconds,
                executor=executor,
                jobs=workers,
                monitor=monitor,
                force=force,
            )
        except Interrupted as stop:
            found, interrupted = stop.result, True
    _report(found, json)
    if interrupted:
        note("interrupted: the file holds what is done; the same command goes on from it")
        raise typer.Exit(130)


@atlas.command("evaluate")
def evaluate(
    file: AtlasPath,
    samples: Annotated[
        int, typer.Option("--samples", parser=whole_number, help="Number of samples of the region.")
    ] = 100_000,
    seed: Annotated[int, typer.Option("--seed", parser=whole_number, help="Seed of the samples.")] = 1,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="Folder for pictures of quality and coverage.")
    ] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Measure coverage and quality of an atlas at random samples of its region."""
    known = Atlas.load(file)
    with nullcontext() if pictures is None else output_folder("--pictures", pictures) as folder:
        found = evaluate_atlas(known, samples, seed)
        drawn = [] if folder is None else draw_coverage(found, folder, force)
    if json:
        print_json(found.as_dict())
    else:
        print_rows({**found.facts(), **({"pictures": ", ".join(map(str, drawn))} if drawn else {})})


@atlas.command("info")
def info(file: AtlasPath, json: AsJson = False) -> None:
    """Show what an atlas file holds."""
    _report(Atlas.load(file), json)


def _executor(scheduler: str | None) -> AbstractContextManager[Executor | None]:
    return nullcontext() if scheduler is None else scheduler_executor(scheduler)


def _report(found: Atlas, json: bool) -> None:
    if json:
        print_json({"atlas": str(found.path), **found.as_dict()})
    else:
        print_rows({**found.facts(), "atlas file": str(found.path)})
