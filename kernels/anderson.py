"""Anderson acceleration: the small least squares that mixes the last few iterates.

With the differences Δr_j of the present residual r to the last few, the coefficients are
α = argmin ‖φ (r − Σ_j α_j Δr_j)‖, j = 0 the latest. Their normal equations are summed over all moments in float64, in
columns: the right side ⟨φΔr_a, φr⟩, then the upper triangle of the matrix ⟨φΔr_a, φΔr_b⟩, row by row.
"""

import warp as wp

DEPTH = 5
"""Earlier iterates that are mixed."""
SLOTS = DEPTH + 1
"""Iterates that are kept, in a ring: the earlier ones and the present one."""
COLUMNS = DEPTH + DEPTH * (DEPTH + 1) // 2
"""Sums that the normal equations take."""
_RIDGE = 1.0e-9
"""Relative ridge of the least squares: below it differences of float32 residuals are rounding."""
_LARGEST = 1.0e4
"""Sum of |α_j| beyond which the iterates are as good as dependent."""

_matrix = wp.types.matrix((DEPTH, DEPTH), wp.float64)
_vector = wp.types.vector(DEPTH, wp.float64)


@wp.func
def slot_of(current: int, age: int):
    """Slot of the iterate ``age`` before the one in slot ``current``."""
    return (current - age + wp.static(SLOTS)) % wp.static(SLOTS)


@wp.func
def matrix_column(a: int, b: int):
    """Column that holds the product of differences ``a`` and ``b``."""
    low = wp.min(a, b)
    high = wp.max(a, b)
    return wp.static(DEPTH) + low * wp.static(DEPTH) - (low * (low - 1)) // 2 + high - low


@wp.func
def least_squares(matrix: _matrix, right: _vector, size: int):
    """Solve a symmetric positive definite system of ``size`` rows by elimination; zeros where it is singular."""
    m = matrix
    x = right
    for p in range(size):
        pivot = m[p, p]
        if not pivot > wp.float64(0.0):
            return _vector()
        for row in range(p + 1, size):
            factor = m[row, p] / pivot
            for column in range(p, size):
                m[row, column] = m[row, column] - factor * m[p, column]
            x[row] = x[row] - factor * x[p]
    for back in range(size):
        p = size - 1 - back
        value = x[p]
        for column in range(p + 1, size):
            value -= m[p, column] * x[column]
        x[p] = value / m[p, p]
    return x


@wp.func
def anderson_coefficients(sums: wp.array2d[wp.float64], w: int, first: int, history: int):
    """Coefficients α_j of the last ``history`` iterates; zeros if they are of no use.

    The normal equations are those of world ``w``, in the columns of ``sums`` from ``first`` on.
    """
    matrix = _matrix()
    right = _vector()
    for a in range(history):
        right[a] = sums[w, first + a]
        for b in range(history):
            matrix[a, b] = sums[w, first + matrix_column(a, b)]
        matrix[a, a] = matrix[a, a] * wp.float64(wp.static(1.0 + _RIDGE))
    alpha = least_squares(matrix, right, history)
    size = wp.float64(0.0)
    for a in range(history):
        size += wp.abs(alpha[a])
    if not size < wp.float64(wp.static(_LARGEST)):
        return _vector()
    return alpha
