"""Coordinates xi(q) of a chart, and their inverse."""

__all__: list[str] = []
