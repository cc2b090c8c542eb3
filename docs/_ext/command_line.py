"""The directive `{command-line}`: all commands of `orthocas` with their arguments, from the program itself."""

import inspect
import re
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from typer.main import get_command

from orthocas.cli.commands import COMMANDS, build_app

OPTION = re.compile(r"(--[a-z][a-z-]*)")


def leaves(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """A command, or those of a group, with their full names."""
    for part, inner in getattr(command, "commands", {}).items():
        yield from leaves(inner, f"{name} {part}")
    if not hasattr(command, "commands"):
        yield name, command


def described(name: str, command: Any) -> str:
    """A section in Markdown: what the command does, and a table of what it takes."""
    rows = [_row(parameter) for parameter in command.params if parameter.name != "help"]
    table = ["| argument or option | meaning |", "| --- | --- |", *rows]
    return "\n".join([f"## {name}", "", inspect.cleandoc(command.help), "", *table, ""])


def _row(parameter: Any) -> str:
    argument = parameter.param_type_name == "argument"
    flag = argument or parameter.is_flag
    value = parameter.metavar or (parameter.name.upper() if argument else "VALUE")
    words = value if argument else ", ".join(parameter.opts) + ("" if flag else f" {value}")
    text = parameter.help or ""
    if parameter.required and not argument:
        text += " Required."
    elif not flag and parameter.default not in (None, ()):
        text += f" Default: {parameter.default}."
    meaning = OPTION.sub(r"`\1`", _cell(text))
    return f"| `{_cell(words)}` | {meaning} |"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


class CommandLine(SphinxDirective):
    """Sections for all commands."""

    def run(self) -> list[nodes.Node]:
        """Called by Sphinx for the directive."""
        program = get_command(build_app(list(COMMANDS)))
        texts = [described(name, command) for name, command in leaves(program, "orthocas")]
        return self.parse_text_to_nodes("\n".join(texts), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("command-line", CommandLine)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
