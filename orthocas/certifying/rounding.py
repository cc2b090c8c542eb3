"""What the proofs assume of floating-point numbers, and the constants that follow from it.

Assumed: IEEE 754 double precision, round to nearest, for +, -, *, / and sqrt of NumPy and for the products and sums of
BLAS, in any order and with or without fused multiply-add. A sum of k products then differs from the exact sum by at
most k u / (1 - k u) times the sum of the absolute values, u = 2^-53 (Higham, Accuracy and Stability of Numerical
Algorithms, Sec. 3.1). No accuracy of sin, cos, exp, ... of the C library is assumed.

Bounds are sums and products of non-negative numbers. Few roundings each of relative size u make them too small by far
less than the factor UP, so UP times the computed bound is a bound. TINY covers underflow.
"""

UNIT = 2.0**-53  #: u: relative error of one operation
UP = 1.0 + 2.0**-40  #: factor on bounds, for up to 4,000 roundings of non-negative numbers
SUM = 256 * UNIT  #: relative error of sums of up to 250 products, for the sum of absolute values
TINY = 1e-290  #: larger than all underflow of one operation on arrays of numbers up to 1e10
