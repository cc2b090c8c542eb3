"""Fitting coordinates to a problem."""

__all__: list[str] = []
