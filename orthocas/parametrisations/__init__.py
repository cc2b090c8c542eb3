"""Parametrisations xi_theta(q): linear, polynomial, Fourier, MLP."""

from orthocas.parametrisations.family import Family, JointSpace, Parametrisation, embed, joint_derivatives
from orthocas.parametrisations.fourier import Fourier
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

__all__ = [
    "MLP",
    "PARAMETRISATIONS",
    "Family",
    "Fourier",
    "GradedParametrisation",
    "JointSpace",
    "Linear",
    "LinearFamily",
    "Parametrisation",
    "Polynomial",
    "Term",
    "embed",
    "joint_derivatives",
    "parametrisation_from_data",
    "parametrisation_to_data",
    "parse_parametrisation",
]
