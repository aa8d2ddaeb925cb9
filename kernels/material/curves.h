// Magnetization curves in reduced form (Kim and Han 2022, Eqs. 7, 10); curves.py lists them and their ids.
//
// The functions are templates of the number type: ``Real`` in a Warp function, ``Number`` in a pass over moments. First
// come the formulas c(s), then the formulas as functions of the field inside, then all curves, measured ones included
// (tables.h). ``slope`` is k = 3χ/(3+χ).
#pragma once
#include "material/tables.h"

namespace warpmag {

// As in curves.py. Curve INNER + i is formula i as a function of the field inside.
enum Curve { MIXED = -1, TANH, LANGEVIN, CLAMPED, FROHLICH, LINEAR, INNER };
static_assert(INNER + LINEAR == FIRST_TABLE, "tables come after curves with a formula");

// tanh(s)/s, 1 at s = 0. Below 1e-18 it is set to 1, since a quotient of denormals is inaccurate.
CUDA_CALLABLE inline Real tanh_ratio(Real s) { return s < Real(1e-18) ? Real(1) : wp::tanh(s) / s; }
#if !defined(__CUDA_ARCH__)
// The same for vectors; there are no vector versions of hyperbolic functions. In float32 it is a quotient of two
// polynomials in s², fitted up to s = 9, where tanh is 1. Its error is at most 3e-7, and 4e-8 on average.
inline Number tanh_ratio(Number s) {
    if constexpr (sizeof(Real) == 8) {
        Number ratio;
        for (int l = 0; l < WIDTH; ++l) ratio[l] = tanh_ratio(s[l]);
        return ratio;
    }
    constexpr Real numerator[5] = {1.0, 0.13380975, 0.0034955274, 2.0608056e-05, 1.3353217e-08};
    constexpr Real denominator[5] = {1.0, 0.46714291, 0.025876754, 0.00032855341, 7.7759703e-07};
    const Number z = s * s;
    Number top = numerator[4], bottom = denominator[4];
    for (int k = 3; k >= 0; --k) top = top * z + numerator[k], bottom = bottom * z + denominator[k];
    const Mask saturated = s > Real(9);
    return (saturated ? Number(1) : top) / (saturated ? s : bottom);
}
#endif

// 3 L(x)/x of Langevin's function L(x) = coth x − 1/x; by its series below 0.3, where the closed form cancels.
template <class N> CUDA_CALLABLE inline N langevin_ratio(N x) {
    const N z = x * x, safe = x > Real(0.3) ? x : N(Real(0.3));
    const N series = 1 - z * (Real(1.0 / 15) - z * (Real(2.0 / 315) - z * (Real(1.0 / 1575) - z * Real(3 / 46777.5))));
    return x > Real(0.3) ? 3 * (1 / tanh_ratio(safe) - 1) / (safe * safe) : series;
}

// c(s)/s, 1 at s = 0: the factor between a reduced field and its reduced magnetization.
template <class N> CUDA_CALLABLE inline N curve_ratio(N s, int curve) {
    if (curve == CLAMPED) return s > Real(1) ? 1 / s : N(Real(1));
    if (curve == FROHLICH) return 1 / (1 + s);
    if (curve == LINEAR) return s * 0 + 1;
    return curve == LANGEVIN ? langevin_ratio(3 * s) : tanh_ratio(s);
}

// 3 L'(x) = 3 (1/x² − 1/sinh² x).
CUDA_CALLABLE inline Real langevin_slope(Real x) {
    const Real z = x * x, sinh = wp::sinh(x < 40 ? x : Real(40));
    const Real series = 1 - z * (Real(1.0 / 5) - z * (Real(2.0 / 63) - z * (Real(1.0 / 225) - z * Real(27 / 46777.5))));
    return x < Real(0.3) ? series : 3 * (1 / z - 1 / (sinh * sinh));
}

// Derivative c'(s).
CUDA_CALLABLE inline Real curve_slope(Real s, int curve) {
    if (curve == CLAMPED) return s < 1 ? Real(1) : Real(0);
    if (curve == LANGEVIN) return langevin_slope(3 * s);
    if (curve == FROHLICH) return 1 / ((1 + s) * (1 + s));
    if (curve == LINEAR) return 1;
    const Real cosh = wp::cosh(s < 40 ? s : Real(40));
    return 1 / (cosh * cosh);
}

// Derivative c'(s) where the reduced magnetization c(s) has a given square.
template <class N> CUDA_CALLABLE inline N curve_steepness(N reduced_square, int curve) {
    const N zero = reduced_square * Real(0), one = zero + 1;
    N steepness = one - reduced_square;                                            // of tanh: c' = 1 − c²
    if (curve == CLAMPED) steepness = reduced_square < Real(0.99999) ? one : zero; // M = Ms up to rounding
    if (curve == LINEAR) steepness = one;
    if (curve == FROHLICH) steepness = (one - root(reduced_square)) * (one - root(reduced_square));
    if (curve == LANGEVIN) {
        // Cohen's approximation, corrected by a fitted polynomial in 2c − 1, to an error of 2e-4
        constexpr Real fitted[13] = {
            0.36476878046223565,  0.33269381936319425, -1.063990432535928,  -1.092334636112763,   0.9658571775659215,
            1.264510831049312,    -0.0960163093945858, -0.4838736226305589, -0.21565177679233247, -0.11643126163366144,
            -0.00807874082630003, 0.09545970643540323, 1.0531288294918555};
        steepness *= 3 * steepness / (3 + reduced_square * reduced_square);
        const N x = 2 * root(reduced_square) - 1;
        N fit = zero;
        for (int k = 0; k < 13; ++k) fit = fit * x + fitted[k];
        steepness *= fit;
    }
    return steepness;
}

// Ratio s/c of the reduced field s to the reduced magnetization c. At saturation s is large but finite.
CUDA_CALLABLE inline Real inverse_curve_ratio(Real c, int curve) {
    const Real bounded = c < Real(0.999999) ? c : Real(0.999999), z = bounded * bounded;
    if (bounded < Real(1e-18) || curve == CLAMPED || curve == LINEAR) return 1;
    if (curve == FROHLICH) return 1 / (1 - bounded);
    if (curve == TANH) return Real(0.5) * wp::log((1 + bounded) / (1 - bounded)) / bounded;
    // Newton's iteration on L(3s) = c from Cohen's rational approximation; L is concave, so it converges from below
    Real x = bounded * (3 - z) / (1 - z);
    for (int step = 0; step < 8; ++step) x += (3 * bounded - x * langevin_ratio(x)) / langevin_slope(x);
    return x / (3 * bounded);
}

// Area under c from 0 to s in double precision: the co-energy of a curve.
CUDA_CALLABLE inline double curve_area(double s, int curve) {
    const double z = s * s;
    if (curve == LINEAR) return z / 2;
    if (curve == CLAMPED) return s < 1 ? z / 2 : s - 0.5;
    if (curve == FROHLICH) { // s − ln(1 + s)
        if (s > 0.02) return s - wp::log(1 + s);
        double series = 0;
        for (int k = 8; k >= 2; --k) series = 1.0 / k - s * series;
        return z * series;
    }
    if (curve == LANGEVIN) { // ln(sinh x / x) / 3
        const double x = 3 * s, y = x * x;
        if (x > 20) return (x - wp::log(2 * x)) / 3;
        if (x > 0.3) return wp::log(wp::sinh(x) / x) / 3;
        return y * (1.0 / 6 - y * (1.0 / 180 - y * (1.0 / 2835 - y * (1.0 / 37800 - y / 467775)))) / 3;
    }
    if (s > 20) return s - 0.6931471805599453; // ln cosh s
    if (s > 0.1) return wp::log(wp::cosh(s));
    return z * (0.5 - z * (1.0 / 12 - z * (1.0 / 45 - z * (17.0 / 2520 - z * 31 / 14175))));
}

// ---------- Formulas as functions of the field inside: s = b y + a c(y), a = k/3, b = 1 − a = k/χ ----------

// b, which is positive even for an ideally permeable material, so that y is finite.
template <class N> CUDA_CALLABLE inline N inner_share(N slope) {
    constexpr Real least = sizeof(Real) == 4 ? 1e-11 : 1e-20;
    return larger(1 - slope * Real(1.0 / 3), slope * 0 + least);
}

constexpr Real SATURATING = sizeof(Real) == 4 ? 1e7 : 1e16; // reduced field beyond which c = 1 up to rounding

// Reduced field y inside at a reduced field s, at most SATURATING, by Newton's method. s is concave in y, so the
// iteration rises from below. It takes about five steps, and more only for s ≈ 1 at a large susceptibility.
template <class N> WARPMAG_CALLED inline N inner_field(N s, N slope, int formula) {
    constexpr Real tolerance = sizeof(Real) == 4 ? 1e-6 : 1e-14; // of s, at which one more step suffices
    const N b = inner_share(slope), a = 1 - b, bounded = s > SATURATING ? s * 0 + SATURATING : s;
    const N least = larger(bounded, (bounded - a) / b); // from c(y) ≤ y and c(y) ≤ 1
    N y = least;
    for (int step = 0; step < 60; ++step) {
        const N c = curve_ratio(y, formula) * y, missing = bounded - b * y - a * c;
        const N steepness = larger(curve_steepness(c * c, formula), s * 0);
        y = larger(y + missing / (b + a * steepness), least);
        if (!any((missing < 0 ? -missing : missing) > tolerance * bounded)) break;
    }
    return y;
}

// dc/ds of a curve of the field inside that has dc/dy; likewise c/s for c/y.
template <class N> CUDA_CALLABLE inline N with_inner_field(N quotient, N slope) {
    const N b = inner_share(slope);
    return quotient / (b + (1 - b) * quotient);
}

// The functions above for formulas of both kinds.
template <class N> CUDA_CALLABLE inline N curve_ratio(N s, N slope, int curve) {
    if (curve < INNER) return curve_ratio(s, curve);
    const N ratio = with_inner_field(curve_ratio(inner_field(s, slope, curve - INNER), curve - INNER), slope);
    return s > SATURATING ? 1 / s : ratio;
}
CUDA_CALLABLE inline Real curve_slope(Real s, Real slope, int curve) {
    if (curve < INNER) return curve_slope(s, curve);
    return with_inner_field(curve_slope(inner_field(s, slope, curve - INNER), curve - INNER), slope);
}
CUDA_CALLABLE inline Number curve_steepness(Number square, Number slope, int curve) {
    if (curve < INNER) return curve_steepness(square, curve);
    return with_inner_field(larger(curve_steepness(square, curve - INNER), square * 0), slope);
}
CUDA_CALLABLE inline Real inverse_curve_ratio(Real c, Real slope, int curve) {
    if (curve < INNER) return inverse_curve_ratio(c, curve);
    const Real b = inner_share(slope);
    return b * inverse_curve_ratio(c, curve - INNER) + (1 - b);
}
CUDA_CALLABLE inline double curve_area(Real s, Real slope, int curve) {
    if (curve < INNER) return curve_area(double(s), curve);
    const Real own = inner_field(s, slope, curve - INNER);
    const double b = inner_share(slope), y = own, c = double(curve_ratio(own, curve - INNER)) * y;
    const double missing = s - b * y - (1 - b) * c; // error of y, and s beyond SATURATING
    return b * curve_area(y, curve - INNER) + (1 - b) * c * c / 2 + missing * c;
}

// ---------- All curves ----------

// Curves of a vector of moments: ``common`` is the id of all, or MIXED; ``each`` is the id of each.
struct Curves {
    int common;
    Index each;
    const Real* tables;
    Number slope;
};

// Curves of ``lane_count`` moments from number i on. If ``common`` is MIXED, their ids are read one by one.
CUDA_CALLABLE inline Curves curves_of(const int* curve, int common, const Real* tables, Number slope, int i,
                                      int lane_count) {
#if defined(__CUDA_ARCH__)
    return {curve[i], curve[i], tables, slope};
#else
    Index each = common;
    if (common == MIXED)
        for (int l = 0; l < WIDTH; ++l) each[l] = curve[i + (l < lane_count ? l : 0)];
    return {common, each, tables, slope};
#endif
}

#if !defined(__CUDA_ARCH__)
// Values of moments with different curves: by_formula(curve) for curves with a formula, by_table(ids) for tables.
template <class ByFormula, class ByTable>
__attribute__((noinline)) inline Number of_mixed(const Curves& curves, ByFormula by_formula, ByTable by_table) {
    Number all = 0;
    for (int curve = TANH; curve < FIRST_TABLE; ++curve) {
        const Mask active = mask_of(curves.each == Index(curve));
        if (any(active)) all = active ? by_formula(curve) : all;
    }
    const auto tabled = curves.each >= Index(FIRST_TABLE);
    const Mask active = mask_of(tabled);
    return any(active) ? (active ? by_table(tabled ? curves.each : Index(FIRST_TABLE)) : all) : all;
}
#endif

// c(s)/s of any curve.
CUDA_CALLABLE inline Number curve_ratio(Number s, const Curves& curves) {
    if (curves.common >= FIRST_TABLE) return table_ratio(s, curves.each, curves.tables);
#if !defined(__CUDA_ARCH__)
    if (curves.common == MIXED)
        return of_mixed(
            curves, [=](int curve) { return curve_ratio(s, curves.slope, curve); },
            [=](Index each) { return table_ratio(s, each, curves.tables); });
#endif
    return curve_ratio(s, curves.slope, curves.common);
}

// c'(s) of any curve where c(s) has a given square.
CUDA_CALLABLE inline Number curve_steepness(Number square, const Curves& curves) {
    if (curves.common >= FIRST_TABLE) return table_steepness(root(square), curves.each, curves.tables);
#if !defined(__CUDA_ARCH__)
    if (curves.common == MIXED)
        return of_mixed(
            curves, [=](int curve) { return curve_steepness(square, curves.slope, curve); },
            [=](Index each) { return table_steepness(root(square), each, curves.tables); });
#endif
    return curve_steepness(square, curves.slope, curves.common);
}

// The same for one moment, called by Warp functions.
CUDA_CALLABLE inline Real curve_ratio(Real s, Real slope, int curve, const Real* tables) {
    return curve >= FIRST_TABLE ? table_ratio(s, curve, tables) : curve_ratio(s, slope, curve);
}
CUDA_CALLABLE inline Real curve_slope(Real s, Real slope, int curve, const Real* tables) {
    return curve >= FIRST_TABLE ? table_slope(s, curve, tables) : curve_slope(s, slope, curve);
}
CUDA_CALLABLE inline Real inverse_curve_ratio(Real c, Real slope, int curve, const Real* tables) {
    if (curve < FIRST_TABLE) return inverse_curve_ratio(c, slope, curve);
    return inverse_table_ratio(c < Real(0.999999) ? c : Real(0.999999), curve, tables);
}
CUDA_CALLABLE inline double curve_area(Real s, Real slope, int curve, const Real* tables) {
    return curve >= FIRST_TABLE ? table_area(s, curve, tables) : curve_area(s, slope, curve);
}
}
