"""Named problems with their data."""

from orthocas.problems.registry import get, names

__all__ = ["get", "names"]
