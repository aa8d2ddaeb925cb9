// Measured magnetization curves: tables of cubic pieces and the approach to saturation; curves.py has the rows and the
// equations. The functions are templates of the number type N, as in curves.h, and of the type I of curve ids.
#pragma once
#include "shared/lanes.h"

namespace warpmag {

constexpr int FIRST_TABLE = 9; // id of the first table's curve; as in curves.py
// Columns of a row, as in curves.py. The last row of a curve has span 0; its KNOT_C1 and KNOT_C2 are z and a.
enum TableColumn { KNOT_S, KNOT_C, KNOT_SPAN, KNOT_C1, KNOT_C2, KNOT_C3, KNOT_AREA, KNOT_SHEAR, TABLE_COLUMNS };

#if defined(__CUDA_ARCH__)
// not inlined, so that curves with a formula have more registers
#define WARPMAG_CALLED __device__ __noinline__
#else
#define WARPMAG_CALLED __attribute__((noinline))
inline Index rows_where(Mask mask, int rows) { return -rows * __builtin_convertvector(mask, Index); }
inline Number table_entry(const Real* tables, Index row, int column) {
    return collect(tables, Index((int)TABLE_COLUMNS) * row + Index(column));
}
#endif
CUDA_CALLABLE inline int rows_where(bool mask, int rows) { return mask ? rows : 0; }
CUDA_CALLABLE inline Real table_entry(const Real* tables, int row, int column) {
    return tables[TABLE_COLUMNS * row + column];
}

// Solves t (a + t (b + t c)) = value for t in [0, 1], where the cubic increases, by Newton's iteration within bounds.
template <class N> CUDA_CALLABLE inline N solve_cubic(N value, N a, N b, N c) {
    constexpr Real tolerance = sizeof(Real) == 4 ? 1e-5 : 1e-9; // of the relative step
    const N zero = value * 0, one = zero + 1, whole = a + b + c;
    N low = zero, high = one, t = value < whole ? value / whole : one;
    t = t > zero ? t : zero;
    for (int step = 0; step < 60; ++step) {
        const N excess = t * (a + t * (b + t * c)) - value, slope = a + t * (2 * b + 3 * t * c);
        high = excess > zero ? t : high;
        low = excess > zero ? low : t;
        N next = t - excess / slope;
        next = next >= low ? next : Real(0.5) * (low + high);
        next = next <= high ? next : Real(0.5) * (low + high);
        const N change = next > t ? next - t : t - next;
        t = next;
        if (!any(change > tolerance * t)) break;
    }
    return t;
}

// One row of a table: the cubic piece c(y) from a knot on. y is the reduced internal field, and s = y + shear c.
template <class N> struct Piece {
    N s, c, span, c1, c2, c3, area, shear;

    // Parameter t in [0, 1] from this knot to the next, at a reduced field or a reduced magnetization.
    CUDA_CALLABLE N at_field(N field) const {
        return solve_cubic(field - s, span + shear * c1, shear * c2, shear * c3);
    }
    CUDA_CALLABLE N at_magnetization(N reduced) const { return solve_cubic(reduced - c, c1, c2, c3); }
    // (c(t) − c(0))/t and dc/dt
    CUDA_CALLABLE N rise(N t) const { return c1 + t * (c2 + t * c3); }
    CUDA_CALLABLE N slope(N t) const { return c1 + t * (2 * c2 + 3 * t * c3); }
    // Variable z of the approach to saturation c = 1 − a/z beyond the last knot, at a reduced field.
    CUDA_CALLABLE N beyond(N field) const {
        const N z = c1, a = shear * c2, w = field - s + z - a / z, size = root(w * w + 4 * a);
        return w > s * 0 ? Real(0.5) * (w + size) : 2 * a / (size - w);
    }
};

// Row of a curve whose interval of an increasing column contains a value, by bisection.
template <class N, class I> CUDA_CALLABLE inline Piece<N> piece_of(const Real* tables, I curve, N value, int column) {
    const int rows = (int)tables[0]; // rows per curve, a power of two, stored in the first row
    I row = 1 + rows * (curve - FIRST_TABLE);
    for (int step = rows / 2; step > 0; step /= 2)
        row += rows_where(value >= table_entry(tables, row + step, column), step);
    Piece<N> piece;
    N* const numbers[TABLE_COLUMNS] = {&piece.s,  &piece.c,  &piece.span, &piece.c1,
                                       &piece.c2, &piece.c3, &piece.area, &piece.shear};
#pragma unroll
    for (int k = 0; k < TABLE_COLUMNS; ++k) *numbers[k] = table_entry(tables, row, k);
    return piece;
}

// c(s)/s.
template <class N, class I> WARPMAG_CALLED inline N table_ratio(N s, I curve, const Real* tables) {
    const Piece<N> piece = piece_of(tables, curve, s, KNOT_S);
    const N zero = s * 0, t = piece.at_field(s), rise = piece.rise(t);
    const N inside = piece.s > zero ? (piece.c + t * rise) / s : rise / (piece.span + piece.shear * rise);
    return piece.span > zero ? inside : (1 - piece.c2 / piece.beyond(s)) / s;
}

// c'(s) of a piece in which c increases by ``rise`` where y increases by ``span``.
template <class N> CUDA_CALLABLE inline N sheared_slope(const Piece<N>& piece, N rise, N span) {
    return rise / (span + piece.shear * rise);
}

// c'(s).
template <class N, class I> WARPMAG_CALLED inline N table_slope(N s, I curve, const Real* tables) {
    const Piece<N> piece = piece_of(tables, curve, s, KNOT_S);
    const N one = s * 0 + 1, z = piece.beyond(s);
    const N inside = sheared_slope(piece, piece.slope(piece.at_field(s)), piece.span);
    return piece.span > s * 0 ? inside : sheared_slope(piece, piece.c2 / (z * z), one);
}

// c'(s) where c(s) is ``reduced``.
template <class N, class I> WARPMAG_CALLED inline N table_steepness(N reduced, I curve, const Real* tables) {
    const N zero = reduced * 0, one = zero + 1, left = reduced < one ? 1 - reduced : zero;
    const Piece<N> piece = piece_of(tables, curve, reduced, KNOT_C);
    const N inside = sheared_slope(piece, piece.slope(piece.at_magnetization(reduced)), piece.span);
    const N beyond = piece.c2 > zero ? left * left / piece.c2 : zero;
    return piece.span > zero ? inside : sheared_slope(piece, beyond, one);
}

// s/c of the reduced field s at reduced magnetization c < 1.
CUDA_CALLABLE inline Real inverse_table_ratio(Real c, int curve, const Real* tables) {
    const Piece<Real> piece = piece_of(tables, curve, c, KNOT_C);
    if (piece.span == 0) return (piece.s - piece.c1 + piece.c2 / (1 - c) + piece.shear * (c - piece.c)) / c;
    const Real t = piece.at_magnetization(c);
    if (piece.c == 0) return piece.span / piece.rise(t) + piece.shear;
    return (piece.s + piece.span * t + piece.shear * (c - piece.c)) / c;
}

// Area under c from 0 to s: ∫ c dy over the internal field plus shear c²/2.
CUDA_CALLABLE inline double table_area(Real s, int curve, const Real* tables) {
    const Piece<Real> piece = piece_of(tables, curve, s, KNOT_S);
    if (piece.span == 0) {
        const double z = piece.beyond(s), a = piece.c2, c = 1 - a / z, first = piece.c1;
        return piece.area + (z - first) - a * wp::log(z / first) + 0.5 * piece.shear * c * c;
    }
    const double t = piece.at_field(s), c = piece.c + t * (piece.c1 + t * (piece.c2 + t * piece.c3));
    const double mean = piece.c + t * (piece.c1 / 2 + t * (piece.c2 / 3 + t * piece.c3 / 4));
    return piece.area + piece.span * t * mean + 0.5 * piece.shear * c * c;
}
}
