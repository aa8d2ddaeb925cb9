// Field, gradient and potentials of a uniformly magnetized polyhedron at a vector of targets, in closed form.
//
// A face of surface charge σ = M·n has the potential σ P. With ν the outward normals of its edges in its plane,
//
//     4π P = ∫ dA/r = Σ ν·(v − x) L − z Ω,    L = ∫ dl/r = ln((r1 + r2 + l)/(r1 + r2 − l)),
//
// where z is the height of x above the face, v a corner of the edge, and Ω the solid angle of the face, positive above
// it. The field is 4π H = Σ σ (ν L + n Ω). Derivatives of L and Ω are algebraic; ∇Ω = −∮ dl × r/r³. With G = Σ n P the
// scalar potential is M·G, and the vector potential over μ0 is M × G.
//
// Reference: Werner and Scheeres 1997, "Exterior gravitation of a polyhedron", Celest. Mech. Dyn. Astron. 65, 313-344.
// Their gravity is G; by Poisson's theorem the field of M is minus the gradient of M·G.
//
// Near an edge and on its line r − τ cancels, and is written as ρ²/(r + τ). Here ρ is the distance from the line, and τ
// the distance along it. Targets nearer to an edge than the distance ``least`` count as that far away, which bounds the
// gradient; ``least2`` is its square.
#pragma once
#include "shared/group.h"

