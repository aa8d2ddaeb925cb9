// Field, gradient and potentials of a uniformly magnetized polyhedron at several targets, in closed form.
//
// A face of charge σ = M·n, with edges of outward directions ν, has the potential
//
//     4π P = ∫ dA/r = Σ ν·(v − x) L − z Ω,    L = ∫ dl/r = ln((r1 + r2 + l)/(r1 + r2 − l)),
//
// z being the height of x over the face, v a corner of the edge and Ω the solid angle of the face, positive above it.
// Tangential derivatives of it make ν L, so that 4π H = Σ σ (ν L + n Ω), and derivatives of L and Ω are algebraic: Ω's
// is −∮ dl × r/r³. With G = Σ n P the scalar potential is M·G, and the vector potential over μ0 is M×G. Reference:
// Werner and Scheeres 1997, "Exterior gravitation of a polyhedron", Celest. Mech. Dyn. Astron. 65, 313-344, whose
// gravity is G; a field of M is minus its gradient (Poisson).
//
// Logarithms keep their digits near edges and on their lines: r − τ is ρ²/(r + τ), ρ and τ being the distance from the
// line and along it. Where one is nearer to an edge than ``least``, it counts as that far: a field's gradient stays
// bounded.
#pragma once
#include "shared/group.h"

namespace warpmag {

constexpr int EDGE_ROW = 19, FACE_ROW = 3; // as in solids.py

// Tables of a shape: rows of edges (corner, direction, length, ν and n of both faces), of faces (n), and the corners of
// each face from corner[begin] to corner[end].
struct Solid {
    const Real *edge, *face, *corner;
    const int* begin;
    int edges, faces;
};

struct Three {
    Real x, y, z;
};
CUDA_CALLABLE inline Three three(const Real* at) { return {at[0], at[1], at[2]}; }
CUDA_CALLABLE inline Real dot(Three a, Three b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
CUDA_CALLABLE inline Three operator+(Three a, Three b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
CUDA_CALLABLE inline Three operator-(Three a, Three b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
CUDA_CALLABLE inline Three operator*(Real k, Three a) { return {k * a.x, k * a.y, k * a.z}; }
CUDA_CALLABLE inline Three& operator+=(Three& a, Three b) { return a = a + b; }
CUDA_CALLABLE inline Three cross(Three a, Three b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
CUDA_CALLABLE inline Vector spread(Three a) {
    const Number zero = Number(Real(0));
    return {zero + a.x, zero + a.y, zero + a.z};
}

// Field and its gradient.
struct Near {
    Vector h;
    Symmetric t;
};
CUDA_CALLABLE inline Near no_field() {
    const Number zero = Number(Real(0));
    return {{zero, zero, zero}, {zero, zero, zero, zero, zero, zero}};
}
CUDA_CALLABLE inline Near operator*(Real k, const Near& a) {
    const Symmetric& t = a.t;
    return {k * a.h, {k * t.xx, k * t.yy, k * t.zz, k * t.xy, k * t.yz, k * t.zx}};
}
CUDA_CALLABLE inline Near operator-(const Near& a, const Near& b) {
    return {a.h - b.h,
            {a.t.xx - b.t.xx, a.t.yy - b.t.yy, a.t.zz - b.t.zz, a.t.xy - b.t.xy, a.t.yz - b.t.yz, a.t.zx - b.t.zx}};
}
CUDA_CALLABLE inline void add_where(Mask wanted, Symmetric& to, const Symmetric& t) {
    to.xx += wanted ? t.xx : 0, to.yy += wanted ? t.yy : 0, to.zz += wanted ? t.zz : 0;
    to.xy += wanted ? t.xy : 0, to.yz += wanted ? t.yz : 0, to.zx += wanted ? t.zx : 0;
}
// Adds s (a b^T), of which the sum of all is symmetric.
CUDA_CALLABLE inline void add_product(Symmetric& t, Number s, Vector a, Vector b) {
    t.xx += s * a.x * b.x, t.yy += s * a.y * b.y, t.zz += s * a.z * b.z;
    t.xy += s * a.x * b.y, t.yz += s * a.y * b.z, t.zx += s * a.z * b.x;
}

// An edge seen from targets: its ends a and b, distances from them, and r1 + r2 + l and r1 + r2 − l.
struct Sight {
    Vector a, b, across;
    Number r1, r2, more, less;
};
CUDA_CALLABLE inline Sight sight_of(const Real* edge, Vector x, Number least2) {
    const Three along = three(edge + 3);
    const Real length = edge[6];
    const Vector t = spread(along), a = spread(three(edge)) - x, b = a + (Number(Real(0)) + length) * t;
    const Real tiny = Real(1e-14) * length * length;
    const Vector c = cross(a, t);
    const Number rho2 = larger(dot(c, c), larger(least2, Number(Real(0)) + tiny));
    const Number r1 = root(dot(a, a) + tiny), r2 = root(dot(b, b) + tiny), t1 = -dot(a, t), t2 = dot(b, t);
    const Number m1 = t1 > 0 ? rho2 / (r1 + (t1 > 0 ? t1 : r1)) : r1 - t1;
    const Number m2 = t2 > 0 ? rho2 / (r2 + (t2 > 0 ? t2 : r2)) : r2 - t2;
    return {a, b, c, r1, r2, r1 + r2 + length, m1 + m2};
}

// 2π times less than nothing: the solid angle of face f, over −2, from the product of its triangles' (D + iN) (van
// Oosterom and Strackee 1983), whose angles are all of one sign.
CUDA_CALLABLE inline Number half_angle(const Solid& solid, int f, Vector x) {
    const Number zero = Number(Real(0)), tiny = zero + Real(1e-30);
    auto towards = [&](int k) {
        const Vector a = spread(three(solid.corner + 3 * k)) - x;
        return 1 / root(larger(dot(a, a), tiny)) * a;
    };
    const int begin = solid.begin[f], end = solid.begin[f + 1];
    const Vector p = towards(begin);
    Vector q = towards(begin + 1);
    Number real = zero + 1, imaginary = zero, pq = dot(p, q);
    for (int k = begin + 2; k < end; ++k) {
        const Vector s = towards(k);
        const Number sp = dot(s, p);
        const Number n = Real(0.25) * dot(p, cross(q, s)), d = Real(0.25) * (1 + pq + dot(q, s) + sp);
        const Number turned = real * d - imaginary * n;
        imaginary = real * n + imaginary * d;
        real = turned;
        q = s, pq = sp;
    }
    return angle(imaginary, real);
}

// Field and gradient of magnetization M at x, both in the frame of the solid; threads of a group share out edges and
// faces, each ``step``-th from ``begin`` on, and what they have is to be added up.
CUDA_CALLABLE inline Near field_of(const Solid& solid, Three m, Vector x, Number least2, int begin, int step) {
    constexpr Real INVERSE = Real(0.07957747154594767);
    Near out = no_field();
    const Real dark = Real(1e-12) * dot(m, m);
    for (int e = begin; e < solid.edges; e += step) {
        const Real* const edge = solid.edge + EDGE_ROW * e;
        const Three n1 = three(edge + 13), n2 = three(edge + 16);
        const Real s1 = INVERSE * dot(m, n1), s2 = INVERSE * dot(m, n2);
        if (s1 * s1 + s2 * s2 <= dark) continue;
        const Sight at = sight_of(edge, x, least2);
        const Vector w = spread(s1 * three(edge + 7) + s2 * three(edge + 10));
        const Number factor = 2 / (at.more * at.less), length = Number(Real(0)) + edge[6];
        out.h += logarithm(at.more / at.less) * w;
        add_product(out.t, length * factor, w, 1 / at.r1 * at.a + 1 / at.r2 * at.b);
        const Number turn = length * factor * (1 / at.r1 + 1 / at.r2);
        add_product(out.t, -turn, spread(s1 * n1 - s2 * n2), at.across);
    }
    for (int f = begin; f < solid.faces; f += step) {
        const Three n = three(solid.face + FACE_ROW * f);
        const Real charge = -2 * INVERSE * dot(m, n);
        if (charge * charge <= dark) continue;
        out.h += charge * half_angle(solid, f, x) * spread(n);
    }
    return out;
}

// G at x in the frame of the solid.
CUDA_CALLABLE inline Vector potentials_of(const Solid& solid, Vector x) {
    const Number zero = Number(Real(0));
    Vector g = {zero, zero, zero};
    for (int e = 0; e < solid.edges; ++e) {
        const Real* const edge = solid.edge + EDGE_ROW * e;
        const Sight at = sight_of(edge, x, zero);
        const Number l = logarithm(at.more / at.less);
        g += l * dot(at.a, spread(three(edge + 7))) * spread(three(edge + 13));
        g += l * dot(at.a, spread(three(edge + 10))) * spread(three(edge + 16));
    }
    for (int f = 0; f < solid.faces; ++f) {
        const Vector n = spread(three(solid.face + FACE_ROW * f));
        const Number height = dot(x - spread(three(solid.corner + 3 * solid.begin[f])), n);
        g += 2 * height * half_angle(solid, f, x) * n;
    }
    return (zero + Real(0.07957747154594767)) * g;
}

// Whether x, in the frame of the solid, lies inside.
CUDA_CALLABLE inline Mask inside_of(const Solid& solid, Vector x) {
    Mask inside = x.x == x.x;
    for (int f = 0; f < solid.faces; ++f) {
        const Vector n = spread(three(solid.face + FACE_ROW * f));
        inside &= dot(x - spread(three(solid.corner + 3 * solid.begin[f])), n) < 0;
    }
    return inside;
}
}
