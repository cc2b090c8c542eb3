"""Parametrisations xi_theta(q): linear, polynomial, Fourier, MLP, closed forms, and your own."""

from orthocas.parametrisations.basis import BasisFamily
from orthocas.parametrisations.circle import Circle
from orthocas.parametrisations.cyclic_joints import cyclic_joints
from orthocas.parametrisations.family import (
    ArrayFamily,
    ClosedForm,
    CombinableFamily,
    CyclicParametrisation,
    Family,
    GradedFamily,
    GradedParametrisation,
    JointSpace,
    LinearFamily,
    Parametrisation,
    ReorderableFamily,
    SelfDerivativeFamily,
    component_gradients,
)
from orthocas.parametrisations.fourier import Fourier
from orthocas.parametrisations.given import Given
from orthocas.parametrisations.linear import Linear
from orthocas.parametrisations.mlp import MLP
from orthocas.parametrisations.polynomial import Polynomial
from orthocas.parametrisations.product_basis import ProductFamily, Term
from orthocas.parametrisations.registry import (
    parametrisation_from_data,
    parametrisation_names,
    parametrisation_to_data,
    parse_parametrisation,
    register,
    require_savable,
    warn_unless_savable,
)
from orthocas.parametrisations.sew import SEW

__all__ = [
    "MLP",
    "SEW",
    "ArrayFamily",
    "BasisFamily",
    "Circle",
    "ClosedForm",
    "CombinableFamily",
    "CyclicParametrisation",
    "Family",
    "Fourier",
    "Given",
    "GradedFamily",
    "GradedParametrisation",
    "JointSpace",
    "Linear",
    "LinearFamily",
    "Parametrisation",
    "Polynomial",
    "ProductFamily",
    "ReorderableFamily",
    "SelfDerivativeFamily",
    "Term",
    "component_gradients",
    "cyclic_joints",
    "parametrisation_from_data",
    "parametrisation_names",
    "parametrisation_to_data",
    "parse_parametrisation",
    "register",
    "require_savable",
    "warn_unless_savable",
]
