// Coils and field maps: their kinds, and their fields in the world. ``Arrays`` is the struct of sources.py.
#pragma once
#include "applied/field_map.h"
#include "applied/loop.h"
#include "applied/polyline.h"
#include "applied/solenoid.h"

namespace warpmag {

// Field of a source at x, in the frame of the source. Not inlined: kinds are long, and several passes call it.
__attribute__((noinline)) CUDA_CALLABLE inline PointField field_of(const AppliedSource& source, Point x) {
    switch (source.kind) {
    case LOOP: return loop_field(source, x);
    case SOLENOID: return solenoid_field(source, x);
    case POLYLINE: return polyline_field(source, x);
    case FIELD_MAP: return map_field(source, x);
    }
    return {};
}

// Origin and axes of a source in the world, in double precision (``Frame`` has them as ``Real``).
struct DoubleFrame {
    Point origin, x, y, z;

    CUDA_CALLABLE Point to_local(Point v) const { return {dot(x, v), dot(y, v), dot(z, v)}; }
    CUDA_CALLABLE Point to_world(Point v) const { return v.x * x + v.y * y + v.z * z; }
    CUDA_CALLABLE PointField to_world(const PointField& f) const {
        auto derivative = [&](Point v) { return to_world(f.along(to_local(v))); };
        return {to_world(f.h), derivative({1, 0, 0}), derivative({0, 1, 0}), derivative({0, 0, 1})};
    }
};

CUDA_CALLABLE inline Point point_at(const Real* vectors, int i) {
    return {vectors[3 * (size_t)i], vectors[3 * (size_t)i + 1], vectors[3 * (size_t)i + 2]};
}

// Frame of a transform: position and quaternion (x, y, z, w), normalized up to the rounding of Real.
CUDA_CALLABLE inline DoubleFrame double_frame_of(const Real* t) {
    const double x = t[3], y = t[4], z = t[5], w = t[6], n = 2 / (x * x + y * y + z * z + w * w);
    return {{t[0], t[1], t[2]},
            {1 - n * (y * y + z * z), n * (x * y + w * z), n * (x * z - w * y)},
            {n * (x * y - w * z), 1 - n * (x * x + z * z), n * (y * z + w * x)},
            {n * (x * z + w * y), n * (y * z - w * x), 1 - n * (x * x + y * y)}};
}

// Field of source s at x, both in the world, for a strength in place of the source's.
template <class Arrays> CUDA_CALLABLE inline PointField field_at(const Arrays& arrays, int s, Point x, Point strength) {
    const DoubleFrame frame = double_frame_of((const Real*)arrays.coils.frame.data + 7 * (size_t)s);
    const int begin = arrays.coils.table_begin.data[s], end = arrays.coils.table_end.data[s];
    const AppliedSource source = {arrays.coils.kind.data[s], strength,
                                  arrays.coils.parameters.data + (size_t)s * arrays.coils.parameters.shape[1],
                                  (const Point*)arrays.coils.table.data + begin, end - begin};
    return frame.to_world(field_of(source, frame.to_local(x - frame.origin)));
}
template <class Arrays> CUDA_CALLABLE inline PointField field_at(const Arrays& arrays, int s, Point x) {
    return field_at(arrays, s, x, point_at((const Real*)arrays.coils.strength.data, s));
}
}
