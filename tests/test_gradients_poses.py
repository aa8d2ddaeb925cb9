"""Gradients of the forces on bodies by their poses, through ``Magnetics.apply`` on a tape."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from small_builders import R, add_ball, new_builder

import warpmag

FIELD = (2e4, 0.0, 5e4)
MAGNETIZATION = (0.0, 3e5, 8e5)


def model_of_balls(device, worlds=1, **settings):
    """Two iron balls, a magnet that hangs off its body's center, and a pair of magnets on one body, in each world."""
    builder = world = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0))
    add_ball(builder, (0.001, 0.011, 0.0))
    turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, 0.5)), 0.7)
    add_ball(builder, (0.012, 0.003, 0.001), magnetization=MAGNETIZATION, rotation=turn)
    pair = builder.add_body(xform=wp.transform((-0.022, 0.004, 0.006), turn), mass=0.01, com=(0.002, 0.001, 0.0))
    for offset in (0.0, 0.011):
        builder.add_shape_sphere(pair, radius=R, xform=wp.transform((offset, 0.0, 0.0), wp.quat_identity()))
    warpmag.add_permanent(builder, body=pair, magnetization=MAGNETIZATION)
    if worlds > 1:
        builder = new_builder()
        builder.replicate(world, worlds)
    model = builder.finalize(device=device, requires_grad=True)
    return model, warpmag.Magnetics(model, external_field=FIELD, rtol=1e-5, **settings)


def rotated(q, v):
    """Warp's polynomial for the rotation of a vector, also for quaternions that are not of unit length."""
    axis, w = q[:3], q[3]
    return v * (2.0 * w * w - 1.0) + 2.0 * w * np.cross(axis, v) + 2.0 * axis * (axis @ v)


def body_forces(poses, com):
    """Wrenches of the bodies of :func:`model_of_balls` in float64, by calls on arrays."""
    magnetization, volume = np.array(MAGNETIZATION), 4.0 / 3.0 * np.pi * R**3
    body, local = np.array([0, 1, 2, 3, 3]), np.zeros((5, 3))
    local[4, 0] = 0.011
    x = np.array([poses[b, :3] + rotated(poses[b, 3:], v) for b, v in zip(body, local, strict=True)])
    m = np.array([volume * rotated(poses[b, 3:], magnetization) for b in body[2:]])
    material = warpmag.declarations.magnets.Magnet(kind="inducible")
    balls = warpmag.solve_induction(
        x[:2], R, saturation=material.saturation, susceptibility=material.susceptibility, external_field=FIELD,
        permanent=(x[2:], m), rtol=1e-12, dtype="float64", device="cpu",
    )  # fmt: skip
    m = np.concatenate([volume * balls.magnetizations, m])
    forces, torques = warpmag.wrench(x, m, radii=R, external_field=FIELD, dtype="float64", device="cpu")
    # magnets of one body exert no forces on each other
    own_forces, own_torques = warpmag.wrench(x[3:], m[3:], radii=R, dtype="float64", device="cpu")
    forces[3:] -= own_forces
    torques[3:] -= own_torques
    torques[:2] = 0.0
    total = np.zeros((4, 6))
    for i, b in enumerate(body):
        center = poses[b, :3] + rotated(poses[b, 3:], com[b])
        total[b] += np.concatenate([forces[i], torques[i] + np.cross(x[i] - center, forces[i])])
    return total


