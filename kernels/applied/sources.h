// The field of all sources of a world at a target: the table of kinds, frames and sums.
//
// ``Arrays`` is the struct of sources.py. On a GPU a thread has one target, on a CPU threads share them out.
#pragma once
#include "applied/field_map.h"
#include "applied/loop.h"
#include "applied/polyline.h"
#include "applied/solenoid.h"
#include "shared/team.h"

namespace warpmag {

// As in sources.SourceKind.
enum SourceKind { LOOP, SOLENOID, POLYLINE, FIELD_MAP };

CUDA_CALLABLE inline FieldAt field_of(const AppliedSource& source, Point x) {
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
CUDA_CALLABLE inline void put_point(Real* vectors, size_t i, Point v) {
    vectors[3 * i] = Real(v.x), vectors[3 * i + 1] = Real(v.y), vectors[3 * i + 2] = Real(v.z);
}
// A gradient as a matrix ∂H_i/∂x_k.
CUDA_CALLABLE inline void put_gradient(Real* matrices, size_t i, const FieldAt& f) {
    put_point(matrices, 3 * i, {f.dx.x, f.dy.x, f.dz.x});
    put_point(matrices, 3 * i + 1, {f.dx.y, f.dy.y, f.dz.y});
    put_point(matrices, 3 * i + 2, {f.dx.z, f.dy.z, f.dz.z});
}

// From a transform: a place and a quaternion (x, y, z, w), of length 1 up to the rounding of Real.
CUDA_CALLABLE inline SourceFrame frame_from(const Real* t) {
    const double x = t[3], y = t[4], z = t[5], w = t[6], n = 2 / (x * x + y * y + z * z + w * w);
    return {{t[0], t[1], t[2]},
            {1 - n * (y * y + z * z), n * (x * y + w * z), n * (x * z - w * y)},
            {n * (x * y - w * z), 1 - n * (x * x + z * z), n * (y * z + w * x)},
            {n * (x * z + w * y), n * (y * z - w * x), 1 - n * (x * x + y * y)}};
}

// Field of source s at target i, in the world.
template <class Arrays> CUDA_CALLABLE inline FieldAt field_at(const Arrays& arrays, int s, int i) {
    const SourceFrame frame = frame_from((const Real*)arrays.frame.data + 7 * (size_t)s);
    const int begin = arrays.table_begin.data[s], end = arrays.table_end.data[s];
    const AppliedSource source = {arrays.kind.data[s], point_at((const Real*)arrays.strength.data, s),
                                  arrays.parameters.data + (size_t)s * arrays.parameters.shape[1],
                                  (const Point*)arrays.table.data + begin, end - begin};
    const Point x = point_at((const Real*)arrays.position.data, i);
    return frame.to_world(field_of(source, frame.to_local(x - frame.origin)));
}

// Adds to the field at target i what the sources of its world apply, all of them to the one that magnetizes, those of
// other bodies to the one that acts; and keeps apart what comes from those that are pushed back.
template <class Arrays> CUDA_CALLABLE inline void apply_sources_at(const Arrays& arrays, int i) {
    const int world = arrays.world.data[i];
    const Point base = point_at((const Real*)arrays.base.data, i);
    FieldAt acting = {base};
    Point field = base;
    for (int k = arrays.list_begin.data[world]; k < arrays.list_begin.data[world + 1]; ++k) {
        const int s = arrays.list.data[k];
        const bool own = arrays.source_body.data[s] == arrays.target_body.data[i];
        FieldAt at = field_at(arrays, s, i);
        field += at.h;
        if (own) at = {};
        acting = acting + at;
        if (arrays.pair_begin.data[s] >= 0) {
            const size_t pair = (size_t)arrays.pair_begin.data[s] + i - arrays.first.data[world];
            put_point((Real*)arrays.pair_field.data, pair, at.h);
            put_gradient((Real*)arrays.pair_gradient.data, pair, at);
        }
    }
    put_point((Real*)arrays.field.data, i, field);
    put_point((Real*)arrays.acting.data, i, acting.h);
    put_gradient((Real*)arrays.gradient.data, i, acting);
}

template <class Word, class Arrays>
CUDA_CALLABLE inline void apply_sources(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    apply_sources_at(arrays, thread);
#else
    run_passes(team, threads, 0, 1, arrays.position.shape[0], 1, [&](int, int i) { apply_sources_at(arrays, i); });
#endif
}
}
