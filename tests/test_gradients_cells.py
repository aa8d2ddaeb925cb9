"""Gradients by the poses of bodies of cells, against central differences of systems in float64."""

import numpy as np
import pytest
import warp as wp
from cell_bodies import TURN, filled
from scipy.spatial.transform import Rotation

from bench.systems import moment_system
from warpmag.shapes import demagnetization, lattice, linear_cells

EXACT = 1e-6
"""Relative error: of differences below 1e-8 with Richardson's extrapolation, and of solves to 1e-11, with a margin.
Gradients of forces jump where pairs of cells begin to act as boxes. So the steps are small."""
PLATE = filled([lattice.box([0.012, 0.009, 0.002])], 0.006)
TILTED = filled([lattice.box([0.008, 0.011, 0.003])], 0.005)
POSE = Rotation.from_quat(TURN)
DIPOLES = ([0.022, 0.003, 0.004], [0.3, -0.2, 0.5], 0.0), ([-0.004, 0.019, -0.006], [0.1, 0.4, 0.2], 0.0)
BALL = [0.009, 0.002, -0.012], [0.3, -0.2, 0.5], 0.006
BODIES = {
    "box": ([filled([lattice.box((0.006, 0.006, 0.004))], 0.0)], DIPOLES),
    "cells": ([filled([lattice.box((0.014, 0.007, 0.004))], 0.0)], DIPOLES),
    "plates": ([PLATE, TILTED], (DIPOLES[1], BALL)),  # a gap of 2 mm, and a ball at 4 mm
    "linear cells": ([filled([lattice.box([0.01] * 3)], 0.004), PLATE], DIPOLES),
}
PLACES = [np.zeros(3), POSE.apply([0.003, 0.002, 0.007]), POSE.apply([0.002, 0.003, 0.014])]


class MovingBodies:
    """A system of bodies of cells, and of permanent balls or dipoles (position, moment, radius)."""

    def __init__(self, bodies, permanent, device):
        self.counts = [len(body.volumes) for body in bodies] + [1] * len(permanent)
        self.bodies, firsts = bodies, np.cumsum(self.counts) - self.counts
        cells = [linear_cells.with_slopes(demagnetization.coupling(body, body.radii), body) for body in bodies]
        is_permanent = np.arange(sum(self.counts)) >= sum(self.counts) - len(permanent)
        self.system = moment_system(
            radii=np.concatenate([*(body.radii for body in bodies), [radius for *_, radius in permanent]]),
            permanent=is_permanent, bodies=np.repeat(np.arange(len(self.counts)), self.counts),
            couplings=list(zip(firsts.tolist(), cells, strict=False)), saturation=1.2e6, susceptibility=80.0,
            external_field=(3e4, -1e4, 8e4), rtol=1e-11, dtype="float64", device=device, single_torque=True,
        )  # fmt: skip
        self.is_permanent = is_permanent
        first = 2 if len(bodies) == 2 and self.counts[0] > 30 else 1  # the linear cells' cube is thicker
        self.places = [PLACES[0], PLACES[first]][: len(bodies)]
        self.turns = [POSE, POSE * Rotation.from_rotvec([0.03, 0.05, 0.4])][: len(bodies)]
        self.positions, self.moments = (np.array(part) for part in list(zip(*permanent, strict=True))[:2])

    def wrenches(self, shift, turn, positions, moments):
        """Forces and torques of all moments after a change of the poses, positions and permanent moments."""
        turns = [Rotation.from_rotvec(v) * old for v, old in zip(turn, self.turns, strict=True)]
        cells = [
            rotation.apply(body.positions) + place + move
            for rotation, body, place, move in zip(turns, self.bodies, self.places, shift, strict=True)
        ]
        system, every = self.system, self.system.moments.numpy()
        every[self.is_permanent] = self.moments + moments
        system.positions.assign(np.concatenate([*cells, self.positions + positions]))
        system.moments.assign(every)
        system.rotations.assign(np.array([rotation.as_quat() for rotation in turns]))
        system.start_cold()
        system.solve()
        system.apply_forces()
        return system.forces.numpy(), system.torques.numpy()

    def gradients(self, seeds):
        """Gradients of the scalar product of the wrenches with ``seeds``, by name, at the last state."""
        system, gradients = self.system, self.system.gradients
        gradients.load(system.positions, system.moments, system.h, system.external_field, system.rotations)
        sums = gradients.wrench(*(wp.array(seed, dtype=wp.vec3d, device=system.device) for seed in seeds))
        gradients.solve(sums.by_moments)
        gradients.check()
        by_positions = sums.by_positions.numpy() + gradients.by_positions.numpy()
        by_moments = sums.by_moments.numpy() + gradients.by_moments.numpy()
        x, ends = system.positions.numpy(), np.cumsum(self.counts)[:-1]
        spins = [
            np.cross(own - place, part).sum(axis=0)
            for own, part, place in zip(np.split(x, ends), np.split(by_positions, ends), self.places, strict=False)
        ]
        return {
            "shift": np.array([part.sum(axis=0) for part in np.split(by_positions, ends)])[: len(self.bodies)],
            "turn": np.array(spins) + gradients.cells.by_rotations.numpy(),
            "positions": by_positions[self.is_permanent],
            "moments": by_moments[self.is_permanent],
        }


@pytest.mark.parametrize("name", BODIES)
def test_poses_of_bodies(name, device):
    scene, rng = MovingBodies(*BODIES[name], device), np.random.default_rng(2)
    rest = {"shift": np.zeros((len(scene.bodies), 3)), "positions": np.zeros_like(scene.positions)}
    rest |= {"turn": rest["shift"], "moments": rest["positions"]}
    seeds = rng.normal(size=(2, len(scene.is_permanent), 3)) * [[[1.0]], [[30.0]]]
    scene.wrenches(**rest)
    for argument, gradient in scene.gradients(seeds).items():
        direction = rng.normal(size=gradient.shape)

        def slope(step, argument=argument, direction=direction):
            values = [np.sum(seeds * scene.wrenches(**{**rest, argument: s * direction})) for s in (step, -step)]
            return (values[0] - values[1]) / (2.0 * step)

        step = {"turn": 1e-5, "moments": 1e-4}.get(argument, 5e-8)
        difference = (4.0 * slope(step) - slope(2.0 * step)) / 3.0
        scale = np.linalg.norm(gradient) * np.linalg.norm(direction)
        assert abs(np.sum(gradient * direction) - difference) < EXACT * scale, argument
