"""Postures that suit a task. They are the centres of default domains."""

__all__: list[str] = []
