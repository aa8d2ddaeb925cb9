// Mirror images of balls in flat faces of iron. images.py has the physics and the arrays.
//
// Image k of ball i is number (k + 1) · balls + i in the lines that balls write for others to read. Only its own ball
// is near it. From Python: IMAGES, the images of a ball, 0 without faces; VIEW_ROWS; EDGE, the distance from an edge
// over which an image fades; and DEEPEST_CENTER, the height of a ball's center below which it has no image.
#pragma once
#include "cells/rotation.h"
#include "near_contact/state.h"

namespace warpmag {

typedef Vec3<Real> Point3;
constexpr int NORMAL = 0, WEIGHT = 3, SLOPE = 4, RESPONSE = 7; // rows of an image's view

CUDA_CALLABLE inline Point3 point3(const Real* p) { return {p[0], p[1], p[2]}; }
CUDA_CALLABLE inline void put_point3(Real* p, Point3 v) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }
CUDA_CALLABLE inline Point3 rotated(const Rotation<Real>& r, Point3 v) {
    const auto& a = r.rows;
    return {a[0][0] * v.x + a[0][1] * v.y + a[0][2] * v.z, a[1][0] * v.x + a[1][1] * v.y + a[1][2] * v.z,
            a[2][0] * v.x + a[2][1] * v.y + a[2][2] * v.z};
}
CUDA_CALLABLE inline Point3 rotated_back(const Rotation<Real>& r, Point3 v) {
    const auto& a = r.rows;
    return {a[0][0] * v.x + a[1][0] * v.y + a[2][0] * v.z, a[0][1] * v.x + a[1][1] * v.y + a[2][1] * v.z,
            a[0][2] * v.x + a[1][2] * v.y + a[2][2] * v.z};
}
CUDA_CALLABLE inline Point3 position_of(const NearArrays& a, int i) {
    const Real* const row = a.packed + i;
    const size_t stride = a.moment_stride;
    return {row[0], row[stride], row[2 * stride]};
}

// Weight of a face for a ball whose center is over point p of its plane, and its gradient, in the frame of the body.
struct FaceWeight {
    Real value;
    Point3 slope;
};
CUDA_CALLABLE inline FaceWeight face_weight(const NearArrays& a, const int* face, Point3 p, Real radius) {
    FaceWeight weight = {1, {0, 0, 0}};
    for (int k = face[1]; k < face[2] && weight.value > 0; ++k) {
        const Real* const edge = a.face_edge + 4 * (size_t)k;
        const Point3 outward = point3(edge);
        const Real inside = (edge[3] - dot(outward, p)) / (EDGE * radius), t = inside < 1 ? inside : Real(1);
        if (!(t > 0)) return {0, {0, 0, 0}};
        const Real value = t * t * (3 - 2 * t), slope = -6 * t * (1 - t) / (EDGE * radius);
        weight.slope = value * weight.slope + (slope * weight.value) * outward;
        weight.value *= value;
    }
    return weight;
}

// Writes image k of ball i in face f, if the ball is near it. Returns whether it is.
CUDA_CALLABLE inline bool put_image(const NearArrays& a, int i, int k, int f, Real radius) {
    const int* const face = a.face + 3 * (size_t)f;
    const Real* const plane = a.face_plane + 4 * (size_t)f;
    const int* const cells = a.face_cells + 3 * face[0];
    const Rotation<Real> frame = rotation_of<Real>(a.face_rotation + 4 * (size_t)cells[0]);
    const Point3 x = position_of(a, i), local = rotated_back(frame, x - position_of(a, cells[1]));
    const Point3 p = local + point3(a.face_origin + 3 * (size_t)face[0]), normal = point3(plane);
    const Real height = dot(normal, p) - plane[3];
    if (!(height < HALF_REACH * radius && height > DEEPEST_CENTER * radius)) return false;
    const FaceWeight weight = face_weight(a, face, p, radius);
    if (!(weight.value > 0)) return false;
    const Point3 outward = rotated(frame, normal);
    const size_t image = (size_t)k * a.balls + i, line = LINE * (image + a.balls);
    Real* const view = a.image_view + VIEW_ROWS * image;
    put_point3(view + NORMAL, outward);
    view[WEIGHT] = weight.value;
    put_point3(view + SLOPE, rotated(frame, weight.slope));
    put_point3(a.positions + line, x - (2 * height) * outward);
    a.positions[line + 3] = radius, a.positions[line + 4] = 0, a.positions[line + 5] = (Real)a.kind[i];
    a.image_face[image] = f;
    return true;
}

// Finds the images of ball i: in the first IMAGES faces that are near it.
CUDA_CALLABLE inline void find_images(const NearArrays& a, int i) {
    const Real radius = a.packed[i + 3 * (size_t)a.moment_stride];
    int count = 0;
    for (int f = a.face_begin[i]; f < a.face_end[i] && count < IMAGES; ++f) count += put_image(a, i, count, f, radius);
    for (int k = 0; k < IMAGES; ++k) {
        const size_t image = (size_t)k * a.balls + i;
        if (k >= count) a.image_face[image] = -1;
        for (int c = 0; c < 6; ++c) a.image_wrench[6 * image + c] = 0;
    }
}

