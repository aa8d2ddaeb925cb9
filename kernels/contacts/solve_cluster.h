// All iterations of the contact solve in one launch of a GPU: of a small scene by a cluster of blocks, which takes the
// passes before and after as well, and of each of many small worlds by a block.
//
// The blocks of a cluster run at the same time and meet at a barrier of the hardware, which takes less than a launch.
// Each keeps the lines of some bodies in its shared memory, where the others read them, and each thread keeps its
// contact in registers. Passes, impulses and sums are those of ``solve_cuda.h``.
#pragma once
#include "contacts/solve_cuda.h"

#if defined(__CUDA_ARCH__)
namespace warpmag {

constexpr int QUARTERS = 6; // of a body in shared memory: its motion before and after an iteration, and its inertia

// A body that a block moves.
struct Task {
    int slot;
    int2 sides;
};
struct Room {
    Four lines[QUARTERS * LINES];
    Task tasks[LINES];
    int count;
};

__device__ inline int block_in_cluster() {
    int number = 0;
    if constexpr (CLUSTER > 1) asm("mov.u32 %0, %%cluster_ctarank;" : "=r"(number));
    return number;
}
// Where what lies here in shared memory lies in that of another block.
__device__ inline Four* in_block(Four* here, int block) {
    Four* there;
    asm("mapa.u64 %0, %1, %2;" : "=l"(there) : "l"(here), "r"(block));
    return there;
}
// Waits until all threads of the cluster have come, and sees what they wrote.
__device__ inline void meet() {
    __syncwarp();
    if constexpr (CLUSTER == 1) __syncthreads();
    else asm volatile("barrier.cluster.arrive.release.aligned;\n\tbarrier.cluster.wait.acquire.aligned;" ::: "memory");
}
// Makes a pass over ``count`` items with all threads of the cluster.
template <class Pass> __device__ inline void pass_over(int count, Pass pass) {
    const int warp = threadIdx.x / 32 * CLUSTER + block_in_cluster();
    for (int k = 32 * warp + threadIdx.x % 32; k < count; k += CLUSTER * BLOCK) pass(k);
    meet();
}

// Lists the sides of bodies.
__device__ inline void list_all(const Arrays& a, Real relaxation, Real dt) {
    const int found = a.found();
    pass_over(TOTALS + 2 * a.bodies, [&](int k) { a.totals[k] = 0; }); // the counters follow each other
    pass_over(found, [&](int c) { count_sides(c, a); });
    pass_over((a.bodies + 32) / 32 * 32, [&](int b) { place_body(b, a); });
    pass_over(found, [&](int c) { list_sides(c, a); });
    pass_over(a.totals[SIDES], [&](int k) { write_side(k, a, relaxation, dt); });
}

// How bodies are shared out in a cluster: those with many contacts to a few blocks, a body at a time, and all others to
// the rest, a group of threads each. Lines are kept by the latter.
struct ClusterPlan {
    int bodies, wide, wide_blocks, narrow_blocks, block;
    __device__ explicit ClusterPlan(const Arrays& a)
        : bodies(a.totals[BODIES]), wide(a.totals[WIDE_BODIES]), wide_blocks(wide < CLUSTER / 2 ? wide : CLUSTER / 2),
          narrow_blocks(CLUSTER - wide_blocks), block(block_in_cluster()) {}
    __device__ bool fits() const { return bodies <= LINES * narrow_blocks; }
    __device__ bool is_wide() const { return block >= narrow_blocks; }
    __device__ int take_tasks(const Arrays& a, Room& room) const {
        const int first = is_wide() ? block - narrow_blocks : block, step = is_wide() ? wide_blocks : narrow_blocks;
        const int count = ((is_wide() ? wide : bodies) - first + step - 1) / step;
        for (int task = threadIdx.x; task < count; task += BLOCK) {
            const int slot = is_wide() ? a.wide[first + task * step] : first + task * step;
            room.tasks[task] = {slot, ((const int2*)a.range)[slot]};
        }
        return count;
    }
    __device__ Four* line(const Arrays&, Room& room, int slot) const {
        return in_block(room.lines + QUARTERS * (slot / narrow_blocks), slot % narrow_blocks);
    }
};

// A block has a world for itself.
struct WorldPlan {
    int bodies;
    __device__ explicit WorldPlan(const Arrays& a) : bodies(a.totals[BODIES]) {}
    __device__ bool is_wide() const { return false; }
    __device__ int take_tasks(const Arrays& a, Room& room) const {
        if (threadIdx.x == 0) room.count = 0;
        __syncthreads();
        const int last = a.world_first[blockIdx.x + 1];
        for (int b = a.world_first[blockIdx.x] + threadIdx.x; b < last; b += BLOCK) {
            if (a.side_count[b] == 0) continue;
            const int slot = a.slot[b], task = atomicAdd(&room.count, 1);
            room.tasks[task] = {slot, ((const int2*)a.range)[slot]};
            a.filled[b] = task; // its sides are counted no more
        }
        __syncthreads();
        return room.count;
    }
    __device__ Four* line(const Arrays& a, Room& room, int slot) const {
        return room.lines + QUARTERS * a.filled[a.body[slot]];
    }
};

// A side and what the next motion of its other body is away from this one, which for a body that nothing moves is 0.
struct KeptSide {
    Side side;
    int step;
};
template <class Plan>
__device__ inline KeptSide side_of(const Arrays& a, const Plan& plan, Room& room, int k, bool sticking) {
    const int j = a.other[k];
    const Contact contact = contact_at(a, k, sticking);
    if (j >= plan.bodies) return {{contact, line_at(a, a.motion, j)}, 0};
    const Four* const line = plan.line(a, room, j);
    return {{contact, {line, line + 4}}, 2};
}

// All iterations over a block's tasks, and what is kept for the next substep; lines are in the first half of what the
// block keeps of them before even iterations, or else in the second.
template <class Plan>
__device__ inline void iterate_all(const Arrays& a, const Plan& plan, Room& room, int tasks, int iterations,
                                   Real relaxation, Real dt) {
    const int teams = plan.is_wide() ? 1 : BLOCK / GROUP, members = BLOCK / teams;
    const int team = threadIdx.x / members, first = threadIdx.x % members;
    const bool sticking = a.totals[STICKING];
    int kept_at = -1;
    KeptSide kept = {};
    Given kept_given = {};
    if (team < tasks) {
        const int2 sides = room.tasks[team].sides;
        const bool taken = plan.is_wide() || sides.y - sides.x <= WIDE;
        if (taken && sides.x + first < sides.y)
            kept_at = sides.x + first, kept = side_of(a, plan, room, kept_at, sticking);
    }
    auto side_before = [&](int k, int iteration) {
        KeptSide its = kept;
        if (k != kept_at) its = side_of(a, plan, room, k, sticking);
        else its.side.contact.back = back_at(a, k, sticking); // registers are few
        its.side.other.motion += iteration % 2 * its.step;
        return its.side;
    };
    auto line_of = [&](int t) {
        return plan.is_wide() ? plan.line(a, room, room.tasks[t].slot) : room.lines + QUARTERS * t;
    };
    for (int iteration = 0; iteration < iterations; ++iteration) {
        const int odd = iteration % 2;
        auto side_at = [&](int k) { return side_before(k, iteration); };
        auto press_at = [&](int k, auto press) {
            if (k == kept_at) return press(kept_given);
            Given given = given_at(a, k);
            const Impulse added = press(given);
            put_given_of(a, k, given);
            return added;
        };
        auto totals = [&](int sides, Pressure p) { return plan.is_wide() ? block_sums(p, sides) : p; };
        for (int t = team; t < tasks; t += teams) {
            Four* const line = line_of(t);
            move({line + 2 * odd, line + 4}, line + 2 * (1 - odd), room.tasks[t].sides, true, first, members, side_at,
                 press_at, totals, momentum_at(iteration, iterations));
        }
        meet();
    }
    if (!sticking) return;
    for (int t = team; t < tasks; t += teams) {
        const int2 sides = room.tasks[t].sides;
        if (!plan.is_wide() && sides.y - sides.x > WIDE) continue;
        const Four* const motion = line_of(t) + 2 * (iterations % 2);
        keep_sides(
            a, read_body([&](int quarter) { return motion[quarter]; }), sides.x + first, sides.y, members,
            [&](int k) { return side_before(k, iterations); },
            [&](int k) { return k == kept_at ? kept_given : given_at(a, k); }, relaxation, dt);
    }
    meet(); // no block ends while others read its lines
}

// Takes bodies into shared memory, moves them, and writes what they are then.
template <class Plan>
__device__ inline void solve_tasks(const Arrays& a, const Plan& plan, Room& room, int iterations, Real relaxation,
                                   Real dt) {
    const int tasks = plan.take_tasks(a, room), own_lines = plan.is_wide() ? 0 : tasks;
    if (CLUSTER == 1 && tasks == 0) return;
    __syncthreads();
    for (int k = threadIdx.x; k < 4 * own_lines; k += BLOCK)
        room.lines[QUARTERS * (k / 4) + k % 4 + k % 4 / 2 * 2] = own_four(a.motion, k % 4, room.tasks[k / 4].slot);
    meet();
    iterate_all(a, plan, room, tasks, iterations, relaxation, dt);
    for (int t = threadIdx.x / GROUP; t < own_lines && share() == 0; t += BLOCK / GROUP) {
        const Four* const motion = room.lines + QUARTERS * t + iterations % 2 * 2;
        finish_body(a, room.tasks[t].slot, room.tasks[t].sides,
                    read_body([&](int quarter) { return motion[quarter]; }));
    }
}

// The whole solve, or if there are more than ``most`` sides or more bodies than fit, no more than the lists: then
// ``totals[LEFT]`` tells so.
__device__ inline void solve_in_cluster(const Arrays& a, int iterations, int most, Real relaxation, Real dt) {
    __shared__ Room room;
    list_all(a, relaxation, dt);
    const ClusterPlan plan(a);
    const bool fits = plan.fits() && a.totals[SIDES] <= most;
    if (!fits && threadIdx.x == 0 && plan.block == 0) a.totals[LEFT] = plan.bodies;
    if (fits && plan.bodies > 0) solve_tasks(a, plan, room, iterations, relaxation, dt);
}

// All iterations in the block's world.
__device__ inline void solve_world(const Arrays& a, int iterations, Real relaxation, Real dt) {
    __shared__ Room room;
    solve_tasks(a, WorldPlan(a), room, iterations, relaxation, dt);
}
}
#endif
