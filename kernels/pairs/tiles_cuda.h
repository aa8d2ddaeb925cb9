// Common parts of all-pairs sums on a GPU: reading and staging moments, the inverse distance, the loop of a warp over
// its sources, and sums over the warps of a block.
#pragma once
#include "pairs/pair_terms.h"

namespace warpmag {

constexpr unsigned ALL_LANES = ~0u;
constexpr int FAR = 1 << 30; // beyond all columns

// 1/√c. The library's rsqrtf handles denormals, with as many instructions as the rest of the pair law.
CUDA_CALLABLE inline float inverse_root(float c) {
    float y;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(c));
    return y;
}

CUDA_CALLABLE inline double inverse_root(double c) { return rsqrt(c); }

// Inverse of a distance d that is at least the contact distance; zero for a masked pair, and for points at d = 0.
CUDA_CALLABLE inline Real masked_inverse(Real d2, Real contact, bool masked) {
    const Real c = max(d2, contact * contact);
    return c > 0 && !masked ? inverse_root(c) : Real(0);
}

// A column of a packed table of moments.
struct Moment {
    Vec3<Real> x;
    Real radius;
    Vec3<Real> m;
    Real label;
};

// Table with a column for each moment.
struct Table {
    const Real* data;
    size_t stride;

    CUDA_CALLABLE Table(const wp::array_t<Real>& rows) : data(rows.data), stride(rows.strides[0] / sizeof(Real)) {}

    CUDA_CALLABLE Real operator()(int row, int column) const { return data[row * stride + column]; }

    CUDA_CALLABLE Vec3<Real> vector(int row, int column) const {
        return {(*this)(row, column), (*this)(row + 1, column), (*this)(row + 2, column)};
    }

    // Packed moment of a column; with a zero moment if not ``loaded``.
    CUDA_CALLABLE Moment moment(int column, bool loaded = true) const {
        return {vector(0, column), (*this)(3, column), loaded ? vector(4, column) : Vec3<Real>{}, (*this)(7, column)};
    }
};

// Numbers that one instruction loads.
struct alignas(16) Quad {
    Real x, y, z, w;
};

struct alignas(2 * sizeof(Real)) Pair {
    Real x, y;
};

// Target of a lane; e is its effective moment, for a force.
struct Target {
    Vec3<Real> x;
    Real radius, label;
    Vec3<Real> e;
};

// Targets of a lane, and their sums.
template <Quantity Q, int TARGETS> struct LaneTargets {
    Target targets[TARGETS];
    Sums<Real> sums[TARGETS];
    Real clamp[TARGETS];

    // Sets the squared contact distances with sources of one radius, for add.
    CUDA_CALLABLE void clamp_for(Real radius) {
#pragma unroll
        for (int k = 0; k < TARGETS; ++k) clamp[k] = (targets[k].radius + radius) * (targets[k].radius + radius);
    }

    // Adds a source without masking.
    CUDA_CALLABLE void add(const Source<Real>& source) {
        add(source, [&](int k, Real d2) { return inverse_root(max(d2, clamp[k])); });
    }

    // Adds a source of any radius; masked(k) leaves out the k-th target.
    template <class Masked> CUDA_CALLABLE void add_masked(const Source<Real>& source, Real radius, Masked masked) {
        add(source, [&](int k, Real d2) { return masked_inverse(d2, targets[k].radius + radius, masked(k)); });
    }

    template <class Inverse> CUDA_CALLABLE void add(const Source<Real>& source, Inverse inverse) {
#pragma unroll
        for (int k = 0; k < TARGETS; ++k) {
            const Vec3<Real> r = targets[k].x - source.x;
            add_pair<Q>(sums[k], r, inverse(k, dot(r, r)), source, targets[k].e);
        }
    }
};

// Lowest and highest label of the targets of several lanes. A source whose label is outside belongs to no target's
// body.
struct LabelRange {
    Real lowest, highest;

    template <int LANES, int TARGETS, class T> static CUDA_CALLABLE LabelRange of(const T (&targets)[TARGETS]) {
        LabelRange range{targets[0].label, targets[0].label};
#pragma unroll
        for (int k = 1; k < TARGETS; ++k) {
            range.lowest = min(range.lowest, targets[k].label);
            range.highest = max(range.highest, targets[k].label);
        }
#pragma unroll
        for (int step = LANES / 2; step > 0; step /= 2) {
            range.lowest = min(range.lowest, __shfl_xor_sync(ALL_LANES, range.lowest, step));
            range.highest = max(range.highest, __shfl_xor_sync(ALL_LANES, range.highest, step));
        }
        return range;
    }

    CUDA_CALLABLE bool excludes(Real label) const { return label < lowest || label > highest; }
};

