"""`orthocas charts`: the ready charts of known arms."""

from pathlib import Path
from typing import Annotated

import typer

from orthocas.charts.ready import Card, card, load, names
from orthocas.cli.output import AsJson, Force, print_json, print_rows, print_table
from orthocas.errors import OptionError


def charts(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A ready chart; without it, all are listed.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Chart file to write, for the other commands.")] = None,
    force: Force = False,
    json: AsJson = False,
) -> None:
    """List the ready charts of known arms, show the card of one, or write it to a file."""
    if name is None:
        if out is not None:
            raise OptionError("--out requires the name of a ready chart")
        _list([card(known) for known in names()], json)
        return
    found = card(name)
    if out is not None:
        load(name).save(out, force)
    if json:
        print_json({**found.as_dict(), **({} if out is None else {"chart": str(out)})})
    else:
        rows = {**found.facts(), **{f"command {k}": line for k, line in enumerate(found.commands, 1)}}
        print_rows(rows if out is None else {**rows, "chart": str(out)})


def _list(cards: list[Card], json: bool) -> None:
    if json:
        print_json({"charts": [known.as_dict() for known in cards]})
        return
    head = ("name", "robot", "n", "m", "r", "leak [deg]", "least conditioning", "licence")
    print_table([head, *(_row(known) for known in cards)])


def _row(known: Card) -> tuple[str, ...]:
    quality = known.quality
    sizes = (str(quality[name]) for name in "nmr")
    leak, least = f"{quality['leak_deg']['rms']:.2f}", f"{quality['conditioning']['min']:.2f}"
    return known.name, known.model.robot, *sizes, leak, least, known.model.licence
