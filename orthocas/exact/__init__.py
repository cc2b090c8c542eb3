"""Exact coordinates, where the geometry allows them ([AS2023] Sec. 5).

- `involutivity` tests whether they exist. `flow` follows the task gradients.
- `leaf` is the interface of charts of base leaves, `leaves` has lines and closed curves, `disk_leaf` disks, with the
  meshes of `mesh` and the harmonic maps of `harmonic`.
- `grown` joins both to coordinates; `orthocas.charts.grow` makes a chart of them.
"""

__all__: list[str] = []
