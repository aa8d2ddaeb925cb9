// The accelerated θ flow (Kim and Han 2022, Eqs. 8, 9 and 11, exact in time), in passes over the inducible moments.
// theta_flow.py has its equations; theta_step.h chooses the next step of a world.
//
// On a CPU a pass works on a vector of moments of one world; on a GPU a group of threads works on one moment. Takes
// CAPACITY, CONTACT, DEPTH, FLOW_STEP, GROUP, INVERSE_4PI and OVERLAP_DEMAGNETIZATION from Python. ``State`` is the
// struct of solve_state.py.
#pragma once
#include "induction/spans.h"
#include "induction/theta_step.h"
#include "material/curves.h"
#include "pairs/neighbor_lists.h"
#include "shared/active.h"
#include "shared/block_sum.h"
#include "shared/group.h"
#include "shared/team.h"

namespace warpmag {

// Step length of a sweep over that of a step: long chains of balls converge faster above 1.
constexpr double SWEEP_STEP = 1.4;

enum Pass { START, FIRST_SWEEP, LAST_SWEEP, MEASURE, CHOOSE, ADVANCE }; // as in theta_flow.py

struct Material {
    Number saturation, slope;
    Curves curves;
};
// Share of a magnetization that errors are relative to: 1, or k for a permanent moment that responds, because its
// remanence is not induced.
CUDA_CALLABLE inline Number induced_share(const Material& material) {
    const Number full = material.slope * 0 + 1;
#if !defined(__CUDA_ARCH__)
    if (material.curves.common == MIXED) return mask_of(material.curves.each == Index(LINEAR)) ? material.slope : full;
#endif
    return material.curves.common == LINEAR ? material.slope : full;
}
template <class State> CUDA_CALLABLE inline Material material_of(const State& state, const Span& at) {
    const Number slope = numbers_or(entries(state.slope, at), at.count, 1);
    return {numbers_or(entries(state.saturation, at), at.count, 1), slope,
            curves_of(state.curve.data, state.common_curve, state.curve_tables.data, slope, at.i, at.count)};
}

// Positions and radii [m].
template <class State> CUDA_CALLABLE inline Four balls_at(const State& state, const Span& at) {
    Number x[4];
    for (int c = 0; c < 4; ++c) x[c] = numbers_or(entries(state.packed, at, c), at.count, 0);
    return {x[0], x[1], x[2], x[3]};
}

// Moments [A·m²] of balls of given radii [m] for dual variables s.
CUDA_CALLABLE inline Vector moments_of(Material material, Number radius, Vector s) {
    const Number volume = Real(4.18879020478639) * radius * radius * radius;
    return volume * material.saturation * curve_ratio(length(s), material.curves) * s;
}

template <class State> CUDA_CALLABLE inline void store_moments(State& state, const Span& at, Vector m) {
    set(state.moments, at, m);
    put_first(entries(state.packed, at, 4), at.count, m.x);
    put_first(entries(state.packed, at, 5), at.count, m.y);
    put_first(entries(state.packed, at, 6), at.count, m.z);
}

// True if moments i and j act on each other as balls in sweeps. Those of some bodies do not: few moments in place of a
// body, and bodies with steps of their own.
template <class State> CUDA_CALLABLE inline bool are_balls(const State& state, int i, int j) {
    const Real* const labels = (const Real*)((const char*)state.packed.data + 7 * (size_t)state.packed.strides[0]);
    return labels[i] != labels[j] || state.within_body.data[i] > 0;
}

// Calls visit(rows, mask) for the inducible neighbors of moments. A moment whose list overflowed has no neighbors.
#if defined(__CUDA_ARCH__)
template <class State, class Visit>
CUDA_CALLABLE inline void visit_listed(const State& state, const Span& at, Visit visit) {
    const int* const list = state.neighbor.data + (size_t)CAPACITY * at.i;
    const int count = state.neighbor_count.data[at.i];
    for (int s = share(); s < (count > CAPACITY ? 0 : count); s += SHARES) {
        const int j = list[s], row = j - at.i + at.row;
        if (j >= at.begin && j < at.end && are_balls(state, at.i, j)) visit(&row, true);
    }
}
template <class State, class Visit>
CUDA_CALLABLE inline void visit_neighbors(const State& state, const Span& at, Visit visit) {
    if (state.near_count.data[at.row] > 0) visit_listed(state, at, visit);
}

// Counts the neighbors of a moment: the cells of most bodies have none, but long lists.
template <class State> CUDA_CALLABLE inline void list_neighbors(State& state, const Span& at) {
    int count = 0;
    visit_listed(state, at, [&](const int*, Mask) { ++count; });
    count = group_count(count);
    if (share() == 0) state.near_count.data[at.row] = count;
    __syncwarp(group_mask());
}
#else
template <class State, class Visit> inline void visit_neighbors(const State& state, const Span& at, Visit visit) {
    Index self;
    for (int l = 0; l < WIDTH; ++l) self[l] = at.row + l;
    for (int s = 0; s < state.near_count.data[at.row / WIDTH]; ++s) {
        const int* const rows = list_at(state.near.data, CAPACITY, s, at.row);
        visit(rows, mask_of(indices(rows) != self));
    }
}

// Writes the neighbor lists of a vector of moments side by side. Shorter lists are padded with the moment itself.
template <class State> inline void list_neighbors(State& state, const Span& at) {
    int* const lists = list_at(state.near.data, CAPACITY, 0, at.row);
    int counts[WIDTH] = {};
    for (int l = 0; l < at.count; ++l) {
        const int i = at.i + l, length = state.neighbor_count.data[i];
        for (int s = 0; s < length && length <= CAPACITY; ++s) {
            const int j = state.neighbor.data[(size_t)CAPACITY * i + s];
            if (j >= at.begin && j < at.end && are_balls(state, i, j))
                lists[CHUNK * counts[l]++ + l] = j - at.i + at.row;
        }
    }
    const int longest = largest_count(counts);
    for (int l = 0; l < WIDTH; ++l)
        for (int s = counts[l]; s < longest; ++s) lists[CHUNK * s + l] = at.row + l;
    state.near_count.data[at.row / WIDTH] = longest;
}
#endif

// Step lengths ω of moments.
template <class State> CUDA_CALLABLE inline Number step_of(const State& state, const Span& at) {
    return numbers_or(entries(state.step, at), at.count, 1);
}

// Stiffness 2/3 + o_i + f_i of moments, with o_i = Σ_j |B_i ∩ B_j|/√(V_i V_j) the volume that balls share with others.
//
// The field energy of uniformly magnetized balls is at most ½μ0 ∫‖Σ M_i‖². The eigenvalues of the coupling therefore
// lie above 1/3 − (1 + max o_i), which is −2/3 without overlap. In the metric of 2/3 + o_i they lie above −1, since the
// matrix of shared volumes is bounded by the diagonal matrix of its row sums. The resulting step lengths converge for
// any arrangement, and are short only where balls overlap.
//
// Cells that act by tensors alone have a demagnetizing factor f_i of overlaps, too (``cells/cell_pairs.h``). Between
// cells of one size it is at most o_i. For a small cell inside a large one o_i is small, but f_i is not.
template <class State> CUDA_CALLABLE inline Number stiffness_of(const State& state, const Span& at) {
    const Real* const labels = entries(state.packed, at, 7) - at.i;
    const Mask within_body = mask_of(numbers_or(entries(state.within_body, at), at.count, 1) > Real(0));
    auto others = [=](Index i, Index j) {
        const Mask same = mask_of(collect(labels, i) == collect(labels, j));
        return !same || (within_body && mask_of(j != i));
    };
    const SharedVolumes shared = shared_volumes(state, at.i, at.count, at.begin, at.end, others);
    const Number zero = shared.over_own * Real(0), inside = shared.over_own - CONTACT;
    const Number factor = larger(shared.over_mean, smaller(inside, zero + OVERLAP_DEMAGNETIZATION));
    return Real(2.0 / 3.0) + shared.over_mean + (within_body ? zero : factor);
}

// 4π times the neighbors' field [A/m] at the last solution plus ``ahead`` times its last change.
template <class State>
CUDA_CALLABLE inline Vector extrapolated_field(const State& state, const Span& at, Four ball, Real ahead) {
    const Real* const past = (const Real*)state.past.data;
    const Vector x0 = vector_of(own_four(past, 0, at.row)), x1 = vector_of(own_four(past, 2, at.row));
    Vector total = {0, 0, 0};
    visit_neighbors(state, at, [&](const int* j, Mask listed) {
        const Four y0 = four_at(past, 0, j), y1 = four_at(past, 2, j);
        const Vector m0 = vector_of(four_at(past, 1, j)), m1 = vector_of(four_at(past, 3, j));
        Vector last = {0, 0, 0}, earlier = {0, 0, 0};
        add_pair_field(last, x0 - vector_of(y0), ball.w, y0.w, m0, listed);
        add_pair_field(earlier, x1 - vector_of(y1), ball.w, y1.w, m1, listed);
        total += (last + ahead * (last - earlier));
    });
    return group_sums(total);
}

// Starts a solve: writes step lengths, and first moments from the applied field and the last solutions.
template <class State> CUDA_CALLABLE inline void start(State& state, const Span& at) {
    if (state.searching.data[0]) list_neighbors(state, at);
    if (state.resting.data[at.world]) return;
    auto& world = state.worlds.data[at.world];
    const int warm = state.warm.data[at.world];
    const Real ahead = (Real)world.ahead;
    const Four ball = balls_at(state, at);
    const Material material = material_of(state, at);
    const Number omega = step_length<Real>(material.slope * stiffness_of(state, at));
    Vector near = {0, 0, 0};
    if (warm == STEADY) near = extrapolated_field(state, at, ball, ahead);
    if (share() != 0) return;
    put_first(entries(state.step, at), at.count, omega);
    const Vector h0 = get(state.h0, at);
    if (any(mask_of(length(h0) > Real(0)))) raise_flag(world.in_field);
    Vector s = get(state.s, at);
    // θ flow with κ = k from zero magnetization: exact for an isolated ball
    if (warm == 0) s = (whole_step<Real>(omega) * material.slope / material.saturation) * h0;
    if (warm == STEADY) s = s + ahead * (get(state.past_g, at) - get(state.past_g, at, 1));
    set(state.s, at, s);
    const Vector m = moments_of(material, ball.w, s);
    store_moments(state, at, m);
    put_four(state.now.data, 0, at.row, ball);
    put_four(state.swept.data, 0, at.row, ball);
    if (warm != STEADY) return;
    const Vector field = get(state.past_field, at), change = field - get(state.past_field, at, 1);
    const Vector far = field + ahead * change - INVERSE_4PI * near;
    set(state.mixed_g, at, material.slope / material.saturation * (h0 + far));
    set(state.mixed_moment, at, {0, 0, 0});
    put_four(state.now.data, 1, at.row, {m.x, m.y, m.z, 0});
}

// Sweeps once over the neighbors' changes of moment, s ← s + ω' (ḡ + (k/Ms) G' ΔM − s). The last sweep stores moments.
template <class State> CUDA_CALLABLE inline void sweep(State& state, const Span& at, bool last) {
    const auto& world = state.worlds.data[at.world];
    if (world.next != STEP_AND_SWEEP) return;
    Real* const from = last ? state.swept.data : state.now.data;
    const Four ball = own_four(from, 0, at.row);
    Vector h = {0, 0, 0};
    visit_neighbors(state, at, [&](const int* j, Mask listed) {
        const Four other = four_at(from, 0, j), change = four_at(from, 1, j);
        add_pair_field(h, vector_of(ball) - vector_of(other), ball.w, other.w, vector_of(change), listed);
    });
    h = group_sums(h);
    if (share() != 0) return;
    const Material material = material_of(state, at);
    const Vector s = get(state.s, at);
    const Vector g = get(state.mixed_g, at) + INVERSE_4PI * material.slope / material.saturation * h;
    const Number step = smaller(Real(SWEEP_STEP) * step_of(state, at), Number(Real(1)));
    const Vector next = s + step * (g - s);
    set(state.s, at, next);
    const Vector m = moments_of(material, ball.w, next);
    if (last) {
        store_moments(state, at, m);
    } else {
        const Vector change = m - get(state.mixed_moment, at);
        put_four(state.swept.data, 1, at.row, {change.x, change.y, change.z, 0});
    }
}

CUDA_CALLABLE inline Wide wide_dot(Vector a, Vector b) {
    return wide(a.x) * wide(b.x) + wide(a.y) * wide(b.y) + wide(a.z) * wide(b.z);
}

// Stores an iterate and its residual r = g − s, and calls put(column, value) with the moments' terms of the world's
// sums.
template <class State, class Put> CUDA_CALLABLE inline void measure(State& state, const Span& at, Put put) {
    const auto& world = state.worlds.data[at.world];
    const History history = history_of(world);
    const Material material = material_of(state, at);
    const Vector s = get(state.s, at), g = material.slope / material.saturation * get(state.h, at);
    const Vector r = g - s;
    Vector step = {0, 0, 0};
    if (world.has_change) {
        step = s - get(state.mixed_s, at);
        set(state.history_s, at, step, history.newest);
        set(state.history_r, at, r - get(state.mixed_r, at), history.newest);
    }
    set(state.mixed_s, at, s);
    set(state.mixed_r, at, r);
    const Number length_s = length(s), length_g = length(g);
    // M(s) = ratio_s s
    const Number ratio_s = material.saturation * curve_ratio(length_s, material.curves);
    const Number ratio_g = material.saturation * curve_ratio(length_g, material.curves);
    // lengths, not squares: the square of 1e-20 A/m underflows float32
    const Wide goal = wide(induced_share(material) * ratio_g * length_g);
    const Vector changed = ratio_g * g - ratio_s * s;
    Vector deviation = changed;
    if (state.h_change.data != nullptr && world.apart == 0) {
        const Vector own = g - material.slope / material.saturation * get(state.h_change, at);
        deviation = material.saturation * curve_ratio(length(own), material.curves) * own - ratio_s * s;
    }
    const Wide size = wide(length(deviation));
    const Wide weight = wide(length_s > length_g ? ratio_s : ratio_g), square = weight * weight;
    const Wide merit = weight * wide(length(r));
    put(DEVIATION, size * size);
    put(GOAL, goal * goal);
    put(ENERGY, wide_dot(deviation, changed));
    const Number share = induced_share(material);
    put(WORK, wide(share * share) * square * wide_dot(s, material.slope / material.saturation * get(state.h0, at)));
    const Wide left = merit * wide(2 - whole_step<Real>(step_of(state, at)));
    put(MERIT, merit * merit);
    put(LEFT, left * left);
    put(CHANGE, square * wide_dot(step, step));
    const Vector former = history.count > 1 ? get(state.history_s, at, slot_of(history.newest, 1)) : step;
    put(FORMER, square * wide_dot(former, former));
    const Vector past = get(state.past_g, at), earlier = past - get(state.past_g, at, 1);
    put(FOLLOWED, square * wide_dot(g - past, earlier));
    put(EARLIER, square * wide_dot(earlier, earlier));
    Vector change[DEPTH];
#pragma unroll
    for (int a = 0; a < DEPTH; ++a) {
        if (a >= history.count) continue;
        change[a] = get(state.history_r, at, slot_of(history.newest, a));
        put(PRODUCTS + a, square * wide_dot(change[a], r));
#pragma unroll
        for (int b = 0; b <= a; ++b) put(PRODUCTS + matrix_column(b, a), square * wide_dot(change[b], change[a]));
    }
}

// Stores the mixture of the last iterates for the start of the next solve; it is closer to the solution than the last
// iterate.
template <class State>
CUDA_CALLABLE inline void keep_solution(State& state, const Span& at, Material material, Vector mixed, Vector g) {
    const Four ball = own_four(state.now.data, 0, at.row);
    const Vector m = moments_of(material, ball.w, mixed), h = material.saturation / material.slope * g;
    Real* const past = state.past.data;
    for (int quarter = 0; quarter < 2; ++quarter) // the last solution becomes the one before
        put_four(past, 2 + quarter, at.row, own_four(past, quarter, at.row));
    put_four(past, 0, at.row, ball);
    put_four(past, 1, at.row, {m.x, m.y, m.z, 0});
    set(state.past_field, at, get(state.past_field, at), 1);
    set(state.past_g, at, get(state.past_g, at), 1);
    set(state.past_field, at, h - get(state.h0, at));
    set(state.past_g, at, g);
}

// Stores a mixture of iterates and its residual, and the change to it from the last mixture where they are distinct.
template <class State> CUDA_CALLABLE inline void keep_mixture(State& state, const Span& at, Vector mixed, Vector r) {
    const auto& world = state.worlds.data[at.world];
    if (!world.changes_mixture) return;
    const int newest = world.newest;
    set(state.history_s, at, get(state.history_s, at, newest) + (mixed - get(state.mixed_s, at)), newest);
    set(state.history_r, at, get(state.history_r, at, newest) + (r - get(state.mixed_r, at)), newest);
    set(state.mixed_s, at, mixed);
    set(state.mixed_r, at, r);
}

// Takes the world's chosen step: s̄ = s − Σ α_j Δs_j, r̄ = r − Σ α_j Δr_j, s ← s̄ + ω r̄. The newest change becomes that
// from mixture to mixture.
template <class State> CUDA_CALLABLE inline void advance(State& state, const Span& at) {
    const auto& world = state.worlds.data[at.world];
    if (world.next == NOTHING) return;
    Vector mixed = {0, 0, 0}, r = {0, 0, 0};
    if (world.next == STEP_FROM_BEST) {
        mixed = get(state.best_s, at);
        r = get(state.best_r, at);
    } else if (world.next != DEMAGNETIZE) {
        mixed = get(state.mixed_s, at);
        r = get(state.mixed_r, at);
        if (world.is_best) {
            set(state.best_s, at, mixed);
            set(state.best_r, at, r);
        }
        for (int a = 0; a < world.used; ++a) {
            const int slot = slot_of(world.newest, a);
            const Real alpha = (Real)world.alpha[a];
            mixed -= alpha * get(state.history_s, at, slot);
            r -= alpha * get(state.history_r, at, slot);
        }
        keep_mixture(state, at, mixed, r);
    }
    const Number omega = step_of(state, at), whole = whole_step<Real>(omega);
    const Vector g = mixed + r, next = mixed + omega * r;
    const Material material = material_of(state, at);
    set(state.s, at, next);
    // A converged world returns moments and field of a whole step, on the curve; s starts the next solve.
    const bool ended = !world.active;
    const Vector result = ended ? (mixed + whole * r) : next;
    const Number radius = numbers_or(entries(state.packed, at, 3), at.count, 0);
    const Vector m = moments_of(material, radius, result);
    store_moments(state, at, m);
    if (ended) {
        set(state.h, at, material.saturation / material.slope * result);
        return keep_solution(state, at, material, mixed, g);
    }
    if (world.next != STEP_AND_SWEEP) return;
    const Vector before = moments_of(material, radius, mixed), change = m - before;
    set(state.mixed_g, at, g);
    set(state.mixed_moment, at, before);
    put_four(state.now.data, 1, at.row, {change.x, change.y, change.z, 0});
}

#if defined(__CUDA_ARCH__)
// Sweeps over the n-th of the moments whose worlds do not rest.
template <class State> CUDA_CALLABLE inline void sweep_moment(State& state, int n, bool last) {
    if (n == 0 && share() == 0) state.condition.data[0] = 0; // worlds that iterate on set it again
    const int row = active_item(state.active, n);
    if (row >= 0) sweep(state, span_at(state, row), last);
}
template <class State> CUDA_CALLABLE inline void advance_moment(State& state, int n) {
    const int row = active_item(state.active, n);
    if (row >= 0) advance(state, span_at(state, row));
}

// Terms of the moment at ``row`` in the sums of its world.
template <class State> CUDA_CALLABLE inline wp::vec_t<COLUMNS, double> world_sums(State& state, int row) {
    wp::vec_t<COLUMNS, double> sums;
    measure(state, span_at(state, row), [&](int column, Wide value) { sums[column] = value; });
    return sums;
}
#else
// Writes the sums of a vector of moments.
template <class State> inline void measure_vector(State& state, const Span& at) {
    double* const sums = state.sums.data + (size_t)COLUMNS * (at.row / WIDTH);
    for (int column = 0; column < COLUMNS; ++column) sums[column] = 0;
    measure(state, at, [=](int column, Wide lanes) {
#pragma clang fp reassociate(on)
        double total = 0;
        for (int l = 0; l < WIDTH; ++l) total += lanes[l];
        sums[column] = total;
    });
}

// Adds up the sums of a world's vectors, and chooses its next step.
template <class State> inline void choose_for_world(State& state, int w) {
    constexpr int VECTORS = CHUNK / WIDTH;
    double total[COLUMNS] = {};
    for (int v = VECTORS * state.chunk_begin.data[w]; v < VECTORS * state.chunk_begin.data[w + 1]; ++v)
        for (int column = 0; column < COLUMNS; ++column) total[column] += state.sums.data[(size_t)COLUMNS * v + column];
    choose_step(state, w, total);
}

// Runs one pass for a vector of moments.
template <class State> inline void run_pass(State& state, int pass, int row) {
    const Span at = span_at(state, row);
    if (at.count == 0) return;
    auto& world = state.worlds.data[at.world];
    if (pass == START) {
        start(state, at);
        if (row == CHUNK * state.chunk_begin.data[at.world]) begin_world(state, at.world);
    } else if (pass == FIRST_SWEEP || pass == LAST_SWEEP) {
        if (row == 0) state.condition.data[0] = 0; // worlds that iterate on set it again
        sweep(state, at, pass == LAST_SWEEP);
    } else if (pass == MEASURE) {
        if (world.active) measure_vector(state, at);
    } else if (pass == ADVANCE) {
        advance(state, at);
    } else if (row == CHUNK * state.chunk_begin.data[at.world]) {
        if (world.active) choose_for_world(state, at.world);
        else world.next = NOTHING;
    }
}

template <class State> inline void theta_flow(int first, int last, int threads, Word* team, State& state) {
    run_passes(team, threads, first, last, CHUNK * state.chunk.shape[0], WIDTH,
               [&](int pass, int row) { run_pass(state, pass, row); });
}
#endif
}
