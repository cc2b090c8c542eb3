"""`orthocas codegen` and `export`, which write a chart as C or as a Python module, and the options of laws."""

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
    """A decorator of commands: replaces the parameter `settings` by options for the settings of all laws.

    The command receives a mapping from names to texts, with the options that were given.
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
            raise OptionError(f"--controller {_TRACK} takes no other options than --out, --name and --force")
        _write_tracker(chart, out, name, force, json)
        return
    # Settings require a law.
    if controller != _NONE:
        require_settings(controller, settings)
    elif settings or limit is not None:
        raise OptionError("settings of a controller require a controller: --controller is none")
    # CasADi may lose Ctrl-C while it builds functions.
    with deferred():
        loaded = load(chart)
        # Refuse grown charts.
        loaded.function("xi")
        law = None if controller == _NONE else build_controller(controller, loaded, settings, limit)
        model = solids.build_model(loaded.problem.robot)
        capsules = None if model is None else fit_capsules(model)
        generated = generate_c(loaded, out, law, name, force, single_precision=single_precision, capsules=capsules)
        remarks = [] if law is None else [*law.remarks()]
    # List the pairs that the C code does not check, so that the user can judge them.
    if capsules is not None and capsules.dropped:
        pairs = listed([f"{first} and {second}" for first, second in capsules.dropped])
        remarks.append(f"not checked in C, because their capsules touch in every posture tried: {pairs}")
    agreement = check_c(generated, loaded, law) if check else None
    # Report the files, and the differences from Python.
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
    """Write the tracker of an arm file, or of a chart as an arm with one chart."""
    # Imports all modules for arms, which charts do not need.
    from orthocas.arms.arm import Arm
    from orthocas.arms.arm_file import is_arm

    # Make an arm of a single chart.
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
    """Check that a controller exists and has every setting that was given.

    Raises:
        UnknownNameError: if there is no such controller.
        OptionError: for a setting that the controller does not have.
    """
    law = law_of(name)
    for field in settings:
        if field not in law.options:
            takers = _find_laws_with(field)
            option = _name_option(field, law_of(takers[0]).options[field])
            raise OptionError(f"{name} has no option {option}, which is for {', '.join(takers)}")


def build_controller(name: str, chart: Chart, settings: Mapping[str, str], limit: str | None = None) -> Controller:
    """Build the controller that a command line describes, with settings checked by `require_settings`.

    Raises:
        OrthocasError: if an argument is invalid or does not fit the chart.
    """
    law = law_of(name)
    values: dict[str, Any] = {}
    for field, text in settings.items():
        setting = law.options[field]
        values[field] = text if setting.is_word else parse_one_or_all(_name_option(field, setting), text)
    with warnings.catch_warnings():
        # Commands print the law's remarks instead.
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
