"""Interfaces between objectives, minimisers and observers of long computations. Solvers are in `orthocas.solvers`.

- `objective` has the protocols of objectives: values and gradients, and optionally more (Gauss-Newton matrix, Hessian,
  fresh samples, constraints).
- `solver` has the protocol of a minimiser, and its result: `SolveResult` with a `Status`.
- `watch` has progress monitors, and keepers of the solver's state for checkpoints.
- `best_point` keeps the best point, the counts and the state of one minimisation. All solvers use it.
"""

__all__: list[str] = []
