"""Fitting coordinates to a problem.

- `fit` is the entry point. `settings` checks the arguments, and `stages` runs the minimisations.
- `idle_joints` splits off joints that are exact coordinates; `spectral_start` finds the initial coefficients of bases.
- `loss` is a package with one module per term, the weights, and the residuals of one sample.
- `basis_objective` (with `basis_gradients`) evaluates the loss for families linear in theta, `array_objective` for
  networks, `graph_objective` for all others. `bounded_mutual` adds a bound on mutual angles. `symbolic_loss` gives the
  loss as one CasADi expression.
- `gauge` fixes what the loss leaves free: offset, scale, order and sign of the coordinates.
- `checkpoint` keeps the state of a long fit in a file.
"""

__all__: list[str] = []
