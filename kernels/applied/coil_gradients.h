// Gradients of functions of the fields, forces and torques of coils and field maps; coil_gradients.py has the
// equations.
//
// From Python: MU0, and PASS, the pass of a GPU; on a CPU it is −1. ``Arrays`` is the struct of coil_gradients.py.
#pragma once
#include "applied/sources.h"
#include "shared/team.h"

namespace warpmag {

enum GradientPass { BY_MOMENTS, OF_ROWS, BY_SOURCES }; // as in coil_gradients.py
constexpr int ROW_SUMS = 10;                           // by strength, origin, rotation and center of the source
constexpr double STEP = 1e-4;                          // of differences, in radii of the moment

// Gradients of a pair of a source and a moment.
struct CoilGradient {
    Point by_position, by_moment, by_origin, by_rotation, by_center;
    double by_strength;
};

// ∇(m·H)
CUDA_CALLABLE inline Point gradient_dot(const PointField& f, Point m) {
    return {dot(f.dx, m), dot(f.dy, m), dot(f.dz, m)};
}

template <class Arrays> CUDA_CALLABLE inline CoilGradient gradient_of(const Arrays& arrays, int s, int i) {
    const size_t pitch = arrays.packed.strides[0] / sizeof(Real);
    const auto number = [&](int row) { return (double)arrays.packed.data[row * pitch + i]; };
    const auto at = [](const auto& vectors, int k) { return point_at((const Real*)vectors.data, k); };
    const Point x = {number(0), number(1), number(2)}, m = {number(4), number(5), number(6)};
    const Point eta = arrays.by_field.data ? at(arrays.by_field, i) : Point{0, 0, 0};
    const double strength = point_at((const Real*)arrays.coils.strength.data, s).x;
    const auto field = [&](Point p) { return field_at(arrays, s, p, {1, 0, 0}); }; // linear in the strength
    const PointField unit = field(x);
    Point a = {0, 0, 0}, b = a, about = a;
    if (arrays.force_cotangents.data && arrays.coils.label.data[s] != (Real)number(7)) {
        about = at(arrays.source_torque_cotangents, s);
        a = at(arrays.force_cotangents, i) - at(arrays.source_force_cotangents, s)
            - cross(about, x - at(arrays.centers, s));
        b = at(arrays.torque_cotangents, i) - about;
    }
    const Point force = MU0 * gradient_dot(unit, m), torque = (double)MU0 * cross(m, unit.h), v = cross(b, m);
    CoilGradient g;
    g.by_strength = dot(a, force) + dot(b, torque) + dot(eta, unit.h);
    g.by_moment = (strength * MU0) * (unit.along(a) + cross(unit.h, b));
    Point by_position = gradient_dot(unit, (double)MU0 * v + eta);
    const double size = norm(a), step = STEP * number(3);
    if (size > 0 && step > 0) {
        const Point along = (step / size) * a;
        const Point change = gradient_dot(field(x + along), m) - gradient_dot(field(x - along), m);
        by_position += (MU0 * size / (2 * step)) * change;
    }
    by_position = strength * by_position;
    g.by_center = cross(strength * force, about); // of the lever arm in the reaction's torque
    g.by_position = by_position - g.by_center;
    g.by_origin = -by_position;
    // nothing changes if the moment, the source and all cotangents turn about the source's origin together
    const Point origin = point_at((const Real*)arrays.coils.frame.data + 7 * (size_t)s, 0);
    g.by_rotation = -(cross(x - origin, by_position) + cross(m, g.by_moment)
                      + strength * (cross(a, force) + cross(b, torque) + cross(eta, unit.h)));
    return g;
}

CUDA_CALLABLE inline void add(Real* to, Point v) { to[0] += (Real)v.x, to[1] += (Real)v.y, to[2] += (Real)v.z; }

// Writes the gradients by moment i and its position.
template <class Arrays> CUDA_CALLABLE inline void sum_sources(const Arrays& arrays, int i) {
    Point by_position = {0, 0, 0}, by_moment = by_position;
    const auto& range = arrays.lists.data[i];
    for (int k = range[0]; k < range[1]; ++k) {
        const CoilGradient g = gradient_of(arrays, arrays.coils.list.data[k], i);
        by_position += g.by_position, by_moment += g.by_moment;
    }
    add((Real*)arrays.by_positions.data + 3 * (size_t)i, by_position);
    add((Real*)arrays.by_moments.data + 3 * (size_t)i, by_moment);
}

// Writes the sums of a row of moments over a source's gradients.
template <class Arrays> CUDA_CALLABLE inline void sum_row(const Arrays& arrays, int row) {
    const auto& range = arrays.row.data[row]; // source, range of moments
    double* const sums = arrays.partial.data + ROW_SUMS * (size_t)row;
    for (int k = 0; k < ROW_SUMS; ++k) sums[k] = 0;
    for (int i = range[1]; i < range[2]; ++i) {
        const CoilGradient g = gradient_of(arrays, range[0], i);
        const double terms[ROW_SUMS] = {g.by_strength,   g.by_origin.x,   g.by_origin.y, g.by_origin.z, g.by_rotation.x,
                                        g.by_rotation.y, g.by_rotation.z, g.by_center.x, g.by_center.y, g.by_center.z};
        for (int k = 0; k < ROW_SUMS; ++k) sums[k] += terms[k];
    }
}

// Adds the rows of source s to its gradients.
template <class Arrays> CUDA_CALLABLE inline void add_rows(const Arrays& arrays, int s) {
    double total[ROW_SUMS] = {};
    for (int row = arrays.row_begin.data[s]; row < arrays.row_begin.data[s + 1]; ++row)
        for (int k = 0; k < ROW_SUMS; ++k) total[k] += arrays.partial.data[ROW_SUMS * (size_t)row + k];
    for (int k = 0; k < ROW_SUMS; ++k) arrays.by_sources.data[ROW_SUMS * (size_t)s + k] += (Real)total[k];
}

template <class Word, class Arrays>
CUDA_CALLABLE inline void differentiate_coils(int thread, int first, int last, int threads, Word* team,
                                              const Arrays& arrays) {
    const auto run_item = [&](int pass, int i) {
        if constexpr (PASS < 0 || PASS == BY_MOMENTS)
            if (pass == BY_MOMENTS) sum_sources(arrays, i);
        if constexpr (PASS < 0 || PASS == OF_ROWS)
            if (pass == OF_ROWS) sum_row(arrays, i);
        if constexpr (PASS < 0 || PASS == BY_SOURCES)
            if (pass == BY_SOURCES) add_rows(arrays, i);
    };
#if defined(__CUDA_ARCH__)
    run_item(PASS, thread);
#else
    const int counts[] = {arrays.lists.shape[0], arrays.row.shape[0], arrays.by_sources.shape[0]};
    run_passes(team, threads, first, last, [=](int pass) { return counts[pass]; }, 1, run_item);
#endif
}
}
