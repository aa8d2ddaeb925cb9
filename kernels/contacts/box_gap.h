// Separating-axis test of two boxes, along the normals of faces and pairs of edges (Gottschalk, Lin and Manocha 1996).
// It removes most pairs whose bounding boxes overlap, and is far cheaper than Newton's narrow phase.
#pragma once
#include "contacts/ball_contacts.h"

namespace warpmag {

template <class Arrays> CUDA_CALLABLE inline bool are_boxes(const Arrays& arrays, int a, int b) {
    return arrays.kind.data[a] == BOX && arrays.kind.data[b] == BOX;
}

// Upper bound of the displacement of any point of a box in the substep [m].
template <class Arrays> CUDA_CALLABLE inline Real largest_motion(const Arrays& arrays, int box) {
    const int body = arrays.body.data[box];
    if (body < 0 || arrays.displacement.shape[0] == 0) return 0;
    const Real angle = arrays.dt * wp::length(wp::spatial_bottom(arrays.body_qd.data[body]));
    return wp::length(arrays.displacement.data[box]) + angle * wp::length(arrays.scale.data[box]);
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
    const wp::transform frame_a = arrays.frame.data[a], frame_b = arrays.frame.data[b];
    const wp::vec3 half_a = arrays.scale.data[a], half_b = arrays.scale.data[b];
    const wp::vec3 offset = wp::quat_rotate_inv(frame_a.q, frame_b.p - frame_a.p); // of the centers, in frame_a
    const Real distance = contact_distance(arrays, a, b);
    Real axis[3][3], magnitude[3][3]; // component i of axis j of box b, and its magnitude
    for (int j = 0; j < 3; ++j) {
        wp::vec3 unit(0, 0, 0);
        unit[j] = 1;
        unit = wp::quat_rotate_inv(frame_a.q, wp::quat_rotate(frame_b.q, unit));
        for (int i = 0; i < 3; ++i) axis[i][j] = unit[i], magnitude[i][j] = fabs(unit[i]);
    }
    for (int i = 0; i < 3; ++i) {
        const Real projection_b =
            half_b[0] * magnitude[i][0] + half_b[1] * magnitude[i][1] + half_b[2] * magnitude[i][2];
        if (fabs(offset[i]) - half_a[i] - projection_b > distance) return true;
        const Real projection_a =
            half_a[0] * magnitude[0][i] + half_a[1] * magnitude[1][i] + half_a[2] * magnitude[2][i];
        if (fabs(offset[0] * axis[0][i] + offset[1] * axis[1][i] + offset[2] * axis[2][i]) - half_b[i] - projection_a
            > distance)
            return true;
    }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
            const Real square = 1 - magnitude[i][j] * magnitude[i][j]; // squared length of the edges' cross product
            const Real projections = half_a[i1] * magnitude[i2][j] + half_a[i2] * magnitude[i1][j]
                                     + half_b[j1] * magnitude[i][j2] + half_b[j2] * magnitude[i][j1];
            const Real gap = fabs(offset[i2] * axis[i1][j] - offset[i1] * axis[i2][j]) - projections;
            if (square > Real(1e-4) && gap > 0 && gap * gap > distance * distance * square) return true;
        }
    return false;
}
}
