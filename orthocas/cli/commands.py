"""Collects the commands, and turns errors into one line and exit code 2."""

import logging
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from orthocas.errors import OrthocasError, one_line
from orthocas.tools.interrupts import INTERRUPTED, ended_in_order, remembered
from orthocas.version import VERSION

COMMANDS = {
    "demo": "Fit coordinates for the 7-DoF arm of the paper, print their quality, save a chart and pictures (10 s).",
    "fit": "Fit extra coordinates to a problem and save the chart.",
    "evaluate": "Measure the quality of a chart on held-out samples of its domain.",
    "certify": "Prove that a chart does not fold anywhere on its domain, and save the proof in its file.",
    "info": "Show a chart, a named problem, or a robot.",
    "compare": "Fit a grid of parametrisations, solvers and seeds; write tables, pictures and charts.",
    "simulate": "Run a controller in a chart's coordinates; write the run, pictures, an animation and a report.",
    "solve": "Find joint positions with a given task value and, optionally, xi. Exit code 1 if there are none.",
    "follow": "Follow a tool path; write joint positions, velocities and accelerations on time stamps.",
    "codegen": "Write a chart, the robot's dynamics, the inverse map and a controller as C99.",
    "export": "Write task, xi, phi, Jacobian and inverse of a chart as one Python module that needs the library only.",
    "view": "Show a chart, a robot or a motion in the browser, until Ctrl-C.",
    "doctor": "Show installed and missing packages and their uses, and test a first chart. Exit code 1 on failure.",
    "charts": "List the ready charts of known arms, show the card of one, or write it to a file.",
}  #: names of the commands and the first lines of their help
_PACKAGE = __package__.partition(".")[0]  #: package whose log is shown
_MODULES = {"demo": "compare", "evaluate": "charts", "certify": "charts", "export": "codegen"}


def build_app(words: Sequence[str]) -> typer.Typer:
    """The command line with the commands in `words`. For all others it has only the help, because imports take time."""
    app = typer.Typer(
        name="orthocas",
        help="Joint-space coordinates that a redundant robot's task does not disturb.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_options)
    for name, summary in COMMANDS.items():
        module = f"{__package__}.{_MODULES.get(name, name)}"
        # A command that is not called gets a placeholder.
        command = getattr(import_module(module), name) if name in words else lambda: None
        app.command(name, help=None if name in words else summary, short_help=summary)(command)
    return app


def _print_version(wanted: bool) -> None:
    """Print the version, and end."""
    if wanted:
        typer.echo(f"orthocas {VERSION}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options of the command line itself."""


def run(app: typer.Typer) -> int:
    """Run a command line. Bad input gives one line on standard error and exit code 2; a signal gives its own code."""
    with ended_in_order() as ended, remembered() as pressed, warnings.catch_warnings():
        warnings.showwarning = _show_warning
        logging.getLogger(_PACKAGE).addHandler(notes := _Notes())
        try:
            code = app(prog_name="orthocas", standalone_mode=False) or 0
        except KeyboardInterrupt:
            code = INTERRUPTED
        except Exception as error:
            # The message of this error is the help.
            if type(error).__name__ == "NoArgsIsHelpError":
                typer.echo(_format_error(error), err=True)
            elif not (pressed() or ended()):
                # A library has wrapped a signal in its own error.
                line = one_line(_format_error(error))
                typer.echo(f"orthocas: {line[:1000]}{'...' if len(line) > 1000 else ''}", err=True)
            code = 2
        finally:
            logging.getLogger(_PACKAGE).removeHandler(notes)
        return ended() or (report_interrupt() if pressed() or code == INTERRUPTED else code)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as a note in one line, including warnings of other libraries."""
    typer.echo(f"note: {one_line(str(message))}", err=True)


class _Notes(logging.Handler):
    """Prints the library's log records as notes."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record of the log as one line."""
        _show_warning(record.getMessage())


def _format_error(error: Exception) -> str:
    """The line to print for an error; an error that is a defect of orthocas is raised again."""
    if isinstance(error, typer.TyperException):
        # The options module is loaded if it can have raised this error.
        former = getattr(sys.modules.get(f"{__package__}.options"), "FORMER", {})
        option = getattr(error, "option_name", None)
        return f"no such option: {option}; {former[option]}" if option in former else error.format_message()
    if isinstance(error, OrthocasError):
        return str(error)
    from_library = isinstance(error, OSError | MemoryError) or type(error).__name__ == "LinAlgError"
    # Errors of other libraries also become one line.
    if from_library:
        return f"{type(error).__name__}: {error}"
    raise error


def report_interrupt() -> int:
    """Print that Ctrl-C ended the command; returns the exit code."""
    typer.echo("orthocas: interrupted", err=True)
    return INTERRUPTED
