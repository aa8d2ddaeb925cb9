// The contact solve on a GPU: groups of threads share a body and go through its own contacts, one launch an iteration.
//
// Both bodies of a contact compute its impulses, from what they were after the last iteration: no atomics are needed,
// and nothing waits for another block. Where bodies and their lists lie depends on the order in which threads came, but
// no result does: a body's contacts are sorted by what they are.
#pragma once
#include "contacts/solve_arrays.h"
#include "shared/group.h"

#if defined(__CUDA_ARCH__)
namespace warpmag {

enum Total { BODIES, SIDES, IMMOVABLE, WIDE_BODIES, LEFT, STICKING, TOTALS }; // entries of ``totals``, and their number

// For contact c: counts it for the bodies that it moves.
__device__ inline void count_sides(int c, const Arrays& a) {
    int ends[2];
    if (c >= a.found() || !ends_of(a, c, ends)) return;
    if (a.sticks(c)) a.totals[STICKING] = 1;
    for (int end = 0; end < 2; ++end)
        if (a.movable(ends[end])) atomicAdd(a.side_count + ends[end], 1);
}

// A place of its own for each thread of a warp that wants ``count`` entries, from a counter.
__device__ inline int reserve(int* counter, int count) {
    const int lane = threadIdx.x % 32;
    int before = count;
    for (int step = 1; step < 32; step *= 2) {
        const int its = __shfl_up_sync(~0u, before, step);
        before += lane >= step ? its : 0;
    }
    int first = 0;
    if (lane == 31 && before > 0) first = atomicAdd(counter, before);
    return __shfl_sync(~0u, first, 31) + before - count;
}

// For body b: a line, and room for its sides; all threads of a warp take part. The body after the last is the world.
// Nothing is kept of bodies without sides.
__device__ inline void place_body(int b, const Arrays& a) {
    const int sides = b < a.bodies ? a.side_count[b] : 0;
    const int slot = reserve(a.totals + BODIES, sides > 0), start = reserve(a.totals + SIDES, sides);
    if (b > a.bodies) return;
    if (b < a.bodies && sides == 0) keep_range(a, b, 0, 0);
    int line = slot;
    if (sides > 0) {
        a.range[2 * slot] = start;
        a.range[2 * slot + 1] = start + sides;
        if (sides > WIDE) a.wide[atomicAdd(a.totals + WIDE_BODIES, 1)] = slot;
    } else if (b == a.bodies) line = a.lines - 1;
    else if (a.inv_mass[b] == 0) line = a.lines - 2 - atomicAdd(a.totals + IMMOVABLE, 1);
    else return;
    if (b < a.bodies) a.slot[b] = line;
    a.body[line] = b < a.bodies ? b : -1;
    begin_lines(a, line);
}

// For contact c: puts its sides into the lists of their bodies, as they come.
__device__ inline void list_sides(int c, const Arrays& a) {
    int ends[2];
    if (c >= a.found() || !ends_of(a, c, ends)) return;
    for (int end = 0; end < 2; ++end) {
        if (!a.movable(ends[end])) continue;
        const int place = a.range[2 * a.slot[ends[end]]] + atomicAdd(a.filled + ends[end], 1);
        a.entry[place] = 2 * c + end;
        a.key[place] = a.key_of(c);
    }
}

// Whether contact c comes before d, which is between the same shapes, by where and how they touch.
__device__ inline bool touches_before(const Arrays& a, int c, int d) {
    for (const Real* row : {a.point0, a.point1, a.normal})
        for (int k = 0; k < 3; ++k)
            if (row[3 * (size_t)c + k] != row[3 * (size_t)d + k])
                return row[3 * (size_t)c + k] < row[3 * (size_t)d + k];
    return a.margin0[c] + a.margin1[c] < a.margin0[d] + a.margin1[d];
}

__device__ inline Given given_at(const Arrays& a, int k) {
    return read_given([&](int quarter) { return ((const Four*)a.given)[GIVEN / 4 * (size_t)k + quarter]; });
}
__device__ inline void put_given_of(const Arrays& a, int k, const Given& given) {
    put_given(given, [&](int quarter, Four f) { ((Four*)a.given)[GIVEN / 4 * (size_t)k + quarter] = f; });
}

// The contact that a side is of, in the half of ``other`` that sides leave.
__device__ inline int& contact_of(const Arrays& a, int k) { return a.other[2 * (size_t)a.contact_max + k]; }

// For entry k of the lists: writes the side to where it comes among those of its body.
__device__ inline void write_side(int k, const Arrays& a, Real relaxation, Real dt) {
    if (k >= a.totals[SIDES]) return;
    const int c = a.entry[k] / 2, end = a.entry[k] % 2;
    int ends[2];
    ends_of(a, c, ends);
    const int slot = a.slot[ends[end]], first = a.range[2 * slot], last = a.range[2 * slot + 1];
    const unsigned long long key = a.key[k];
    int place = first;
    for (int m = first; m < last; ++m) {
        if (a.key[m] != key) place += a.key[m] < key;
        else if (m != k) {
            const int d = a.entry[m] / 2;
            place += touches_before(a, d, c) || (m < k && !touches_before(a, c, d));
        }
    }
    Real touch[TOUCH];
    put_touch(a, c, end, touch, 1);
    const int other = a.line_of(ends[1 - end]);
    a.other[place] = other;
    contact_of(a, place) = c;
    Real s[6];
    slipped_before(a, c, s);
    const Real from = end == 1 ? 1 : -1;
    const Slip slipped = {{from * s[0], from * s[1], from * s[2]}, {from * s[3], from * s[4], from * s[5]}};
    auto fours = [](const Real* lines, int i) { return [=](int quarter) { return own_four(lines, quarter, i); }; };
    const auto own_motion = fours(a.motion, slot), other_motion = fours(a.motion, other);
    auto found = [&](int q) { return Four{touch[4 * q], touch[4 * q + 1], touch[4 * q + 2], touch[4 * q + 3]}; };
    const Contact contact = prepared(read_touch(found), read_pose(fours(a.pose, slot)), read_pose(fours(a.pose, other)),
                                     read_body(own_motion), read_body(other_motion), read_inertia(own_motion),
                                     read_inertia(other_motion), slipped, relaxation, dt);
    put_contact(contact, [&](int quarter, Four f) { put_four(a.side, quarter, place, f); });
    if (a.totals[STICKING])
        put_slip(contact.back, [&](int half, Four f) { ((Four*)a.back)[BACK / 4 * (size_t)place + half] = f; });
    put_given_of(a, place, {});
}

// Sums of impulses on a body, over the threads that share it.
struct Pressure {
    Vector linear, angular;
};

// Where the motion and the inertia of a body stand.
struct Line {
    const Four *motion, *inertia;
};
__device__ inline Line line_at(const Arrays& a, const Real* motion, int i) {
    return {(const Four*)motion + 4 * (size_t)i, (const Four*)a.motion + 4 * (size_t)i + 2};
}
// A contact, and the body at its other end.
struct Side {
    Contact contact;
    Line other;
};
__device__ inline Slip back_at(const Arrays& a, int k, bool sticking) {
    if (!sticking) return {};
    return read_slip([&](int half) { return ((const Four*)a.back)[BACK / 4 * (size_t)k + half]; });
}
__device__ inline Contact contact_at(const Arrays& a, int k, bool sticking) {
    return read_contact([&](int quarter) { return own_four(a.side, quarter, k); }, back_at(a, k, sticking));
}

// What each ``threads``-th contact of a body does, from k to last. ``side_at`` gives contacts, and ``press_at`` lets a
// function change what they have given.
template <class Sides, class Presses>
__device__ inline Pressure press_all(Sides side_at, Presses press_at, int k, int last, int threads, const Body& own,
                                     Real momentum) {
    Pressure total = {{0, 0, 0}, {0, 0, 0}};
    for (; k < last; k += threads) {
        const Side side = side_at(k);
        const Body other = read_body([&](int quarter) { return side.other.motion[quarter]; });
        const Impulse added =
            press_at(k, [&](Given& given) { return press(side.contact, own, other, given, momentum); });
        total.linear += added.linear;
        total.angular += on_own(side.contact, added);
    }
    return {group_sums(total.linear), group_sums(total.angular)};
}

// Sums over a block of the sums of its groups, of which the first have ``sides``.
__device__ inline Pressure block_sums(Pressure mine, int sides) {
    constexpr int GROUPS = BLOCK / GROUP;
    __shared__ Pressure parts[GROUPS];
    __syncthreads();
    if (share() == 0) parts[threadIdx.x / GROUP] = mine;
    __syncthreads();
    Pressure total = parts[0];
    for (int g = 1; g < GROUPS && g * GROUP < sides; ++g) {
        total.linear += parts[g].linear;
        total.angular += parts[g].angular;
    }
    return total;
}

// Moves the body of a line by what ``threads`` threads, of which this is the one of number ``first``, sum up of its
// contacts, unless they are ``WIDE`` where these are not.
template <class Sides, class Presses, class Totals>
__device__ inline void move(const Line& line, Four* to, int2 sides, bool taken, int first, int threads, Sides side_at,
                            Presses press_at, Totals totals, Real momentum) {
    Body own = read_body([&](int quarter) { return line.motion[quarter]; });
    const Inertia inertia = read_inertia([&](int quarter) { return line.inertia[quarter - 2]; });
    // all of that is read at once, whether it is needed or not
    if (!taken || (threads == GROUP && sides.y - sides.x > WIDE)) return;
    const Pressure p =
        totals(sides.y - sides.x, press_all(side_at, press_at, sides.x + first, sides.y, threads, own, momentum));
    apply(own, inertia, p.linear, p.angular);
    if (first == 0) put_body((Real*)to, 0, own);
}

// Lets a group of threads act on the body that they share, one of a line or none. The first blocks take the bodies with
// many contacts, a whole block each.
template <class Act> __device__ inline void share_bodies(int thread, const Arrays& a, Act act) {
    const int block = thread / BLOCK;
    if (block < WIDE_BLOCKS) {
        for (int w = block; w < a.totals[WIDE_BODIES]; w += WIDE_BLOCKS) act(a.wide[w], true, threadIdx.x, BLOCK);
        return;
    }
    const int slot = (thread - WIDE_BLOCKS * BLOCK) / GROUP;
    act(slot, slot < a.totals[BODIES], share(), GROUP);
}

// One iteration: moves the body that a group of threads shares, from one array of motions to the other.
__device__ inline void iterate(int thread, const Arrays& a, int iteration, int iterations) {
    const bool odd = iteration % 2, sticking = a.totals[STICKING];
    const Real* const from = odd ? a.next_motion : a.motion;
    Four* const to = (Four*)(odd ? a.motion : a.next_motion);
    auto side_at = [&](int k) { return Side{contact_at(a, k, sticking), line_at(a, from, a.other[k])}; };
    auto press_at = [&](int k, auto press) {
        Given given = given_at(a, k);
        const Impulse added = press(given);
        put_given_of(a, k, given);
        return added;
    };
    share_bodies(thread, a, [&](int slot, bool taken, int first, int threads) {
        auto totals = [&](int sides, Pressure p) { return threads == GROUP ? p : block_sums(p, sides); };
        move(line_at(a, from, slot), to + 4 * (size_t)slot, ((const int2*)a.range)[slot], taken, first, threads,
             side_at, press_at, totals, momentum_at(iteration, iterations));
    });
}

// Keeps each ``threads``-th side of a body, from k to last, for the next substep.
template <class Sides, class Givens>
__device__ inline void keep_sides(const Arrays& a, const Body& own, int k, int last, int threads, Sides side_at,
                                  Givens given_at, Real relaxation, Real dt) {
    for (; k < last; k += threads) {
        const Side side = side_at(k);
        const Body other = read_body([&](int quarter) { return side.other.motion[quarter]; });
        const Slip s = slipped_so_far(side.contact, own, other, given_at(k).last, relaxation, dt);
        keep(a, k, contact_of(a, k), {s.linear.x, s.linear.y, s.linear.z, s.turn.x, s.turn.y, s.turn.z});
    }
}
// Ends the solve for the body of a line: writes its velocities, and which sides are kept.
__device__ inline void finish_body(const Arrays& a, int slot, int2 sides, const Body& body) {
    end_lines(a, body, slot, 1);
    const bool sticking = a.totals[STICKING];
    keep_range(a, a.body[slot], sticking ? sides.x : 0, sticking ? sides.y : 0);
}
__device__ inline void finish(int thread, const Arrays& a, int odd, Real relaxation, Real dt) {
    const Real* const lines = odd ? a.next_motion : a.motion;
    share_bodies(thread, a, [&](int slot, bool taken, int first, int threads) {
        if (!taken) return;
        const int2 sides = ((const int2*)a.range)[slot];
        if (threads == GROUP && sides.y - sides.x > WIDE) return;
        const Line line = line_at(a, lines, slot);
        const Body body = read_body([&](int quarter) { return line.motion[quarter]; });
        if (a.totals[STICKING])
            keep_sides(
                a, body, sides.x + first, sides.y, threads,
                [&](int k) { return Side{contact_at(a, k, true), line_at(a, lines, a.other[k])}; },
                [&](int k) { return given_at(a, k); }, relaxation, dt);
        if (first == 0) finish_body(a, slot, sides, body);
    });
}
}
#endif
