"""Parametrisations xi_theta(q): linear, polynomial, Fourier, MLP, closed forms, and your own."""

from orthocas.bases.circle import Circle
from orthocas.bases.cyclic import Mobile, cyclic_joints
from orthocas.bases.family import (
    BasisFamily,
    ClosedForm,
    CombinableFamily,
    Family,
    JointSpace,
    LinearFamily,
    Parametrisation,
    component_gradients,
)
from orthocas.bases.given import SEW, Given
from orthocas.bases.mlp import MLP
from orthocas.bases.products import Fourier, Linear, Polynomial, ProductFamily
from orthocas.bases.registry import (
    parametrisation_from_data,
    parametrisation_names,
    parametrisation_to_data,
    parse_parametrisation,
    register_parametrisation,
)

__all__ = [
    "MLP",
    "SEW",
    "BasisFamily",
    "Circle",
    "ClosedForm",
    "CombinableFamily",
    "Family",
    "Fourier",
    "Given",
    "JointSpace",
    "Linear",
    "LinearFamily",
    "Mobile",
    "Parametrisation",
    "Polynomial",
    "ProductFamily",
    "component_gradients",
    "cyclic_joints",
    "parametrisation_from_data",
    "parametrisation_names",
    "parametrisation_to_data",
    "parse_parametrisation",
    "register_parametrisation",
]
