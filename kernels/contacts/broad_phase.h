// Broad phase: pairs of shapes whose bounding boxes overlap in a substep, as in Newton's broad phase; and the contacts
// of balls.
//
// Targets are the balls, then the other shapes, numbered as in broad_phase.py. A ball finds other balls in its neighbor
// list. The boxes of other shapes are columns of a table, so that a vector of them is read at once. Shapes that belong
// to all worlds come first.
#pragma once
#include "contacts/ball_contacts.h"
#include "contacts/box_gap.h"
#include "pairs/overlaps.h"
#include "shared/team.h"

namespace warpmag {

struct Box {
    Real lower[3], upper[3];
};

CUDA_CALLABLE inline const Real* row_of(const wp::array_t<wp::vec3>& vectors, int i) {
    return (const Real*)vectors.data + 3 * (size_t)i;
}

// Component of a shape's displacement in the substep [m]; 0 if the array is empty.
template <class Arrays> CUDA_CALLABLE inline Real displacement(const Arrays& arrays, int shape, int c) {
    return arrays.displacement.shape[0] ? row_of(arrays.displacement, shape)[c] : Real(0);
}

// Box that encloses a shape's box throughout the substep.
template <class Arrays> CUDA_CALLABLE inline Box swept_box(const Arrays& arrays, int shape) {
    Box box;
    for (int c = 0; c < 3; ++c) {
        const Real d = displacement(arrays, shape, c);
        box.lower[c] = row_of(arrays.lower, shape)[c] + (d < 0 ? d : 0);
        box.upper[c] = row_of(arrays.upper, shape)[c] + (d > 0 ? d : 0);
    }
    return box;
}

#if defined(__CUDA_ARCH__)
// Raises the search distance, which starts at zero. Positive floating-point numbers compare like their bits.
template <class Lists> __device__ inline void raise_search_distance(const Lists& lists, double reach) {
    auto* const largest = (unsigned long long*)lists.reach.data;
    const auto bits = (unsigned long long)__double_as_longlong(reach);
    if (isfinite(reach) && bits > *largest) atomicMax(largest, bits);
}
#else
// Finds the search distance of neighbors, twice the largest radius, once all balls are placed.
template <class Lists> inline void find_search_distance(const Lists& lists) {
    const Balls balls = balls_of(lists);
    Real radius = 0;
    for (int i = 0; i < lists.group.shape[0]; ++i) radius = balls.radius[i] > radius ? balls.radius[i] : radius;
    lists.reach.data[0] = 2.0 * radius;
}
#endif

// Stores the swept box of a shape. For a ball, stores the center and radius of a ball that encloses it throughout the
// substep. Sets a flag if the neighbor lists are out of date. If a ball moves farther than ``farthest``, the enclosing
// ball is at its present position, and ``farthest`` is added to its radius.
template <class Arrays> CUDA_CALLABLE inline void place_target(const Arrays& arrays, int target) {
    const int balls = arrays.lists.group.shape[0], shape = arrays.shape.data[target];
    if (target >= balls) {
        const Box box = swept_box(arrays, shape);
        for (int c = 0; c < 3; ++c) {
            Real* const column = (Real*)arrays.boxes.data + target - balls;
            column[c * arrays.boxes.shape[1]] = box.lower[c];
            column[(c + 3) * arrays.boxes.shape[1]] = box.upper[c];
        }
        return;
    }
    const size_t pitch = arrays.lists.packed.strides[0] / sizeof(Real);
    Real* const packed = (Real*)arrays.lists.packed.data + target;
    const Real* const list_position = row_of(arrays.lists.found_at, target);
    Real d[3], motion = 0, moved = 0;
    for (int c = 0; c < 3; ++c) d[c] = displacement(arrays, shape, c), motion += d[c] * d[c];
    motion = sqrt(motion);
    const bool far = motion > arrays.farthest;
    for (int c = 0; c < 3; ++c) {
        const Real corners = row_of(arrays.lower, shape)[c] + row_of(arrays.upper, shape)[c];
        const Real x = Real(0.5) * (far ? corners : corners + d[c]);
        packed[c * pitch] = x;
        moved += (x - list_position[c]) * (x - list_position[c]);
    }
    packed[3 * pitch] = arrays.radius.data[target] + (far ? arrays.farthest : Real(0.5) * motion);
#if defined(__CUDA_ARCH__)
    raise_search_distance(arrays.lists, 2.0 * packed[3 * pitch]);
#endif
    const Real list_radius = packed[4 * pitch], grown = packed[3 * pitch] - list_radius;
    if (!(sqrt(moved) + (grown > 0 ? grown : 0) <= SKIN * list_radius)) arrays.lists.moved.data[0] = 1;
}

// True if collision groups a and b collide. A positive group collides with itself and with negative ones, a negative
// group with all but itself, group 0 with none.
CUDA_CALLABLE inline bool groups_collide(int a, int b) { return a && b && (a > 0 ? a == b || b < 0 : a != b); }

// True if a pair is in the sorted list of excluded pairs.
template <class Arrays> CUDA_CALLABLE inline bool is_excluded(const Arrays& arrays, int a, int b) {
    int low = 0, high = arrays.excluded_count;
    while (low < high) {
        const int middle = (low + high) / 2;
        const wp::vec2i listed = arrays.excluded.data[middle];
        if (listed[0] < a || (listed[0] == a && listed[1] < b)) low = middle + 1;
        else high = middle;
    }
    return low < arrays.excluded_count && arrays.excluded.data[low][0] == a && arrays.excluded.data[low][1] == b;
}

// True for the world and for kinematic bodies.
template <class Arrays> CUDA_CALLABLE inline bool is_fixed(const Arrays& arrays, int body) {
    return body < 0 || (arrays.body_flags.shape[0] && arrays.body_flags.data[body] & KINEMATIC);
}

// True if the bodies, worlds and collision groups of shapes a < b allow a collision.
template <class Arrays> CUDA_CALLABLE inline bool may_collide(const Arrays& arrays, int a, int b) {
    const int body_a = arrays.body.data[a], body_b = arrays.body.data[b];
    const int world_a = arrays.world.data[a], world_b = arrays.world.data[b];
    if (body_a == body_b || (world_a >= 0 && world_b >= 0 && world_a != world_b)) return false;
    if (!arrays.fixed_pairs && is_fixed(arrays, body_a) && is_fixed(arrays, body_b)) return false;
    return groups_collide(arrays.group.data[a], arrays.group.data[b]);
}

// True if the boxes of two shapes, moving at constant velocity, overlap at some time of the substep.
template <class Arrays> CUDA_CALLABLE inline bool boxes_overlap(const Arrays& arrays, int a, int b) {
    Real start = 0, end = 1; // fractions of the substep
    for (int c = 0; c < 3; ++c) {
        const Real before = row_of(arrays.lower, b)[c] - row_of(arrays.upper, a)[c];
        const Real behind = row_of(arrays.upper, b)[c] - row_of(arrays.lower, a)[c];
        const Real d = displacement(arrays, a, c) - displacement(arrays, b, c);
        if (d == 0) {
            if (!(before <= 0 && behind >= 0)) return false;
        } else {
            const Real first = (d > 0 ? before : behind) / d, last = (d > 0 ? behind : before) / d;
            start = first > start ? first : start;
            end = last < end ? last : end;
        }
    }
    return start <= end;
}

// Tests a pair of shapes. Calls report(a, b), a < b, for a pair that is left to Newton's narrow phase, and report(a, b,
// contact) for a contact of a ball.
template <class Arrays, class Report>
CUDA_CALLABLE inline void test_pair(const Arrays& arrays, int shape, int other, Report report) {
    const int a = shape < other ? shape : other, b = shape < other ? other : shape;
    if (!may_collide(arrays, a, b) || !boxes_overlap(arrays, a, b) || is_excluded(arrays, a, b)) return;
    if (!involves_ball(arrays, a, b)) {
        if (!are_boxes(arrays, a, b) || !boxes_separated(arrays, a, b)) report(a, b);
        return;
    }
    const BallContact contact = detect_ball_contact(arrays, a, b);
    if (is_contact(arrays, contact)) report(a, b, contact);
}

// Calls visit(lane) for the set lanes of a mask.
template <class Visit> CUDA_CALLABLE inline void for_each_lane(Mask mask, Visit visit) {
#if defined(__CUDA_ARCH__)
    if (mask) visit(0);
#else
    for (unsigned bits = bits_of(mask); bits; bits &= bits - 1) visit(__builtin_ctz(bits));
#endif
}

// Lanes of the vector of swept boxes from column ``first`` on that overlap another box.
CUDA_CALLABLE inline Mask overlapping(const Real* boxes, size_t pitch, int first, const Box& own) {
    Mask overlap = mask_of(lanes() == lanes());
    for (int c = 0; c < 3; ++c)
        overlap &= (numbers(boxes + c * pitch + first) <= own.upper[c])
                   & (numbers(boxes + (c + 3) * pitch + first) >= own.lower[c]);
    return overlap;
}

// Tests a target's shape against other shapes ``begin`` to ``end`` whose swept boxes overlap its own.
template <class Arrays, class Report>
CUDA_CALLABLE inline void test_boxes(const Arrays& arrays, int shape, const Box& own, int begin, int end,
                                     Report report) {
    const int* const others = arrays.shape.data + arrays.lists.group.shape[0];
#if defined(__CUDA_ARCH__)
    // the threads of a group first list the overlapping boxes, then share the tests
    constexpr int LIST_CAPACITY = 64;
    __shared__ int lists[BLOCK / GROUP][LIST_CAPACITY];
    int* const list = lists[threadIdx.x / GROUP];
    int count = 0;
    for (int first = begin; first < end; first += GROUP) {
        const int i = first + share();
        count += append(list + count, i, i < end && overlapping(arrays.boxes.data, arrays.boxes.shape[1], i, own));
        if (count <= LIST_CAPACITY - GROUP && first + GROUP < end) continue;
        __syncwarp(group_mask());
        for (int n = share(); n < count; n += GROUP) test_pair(arrays, shape, others[list[n]], report);
        __syncwarp(group_mask());
        count = 0;
    }
#else
    for (int block = begin / WIDTH; block * WIDTH < end; block += WIDTH) {
        for_each_lane(overlapping(arrays.bounds.data, arrays.bounds.shape[1], block, own), [&](int b) {
            const int first = (block + b) * WIDTH;
            const Mask overlap = overlapping(arrays.boxes.data, arrays.boxes.shape[1], first, own)
                                 & mask_of((lanes() >= begin - first) & (lanes() < end - first));
            for_each_lane(overlap, [&](int l) { test_pair(arrays, shape, others[first + l], report); });
        });
    }
#endif
}

// Finds all pairs and contacts of a target with targets of smaller index.
template <class Arrays, class Report>
CUDA_CALLABLE inline void find_pairs_of(const Arrays& arrays, int target, Report report) {
    const int balls = arrays.lists.group.shape[0], shape = arrays.shape.data[target];
    int last = arrays.boxes.shape[1];
    if (target < balls) {
        const Balls own = balls_of(arrays.lists);
        const int count = arrays.lists.count.data[target];
        const bool listed = count <= CAPACITY;
        const int* const list = arrays.lists.neighbor.data + (size_t)CAPACITY * target;
        for (int n = share() * WIDTH; n < (listed ? count : target); n += SHARES * WIDTH) {
            const Index j = listed ? indices(list + n) : n + lanes();
            const auto earlier = (j < target) & (lanes() < (listed ? count : target) - n);
            const Index index = earlier ? j : Index(0);
            const Vector r = {own.x[target] - collect(own.x, index), own.y[target] - collect(own.y, index),
                              own.z[target] - collect(own.z, index)};
            const Number reach = own.radius[target] + collect(own.radius, index);
            for_each_lane((dot(r, r) <= reach * reach) & mask_of(earlier),
                          [&](int l) { test_pair(arrays, shape, arrays.shape.data[lane_of(index, l)], report); });
        }
    } else {
        last = target - balls;
    }
    const Box own = swept_box(arrays, shape);
    const wp::vec2i range = arrays.range.data[target];
    test_boxes(arrays, shape, own, 0, arrays.shared < last ? arrays.shared : last, report);
    // immovable shapes of a world do not collide with each other
    if (target < balls || arrays.body.data[shape] >= 0)
        test_boxes(arrays, shape, own, range[0], range[1] < last ? range[1] : last, report);
}

// Stores the radius that a ball's neighbor list was made with.
template <class Arrays> CUDA_CALLABLE inline void store_list_radius(const Arrays& arrays, int target) {
    const size_t pitch = arrays.lists.packed.strides[0] / sizeof(Real);
    Real* const packed = (Real*)arrays.lists.packed.data + target;
    if (target < arrays.lists.group.shape[0] && arrays.lists.searching.data[0]) packed[4 * pitch] = packed[3 * pitch];
}

#if !defined(__CUDA_ARCH__)
// Finds the bounding box of each vector of swept boxes. Padding contains empty boxes.
template <class Arrays> inline void bound_boxes(const Arrays& arrays) {
    const size_t pitch = arrays.boxes.shape[1], blocks = arrays.bounds.shape[1];
    for (size_t first = 0; first + WIDTH <= pitch; first += WIDTH)
        for (int c = 0; c < 3; ++c) {
            const Real* const lower = arrays.boxes.data + c * pitch + first;
            arrays.bounds.data[c * blocks + first / WIDTH] = __builtin_reduce_min(numbers(lower));
            arrays.bounds.data[(c + 3) * blocks + first / WIDTH] = __builtin_reduce_max(numbers(lower + 3 * pitch));
        }
}
#endif

// Stores the enclosing balls and swept boxes of all targets.
template <class Word, class Arrays>
CUDA_CALLABLE inline void place_targets(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    if (thread < arrays.shape.shape[0]) place_target(arrays, thread);
#else
    share_items(team, threads, arrays.shape.shape[0], TARGETS_AT_ONCE, [&](int t) { place_target(arrays, t); });
    find_search_distance(arrays.lists);
    bound_boxes(arrays);
#endif
}

// Writes pair n, or contact n; results beyond the capacity are only counted.
template <class Arrays> CUDA_CALLABLE inline void write_result(const Arrays& arrays, int n, int a, int b) {
    if (n < arrays.pairs.shape[0]) arrays.pairs.data[n] = wp::vec2i(a, b);
}
template <class Arrays>
CUDA_CALLABLE inline void write_result(const Arrays& arrays, int n, int, int, const BallContact& contact) {
    if (n < arrays.contacts.shape0.shape[0]) write_contact(arrays, contact, n);
}

// Writes all pairs and the contacts of balls; on a CPU in the order of targets.
template <class Word, class Arrays>
CUDA_CALLABLE inline void find_pairs(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    const int target = thread / GROUP;
    if (share() == 0) store_list_radius(arrays, target);
    if (thread == 0) arrays.lists.reach.data[0] = 0; // for the next search
    find_pairs_of(arrays, target, [&](int a, int b, auto... contact) {
        int* const count = sizeof...(contact) ? arrays.contacts.count.data : arrays.pair_count.data;
        write_result(arrays, atomicAdd(count, 1), a, b, contact...);
    });
#else
    // a chunk of targets buffers its results; if the buffer is too small, the search is repeated
    struct Result {
        int a, b;
        BallContact contact; // of a pair with a ball
    };
    static_assert(sizeof(Result) == RESULT_SIZE * sizeof(int), "broad_phase.py has the size of a result");
    const int targets = arrays.shape.shape[0], chunks = arrays.results.shape[0];
    auto counts_of = [&](int chunk) { return arrays.results.data + (size_t)arrays.results.shape[1] * chunk; };
    auto results_of = [&](int chunk) { return (Result*)(counts_of(chunk) + 2); };
    auto each_target = [&](int chunk, auto visit) {
        const int first = chunk * TARGETS_AT_ONCE, last = first + TARGETS_AT_ONCE;
        for (int t = first; t < (last < targets ? last : targets); ++t) visit(t);
    };
    share_items(team, threads, chunks, 1, [&](int chunk) {
        int count[2] = {}; // of pairs and contacts
        each_target(chunk, [&](int t) {
            store_list_radius(arrays, t);
            find_pairs_of(arrays, t, [&](int a, int b, auto... contact) {
                const int n = count[0] + count[1];
                if (n < RESULTS) results_of(chunk)[n] = {a, b, BallContact(contact)...};
                ++count[sizeof...(contact)];
            });
        });
        counts_of(chunk)[0] = count[0], counts_of(chunk)[1] = count[1];
    });
    int total[2] = {};
    for (int chunk = 0; chunk < chunks; ++chunk)
        for (int k = 0; k < 2; ++k) {
            const int count = counts_of(chunk)[k];
            counts_of(chunk)[k] = total[k];
            total[k] += count;
        }
    arrays.pair_count.data[0] = total[0];
    if (total[1]) arrays.contacts.count.data[0] = total[1];
    share_items(team, threads, chunks, 1, [&](int chunk) {
        const int *const first = counts_of(chunk), *const next = chunk + 1 < chunks ? counts_of(chunk + 1) : total;
        int at[2] = {first[0], first[1]};
        const int count = next[0] - at[0] + next[1] - at[1];
        auto put = [&](int a, int b, auto... contact) {
            write_result(arrays, at[sizeof...(contact)]++, a, b, contact...);
        };
        if (count > RESULTS) return each_target(chunk, [&](int t) { find_pairs_of(arrays, t, put); });
        for (int n = 0; n < count; ++n) {
            const Result& result = results_of(chunk)[n];
            if (involves_ball(arrays, result.a, result.b)) put(result.a, result.b, result.contact);
            else put(result.a, result.b);
        }
    });
#endif
}
}
