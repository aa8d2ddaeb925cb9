// Field given at the nodes of a regular grid. Each component is interpolated by cubic convolution along the three axes
// (Keys 1981, "Cubic convolution interpolation for digital image processing", IEEE Trans. Acoust. 29, 1153). The
// interpolant passes through the nodes, is third-order accurate, and has a continuous gradient. The field is zero
// outside the grid.
#pragma once
#include "applied/point_field.h"

namespace warpmag {

// Weights of the four nodes around a point, and their derivatives by t, the offset from the second node in spacings.
struct CubicWeights {
    double value[4], slope[4];

    CUDA_CALLABLE explicit CubicWeights(double t)
        : value{0.5 * t * (-1 + t * (2 - t)), 1 + 0.5 * t * t * (3 * t - 5), 0.5 * t * (1 + t * (4 - 3 * t)),
                0.5 * t * t * (t - 1)},
          slope{0.5 * (-1 + t * (4 - 3 * t)), 0.5 * t * (9 * t - 10), 0.5 * (1 + t * (8 - 9 * t)),
                0.5 * t * (3 * t - 2)} {}
};

// Field map. Parameters: first node and spacings [m], and numbers of nodes, along x, y and z. Table: field [A/m] at the
// nodes, z fastest, with one more node at either end of each axis. Strength: a factor.
CUDA_CALLABLE inline PointField map_field(const AppliedSource& source, Point x) {
    const double* const p = source.parameters;
    const double position[3] = {(x.x - p[0]) / p[3], (x.y - p[1]) / p[4], (x.z - p[2]) / p[5]};
    int cell[3];
    for (int axis = 0; axis < 3; ++axis) {
        const double last = p[6 + axis] - 1;
        if (!(position[axis] >= 0 && position[axis] <= last)) return {};
        cell[axis] = (int)(position[axis] < last ? position[axis] : last - 1);
    }
    const CubicWeights u(position[0] - cell[0]), v(position[1] - cell[1]), w(position[2] - cell[2]);
    const size_t row = (size_t)p[8] + 2, sheet = row * ((size_t)p[7] + 2);
    PointField field = {};
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) {
            const Point* const nodes = source.table + (cell[0] + i) * sheet + (cell[1] + j) * row + cell[2];
            Point line = {0, 0, 0}, slope = line;
            for (int k = 0; k < 4; ++k) line += w.value[k] * nodes[k], slope += w.slope[k] * nodes[k];
            field.h += u.value[i] * v.value[j] * line;
            field.dx += u.slope[i] * v.value[j] / p[3] * line;
            field.dy += u.value[i] * v.slope[j] / p[4] * line;
            field.dz += u.value[i] * v.value[j] / p[5] * slope;
        }
    return source.strength.x * field;
}
}
