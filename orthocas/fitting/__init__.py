"""Fitting coordinates to a problem, choosing its domain, and comparing fits.

- `fit` is the entry point. `settings` checks the arguments, `stages` runs the minimisations, `starts` begins them.
- `terms` has the terms and weights of the loss, `residuals` the loss of one sample.
- `basis_objective` (with `basis_gradients`) evaluates the loss for families linear in theta, `dense_objectives` for
  networks and all others. `symbolic_loss` gives the loss as one CasADi expression.
- `suggest_domain` (with `probe`) chooses domains. `distil` fits grown coordinates.
- `compare` fits a `grid`, and has the result.
"""

__all__: list[str] = []
