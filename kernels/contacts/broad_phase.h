// Pairs of shapes whose boxes meet within a substep, those of Newton's broad phase; of balls, their contacts.
//
// Targets are balls, then the other shapes, numbered as in broad_phase.py. A ball finds other balls in its list of
// neighbours; the boxes of other shapes stand in rows of a table, side by side for a vector of them, those of all
// worlds first.
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

// Displacement [m] of a shape within the substep; shapes of still scenes have none.
template <class Arrays> CUDA_CALLABLE inline Real displacement(const Arrays& arrays, int shape, int c) {
    return arrays.displacement.shape[0] ? row_of(arrays.displacement, shape)[c] : Real(0);
}

// Box of all places of a shape's box within the substep.
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
// Takes a distance of contact into the largest, which was set to zero; positive numbers are in the order of their bits.
template <class Lists> __device__ inline void note_reach(const Lists& lists, double reach) {
    auto* const largest = (unsigned long long*)lists.reach.data;
    const auto bits = (unsigned long long)__double_as_longlong(reach);
    if (isfinite(reach) && bits > *largest) atomicMax(largest, bits);
}
#else
// The largest distance of contact, once all balls are placed.
template <class Lists> inline void find_reach(const Lists& lists) {
    const Balls balls = balls_of(lists);
    Real radius = 0;
    for (int i = 0; i < lists.group.shape[0]; ++i) radius = balls.radius[i] > radius ? balls.radius[i] : radius;
    lists.reach.data[0] = 2.0 * radius;
}
#endif

// Stores where a ball is in the middle of the substep, with a radius that holds all of its places, and whether the
// lists are too old for it; or the swept box of another shape. A ball that moves farther than contacts are sought ahead
// is taken where it is, with that farthest distance around it.
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
    const Real* const found_at = row_of(arrays.lists.found_at, target);
    Real d[3], way = 0, moved = 0;
    for (int c = 0; c < 3; ++c) d[c] = displacement(arrays, shape, c), way += d[c] * d[c];
    way = sqrt(way);
    const bool far = way > arrays.farthest;
    for (int c = 0; c < 3; ++c) {
        const Real sides = row_of(arrays.lower, shape)[c] + row_of(arrays.upper, shape)[c];
        const Real x = Real(0.5) * (far ? sides : sides + d[c]);
        packed[c * pitch] = x;
        moved += (x - found_at[c]) * (x - found_at[c]);
    }
    packed[3 * pitch] = arrays.radius.data[target] + (far ? arrays.farthest : Real(0.5) * way);
#if defined(__CUDA_ARCH__)
    note_reach(arrays.lists, 2.0 * packed[3 * pitch]);
#endif
    const Real found_radius = packed[4 * pitch], grown = packed[3 * pitch] - found_radius;
    if (!(sqrt(moved) + (grown > 0 ? grown : 0) <= SKIN * found_radius)) arrays.lists.moved.data[0] = 1;
}

// Whether collision groups a and b collide: a positive one with itself and negative ones, a negative one with all but
// itself, zero with none.
CUDA_CALLABLE inline bool groups_collide(int a, int b) { return a && b && (a > 0 ? a == b || b < 0 : a != b); }

// Whether a pair is listed among the excluded, which are sorted.
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

template <class Arrays> CUDA_CALLABLE inline bool is_fixed(const Arrays& arrays, int body) {
    return body < 0 || (arrays.body_flags.shape[0] && arrays.body_flags.data[body] & KINEMATIC);
}

// Whether shapes a < b may collide at all, unless they are excluded.
template <class Arrays> CUDA_CALLABLE inline bool may_collide(const Arrays& arrays, int a, int b) {
    const int body_a = arrays.body.data[a], body_b = arrays.body.data[b];
    const int world_a = arrays.world.data[a], world_b = arrays.world.data[b];
    if (body_a == body_b || (world_a >= 0 && world_b >= 0 && world_a != world_b)) return false;
    if (!arrays.fixed_pairs && is_fixed(arrays, body_a) && is_fixed(arrays, body_b)) return false;
    return groups_collide(arrays.group.data[a], arrays.group.data[b]);
}

// Whether the boxes of two shapes, which move evenly, meet at some time of the substep.
template <class Arrays> CUDA_CALLABLE inline bool boxes_meet(const Arrays& arrays, int a, int b) {
    Real enter = 0, leave = 1;
    for (int c = 0; c < 3; ++c) {
        const Real before = row_of(arrays.lower, b)[c] - row_of(arrays.upper, a)[c];
        const Real behind = row_of(arrays.upper, b)[c] - row_of(arrays.lower, a)[c];
        const Real d = displacement(arrays, a, c) - displacement(arrays, b, c);
        if (d == 0) {
            if (!(before <= 0 && behind >= 0)) return false;
        } else {
            const Real first = (d > 0 ? before : behind) / d, last = (d > 0 ? behind : before) / d;
            enter = first > enter ? first : enter;
            leave = last < leave ? last : leave;
        }
    }
    return enter <= leave;
}

