// Expansion of the sources' fields about the centers of balls. near_contact computes the multipoles that they induce;
// expansion.py has the equations, points and tables.
#pragma once
#include "applied/sources.h"
#include "applied/target_field.h"

namespace warpmag {

constexpr int POINTS = 12, TENSOR_ROWS = 21, EXPANSION_ROWS = 4 * TENSOR_ROWS; // as in expansion.py
constexpr int VECTORS_PER_THREAD = CHUNK <= WIDTH * SHARES ? 1 : CHUNK / (WIDTH * SHARES);

// A ball, and the sources' field at its CHUNK points. Points beyond the first POINTS are padding. A thread holds
// VECTORS_PER_THREAD vectors of points.
struct Ball {
    Real3 center;
    Real radius, label;
    int moment;
    bool in_field; // true if any source acts on the ball
    TargetField fields[VECTORS_PER_THREAD];

    // First point of vector v.
    CUDA_CALLABLE static int first(int v) { return WIDTH * (share() + SHARES * v); }
    template <class Arrays> CUDA_CALLABLE Vector points(const Arrays& arrays, int v) const {
        const Real* const p = arrays.balls.points.data + first(v);
        const Number r = Number(Real(0)) + radius;
        return broadcast(center) + r * own_vector(p);
    }
};
template <class Arrays> CUDA_CALLABLE inline Ball ball_at(const Arrays& arrays, int i) {
    Ball ball = {packed_real3(arrays, 0, i), packed_at(arrays, 3, i), packed_at(arrays, 7, i), i, false, {}};
    for (int v = 0; v < VECTORS_PER_THREAD; ++v) ball.fields[v] = zero_target_field();
    return ball;
}

// Weight of the field of a source in a box at a ball; its unit is the ball's radius.
CUDA_CALLABLE inline SourceFade ball_fade(const Ball& ball, const Frame& frame, Real3 center, Real3 half) {
    return fade_of(ball.center, ball.radius, MAGNET_REACH_LOW, MAGNET_REACH_HIGH, frame, center, half);
}
// Adds w H, and its derivatives w ∂H + ∂w H.
CUDA_CALLABLE inline void add_faded(TargetField& to, const SourceFade& fade, const TargetField& s) {
    auto product = [&](Real slope, Vector v) {
        return (Number(Real(0)) + fade.weight) * v + (Number(Real(0)) + slope) * s.h;
    };
    to.h += (Number(Real(0)) + fade.weight) * s.h;
    to.x = to.x + product(fade.slope.x, s.x), to.y = to.y + product(fade.slope.y, s.y);
    to.z += product(fade.slope.z, s.z);
}

// Adds the field of coil or map s, unless it belongs to the ball's body.
template <class Arrays> CUDA_CALLABLE inline void add_coil(const Arrays& arrays, int s, Ball& ball) {
    if (arrays.coils.label.data[s] == ball.label) return;
    const Real* const extent = arrays.coils.extent.data + 6 * (size_t)s;
    const Frame frame = frame_of((const Real*)arrays.coils.frame.data + 7 * (size_t)s);
    const SourceFade fade = ball_fade(ball, frame, real3(extent), real3(extent + 3));
    if (fade.weight == 0) return;
    ball.in_field = true;
    for (int v = 0; v < VECTORS_PER_THREAD && Ball::first(v) < CHUNK; ++v) {
        const Vector x = ball.points(arrays, v);
        TargetField field = zero_target_field();
        for (int l = 0; l < WIDTH && Ball::first(v) + l < POINTS; ++l) {
            const PointField f = field_at(arrays, s, {lane_of(x.x, l), lane_of(x.y, l), lane_of(x.z, l)});
            set_lane(field.h, l, f.h), set_lane(field.x, l, f.dx);
            set_lane(field.y, l, f.dy), set_lane(field.z, l, f.dz);
        }
        add_faded(ball.fields[v], fade, field);
    }
}
// Adds the field of a permanent body: the closed form within the body's reach, else the field of its moments. Far away
// the closed form would lose digits by cancellation.
template <class Arrays>
CUDA_CALLABLE inline void add_body(const Arrays& arrays, const PermanentBody& body, Ball& ball) {
    if (body.responds) return; // its moments are neighbors of the ball already
    const SourceFade fade = ball_fade(ball, body.frame, body.box_center, body.box_half);
    if (fade.weight == 0 || body.label == ball.label) return;
    ball.in_field = true;
    const bool near = dot(fade.offset, fade.offset) < body.reach * body.reach;
    const Number zero = Number(Real(0)), least2 = zero + Real(0.0625) * ball.radius * ball.radius;
    for (int v = 0; v < VECTORS_PER_THREAD && Ball::first(v) < CHUNK; ++v) {
        const Vector x = ball.points(arrays, v);
        const Vector at = body.frame.point_to_body(x);
        const CurlFreeField field = near ? closed_form(body, at, least2, 0, 1) : moments_field(arrays, body, at, 0, 1);
        add_faded(ball.fields[v], fade, target_field(body.frame.to_world(field)));
    }
}

// Writes the tensors b of degrees 2 to 4, and their gradients. The product of the gradients and the ball's response is
// the force on the ball.
template <class Arrays> CUDA_CALLABLE inline void expand(const Arrays& arrays, int n) {
    const auto& row = arrays.balls.ball.data[n]; // moment, world, and the range of permanent bodies in that world
    Ball ball = ball_at(arrays, row[0]);
    if constexpr (COILS)
        for (int k = arrays.coils.list_begin.data[row[1]]; k < arrays.coils.list_begin.data[row[1] + 1]; ++k)
            add_coil(arrays, arrays.coils.list.data[k], ball);
    if constexpr (SOLIDS)
        for (int b = row[2]; b < row[3]; ++b) add_body(arrays, body_at(arrays, b), ball);
    Real* const out = rows_at(arrays.balls.expansion.data, EXPANSION_ROWS, row[0]);
    for (int component = 0; component < TENSOR_ROWS; ++component) {
        Number tensor = Number(Real(0));
        Vector slope = {tensor, tensor, tensor};
        for (int v = 0; ball.in_field && v < VECTORS_PER_THREAD && Ball::first(v) < CHUNK; ++v) {
            const Real* const table = arrays.balls.tables.data + 6 * CHUNK * component + Ball::first(v);
            tensor += dot(own_vector(table), ball.fields[v].h);
            slope += gradient_dot(ball.fields[v], own_vector(table + 3 * CHUNK));
        }
        const Real3 force = ball.in_field ? total_of(slope) : Real3{0, 0, 0};
        const Real rows[4] = {ball.in_field ? total_of(tensor) : Real(0), force.x, force.y, force.z};
        for (int c = 0; c < 4 && share() == 0; ++c)
            out[(c == 0 ? component : TENSOR_ROWS + 3 * component + c - 1) * CHUNK] = rows[c];
    }
}

// Force/μ0 of one source on the multipoles of a ball.
template <class Arrays> CUDA_CALLABLE inline Real3 multipole_force(const Arrays& arrays, const Ball& ball) {
    if (!ball.in_field) return {0, 0, 0};
    const Real* const response = rows_at(arrays.balls.response.data, RESPONSE_ROWS, ball.moment);
    Vector total = zero_target_field().h;
    for (int v = 0; v < VECTORS_PER_THREAD && Ball::first(v) < CHUNK; ++v) {
        Vector e = zero_target_field().h;
        for (int row = 0; row < TENSOR_ROWS; ++row) {
            const Real* const table = arrays.balls.tables.data + 6 * CHUNK * row + 3 * CHUNK + Ball::first(v);
            e += (Number(Real(0)) + response[row * CHUNK]) * own_vector(table);
        }
        total += gradient_dot(ball.fields[v], e);
    }
    const Real volume = INVERSE_4PI * ball.radius * ball.radius * ball.radius;
    return volume * total_of(total);
}
}
