"""Builds a controller from command-line options, and rejects options that belong to another controller."""

import warnings
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import typer

from orthocas.charts.chart import Chart
from orthocas.cli.options import parse_numbers
from orthocas.cli.output import spread
from orthocas.control.controller import Controller, Setting, law_names, law_of
from orthocas.errors import LawWarning, OptionError
from orthocas.tools.checks import Array

CONTROLLERS = law_names()
Limit = Annotated[
    str | None,
    typer.Option(
        "--limit", help='Largest torque or speed, "50" or "50,40,..." per joint; default: the limits of the robot.'
    ),
]


def add_law_options(for_codegen: bool) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator of commands: the settings of all laws, as options, take the place of the parameter `settings`.

    The command gets those that were given, by name, as texts.
    """
    known = {
        name: setting
        for law in map(law_of, law_names())
        for name, setting in law.options.items()
        if for_codegen or not setting.codegen_only
    }
    options = {
        name: Annotated[str | None, typer.Option(_option(name), help=_help(name, setting))]
        for name, setting in known.items()
    }
    return spread("settings", options, lambda given: {name: text for name, text in given.items() if text is not None})


def require_settings(name: str, settings: Mapping[str, str]) -> None:
    """Check that a controller exists and takes every setting that was given.

    Raises:
        UnknownNameError: if there is no such controller.
        OptionError: for a setting that the controller would ignore.
    """
    law = law_of(name)
    for field in settings:
        if field not in law.options:
            raise OptionError(_belongs(field, name, _takers(field)))


def require_torques(name: str, **words: Any) -> None:
    """Raise OptionError for conditions of the plant that matter only to laws that command torques."""
    for field, value in words.items():
        if value is not None and law_of(name).command != "torque":
            takers = [other for other in law_names() if law_of(other).command == "torque"]
            raise OptionError(_belongs(field, name, takers))


def build_controller(name: str, chart: Chart, settings: Mapping[str, str], limit: str | None = None) -> Controller:
    """Build the controller that a command line describes; `require_settings` has checked the settings.

    Raises:
        OrthocasError: if anything does not fit together.
    """
    law = law_of(name)
    values = {
        field: text if law.options[field].is_word else _one_or_all(_option(field), text)
        for field, text in settings.items()
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LawWarning)  # commands print the remarks of the law
        return law.on_chart(chart, None if limit is None else _one_or_all("--limit", limit), **values)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _help(name: str, setting: Setting) -> str:
    takers = _takers(name)
    return setting.help + ("" if len(takers) == len(law_names()) else f" For {', '.join(takers)}.")


def _takers(name: str) -> list[str]:
    return [law for law in law_names() if name in law_of(law).options]


def _belongs(field: str, name: str, takers: list[str]) -> str:
    return f"{name} has no {_option(field)}, which belongs to {', '.join(takers)}"


def _one_or_all(option: str, text: str) -> Array:
    """Read "100" as a number, "100,50" as an array."""
    numbers = parse_numbers(option, text)
    return numbers.reshape(()) if len(numbers) == 1 else numbers
