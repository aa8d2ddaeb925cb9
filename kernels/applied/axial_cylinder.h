// Field and gradient of a cylinder that is magnetized along its axis: H = B/μ0 − M, with B of the sheet of current M on
// its wall (solenoid.h).
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
}
