"""Anderson acceleration: the small least squares that mixes the last few iterates.

With the differences Δr_j of the present residual r to the last few, the coefficients are
α = argmin ‖φ (r − Σ_j α_j Δr_j)‖, j = 0 the latest. Their normal equations are summed over all moments in float64, in
columns: the right side ⟨φΔr_a, φr⟩, then the upper triangle of the matrix ⟨φΔr_a, φΔr_b⟩, row by row.
"""

from functools import cache

import warp as wp

DEPTH = 5
"""Changes between iterates that are kept, in a ring, and mixed."""
COLUMNS = DEPTH + DEPTH * (DEPTH + 1) // 2
"""Sums that the normal equations take."""
_RIDGE = 1.0e-9
"""Relative ridge of the least squares: below it differences of float32 residuals are rounding."""
_LARGEST = 1.0e4
"""Sum of |α_j| beyond which the iterates are as good as dependent."""

coefficients = wp.types.vector(DEPTH, wp.float64)
"""Type of the α_j."""


@wp.func
def slot_of(current: int, age: int):
    """Slot of the change ``age`` before the one in slot ``current``."""
    return (current - age + wp.static(DEPTH)) % wp.static(DEPTH)


@wp.func
def matrix_column(a: int, b: int):
    """Column that holds the product of differences ``a`` and ``b``."""
    low = wp.min(a, b)
    high = wp.max(a, b)
    return wp.static(DEPTH) + low * wp.static(DEPTH) - (low * (low - 1)) // 2 + high - low


@cache
def anderson_solver(columns: int, first: int):
    """Warp function that returns the coefficients α_j of the last ``kept`` changes; zeros if they are of no use.

    It takes a vector of ``columns`` sums; the normal equations begin at ``first``.
    """

    # in C, since loops of Warp over arrays in registers would put these into memory
    @wp.func_native(f"""
    double m[{DEPTH}][{DEPTH}], x[{DEPTH}], size = 0.0;
    bool regular = true;
    #pragma unroll
    for (int a = 0, column = {first + DEPTH}; a < {DEPTH}; ++a) {{
        x[a] = a < kept ? sums[{first} + a] : 0.0;
        #pragma unroll
        for (int b = a; b < {DEPTH}; ++b, ++column)
            m[a][b] = b < kept ? sums[column] * (a == b ? {1.0 + _RIDGE!r} : 1.0) : (a == b ? 1.0 : 0.0);
    }}
    // elimination in the upper triangle of a symmetric positive definite matrix
    #pragma unroll
    for (int p = 0; p < {DEPTH}; ++p) {{
        regular = regular && m[p][p] > 0.0;
        const double inverse = 1.0 / m[p][p];
        #pragma unroll
        for (int row = p + 1; row < {DEPTH}; ++row) {{
            const double factor = m[p][row] * inverse;
            #pragma unroll
            for (int column = row; column < {DEPTH}; ++column) m[row][column] -= factor * m[p][column];
            x[row] -= factor * x[p];
        }}
        m[p][p] = inverse;
    }}
    #pragma unroll
    for (int p = {DEPTH - 1}; p >= 0; --p) {{
        #pragma unroll
        for (int column = p + 1; column < {DEPTH}; ++column) x[p] -= m[p][column] * x[column];
        x[p] *= m[p][p];
        size += x[p] < 0.0 ? -x[p] : x[p];
    }}
    wp::vec_t<{DEPTH}, wp::float64> alpha;
    #pragma unroll
    for (int a = 0; a < {DEPTH}; ++a) alpha[a] = regular && size < {_LARGEST!r} ? x[a] : 0.0;
    return alpha;
    """)
    def solve(sums: wp.types.vector(columns, wp.float64), kept: int) -> coefficients: ...

    return solve
