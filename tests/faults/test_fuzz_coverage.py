"""Every command, every function that reads files, and every public callable belongs to a campaign of faults."""

import ast
import inspect
import pydoc
import re
import sys
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from types import FrameType

import pytest
import typer
from fuzz import signals
from fuzz.campaigns import CAMPAIGNS, READERS, RESULTS, meaning
from fuzz.child import Finding, Judge
from fuzz.commands import _COMMANDS
from fuzz.good_calls import good_calls

import orthocas as oc
from orthocas import arms, certificates, charts, control, learn, paths, problems, simulation, solvers, viewer
from orthocas.cli.commands import build_app

_READS = re.compile(r"(read|load)_?\w*|from_(file|urdf|mjcf)|urdf_look")

#: of public names
_MODULES = (oc, arms, certificates, charts, control, learn, paths, problems, simulation, solvers, viewer)
_REFERENCE = Path(__file__).parents[2] / "docs" / "reference"  # it describes these, and others in modules
_LATER = {"Memory", "convergence_figure", "front_figure", "trajectory_figure"}  # their arguments are not checked yet
_MUTANTS = {"calls": 2000, "robots": 2000}  # until each function has its turn
_FIRST = {"robots": (2, 138, 275)}  # mutants that reach functions which few do; others follow, if these change


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
    missing = commands_of(build_app([]))
    missing -= {name for name in missing if any(line == name or line.startswith(f"{name} ") for line in tested)}
    assert missing == set()


def test_every_command_is_stopped_by_signals() -> None:
    assert commands_of(build_app([])) <= {words[0] for words in signals.COMMANDS.values()}


@pytest.mark.slow
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


def functions_called(name: str, wanted: set[str], monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Which of some functions of orthocas a campaign calls while it judges its first mutants, here in this process."""
    places = {(part.rpartition(".")[0].replace(".", "/"), part.rpartition(".")[2]): part for part in wanted}
    root, found, names = Path(inspect.getfile(oc)).parent, set(), {name for _, name in places}

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        # the name first: this runs at every call of every package
        if event == "call" and code.co_name in names and code.co_filename.startswith(f"{root}/"):
            place = code.co_filename.removeprefix(f"{root}/").removesuffix(".py")
            found.update({places[place, code.co_name]} if (place, code.co_name) in places else ())

    def judged(campaign: str, judge: Judge, seeds: Iterable[int], *_: float) -> list[Finding]:
        for seed in (*_FIRST.get(name, ()), *seeds):
            sys.setprofile(note)
            try:
                judge(seed)
            finally:
                sys.setprofile(None)
            if found == wanted:
                break
        return []

    monkeypatch.setattr(inspect.getmodule(CAMPAIGNS[name]), "run", judged)
    monkeypatch.chdir("/")  # the campaign of calls goes there
    CAMPAIGNS[name](_MUTANTS.get(name, 40))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(READERS.values())))
def test_campaigns_call_their_readers(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = {reader for reader, campaign in READERS.items() if campaign == name}
    assert functions_called(name, wanted, monkeypatch) == wanted


def public_callables() -> set[str]:
    """Classes and functions that users call with arguments, by name: neither errors, protocols nor enumerations."""
    found = {name: getattr(module, name) for module in _MODULES for name in module.__all__}
    pages = [page.read_text() for page in _REFERENCE.glob("*.md")]
    names = [
        name
        for page in pages
        for name in re.findall(r"^\.\. auto(?:class|function):: (orthocas\.\w+\.\w+\.\w+)$", page, re.MULTILINE)
    ]
    assert len(names) > 15
    found |= {name.split(".")[-1]: pydoc.locate(name) for name in names}
    return {
        name
        for name, thing in found.items()
        if callable(thing)
        and not (inspect.isclass(thing) and issubclass(thing, Exception | Enum))
        and not getattr(thing, "_is_protocol", False)
        and (inspect.isclass(thing) or inspect.signature(thing).parameters)
    }


@pytest.mark.slow
def test_every_public_callable_belongs_to_a_campaign() -> None:
    called = {part for name in good_calls() for part in name.split(".")}
    public = public_callables()
    assert len(public) > 100
    assert public - called - set(RESULTS) == _LATER
    assert set(RESULTS) - public <= {"InverseStatus", "TrackerStatus"}
    assert set(RESULTS.values()) <= set(CAMPAIGNS)


@pytest.mark.parametrize("name", sorted(CAMPAIGNS))
def test_campaigns_say_what_they_cover(name: str) -> None:
    assert 30 < len(meaning(name)) < 200
