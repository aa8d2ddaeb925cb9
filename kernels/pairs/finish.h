// Field (Eq. 1), and force and torque (Eqs. 4, 13 and 14), from sums over pairs of moments. The partial sums of a
// target are added up, overlapping pairs are corrected, and the results are stored.
//
// From Python: INVERSE_4PI, MU0 [T·m/A], CAPACITY and GROUP (neighbor_lists.h). ``Arrays`` is the struct of
// work_list.py. On a CPU a vector of target rows is finished at a time, on a GPU a group of threads finishes one row.
#pragma once
#include "pairs/neighbor_lists.h"
#include "pairs/pair_law.h"
#include "pairs/pair_terms.h"
#include "shared/active.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

// Target rows: row numbers, packed columns i and ranges of sources. Only the first ``lane_count`` lanes are stored.
struct TargetRows {
    int first, lane_count;
    Index row, i, begin, end;
};

// Table with a column for each moment. A scalar index is read once for all lanes.
struct Columns {
    const Real* data;
    size_t pitch;

    CUDA_CALLABLE Columns(const wp::array_t<Real>& table) : data(table.data), pitch(table.strides[0] / sizeof(Real)) {}
    template <class Indices> CUDA_CALLABLE Number number(int row, Indices i) const {
        return collect(data + row * pitch, i);
    }
    template <class Indices> CUDA_CALLABLE Vector vector(int row, Indices i) const {
        return {number(row, i), number(row + 1, i), number(row + 2, i)};
    }
};

CUDA_CALLABLE inline Vector vectors_at(const Real* vectors, Index i) {
    return {collect(vectors, 3 * i), collect(vectors + 1, 3 * i), collect(vectors + 2, 3 * i)};
}

#if defined(__CUDA_ARCH__)
template <class Arrays> CUDA_CALLABLE inline TargetRows target_rows(const Arrays& arrays, int row) {
    return {row, share() == 0, row, arrays.target.data[row], arrays.begin.data[row], arrays.end.data[row]};
}
CUDA_CALLABLE inline void put_vectors_at(Real* vectors, const TargetRows& at, Vector v) {
    if (at.lane_count > 0) put_vectors(vectors + 3 * (size_t)at.i, 1, v);
}
CUDA_CALLABLE inline Mask nonzero_at(const int* values, const TargetRows& at) { return values[at.i] != 0; }
#else
template <class Arrays> inline TargetRows target_rows(const Arrays& arrays, int first) {
    const int *target = arrays.target.data, *begin = arrays.begin.data, *end = arrays.end.data;
    const int left = arrays.target.shape[0] - first, lane_count = left < WIDTH ? left : WIDTH;
    TargetRows at = {first, lane_count, first, target[first], begin[first], begin[first]};
    for (int l = 0; l < lane_count; ++l) {
        at.row[l] = first + l;
        at.i[l] = target[first + l], at.begin[l] = begin[first + l], at.end[l] = end[first + l];
    }
    return at;
}
inline void put_vectors_at(Real* vectors, const TargetRows& at, Vector v) {
    for (int l = 0; l < at.lane_count; ++l) {
        Real* const out = vectors + 3 * (size_t)at.i[l];
        out[0] = v.x[l], out[1] = v.y[l], out[2] = v.z[l];
    }
}
inline Mask nonzero_at(const int* values, const TargetRows& at) {
    Index value = 0;
    for (int l = 0; l < at.lane_count; ++l) value[l] = values[at.i[l]];
    return mask_of(value != 0);
}
#endif

// Adds up the partial sums of target rows: of the ROW numbers of a sum, the three from ``offset`` on. The threads of a
// group share the partial sums.
template <int ROW, class Arrays>
CUDA_CALLABLE inline Vector add_parts(const Arrays& arrays, const TargetRows& at, int offset) {
    Vector total = {0, 0, 0};
#pragma unroll 4
    for (int part = share(); part < arrays.partial.shape[0]; part += SHARES) {
        const Real* const sums = arrays.partial.data + (size_t)part * arrays.partial.shape[1] * ROW + offset;
        if constexpr (ROW == 3 && WIDTH > 1) {
            total += vectors(sums + 3 * (size_t)at.first, at.lane_count);
        } else {
            const Index index = ROW * at.row;
            total += Vector{collect(sums, index), collect(sums + 1, index), collect(sums + 2, index)};
        }
    }
    return total;
}

