"""Gradients by the pose of a body of cells, against central differences of systems in float64."""

import numpy as np
import pytest
import warp as wp
from cell_bodies import TURN, filled, make_system, matrix

from warpmag.shapes import lattice

EXACT = 1e-6
"""Relative error: of differences below 1e-8 with Richardson's extrapolation, and of solves to 1e-11, with a margin."""
DIPOLES = (([0.022, 0.003, 0.004], [0.3, -0.2, 0.5]), ([-0.004, 0.019, -0.006], [0.1, 0.4, 0.2]))


@pytest.mark.parametrize("half", [(0.006, 0.006, 0.004), (0.014, 0.007, 0.004)])
def test_pose_of_a_body(half, device):
    body, rng = filled([lattice.box(half)], 0.0), np.random.default_rng(2)
    settings = {"saturation": 1.2e6, "susceptibility": 80.0, "external_field": (3e4, -1e4, 8e4), "rtol": 1e-11}
    system = make_system(body, permanent=DIPOLES, dtype="float64", device=device, single_torque=True, **settings)
    count, dipoles = len(body.volumes), [np.array(part) for part in zip(*DIPOLES, strict=True)]
    seeds = [rng.normal(size=(count + 2, 3)), 30.0 * rng.normal(size=(count + 2, 3))]

    def solve(shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), positions=dipoles[0], moments=dipoles[1]):
        half_turn = np.append(0.5 * np.array(turn), 1.0)
        x, y, z, w = half_turn / np.linalg.norm(half_turn)
        a, b, c, d = TURN
        rotation = np.array([
            w * a + x * d + y * c - z * b, w * b + y * d + z * a - x * c, w * c + z * d + x * b - y * a,
            w * d - x * a - y * b - z * c,
        ])  # fmt: skip
        system.positions.assign(np.concatenate([body.positions @ matrix(rotation).T + shift, positions]))
        system.moments.assign(np.concatenate([system.moments.numpy()[:count], moments]))
        system.rotations.assign(rotation[None])
        system.start_cold()
        system.solve()
        system.apply_forces()
        return sum(float(np.sum(s * r.numpy())) for s, r in zip(seeds, (system.forces, system.torques), strict=True))

    solve()
    gradients = system.gradients
    gradients.load(system.positions, system.moments, system.h, system.external_field)
    gradients.cells.rotations.assign(system.rotations)
    sums = gradients.wrench(*(wp.array(seed, dtype=wp.vec3d, device=device) for seed in seeds))
    gradients.solve(sums.by_moments)
    gradients.check()
    by_positions = sums.by_positions.numpy() + gradients.by_positions.numpy()
    by_moments = sums.by_moments.numpy() + gradients.by_moments.numpy()
    x = system.positions.numpy()[:count].copy()
    expected = {
        "shift": by_positions[:count].sum(axis=0),
        "turn": np.cross(x, by_positions[:count]).sum(axis=0) + gradients.cells.by_rotations.numpy()[0],
        "positions": by_positions[count:],
        "moments": by_moments[count:],
    }
    for name, gradient in expected.items():
        base = {"positions": dipoles[0], "moments": dipoles[1]}.get(name, np.zeros(3))
        direction = rng.normal(size=gradient.shape)
        step = {"turn": 1e-4, "moments": 1e-4}.get(name, 1e-6)

        def slope(step, name=name, base=base, direction=direction):
            return (solve(**{name: base + step * direction}) - solve(**{name: base - step * direction})) / (2.0 * step)

        difference = (4.0 * slope(step) - slope(2.0 * step)) / 3.0
        assert abs(np.sum(gradient * direction) - difference) < EXACT * np.linalg.norm(gradient) * 3.0, name
