"""Magnets of bodies that two solvers of Newton move, coupled by its experimental solver."""

import math

import newton
import numpy as np
import pytest
from small_builders import R, add_ball, new_builder

import warpmag

coupled = pytest.importorskip("newton.solvers.experimental.coupled", reason="this Newton cannot couple solvers")


def test_magnets_of_two_solvers_act_on_each_other(device):
    """The force of two dipoles in line, F = 3 μ0 m² / (2 π d⁴); they move by 3e-6 m, 2e-4 of the force."""
    distance, magnetization, dt, steps = 0.05, 1e6, 1e-4, 3
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    for z in (0.0, distance):
        add_ball(builder, (0.0, 0.0, z), (0.0, 0.0, magnetization))
    model = builder.finalize(device=device)
    entries = [
        coupled.SolverCoupled.Entry(name=kind.__name__, solver=kind, bodies=[body], joints=[body], shapes=[body])
        for body, kind in enumerate((newton.solvers.SolverXPBD, newton.solvers.SolverSemiImplicit))
    ]
    solver, magnetics = coupled.SolverCoupled(model, entries), warpmag.Magnetics(model)
    state, after, control = model.state(), model.state(), model.control()
    for _ in range(steps):
        state.clear_forces()
        magnetics.apply(state)
        solver.step(state, after, control, None, dt)
        state, after = after, state
    moment = magnetization * 4.0 / 3.0 * math.pi * R**3
    force = 3.0 * 4e-7 * math.pi * moment**2 / (2.0 * math.pi * distance**4)
    speed = steps * dt * force / model.body_mass.numpy()[0]
    np.testing.assert_allclose(state.body_qd.numpy()[:, 2], [speed, -speed], rtol=3e-4)  # of the motion
