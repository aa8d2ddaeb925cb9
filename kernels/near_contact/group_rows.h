// Distribution of the numbers and the slots of a ball over the threads of a group (``group.h``). Thread c mod SHARES
// has number c of its ball, as its part c / SHARES, and thread s mod SHARES has slot s. On a CPU a thread has all of
// them.
//
// From Python: NEAR_SLOTS, the slots of a ball's list.
#pragma once
#include "shared/group.h"

namespace warpmag {

CUDA_CALLABLE inline constexpr int parts(int count) { return (count + SHARES - 1) / SHARES; }
// Slots rounded up to whole rounds of the threads of a group.
CUDA_CALLABLE inline int whole_rounds(int slots) { return parts(slots) * SHARES; }

#if defined(__CUDA_ARCH__)
// Numbers of a ball, STEP rows of CHUNK apart. A GPU reads all of them at once, a CPU reads each where it is used.
template <int COUNT, int STEP = 1> struct Rows {
    Number at[COUNT];
    CUDA_CALLABLE explicit Rows(const Real* rows) {
        for (int row = 0; row < COUNT; ++row) at[row] = rows[row * STEP * CHUNK];
    }
    CUDA_CALLABLE Number operator[](int row) const { return at[row]; }
};

// Other balls in the slots of a list; a thread of a GPU reads all of its slots at once.
template <int SLOTS> struct Partners {
    int at[SLOTS / GROUP], other;
    CUDA_CALLABLE Partners(int* lists, int i) {
        for (int k = 0; k < SLOTS / GROUP; ++k) at[k] = *list_at(lists, NEAR_SLOTS, k * GROUP + share(), i);
    }
    CUDA_CALLABLE const int* of(int s) {
        other = at[0];
        for (int k = 1; k < SLOTS / GROUP; ++k) other = s >= k * GROUP ? at[k] : other;
        return &other;
    }
};

// Number c of a ball.
template <class Part> CUDA_CALLABLE inline Number number(const Part& part, int c) {
    return __shfl_sync(~0u, part[c / GROUP], c % GROUP, GROUP);
}

// Sums those of 16 numbers whose bits are set in ``used``, over the threads of a group. The total of number c goes to
// sum[c / GROUP * GROUP] of its thread. Each exchange halves the numbers of a thread.
CUDA_CALLABLE inline void group_totals(Number (&sum)[16], unsigned used) {
#pragma unroll
    for (int step = GROUP / 2; step > 0; step /= 2) {
        const bool upper = share() & step;
#pragma unroll
        for (int c = 0; c < 16; ++c) {
            if (c % GROUP >= step || !((used >> c | used >> (c + step)) & 1)) continue;
            const Real sent = upper ? sum[c] : sum[c + step], kept = upper ? sum[c + step] : sum[c];
            sum[c] = kept + __shfl_xor_sync(~0u, sent, step);
        }
        used |= used >> step;
    }
}
#else
template <int COUNT, int STEP = 1> struct Rows {
    const Real* rows;
    explicit Rows(const Real* rows) : rows(rows) {}
    Number operator[](int row) const { return numbers(rows + row * STEP * CHUNK); }
};

template <int SLOTS> struct Partners {
    int* const list;
    Partners(int* lists, int i) : list(list_at(lists, NEAR_SLOTS, 0, i)) {}
    const int* of(int s) const { return list + s * CHUNK; }
};

template <class Part> inline Number number(const Part& part, int c) { return part[c]; }
inline void group_totals(Number (&)[16], unsigned) {}
#endif

// The thread's parts of COUNT numbers of its ball, in rows of CHUNK.
template <int COUNT> struct Parts : Rows<parts(COUNT), SHARES> {
    CUDA_CALLABLE explicit Parts(const Real* rows) : Rows<parts(COUNT), SHARES>(rows + share() * CHUNK) {}
};
}
