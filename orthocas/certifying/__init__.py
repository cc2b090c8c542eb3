"""Proofs that charts do not fold, by rigorous arithmetic on boxes.

- `certify` has the user's functions, `check` checks a certificate again; `orthocas.certificates` has the result.
- `search` halves boxes, and `judges` decide on each.
- `chart_rows` gives J on boxes as Taylor models, from `task_rows` and `product_rows`.
- `one_to_one` proves boxes one-to-one, from the derivatives in `jets` and `tip_jets`.
- `outside` leaves out what is no part of a domain, and `unbounded` says what a box proves of joints without borders.
- `elimination` and `volume` bound determinants and the conditioning.
- `taylor`, `monomials`, `functions`, `elementary`, `graph` and `derivative_graph` are the arithmetic; `rounding` says
  what it assumes.
"""

from orthocas.certifying.certify import certified_box, certify
from orthocas.certifying.check import check_certificate

__all__ = ["certified_box", "certify", "check_certificate"]