// Adds the corrections of overlapping sources to h, 4π times the field, and to f, 4π (e·∇)H. A force leaves out sources
// of the target's body, a field leaves out the target itself.
template <Quantity Q, class Arrays>
CUDA_CALLABLE inline void add_overlaps(Vector& h, Vector& f, Vector e, const Arrays& arrays, const TargetRows& at) {
    const Columns targets(arrays.targets), sources(arrays.sources);
    const Vector x = targets.vector(0, at.i);
    const Number radius = targets.number(3, at.i), label = targets.number(7, at.i);
    auto add = [&](auto j, Mask listed) {
        const Vector r = x - sources.vector(0, j);
        const Number other_radius = sources.number(3, j), contact = radius + other_radius;
        Mask active = listed & (dot(r, r) < contact * contact);
        if (Q != Quantity::FIELD) active &= label != sources.number(7, j);
        else if (arrays.same_set) active &= mask_of(j != at.i);
        if (!any(active)) return;
        const Vector m = sources.vector(4, j);
        auto pair = [&] { return overlap_of(r, radius, other_radius, m, active); };
        if (Q != Quantity::FIELD) add_where(active, f, force_of(pair(), e));
        if (Q == Quantity::FIELD || Q == Quantity::WRENCH) add_where(active, h, field_of(pair()));
    };
    walk_lists(arrays.overlap.data, arrays.overlap_count.data, at.i, at.lane_count, at.begin, at.end, add);
}

// Stores the field H = base + h/4π [A/m], or the force μ0 f/4π [N] and torque μ0 e × H [N·m].
template <Quantity Q, class Arrays>
CUDA_CALLABLE inline void store(const Arrays& arrays, const TargetRows& at, Vector h, Vector f, Vector e, Vector base) {
    Real* const out = (Real*)arrays.out.data;
    if constexpr (Q == Quantity::FIELD) {
        put_vectors_at(out, at, base + INVERSE_4PI * h);
    } else {
        put_vectors_at(out, at, MU0 * INVERSE_4PI * f);
        Vector torque = {0, 0, 0};
        if (Q == Quantity::WRENCH) {
            const Mask active = nonzero_at(arrays.with_torque.data, at);
            add_where(active, torque, MU0 * cross(e, INVERSE_4PI * h + base));
        }
        put_vectors_at((Real*)arrays.torques.data, at, torque);
    }
}

template <Quantity Q, class Arrays> CUDA_CALLABLE inline void finish_rows(const Arrays& arrays, int first) {
    const TargetRows at = target_rows(arrays, first);
    const Vector base = vectors_at((const Real*)arrays.base.data, at.i);
    Vector h = {0, 0, 0}, f = h, e = h;
    if constexpr (Q == Quantity::FIELD) {
        h = add_parts<3>(arrays, at, 0);
    } else {
        e = Columns(arrays.effective).vector(0, at.i);
        f = add_parts<width(Q)>(arrays, at, 0);
        if (Q == Quantity::WRENCH) h = add_parts<6>(arrays, at, 3);
    }
    add_overlaps<Q>(h, f, e, arrays, at);
    store<Q>(arrays, at, group_sums(h), group_sums(f), e, base);
}

// Finishes all target rows; on a GPU a group of threads finishes one.
template <Quantity Q, class Word, class Arrays>
CUDA_CALLABLE inline void finish(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    const int row = active_item(arrays.active, thread / GROUP);
    if (row >= 0) finish_rows<Q>(arrays, row);
#else
    run_passes(team, threads, 0, 1, arrays.target.shape[0], WIDTH, [&](int, int i) { finish_rows<Q>(arrays, i); });
#endif
}
}
