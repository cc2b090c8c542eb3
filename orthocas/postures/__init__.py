"""Postures that suit a task: where a domain lies when none is given."""

__all__: list[str] = []
