"""Fitting coordinates to a problem, choosing its domain, and comparing fits.

- `fit` and `wide` are the entry points: plans over one engine. `settings` checks what is asked of a fit.
- `stages` is the engine: it runs minimisations one after the other, and searches folds between them. `wide_search` has
  the stages of wide fits. `starts` begins both.
- `terms` has the terms and weights of the loss, `sample_loss` the loss of one sample; `loss` is that of a fit as one
  CasADi expression.
- `basis_objective` evaluates the loss for families linear in theta, `network_objective` for networks and all others.
  `like` holds coordinates to quantities, `bounded_mutual` bounds the angles between them.
- `suggest_domain` (with `probe`) chooses domains. `distil` fits grown coordinates. `compare` fits a grid of settings.
"""

__all__: list[str] = []