// Adds the sources `begin` to `end` to the sums of a warp's targets. Lanes that are a multiple of LANES apart hold the
// same targets. Sources are staged in shared memory, 32 at a time. 32 / LANES groups of lanes share a stage, and a lane
// takes UNROLLED sources in a step.
//
// A force masks sources of the target's label, a field masks the target itself: own_count targets are sources, from
// column own_begin on. A step is plain if its sources all have the given radius and none is masked. Then the clamp is a
// constant of the target, and a pair takes 20 instructions for the field and 31 for the force. In addition a source
// takes about four for all targets of a lane, and the staging of 32 sources about sixty. A LONG sum takes the radius
// from each stage, and a whole stage is plain or not. It adds up partial sums, which keeps it accurate.
template <int LANES, int UNROLLED, bool LONG, Quantity Q, int TARGETS, class TargetAt, class Sources>
CUDA_CALLABLE inline void add_sources(LaneTargets<Q, TARGETS>& lane_targets, TargetAt target_at, const Sources& sources,
                                      int begin, int end, Real radius, int own_begin, unsigned own_count, int lane,
                                      Quad* staged) {
    constexpr bool FIELD = Q == Quantity::FIELD;
    constexpr Real SCALE = scaled_moment(Q);
    constexpr int GROUPS = 32 / LANES, STRIDE = GROUPS * UNROLLED, STAGES_PER_PART = 16;
    constexpr int RUN = LONG ? 32 : STRIDE;
    constexpr unsigned RUN_MASK = RUN < 32 ? (1u << RUN) - 1 : ~0u;
    // rows may be read beyond the last moment; a LONG sum repeats the last one so that the radius stays the same
    const auto load = [&](int j) { return sources.moment(LONG ? min(j, end - 1) : j, j < end); };
    const auto source_at = [&](int i) -> Source<Real> {
        const Quad a = staged[i], b = staged[i + 32];
        return {{a.x, a.y, a.z}, {a.w, b.x, b.y}, {b.z, b.w, SCALE * b.y}};
    };
    Moment s;
    if (begin < end) s = load(begin + lane);
#pragma unroll
    for (int k = 0; k < TARGETS; ++k) lane_targets.targets[k] = target_at(k);
    LabelRange labels;
    if constexpr (!FIELD) labels = LabelRange::of<LANES>(lane_targets.targets);
    if constexpr (!LONG) lane_targets.clamp_for(radius);
    Sums<Real> long_sums[TARGETS];
#pragma unroll 1
    for (int base = begin; base < end; base += 32) {
        const int j = base + lane, count = min(32, end - base);
        if constexpr (LONG) radius = __shfl_sync(ALL_LANES, s.radius, 0);
        const bool plain = s.radius == radius && s.radius > 0
                           && (FIELD ? unsigned(j - own_begin) >= own_count : labels.excludes(s.label));
        const unsigned not_plain = ~__ballot_sync(ALL_LANES, plain);
        staged[lane] = {s.x.x, s.x.y, s.x.z, s.m.x};
        staged[lane + 32] = {s.m.y, s.m.z, SCALE * s.m.x, SCALE * s.m.y};
        ((Pair*)(staged + 64))[lane] = {s.radius, FIELD ? 0 : s.label};
        __syncwarp();
        if (base + 32 < end) s = load(j + 32);
        if constexpr (LONG) lane_targets.clamp_for(radius);
#pragma unroll 1
        for (int first = 0; first < count; first += RUN) {
            const int last = LONG ? count : first + RUN;
            if ((not_plain >> first & RUN_MASK) == 0) {
#pragma unroll 1
                for (int step = first; step < last; step += STRIDE)
#pragma unroll
                    for (int i = 0; i < UNROLLED; ++i) lane_targets.add(source_at(step + GROUPS * i + lane / LANES));
            } else {
#pragma unroll 1
                for (int i = first + lane / LANES; i < last; i += GROUPS) {
                    const Pair c = ((const Pair*)(staged + 64))[i];
                    const int offset = base + i - own_begin - lane % LANES;
                    lane_targets.add_masked(source_at(i), c.x, [&](int k) {
                        return FIELD ? offset == LANES * k : c.y == lane_targets.targets[k].label;
                    });
                }
            }
        }
        __syncwarp();
        if (LONG && (base - begin) % (32 * STAGES_PER_PART) == 32 * (STAGES_PER_PART - 1)) {
#pragma unroll
            for (int k = 0; k < TARGETS; ++k) {
                long_sums[k] += lane_targets.sums[k];
                lane_targets.sums[k] = {};
            }
        }
    }
#pragma unroll
    for (int k = 0; k < TARGETS && LONG; ++k) lane_targets.sums[k] += long_sums[k];
}

// Adds up the sums of a block's warps in shared memory, in order, and calls store(item, total) for each item.
template <int WARPS, int QUADS, class Store>
CUDA_CALLABLE inline void sum_warps(const Quad (&staging)[WARPS][QUADS], int thread, int items, Store store) {
    for (int item = thread; item < items; item += 32 * WARPS) {
        Real total = 0;
#pragma unroll
        for (int w = 0; w < WARPS; ++w) total += ((const Real*)staging[w])[item];
        store(item, total);
    }
}

}
