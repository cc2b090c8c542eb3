"""`orthocas codegen` and `export`: a chart as C or as a Python module; and the options of laws, for `simulate` too."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from orthocas.charts.chart import Chart
from orthocas.charts.ready import load
from orthocas.cli.options import AsJson, ChartPath, Force, Limit, SolidOptions, parse_one_or_all, spread, spread_options
from orthocas.cli.output import note, print_json, print_rows
from orthocas.codegen.check import check_c
from orthocas.codegen.export import LIBRARIES
from orthocas.codegen.export import export as export_chart
from orthocas.codegen.generate import generate_c
from orthocas.control.controller import Controller, Setting, law_names, law_of
from orthocas.errors import LawWarning, OptionError
from orthocas.robots.capsules import fit_capsules
from orthocas.tools.display import listed
from orthocas.tools.interrupts import deferred

CONTROLLERS = law_names()
_NONE, _TRACK = "none", "track"


def add_law_options(for_codegen: bool) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator of commands: the settings of all laws, as options, take the place of the parameter `settings`.

    The command gets those that were given, by name, as texts.
    """
    options: dict[str, tuple[Any, None]] = {}
    for law in map(law_of, law_names()):
        for name, setting in law.options.items():
            if for_codegen or not setting.codegen_only:
                takers = _find_laws_with(name)
                text = setting.help + ("" if len(takers) == len(law_names()) else f" For {', '.join(takers)}.")
                options[name] = Annotated[str | None, typer.Option(_name_option(name, setting), help=text)], None
    return spread_options(
        "settings", options, lambda values: {name: text for name, text in values.items() if text is not None}
    )


def _name_option(name: str, setting: Setting) -> str:
    return setting.option or f"--{name.replace('_', '-')}"


def _find_laws_with(setting: str) -> list[str]:
    return [law for law in law_names() if setting in law_of(law).options]


@add_law_options(for_codegen=True)
@spread("solids", SolidOptions)
def codegen(
    chart: ChartPath,
    controller: Annotated[
        str,
        typer.Option("--controller", help=f"Control law: {', '.join(CONTROLLERS)}, {_NONE}, or {_TRACK} for an arm."),
    ],
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
    *,
    solids: SolidOptions,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write a chart, the robot's dynamics, the inverse map and a controller as C99."""
    if controller == _TRACK:
        if settings or limit is not None or check or single_precision or solids != SolidOptions():
            raise OptionError(f"--controller {_TRACK} takes --out, --name and --force")
        _write_tracker(chart, out, name, force, json)
        return
    # Settings belong to a law.
    if controller != _NONE:
        require_settings(controller, settings)
    elif settings or limit is not None:
        raise OptionError("settings of a controller require a controller: --controller is none")
    # CasADi may lose Ctrl-C while it builds functions
    with deferred():
        loaded = load(chart)
        # Raises for grown charts.
        loaded.function("xi")
        law = None if controller == _NONE else build_controller(controller, loaded, settings, limit)
        model = solids.build_model(loaded.problem.robot)
        capsules = None if model is None else fit_capsules(model)
        generated = generate_c(loaded, out, law, name, force, single_precision=single_precision, capsules=capsules)
        remarks = [] if law is None else [*law.remarks()]
    # Pairs that no distance in C will ever see are for the user to judge.
    if capsules is not None and capsules.dropped:
        pairs = listed([f"{first} and {second}" for first, second in capsules.dropped])
        remarks.append(f"not checked in C, because their capsules touch in every posture tried: {pairs}")
    agreement = check_c(generated, loaded, law) if check else None
    # What was written, and how far it is from Python.
    source = generated.folder / f"{generated.name}.c"
    lines, differences = len(source.read_text().splitlines()), {} if agreement is None else agreement.differences
    if json:
        report = {
            "name": generated.name,
            "source": str(source),
            "lines": lines,
            "stack_bytes": generated.stack_bytes,
            "checked_states": None if agreement is None else agreement.states,
            "compilers": None if agreement is None else list(agreement.compilers),
            "relative_differences": None if agreement is None else differences,
        }
        print_json(report)
    else:
        rows = {"library": f"{generated.name}: {lines} lines of C99, {source}"}
        rows["stack"] = f"{generated.stack_bytes} bytes at most per call"
        if agreement is not None and differences:
            worst = max(differences, key=lambda name: differences[name])
            rows["checked"] = (
                f"{agreement.states} states with {' and '.join(agreement.compilers)}, "
                f"largest relative difference {differences[worst]:.1e} ({worst})"
            )
        print_rows(rows, "" if check else f"cmake -S {out} -B {out}/build && cmake --build {out}/build")
    for remark in remarks:
        note(remark)


def _write_tracker(file: Path, out: Path, name: str | None, force: bool, json: bool) -> None:
    """The tracker of an arm file, or of an arm with one chart."""
    from orthocas.arms.arm import Arm  # with all that arms need, which charts do not
    from orthocas.arms.arm_file import is_arm

    # A chart is an arm with one chart.
    with deferred():
        if is_arm(file):
            arm = Arm.load(file)
        else:
            chart = load(file)
            arm = Arm(chart.task, (chart,))
        header, source = arm.generate_c(out, "arm" if name is None else name, force=force)
    data = {"header": str(header), "source": str(source), "lines": len(source.read_text().splitlines())}
    if json:
        print_json(data)
    else:
        print_rows({"tracker": f"{data['lines']} lines of C99, {source}", "header": str(header)})


def require_settings(name: str, settings: Mapping[str, str]) -> None:
    """Check that a controller exists and takes every setting that was given.

    Raises:
        UnknownNameError: if there is no such controller.
        OptionError: for a setting that the controller would ignore.
    """
    law = law_of(name)
    for field in settings:
        if field not in law.options:
            takers = _find_laws_with(field)
            option = _name_option(field, law_of(takers[0]).options[field])
            raise OptionError(f"{name} has no {option}, which belongs to {', '.join(takers)}")


def build_controller(name: str, chart: Chart, settings: Mapping[str, str], limit: str | None = None) -> Controller:
    """Build the controller that a command line describes; `require_settings` has checked the settings.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    law = law_of(name)
    values: dict[str, Any] = {}
    for field, text in settings.items():
        setting = law.options[field]
        values[field] = text if setting.is_word else parse_one_or_all(_name_option(field, setting), text)
    with warnings.catch_warnings():
        # commands print the remarks of the law instead
        warnings.simplefilter("ignore", LawWarning)
        return law.on_chart(chart, None if limit is None else parse_one_or_all("--limit", limit), **values)


def export(
    chart: ChartPath,
    to: Annotated[str, typer.Option("--to", help=f"Library: {', '.join(LIBRARIES)}.")],
    out: Annotated[Path, typer.Option("--out", help="The module to write, NAME.py.")],
    force: Force = False,
    json: AsJson = False,
) -> None:
    """Write task, xi, phi, Jacobian and inverse of a chart as one Python module that needs the library only."""
    loaded = load(chart)
    module = export_chart(loaded, to, out, force)
    if json:
        print_json({"module": str(module), "library": to, "joints": loaded.n, "labels": list(loaded.labels)})
    else:
        print_rows({"module": f"{module}, with {to} alone", "functions": "task, xi, phi, jacobian, inverse"})
