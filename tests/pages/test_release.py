"""What a release needs agrees: version, dependencies, and contents of the archives."""

import re
from importlib.util import find_spec

import pytest
import release


def test_recipe_has_the_dependencies_of_the_project(monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(release.dependencies()) == []
    monkeypatch.setitem(release.PROJECT, "dependencies", [*release.PROJECT["dependencies"], "other>=2"])
    assert list(release.dependencies()) == ["tools/recipe.yaml lacks 'other >=2', unlike pyproject.toml"]


def test_all_files_name_the_same_version(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [fault for fault in release.texts() if "has version" in fault] == []
    version = release.VERSION
    monkeypatch.setattr(release, "VERSION", "9.9.9")
    assert sum(f"has version {version}, expected 9.9.9" in fault for fault in release.texts()) == 2


@pytest.mark.skipif(find_spec("rattler_build") is None, reason="no rattler_build: pip install 'orthocas[release]'")
def test_recipe_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(release.recipe()) == []
    monkeypatch.setitem(release.PROJECT, "license", "MIT")
    assert len(list(release.recipe())) == 1


def test_contents_of_archives_are_judged() -> None:
    found = ["a/LICENSE", "tests/x.py"]
    assert list(release.contents("w.whl", found, ("LICENSE",), ("docs/",))) == []
    assert list(release.contents("w.whl", found, ("py.typed",), ("tests/",))) == [
        "w.whl lacks py.typed",
        "w.whl holds tests/",
    ]


def test_the_paper_has_the_title_and_authors_of_the_citation_and_its_references() -> None:
    folder = release.ROOT / "docs" / "joss"
    paper, citation = (folder / "paper.md").read_text(), (release.ROOT / "CITATION.cff").read_text()
    own = citation.partition("preferred-citation")[0]
    assert re.findall("^title: .*", paper, re.MULTILINE) == re.findall("^title: .*", own, re.MULTILINE)
    authors = re.findall(r"- name: (.*)\n    affiliation", paper)
    assert authors == re.findall("- name: (.*)", own) != []
    listed = re.findall(r"^@\w+\{(\w+),", (folder / "paper.bib").read_text(), re.MULTILINE)
    assert set(re.findall(r"@(\w+)\]", paper)) == set(listed)
