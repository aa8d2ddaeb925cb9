// Worlds of an induction solve: their start, and their convergence (Kim and Han 2022, Eq. 12).
//
// ``State`` is the struct of solve_state.py.
#pragma once

namespace warpmag {

constexpr int STEADY = 3; // consecutive solves that give two changes, enough to extrapolate
enum Next { NOTHING, DEMAGNETIZE, STEP_FROM_BEST, STEP, STEP_AND_SWEEP }; // next action of a world

// Starts the iteration of a world, unless it rests.
template <class State> CUDA_CALLABLE inline void begin_world(State& state, int w) {
    auto& world = state.worlds.data[w];
    world.active = !state.resting.data[w];
    if (world.active) state.condition.data[0] = 1;
    world.evaluations = world.has_change = world.plain_steps = 0;
    world.next = world.active && state.warm.data[w] == STEADY ? STEP_AND_SWEEP : NOTHING;
    world.best = -1.0;
    if (world.active && world.apart > 0) world.apart -= 1;
    if (state.warm.data[w] == 0) world.change_count = 0, world.slowness = 0.0;
}

// Residual (Eq. 12) from ‖M − f(H)‖² and ‖f(H)‖²: relative, or absolute where there is no field.
CUDA_CALLABLE inline double relative_residual(double deviation2, double goal2) {
    const double deviation = wp::sqrt(deviation2), goal = wp::sqrt(goal2);
    return goal > 0.0 ? deviation / goal : deviation;
}

// Records an evaluation. Returns true if it is the last evaluation of the world. After a state that is not finite the
// next solve starts cold.
template <class State>
CUDA_CALLABLE inline bool check_convergence(State& state, int w, double residual, double error, bool finite,
                                            bool failed) {
    auto& world = state.worlds.data[w];
    const bool converged = error <= state.rtol;
    world.evaluations += 1;
    world.in_field = 0;
    state.residual.data[w] = residual;
    state.error.data[w] = error;
    state.evaluations.data[w] = world.evaluations;
    state.converged.data[w] = converged;
    const bool done = converged || world.evaluations >= state.max_evaluations || failed;
    if (done) {
        int& warm = state.warm.data[w];
        warm = !finite ? 0 : warm < STEADY ? warm + 1 : STEADY;
        world.active = 0;
    } else {
        state.condition.data[0] = 1;
    }
    return done;
}
}
