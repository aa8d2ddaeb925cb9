// Passes over targets and sources: fields at targets, over cells and about balls, and the reactions on sources.
//
// Fields and forces of a permanent body are corrections, less those of its moments in the system, which the sums over
// pairs contain already. On a CPU a pass works on a vector of targets or points. On a GPU a group of threads shares a
// target, a ball, a row of targets, or a body.
//
// Takes GROUP, MU0 and INVERSE_4PI from Python, and the switches COILS, SOLIDS, CELLS, BALLS and RATES. On a GPU a
// kernel runs the one pass PASS; on a CPU PASS is −1 and a kernel runs several. ``Arrays`` is the struct of sources.py.
#pragma once
#include "applied/balls.h"
#include "applied/body_pairs.h"
#include "applied/near_cells.h"
#include "applied/rates.h"
#include "shared/active.h"
#include "shared/team.h"

namespace warpmag {

enum SourcePass { AT_TARGETS, AT_POINTS, FIND_CELLS, AT_CELLS, AT_NEIGHBORS, AT_BALLS, ON_CELLS, REACT, ADD_UP };
enum RowKind { OF_TARGETS, OF_BALLS, OF_CELLS }; // both enumerations as in fields.py
constexpr int WRENCH_ROW = 7;                    // force, torque, energy

// Targets from column i on: positions, radii, labels, and bits of their kind.
constexpr int CORRECTED = 1, MAGNETIZED = 2; // bits of a target, as in sources.py
struct Targets {
    Vector x;
    Number radius, label;
    Index kind;
};
template <class Arrays> CUDA_CALLABLE inline Targets targets_at(const Arrays& arrays, int i, int lane_count) {
    const Number zero = Number(Real(0));
    const Vector none = {zero, zero, zero};
    Targets at = {none, zero, zero, {}};
    if (lane_count <= 0) return at;
    const Real* const rows = arrays.targets.packed.data + i;
    const size_t pitch = arrays.targets.packed.strides[0] / sizeof(Real);
    auto row = [=](int n) -> Number { return numbers(rows + n * pitch); };
    at = {{row(0), row(1), row(2)}, row(3), row(7), {}};
#if defined(__CUDA_ARCH__)
    at.kind = arrays.targets.kind.data[i];
#else
    for (int l = 0; l < lane_count && l < WIDTH; ++l) at.kind[l] = arrays.targets.kind.data[i + l];
#endif
    return at;
}

// Returns the field of every ``step``-th coil or map of a list at targets. Writes into ``acting`` the field and
// gradient of the coils and maps on other bodies.
template <class Arrays>
CUDA_CALLABLE inline Vector add_coil_fields(const Arrays& arrays, const int* list, int begin, int step, int count,
                                            const Targets& at, int lane_count, TargetField& acting) {
    Vector h = acting.h;
    for (int l = 0; l < WIDTH && l < lane_count; ++l) {
        Point sum = {0, 0, 0};
        PointField others = {};
        for (int k = begin; k < count; k += step) {
            const bool acts = arrays.coils.label.data[list[k]] != lane_of(at.label, l);
            if (!acts && !(lane_of(at.kind, l) & MAGNETIZED)) continue;
            const PointField f =
                field_at(arrays, list[k], {lane_of(at.x.x, l), lane_of(at.x.y, l), lane_of(at.x.z, l)});
            sum += f.h;
            if (acts) others = others + f;
        }
        set_lane(h, l, sum), set_lane(acting.h, l, others.h);
        set_lane(acting.x, l, others.dx), set_lane(acting.y, l, others.dy), set_lane(acting.z, l, others.dz);
    }
    return h;
}

// Mask of targets at which a body's field is corrected.
template <class Arrays> CUDA_CALLABLE inline Mask within_reach(const PermanentBody& body, const Targets& at) {
    return mask_of((at.kind & CORRECTED) != 0)
           & (box_distance2(body, body.frame.point_to_body(at.x)) < body.far_reach * body.far_reach);
}

// Writes the fields at a vector of targets. POINTS is true for points of a probe, false for moments.
template <bool POINTS, class Arrays> CUDA_CALLABLE inline void field_at_targets(const Arrays& arrays, int row) {
    // first target, number of targets, and range of permanent bodies in their world
    const auto& chunk = arrays.targets.chunk.data[row / CHUNK];
    const int offset = row % CHUNK, lane_count = chunk[1] - offset, i = chunk[0] + offset;
    if (lane_count <= 0) return;
    const Targets at = targets_at(arrays, i, lane_count);
    TargetField acting = zero_target_field(), of_bodies = acting;
    Vector h = acting.h, inside = h, rate = h;
    if constexpr (COILS) {
        const auto& list = arrays.targets.lists.data[row / CHUNK];
        const int* const first = arrays.coils.list.data + list[0];
        h = add_coil_fields(arrays, first, share(), SHARES, list[1] - list[0], at, lane_count, acting);
        if constexpr (RATES)
            rate = rate_of_coils(arrays, first, share(), SHARES, list[1] - list[0], i, lane_count, at.x, at.label);
    }
    if constexpr (SOLIDS)
        for (int b = chunk[2]; b < chunk[3]; ++b) {
            const PermanentBody body = body_at(arrays, b);
            const Mask near = within_reach<Arrays>(body, at);
            if (!any(near)) continue;
            const CurlFreeField whole = near_field(arrays, body, at.x, at.radius, near, share(), SHARES);
            const TargetField field =
                target_field(whole - INVERSE_4PI * lattice_field(arrays, body, at.x, at.radius, near, share(), SHARES));
            if constexpr (CELLS && !POINTS) add_where(near, of_bodies, target_field(whole));
            add_where(near, h, field.h);
            add_where(near & (at.label != body.label), acting, field);
            if constexpr (RATES)
                add_where(near & (at.label != body.label), rate,
                          rate_of_body(arrays, body, field, i, lane_count, at.x));
            if constexpr (POINTS)
                add_where(near, inside, magnetization_correction(arrays, body, at.x, share(), SHARES));
        }
    h = group_sums(h);
    acting = group_sums(acting);
    if constexpr (CELLS && !POINTS) of_bodies = group_sums(of_bodies);
    if constexpr (POINTS) inside = group_sums(inside);
    if constexpr (RATES) rate = group_sums(rate);
    if (share() != 0) return;
    const size_t column = 3 * (size_t)i;
    const Vector base = vectors((Real*)arrays.targets.base.data + column, lane_count);
    auto put = [=](const auto& array, Vector v) { put_vectors((Real*)array.data + column, lane_count, v); };
    put(arrays.targets.field, base + h);
    put(arrays.targets.acting, base + acting.h);
    put(arrays.targets.along_x, acting.x), put(arrays.targets.along_y, acting.y);
    put(arrays.targets.along_z, acting.z);
    if constexpr (CELLS && !POINTS) {
        put(arrays.targets.body_field, of_bodies.h), put(arrays.targets.body_field_x, of_bodies.x);
        put(arrays.targets.body_field_y, of_bodies.y), put(arrays.targets.body_field_z, of_bodies.z);
    }
    if constexpr (POINTS) put(arrays.targets.inside, inside);
    if constexpr (RATES) put(arrays.targets.rate, rate);
}

// Field that acts on targets, as last evaluated: that of a source that is the only one.
template <class Arrays> CUDA_CALLABLE inline TargetField acting_field(const Arrays& arrays, int i, int lane_count) {
    auto at = [&](const auto& array) { return vectors((const Real*)array.data + 3 * (size_t)i, lane_count); };
    return {at(arrays.targets.acting) - at(arrays.targets.base), at(arrays.targets.along_x), at(arrays.targets.along_y),
            at(arrays.targets.along_z)};
}

// Wrench of source s on the targets of a row. The reaction on the source is the opposite.
template <class Arrays>
CUDA_CALLABLE inline Wrench wrench_on_targets(const Arrays& arrays, int s, const PermanentBody& body, int first,
                                              int last) {
    Wrench wrench = zero_wrench();
    const bool solid = SOLIDS && s >= arrays.coils.kind.shape[0];
    const Real3 center =
        solid ? reference_point(arrays, body) : real3((const Real*)arrays.coils.frame.data + 7 * (size_t)s);
    const size_t pitch = arrays.effective.strides[0] / sizeof(Real);
    // a row of few targets: the threads share the moments and faces of the body in place of the targets
    const bool only = arrays.only.data[s], shares_body = solid && !only && last - first < SHARES;
    const int begin = shares_body ? share() : 0, step = shares_body ? SHARES : 1;
    for (int i = first + WIDTH * (share() - begin); i < last; i += WIDTH * SHARES / step) {
        const Targets at = targets_at(arrays, i, last - i);
        const Real* const m = arrays.effective.data + i;
        Mask mask = first_lanes(last - i);
        TargetField field = only ? acting_field(arrays, i, last - i) : zero_target_field();
        if constexpr (SOLIDS)
            if (solid && !only) {
                mask &= within_reach<Arrays>(body, at) & (at.label != body.label);
                if (!any(mask)) continue;
                field = target_field(field_correction(arrays, body, at.x, at.radius, mask, begin, step));
            }
        if constexpr (COILS)
            if (!solid && !only) add_coil_fields(arrays, &s, 0, 1, 1, at, last - i, field);
        add_wrench(wrench, mask, field, {numbers(m), numbers(m + pitch), numbers(m + 2 * pitch)}, at.x, center);
    }
    return wrench;
}
// Writes the reaction of a row of targets, balls or cells on its source.
template <class Arrays> CUDA_CALLABLE inline void react(const Arrays& arrays, int row) {
    const auto& range = arrays.row.data[row]; // source, range of targets, balls or cells, which of these
    const int s = range[0], coils = arrays.coils.kind.shape[0];
    if (range[1] >= range[2]) return; // of a world that rests
    const PermanentBody body = SOLIDS && s >= coils ? body_at(arrays, s - coils) : PermanentBody{};
    Real3 force = {0, 0, 0}, torque = force;
    if (range[3] == OF_TARGETS) {
        const Wrench wrench = wrench_on_targets(arrays, s, body, range[1], range[2]);
        force = total_of(wrench.force), torque = total_of(wrench.torque);
    } else if (CELLS && range[3] == OF_CELLS) {
        if constexpr (CELLS) wrench_on_cells(arrays, s - coils, arrays.only.data[s], range[1], range[2], force, torque);
    } else if constexpr (BALLS) {
        const Real3 center =
            s < coils ? real3((const Real*)arrays.coils.frame.data + 7 * (size_t)s) : reference_point(arrays, body);
        for (int n = range[1]; n < range[2]; ++n) {
            Ball ball = ball_at(arrays, arrays.balls.ball.data[n][0]);
            if constexpr (COILS)
                if (s < coils) add_coil(arrays, s, ball);
            if constexpr (SOLIDS)
                if (s >= coils) add_body(arrays, body, ball);
            const Real3 f = multipole_force(arrays, ball);
            force += f;
            torque += cross(ball.center - center, f);
        }
    }
    if (share() != 0) return;
    Real* const out = arrays.partial.data + 6 * (size_t)row;
    for (int k = 0; k < 6; ++k) out[k] = 0;
    add_force_torque(out, force, torque, -MU0);
}

// Adds the wrenches of other permanent bodies on body b.
template <class Arrays>
CUDA_CALLABLE inline void add_body_pairs(const Arrays& arrays, int b, Real (&total)[WRENCH_ROW]) {
    const PermanentBody body = body_at(arrays, b);
    const auto& world = arrays.solids.world.data[b]; // the bodies of its world
    for (int c = world[0]; c < world[1]; ++c) {
        if (c == b) continue;
        const BodyPair pair = body_pair(body, body_at(arrays, c), b < c);
        if (!pair.near) continue;
        Real3 force, torque;
        Real energy;
        body_wrench(arrays, pair, force, torque, energy);
        if (pair.first_is_q) add_force_torque(total, force, torque, MU0);
        else {
            const Real3 arm_torque = cross(reference_point(arrays, pair.q) - reference_point(arrays, pair.s), force);
            add_force_torque(total, force, torque + arm_torque, -MU0);
        }
        total[6] += Real(0.5) * MU0 * energy;
    }
}
// Adds up the wrench on source s: its rows, and other permanent bodies.
template <class Arrays> CUDA_CALLABLE inline void add_up(const Arrays& arrays, int s) {
    Real total[WRENCH_ROW] = {};
    for (int row = arrays.row_begin.data[s] + share(); row < arrays.row_begin.data[s + 1]; row += SHARES)
        for (int k = 0; k < 6; ++k) total[k] += arrays.partial.data[6 * (size_t)row + k];
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < 6; ++k) total[k] = group_sum(total[k]);
#endif
    if constexpr (SOLIDS)
        if (s >= arrays.coils.kind.shape[0]) add_body_pairs(arrays, s - arrays.coils.kind.shape[0], total);
    if (share() != 0) return;
    for (int k = 0; k < WRENCH_ROW; ++k) arrays.wrench.data[WRENCH_ROW * (size_t)s + k] = total[k];
}

