"""Files: containers, charts."""

__all__: list[str] = []
