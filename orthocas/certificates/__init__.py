"""Proofs that a chart does not fold and is one-to-one, and their check.

- `certify` proves, `check` checks; `search` divides the domain, `judges` and `one_to_one` judge boxes.
- With one coordinate, `determinant` expands det J from the `waves` of the task's rows, and bounds it.
- `chart_rows`, `task_rows` and `jets` bound rows of the Jacobian, `outside` what lies beyond a box.
- `taylor` and `graph` are the arithmetic: Taylor models with remainders that cover rounding.
"""

from orthocas.certificates.certify import certified_box, certify, check_certificate

__all__ = ["certified_box", "certify", "check_certificate"]
