"""Coordinates xi(q) of a chart.

- `map` has the protocols: `CoordinateMap` for all coordinates, `InvertibleMap` for those with their own inverse.
- `fitted` has `Coordinates`: a fitted family on the active joints, and the idle joints. The grown counterpart is
  `orthocas.growing.grown.GrownCoordinates`.
- `point_functions` builds xi, its Jacobian and its second derivative at one joint position, for controllers and C.
"""

__all__: list[str] = []
