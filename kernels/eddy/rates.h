// How fast the field changes at conducting balls, and what their eddy currents make of it at others; eddy.py has the
// equations.
//
// On a CPU a pass works on a vector of balls of one world, on a GPU a group of threads shares one. Takes MU0_4PI and
// GROUP from Python; ``All`` is the struct of eddy.py, which has the names.
#pragma once
#include "pairs/pair_law.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

enum EddyPass { RATES, FIELDS, EDDY_PASSES }; // as in eddy.py
CUDA_CALLABLE inline Number square(const Symmetric& t) {
    return t.xx * t.xx + t.yy * t.yy + t.zz * t.zz + 2 * (t.xy * t.xy + t.yz * t.yz + t.zx * t.zx);
}
// g2 (r m^T + m r^T + r·m) + b r r^T
CUDA_CALLABLE inline Symmetric slope_of(Vector r, Vector m, Number g2, Number b) {
    const Number a = g2 * dot(r, m);
    return {a + 2 * g2 * r.x * m.x + b * r.x * r.x,       a + 2 * g2 * r.y * m.y + b * r.y * r.y,
            a + 2 * g2 * r.z * m.z + b * r.z * r.z,       g2 * (r.x * m.y + r.y * m.x) + b * r.x * r.y,
            g2 * (r.y * m.z + r.z * m.y) + b * r.y * r.z, g2 * (r.z * m.x + r.x * m.z) + b * r.z * r.x};
}
CUDA_CALLABLE inline void add(Symmetric& to, const Symmetric& t) {
    to.xx += t.xx, to.yy += t.yy, to.zz += t.zz, to.xy += t.xy, to.yz += t.yz, to.zx += t.zx;
}

// Rows of a table that is read by columns.
struct Columns {
    const Real* data;
    size_t pitch;
    CUDA_CALLABLE Columns(const wp::array_t<Real>& rows) : data(rows.data), pitch(rows.strides[0] / sizeof(Real)) {}
    CUDA_CALLABLE Real at(int row, int j) const { return data[row * pitch + j]; }
    CUDA_CALLABLE Number own(int row, const int* i) const { return gather(data + row * pitch, i); }
    CUDA_CALLABLE Vector own_three(int row, const int* i) const {
        return {own(row, i), own(row + 1, i), own(row + 2, i)};
    }
    CUDA_CALLABLE Vector three(int row, int j) const {
        const Number zero = Number(Real(0));
        return {zero + at(row, j), zero + at(row + 1, j), zero + at(row + 2, j)};
    }
};

// What a ball sees, 4π times each but the last: field, its rate, its gradient; and how much the bodies of the sources
// give way to the ball's eddy currents.
struct Seen {
    Vector h, rate;
    Symmetric t;
    Number yield;
};
CUDA_CALLABLE inline void add_source(Seen& seen, const Columns& packed, const Columns& motion, int j, Vector x,
                                     Number radius, Vector velocity, Mask wanted) {
    const Number zero = Number(Real(0)), other = zero + packed.at(3, j), s = radius + other, s2 = s * s;
    const Vector r = x - packed.three(0, j), m = packed.three(4, j), w = cross(motion.three(3, j), m);
    const Number d2 = dot(r, r), c = larger(d2, s2);
    const Number i = (wanted & (c > zero)) ? Real(0.5) * twice_inverse_root(c) : zero, i2 = i * i, i3 = i2 * i;
    const Number g2 = 3 * i2 * i3;
    Symmetric t = slope_of(r, m, g2, -5 * i2 * (g2 * dot(r, m))); // without r⁻⁷, which is no float at 1 µm
    Vector h = g2 * dot(r, m) * r - i3 * m, turn = g2 * dot(r, w) * r - i3 * w;
    const Mask overlapping = wanted & (d2 < s2);
    if (any(overlapping)) {
        const Overlap p = overlap_of(r, radius, other, m, overlapping);
        add_where(overlapping, h, field_of(p));
        add_where(overlapping, turn, field_of(overlap_of(r, radius, other, w, overlapping)));
        const Number g = p.unit * p.g.g2, g3 = p.unit * p.g.g3; // of lanes that do not overlap they may be no numbers
        const Vector u = {overlapping ? p.u.x : 0, overlapping ? p.u.y : 0, overlapping ? p.u.z : 0};
        add(t, slope_of(u, p.m, overlapping ? g : 0, overlapping ? g3 * dot(p.u, p.m) : 0));
    }
    seen.h += h;
    seen.rate += (t * (velocity - motion.three(0, j)) + turn);
    add(seen.t, t);
    const Real unit = MU0_4PI * MU0_4PI;
    seen.yield += (unit * motion.at(6, j)) * square(t) + (unit * motion.at(7, j)) * dot(h, h);
}

