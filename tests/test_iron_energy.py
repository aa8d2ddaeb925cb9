"""Energy of iron bodies and magnets: forces and torques are its derivatives, and motion conserves it."""

from dataclasses import dataclass

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from small_builders import new_builder

import warpmag
from bench.iron import model_of
from bench.reference.iron_bodies import SETUPS
from warpmag.shapes import lattice
from warpmag.shapes.solids import boxes_meet

CELLS = 150  # of a body
NODES, WEIGHTS = np.polynomial.legendre.leggauss(5)
PATHS = {
    "cylinders side by side, gap 0.2": 1,
    "ball on plate, gap 0.2": 1,
    "letters T and L, gap 0.2": 0,
    "tilted cube over cube, gap 0.5": 1,
    "magnet over the edge of iron plate 3, gap 1": 1,
    "magnet μ 1.05 over steel plate 3, gap 1": 1,
    "yoke with two magnets and bar, gap 0.2": 3,
}
"""The body that moves in each setup."""


@dataclass(frozen=True)
class Path:
    """Drop of the energy along a path of a body, and the work of the wrench on it, both over the work's scale."""

    drop: float
    work: float
    rounding: float  # of the energy in float32, over the scale


class MovedBody:
    """A setup of ``bench.reference.iron_bodies`` whose body moves on short paths around its place."""

    def __init__(self, name: str, device):
        setup, self._body = SETUPS[name], PATHS[name]
        model = model_of(setup, CELLS, device)
        # float32 sums of fields leave 2e-6; the energy is quadratic in the error of the moments, forces are linear
        self._magnetics, self._state = warpmag.Magnetics(model, external_field=setup.field, rtol=1e-5), model.state()
        self._start, self._center = self._state.body_q.numpy().astype(float), model.body_com.numpy()[self._body]
        self.gap, self.reach = 1e-3 * float(name.rpartition(" ")[2]), setup.bodies[self._body].reach

    def along(self, path) -> Path:
        """Path of twists (displacement [m] and rotation vector about the center of mass), from -path to path."""
        begin, end = self._put(-path)[0], self._put(path)[0]
        wrenches = np.array([self._put(node * path)[1] for node in NODES])
        scale = WEIGHTS @ np.linalg.norm(wrenches[:, :3], axis=1) * np.linalg.norm(path * [1, 1, 1, *[self.reach] * 3])
        return Path((begin - end) / scale, WEIGHTS @ wrenches @ path / scale, 6e-8 * abs(end) / scale)

    def _put(self, twist):
        """Energy [J] and wrench on the body, displaced and turned."""
        poses, rotation = self._start.copy(), Rotation.from_quat(self._start[self._body, 3:])
        center = poses[self._body, :3] + rotation.apply(self._center) + twist[:3]
        rotation = Rotation.from_rotvec(twist[3:]) * rotation
        poses[self._body] = [*(center - rotation.apply(self._center)), *rotation.as_quat()]
        self._state.body_q.assign(poses)
        self._state.clear_forces()
        self._magnetics.apply(self._state)
        assert self._magnetics.converged.numpy().all()
        return self._magnetics.energy()[0], self._state.body_f.numpy()[self._body].astype(float)


@pytest.mark.parametrize("name", PATHS)
def test_work_of_forces_and_torques_is_the_drop_of_the_energy(name, device):
    """Five Gauss points are exact for a force of degree nine over a quarter of the gap on both sides.

    Rounding of positions, 2e-9 m, is up to 1e-4 of the work. Sums over the cells round the energy by up to ten units.
    Works are relative to the work of the force at the end of the body.
    """
    body = MovedBody(name, device)
    shift = 0.25 * body.gap * np.array([0.48, 0.36, 0.8, 0.0, 0.0, 0.0])  # oblique, so that no symmetry helps
    turn = 0.2 * body.gap / body.reach * np.array([0.0, 0.0, 0.0, 0.48, 0.6, 0.64])
    for path in (body.along(shift), body.along(turn)):
        assert path.work == pytest.approx(path.drop, abs=3e-4 + 10.0 * path.rounding)


HALF_SIDES = np.array([0.015, 0.003, 0.003])  # of bars [m]
STEP = 5e-5  # s
BARS = {
    "parallel field": ({}, {}, (1e4, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "magnet": ({"magnetization": (5e5, 0.0, 0.0)}, {}, (0.0, 0.0, 0.0), (0.002, 0.001, 0.3)),
}
"""Materials of two bars, applied field, and lateral shift [m] and turn [rad] of the second bar."""


def bars(name, device):
    """Two bars in line, 4 mm apart."""
    first, second, field, (y, z, angle) = BARS[name]
    builder = new_builder(gravity=(0.0, 0.0, 0.0))
    for material, place, turn in ((first, (0.0, 0.0, 0.0), 0.0), (second, (0.034, y, z), angle)):
        body = builder.add_body(xform=wp.transform(place, wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), turn)))
        hx, hy, hz = HALF_SIDES
        builder.add_shape_box(body, hx=hx, hy=hy, hz=hz, cfg=newton.ModelBuilder.ShapeConfig(density=7870.0))
        if material:
            warpmag.add_permanent(builder, body=body, **material)
        else:
            warpmag.add_inducible(builder, body=body, material="1010-steel", moment_spacing=0.002)
    model = builder.finalize(device=device)
    return model, warpmag.Magnetics(model, external_field=field, rtol=1e-4)


def kinetic_energy(model, poses, velocities):
    """Energy of motion [J] of bodies whose origin is their center of mass."""
    masses, inertias = model.body_mass.numpy().astype(float), model.body_inertia.numpy().astype(float)
    spins = Rotation.from_quat(poses[:, 3:]).inv().apply(velocities[:, 3:])
    return 0.5 * masses @ (velocities[:, :3] ** 2).sum(axis=1) + 0.5 * np.einsum("bi,bij,bj", spins, inertias, spins)


@pytest.mark.parametrize("name", BARS)
def test_bars_that_snap_together_gain_what_the_field_loses(name, device):
    """0.5 % up to contact: the error of the last steps, 0.2 %, is of second order in the step.

    Velocities of symplectic Euler are half a step ahead, so their means belong to the poses.
    """
    model, magnetics = bars(name, device)
    solver, now, then = newton.solvers.SolverSemiImplicit(model, angular_damping=0.0), model.state(), model.state()
    total, kinetic = [], []
    while True:
        poses = now.body_q.numpy().astype(float)
        if boxes_meet(*(lattice.box(HALF_SIDES).posed(pose[:3], pose[3:]) for pose in poses)):
            break
        now.clear_forces()
        magnetics.apply(now)
        solver.step(now, then, None, None, STEP)
        velocities = 0.5 * (now.body_qd.numpy().astype(float) + then.body_qd.numpy())
        kinetic.append(kinetic_energy(model, poses, velocities))
        total.append(kinetic[-1] + magnetics.energy()[0])
        now, then = then, now
        assert len(total) < 2000
    assert np.isfinite(total).all()
    assert np.abs(np.array(total) - total[0]).max() < 5e-3 * kinetic[-1]
