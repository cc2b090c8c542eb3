"""Certificates of charts, and the subdivisions of boxes that they consist of. `orthocas.certifying` makes them."""

from orthocas.certificates.certificate import Certificate
from orthocas.certificates.subdivision import Subdivision

__all__ = ["Certificate", "Subdivision"]
