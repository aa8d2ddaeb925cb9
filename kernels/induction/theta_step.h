// What a world of the θ flow does after an evaluation: theta_flow.py says why.
#pragma once
#include "induction/anderson.h"
#include "induction/solve_state.h"

namespace warpmag {

constexpr int PLAIN_STEPS = DEPTH + 1; // after an accelerated step was taken back, before the next is tried
constexpr double FLOW_STEP = 0.9;      // share of the largest convergent step length that is used

// Sums over the moments of a chunk or a world: ‖M − f(H)‖², ‖f(H)‖², ‖φr‖², ⟨φΔg, φΔg'⟩, ‖φΔg'‖², and those of
// anderson.h.
enum Column { DEVIATION, GOAL, MERIT, FOLLOWED, EARLIER, PRODUCTS };
constexpr int COLUMNS = PRODUCTS + DEPTH + DEPTH * (DEPTH + 1) / 2; // as in solve_state.py

// Step length ω = κ/k that converges at the largest stiffness k (2/3 + o_i) of a world, of scalars S.
template <class S, class N> CUDA_CALLABLE inline N step_length(N stiffness) {
    const N safe = S(2.0 * FLOW_STEP) / (1 + stiffness), longest = N(S(1));
    return safe < longest ? safe : longest;
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

// Chooses a world's next step from its sums.
template <class State> CUDA_CALLABLE inline void choose_step(State& state, int w, const double* sums) {
    auto& world = state.worlds.data[w];
    const History history = history_of(world);
    const double merit = wp::sqrt(sums[MERIT]);
    const bool finite = wp::isfinite(merit), first = world.best < 0.0;
    const bool fieldless = world.evaluations == 0 && !world.in_field;
    if (world.evaluations == 0) world.omega = step_length<double>(world.stiffness);
    const bool done = check_convergence(state, w, sums[DEVIATION], sums[GOAL], finite, first && !finite);
    if (done) {
        const double followed = sums[EARLIER] > 0.0 ? sums[FOLLOWED] / sums[EARLIER] : 0.0;
        world.ahead = followed < 0.0 ? 0.0 : followed > 1.0 ? 1.0 : followed;
    }
    world.newest = history.newest;
    world.improved = 0;
    int next = STEP;
    // plain steps descend in energy whatever the merit does on the way, so only accelerated ones are checked by it
    if (done && !finite) {
        next = NOTHING;
    } else if (fieldless && !done) {
        next = DEMAGNETIZE;
    } else if (!finite || (!first && world.plain_steps == 0 && merit > 2.0 * world.best)) {
        next = STEP_FROM_BEST;
        world.plain_steps = PLAIN_STEPS;
    } else {
        if (world.plain_steps > 0) world.plain_steps -= 1;
        const bool descended = world.plain_steps == 0 && history.kept == DEPTH && world.used == 0;
        if (first || merit < world.best || descended) {
            world.best = merit;
            world.improved = 1;
            world.plain_steps = 0;
        }
        world.used = world.plain_steps > 0 ? 0 : history.kept;
        world.alpha = solve_anderson(sums + PRODUCTS, world.used);
        if (!done && world.plain_steps == 0) next = STEP_AND_SWEEP;
    }
    world.next = next;
    world.linked = next >= STEP;
    world.kept = next >= STEP ? history.kept : 0;
}
}
