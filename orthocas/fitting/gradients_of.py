"""The form in which the gradients of a basis are stored."""

import numpy as np
from numpy.typing import DTypeLike

from orthocas.fitting.basis_gradients import BasisGradients
from orthocas.fitting.product_gradients import ProductGradients
from orthocas.fitting.sparse_gradients import SparseGradients
from orthocas.parametrisations import LinearFamily, ProductFamily


def gradients_of(family: LinearFamily, n: int, dtype: DTypeLike = np.float64) -> BasisGradients:
    """Gradients of a family of n joints, with numbers of a type."""
    return (
        ProductGradients(family, n, dtype) if isinstance(family, ProductFamily) else SparseGradients(family, n, dtype)
    )
