// Field, gradient and potentials of a cylinder that is magnetized along its axis: H = B/μ0 − M, with B of the sheet of
// current M on its wall (solenoid.h).
//
// The potentials follow from the field. The potential P of an end face of unit charge is homogeneous in ρ, z and a, of
// degree 1; the vector potential A_φ = ρ F of one end of the sheet is, too, and ρ² F is symmetric in ρ and a, as each
// mutual inductance. With H of the face and B/μ0 of the sheet, Euler's theorem gives
//
//     P = −(ρ H_ρ + z H_z) + a² K/(πβ),      2 ρ² F = −z ρ B_ρ + ρ² B_z(ρ, a) + a² B_z(a, ρ),
//
// where a K/(πβ) = ∂P/∂a is the potential of a ring. Both terms B_z combine to aρ z/(πβ) cel(q, γ², 1, −γ²). The
// first step of cel is done in closed form, as in loop.h.
#pragma once
#include "applied/polyhedron.h"
#include "applied/solenoid.h"

namespace warpmag {

// ``magnetization`` is along the axis. Radius 0 stands for no such cylinder.
struct AxialCylinder {
    Real3 center, axis;
    Real radius, half_height, magnetization;
};

// Points relative to a cylinder: height above the middle, and vector from the axis.
struct CylinderPoints {
    Number z, rho2;
    Vector out;
    Mask inside;
};
CUDA_CALLABLE inline CylinderPoints points_about(const AxialCylinder& cylinder, Vector x) {
    const Vector axis = broadcast(cylinder.axis), from = x - broadcast(cylinder.center);
    const Number z = dot(from, axis), a = z * 0 + cylinder.radius, b = z * 0 + cylinder.half_height;
    const Vector out = from - z * axis;
    const Number rho2 = dot(out, out);
    return {z, rho2, out, (rho2 < a * a) & (z < b) & (z > -b)};
}
// Field at x in the frame of the cylinder's body, as ``field_of`` of a solid; the threads of a group share its ends.
CUDA_CALLABLE inline CurlFreeField field_of(const AxialCylinder& cylinder, Vector x, Number least2, int begin,
                                            int step) {
    const Number zero = Number(Real(0)), a = zero + cylinder.radius, b = zero + cylinder.half_height;
    const Vector axis = broadcast(cylinder.axis);
    const CylinderPoints at = points_about(cylinder, x);
    const Number tiny = Real(1e-12) * a * a;
    Number e = zero, h_z = zero, f = zero, z_z = zero; // as in solenoid.h
    for (int k = begin; k < 2; k += step) {
        const Real sign = Real(1 - 2 * k);
        Number q[1], values[1][4];
        Cel<Number> integrals[1][4];
        put_sheet_end<Number>(a, root(at.rho2), at.z + sign * b, larger(least2, tiny), q[0], integrals[0]);
        evaluate<Number>(q, integrals, values);
        e += sign * values[0][0], h_z += sign * values[0][1], f += sign * values[0][2], z_z += sign * values[0][3];
    }
    CurlFreeField result = zero_field();
    result.h = e * at.out + h_z * axis;
    const Number radial = at.rho2 > tiny ? (-2 * e - z_z) / at.rho2 : zero;
    add_product(result.t, radial, at.out, at.out), add_product(result.t, z_z - e, axis, axis);
    add_product(result.t, f, at.out, axis), add_product(result.t, f, axis, at.out);
    result.t.xx += e, result.t.yy += e, result.t.zz += e;
    result = Real(INVERSE_PI) * cylinder.magnetization * result;
    if (begin == 0) add_where(at.inside, result.h, -(zero + cylinder.magnetization) * axis);
    return result;
}

// Scalar potential of a body, and its vector potential over μ0.
struct Potentials {
    Number phi;
    Vector a;
};
// P and F of the end of a cylinder of radius a, at the height z above this end.
struct EndPotentials {
    Number p, f;
};
CUDA_CALLABLE inline EndPotentials end_potentials(Number a, Number rho, Number z) {
    const Number zero = 0 * a, tiny = Real(1e-12) * a * a, gamma = sheet_gamma(a, rho), size = magnitude(gamma);
    const LoopPoint<Number> at(a, rho, z, tiny);
    Number q[1], values[1][4];
    Cel<Number> integrals[1][4], &ring = integrals[0][2], &rest = integrals[0][3];
    put_sheet_end<Number>(a, rho, z, tiny, q[0], integrals[0]);
    const Number bracket = z * (z * z + at.q * at.beta2) / ((a + rho) * (a + rho) * size);
    ring = {a * a / at.beta, 1 + at.q, zero + 2, 2 * (1 + at.q)};
    rest = {-bracket * integrals[0][0].factor, at.q / size + size, zero, zero + 1};
    evaluate<Number>(q, integrals, values);
    const Number e = values[0][0], h_z = values[0][1], of_face = gamma > 0 ? Real(0.5) * magnitude(z) : zero;
    return {Real(INVERSE_PI) * (z * h_z + rho * rho * e + values[0][2]) - of_face,
            Real(0.5 * INVERSE_PI) * (values[0][3] - z * e)};
}
// Potentials at x in the frame of the cylinder's body.
CUDA_CALLABLE inline Potentials potentials_of(const AxialCylinder& cylinder, Vector x) {
    const CylinderPoints at = points_about(cylinder, x);
    const Number zero = Number(Real(0)), a = zero + cylinder.radius, rho = root(at.rho2),
                 m = zero + cylinder.magnetization;
    const EndPotentials above = end_potentials(a, rho, at.z - cylinder.half_height),
                        below = end_potentials(a, rho, at.z + cylinder.half_height);
    return {m * (above.p - below.p), m * (below.f - above.f) * cross(broadcast(cylinder.axis), at.out)};
}
}
