"""Exact coordinates, where the geometry allows them ([AS2023] Sec. 5).

- `involutivity` tests whether they exist.
- `leaves` has charts of base leaves: lines, closed curves, and disks. Disks use the meshes and harmonic maps of `mesh`.
- `flow` follows the task gradients, and extends the coordinates of a leaf along them. `orthocas.charts.grow` makes a
  chart of them.
"""

__all__: list[str] = []
