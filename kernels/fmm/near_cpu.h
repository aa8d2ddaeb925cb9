// Sums over the pairs of moments in neighbouring cells on a CPU: the loop over tiles of sums_cpu.h, a tile of targets
// from one cell, tiles of sources from its neighbours.
#pragma once
#include "pairs/sums_cpu.h"

namespace warpmag::cpu {

// Sums of the moments of one leaf.
template <Quantity Q, class Arrays> void sum_leaf(const Arrays& arrays, int leaf) {
    const Share share = {arrays.moments, arrays.moments, arrays.effective, nullptr, nullptr, arrays.sums.data, 0};
    const int* const begin_of = arrays.moment_begin.data;
    const int begin = begin_of[leaf], end = begin_of[leaf + 1];
    __builtin_memset(share.sums_at<Q>(0, begin), 0, (end - begin) * width(Q) * sizeof(Real));
    Tile targets, sources;
    const auto clear = [&] {
        sources.count = 0;
        sources.begin = end; // beyond the targets: none of them is a source
    };
    const auto sum_tile = [&] {
        if (sources.count == 0) return;
        complete<Q>(sources);
        for (int i = begin; i < end; i += TILE_SIZE) {
            fill<Q>(targets, share.targets, i, i + TILE_SIZE < end ? i + TILE_SIZE : end);
            sum_all_pairs<Q, false>(share, targets, sources, share.sums_at<Q>(0, i));
        }
        clear();
    };
    clear();
    for (int k = 0; k < 9; ++k) {
        // the moments of cells side by side along x follow each other
        const int* const row = arrays.neighbors.data + 27 * (size_t)leaf + 3 * k;
        const int lowest = row[0] >= 0 ? row[0] : row[1] >= 0 ? row[1] : row[2];
        const int highest = row[2] >= 0 ? row[2] : row[1] >= 0 ? row[1] : row[0];
        if (lowest < 0) continue;
        const int last = begin_of[highest + 1];
        for (int first = begin_of[lowest]; first < last;) {
            const int room = TILE_SIZE - sources.count, taken = last - first < room ? last - first : room;
            // where the targets are sources themselves, their place among these
            if (k == 4) sources.begin = first - sources.count;
            append(sources, share.sources, first, first + taken);
            first += taken;
            if (sources.count == TILE_SIZE) sum_tile();
        }
    }
    sum_tile();
}

// Sums of the moments of the leaves wanted.
template <Quantity Q, class Arrays> void sum_near(const Arrays& arrays, int threads, Word* team) {
    const int first = arrays.leaves.data[0], count = arrays.leaves.data[1] - first;
    share_out(team, threads, count, 8, [&](int leaf) { sum_leaf<Q>(arrays, first + leaf); });
}

}
