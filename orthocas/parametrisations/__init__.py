"""Parametrisations xi_theta(q): linear, polynomial, Fourier, MLP."""

from orthocas.parametrisations.family import Family, JointSpace, Parametrisation, component_gradients, embed
from orthocas.parametrisations.fourier import Fourier
from orthocas.parametrisations.given import Given
from orthocas.parametrisations.linear import Linear
from orthocas.parametrisations.mlp import MLP
from orthocas.parametrisations.polynomial import Polynomial
from orthocas.parametrisations.product_basis import GradedParametrisation, LinearFamily, Term
from orthocas.parametrisations.registry import (
    PARAMETRISATIONS,
    parametrisation_from_data,
    parametrisation_to_data,
    parse_parametrisation,
)
from orthocas.parametrisations.sew import SEW

__all__ = [
    "MLP",
    "PARAMETRISATIONS",
    "SEW",
    "Family",
    "Fourier",
    "Given",
    "GradedParametrisation",
    "JointSpace",
    "Linear",
    "LinearFamily",
    "Parametrisation",
    "Polynomial",
    "Term",
    "component_gradients",
    "embed",
    "parametrisation_from_data",
    "parametrisation_to_data",
    "parse_parametrisation",
]
