// Separating-axis test of two boxes, along the normals of faces and pairs of edges (Gottschalk, Lin and Manocha 1996).
// It removes most pairs whose bounding boxes overlap, and is far cheaper than Newton's narrow phase.
#pragma once
#include "contacts/ball_contacts.h"

namespace warpmag {

template <class Arrays> CUDA_CALLABLE inline bool are_boxes(const Arrays& arrays, int a, int b) {
    return arrays.kind.data[a] == BOX && arrays.kind.data[b] == BOX;
}

// Upper bound of the distance that a point of a box moves in the substep [m].
template <class Arrays> CUDA_CALLABLE inline Real largest_motion(const Arrays& arrays, int box) {
    const int body = arrays.body.data[box];
    if (body < 0 || arrays.displacement.shape[0] == 0) return 0;
    const Real turn = arrays.dt * wp::length(wp::spatial_bottom(arrays.body_qd.data[body]));
    return wp::length(arrays.displacement.data[box]) + turn * wp::length(arrays.scale.data[box]);
}

// Distance up to which contacts of two boxes are detected, with a margin for float32 rounding [m].
template <class Arrays> CUDA_CALLABLE inline Real contact_distance(const Arrays& arrays, int a, int b) {
    const Real gap = arrays.gap.data[a] + arrays.gap.data[b],
               motion = largest_motion(arrays, a) + largest_motion(arrays, b);
    const Real ahead = motion < arrays.farthest ? motion : arrays.farthest;
    const Real rounding = Real(1e-5) * (wp::length(arrays.scale.data[a]) + wp::length(arrays.scale.data[b]));
    return arrays.margin.data[a] + arrays.margin.data[b] + (gap > ahead ? gap : ahead) + rounding;
}

// True if two boxes are farther apart than the distance up to which contacts are detected.
template <class Arrays> CUDA_CALLABLE inline bool boxes_separated(const Arrays& arrays, int a, int b) {
    const wp::transform from = arrays.frame.data[a], to = arrays.frame.data[b];
    const wp::vec3 size = arrays.scale.data[a], other = arrays.scale.data[b];
    const wp::vec3 t = wp::quat_rotate_inv(from.q, to.p - from.p); // to the other center, in the first frame
    const Real distance = contact_distance(arrays, a, b);
    Real axis[3][3], part[3][3]; // component i of the other box's axis j, and its magnitude
    for (int j = 0; j < 3; ++j) {
        wp::vec3 unit(0, 0, 0);
        unit[j] = 1;
        unit = wp::quat_rotate_inv(from.q, wp::quat_rotate(to.q, unit));
        for (int i = 0; i < 3; ++i) axis[i][j] = unit[i], part[i][j] = fabs(unit[i]);
    }
    for (int i = 0; i < 3; ++i) {
        const Real other_half = other[0] * part[i][0] + other[1] * part[i][1] + other[2] * part[i][2];
        if (fabs(t[i]) - size[i] - other_half > distance) return true;
        const Real half = size[0] * part[0][i] + size[1] * part[1][i] + size[2] * part[2][i];
        if (fabs(t[0] * axis[0][i] + t[1] * axis[1][i] + t[2] * axis[2][i]) - other[i] - half > distance) return true;
    }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
            const Real square = 1 - part[i][j] * part[i][j]; // squared length of the edges' cross product
            const Real halves =
                size[i1] * part[i2][j] + size[i2] * part[i1][j] + other[j1] * part[i][j2] + other[j2] * part[i][j1];
            const Real gap = fabs(t[i2] * axis[i1][j] - t[i1] * axis[i2][j]) - halves;
            if (square > Real(1e-4) && gap > 0 && gap * gap > distance * distance * square) return true;
        }
    return false;
}
}
