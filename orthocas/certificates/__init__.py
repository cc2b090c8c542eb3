"""Proofs that a chart does not fold and is one-to-one, and their check.

- `certify` proves, and checks proofs; `search` divides the domain, `box_checks` and `one_to_one` prove single boxes.
- With one coordinate, `determinant` expands det J in waves of the joints, and bounds it.
- `rows` and `jets` bound rows of the Jacobian and their averages, `outside` what lies beyond a box.
- `taylor` and `graph` are the arithmetic: Taylor models with remainders that cover rounding.
"""

from orthocas.certificates.certify import certify, check_certificate

__all__ = ["certify", "check_certificate"]
