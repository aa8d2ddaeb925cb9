// Cells of the neighbor search, and buckets of their hash table.
#pragma once

namespace warpmag {

constexpr double FARTHEST_CELL = 1e9; // largest index that safely fits an int

struct alignas(16) Cell {
    int x, y, z, group; // group −1 stands for no cell
};

// Positions [m] of packed moments, and radii [m] that determine who is near.
struct Balls {
    const Real *x, *y, *z, *radius;
};

template <class Lists> CUDA_CALLABLE inline Balls balls_of(const Lists& lists) {
    const Real* const x = (const Real*)lists.packed.data;
    const size_t pitch = lists.packed.strides[0] / sizeof(Real);
    return {x, x + pitch, x + 2 * pitch, lists.radius.data};
}

// Inverse width of a cell. The width exceeds the largest distance of neighbors despite rounding.
template <class Lists> CUDA_CALLABLE inline double cells_per_meter_of(const Lists& targets) {
    return 1.0 / ((targets.ratio + 1e-6) * targets.reach.data[0]);
}

// Cell of a moment of a group; no cell if it is too far away or its position is not a number.
CUDA_CALLABLE inline Cell cell_of(const Balls& balls, int i, int group, double cells_per_meter) {
    const double coordinate[3] = {balls.x[i] * cells_per_meter, balls.y[i] * cells_per_meter,
                                  balls.z[i] * cells_per_meter};
    int cell[3];
    for (int c = 0; c < 3; ++c) {
        if (!(coordinate[c] < FARTHEST_CELL && -coordinate[c] < FARTHEST_CELL)) return {0, 0, 0, -1};
        cell[c] = (int)coordinate[c];
        cell[c] -= cell[c] > coordinate[c];
    }
    return {cell[0], cell[1], cell[2], group};
}

// Bucket of a cell among 2ᵏ, after Teschner et al. 2003; cells in a column along z have consecutive buckets.
CUDA_CALLABLE inline int bucket_of(Cell cell, int buckets) {
    unsigned mixed = (unsigned)cell.x * 73856093u ^ (unsigned)cell.y * 19349663u ^ (unsigned)cell.group * 49979687u;
    mixed = (mixed ^ mixed >> 15) * 0x2c1b3c6du;
    return (int)(((mixed ^ mixed >> 16) + (unsigned)cell.z) & (unsigned)(buckets - 1));
}
}
