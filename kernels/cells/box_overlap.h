// Share of the volume of a box inside another one: exact for boxes with parallel edges, 0 for disjoint boxes.
//
// Boxes at an angle share at most as much as each shares with the bounding box of the other one in its own frame. They
// are disjoint if their projections on an axis are: on one of the edges, or on a normal of an edge of each (separating
// axes, Gottschalk, Lin and Manocha 1996). So if the common part of the projections is smaller on normals than on
// edges, the ratio of the two is a factor of the share.
#pragma once
#include "cells/box_pair.h"

namespace warpmag {

CUDA_CALLABLE inline Number magnitude(Number x) { return larger(x, -x); }

// Volume of box i inside the bounding box of box j in the frame of i, over that of i, and the least common part of the
// projections of both on an edge of i, over the shorter projection.
struct Shares {
    Number volume, least;
};
// ``axes`` has the edges of j as columns in the frame of i.
CUDA_CALLABLE inline Shares share_in_bounds(Vector half, Vector other_half, Vector r, const Rotation<Number>& axes) {
    const Number own[3] = {half.x, half.y, half.z}, at[3] = {r.x, r.y, r.z}, zero = half.x * Real(0);
    Shares shares = {zero + 1, zero + 1};
    for (int k = 0; k < 3; ++k) {
        const auto& row = axes.rows[k];
        const Number extent =
            magnitude(row[0]) * other_half.x + magnitude(row[1]) * other_half.y + magnitude(row[2]) * other_half.z;
        const Number shorter = 2 * smaller(own[k], extent);
        const Number common = larger(smaller(own[k] + extent - magnitude(at[k]), shorter), zero);
        shares.volume *= common / (2 * own[k]);
        shares.least = smaller(shares.least, common / shorter);
    }
    return shares;
}

// Least common part of the projections of two boxes on the normals of their edges, over the shorter projection.
CUDA_CALLABLE inline Number share_across_edges(Vector half, Vector other_half, Vector r, const Rotation<Number>& axes) {
    const Number a[3] = {half.x, half.y, half.z}, b[3] = {other_half.x, other_half.y, other_half.z},
                 at[3] = {r.x, r.y, r.z}, zero = half.x * Real(0);
    const auto& q = axes.rows;
    Number least = zero + 1;
    for (int k = 0; k < 3; ++k)
        for (int l = 0; l < 3; ++l) {
            const int k1 = (k + 1) % 3, k2 = (k + 2) % 3, l1 = (l + 1) % 3, l2 = (l + 2) % 3;
            const Number own = a[k1] * magnitude(q[k2][l]) + a[k2] * magnitude(q[k1][l]);
            const Number other = b[l1] * magnitude(q[k][l2]) + b[l2] * magnitude(q[k][l1]);
            const Number common = own + other - magnitude(at[k2] * q[k1][l] - at[k1] * q[k2][l]);
            const Number share = larger(common, zero) / larger(2 * smaller(own, other), zero + Real(1e-30));
            // parallel edges have no normal
            least = 1 - q[k][l] * q[k][l] > Real(1e-4) ? smaller(least, share) : least;
        }
    return least;
}

// Share of a cell's volume inside a cell of another body, 0 to 1. A ball counts as a ball, a cell beside it as its
// inscribed one.
CUDA_CALLABLE inline Number overlap_share(const Boxes& own, const Boxes& other, const RelativePose& pose) {
    auto inscribed = [](const Boxes& b) { return b.ball ? b.radius : smaller(b.half.x, smaller(b.half.y, b.half.z)); };
    const Number zero = own.size * Real(0), d = length(pose.r);
    const Number of_balls = larger(1 - d / (inscribed(own) + inscribed(other)), zero);
    const Mask balls = own.ball | other.ball, near = d < length(own.half) + length(other.half);
    if (!any(near)) return balls ? of_balls : zero;
    const Rotation<Number> axes = rotation_of<Number>(pose.q);
    Rotation<Number> own_axes; // in the frame of the other one
    for (int k = 0; k < 3; ++k)
        for (int l = 0; l < 3; ++l) own_axes.rows[k][l] = axes.rows[l][k];
    const Shares in_own = share_in_bounds(own.half, other.half, pose.r, axes);
    const Shares in_other = share_in_bounds(other.half, own.half, to_body(axes, pose.r), own_axes);
    const Number across = share_across_edges(own.half, other.half, pose.r, axes);
    const Number least = larger(smaller(in_own.least, in_other.least), zero + Real(1e-30));
    const Number of_boxes =
        smaller(in_own.volume, in_other.volume * (other.volume / own.volume)) * smaller(across / least, zero + 1);
    return balls ? of_balls : near ? of_boxes : zero;
}
}
