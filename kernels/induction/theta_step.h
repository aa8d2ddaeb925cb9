// What a world of the θ flow does after an evaluation: theta_flow.py says why.
#pragma once
#include "induction/anderson.h"
#include "induction/solve_state.h"

namespace warpmag {

constexpr int PLAIN_STEPS = DEPTH + 1; // after an accelerated step was taken back, before the next is tried
constexpr double FLOW_STEP = 0.9;      // share of the largest convergent step length that is used
constexpr double WHOLE_STEP = 0.6;     // step length of balls that do not overlap
constexpr double SLOWEST = 20.0;       // most that slow convergence makes of an error
constexpr double LEAST = 0.01;         // part of the last change that an error is at least
constexpr double REMEMBERED = 0.5;     // part of an earlier evaluation's slowness that is believed
constexpr double ROUNDING = 8.0 * (sizeof(Real) == 4 ? 1.2e-7 : 2.2e-16); // residual that steps do not lessen

// Sums over the moments of a chunk or a world: ‖M − f(H)‖², ‖f(H)‖², ‖φr‖², ‖φ(2 − ω₁)r‖², ‖φΔs‖² of the last change,
// ⟨φΔg, φΔg'⟩, ‖φΔg'‖², and those of anderson.h.
enum Column { DEVIATION, GOAL, MERIT, LEFT, CHANGE, FOLLOWED, EARLIER, PRODUCTS };
constexpr int COLUMNS = PRODUCTS + DEPTH + DEPTH * (DEPTH + 1) / 2; // as in solve_state.py

// Step length ω = κ/k of a moment of stiffness k (2/3 + o_i), with which all converge, of scalars S.
template <class S, class N> CUDA_CALLABLE inline N step_length(N stiffness) {
    const N safe = S(2.0 * FLOW_STEP) / (1 + stiffness), longest = N(S(1));
    return safe < longest ? safe : longest;
}

// Step with which a solve begins and ends: the whole one, which solves a lone ball, or shorter where balls overlap.
template <class S, class N> CUDA_CALLABLE inline N whole_step(N step) {
    const N longer = step * S(1.0 / WHOLE_STEP), whole = N(S(1));
    return longer < whole ? longer : whole;
}

// Changes from iterate to iterate that are kept: how many, and the slot of the newest.
struct History {
    int kept, newest;
};

// Those of a world once the present iterate is known.
template <class World> CUDA_CALLABLE inline History history_of(const World& world) {
    const int kept = world.kept + world.linked;
    return {kept < DEPTH ? kept : DEPTH, (world.newest + world.linked) % DEPTH};
}

// Learns from an evaluation: how fast the solve converges, and what the last change of the residual was worth in s.
template <class World>
CUDA_CALLABLE inline void learn(World& world, const History& history, const double* sums, double merit) {
    world.newest = history.newest;
    if (world.linked) {
        const double change = sums[PRODUCTS + matrix_column(0, 0)];
        world.gain[history.newest] = change > 0.0 ? wp::sqrt(sums[CHANGE] / change) : 0.0;
    }
    if (world.best < 0.0) return;
    const double left = 1.0 - merit / world.best;
    const double slowness = left > 1.0 / (1.0 + SLOWEST) ? 1.0 / left - 1.0 : SLOWEST;
    const double before = REMEMBERED * world.slowness;
    world.slowness = slowness > before ? slowness : before;
}

// Mixes the next step, unless the last one has to be taken back, which it tells by false.
template <class World>
CUDA_CALLABLE inline bool mix(World& world, const History& history, const double* sums, double merit, bool finite) {
    const bool first = world.best < 0.0;
    world.improved = 0;
    // plain steps descend in energy whatever the merit does on the way, so only accelerated ones are checked by it
    if (!finite || (!first && world.plain_steps == 0 && merit > 2.0 * world.best)) {
        world.plain_steps = PLAIN_STEPS;
        return false;
    }
    if (world.plain_steps > 0) world.plain_steps -= 1;
    const bool descended = world.plain_steps == 0 && history.kept == DEPTH && world.used == 0;
    if (first || merit < world.best || descended) {
        world.best = merit;
        world.improved = 1;
        world.plain_steps = 0;
    }
    world.used = world.plain_steps > 0 ? 0 : history.kept;
    world.alpha = solve_anderson(sums + PRODUCTS, world.used);
    return true;
}

// Error of the last step's end over the residual of the iterate that it is taken from: theta_flow.py has the estimate.
template <class World>
CUDA_CALLABLE inline double amplification(const World& world, const double* sums, double merit, bool mixed) {
    double known = 0.0, gain = 0.0;
#pragma unroll
    for (int a = 0; a < DEPTH; ++a) {
        if (!mixed || a >= world.used) continue;
        const double one = world.gain[slot_of(world.newest, a)];
        known += world.alpha[a] * sums[PRODUCTS + a]; // of ‖φr‖²
        gain = one > gain ? one : gain;
    }
    const double all = merit * merit, part = known > 0.0 ? known < all ? known / all : 1.0 : 0.0;
    const double size = merit > 0.0 ? wp::sqrt(sums[LEFT] * (1.0 - part)) / merit + gain * wp::sqrt(part) : 1.0;
    const double slow = world.slowness > 1.0 ? world.slowness * size : size;
    const double least = merit > 0.0 ? LEAST * wp::sqrt(sums[CHANGE]) / merit : 0.0;
    const double error = slow > least ? slow : least;
    return error > 1.0 ? error : 1.0;
}

// Chooses a world's next step from its sums.
template <class State> CUDA_CALLABLE inline void choose_step(State& state, int w, const double* sums) {
    auto& world = state.worlds.data[w];
    const History history = history_of(world);
    const double merit = wp::sqrt(sums[MERIT]), residual = relative_residual(sums[DEVIATION], sums[GOAL]);
    const bool finite = wp::isfinite(merit), hopeless = world.best < 0.0 && !finite;
    const bool fieldless = world.evaluations == 0 && !world.in_field;
    learn(world, history, sums, merit);
    const bool mixed = mix(world, history, sums, merit, finite);
    const double factor = residual > ROUNDING ? amplification(world, sums, merit, mixed) : 1.0;
    const bool done = check_convergence(state, w, residual, factor * residual, finite, hopeless);
    if (done) {
        const double followed = sums[EARLIER] > 0.0 ? sums[FOLLOWED] / sums[EARLIER] : 0.0;
        world.ahead = followed < 0.0 ? 0.0 : followed > 1.0 ? 1.0 : followed;
    }
    int next = done || world.plain_steps > 0 ? STEP : STEP_AND_SWEEP;
    if (!mixed) next = STEP_FROM_BEST;
    // how strongly bodies that respond as wholes couple is not bounded beforehand
    if (!mixed && RESPONDING) world.damping *= 0.5;
    if (done && !finite) next = NOTHING;
    if (fieldless && !done) next = DEMAGNETIZE;
    world.next = next;
    world.linked = next >= STEP;
    world.kept = next >= STEP ? history.kept : 0;
}
}
