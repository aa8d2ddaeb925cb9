// Fields of sources about the centres of balls, by degrees, of which uneven.py makes multipoles; expansion.py has the
// points and the tables.
#pragma once
#include "applied/seen.h"
#include "applied/sources.h"

namespace warpmag {

constexpr int POINTS = 12, TENSOR_ROWS = 21, EXPANSION_ROWS = 4 * TENSOR_ROWS; // as in expansion.py
constexpr int HELD = CHUNK <= WIDTH * SHARES ? 1 : CHUNK / (WIDTH * SHARES);

// A ball, and what is seen at its CHUNK places, POINTS of which count, of which a thread has those of vector v from
// ``first`` on.
struct Ball {
    Three center;
    Real size, label;
    int moment;
    bool lit; // whether any source takes part
    Seen at[HELD];

    CUDA_CALLABLE static int first(int v) { return WIDTH * (share() + SHARES * v); }
    template <class All> CUDA_CALLABLE Vector points(const All& all, int v) const {
        const Real* const p = all.points.data + first(v);
        const Number r = Number(Real(0)) + size;
        return spread(center) + r * own_vector(p);
    }
};
template <class All> CUDA_CALLABLE inline Ball ball_at(const All& all, int i) {
    Ball ball = {{packed_at(all, 0, i), packed_at(all, 1, i), packed_at(all, 2, i)},
                 packed_at(all, 3, i),
                 packed_at(all, 7, i),
                 i,
                 false,
                 {}};
    for (int v = 0; v < HELD; ++v) ball.at[v] = nothing_seen();
    return ball;
}

// How far a source takes part, and the derivative of that by the ball's place: it fades as the ball leaves the box
// around the source.
struct Part {
    Real value;
    Three slope, beyond;
};
CUDA_CALLABLE inline Part part_of(const Ball& ball, const Pose& pose, Three middle, Three half) {
    auto past = [](Real at, Real half) { return at > half ? at - half : at < -half ? at + half : Real(0); };
    const Three r = ball.center - pose.origin;
    const Three at = pose.to_body(r) - middle;
    const Three d = {past(at.x, half.x), past(at.y, half.y), past(at.z, half.z)};
    const Three beyond = d.x * pose.x + d.y * pose.y + d.z * pose.z;
    const Real away = wp::sqrt(dot(d, d)) / ball.size, width = MAGNET_REACH_HIGH - MAGNET_REACH_LOW;
    const Real left = (MAGNET_REACH_HIGH - away) / width, t = left < 1 ? left : Real(1);
    if (!(t > 0)) return {0, {0, 0, 0}, beyond};
    const Real slope = t < 1 ? -6 * t * (1 - t) / (width * ball.size * ball.size * away) : Real(0);
    return {t * t * (3 - 2 * t), slope * beyond, beyond};
}
// Adds a field that takes part so far.
CUDA_CALLABLE inline void add_part(Seen& to, const Part& part, const Seen& s) {
    auto product = [&](Real slope, Vector v) {
        return (Number(Real(0)) + part.value) * v + (Number(Real(0)) + slope) * s.h;
    };
    to.h += (Number(Real(0)) + part.value) * s.h;
    to.x = to.x + product(part.slope.x, s.x), to.y = to.y + product(part.slope.y, s.y);
    to.z += product(part.slope.z, s.z);
}

// Adds what source s applies to the ball, unless both are of one body.
template <class All> CUDA_CALLABLE inline void add_source(const All& all, int s, Ball& ball) {
    if (all.label.data[s] == ball.label) return;
    const Real* const extent = all.extent.data + 6 * (size_t)s;
    const Pose pose = pose_from((const Real*)all.frame.data + 7 * (size_t)s);
    const Part part = part_of(ball, pose, three(extent), three(extent + 3));
    if (part.value == 0) return;
    ball.lit = true;
    for (int v = 0; v < HELD && Ball::first(v) < CHUNK; ++v) {
        const Vector x = ball.points(all, v);
        Seen seen = nothing_seen();
        for (int l = 0; l < WIDTH && Ball::first(v) + l < POINTS; ++l) {
            const FieldAt f = field_at(all, s, {lane_of(x.x, l), lane_of(x.y, l), lane_of(x.z, l)});
            set_lane(seen.h, l, f.h), set_lane(seen.x, l, f.dx), set_lane(seen.y, l, f.dy), set_lane(seen.z, l, f.dz);
        }
        add_part(ball.at[v], part, seen);
    }
}
// Adds what a permanent body does: by its closed form, from its reach on by its lattice, which keeps more digits there.
template <class All> CUDA_CALLABLE inline void add_body(const All& all, const Body& body, Ball& ball) {
    if (body.yields) return; // its moments are neighbours of the ball
    const Part part = part_of(ball, body.pose, body.middle, body.half);
    if (part.value == 0 || body.label == ball.label) return;
    ball.lit = true;
    const bool near = dot(part.beyond, part.beyond) < body.reach * body.reach;
    const Number zero = Number(Real(0)), least2 = zero + Real(0.0625) * ball.size * ball.size;
    for (int v = 0; v < HELD && Ball::first(v) < CHUNK; ++v) {
        const Vector x = ball.points(all, v);
        const Near field = near ? body.pose.to_world(field_of(body.solid, body.m, body.pose.place(x), least2, 0, 1))
                                : (INVERSE_4PI * lattice_field(all, body, x, zero, x.x != x.x, 0, 1));
        add_part(ball.at[v], part, seen_of(field));
    }
}

// Writes the tensors of degrees 2 to 4 and what their derivatives pull by.
template <class All> CUDA_CALLABLE inline void expand(const All& all, int n) {
    const auto& own = all.ball.data[n]; // moment, world, and the permanent bodies of that
    Ball ball = ball_at(all, own[0]);
    if constexpr (COILS)
        for (int k = all.list_begin.data[own[1]]; k < all.list_begin.data[own[1] + 1]; ++k)
            add_source(all, all.list.data[k], ball);
    if constexpr (SOLIDS)
        for (int b = own[2]; b < own[3]; ++b) add_body(all, body_at(all, b), ball);
    Real* const out = rows_at(all.expansion.data, EXPANSION_ROWS, own[0]);
    for (int row = 0; row < TENSOR_ROWS; ++row) {
        Number tensor = Number(Real(0));
        Vector slope = {tensor, tensor, tensor};
        for (int v = 0; ball.lit && v < HELD && Ball::first(v) < CHUNK; ++v) {
            const Real* const table = all.tables.data + 6 * CHUNK * row + Ball::first(v);
            tensor += dot(own_vector(table), ball.at[v].h);
            slope += pulled(ball.at[v], own_vector(table + 3 * CHUNK));
        }
        const Three pull = ball.lit ? added_up(slope) : Three{0, 0, 0};
        const Real rows[4] = {ball.lit ? added_up(tensor) : Real(0), pull.x, pull.y, pull.z};
        for (int c = 0; c < 4 && share() == 0; ++c)
            out[(c == 0 ? row : TENSOR_ROWS + 3 * row + c - 1) * CHUNK] = rows[c];
    }
}

// Force over μ0 of one source on the multipoles of a ball.
template <class All> CUDA_CALLABLE inline Three pull_of(const All& all, const Ball& ball) {
    if (!ball.lit) return {0, 0, 0};
    const Real* const response = rows_at(all.response.data, RESPONSE_ROWS, ball.moment);
    Vector total = nothing_seen().h;
    for (int v = 0; v < HELD && Ball::first(v) < CHUNK; ++v) {
        Vector e = nothing_seen().h;
        for (int row = 0; row < TENSOR_ROWS; ++row) {
            const Real* const table = all.tables.data + 6 * CHUNK * row + 3 * CHUNK + Ball::first(v);
            e += (Number(Real(0)) + response[row * CHUNK]) * own_vector(table);
        }
        total += pulled(ball.at[v], e);
    }
    const Real volume = INVERSE_4PI * ball.size * ball.size * ball.size;
    return volume * added_up(total);
}
}
