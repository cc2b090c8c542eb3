"""How good coordinates are at given joint positions; `orthocas.quality` sums it up for a domain.

- `gradients` computes cosines, leaks, conditioning and volumes at joint positions: with the formulas of one sample for
  columns of samples (`formulas`, `small_matrices`), or with LAPACK (`by_lapack`).
- `statistics` has the statistics of angles and leaks in reports.
- `pointwise` is what `Chart.quality` returns.
"""

__all__: list[str] = []