// Mean response (μ − 1)/(μ + 1) of the cells of a body around a point, from their differential permeability. Cells
// count up to three radii of the ball and two of their own.
CUDA_CALLABLE inline Real iron_response(const NearArrays& a, int body, Point3 foot, Real radius) {
    const size_t stride = a.moment_stride;
    const int first = a.face_cells[3 * body + 1], end = a.face_cells[3 * body + 2];
    const Number zero = Number(Real(0));
    Number total = zero, weights = zero;
    for (int c = first; c < end; c += WIDTH) {
        const int count = end - c;
        auto row = [&](int n) { return numbers_or(a.packed + n * stride + c, count, 0); };
        const Vector r = {row(0) - foot.x, row(1) - foot.y, row(2) - foot.z};
        const Number size = row(3), reach = 3 * radius + 2 * size, near = 1 - dot(r, r) / (reach * reach);
        if (!any(near > zero)) continue;
        const Number slope = numbers_or(a.cell_slope + c, count, 1), inside = larger(near, zero);
        const Vector reduced = numbers_or(a.cell_inverse_saturation + c, count, 0) * Vector{row(4), row(5), row(6)};
        const Curves curves = curves_of(a.cell_curve, a.common_curve, a.curve_tables, slope, c, count);
        const Number steep = slope * curve_steepness(dot(reduced, reduced), curves);
        const Number k = smaller(larger(steep, zero), zero + 3), weight = size * size * size * inside * inside;
        weights += weight;
        total += weight * k / (2 + Real(1.0 / 3.0) * k);
    }
    Real sum = 0, sum_of_weights = 0;
    for (int l = 0; l < WIDTH; ++l) sum += lane_of(total, l), sum_of_weights += lane_of(weights, l);
    return sum_of_weights > 0 ? sum / sum_of_weights : Real(0);
}

// Calls visit(image, ball) for the images of balls i; the threads of a group take turns.
template <class Visit> CUDA_CALLABLE inline void for_images(const NearArrays& a, int i, Visit visit) {
#if defined(__CUDA_ARCH__)
    if (IMAGES > 0) __syncwarp(group_mask());
#endif
    for (int k = share(); k < IMAGES; k += SHARES)
        for (int l = 0; l < WIDTH; ++l) {
            const size_t image = (size_t)k * a.balls + i + l;
            if (a.image_face[image] >= 0) visit(image, i + l);
        }
}

// Writes the responses of the iron behind the images of balls i.
CUDA_CALLABLE inline void store_responses(const NearArrays& a, int i) {
    for_images(a, i, [&](size_t image, int ball) {
        const Real* const to = a.positions + LINE * (image + a.balls);
        const Point3 foot = Real(0.5) * (position_of(a, ball) + point3(to));
        const int body = a.face[3 * (size_t)a.image_face[image]];
        a.image_view[VIEW_ROWS * image + RESPONSE] = iron_response(a, body, foot, to[3]);
    });
}

// Mirrors numbers 0 to 8 of a line: a traceless tensor, a vector and a charge, with the opposite sign.
CUDA_CALLABLE inline void mirror_line(const Real* from, Real* to, Point3 n, Real scale) {
    const Real xx = from[0], yy = from[1], xy = from[2], yz = from[3], zx = from[4];
    const Point3 y = {xx * n.x + xy * n.y + zx * n.z, xy * n.x + yy * n.y + yz * n.z,
                      zx * n.x + yz * n.y - (xx + yy) * n.z};
    const Real f = dot(n, y);
    auto mirrored = [&](Real own, Real n_a, Real n_b, Real y_a, Real y_b) {
        return scale * (2 * (n_a * y_b + y_a * n_b) - 4 * f * n_a * n_b - own);
    };
    to[0] = mirrored(xx, n.x, n.x, y.x, y.x);
    to[1] = mirrored(yy, n.y, n.y, y.y, y.y);
    to[2] = mirrored(xy, n.x, n.y, y.x, y.y);
    to[3] = mirrored(yz, n.y, n.z, y.y, y.z);
    to[4] = mirrored(zx, n.z, n.x, y.z, y.x);
    const Point3 v = point3(from + 5);
    put_point3(to + 5, scale * ((2 * dot(n, v)) * n - v));
    to[8] = -scale * from[8];
}

// Writes the lines of the images of balls i: their sources, scaled by the response of the iron.
CUDA_CALLABLE inline void mirror_sources(const NearArrays& a, int i) {
    for_images(a, i, [&](size_t image, int ball) {
        const Real *const view = a.image_view + VIEW_ROWS * image, *const from = a.sources + LINE * (size_t)ball;
        Real* const to = a.sources + LINE * (image + a.balls);
        const Point3 n = point3(view + NORMAL), m = point3(from + 9);
        mirror_line(from, to, n, view[RESPONSE]);
        put_point3(to + 9, view[RESPONSE] * ((2 * dot(n, m)) * n - m));
    });
}

// Writes the lines of the images of balls i: their drives, with a weight scaled by the response of the iron.
CUDA_CALLABLE inline void mirror_drives(const NearArrays& a, int i) {
    for_images(a, i, [&](size_t image, int ball) {
        const Real *const view = a.image_view + VIEW_ROWS * image, *const from = a.drives + LINE * (size_t)ball;
        Real* const to = a.drives + LINE * (image + a.balls);
        mirror_line(from, to, point3(view + NORMAL), 1);
        to[9] = view[RESPONSE] * from[9];
    });
}
}
