"""libigl, which is imported on first use: only meshes need it, and it brings half of SciPy."""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    """A function of libigl."""
    return getattr(import_module("igl"), name)
