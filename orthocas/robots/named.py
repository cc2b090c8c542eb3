"""Robots by name: files of packages that are installed, example-robot-data and robot_descriptions."""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, files
from importlib.util import find_spec
from pathlib import Path

from orthocas.errors import UnknownNameError

_DATA = "example-robot-data"


def list_robot_files() -> dict[str, Path]:
    """The URDF files of example-robot-data by name: their stems, 'ur5' for ur5_robot.urdf."""
    try:
        found = [Path(str(file.locate())) for file in files(_DATA) or () if file.suffix == ".urdf"]
    except PackageNotFoundError:
        return {}
    named = {path.stem: path for path in sorted(found, reverse=True)}
    return {stem.removesuffix("_robot"): path for stem, path in named.items()} | named


def find_robot_file(name: str) -> Path:
    """The URDF file of a robot's name, such as 'panda'.

    example-robot-data comes first. robot_descriptions, if it is installed, downloads a description when it is asked for
    it the first time.

    Raises:
        UnknownNameError: if no installed package knows the name; the error has the known ones.
    """
    known = list_robot_files()
    if name in known:
        return known[name]
    module = f"robot_descriptions.{name}_description"
    if name.isidentifier() and find_spec("robot_descriptions") and find_spec(module):
        return Path(import_module(module).URDF_PATH)
    hint = () if known else (f"none: pip install {_DATA}, or robot_descriptions",)
    raise UnknownNameError("robot", name, (*known, *hint))