// Tries the pair of a target's shape and another: calls found(a, b) if Newton is to look for contacts of a < b, or
// found(a, b, touch) if they are in contact.
template <class Arrays, class Found>
CUDA_CALLABLE inline void try_pair(const Arrays& arrays, int shape, int other, Found found) {
    const int a = shape < other ? shape : other, b = shape < other ? other : shape;
    if (!may_collide(arrays, a, b) || !boxes_meet(arrays, a, b) || is_excluded(arrays, a, b)) return;
    if (!is_touch(arrays, a, b)) {
        if (!are_boxes(arrays, a, b) || !boxes_apart(arrays, a, b)) found(a, b);
        return;
    }
    const Touch touch = touch_of(arrays, a, b);
    if (is_contact(arrays, touch)) found(a, b, touch);
}

// Calls visit(lane) for those lanes of a vector that are wanted.
template <class Visit> CUDA_CALLABLE inline void each_of(Mask wanted, Visit visit) {
#if defined(__CUDA_ARCH__)
    if (wanted) visit(0);
#else
    for (unsigned bits = bits_of(wanted); bits; bits &= bits - 1) visit(__builtin_ctz(bits));
#endif
}

// Whether the swept boxes in columns from ``first`` on meet another.
CUDA_CALLABLE inline Mask meeting(const Real* boxes, size_t pitch, int first, const Box& own) {
    Mask meet = mask_of(lanes() == lanes());
    for (int c = 0; c < 3; ++c)
        meet &= (numbers(boxes + c * pitch + first) <= own.upper[c])
                & (numbers(boxes + (c + 3) * pitch + first) >= own.lower[c]);
    return meet;
}

// Tries a target's shape with the other shapes ``begin`` to ``end`` whose swept boxes meet its own.
template <class Arrays, class Found>
CUDA_CALLABLE inline void try_boxes(const Arrays& arrays, int shape, const Box& own, int begin, int end, Found found) {
    const int* const others = arrays.shape.data + arrays.lists.group.shape[0];
#if defined(__CUDA_ARCH__)
    // what a group finds is tried by all of its threads together
    constexpr int ROOM = 64;
    __shared__ int lists[BLOCK / GROUP][ROOM];
    int* const list = lists[threadIdx.x / GROUP];
    int count = 0;
    for (int first = begin; first < end; first += GROUP) {
        const int i = first + share();
        count += append(list + count, i, i < end && meeting(arrays.boxes.data, arrays.boxes.shape[1], i, own));
        if (count <= ROOM - GROUP && first + GROUP < end) continue;
        __syncwarp(group_mask());
        for (int n = share(); n < count; n += GROUP) try_pair(arrays, shape, others[list[n]], found);
        __syncwarp(group_mask());
        count = 0;
    }
#else
    for (int block = begin / WIDTH; block * WIDTH < end; block += WIDTH) {
        each_of(meeting(arrays.bounds.data, arrays.bounds.shape[1], block, own), [&](int b) {
            const int first = (block + b) * WIDTH;
            const Mask meet = meeting(arrays.boxes.data, arrays.boxes.shape[1], first, own)
                              & mask_of((lanes() >= begin - first) & (lanes() < end - first));
            each_of(meet, [&](int l) { try_pair(arrays, shape, others[first + l], found); });
        });
    }
#endif
}

// Finds all pairs and contacts of which this target is the later one.
template <class Arrays, class Found>
CUDA_CALLABLE inline void find_pairs_of(const Arrays& arrays, int target, Found found) {
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
            const Index place = earlier ? j : Index(0);
            const Vector r = {own.x[target] - collect(own.x, place), own.y[target] - collect(own.y, place),
                              own.z[target] - collect(own.z, place)};
            const Number reach = own.radius[target] + collect(own.radius, place);
            each_of((dot(r, r) <= reach * reach) & mask_of(earlier),
                    [&](int l) { try_pair(arrays, shape, arrays.shape.data[lane_of(place, l)], found); });
        }
    } else {
        last = target - balls;
    }
    const Box own = swept_box(arrays, shape);
    const wp::vec2i range = arrays.range.data[target];
    try_boxes(arrays, shape, own, 0, arrays.shared < last ? arrays.shared : last, found);
    // in a world those that cannot move come first, and do not collide with each other
    if (target < balls || arrays.body.data[shape] >= 0)
        try_boxes(arrays, shape, own, range[0], range[1] < last ? range[1] : last, found);
}

