"""Energy and momentum of soft balls that fall towards each other, for errors of the time step.

The energy is kinetic plus the free energy of soft magnets in equilibrium, from the float64 oracle. The integrator is
symplectic Euler. Its velocities are half a step ahead, so the mean of the velocities before and after the step belongs
to the time of the positions. The error of the energy is of second order in the step, that of positions of first order.
"""

from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

import warpmag
from bench.reference import oracle

RADIUS, SATURATION, DENSITY = 0.005, 1.7e6, 7870.0
FIELD = np.array([2e5, 0.0, 1e5])
"""Applied field [A/m]; it magnetizes the balls to a third of their saturation."""
DURATION = 0.01  # time [s] in which the distance of two balls falls from 4.4 to 3.1 radii
BALLS = RADIUS * np.array([[0.0, 0.0, 0.0], [4.4, 0.0, 0.0], [1.32, 3.96, 0.88]])


@dataclass(frozen=True)
class Fall:
    """Result of a fall."""

    drift: float  # largest change of the total energy over the kinetic energy gained
    momentum: float  # largest total momentum over the sum of the balls' momenta
    positions: np.ndarray  # final positions of the balls [m], shape [count, 3]


def free_energy(positions) -> float:
    """Magnetic free energy [J] of soft balls in equilibrium; minus its gradient is the Kelvin force."""
    solution = oracle.equilibrium(positions, RADIUS, FIELD, saturation=SATURATION)
    m, g = solution.magnetizations, oracle.coupling_matrix(positions, RADIUS)
    s = np.linalg.norm(m, axis=1) / SATURATION
    stored = SATURATION**2 / 3.0 * np.sum(s * np.arctanh(s) + 0.5 * np.log1p(-(s**2)))
    mutual, applied = 0.5 * m.ravel() @ g @ m.ravel(), np.sum(m * FIELD)
    return oracle.MU0 * 4.0 / 3.0 * np.pi * RADIUS**3 * (stored - mutual - applied)


def fall(count: int, dt: float, device, *, force: str = "kelvin") -> Fall:
    """Let two or three balls fall together in steps of ``dt`` [s]."""
    builder = newton.ModelBuilder()
    builder.gravity = wp.vec3(0.0, 0.0, 0.0)
    warpmag.register_attributes(builder)
    for center in BALLS[:count]:
        body = builder.add_body(xform=wp.transform(wp.vec3(*center), wp.quat_identity()))
        builder.add_shape_sphere(body, radius=RADIUS, cfg=newton.ModelBuilder.ShapeConfig(density=DENSITY))
        warpmag.add_inducible(builder, body=body)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=tuple(FIELD), rtol=2e-6, force=force)
    # XPBD sets speeds below 0.1 mm/s to zero, so with short steps balls would never start to move
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
    drift = np.abs(np.array(total) - total[0]).max() / np.max(kinetic)
    return Fall(float(drift), float(np.max(momentum)), now.body_q.numpy()[:, :3].astype(float))
