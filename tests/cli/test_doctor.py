"""`orthocas doctor`: what it finds, and its exit code."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from programs import Run

from orthocas.cli import doctor
from orthocas.version import VERSION

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_sound_installation_passes(run: Run) -> None:
    code, out, err = run("doctor", "--json")
    found = json.loads(out)
    assert (code, err, found["faults"]) == (0, "", [])
    assert found["orthocas"] == VERSION
    assert found["core"]["casadi"] >= "3.8"
    assert found["checks"]["a chart"] == "fits and inverts"
    assert found["extras"]["robots"]


@pytest.mark.parametrize(
    ("requirement", "fault"),
    [
        ("no-such-library>=1.0", "no-such-library is missing: pip install no-such-library"),
        ("numpy>=99", "numpy is "),
        ("typer>=0.1", ""),
    ],
)
def test_missing_and_old_libraries_are_faults(
    requirement: str, fault: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: [requirement, 'numpy>=99; extra == "view"'])
    monkeypatch.setattr(doctor, "run_checks", lambda _: [])
    code, out, _ = run("doctor")
    assert code == (1 if fault else 0)
    assert f"FAULT           {fault}" in out or not fault
    assert "pip install 'orthocas[view]'" in " ".join(out.split())
    assert all(len(line) <= 80 for line in out.splitlines())


def test_a_library_that_cannot_be_imported_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise OSError("libthat.so: cannot open shared object file")

    monkeypatch.setattr(doctor, "import_module", fail)
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: ["numpy>=2.0"])
    (part,) = doctor.find_parts()
    assert part.fault.endswith("cannot be imported: OSError: libthat.so: cannot open shared object file")


def test_a_folder_on_the_path_has_unknown_requirements(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise doctor.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.metadata, "requires", fail)
    assert list(doctor.find_parts()) == []


@pytest.mark.slow
def test_it_reports_without_the_libraries_that_it_looks_for() -> None:
    code = (
        "import sys; sys.modules['numpy'] = sys.modules['casadi'] = None; sys.argv = ['orthocas', 'doctor'];"
        "from orthocas.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")
    assert "FAULT           casadi" in done.stdout


def test_without_a_compiler_it_says_what_that_costs(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(doctor, "run_checks", lambda _: [])
    code, out, _ = run("doctor")
    assert code == 0
    assert "none: no compiled controllers" in out


def test_extras_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for_developers = {"test", "docs", "joss", "release", "bench", "peers"}
    assert set(doctor.EXTRAS) == set(project["optional-dependencies"]) - for_developers
