"""Entry point: collects the commands and turns errors into one line and exit code 2."""

import sys

import typer

from orthocas.cli.evaluate import evaluate
from orthocas.cli.fit import fit
from orthocas.cli.info import info
from orthocas.errors import OrthocasError

INTERRUPTED = 130  #: exit code after Ctrl-C, as shells have it

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
app.command()(info)


def main() -> None:
    """Run the command line; bad input gives one line on standard error and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except (OrthocasError, typer.TyperException) as error:
        text = error.format_message() if isinstance(error, typer.TyperException) else str(error)
        typer.echo(f"orthocas: {' '.join(text.split())}" if len(text) < 500 else text, err=True)
        code = 2
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:
        typer.echo("orthocas: interrupted", err=True)
    sys.exit(code or 0)
