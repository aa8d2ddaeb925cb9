// Choice of a world's next step after an evaluation of the field; theta_flow.py derives it.
#pragma once
#include "induction/anderson.h"
#include "induction/solve_state.h"

namespace warpmag {

constexpr int PLAIN_STEPS = DEPTH + 1; // plain steps after an accelerated step was rejected
constexpr int APART = 32;              // solves without sweeps and steps of bodies as a whole after a rejection
constexpr double WHOLE_STEP = 0.6;     // step length of balls without overlap
constexpr double SLOWEST = 20.0;       // largest error amplification by slow convergence
constexpr double LEAST = 0.01;         // lower bound of an error, as a fraction of the last change
constexpr double REMEMBERED = 0.5;     // fraction of the slowness that is kept at an evaluation
constexpr double DISTINCT = 0.01; // least change of the residual between mixtures, as a fraction of the last change
constexpr double ROUNDING = 8.0 * (sizeof(Real) == 4 ? 1.2e-7 : 2.2e-16); // residual at rounding level

// Sums over the moments of a chunk or a world: ‖M − f(H)‖², ‖f(H)‖², ⟨M − f(H), M − f(H')⟩ with H' the field changed by
// steps of bodies as a whole, ⟨φs, φb⟩ with b the applied field, ‖φr‖², ‖φ(2 − ω₁)r‖², ‖φΔs‖² of the last change and of
// the one before, ⟨φΔg, φΔg'⟩, ‖φΔg'‖², and the products of anderson.h.
enum Column { DEVIATION, GOAL, ENERGY, WORK, MERIT, LEFT, CHANGE, FORMER, FOLLOWED, EARLIER, PRODUCTS };
constexpr int COLUMNS = PRODUCTS + DEPTH + DEPTH * (DEPTH + 1) / 2; // as in solve_state.py

// Convergent step length ω = κ/k of a moment with stiffness k (2/3 + o_i), in scalars S.
template <class S, class N> CUDA_CALLABLE inline N step_length(N stiffness) {
    const N safe = S(2.0 * FLOW_STEP) / (1 + stiffness), longest = N(S(1));
    return safe < longest ? safe : longest;
}

// Step ω₁ at the beginning and the end of a solve: 1, which solves an isolated ball, or less where balls overlap.
template <class S, class N> CUDA_CALLABLE inline N whole_step(N step) {
    const N scaled = step * S(1.0 / WHOLE_STEP), whole = N(S(1));
    return scaled < whole ? scaled : whole;
}

// Stored changes from iterate to iterate: their number, and the slot of the newest.
struct History {
    int count, newest;
};

// History of a world, with the change to the present iterate.
template <class World> CUDA_CALLABLE inline History history_of(const World& world) {
    const int count = world.change_count + world.has_change;
    return {count < DEPTH ? count : DEPTH, (world.newest + world.has_change) % DEPTH};
}

// Updates the world's rate of convergence, and the gain ‖φΔs‖/‖φΔr‖ of its last change.
template <class World>
CUDA_CALLABLE inline void update_estimates(World& world, const History& history, const double* sums, double merit) {
    world.newest = history.newest;
    if (world.has_change) {
        const double change = sums[PRODUCTS + matrix_column(0, 0)];
        world.gain[history.newest] = change > 0.0 ? wp::sqrt(sums[CHANGE] / change) : 0.0;
        const double former = history.count > 1 ? sums[PRODUCTS + matrix_column(1, 1)] : 0.0;
        if (former > 0.0) world.gain[slot_of(history.newest, 1)] = wp::sqrt(sums[FORMER] / former);
    }
    if (world.best < 0.0) return;
    const double reduction = 1.0 - merit / world.best;
    const double slowness = reduction > 1.0 / (1.0 + SLOWEST) ? 1.0 / reduction - 1.0 : SLOWEST;
    const double before = REMEMBERED * world.slowness;
    world.slowness = slowness > before ? slowness : before;
}

// Chooses the mixture of the next step. Returns false if the last step must be rejected.
template <class World>
CUDA_CALLABLE inline bool mix(World& world, const History& history, const double* sums, double merit, bool finite) {
    const bool first = world.best < 0.0;
    world.is_best = 0;
    // Plain steps descend in energy even where the merit grows, so only accelerated steps are checked.
    if (!finite || (!first && world.plain_steps == 0 && merit > 2.0 * world.best)) {
        world.plain_steps = PLAIN_STEPS;
        world.apart = APART;
        return false;
    }
    if (world.plain_steps > 0) world.plain_steps -= 1;
    const bool descended = world.plain_steps == 0 && history.count == DEPTH && world.used == 0;
    if (first || merit < world.best || descended) {
        world.best = merit;
        world.is_best = 1;
        world.plain_steps = 0;
    }
    world.used = world.plain_steps > 0 ? 0 : history.count;
    world.alpha = solve_anderson(sums + PRODUCTS, world.used);
    return true;
}

// Whether a solve is long: then few stored changes must tell about all earlier ones, so they are those of mixtures.
template <class World> CUDA_CALLABLE inline bool is_long(const World& world) { return world.evaluations >= DEPTH; }

// Whether the residual of the next mixture differs from that of the last one, by (1 − α₀) Δr₀ − Σ α_a Δr_a, a > 0.
// Where two moments or so are unknown it does not, and their quotient would be one of rounding errors.
template <class World> CUDA_CALLABLE inline bool is_distinct(const World& world, const double* sums) {
    double square = 0.0;
#pragma unroll
    for (int a = 0; a < DEPTH; ++a) {
        const double first = a == 0 ? 1.0 - world.alpha[0] : -world.alpha[a];
#pragma unroll
        for (int b = a; b < DEPTH; ++b) {
            if (b >= world.used) continue;
            const double second = b == 0 ? 1.0 - world.alpha[0] : -world.alpha[b];
            square += (a == b ? 1.0 : 2.0) * first * second * sums[PRODUCTS + matrix_column(a, b)];
        }
    }
    return square > DISTINCT * DISTINCT * sums[PRODUCTS + matrix_column(0, 0)];
}

// Error after the last step over the residual before it, by the estimate of theta_flow.py.
template <class World>
CUDA_CALLABLE inline double amplification(const World& world, const double* sums, double merit, bool mixed) {
    double removed = 0.0, gain = 0.0;
#pragma unroll
    for (int a = 0; a < DEPTH; ++a) {
        if (!mixed || a >= world.used) continue;
        const double slot_gain = world.gain[slot_of(world.newest, a)];
        removed += world.alpha[a] * sums[PRODUCTS + a]; // ‖φr‖² − ‖φr̄‖²
        gain = slot_gain > gain ? slot_gain : gain;
    }
    const double all = merit * merit, fraction = removed > 0.0 ? removed < all ? removed / all : 1.0 : 0.0;
    const double step = merit > 0.0 ? wp::sqrt(sums[LEFT]) / merit : 1.0; // λ
    const double left = is_long(world) && gain > step ? gain : step;
    const double size = left * wp::sqrt(1.0 - fraction) + gain * wp::sqrt(fraction);
    const double slow = world.slowness > 1.0 ? world.slowness * size : size;
    const double least = merit > 0.0 ? LEAST * wp::sqrt(sums[CHANGE]) / merit : 0.0;
    const double error = slow > least ? slow : least;
    return error > 1.0 ? error : 1.0;
}

// Error of a solution whose residual is amplified by a factor: of the magnetization, or with cells in the energy norm.
CUDA_CALLABLE inline double solution_error(bool has_cells, const double* sums, double residual, double factor) {
    if (!has_cells || !(sums[WORK] > 0.0)) return factor * residual;
    const double energy = sums[ENERGY] > 0.0 ? wp::sqrt(factor * sums[ENERGY] / sums[WORK]) : 0.0;
    return energy > residual ? energy : residual;
}

// Chooses a world's next step from its sums.
template <class State> CUDA_CALLABLE inline void choose_step(State& state, int w, const double* sums) {
    auto& world = state.worlds.data[w];
    const History history = history_of(world);
    const double merit = wp::sqrt(sums[MERIT]), residual = relative_residual(sums[DEVIATION], sums[GOAL]);
    const bool finite = wp::isfinite(merit), failed = world.best < 0.0 && !finite;
    const bool no_field = world.evaluations == 0 && !world.in_field;
    update_estimates(world, history, sums, merit);
    const bool mixed = mix(world, history, sums, merit, finite);
    const double factor = residual > ROUNDING ? amplification(world, sums, merit, mixed) : 1.0;
    const double error = solution_error(state.has_cells.data[w], sums, residual, factor);
    const bool done = check_convergence(state, w, residual, error, finite, failed);
    if (done) {
        const double followed = sums[EARLIER] > 0.0 ? sums[FOLLOWED] / sums[EARLIER] : 0.0;
        world.ahead = followed < 0.0 ? 0.0 : followed > 1.0 ? 1.0 : followed;
    }
    world.changes_mixture = world.has_change && world.is_best && is_long(world) && is_distinct(world, sums);
    int next = done || world.plain_steps > 0 || world.apart > 0 ? STEP : STEP_AND_SWEEP;
    if (!mixed) next = STEP_FROM_BEST;
    if (done && !finite) next = NOTHING;
    if (no_field && !done) next = DEMAGNETIZE;
    world.next = next;
    world.has_change = next >= STEP;
    world.change_count = next >= STEP ? history.count : 0;
}
}