namespace warpmag {

constexpr int EDGE_ROW = 19, FACE_ROW = 3; // numbers of an edge and of a face

// Tables of a shape. A row of ``edge``: corner, direction, length, ν of both faces, n of both faces. A row of ``face``:
// n. Face f has the corners begin[f] to begin[f + 1].
struct Solid {
    const Real *edge, *face, *corner;
    const int* begin;
    int edges, faces;
};

// Vector that is equal in all lanes.
struct Real3 {
    Real x, y, z;
};
CUDA_CALLABLE inline Real3 real3(const Real* at) { return {at[0], at[1], at[2]}; }
CUDA_CALLABLE inline Real dot(Real3 a, Real3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
CUDA_CALLABLE inline Real3 operator+(Real3 a, Real3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
CUDA_CALLABLE inline Real3 operator-(Real3 a, Real3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
CUDA_CALLABLE inline Real3 operator*(Real k, Real3 a) { return {k * a.x, k * a.y, k * a.z}; }
CUDA_CALLABLE inline Real3& operator+=(Real3& a, Real3 b) { return a = a + b; }
CUDA_CALLABLE inline Real3 cross(Real3 a, Real3 b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
CUDA_CALLABLE inline Vector broadcast(Real3 a) {
    const Number zero = Number(Real(0));
    return {zero + a.x, zero + a.y, zero + a.z};
}

// Field and its symmetric gradient.
struct CurlFreeField {
    Vector h;
    Symmetric t;
};
CUDA_CALLABLE inline CurlFreeField zero_field() {
    const Number zero = Number(Real(0));
    return {{zero, zero, zero}, {zero, zero, zero, zero, zero, zero}};
}
CUDA_CALLABLE inline CurlFreeField operator*(Real k, const CurlFreeField& a) {
    const Symmetric& t = a.t;
    return {k * a.h, {k * t.xx, k * t.yy, k * t.zz, k * t.xy, k * t.yz, k * t.zx}};
}
CUDA_CALLABLE inline CurlFreeField operator-(const CurlFreeField& a, const CurlFreeField& b) {
    return {a.h - b.h,
            {a.t.xx - b.t.xx, a.t.yy - b.t.yy, a.t.zz - b.t.zz, a.t.xy - b.t.xy, a.t.yz - b.t.yz, a.t.zx - b.t.zx}};
}
CUDA_CALLABLE inline void add_where(Mask mask, Symmetric& to, const Symmetric& t) {
    to.xx += mask ? t.xx : 0, to.yy += mask ? t.yy : 0, to.zz += mask ? t.zz : 0;
    to.xy += mask ? t.xy : 0, to.yz += mask ? t.yz : 0, to.zx += mask ? t.zx : 0;
}
// Adds the upper triangle of s a bᵀ; only the sum of all calls is symmetric.
CUDA_CALLABLE inline void add_product(Symmetric& t, Number s, Vector a, Vector b) {
    t.xx += s * a.x * b.x, t.yy += s * a.y * b.y, t.zz += s * a.z * b.z;
    t.xy += s * a.x * b.y, t.yz += s * a.y * b.z, t.zx += s * a.z * b.x;
}

// An edge relative to the targets: vectors a and b to its ends, their lengths r1 and r2, and r1 + r2 ± l. ``normal`` is
// a × t, with t the direction of the edge.
struct EdgeView {
    Vector a, b, normal;
    Number r1, r2, sum, difference;
};
CUDA_CALLABLE inline EdgeView view_edge(const Real* edge, Vector x, Number least2) {
    const Real3 along = real3(edge + 3);
    const Real length = edge[6];
    const Vector t = broadcast(along), a = broadcast(real3(edge)) - x, b = a + (Number(Real(0)) + length) * t;
    const Real tiny = Real(1e-14) * length * length;
    const Vector c = cross(a, t);
    const Number rho2 = larger(dot(c, c), larger(least2, Number(Real(0)) + tiny));
    const Number r1 = root(dot(a, a) + tiny), r2 = root(dot(b, b) + tiny), t1 = -dot(a, t), t2 = dot(b, t);
    const Number m1 = t1 > 0 ? rho2 / (r1 + (t1 > 0 ? t1 : r1)) : r1 - t1;
    const Number m2 = t2 > 0 ? rho2 / (r2 + (t2 > 0 ? t2 : r2)) : r2 - t2;
    return {a, b, c, r1, r2, r1 + r2 + length, m1 + m2};
}

// −Ω/2 of face f seen from x, from the product of D + iN of its triangles (van Oosterom and Strackee 1983). The angles
// of all triangles have one sign, and sum to at most π.
CUDA_CALLABLE inline Number half_solid_angle(const Solid& solid, int f, Vector x) {
    const Number zero = Number(Real(0)), tiny = zero + Real(1e-30);
    auto direction_to = [&](int k) {
        const Vector a = broadcast(real3(solid.corner + 3 * k)) - x;
        return 1 / root(larger(dot(a, a), tiny)) * a;
    };
    const int begin = solid.begin[f], end = solid.begin[f + 1];
    const Vector p = direction_to(begin);
    Vector q = direction_to(begin + 1);
    Number real = zero + 1, imaginary = zero, pq = dot(p, q);
    for (int k = begin + 2; k < end; ++k) {
        const Vector s = direction_to(k);
        const Number sp = dot(s, p);
        const Number n = Real(0.25) * dot(p, cross(q, s)), d = Real(0.25) * (1 + pq + dot(q, s) + sp);
        const Number product = real * d - imaginary * n;
        imaginary = real * n + imaginary * d;
        real = product;
        q = s, pq = sp;
    }
    return angle(imaginary, real);
}

// Field and gradient of magnetization m at x, in the frame of the solid. Threads of a group share edges and faces: each
// takes every ``step``-th from ``begin`` on, and the caller adds up their results.
CUDA_CALLABLE inline CurlFreeField field_of(const Solid& solid, Real3 m, Vector x, Number least2, int begin, int step) {
    constexpr Real INVERSE = Real(0.07957747154594767); // 1/4π
    CurlFreeField out = zero_field();
    const Real negligible = Real(1e-12) * dot(m, m);
    for (int e = begin; e < solid.edges; e += step) {
        const Real* const edge = solid.edge + EDGE_ROW * e;
        const Real3 n1 = real3(edge + 13), n2 = real3(edge + 16);
        const Real s1 = INVERSE * dot(m, n1), s2 = INVERSE * dot(m, n2);
        if (s1 * s1 + s2 * s2 <= negligible) continue;
        const EdgeView at = view_edge(edge, x, least2);
        const Vector w = broadcast(s1 * real3(edge + 7) + s2 * real3(edge + 10));
        const Number factor = 2 / (at.sum * at.difference), length = Number(Real(0)) + edge[6];
        out.h += logarithm(at.sum / at.difference) * w;
        add_product(out.t, length * factor, w, 1 / at.r1 * at.a + 1 / at.r2 * at.b);
        const Number twist = length * factor * (1 / at.r1 + 1 / at.r2);
        add_product(out.t, -twist, broadcast(s1 * n1 - s2 * n2), at.normal);
    }
    for (int f = begin; f < solid.faces; f += step) {
        const Real3 n = real3(solid.face + FACE_ROW * f);
        const Real charge = -2 * INVERSE * dot(m, n);
        if (charge * charge <= negligible) continue;
        out.h += charge * half_solid_angle(solid, f, x) * broadcast(n);
    }
    return out;
}

// Scalar potential and field of magnetization m at x, in the frame of the solid.
struct PotentialField {
    Number phi;
    Vector h;
};
CUDA_CALLABLE inline PotentialField potential_field_of(const Solid& solid, Real3 m, Vector x) {
    constexpr Real INVERSE = Real(0.07957747154594767); // 1/4π
    const Number zero = Number(Real(0));
    PotentialField out = {zero, {zero, zero, zero}};
    const Real negligible = Real(1e-12) * dot(m, m);
    for (int e = 0; e < solid.edges; ++e) {
        const Real* const edge = solid.edge + EDGE_ROW * e;
        const Real s1 = INVERSE * dot(m, real3(edge + 13)), s2 = INVERSE * dot(m, real3(edge + 16));
        if (s1 * s1 + s2 * s2 <= negligible) continue;
        const EdgeView at = view_edge(edge, x, zero);
        const Vector w = logarithm(at.sum / at.difference) * broadcast(s1 * real3(edge + 7) + s2 * real3(edge + 10));
        out.h += w;
        out.phi += dot(at.a, w);
    }
    for (int f = 0; f < solid.faces; ++f) {
        const Real3 n = real3(solid.face + FACE_ROW * f);
        const Real charge = -2 * INVERSE * dot(m, n);
        if (charge * charge <= negligible) continue;
        const Number angle = charge * half_solid_angle(solid, f, x);
        out.h += angle * broadcast(n);
        out.phi -= angle * dot(x - broadcast(real3(solid.corner + 3 * solid.begin[f])), broadcast(n));
    }
    return out;
}

// G = Σ n P at x, in the frame of the solid.
CUDA_CALLABLE inline Vector potentials_of(const Solid& solid, Vector x) {
    const Number zero = Number(Real(0));
    Vector g = {zero, zero, zero};
    for (int e = 0; e < solid.edges; ++e) {
        const Real* const edge = solid.edge + EDGE_ROW * e;
        const EdgeView at = view_edge(edge, x, zero);
        const Number l = logarithm(at.sum / at.difference);
        g += l * dot(at.a, broadcast(real3(edge + 7))) * broadcast(real3(edge + 13));
        g += l * dot(at.a, broadcast(real3(edge + 10))) * broadcast(real3(edge + 16));
    }
    for (int f = 0; f < solid.faces; ++f) {
        const Vector n = broadcast(real3(solid.face + FACE_ROW * f));
        const Number height = dot(x - broadcast(real3(solid.corner + 3 * solid.begin[f])), n);
        g += 2 * height * half_solid_angle(solid, f, x) * n;
    }
    return (zero + Real(0.07957747154594767)) * g;
}

// Mask of the points x inside the solid, in its frame.
CUDA_CALLABLE inline Mask inside_of(const Solid& solid, Vector x) {
    Mask inside = x.x == x.x;
    for (int f = 0; f < solid.faces; ++f) {
        const Vector n = broadcast(real3(solid.face + FACE_ROW * f));
        inside &= dot(x - broadcast(real3(solid.corner + 3 * solid.begin[f])), n) < 0;
    }
    return inside;
}
}
