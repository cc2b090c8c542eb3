"""The public names explain themselves: each has a docstring, and the examples in them run as they stand."""

import doctest
import inspect
import io
from collections.abc import Iterator
from functools import cache
from types import ModuleType
from typing import Any

import pytest

import orthocas
from orthocas import bases, codegen, control, simulation, solvers
from orthocas.bases import family as families
from orthocas.fitting import terms as loss_terms
from orthocas.tools.cached import cached_property

PACKAGES: tuple[ModuleType, ...] = (orthocas, control, simulation, solvers, bases, codegen)
FEWEST_EXAMPLES = 20
CALLED = (classmethod, staticmethod, property, cached_property)


@cache
def public_objects() -> dict[str, Any]:
    """What the packages export, by full name; an object with two names counts once, under the first."""
    names = {id(getattr(package, name)): (package, name) for package in reversed(PACKAGES) for name in package.__all__}
    return {f"{package.__name__}.{name}": getattr(package, name) for package, name in names.values()}


def can_have_docstring(part: Any) -> bool:
    """Whether it is a module, class or function: type aliases and dictionaries are described where they stand."""
    return inspect.ismodule(part) or inspect.isclass(part) or inspect.isroutine(part)


def written_docstring(part: Any) -> str:
    """The docstring that somebody wrote: dataclasses without one get their signature as a text."""
    text = (part.__doc__ or "").strip()
    return "" if inspect.isclass(part) and text.startswith(f"{part.__name__}(") else text


def public_members() -> Iterator[tuple[str, Any]]:
    """Methods and properties of the public classes that orthocas itself defines."""
    for name, part in public_objects().items():
        if not inspect.isclass(part):
            continue
        for owner in part.__mro__:
            if owner.__module__.startswith("orthocas"):
                for key, value in vars(owner).items():
                    if not key.startswith("_") and (inspect.isfunction(value) or isinstance(value, CALLED)):
                        yield f"{name}.{key}", getattr(part, key) if isinstance(value, classmethod) else value


@cache
def examples() -> tuple[doctest.DocTest, ...]:
    """The doctests of all public classes and functions, and of the methods of those classes."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    parts = {name: part for name, part in public_objects().items() if not inspect.ismodule(part)}
    tests = [test for name, part in parts.items() for test in finder.find(part, name, module=False, globs={})]
    return tuple(test for test in tests if test.examples and "._" not in test.name)  # "._": int's own, in an IntEnum


def test_at_least_twenty_public_names_have_an_example() -> None:
    assert len({test.name for test in examples()}) >= FEWEST_EXAMPLES


@pytest.mark.slow
@pytest.mark.parametrize("example", examples(), ids=lambda test: test.name)
def test_example_runs_as_it_stands(example: doctest.DocTest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "_REGISTERED", dict(families._REGISTERED))  # examples register names of their own
    monkeypatch.setattr(loss_terms, "_TERMS", dict(loss_terms._TERMS))
    report = io.StringIO()
    result = doctest.DocTestRunner().run(example, out=report.write, clear_globs=False)
    assert result.attempted > 0
    assert result.failed == 0, report.getvalue()


def test_a_wrong_example_would_fail() -> None:
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, None)
    assert doctest.DocTestRunner().run(wrong, out=lambda text: 0).failed == 1


def test_every_public_name_has_a_docstring() -> None:
    parts = {name: part for name, part in public_objects().items() if can_have_docstring(part)}
    assert len(parts) > 90
    assert [name for name, part in parts.items() if not written_docstring(part)] == []


def test_every_public_method_has_a_docstring() -> None:
    members = dict(public_members())
    assert len(members) > 150
    assert [name for name, member in members.items() if not (inspect.getdoc(member) or "").strip()] == []
