// Rate of change of the field at conducting balls, and field of their eddy moments at other balls; eddy.py has the
// equations.
//
// On a CPU a pass works on a vector of balls of one world, on a GPU a group of threads shares a ball. From Python:
// MU0_4PI and GROUP. ``Arrays`` is the struct of eddy.py.
#pragma once
#include "pairs/pair_law.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

enum EddyPass { RATES, FIELDS }; // as in eddy.py
// Squared norm Σ t_kl².
CUDA_CALLABLE inline Number square(const Symmetric& t) {
    return t.xx * t.xx + t.yy * t.yy + t.zz * t.zz + 2 * (t.xy * t.xy + t.yz * t.yz + t.zx * t.zx);
}
// Gradient of a dipole's field (times 4π), g2 (r mᵀ + m rᵀ + r·m 1) + b r rᵀ.
CUDA_CALLABLE inline Symmetric gradient_of(Vector r, Vector m, Number g2, Number b) {
    const Number a = g2 * dot(r, m);
    return {a + 2 * g2 * r.x * m.x + b * r.x * r.x,       a + 2 * g2 * r.y * m.y + b * r.y * r.y,
            a + 2 * g2 * r.z * m.z + b * r.z * r.z,       g2 * (r.x * m.y + r.y * m.x) + b * r.x * r.y,
            g2 * (r.y * m.z + r.z * m.y) + b * r.y * r.z, g2 * (r.z * m.x + r.x * m.z) + b * r.z * r.x};
}
CUDA_CALLABLE inline void add(Symmetric& total, const Symmetric& t) {
    total.xx += t.xx, total.yy += t.yy, total.zz += t.zz, total.xy += t.xy, total.yz += t.yz, total.zx += t.zx;
}

// Table with a column for each moment.
struct MomentColumns {
    const Real* data;
    size_t pitch;
    CUDA_CALLABLE MomentColumns(const wp::array_t<Real>& rows)
        : data(rows.data), pitch(rows.strides[0] / sizeof(Real)) {}
    CUDA_CALLABLE Real at(int row, int j) const { return data[row * pitch + j]; }
    CUDA_CALLABLE Number own(int row, const int* i) const { return gather(data + row * pitch, i); }
    CUDA_CALLABLE Vector own_vector_at(int row, const int* i) const {
        return {own(row, i), own(row + 1, i), own(row + 2, i)};
    }
    CUDA_CALLABLE Vector vector_at(int row, int j) const {
        const Number zero = Number(Real(0));
        return {zero + at(row, j), zero + at(row + 1, j), zero + at(row + 2, j)};
    }
};

// At a ball: 4π times the field, its rate and its gradient, and the sources' part of the decay rate K over |N|².
struct FieldAtBall {
    Vector h, rate;
    Symmetric t;
    Number decay;
};
// Adds source j to the field at balls that move with ``velocity``. With w = ω_j × m_j the rate of 4πH is
// ∇(4πH) (v − v_j) + 4πH of w.
CUDA_CALLABLE inline void add_source(FieldAtBall& at_ball, const MomentColumns& packed, const MomentColumns& motion,
                                     int j, Vector x, Number radius, Vector velocity, Mask active) {
    const Number zero = Number(Real(0)), other = zero + packed.at(3, j), s = radius + other, s2 = s * s;
    const Vector r = x - packed.vector_at(0, j), m = packed.vector_at(4, j), w = cross(motion.vector_at(3, j), m);
    const Number d2 = dot(r, r), c = larger(d2, s2);
    const Number i = (active & (c > zero)) ? Real(0.5) * twice_inverse_root(c) : zero, i2 = i * i, i3 = i2 * i;
    const Number g2 = 3 * i2 * i3;
    Symmetric t = gradient_of(r, m, g2, -5 * i2 * (g2 * dot(r, m))); // not with r⁻⁷, which overflows float32 at 1 µm
    Vector h = g2 * dot(r, m) * r - i3 * m, h_w = g2 * dot(r, w) * r - i3 * w;
    const Mask overlapping = active & (d2 < s2);
    if (any(overlapping)) {
        const Overlap p = overlap_of(r, radius, other, m, overlapping);
        add_where(overlapping, h, field_of(p));
        add_where(overlapping, h_w, field_of(overlap_of(r, radius, other, w, overlapping)));
        const Number g = p.unit * p.g.g2, g3 = p.unit * p.g.g3; // may be NaN in lanes that do not overlap
        const Vector u = {overlapping ? p.u.x : 0, overlapping ? p.u.y : 0, overlapping ? p.u.z : 0};
        add(t, gradient_of(u, p.m, overlapping ? g : 0, overlapping ? g3 * dot(p.u, p.m) : 0));
    }
    at_ball.h += h;
    at_ball.rate += (t * (velocity - motion.vector_at(0, j)) + h_w);
    add(at_ball.t, t);
    const Real scale = MU0_4PI * MU0_4PI;
    at_ball.decay += (scale * motion.at(6, j)) * square(t) + (scale * motion.at(7, j)) * dot(h, h);
}

