"""Gradients of the near fields of permanent boxes and cylinders, by poses, moments and magnetizations."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from small_builders import add_ball, new_builder

import warpmag
from warpmag.moments.system import MomentSystem

FIELD = (2e4, 0.0, 5e4)
MAGNETIZATION = (0.0, 3e5, 8e5)


def add_solids(builder, kinds, distance):
    for number, kind in enumerate(kinds):
        turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, 0.5)), 0.1 * number)
        place = wp.vec3(distance * number, 0.002 * number, 0.001 * number)
        body = builder.add_body(xform=wp.transform(place, turn))
        if kind == "box":
            builder.add_shape_box(body, hx=0.01, hy=0.006, hz=0.005)
        else:
            builder.add_shape_cylinder(body, radius=0.006, half_height=0.005)
        warpmag.add_permanent(builder, body=body, magnetization=MAGNETIZATION)


def magnetics_of(device, kinds, distance, *, ball=None):
    """Return a model and its magnetics: a ball of iron or a magnet 2.5 mm above a row of boxes and cylinders."""
    builder = new_builder()
    if ball is not None:
        add_ball(builder, (0.0, 0.004, 0.0135), **ball)
    add_solids(builder, kinds, distance)
    model = builder.finalize(device=device, requires_grad=True)
    return model, warpmag.Magnetics(model, external_field=FIELD, rtol=5e-6)


class Forces:
    """Function L = Σ a·F + b·τ of the forces and torques of a system's moments, in float64."""

    def __init__(self, device, *scene, **options):
        model, magnetics = magnetics_of(device, *scene, **options)
        magnetics.apply(model.state())
        like, rng = magnetics.system, np.random.default_rng(1)
        self.solids = like.sources.solids
        self.start = [
            array.numpy().astype(float) for array in (like.positions, like.moments, like.sources.solid_frames)
        ]
        self.a, self.b = rng.normal(size=(like.count, 3)), 100.0 * rng.normal(size=(like.count, 3))
        self.system = MomentSystem(
            radii=like.radii.numpy(), permanent=np.ones(like.count, bool), bodies=like.bodies.numpy(),
            solids=self.solids, external_field=FIELD, dtype="float64", device=device,
        )  # fmt: skip

    def __call__(self, positions, moments, frames):
        system = self.system
        system.positions.assign(positions)
        system.moments.assign(moments)
        system.sources.solid_frames.assign(frames)
        system.solve()
        system.apply_forces()
        return np.sum(self.a * system.forces.numpy()) + np.sum(self.b * system.torques.numpy())

    def gradients(self):
        """Return gradients by positions, by moments and by rotations of the bodies."""
        system, gradients = self.system, self.system.gradients
        self(*self.start)
        gradients.load(system.positions, system.moments, system.h, system.external_field)
        wp.copy(gradients.solids.frames, system.sources.solid_frames)
        sums = gradients.wrench(*(wp.array(v, dtype=wp.vec3d, device=system.device) for v in (self.a, self.b)))
        return [array.numpy() for array in (sums.by_positions, sums.by_moments, gradients.solids.by_rotations)]

    def with_body(self, k, shift, turn):
        """Return L with a body moved, and turned about its first moment."""
        x, m, frames = (array.copy() for array in self.start)
        rows, origin, turn = self.rows(k), x[self.solids[k].first].copy(), Rotation.from_rotvec(turn)
        x[rows] = origin + shift + turn.apply(x[rows] - origin)
        m[rows] = turn.apply(m[rows])
        frames[k, :3] = origin + shift + turn.apply(frames[k, :3] - origin)
        frames[k, 3:] = (turn * Rotation.from_quat(frames[k, 3:])).as_quat()
        return self(x, m, frames)

    def with_ball(self, shift, change):
        """Return L with the first moment, a ball, moved and changed."""
        x, m, frames = (array.copy() for array in self.start)
        x[0] += shift
        m[0] += change
        return self(x, m, frames)

    def rows(self, k):
        return slice(self.solids[k].first, self.solids[k].first + self.solids[k].count)


def check(gradient, function, step, tolerance):
    """Compare a gradient by three numbers with central differences."""
    expected = [(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(3)]
    assert np.linalg.norm(gradient - expected) < tolerance * np.linalg.norm(expected)


SCENES = {
    "ball": ((("box",), 0.0), {"ball": {"magnetization": MAGNETIZATION}}, 1e-5),
    "apart": ((("box", "box"), 0.03), {}, 1e-5),
    "near": ((("box", "cylinder"), 0.021), {}, 1e-5),
}


@pytest.mark.parametrize("scene", SCENES)
def test_forces_in_double_precision(scene, device):
    arguments, options, tolerance = SCENES[scene]
    forces, none = Forces(device, *arguments, **options), np.zeros(3)
    by_x, by_m, by_rotations = forces.gradients()
    x, m, _ = forces.start
    for k, solid in enumerate(forces.solids):
        rows = forces.rows(k)
        check(by_x[rows].sum(axis=0), lambda v, k=k: forces.with_body(k, v, none), 1e-6, tolerance)
        turned = np.cross(x[rows] - x[solid.first], by_x[rows]) + np.cross(m[rows], by_m[rows])
        gradient = turned.sum(axis=0) + by_rotations[k]
        check(gradient, lambda v, k=k: forces.with_body(k, none, v), 1e-4, tolerance)
    if scene == "ball":
        check(by_x[0], lambda v: forces.with_ball(v, none), 1e-6, tolerance)
        check(by_m[0], lambda v: forces.with_ball(none, v), 1e-2, tolerance)


def test_bodies(device):
    """An iron ball, a box and a cylinder: forces on bodies by poses and magnetizations."""
    model, magnetics = magnetics_of(device, ("box", "cylinder"), 0.0175, ball={})
    rng, poses = np.random.default_rng(5), model.body_q.numpy().copy()
    magnetization = model.warpmag.magnetization.numpy().copy()
    seed = rng.normal(size=(3, 6)) * ([1.0] * 3 + [100.0] * 3)
    state = model.state()
    with wp.Tape() as tape:
        magnetics.apply(state)
    state.body_f.grad.assign(seed)
    tape.backward()

    def loss(step, poses_change, change):
        model.warpmag.magnetization.assign((magnetization + step * change).astype(np.float32))
        state = model.state()
        state.body_q.assign(poses + step * poses_change)
        magnetics.apply(state)
        return np.sum(seed * state.body_f.numpy().astype(float))

    directions = rng.normal(size=(2, 3, 7))
    directions[0, :, 3:] = directions[1, :, :3] = 0.0
    turns = directions[1, :, 3:]  # quaternions keep their length
    turns -= np.sum(turns * poses[:, 3:], axis=1, keepdims=True) * poses[:, 3:]
    change = rng.normal(size=magnetization.shape) * (np.abs(magnetization).max(axis=1, keepdims=True) > 0.0)
    for gradient, step, *direction in (
        (state.body_q.grad, 3e-5, directions[0], 0.0 * change),
        (state.body_q.grad, 1e-3, directions[1], 0.0 * change),
        (model.warpmag.magnetization.grad, 1e4, 0.0 * poses, change),
    ):
        moved = direction[0] if step < 1.0 else change
        slope = (loss(step, *direction) - loss(-step, *direction)) / (2.0 * step)
        error = np.sum(gradient.numpy() * moved) - slope
        assert abs(error) < 1e-3 * np.linalg.norm(gradient.numpy()) * np.linalg.norm(moved)
