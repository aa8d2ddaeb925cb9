// Sources that are a field everywhere: the table of kinds, and where they are. ``All`` is the struct of sources.py.
#pragma once
#include "applied/field_map.h"
#include "applied/loop.h"
#include "applied/polyline.h"
#include "applied/solenoid.h"

namespace warpmag {

// As in sources.SourceKind.
enum SourceKind { LOOP, SOLENOID, POLYLINE, FIELD_MAP };

// Not inlined: its kinds are long, and several passes call it.
__attribute__((noinline)) CUDA_CALLABLE inline FieldAt field_of(const AppliedSource& source, Point x) {
    switch (source.kind) {
    case LOOP:
        return loop_field(source, x);
    case SOLENOID:
        return solenoid_field(source, x);
    case POLYLINE:
        return polyline_field(source, x);
    case FIELD_MAP:
        return map_field(source, x);
    }
    return {};
}

// Where a source is, with its axes in the world.
struct SourceFrame {
    Point origin, x, y, z;

    CUDA_CALLABLE Point to_local(Point v) const { return {dot(x, v), dot(y, v), dot(z, v)}; }
    CUDA_CALLABLE Point to_world(Point v) const { return v.x * x + v.y * y + v.z * z; }
    CUDA_CALLABLE FieldAt to_world(const FieldAt& f) const {
        auto derivative = [&](Point v) { return to_world(f.along(to_local(v))); };
        return {to_world(f.h), derivative({1, 0, 0}), derivative({0, 1, 0}), derivative({0, 0, 1})};
    }
};

CUDA_CALLABLE inline Point point_at(const Real* vectors, int i) {
    return {vectors[3 * (size_t)i], vectors[3 * (size_t)i + 1], vectors[3 * (size_t)i + 2]};
}

// From a transform: a place and a quaternion (x, y, z, w), of length 1 up to the rounding of Real.
CUDA_CALLABLE inline SourceFrame frame_from(const Real* t) {
    const double x = t[3], y = t[4], z = t[5], w = t[6], n = 2 / (x * x + y * y + z * z + w * w);
    return {{t[0], t[1], t[2]},
            {1 - n * (y * y + z * z), n * (x * y + w * z), n * (x * z - w * y)},
            {n * (x * y - w * z), 1 - n * (x * x + z * z), n * (y * z + w * x)},
            {n * (x * z + w * y), n * (y * z - w * x), 1 - n * (x * x + y * y)}};
}

// Field of source s at x, in the world.
template <class All> CUDA_CALLABLE inline FieldAt field_at(const All& all, int s, Point x) {
    const SourceFrame frame = frame_from((const Real*)all.frame.data + 7 * (size_t)s);
    const int begin = all.table_begin.data[s], end = all.table_end.data[s];
    const AppliedSource source = {all.kind.data[s], point_at((const Real*)all.strength.data, s),
                                  all.parameters.data + (size_t)s * all.parameters.shape[1],
                                  (const Point*)all.table.data + begin, end - begin};
    return frame.to_world(field_of(source, frame.to_local(x - frame.origin)));
}
}
