"""Parametrisations xi_theta(q): linear, polynomial, Fourier, MLP, closed forms, and your own."""

from orthocas.bases.circle import Circle
from orthocas.bases.cyclic import Mobile, cyclic_joints
from orthocas.bases.family import (
    ArrayFamily,
    BasisFamily,
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
from orthocas.bases.given import SEW, Given
from orthocas.bases.mlp import MLP
from orthocas.bases.products import Fourier, Linear, Polynomial, ProductFamily, Term
from orthocas.bases.registry import (
    parametrisation_from_data,
    parametrisation_names,
    parametrisation_to_data,
    parse_parametrisation,
    register_parametrisation,
    require_savable,
    warn_unless_savable,
)

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
    "Mobile",
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
    "register_parametrisation",
    "require_savable",
    "warn_unless_savable",
]