// Remembers the radius that a ball was listed with.
template <class Arrays> CUDA_CALLABLE inline void keep_radius(const Arrays& arrays, int target) {
    const size_t pitch = arrays.lists.packed.strides[0] / sizeof(Real);
    Real* const packed = (Real*)arrays.lists.packed.data + target;
    if (target < arrays.lists.group.shape[0] && arrays.lists.searching.data[0]) packed[4 * pitch] = packed[3 * pitch];
}

#if !defined(__CUDA_ARCH__)
// Boxes around those of each vector of other shapes; none around what pads the last.
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

template <class Word, class Arrays>
CUDA_CALLABLE inline void place_targets(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    if (thread < arrays.shape.shape[0]) place_target(arrays, thread);
#else
    share_out(team, threads, arrays.shape.shape[0], TARGETS_AT_ONCE, [&](int t) { place_target(arrays, t); });
    find_reach(arrays.lists);
    bound_boxes(arrays);
#endif
}

// Writes pair n, and contact n; more may be found than there is room for.
template <class Arrays> CUDA_CALLABLE inline void put_found(const Arrays& arrays, int n, int a, int b) {
    if (n < arrays.pairs.shape[0]) arrays.pairs.data[n] = wp::vec2i(a, b);
}
template <class Arrays> CUDA_CALLABLE inline void put_found(const Arrays& arrays, int n, int, int, const Touch& touch) {
    if (n < arrays.contacts.shape0.shape[0]) put_contact(arrays, touch, n);
}

// Writes all pairs and the contacts of balls, on a CPU in the order of targets.
template <class Word, class Arrays>
CUDA_CALLABLE inline void find_pairs(int thread, int threads, Word* team, const Arrays& arrays) {
#if defined(__CUDA_ARCH__)
    const int target = thread / GROUP;
    if (share() == 0) keep_radius(arrays, target);
    if (thread == 0) arrays.lists.reach.data[0] = 0; // for the next search
    find_pairs_of(arrays, target, [&](int a, int b, auto... touch) {
        int* const count = sizeof...(touch) ? arrays.contacts.count.data : arrays.pair_count.data;
        put_found(arrays, atomicAdd(count, 1), a, b, touch...);
    });
#else
    // chunks of targets note what they find; where that is too much, it is found again
    struct Note {
        int a, b;
        Touch touch; // if the pair is one of a ball
    };
    static_assert(sizeof(Note) == NOTE * sizeof(int), "broad_phase.py gives each note its room");
    const int targets = arrays.shape.shape[0], chunks = arrays.found.shape[0];
    auto counts_of = [&](int chunk) { return arrays.found.data + (size_t)arrays.found.shape[1] * chunk; };
    auto notes_of = [&](int chunk) { return (Note*)(counts_of(chunk) + 2); };
    auto each_target = [&](int chunk, auto visit) {
        const int first = chunk * TARGETS_AT_ONCE, last = first + TARGETS_AT_ONCE;
        for (int t = first; t < (last < targets ? last : targets); ++t) visit(t);
    };
    share_out(team, threads, chunks, 1, [&](int chunk) {
        int count[2] = {}; // of pairs and contacts
        each_target(chunk, [&](int t) {
            keep_radius(arrays, t);
            find_pairs_of(arrays, t, [&](int a, int b, auto... touch) {
                const int n = count[0] + count[1];
                if (n < NOTES) notes_of(chunk)[n] = {a, b, Touch(touch)...};
                ++count[sizeof...(touch)];
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
    share_out(team, threads, chunks, 1, [&](int chunk) {
        const int *const first = counts_of(chunk), *const next = chunk + 1 < chunks ? counts_of(chunk + 1) : total;
        int at[2] = {first[0], first[1]};
        const int count = next[0] - at[0] + next[1] - at[1];
        auto put = [&](int a, int b, auto... touch) { put_found(arrays, at[sizeof...(touch)]++, a, b, touch...); };
        if (count > NOTES) return each_target(chunk, [&](int t) { find_pairs_of(arrays, t, put); });
        for (int n = 0; n < count; ++n) {
            const Note& note = notes_of(chunk)[n];
            if (is_touch(arrays, note.a, note.b)) put(note.a, note.b, note.touch);
            else put(note.a, note.b);
        }
    });
#endif
}
}
