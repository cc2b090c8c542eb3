"""Proofs that a chart does not fold and is one-to-one, and checks of these proofs.

- `certify` proves, and checks proofs. `search` divides the domain into boxes, `box_checks` and `one_to_one` prove
  boxes.
- `determinant` handles charts with one coordinate: it expands det J in waves of the joints, and bounds it.
- `rows` and `jets` bound the rows of the Jacobian and their averages; `outside` handles boxes outside the domain.
- `taylor` and `graph` are the arithmetic: Taylor models whose remainders include rounding.
"""

from orthocas.certificates.certify import certify, check_certificate

__all__ = ["certify", "check_certificate"]
