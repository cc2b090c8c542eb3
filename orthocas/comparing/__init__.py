"""Comparisons: a grid of parametrisations, solvers and seeds, fitted and evaluated side by side.

- `compare` is the entry point: it builds the grid and runs it.
- `cells` runs the fits of a grid, in processes of its own or on any executor.
- `report` has the result, with its table, CSV and JSON. `figures` draws it.
- `ticks` measures the duration of a control tick for each parametrisation.
"""

__all__: list[str] = []
