"""Anderson acceleration: the small least squares that mixes the last few iterates.

Residuals are kept in a ring of slots. Given the sums ⟨φr_a, φr_b⟩ over all pairs of slots, the coefficients are
α = argmin ‖φ (r − Σ_j α_j Δr_j)‖, Δr_j the difference of the present residual to the j-th last.
"""

import warp as wp

DEPTH = 5
"""Earlier iterates that are mixed."""
SLOTS = DEPTH + 1
GRAM_COLUMNS = SLOTS * (SLOTS + 1) // 2
"""Products of two slots, the lower one first."""
_RIDGE = 1.0e-9
"""Relative ridge of the least squares: below it differences of float32 residuals are rounding."""
_LARGEST = 1.0e4
"""Sum of |α_j| beyond which the iterates are as good as dependent."""


def gram_slots() -> list[tuple[int, int]]:
    """Return the two slots whose product each Gram column holds."""
    return [(a, b) for a in range(SLOTS) for b in range(a, SLOTS)]


_matrix = wp.types.matrix((DEPTH, DEPTH), wp.float64)
_vector = wp.types.vector(DEPTH, wp.float64)


@wp.func
def gram_column(a: int, b: int):
    """Column that holds the product of slots ``a`` and ``b``."""
    low = wp.min(a, b)
    high = wp.max(a, b)
    return low * wp.static(SLOTS) - (low * (low - 1)) // 2 + high - low


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
def anderson_coefficients(world_sums: wp.array2d[wp.float64], w: int, current: int, history: int):
    """Coefficients α_j of the last ``history`` iterates, latest first; zeros if they are of no use."""
    matrix = _matrix()
    right = _vector()
    own = world_sums[w, gram_column(current, current)]
    for a in range(history):
        slot_a = (current - 1 - a + wp.static(2 * SLOTS)) % wp.static(SLOTS)
        with_a = world_sums[w, gram_column(current, slot_a)]
        right[a] = own - with_a
        for b in range(history):
            slot_b = (current - 1 - b + wp.static(2 * SLOTS)) % wp.static(SLOTS)
            with_b = world_sums[w, gram_column(current, slot_b)]
            matrix[a, b] = own - with_a - with_b + world_sums[w, gram_column(slot_a, slot_b)]
    for a in range(history):
        matrix[a, a] = matrix[a, a] * wp.float64(wp.static(1.0 + _RIDGE))
    alpha = least_squares(matrix, right, history)
    size = wp.float64(0.0)
    for a in range(history):
        size += wp.abs(alpha[a])
    if not size < wp.float64(wp.static(_LARGEST)):
        return _vector()
    return alpha
