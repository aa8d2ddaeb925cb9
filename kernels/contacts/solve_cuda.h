// The contact solver on a GPU. A group of threads shares a body and loops over its contacts. Each iteration is a
// launch.
//
// Both bodies of a contact compute its impulse from the velocities after the last iteration. So no atomics are needed,
// and no block waits for another. The positions of bodies and of their lists depend on the order of threads. Results do
// not depend on it: the contacts of a body are sorted by their shapes and points.
#pragma once
#include "contacts/solve_arrays.h"
#include "shared/group.h"

#if defined(__CUDA_ARCH__)
namespace warpmag {

// Entries of ``totals``, and their number.
enum Total { BODIES, SIDES, IMMOVABLE, WIDE_BODIES, UNSOLVED, FRICTIONAL, TOTALS };

// Counts contact c for each body that it can move.
__device__ inline void count_sides(int c, const Arrays& a) {
    int ends[2];
    if (c >= a.contact_count() || !find_bodies(a, c, ends)) return;
    if (a.has_friction(c)) a.totals[FRICTIONAL] = 1;
    for (int end = 0; end < 2; ++end)
        if (a.movable(ends[end])) atomicAdd(a.side_count + ends[end], 1);
}

// Reserves ``count`` entries for each thread of a warp from a counter, and returns the first of them.
__device__ inline int reserve(int* counter, int count) {
    const int lane = threadIdx.x % 32;
    int before = count;
    for (int step = 1; step < 32; step *= 2) {
        const int earlier = __shfl_up_sync(~0u, before, step);
        before += lane >= step ? earlier : 0;
    }
    int first = 0;
    if (lane == 31 && before > 0) first = atomicAdd(counter, before);
    return __shfl_sync(~0u, first, 31) + before - count;
}

// Assigns a line to body b, and a range of entries to its sides. All threads of a warp take part. Index ``body_count``
// is the world. Bodies without sides keep no slip.
__device__ inline void place_body(int b, const Arrays& a) {
    const int sides = b < a.body_count ? a.side_count[b] : 0;
    const int slot = reserve(a.totals + BODIES, sides > 0), start = reserve(a.totals + SIDES, sides);
    if (b > a.body_count) return;
    if (b < a.body_count && sides == 0) keep_range(a, b, 0, 0);
    int line = slot;
    if (sides > 0) {
        a.range[2 * slot] = start;
        a.range[2 * slot + 1] = start + sides;
        if (sides > WIDE) a.wide[atomicAdd(a.totals + WIDE_BODIES, 1)] = slot;
    } else if (b == a.body_count) line = a.line_count - 1;
    else if (a.inv_mass[b] == 0) line = a.line_count - 2 - atomicAdd(a.totals + IMMOVABLE, 1);
    else return;
    if (b < a.body_count) a.slot[b] = line;
    a.body[line] = b < a.body_count ? b : -1;
    load_lines(a, line);
}

// Enters the sides of contact c in the lists of their bodies, in the order of threads.
__device__ inline void list_sides(int c, const Arrays& a) {
    int ends[2];
    if (c >= a.contact_count() || !find_bodies(a, c, ends)) return;
    for (int end = 0; end < 2; ++end) {
        if (!a.movable(ends[end])) continue;
        const int side = a.range[2 * a.slot[ends[end]]] + atomicAdd(a.filled + ends[end], 1);
        a.entry[side] = 2 * c + end;
        a.key[side] = a.pair_key(c);
    }
}

// True if contact c comes before contact d of the same shapes, by points, normal and margins.
__device__ inline bool comes_before(const Arrays& a, int c, int d) {
    for (const Real* row : {a.point0, a.point1, a.normal})
        for (int k = 0; k < 3; ++k)
            if (row[3 * (size_t)c + k] != row[3 * (size_t)d + k])
                return row[3 * (size_t)c + k] < row[3 * (size_t)d + k];
    return a.margin0[c] + a.margin1[c] < a.margin0[d] + a.margin1[d];
}

__device__ inline AccumulatedImpulse impulse_at(const Arrays& a, int k) {
    return read_impulse([&](int quarter) { return ((const Four*)a.impulse)[IMPULSE_SIZE / 4 * (size_t)k + quarter]; });
}
__device__ inline void write_impulse_of(const Arrays& a, int k, const AccumulatedImpulse& impulse) {
    write_impulse(impulse,
                  [&](int quarter, Four f) { ((Four*)a.impulse)[IMPULSE_SIZE / 4 * (size_t)k + quarter] = f; });
}

// Contact of side k, stored in the second half of ``other``.
__device__ inline int& contact_of(const Arrays& a, int k) { return a.other[2 * (size_t)a.contact_max + k]; }

// Prepares the side of list entry k and writes it to its rank in the sorted list of its body.
__device__ inline void write_side(int k, const Arrays& a, Real relaxation, Real dt) {
    if (k >= a.totals[SIDES]) return;
    const int c = a.entry[k] / 2, end = a.entry[k] % 2;
    int ends[2];
    find_bodies(a, c, ends);
    const int slot = a.slot[ends[end]], first = a.range[2 * slot], last = a.range[2 * slot + 1];
    const unsigned long long key = a.key[k];
    int rank = first;
    for (int m = first; m < last; ++m) {
        if (a.key[m] != key) rank += a.key[m] < key;
        else if (m != k) {
            const int d = a.entry[m] / 2;
            rank += comes_before(a, d, c) || (m < k && !comes_before(a, c, d));
        }
    }
    Real detected[CONTACT_SIZE];
    write_detected(a, c, end, detected, 1);
    const int other = a.line_of_body(ends[1 - end]);
    a.other[rank] = other;
    contact_of(a, rank) = c;
    Real s[6];
    read_kept_slip(a, c, s);
    const Real sign = end == 1 ? 1 : -1;
    const Slip slip = {{sign * s[0], sign * s[1], sign * s[2]}, {sign * s[3], sign * s[4], sign * s[5]}};
    auto fours = [](const Real* lines, int i) { return [=](int quarter) { return own_four(lines, quarter, i); }; };
    const auto own_motion = fours(a.motion, slot), other_motion = fours(a.motion, other);
    const DetectedContact side = read_detected(
        [&](int q) { return Four{detected[4 * q], detected[4 * q + 1], detected[4 * q + 2], detected[4 * q + 3]}; });
    const Contact contact = prepare_contact(side, read_pose(fours(a.pose, slot)), read_pose(fours(a.pose, other)),
                                            read_body(own_motion), read_body(other_motion), read_inertia(own_motion),
                                            read_inertia(other_motion), slip, relaxation, dt);
    write_contact(contact, [&](int quarter, Four f) { put_four(a.side, quarter, rank, f); });
    if (a.totals[FRICTIONAL])
        write_slip(contact.return_velocity,
                   [&](int half, Four f) { ((Four*)a.return_velocity)[RETURN_SIZE / 4 * (size_t)rank + half] = f; });
    write_impulse_of(a, rank, {});
}

// Sums of impulses and angular impulses on a body, over the threads that share it.
struct ImpulseSum {
    Vector linear, angular;
};

// Addresses of the motion and the inertia of a body.
struct Line {
    const Four *motion, *inertia;
};
__device__ inline Line line_at(const Arrays& a, const Real* motion, int i) {
    return {(const Four*)motion + 4 * (size_t)i, (const Four*)a.motion + 4 * (size_t)i + 2};
}
// A contact, and its other body.
struct Side {
    Contact contact;
    Line other;
};
__device__ inline Slip return_velocity_at(const Arrays& a, int k, bool frictional) {
    if (!frictional) return {};
    return read_slip([&](int half) { return ((const Four*)a.return_velocity)[RETURN_SIZE / 4 * (size_t)k + half]; });
}
__device__ inline Contact contact_at(const Arrays& a, int k, bool frictional) {
    return read_contact([&](int quarter) { return own_four(a.side, quarter, k); },
                        return_velocity_at(a, k, frictional));
}

// Performs an iteration of every ``threads``-th contact of a body, from k to ``last``, and returns the sums of a group.
// ``side_at(k)`` returns a side, ``update_at(k, f)`` applies f to its accumulated impulse.
template <class Sides, class Updates>
__device__ inline ImpulseSum sum_impulses(Sides side_at, Updates update_at, int k, int last, int threads,
                                          const Body& own, Real momentum) {
    ImpulseSum total = {{0, 0, 0}, {0, 0, 0}};
    for (; k < last; k += threads) {
        const Side side = side_at(k);
        const Body other = read_body([&](int quarter) { return side.other.motion[quarter]; });
        const Impulse added = update_at(k, [&](AccumulatedImpulse& impulse) {
            return iterate_contact(side.contact, own, other, impulse, momentum);
        });
        total.linear += added.linear;
        total.angular += own_angular_impulse(side.contact, added);
    }
    return {group_sums(total.linear), group_sums(total.angular)};
}

// Sum over a block of the sums of its groups; the first ``sides`` threads had contacts.
__device__ inline ImpulseSum block_sums(ImpulseSum group_sum, int sides) {
    constexpr int GROUPS = BLOCK / GROUP;
    __shared__ ImpulseSum parts[GROUPS];
    __syncthreads();
    if (share() == 0) parts[threadIdx.x / GROUP] = group_sum;
    __syncthreads();
    ImpulseSum total = parts[0];
    for (int g = 1; g < GROUPS && g * GROUP < sides; ++g) {
        total.linear += parts[g].linear;
        total.angular += parts[g].angular;
    }
    return total;
}

// Performs an iteration of the body of a line, shared by ``threads`` threads; ``first`` is the number of this one. A
// group of GROUP threads skips bodies of more than WIDE contacts, which a whole block solves.
template <class Sides, class Updates, class SumThreads>
__device__ inline void move_body(const Line& line, Four* motion_out, int2 sides, bool valid, int first, int threads,
                                 Sides side_at, Updates update_at, SumThreads sum_threads, Real momentum) {
    Body own = read_body([&](int quarter) { return line.motion[quarter]; });
    const Inertia inertia = read_inertia([&](int quarter) { return line.inertia[quarter - 2]; });
    // the reads above are issued together, before it is known whether they are needed
    if (!valid || (threads == GROUP && sides.y - sides.x > WIDE)) return;
    const ImpulseSum p = sum_threads(
        sides.y - sides.x, sum_impulses(side_at, update_at, sides.x + first, sides.y, threads, own, momentum));
    apply_impulse(own, inertia, p.linear, p.angular);
    if (first == 0) write_body((Real*)motion_out, 0, own);
}

// Calls act(slot, valid, first, threads) for the body that a group of threads shares; ``valid`` is false without one.
// The first WIDE_BLOCKS blocks take the bodies of more than WIDE contacts, one at a time for a whole block.
template <class Act> __device__ inline void for_each_body(int thread, const Arrays& a, Act act) {
    const int block = thread / BLOCK;
    if (block < WIDE_BLOCKS) {
        for (int w = block; w < a.totals[WIDE_BODIES]; w += WIDE_BLOCKS) act(a.wide[w], true, threadIdx.x, BLOCK);
        return;
    }
    const int slot = (thread - WIDE_BLOCKS * BLOCK) / GROUP;
    act(slot, slot < a.totals[BODIES], share(), GROUP);
}

// Performs an iteration, which reads one of the two arrays of motions and writes the other.
__device__ inline void iterate(int thread, const Arrays& a, int iteration, int iterations) {
    const bool odd = iteration % 2, frictional = a.totals[FRICTIONAL];
    const Real* const from = odd ? a.next_motion : a.motion;
    Four* const to = (Four*)(odd ? a.motion : a.next_motion);
    auto side_at = [&](int k) { return Side{contact_at(a, k, frictional), line_at(a, from, a.other[k])}; };
    auto update_at = [&](int k, auto update) {
        AccumulatedImpulse impulse = impulse_at(a, k);
        const Impulse added = update(impulse);
        write_impulse_of(a, k, impulse);
        return added;
    };
    for_each_body(thread, a, [&](int slot, bool valid, int first, int threads) {
        auto sum_threads = [&](int sides, ImpulseSum p) { return threads == GROUP ? p : block_sums(p, sides); };
        move_body(line_at(a, from, slot), to + 4 * (size_t)slot, ((const int2*)a.range)[slot], valid, first, threads,
                  side_at, update_at, sum_threads, momentum_at(iteration, iterations));
    });
}

// Keeps the accumulated slip of every ``threads``-th side of a body, from k to ``last``, for the next substep.
template <class Sides, class Impulses>
__device__ inline void keep_sides(const Arrays& a, const Body& own, int k, int last, int threads, Sides side_at,
                                  Impulses impulse_at, Real relaxation, Real dt) {
    for (; k < last; k += threads) {
        const Side side = side_at(k);
        const Body other = read_body([&](int quarter) { return side.other.motion[quarter]; });
        const Slip s = accumulated_slip(side.contact, own, other, impulse_at(k).last, relaxation, dt);
        keep_slip(a, k, contact_of(a, k), {s.linear.x, s.linear.y, s.linear.z, s.angular.x, s.angular.y, s.angular.z});
    }
}
// Ends the solve for the body of a line: writes its velocities and the range of its kept sides.
__device__ inline void finish_body(const Arrays& a, int slot, int2 sides, const Body& body) {
    store_velocities(a, body, slot, 1);
    const bool frictional = a.totals[FRICTIONAL];
    keep_range(a, a.body[slot], frictional ? sides.x : 0, frictional ? sides.y : 0);
}
__device__ inline void finish(int thread, const Arrays& a, int odd, Real relaxation, Real dt) {
    const Real* const lines = odd ? a.next_motion : a.motion;
    for_each_body(thread, a, [&](int slot, bool valid, int first, int threads) {
        if (!valid) return;
        const int2 sides = ((const int2*)a.range)[slot];
        if (threads == GROUP && sides.y - sides.x > WIDE) return;
        const Line line = line_at(a, lines, slot);
        const Body body = read_body([&](int quarter) { return line.motion[quarter]; });
        if (a.totals[FRICTIONAL])
            keep_sides(
                a, body, sides.x + first, sides.y, threads,
                [&](int k) { return Side{contact_at(a, k, true), line_at(a, lines, a.other[k])}; },
                [&](int k) { return impulse_at(a, k); }, relaxation, dt);
        if (first == 0) finish_body(a, slot, sides, body);
    });
}
}
#endif