template <class All> CUDA_CALLABLE inline void rates_at(const All& all, int slot) {
    const auto& chunk = all.chunk.data[slot / CHUNK]; // its balls, and the sources of their world
    if (slot % CHUNK >= chunk[0]) return;
    const Columns packed(all.packed), motion(all.motion);
    const int* const own = all.ball.data + slot;
    const Number zero = Number(Real(0)), radius = packed.own(3, own), label = packed.own(7, own);
    const Vector none = {zero, zero, zero}, x = packed.own_three(0, own), velocity = motion.own_three(0, own);
    Seen seen = {none, none, {zero, zero, zero, zero, zero, zero}, zero};
    for (int j = chunk[1] + share(); j < chunk[2]; j += SHARES)
        add_source(seen, packed, motion, j, x, radius, velocity, mask_of(label != packed.at(7, j)));
    const Number rows[] = {seen.h.x,  seen.h.y,  seen.h.z,  seen.rate.x, seen.rate.y, seen.rate.z, seen.t.xx,
                           seen.t.yy, seen.t.zz, seen.t.xy, seen.t.yz,   seen.t.zx,   seen.yield};
    int row = 0;
    for (const Number part : rows) {
        const Number total = group_sum(part);
        if (share() == 0) put(all.seen.data + all.seen.shape[1] * (size_t)row++ + slot, total);
    }
}

// 4π times the field of the eddy moments at balls that are parallel to the field otherwise.
template <class All> CUDA_CALLABLE inline void fields_at(const All& all, int slot) {
    const auto& chunk = all.turned_chunk.data[slot / CHUNK]; // its balls, and the conducting ones of their world
    if (slot % CHUNK >= chunk[0]) return;
    const Columns packed(all.packed), eddy(all.eddy);
    const int* const own = all.turned.data + slot;
    const Number zero = Number(Real(0)), radius = packed.own(3, own), label = packed.own(7, own);
    const Vector x = packed.own_three(0, own);
    Vector h = {zero, zero, zero};
    for (int k = chunk[1] + share(); k < chunk[2]; k += SHARES) {
        const int j = all.conductor.data[k];
        add_pair_field(h, x - packed.three(0, j), radius, zero + packed.at(3, j), eddy.three(0, j),
                       mask_of(label != packed.at(7, j)));
    }
    h = group_sums(h);
    if (share() != 0) return;
    const Number rows[] = {h.x, h.y, h.z};
    for (int c = 0; c < 3; ++c) put(all.field.data + all.field.shape[1] * (size_t)c + slot, rows[c]);
}

template <class Word, class All>
CUDA_CALLABLE inline void eddy_passes(int thread, int first, int last, int threads, Word* team, const All& all) {
    const auto make_pass = [&](int pass, int i) { pass == RATES ? rates_at(all, i) : fields_at(all, i); };
#if defined(__CUDA_ARCH__)
    make_pass(first, thread / GROUP);
#else
    const int items[] = {CHUNK * (int)all.chunk.shape[0], CHUNK * (int)all.turned_chunk.shape[0]};
    run_passes(team, threads, first, last, [&](int pass) { return items[pass]; }, WIDTH, make_pass);
#endif
}
}
