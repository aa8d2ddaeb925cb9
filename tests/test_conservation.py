"""Balls that attract each other without contact: energy, momentum and the order of the time step.

The energy is kinetic plus the free energy of soft magnets at equilibrium, both from the float64 oracle. The integrator
is symplectic Euler, in which velocities stand half a step ahead: those at the time of the positions are the mean before
and after the step. Energy then errs by the second order of the step, positions by the first.
"""

import itertools

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag import oracle

R, MS, DENSITY = 0.005, 1.7e6, 7870.0
H0 = np.array([2e5, 0.0, 1e5])  # A/m; the balls come to be magnetized to a third of their saturation
DURATION = 0.01  # s, in which two balls come from 4.4 to 3.1 radii
BALLS = R * np.array([[0.0, 0.0, 0.0], [4.4, 0.0, 0.0], [1.32, 3.96, 0.88]])


def free_energy(positions):
    """Magnetic free energy [J] of soft balls in equilibrium, whose gradient is the Kelvin force."""
    found = oracle.equilibrium(positions, R, H0, saturation=MS)
    m, g = found.magnetizations, oracle.coupling_matrix(positions, R)
    s = np.linalg.norm(m, axis=1) / MS
    stored = MS**2 / 3.0 * np.sum(s * np.arctanh(s) + 0.5 * np.log1p(-(s**2)))
    mutual, applied = 0.5 * m.ravel() @ g @ m.ravel(), np.sum(m * H0)
    return oracle.MU0 * 4.0 / 3.0 * np.pi * R**3 * (stored - mutual - applied)


class Fall:
    """A fall in steps of ``dt``: relative drifts of energy and momentum, and where the balls end."""

    def __init__(self, count, dt, device, force="kelvin"):
        builder = newton.ModelBuilder()
        builder.gravity = wp.vec3(0.0, 0.0, 0.0)
        warpmag.register_attributes(builder)
        for place in BALLS[:count]:
            body = builder.add_body(xform=wp.transform(wp.vec3(*place), wp.quat_identity()))
            builder.add_shape_sphere(body, radius=R, cfg=newton.ModelBuilder.ShapeConfig(density=DENSITY))
            warpmag.add_inducible(builder, body)
        model = builder.finalize(device=device)
        magnetics = warpmag.Magnetics(model, external_field=tuple(H0), rtol=2e-6, force=force)
        solver, now, then = newton.solvers.SolverSemiImplicit(model), model.state(), model.state()
        mass = model.body_mass.numpy().astype(float)[:, None]
        kinetic, total, momentum = [], [], []
        steps = round(DURATION / dt)
        for step in range(steps):
            now.clear_forces()
            magnetics.apply(now)
            solver.step(now, then, None, None, dt)
            if step % (steps // 10) == 0 or step == steps - 1:
                v = 0.5 * (now.body_qd.numpy()[:, :3].astype(float) + then.body_qd.numpy()[:, :3])
                kinetic.append(0.5 * np.sum(mass * v**2))
                total.append(kinetic[-1] + free_energy(now.body_q.numpy()[:, :3].astype(float)))
                momentum.append(np.linalg.norm(np.sum(mass * v, axis=0)) / np.sum(np.linalg.norm(mass * v, axis=1)))
            now, then = then, now
        self.drift = np.abs(np.array(total) - total[0]).max() / max(kinetic)
        self.momentum = max(momentum)
        self.positions = now.body_q.numpy()[:, :3].astype(float)


@pytest.fixture(scope="module")
def falls(device):
    """Two balls, the step halved twice."""
    return [Fall(2, dt, device) for dt in (2e-4, 1e-4, 5e-5)]


def test_energy_and_momentum(falls):
    assert falls[-1].drift < 1e-4
    assert all(fall.momentum < 1e-6 for fall in falls)
    distance = np.linalg.norm(falls[-1].positions[1] - falls[-1].positions[0])
    assert 2.9 * R < distance < 3.2 * R  # they fell, and did not touch


def test_order_of_convergence(falls):
    """Energy errs by dt², positions by dt: halved steps leave a quarter and a half, up to the next order."""
    drifts = [fall.drift for fall in falls]
    assert 3.6 < drifts[0] / drifts[1] < 4.4 and 3.6 < drifts[1] / drifts[2] < 4.4
    moved = [np.linalg.norm(a.positions - b.positions) for a, b in itertools.pairwise(falls)]
    assert 1.9 < moved[0] / moved[1] < 2.1


def test_three_balls(device):
    fall = Fall(3, 1e-4, device)
    assert fall.drift < 1e-4 and fall.momentum < 1e-6


def test_the_papers_force_is_no_gradient(device):
    """Eq. 4 makes energy: forces of soft balls are up to eight times those that their free energy has."""
    assert Fall(2, 1e-4, device, force="zeeman").drift > 0.5
