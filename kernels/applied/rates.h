// How fast the field of a source changes at targets, as these and the source move: what conducting balls see
// (eddy/eddy.py). Takes the switch RATES from Python.
//
// A target that moves at v, r away from where a source moves at v0 and turns at w, sees its field H change at
// (u·∇)H + w × H with u = v − v0 − w × r. Moments, and with them permanent bodies, move as ``motion`` says, of which
// the first rows are velocities and angular velocities.
#pragma once
#include "applied/seen.h"
#include "applied/sources.h"

namespace warpmag {

// Of each ``step``-th coil or map of a list, at targets from column i on that are at x.
template <class All>
CUDA_CALLABLE inline Vector rate_of_coils(const All& all, const int* list, int begin, int step, int count, int i,
                                          int held, Vector x, Number label) {
    const size_t pitch = all.motion.strides[0] / sizeof(Real);
    Vector rate = nothing_seen().h;
    for (int l = 0; l < WIDTH && l < held; ++l) {
        const Real* const own = all.motion.data + i + l;
        const Point at = {lane_of(x.x, l), lane_of(x.y, l), lane_of(x.z, l)}, v = {own[0], own[pitch], own[2 * pitch]};
        Point whole = {0, 0, 0};
        for (int k = begin; k < count; k += step) {
            const int s = list[k];
            if (all.label.data[s] == lane_of(label, l)) continue;
            const FieldAt f = field_at(all, s, at);
            const Real *const frame = (const Real*)all.frame.data + 7 * (size_t)s, *const moves = all.source_motion.data
                                                                                                  + 6 * (size_t)s;
            const Point w = {moves[3], moves[4], moves[5]}, r = at - Point{frame[0], frame[1], frame[2]};
            whole += f.along(v - Point{moves[0], moves[1], moves[2]} - cross(w, r)) + cross(w, f.h);
        }
        set_lane(rate, l, whole);
    }
    return rate;
}

// Of a permanent body whose field is seen at targets from column i on that are at x.
template <class All>
CUDA_CALLABLE inline Vector rate_of_body(const All& all, const Body& body, const Seen& seen, int i, int held,
                                         Vector x) {
    const size_t pitch = all.motion.strides[0] / sizeof(Real);
    const auto three_of = [&](int row) -> Three {
        const Real* const of = all.motion.data + row * pitch + body.first;
        return {of[0], of[pitch], of[2 * pitch]};
    };
    const Real* const own = all.motion.data + i;
    const Vector v = {numbers_or(own, held, 0), numbers_or(own + pitch, held, 0), numbers_or(own + 2 * pitch, held, 0)};
    const Vector w = spread(three_of(3)), r = x - spread(center_of(all, body));
    const Vector u = v - spread(three_of(0)) - cross(w, r);
    return u.x * seen.x + u.y * seen.y + u.z * seen.z + cross(w, seen.h);
}
}
