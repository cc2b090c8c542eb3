"""Collects the commands, and turns errors into one line and exit code 2."""

import numpy as np
import typer

from orthocas.casadi_tools.interrupts import ended_in_order, remembered
from orthocas.cli.certify import certify
from orthocas.cli.codegen import codegen
from orthocas.cli.compare import compare
from orthocas.cli.entry import INTERRUPTED
from orthocas.cli.evaluate import evaluate
from orthocas.cli.export import export
from orthocas.cli.fit import fit
from orthocas.cli.follow import follow
from orthocas.cli.info import info
from orthocas.cli.reproduce import reproduce
from orthocas.cli.simulate import simulate
from orthocas.errors import OrthocasError, one_line

app = typer.Typer(
    name="orthocas",
    help="Joint-space coordinates that a redundant robot's task does not disturb.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command()(fit)
app.command()(evaluate)
app.command()(certify)
app.command()(info)
app.command()(compare)
app.command()(reproduce)
app.command()(simulate)
app.command()(follow)
app.command()(codegen)
app.command()(export)


def _complain(text: str) -> None:
    """Print one line of bounded length on standard error."""
    line = one_line(text)
    typer.echo(f"orthocas: {line[:1000]}{'...' if len(line) > 1000 else ''}", err=True)


def run() -> int:
    """Run the command line; bad input gives one line on standard error and exit code 2, a signal its own code."""
    with ended_in_order(), remembered() as pressed:
        try:
            code = app(standalone_mode=False) or 0
        except KeyboardInterrupt:
            code = INTERRUPTED
        except Exception as error:
            if not pressed():  # otherwise it is what a library made of Ctrl-C
                _complain(_message(error))
            code = 2
        return interrupted() if pressed() or code == INTERRUPTED else code


def _message(error: Exception) -> str:
    """What to say of an error; raises those that are defects."""
    if isinstance(error, typer.TyperException):
        return error.format_message()
    if isinstance(error, OrthocasError):
        return str(error)
    if isinstance(error, OSError | MemoryError | np.linalg.LinAlgError):  # from libraries: also one line, no traceback
        return f"{type(error).__name__}: {error}"
    raise error


def interrupted() -> int:
    """Say that it was Ctrl-C; the exit code."""
    typer.echo("orthocas: interrupted", err=True)
    return INTERRUPTED