template <class Arrays> CUDA_CALLABLE inline void rates_at(const Arrays& arrays, int slot) {
    const auto& chunk = arrays.chunk.data[slot / CHUNK]; // number of balls, range of sources in their world
    if (slot % CHUNK >= chunk[0]) return;
    const MomentColumns packed(arrays.packed), motion(arrays.motion);
    const int* const own = arrays.ball.data + slot;
    const Number zero = Number(Real(0)), radius = packed.own(3, own), label = packed.own(7, own);
    const Vector zeros = {zero, zero, zero}, x = packed.own_vector_at(0, own), velocity = motion.own_vector_at(0, own);
    FieldAtBall at_ball = {zeros, zeros, {zero, zero, zero, zero, zero, zero}, zero};
    for (int j = chunk[1] + share(); j < chunk[2]; j += SHARES)
        add_source(at_ball, packed, motion, j, x, radius, velocity, mask_of(label != packed.at(7, j)));
    const Number rows[] = {at_ball.h.x,    at_ball.h.y,  at_ball.h.z,  at_ball.rate.x, at_ball.rate.y,
                           at_ball.rate.z, at_ball.t.xx, at_ball.t.yy, at_ball.t.zz,   at_ball.t.xy,
                           at_ball.t.yz,   at_ball.t.zx, at_ball.decay};
    int row = 0;
    for (const Number part : rows) {
        const Number total = group_sum(part);
        if (share() == 0) put(arrays.at_conductor.data + arrays.at_conductor.shape[1] * (size_t)row++ + slot, total);
    }
}

// 4π times the field of the eddy moments at inducible balls whose torque is computed.
template <class Arrays> CUDA_CALLABLE inline void fields_at(const Arrays& arrays, int slot) {
    const auto& chunk = arrays.torque_chunk.data[slot / CHUNK]; // number of balls, range of conductors in their world
    if (slot % CHUNK >= chunk[0]) return;
    const MomentColumns packed(arrays.packed), eddy(arrays.eddy);
    const int* const own = arrays.torque_ball.data + slot;
    const Number zero = Number(Real(0)), radius = packed.own(3, own), label = packed.own(7, own);
    const Vector x = packed.own_vector_at(0, own);
    Vector h = {zero, zero, zero};
    for (int k = chunk[1] + share(); k < chunk[2]; k += SHARES) {
        const int j = arrays.conductor.data[k];
        add_pair_field(h, x - packed.vector_at(0, j), radius, zero + packed.at(3, j), eddy.vector_at(0, j),
                       mask_of(label != packed.at(7, j)));
    }
    h = group_sums(h);
    if (share() != 0) return;
    const Number rows[] = {h.x, h.y, h.z};
    for (int c = 0; c < 3; ++c) put(arrays.field.data + arrays.field.shape[1] * (size_t)c + slot, rows[c]);
}

template <class Word, class Arrays>
CUDA_CALLABLE inline void eddy_passes(int thread, int first, int last, int threads, Word* team, const Arrays& arrays) {
    const auto make_pass = [&](int pass, int i) { pass == RATES ? rates_at(arrays, i) : fields_at(arrays, i); };
#if defined(__CUDA_ARCH__)
    make_pass(first, thread / GROUP);
#else
    const int items[] = {CHUNK * (int)arrays.chunk.shape[0], CHUNK * (int)arrays.torque_chunk.shape[0]};
    run_passes(team, threads, first, last, [&](int pass) { return items[pass]; }, WIDTH, make_pass);
#endif
}
}
