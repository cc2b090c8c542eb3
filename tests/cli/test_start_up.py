"""What is imported when: little at first, and nothing twice under two names."""

import subprocess
import sys

import pytest

import orthocas as oc
from orthocas.cli.commands import COMMANDS, build_app

HEAVY = {"casadi", "numpy", "pinocchio", "scipy", "matplotlib", "trimesh", "igl", "skimage", "rich", "PIL", "mujoco"}


def modules_after(code: str) -> set[str]:
    """Modules that a new interpreter has after some code."""
    told = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    return set(told.stdout.splitlines()[-1].split())


def test_the_package_itself_imports_nothing_heavy() -> None:
    assert not HEAVY & modules_after("import orthocas")


def test_help_imports_nothing_heavy() -> None:
    code = "import sys; sys.argv = ['orthocas', '--help']\nfrom orthocas.cli.commands import build_app, run\n"
    code += "run(build_app(['--help']))"
    loaded = modules_after(code)
    assert "orthocas.cli.commands" in loaded
    assert not HEAVY & loaded


@pytest.mark.slow
@pytest.mark.parametrize(
    "module", ["orthocas.charts.chart", "orthocas.fitting.fit", "orthocas.cli.info", "orthocas.control"]
)
def test_parts_of_scipy_and_pictures_wait_until_they_are_needed(module: str) -> None:
    late = {"scipy.interpolate", "scipy.optimize", "scipy.spatial", "scipy.special", "scipy.sparse", "scipy.linalg"}
    late |= {"igl", "matplotlib", "trimesh", "rich", "PIL", "mujoco", "distributed"}
    assert not late & modules_after(f"import {module}")


def test_every_stated_name_is_what_its_module_has() -> None:
    assert set(oc.__all__) == set(oc._HOMES)
    for name, (home, own_name) in oc._HOMES.items():
        public = getattr(oc, name)
        assert public in (sys.modules.get(f"{home}.{own_name}"), getattr(sys.modules[home], own_name, None)), name


@pytest.mark.slow
def test_functions_stay_functions_beside_modules_of_their_names() -> None:
    code = (
        "import orthocas.charts.grow, orthocas.exact.involutivity\nimport orthocas as oc\nfrom orthocas import distil\n"
        "import orthocas.fitting.distil\nassert all(map(callable, (oc.grow, oc.involutivity, distil, oc.distil)))"
    )
    assert "orthocas.fitting.distil" in modules_after(code)


def test_unknown_names_are_errors() -> None:
    with pytest.raises(AttributeError, match="module 'orthocas' has no attribute 'nothing'"):
        oc.nothing  # noqa: B018
    assert set(oc.__all__) < set(dir(oc))


def test_help_tells_the_first_lines_of_all_commands() -> None:
    app = build_app(list(COMMANDS))
    commands = {command.name: command for command in app.registered_commands}
    assert list(commands) == list(COMMANDS)
    for name, command in commands.items():
        assert command.callback is not None
        assert (command.callback.__doc__ or "").splitlines()[0] == COMMANDS[name]
        assert command.callback.__module__.startswith("orthocas.cli.")