def test_poses(device):
    model, magnetics = model_of_balls(device)
    state = model.state()
    with wp.Tape() as tape:
        magnetics.apply(state)
    poses, com = state.body_q.numpy().astype(float), model.body_com.numpy().astype(float)
    expected = body_forces(poses, com)
    assert np.allclose(state.body_f.numpy(), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
    seed = np.random.default_rng(0).normal(size=expected.shape) * ([1.0] * 3 + [50.0] * 3)
    state.body_f.grad.assign(seed)
    tape.backward()
    gradient = state.body_q.grad.numpy()
    for name, part in (("positions", slice(0, 3)), ("rotations", slice(3, 7))):
        step = np.zeros((4, 7))
        step[:, part] = np.random.default_rng(1).normal(size=step[:, part].shape)
        change = body_forces(poses + 1e-6 * step, com) - body_forces(poses - 1e-6 * step, com)
        slope, typical = np.sum(seed * change) / 2e-6, np.linalg.norm(gradient[:, part])
        assert abs(np.sum(gradient * step) - slope) < 1e-4 * typical, name  # float32, and rtol of the induction


def gradient_of(model, magnetics, poses, seed):
    """Gradient of a function of the wrenches by the poses."""
    state = model.state()
    state.body_q.assign(poses)
    with wp.Tape() as tape:
        magnetics.apply(state)
    state.body_f.grad.assign(seed)
    tape.backward()
    return state.body_q.grad.numpy()


def test_worlds(device):
    rng, (single, magnetics) = np.random.default_rng(3), model_of_balls(device)
    poses = np.concatenate([single.body_q.numpy()] * 2)
    poses[:, :3] += 1e-3 * rng.uniform(-0.5, 0.5, (8, 3))
    seed = rng.normal(size=(8, 6))
    expected = [gradient_of(single, magnetics, poses[rows], seed[rows]) for rows in (slice(0, 4), slice(4, 8))]
    together = gradient_of(*model_of_balls(device, worlds=2), poses, seed)
    # rtol of both solves is 1e-5, and the second linear solve of one model starts from the first one's solution
    np.testing.assert_allclose(together, np.concatenate(expected), rtol=0.0, atol=1e-4 * np.abs(together).max())


@wp.kernel(module="unique", enable_backward=True)
def advance(
    dt: float,
    inv_mass: wp.array[float],
    body_f: wp.array[wp.spatial_vector],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_q_out: wp.array[wp.transform],
    body_qd_out: wp.array[wp.spatial_vector],
):
    """Step of the symplectic Euler method, without rotations."""
    i = wp.tid()
    v = wp.spatial_top(body_qd[i]) + dt * inv_mass[i] * wp.spatial_top(body_f[i])
    body_qd_out[i] = wp.spatial_vector(v, wp.vec3())
    x = wp.transform_get_translation(body_q[i]) + dt * v
    body_q_out[i] = wp.transform(x, wp.transform_get_rotation(body_q[i]))


def test_a_rollout(device):
    """A hundred substeps in which three iron balls attract each other, against the same rollout in float64."""
    builder, dt, steps = new_builder(), 5e-5, 100
    for position in ((0.0, 0.0, 0.0), (0.001, 0.0125, 0.002), (-0.002, 0.004, 0.0135)):
        add_ball(builder, position)
    model = builder.finalize(device=device, requires_grad=True)
    magnetics = warpmag.Magnetics(model, external_field=FIELD, rtol=5e-6)
    states = [model.state() for _ in range(steps + 1)]
    with wp.Tape() as tape:
        for now, after in itertools.pairwise(states):
            magnetics.apply(now)
            inputs = [dt, model.body_inv_mass, now.body_f, now.body_q, now.body_qd]
            wp.launch(advance, 3, inputs=inputs, outputs=[after.body_q, after.body_qd], device=device)
    seed = np.random.default_rng(7).normal(size=(3, 3))
    states[-1].body_q.grad.assign(np.pad(seed, ((0, 0), (0, 4))))
    tape.backward()
    gradient = states[0].body_q.grad.numpy()[:, :3].astype(float)
    inv_mass, material = model.body_inv_mass.numpy()[:, None].astype(float), magnetics.magnets[0].magnet

    def final(x):
        v = np.zeros((3, 3))
        for _ in range(steps):
            balls = warpmag.solve_induction(
                x, R, saturation=material.saturation, susceptibility=material.susceptibility, external_field=FIELD,
                rtol=1e-10, dtype="float64", device="cpu",
            )  # fmt: skip
            v = v + dt * inv_mass * balls.wrench()[0]
            x = x + dt * v
        return x

    start = model.body_q.numpy()[:, :3].astype(float)
    end = final(start)
    assert np.abs(end - start).max() > 3e-4 and np.allclose(states[-1].body_q.numpy()[:, :3], end, atol=1e-7)
    expected = np.zeros((3, 3))
    for entry in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[entry] = 1e-7
        expected[entry] = np.sum(seed * (final(start + step) - final(start - step))) / 2e-7
    sizes = np.linalg.norm(gradient), np.linalg.norm(expected)
    assert np.linalg.norm(gradient - expected) < 1e-4 * sizes[1]
    assert np.sum(gradient * expected) > 0.99999 * sizes[0] * sizes[1]


def test_what_has_no_gradient_raises():
    model, magnetics = model_of_balls("cpu", force="zeeman")
    with (
        wp.Tape(),
        pytest.raises(warpmag.InputError, match=r"state.body_q: .* the force 'zeeman' has none"),
    ):
        magnetics.apply(model.state())
    with wp.Tape(), pytest.raises(warpmag.InputError, match=r"only Magnetics.apply records one"):
        magnetics.induce(model.state())
    model = model_of_boxes(0.021, ("inducible", "permanent"))
    with wp.Tape(), pytest.raises(warpmag.InputError, match="the near field of a permanent body at cells of iron"):
        warpmag.Magnetics(model).apply(model.state())


def model_of_boxes(distance, kinds):
    """Boxes of iron and permanent boxes, some of them a distance [m] apart."""
    builder = new_builder()
    for number, kind in enumerate(kinds):
        body = builder.add_body(xform=wp.transform((distance * number, 0.002, 0.001 * number), wp.quat_identity()))
        builder.add_shape_box(body, hx=0.01, hy=0.006, hz=0.005)
        if kind == "inducible":
            warpmag.add_inducible(builder, body=body)
        else:
            warpmag.add_permanent(builder, body=body, magnetization=MAGNETIZATION)
    return builder.finalize(device="cpu", requires_grad=True)


@pytest.mark.parametrize(
    ("distance", "kinds", "step"),
    [(0.035, ("inducible", "permanent"), 1e-3), (0.022, ("inducible", "inducible"), 1e-4)],
)
def test_boxes(distance, kinds, step):
    """Boxes of iron, and a permanent box so far away that its closed form does not act."""
    model = model_of_boxes(distance, kinds)
    magnetics = warpmag.Magnetics(model, external_field=FIELD, rtol=5e-6)
    poses, rng = model.body_q.numpy(), np.random.default_rng(5)
    seed, change = rng.normal(size=(2, 6)) * ([1.0] * 3 + [100.0] * 3), rng.normal(size=(2, 7))
    change[:, 3:] = 10.0 * (change[:, 3:] - np.sum(change[:, 3:] * poses[:, 3:], axis=1, keepdims=True) * poses[:, 3:])
    gradient = gradient_of(model, magnetics, poses, seed)
    values = []
    for sign in (1.0, -1.0):
        state = model.state()
        state.body_q.assign(poses + sign * step * change)
        magnetics.apply(state)
        values.append(np.sum(seed * state.body_f.numpy()))
    slope = (values[0] - values[1]) / (2.0 * step)
    # steps of 1 % in float32, quaternions of length 1 to second order
    assert abs(np.sum(gradient * change) - slope) < 5e-3 * np.linalg.norm(gradient) * np.linalg.norm(change)


def test_a_tape_without_gradients_records_nothing():
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0))
    model = builder.finalize(device="cpu")
    with wp.Tape() as tape:
        warpmag.Magnetics(model, external_field=FIELD).apply(model.state())
    assert isinstance(model, newton.Model) and not tape.launches
