// Anderson acceleration: least squares for the mixture of the last iterates.
//
// With Δr_j the changes of the residual r between the last iterates, j = 0 the latest, the coefficients are
//
//     α = argmin ‖φ (r − Σ_j α_j Δr_j)‖.
//
// The normal equations are sums over all moments in float64. The right side ⟨φΔr_a, φr⟩ comes first, then the upper
// triangle of the matrix ⟨φΔr_a, φΔr_b⟩ by rows. Takes DEPTH from Python, the number of changes in the ring buffer.
#pragma once

namespace warpmag {

constexpr double RIDGE = 1.0e-9;  // relative; float32 residuals differ by rounding below it
constexpr double LARGEST = 1.0e4; // sum of |α_j| above which iterates count as linearly dependent

// Slot of the change that is ``age`` steps older than the one in slot ``newest``.
CUDA_CALLABLE inline int slot_of(int newest, int age) { return (newest - age + DEPTH) % DEPTH; }

// Column of ⟨φΔr_a, φΔr_b⟩ among the sums, a ≤ b.
CUDA_CALLABLE inline constexpr int matrix_column(int a, int b) { return DEPTH + a * DEPTH - a * (a - 1) / 2 + b - a; }

// Coefficients α_j of the last ``count`` changes; zeros if the changes are linearly dependent.
CUDA_CALLABLE inline wp::vec_t<DEPTH, double> solve_anderson(const double* sums, int count) {
#if !defined(__CUDA_ARCH__)
#pragma clang fp contract(off) // same rounding on every CPU where changes are nearly dependent
#endif
    double m[DEPTH][DEPTH], x[DEPTH], size = 0.0;
    bool regular = true;
#pragma unroll
    for (int a = 0, column = DEPTH; a < DEPTH; ++a) {
        x[a] = a < count ? sums[a] : 0.0;
#pragma unroll
        for (int b = a; b < DEPTH; ++b, ++column)
            m[a][b] = b < count ? sums[column] * (a == b ? 1.0 + RIDGE : 1.0) : (a == b ? 1.0 : 0.0);
    }
    // Gaussian elimination in the upper triangle of a symmetric positive definite matrix
#pragma unroll
    for (int p = 0; p < DEPTH; ++p) {
        regular = regular && m[p][p] > 0.0;
        const double inverse = 1.0 / m[p][p];
#pragma unroll
        for (int row = p + 1; row < DEPTH; ++row) {
            const double factor = m[p][row] * inverse;
#pragma unroll
            for (int column = row; column < DEPTH; ++column) m[row][column] -= factor * m[p][column];
            x[row] -= factor * x[p];
        }
        m[p][p] = inverse;
    }
#pragma unroll
    for (int p = DEPTH - 1; p >= 0; --p) {
#pragma unroll
        for (int column = p + 1; column < DEPTH; ++column) x[p] -= m[p][column] * x[column];
        x[p] *= m[p][p];
        size += x[p] < 0.0 ? -x[p] : x[p];
    }
    wp::vec_t<DEPTH, double> alpha;
#pragma unroll
    for (int a = 0; a < DEPTH; ++a) alpha[a] = regular && size < LARGEST ? x[a] : 0.0;
    return alpha;
}
}
