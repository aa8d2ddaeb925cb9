// All iterations of the contact solver in one launch of a GPU. A small scene is solved by a cluster of blocks, which
// also lists the contacts. Each of many small worlds is solved by a block.
//
// The blocks of a cluster run at the same time and synchronize at a hardware barrier, which is faster than a launch.
// Each block holds the lines of some bodies in its shared memory, where the other blocks read them. Each thread holds
// its contact in registers. Passes, impulses and sums are those of ``solve_cuda.h``.
#pragma once
#include "contacts/solve_cuda.h"

#if defined(__CUDA_ARCH__)
namespace warpmag {

// Quarters that shared memory holds for each body: two for its motion before an iteration, two for its motion after
// it, and two for its inertia.
constexpr int QUARTERS = 6;

// A body that a block solves.
struct Task {
    int slot;
    int2 sides;
};
struct BlockMemory {
    Four lines[QUARTERS * LINES];
    Task tasks[LINES];
    int count;
};

__device__ inline int block_in_cluster() {
    int number = 0;
    if constexpr (CLUSTER > 1) asm("mov.u32 %0, %%cluster_ctarank;" : "=r"(number));
    return number;
}
// Address in another block's shared memory that corresponds to an address in this one's.
__device__ inline Four* map_to_block(Four* here, int block) {
    Four* there;
    asm("mapa.u64 %0, %1, %2;" : "=l"(there) : "l"(here), "r"(block));
    return there;
}
// Synchronizes all threads of the cluster; writes before the barrier are visible after it.
__device__ inline void cluster_barrier() {
    __syncwarp();
    if constexpr (CLUSTER == 1) __syncthreads();
    else asm volatile("barrier.cluster.arrive.release.aligned;\n\tbarrier.cluster.wait.acquire.aligned;" ::: "memory");
}
// Calls pass(k) for k < count with all threads of the cluster, then synchronizes.
template <class Pass> __device__ inline void for_each_in_cluster(int count, Pass pass) {
    const int warp = threadIdx.x / 32 * CLUSTER + block_in_cluster();
    for (int k = 32 * warp + threadIdx.x % 32; k < count; k += CLUSTER * BLOCK) pass(k);
    cluster_barrier();
}

// Lists and prepares the sides of all bodies.
__device__ inline void build_lists(const Arrays& a, Real relaxation, Real dt) {
    const int contacts = a.contact_count();
    for_each_in_cluster(TOTALS + 2 * a.body_count, [&](int k) { a.totals[k] = 0; }); // the counters are contiguous
    for_each_in_cluster(contacts, [&](int c) { count_sides(c, a); });
    for_each_in_cluster((a.body_count + 32) / 32 * 32, [&](int b) { place_body(b, a); });
    for_each_in_cluster(contacts, [&](int c) { list_sides(c, a); });
    for_each_in_cluster(a.totals[SIDES], [&](int k) { write_side(k, a, relaxation, dt); });
}

// Distribution of bodies over a cluster. Some blocks solve the wide bodies, those of more than WIDE contacts, one at a
// time. The other blocks, called narrow, solve all other bodies with a group of threads each, and hold all lines.
struct ClusterPlan {
    int bodies, wide, wide_blocks, narrow_blocks, block;
    __device__ explicit ClusterPlan(const Arrays& a)
        : bodies(a.totals[BODIES]), wide(a.totals[WIDE_BODIES]), wide_blocks(wide < CLUSTER / 2 ? wide : CLUSTER / 2),
          narrow_blocks(CLUSTER - wide_blocks), block(block_in_cluster()) {}
    __device__ bool fits() const { return bodies <= LINES * narrow_blocks; }
    __device__ bool is_wide() const { return block >= narrow_blocks; }
    __device__ int list_tasks(const Arrays& a, BlockMemory& memory) const {
        const int first = is_wide() ? block - narrow_blocks : block, step = is_wide() ? wide_blocks : narrow_blocks;
        const int count = ((is_wide() ? wide : bodies) - first + step - 1) / step;
        for (int task = threadIdx.x; task < count; task += BLOCK) {
            const int slot = is_wide() ? a.wide[first + task * step] : first + task * step;
            memory.tasks[task] = {slot, ((const int2*)a.range)[slot]};
        }
        return count;
    }
    __device__ Four* line(const Arrays&, BlockMemory& memory, int slot) const {
        return map_to_block(memory.lines + QUARTERS * (slot / narrow_blocks), slot % narrow_blocks);
    }
};

// Distribution of bodies where each block solves one world.
struct WorldPlan {
    int bodies;
    __device__ explicit WorldPlan(const Arrays& a) : bodies(a.totals[BODIES]) {}
    __device__ bool is_wide() const { return false; }
    __device__ int list_tasks(const Arrays& a, BlockMemory& memory) const {
        if (threadIdx.x == 0) memory.count = 0;
        __syncthreads();
        const int last = a.world_first[blockIdx.x + 1];
        for (int b = a.world_first[blockIdx.x] + threadIdx.x; b < last; b += BLOCK) {
            if (a.side_count[b] == 0) continue;
            const int slot = a.slot[b], task = atomicAdd(&memory.count, 1);
            memory.tasks[task] = {slot, ((const int2*)a.range)[slot]};
            a.filled[b] = task; // this counter is no longer needed
        }
        __syncthreads();
        return memory.count;
    }
    __device__ Four* line(const Arrays& a, BlockMemory& memory, int slot) const {
        return memory.lines + QUARTERS * a.filled[a.body[slot]];
    }
};

// A side that a thread holds, and the offset between the two motions of its other body, 0 for an immovable body.
struct HeldSide {
    Side side;
    int step;
};
template <class Plan>
__device__ inline HeldSide side_of(const Arrays& a, const Plan& plan, BlockMemory& memory, int k, bool frictional) {
    const int j = a.other[k];
    const Contact contact = contact_at(a, k, frictional);
    if (j >= plan.bodies) return {{contact, line_at(a, a.motion, j)}, 0};
    const Four* const line = plan.line(a, memory, j);
    return {{contact, {line, line + 4}}, 2};
}

// Performs all iterations of a block's tasks, and keeps the slip of their contacts for the next substep. Before even
// iterations motions are in the first two quarters of a line, before odd ones in the next two.
template <class Plan>
__device__ inline void iterate_all(const Arrays& a, const Plan& plan, BlockMemory& memory, int tasks, int iterations,
                                   Real relaxation, Real dt) {
    const int teams = plan.is_wide() ? 1 : BLOCK / GROUP, members = BLOCK / teams;
    const int team = threadIdx.x / members, first = threadIdx.x % members;
    const bool frictional = a.totals[FRICTIONAL];
    int held_index = -1;
    HeldSide held = {};
    AccumulatedImpulse held_impulse = {};
    if (team < tasks) {
        const int2 sides = memory.tasks[team].sides;
        const bool taken = plan.is_wide() || sides.y - sides.x <= WIDE;
        if (taken && sides.x + first < sides.y)
            held_index = sides.x + first, held = side_of(a, plan, memory, held_index, frictional);
    }
    auto side_before = [&](int k, int iteration) {
        HeldSide read = held;
        if (k != held_index) read = side_of(a, plan, memory, k, frictional);
        else read.side.contact.return_velocity = return_velocity_at(a, k, frictional); // saves registers
        read.side.other.motion += iteration % 2 * read.step;
        return read.side;
    };
    auto line_of = [&](int t) {
        return plan.is_wide() ? plan.line(a, memory, memory.tasks[t].slot) : memory.lines + QUARTERS * t;
    };
    for (int iteration = 0; iteration < iterations; ++iteration) {
        const int odd = iteration % 2;
        auto side_at = [&](int k) { return side_before(k, iteration); };
        auto update_at = [&](int k, auto update) {
            if (k == held_index) return update(held_impulse);
            AccumulatedImpulse impulse = impulse_at(a, k);
            const Impulse added = update(impulse);
            write_impulse_of(a, k, impulse);
            return added;
        };
        auto sum_threads = [&](int sides, ImpulseSum p) { return plan.is_wide() ? block_sums(p, sides) : p; };
        for (int t = team; t < tasks; t += teams) {
            Four* const line = line_of(t);
            move_body({line + 2 * odd, line + 4}, line + 2 * (1 - odd), memory.tasks[t].sides, true, first, members,
                      side_at, update_at, sum_threads, momentum_at(iteration, iterations));
        }
        cluster_barrier();
    }
    if (!frictional) return;
    for (int t = team; t < tasks; t += teams) {
        const int2 sides = memory.tasks[t].sides;
        if (!plan.is_wide() && sides.y - sides.x > WIDE) continue;
        const Four* const motion = line_of(t) + 2 * (iterations % 2);
        keep_sides(
            a, read_body([&](int quarter) { return motion[quarter]; }), sides.x + first, sides.y, members,
            [&](int k) { return side_before(k, iterations); },
            [&](int k) { return k == held_index ? held_impulse : impulse_at(a, k); }, relaxation, dt);
    }
    cluster_barrier(); // no block exits while others read its lines
}

// Loads the bodies of a block's tasks into shared memory, solves them, and writes their velocities.
template <class Plan>
__device__ inline void solve_tasks(const Arrays& a, const Plan& plan, BlockMemory& memory, int iterations,
                                   Real relaxation, Real dt) {
    const int tasks = plan.list_tasks(a, memory), own_lines = plan.is_wide() ? 0 : tasks;
    if (CLUSTER == 1 && tasks == 0) return;
    __syncthreads();
    for (int k = threadIdx.x; k < 4 * own_lines; k += BLOCK)
        memory.lines[QUARTERS * (k / 4) + k % 4 + k % 4 / 2 * 2] = own_four(a.motion, k % 4, memory.tasks[k / 4].slot);
    cluster_barrier();
    iterate_all(a, plan, memory, tasks, iterations, relaxation, dt);
    for (int t = threadIdx.x / GROUP; t < own_lines && share() == 0; t += BLOCK / GROUP) {
        const Four* const motion = memory.lines + QUARTERS * t + iterations % 2 * 2;
        finish_body(a, memory.tasks[t].slot, memory.tasks[t].sides,
                    read_body([&](int quarter) { return motion[quarter]; }));
    }
}

// Solves a scene in one launch. With more than ``most_sides`` sides, or more bodies than fit, it only makes the lists
// and sets ``totals[UNSOLVED]``.
__device__ inline void solve_in_cluster(const Arrays& a, int iterations, int most_sides, Real relaxation, Real dt) {
    __shared__ BlockMemory memory;
    build_lists(a, relaxation, dt);
    const ClusterPlan plan(a);
    const bool fits = plan.fits() && a.totals[SIDES] <= most_sides;
    if (!fits && threadIdx.x == 0 && plan.block == 0) a.totals[UNSOLVED] = plan.bodies;
    if (fits && plan.bodies > 0) solve_tasks(a, plan, memory, iterations, relaxation, dt);
}

// Performs all iterations in the block's world.
__device__ inline void solve_world(const Arrays& a, int iterations, Real relaxation, Real dt) {
    __shared__ BlockMemory memory;
    solve_tasks(a, WorldPlan(a), memory, iterations, relaxation, dt);
}
}
#endif
