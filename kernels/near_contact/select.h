// Selects the near balls of each ball from candidates, contacts first, and computes the weight of each ball in the
// model.
//
// From Python: MARGIN, CANDIDATES and HALF_REACH of the search, CONTACT_GAP_HIGH, MOST_SHARED_LOW and MOST_SHARED_HIGH.
#pragma once
#include "near_contact/images.h"
#include "pairs/pair_law.h"

namespace warpmag {

// A smooth factor between 0 and 1, and its derivative.
struct Fade {
    Number value, slope;
};
CUDA_CALLABLE inline Fade smoothstep(Number x) {
    const Number zero = x * Real(0), t = smaller(larger(x, zero), zero + 1);
    return {t * t * (3 - 2 * t), 6 * t * (1 - t)};
}
// Window that falls from 1 to 0 between the gaps ``near`` and ``far``, and between the overlaps ``shallow`` and
// ``deep``.
CUDA_CALLABLE inline Fade window(Number gap, Real near, Real far, Real shallow, Real deep) {
    const Real width = 1 / (far - near), depth = 1 / (deep - shallow);
    const Fade outer = smoothstep((far - gap) * width), inner = smoothstep((deep + gap) * depth);
    return {outer.value * inner.value, outer.value * inner.slope * depth - outer.slope * inner.value * width};
}

// Writes positions, radii and kinds to lines, and raises a flag if a ball has moved so far that candidates are searched
// again.
CUDA_CALLABLE inline void store_position(const NearArrays& a, int i) {
    if (share() > 0) return;
    const size_t stride = a.moment_stride;
    const Real* row = a.packed + i;
    const Number size = numbers(row + 3 * stride), zero = size * Real(0);
    put_four(a.positions, 0, i, {numbers(row), numbers(row + stride), numbers(row + 2 * stride), size});
    put_four(a.positions, 1, i, {zero, number_of(indices(a.kind + i)), zero, zero});
    for (int l = 0; l < WIDTH; ++l) {
        if (a.group[i + l] < 0) continue;
        if constexpr (IMAGES > 0) find_images(a, i + l);
        const Real* found_at = a.found_at + 3 * (size_t)(i + l);
        const Real x = row[l] - found_at[0], y = row[stride + l] - found_at[1], z = row[2 * stride + l] - found_at[2];
        const Real limit = MARGIN * row[3 * stride + l];
        if (!(x * x + y * y + z * z <= limit * limit)) raise_flag(*a.moved);
    }
}

// Appends balls j, where ``chosen`` is 1, to the lists of balls i. ``filled`` counts them, also beyond ``slots``.
CUDA_CALLABLE inline void append(const NearArrays& a, int i, const int* j, Index chosen, int slots, int* filled) {
#if defined(__CUDA_ARCH__)
    const unsigned group = group_mask(), all = __ballot_sync(group, chosen) & group;
    const int s = *filled + __popc(all & ((1u << threadIdx.x % 32) - 1u));
    if (chosen && s < slots) *list_at(a.near, NEAR_SLOTS, s, i) = *j;
    *filled += __popc(all);
#else
    int count[WIDTH];
    put_indices(count, chosen);
    for (int l = 0; l < WIDTH; ++l) {
        if (filled[l] < slots) list_at(a.near, NEAR_SLOTS, filled[l], i)[l] = j[l];
        filled[l] += count[l];
    }
#endif
}

// Number of balls that may be near ball i. Images come after other balls.
CUDA_CALLABLE inline int count_candidates(const NearArrays& a, int i) {
    if (a.group[i] < 0 || a.candidate_count[i] > CANDIDATES) return 0;
    int count = a.candidate_count[i];
    for (int k = 0; k < IMAGES && a.image_face[(size_t)k * a.balls + i] >= 0; ++k) ++count;
    return count;
}
CUDA_CALLABLE inline int candidate_of(const NearArrays& a, int i, int k) {
    const int others = a.candidate_count[i];
    return k < others ? a.candidate[(size_t)i * CANDIDATES + k] : (k - others + 1) * a.balls + i;
}

// Lists the near balls of balls i and writes their counts and weights. Balls with too many near balls have none.
CUDA_CALLABLE inline void select(const NearArrays& a, int i) {
    int candidates[WIDTH], filled[WIDTH], touching[WIDTH], largest = 0;
    for (int l = 0; l < WIDTH; ++l) {
        candidates[l] = count_candidates(a, i + l);
        largest = candidates[l] > largest ? candidates[l] : largest;
        filled[l] = 0;
    }
    const Four at = own_four(a.positions, 0, i);
    const Number counts = number_of(indices(candidates)), size = at.w, zero = size * Real(0), unit = zero + 1;
    Number shared = zero;
    for (int apart = 0; apart < 2; ++apart) { // balls in contact, then other near balls
        for (int first = 0; first < largest; first += SHARES) {
            const int k = first + share();
            int j[WIDTH];
            for (int l = 0; l < WIDTH; ++l) j[l] = k < candidates[l] ? candidate_of(a, i + l, k) : i + l;
            const Four o = four_at(a.positions, 0, j);
            const Vector r = {o.x - at.x, o.y - at.y, o.z - at.z};
            const Number d2 = dot(r, r), d = root(d2), sum = size + o.w;
            const auto near = (counts > Real(k)) & (d < HALF_REACH * sum);
            const auto close = (d - sum) * sum < 2 * CONTACT_GAP_HIGH * size * o.w;
            const Number chosen = near ? (close ? unit - apart : zero + apart) : zero;
            append(a, i, j, truncated(chosen), apart ? NEAR_SLOTS : CONTACT_SLOTS, filled);
            const auto overlap = near & (d < sum);
            if (!apart && any(overlap)) shared += shared_volume(d2, size, o.w, near);
        }
        for (int l = 0; l < WIDTH && !apart; ++l) touching[l] = filled[l];
    }
    const Number excess = (group_total(shared) - MOST_SHARED_LOW) * (1 / (MOST_SHARED_HIGH - MOST_SHARED_LOW));
    const Number weight = 1 - smoothstep(excess).value;
    for (int l = 0; l < WIDTH && share() == 0; ++l) {
        const bool fits =
            candidates[l] > 0 && filled[l] <= NEAR_SLOTS && touching[l] <= CONTACT_SLOTS && lane_of(weight, l) > 0;
        a.near_count[i + l] = fits ? filled[l] : 0;
        a.contact_count[i + l] = fits ? touching[l] : 0;
        a.positions[LINE * (size_t)(i + l) + 4] = fits ? lane_of(weight, l) : 0;
        for (int k = 0; k < IMAGES; ++k) {
            const size_t image = (size_t)k * a.balls + i + l;
            if (a.image_face[image] < 0) break;
            const Real faded = a.image_view[VIEW_ROWS * image + WEIGHT];
            a.positions[LINE * (image + a.balls) + 4] = fits ? lane_of(weight, l) * faded : 0;
        }
    }
}

// Pass over all balls before candidates are searched.
struct Positions {
    const NearArrays a;
    CUDA_CALLABLE void operator()(int, int i) const { store_position(a, i); }
};
}
