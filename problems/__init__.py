"""Named problems and their data."""

from orthocas.problems.registry import get, names

__all__ = ["get", "names"]
