// Rate of change of a source's field at moving targets, for eddy currents in conducting balls (eddy/eddy.py). Takes the
// switch RATES from Python.
//
// At a target with velocity v, at r from a source with velocity v0 and angular velocity w, the field H changes at
//
//     dH/dt = (u·∇)H + w × H,   u = v − v0 − w × r.
//
// The first six rows of ``motion`` are velocities and angular velocities of moments; a permanent body moves with its
// first moment.
#pragma once
#include "applied/sources.h"
#include "applied/target_field.h"

namespace warpmag {

// Rate of the field of every ``step``-th coil or map of a list, at targets x from column i on.
template <class Arrays>
CUDA_CALLABLE inline Vector rate_of_coils(const Arrays& arrays, const int* list, int begin, int step, int count, int i,
                                          int lane_count, Vector x, Number label) {
    const size_t pitch = arrays.motion.strides[0] / sizeof(Real);
    Vector rate = zero_target_field().h;
    for (int l = 0; l < WIDTH && l < lane_count; ++l) {
        const Real* const target = arrays.motion.data + i + l;
        const Point at = {lane_of(x.x, l), lane_of(x.y, l), lane_of(x.z, l)};
        const Point v = {target[0], target[pitch], target[2 * pitch]};
        Point sum = {0, 0, 0};
        for (int k = begin; k < count; k += step) {
            const int s = list[k];
            if (arrays.coils.label.data[s] == lane_of(label, l)) continue;
            const PointField f = field_at(arrays, s, at);
            const Real* const frame = (const Real*)arrays.coils.frame.data + 7 * (size_t)s;
            const Real* const motion = arrays.coils.motion.data + 6 * (size_t)s;
            const Point w = {motion[3], motion[4], motion[5]}, r = at - Point{frame[0], frame[1], frame[2]};
            sum += f.along(v - Point{motion[0], motion[1], motion[2]} - cross(w, r)) + cross(w, f.h);
        }
        set_lane(rate, l, sum);
    }
    return rate;
}

// Rate of a permanent body's field, given ``field`` at targets x from column i on.
template <class Arrays>
CUDA_CALLABLE inline Vector rate_of_body(const Arrays& arrays, const PermanentBody& body, const TargetField& field,
                                         int i, int lane_count, Vector x) {
    const size_t pitch = arrays.motion.strides[0] / sizeof(Real);
    const auto motion_vector = [&](int row) -> Real3 {
        const Real* const column = arrays.motion.data + row * pitch + body.first;
        return {column[0], column[pitch], column[2 * pitch]};
    };
    const Real* const rows = arrays.motion.data + i;
    const Vector v = {numbers_or(rows, lane_count, 0), numbers_or(rows + pitch, lane_count, 0),
                      numbers_or(rows + 2 * pitch, lane_count, 0)};
    const Vector w = broadcast(motion_vector(3)), r = x - broadcast(reference_point(arrays, body));
    const Vector u = v - broadcast(motion_vector(0)) - cross(w, r);
    return u.x * field.x + u.y * field.y + u.z * field.z + cross(w, field.h);
}
}