// True for a cell with permanent bodies in its world, unless the world rests.
template <class Arrays> CUDA_CALLABLE inline bool has_bodies(const Arrays& arrays, int c) {
    const auto& cell = arrays.cells.cell.data[c]; // moment, body of its rotation, range of permanent bodies
    return cell[2] < cell[3];
}

#if defined(__CUDA_ARCH__)
// Item ``n`` of the pass, −1 beyond the last: of targets and cells only those whose worlds do not rest, and only cells
// near a body where these are averaged.
template <class Arrays> CUDA_CALLABLE inline int listed_item(const Arrays& arrays, int n) {
    if constexpr (PASS == AT_TARGETS) {
        const int chunk = active_item(arrays.targets.active, n / CHUNK);
        return chunk < 0 ? chunk : CHUNK * chunk + n % CHUNK;
    }
    if constexpr (PASS == AT_CELLS || PASS == ON_CELLS) return listed_cell(arrays.cells.listed, n);
    return PASS == FIND_CELLS || PASS == AT_NEIGHBORS ? active_item(arrays.cells.active, n) : n;
}
#endif

template <class Word, class Arrays>
CUDA_CALLABLE inline void apply_sources(int thread, int first, int last, int threads, Word* team,
                                        const Arrays& arrays) {
    auto run_item = [&](int pass, int i) {
        if constexpr (PASS < 0 || PASS == AT_TARGETS)
            if (pass == AT_TARGETS) field_at_targets<false>(arrays, i);
        if constexpr (PASS < 0 || PASS == AT_POINTS)
            if (pass == AT_POINTS) field_at_targets<true>(arrays, i);
        if constexpr (CELLS && (PASS < 0 || PASS == FIND_CELLS))
            if (pass == FIND_CELLS && has_bodies(arrays, i)) find_near_bodies(arrays, i);
        if constexpr (CELLS && (PASS < 0 || PASS == AT_CELLS))
            if (pass == AT_CELLS && has_bodies(arrays, i)) average_over_cell(arrays, i);
        if constexpr (CELLS && (PASS < 0 || PASS == AT_NEIGHBORS))
            if (pass == AT_NEIGHBORS && has_bodies(arrays, i)) add_differences(arrays, i);
        if constexpr (BALLS && (PASS < 0 || PASS == AT_BALLS))
            if (pass == AT_BALLS) expand(arrays, i);
        if constexpr (CELLS && (PASS < 0 || PASS == ON_CELLS))
            if (pass == ON_CELLS && has_bodies(arrays, i)) act_on_cell(arrays, i);
        if constexpr (PASS < 0 || PASS == REACT)
            if (pass == REACT) react(arrays, i);
        if constexpr (PASS < 0 || PASS == ADD_UP)
            if (pass == ADD_UP) add_up(arrays, i);
    };
#if defined(__CUDA_ARCH__)
    const int item = listed_item(arrays, thread / GROUP);
    if (item >= 0) run_item(PASS, item);
#else
    auto item_count = [&](int pass) {
        switch (pass) {
        case AT_BALLS: return arrays.balls.ball.shape[0];
        case FIND_CELLS:
        case AT_CELLS:
        case AT_NEIGHBORS:
        case ON_CELLS: return arrays.cells.cell.shape[0];
        case REACT: return arrays.row.shape[0];
        case ADD_UP: return arrays.wrench.shape[0];
        default: return CHUNK * arrays.targets.chunk.shape[0];
        }
    };
    run_passes(team, threads, first, last, item_count, first <= AT_POINTS ? WIDTH : 1, run_item);
#endif
}
}
