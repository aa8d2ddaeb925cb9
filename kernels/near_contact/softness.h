// How the higher multipoles of a ball soften as it saturates: they feel the differential susceptibility of its curve.
#pragma once
#include "near_contact/state.h"

namespace warpmag {

// Slope k_d of the curve at the ball's moment, between 0 and the 3 of an ideally permeable ball; 1/χ_d = 1/k_d − 1/3.
CUDA_CALLABLE inline Number differential_slope(const Arrays& a, int i) {
    const Number slope = numbers(a.curve_slope + i), zero = slope * Real(0);
    const Vector reduced = numbers(a.unsaturated + i) * a.own_moment(i);
    const Number steepness = curve_steepness(dot(reduced, reduced), a.curves(i));
    return smaller(larger(slope * steepness, zero), zero + 3);
}

// Polarizability lχ/(lχ + 2l + 1) of a ball's multipoles of degree ``l``, over R^(2l+1).
CUDA_CALLABLE inline Number polarizability(Number slope, Real degree) {
    const Real stiffness = 2 + 1 / degree;
    return slope / (stiffness + slope * (1 - stiffness * Real(1.0 / 3.0)));
}
}
