"""Every command, every function that reads files, and every public callable belongs to a campaign of faults."""

import ast
import inspect
import re
from pathlib import Path

import pytest
import typer
from fuzz.campaigns import CAMPAIGNS, READERS, RESULTS, meaning
from fuzz.commands import _COMMANDS
from fuzz.good_calls import good_calls

import orthocas as oc
from orthocas.cli.commands import app_for

_READS = re.compile(r"(read|load)_?\w*|loaded|from_(file|urdf|mjcf)|urdf_look|srdf_states")


def commands_of(app: typer.Typer, before: str = "") -> set[str]:
    """Names of commands, those of groups with the group's name before them."""
    click = typer.main.get_command(app)
    names: set[str] = set()
    for name, command in getattr(click, "commands", {}).items():
        nested = getattr(command, "commands", None)
        names |= {f"{name} {part}" for part in nested} if nested else {f"{before}{name}"}
    return names


def test_every_command_belongs_to_the_campaign_of_commands() -> None:
    tested = {" ".join(word for word in line.split() if not word.startswith("-")) for line in _COMMANDS}
    missing = {name for words in ([], ["atlas"]) for name in commands_of(app_for(words)) if name != "atlas"}
    missing -= {name for name in missing if any(line == name or line.startswith(f"{name} ") for line in tested)}
    assert missing == set()


def test_every_reader_belongs_to_a_campaign() -> None:
    root, found = Path(inspect.getfile(oc)).parent, set()
    for file in sorted(root.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and _READS.fullmatch(node.name):
                parameters = [part.arg for part in node.args.args if part.arg not in ("self", "cls")]
                if parameters and parameters[0] in ("path", "file", "library", "folder", "urdf", "name"):
                    found.add(".".join((*file.relative_to(root).with_suffix("").parts, node.name)))
    found -= {name for name in found if name.startswith("tools.archive.read.")} | {"tools.archive.read"}
    assert len(found) > 15
    assert found - set(READERS) == set()
    assert set(READERS) - found == set()
    assert set(READERS.values()) <= set(CAMPAIGNS)


@pytest.mark.slow
def test_every_public_callable_belongs_to_a_campaign() -> None:
    called = {part for name in good_calls() for part in name.split(".")}
    public = {name for name in oc.__all__ if callable(getattr(oc, name)) and not inspect.ismodule(getattr(oc, name))}
    errors = {name for name in public if inspect.isclass(kind := getattr(oc, name)) and issubclass(kind, Exception)}
    assert len(public) > 60
    assert public - errors - called - set(RESULTS) == set()
    assert set(RESULTS) - public == set()
    assert set(RESULTS.values()) <= set(CAMPAIGNS)


@pytest.mark.parametrize("name", sorted(CAMPAIGNS))
def test_campaigns_say_what_they_cover(name: str) -> None:
    assert 30 < len(meaning(name)) < 200
