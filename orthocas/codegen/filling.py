"""Templates of generated files with their placeholders filled in."""

from collections.abc import Mapping
from importlib.resources import files
from string import Template


def filled(template: str, values: Mapping[str, str]) -> str:
    """A template of `templates/` with its placeholders filled in."""
    return Template((files(__package__) / "templates" / f"{template}.in").read_text()).substitute(values)
