"""A run of 20,000 steps: it takes no more memory with time, and no energy comes from nowhere."""

import resource
import sys

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from bench.reference import oracle
from warpmag.engine.stepping.simulation import Simulation

RADIUS, MASS, GRAVITY = 0.005, 4e-3, 9.81
M = 2e5  # A/m: neighbours pull each other 4 times as hard as gravity does
STEPS, EVERY = 20_000, 100


def magnets():
    """Five ball magnets, turned at random, in a row above the ground."""
    rng = np.random.default_rng(3)
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.add_ground_plane()
    for place in range(5):
        turn = rng.normal(size=4)
        position = (0.014 * place, 0.002 * (place % 2), 0.01)
        ball = builder.add_body(xform=wp.transform(position, wp.normalize(wp.quat(*turn))))
        density = MASS / (4.0 / 3.0 * np.pi * RADIUS**3)
        builder.add_shape_sphere(ball, radius=RADIUS, cfg=newton.ModelBuilder.ShapeConfig(density=density, mu=0.3))
        warpmag.add_permanent(builder, body=ball, magnetization=(0.0, 0.0, M))
    return builder


def energy(simulation):
    """Kinetic, potential and magnetic energy [J] of the balls, in float64."""
    poses, velocities = simulation.state.body_q.numpy().astype(float), simulation.state.body_qd.numpy().astype(float)
    x, (a, b, c, w) = poses[:, :3], poses[:, 3:].T
    moment = M * 4.0 / 3.0 * np.pi * RADIUS**3
    moments = moment * np.stack([2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)], axis=1)
    kinetic = 0.5 * MASS * ((velocities[:, :3] ** 2).sum() + 0.4 * RADIUS**2 * (velocities[:, 3:] ** 2).sum())
    field = oracle.h_field(x, moments, radii=np.full(len(x), RADIUS))
    return kinetic + MASS * GRAVITY * x[:, 2].sum() - 0.5 * oracle.MU0 * (moments * field).sum()


def memory():
    """Largest resident memory so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


@pytest.mark.long
def test_twenty_thousand_steps(device):
    simulation = Simulation(magnets(), device=device)
    energies, held = [energy(simulation)], 0.0
    for step in range(1, STEPS + 1):
        simulation.step()
        if step % EVERY == 0:
            energies.append(energy(simulation))
        if step == STEPS // 10:
            held = memory()
    energies = np.array(energies)
    released = energies[0] - energies[-1]
    print(f"energy {energies[0]:.3e} to {energies[-1]:.3e} J, at least {energies.min():.3e}")
    print(f"memory {held:.0f} MiB, grew by {memory() - held:.2f}")
    assert np.isfinite(energies).all() and released > 0.0
    assert energies.max() <= energies[0] + 1e-3 * released  # the order of what a substep of 0.5 ms leaves
    assert memory() - held < 4.0  # MiB; reports of 18,000 steps kept by mistake would take more
