"""What the proofs assume of floating-point numbers, and the constants that follow from it.

Assumed: IEEE 754 double precision, round to nearest, for +, -, *, / and sqrt of NumPy and for the products and sums of
BLAS, in any order and with or without fused multiply-add. A sum of k products then differs from the exact sum by at
most k u / (1 - k u) times the sum of the absolute values, u = 2^-53 (Higham, Accuracy and Stability of Numerical
Algorithms, Sec. 3.1). No accuracy of sin, cos, exp, ... of the C library is assumed.

Bounds are sums and products of non-negative numbers. Few roundings each of relative size u make them too small by far
less than the factor UP, so UP times the computed bound is a bound. The longest such sums are over the monomials of a
Taylor model, 1,771 in 20 variables. Where there may be more terms, `above` replaces UP. TINY covers underflow.
"""

UNIT = 2.0**-53  #: u: relative error of one operation
UP = 1.0 + 2.0**-40  #: factor on bounds, for up to 4,000 roundings of non-negative numbers
TINY = 1e-290  #: larger than all underflow of one operation on arrays of numbers up to 1e10


def sum_error(products: int) -> float:
    """Error of a sum of so many products, relative to the sum of their absolute values; 8 roundings are to spare."""
    return 1.01 * (products + 8) * UNIT  # k u / (1 - k u) < 1.01 k u for k below 10^13


def above(products: int) -> float:
    """The factor on bounds that are sums of so many products of non-negative numbers."""
    return UP * (1 + sum_error(products))
