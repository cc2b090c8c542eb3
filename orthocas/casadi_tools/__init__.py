"""CasADi made to fit: evaluation on many samples, expressions as data, Ctrl-C."""

__all__: list[str] = []
