"""Newton's XPBD as mended here: what it solves, what that conserves, and that it repeats."""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp

from warpmag.engine.xpbd import PileXPBD
from warpmag.kernels.rigid import contact_solve

R, DT = 0.005, 5e-4  # m, s
CAPACITY = 2000
TETRAHEDRON = R * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], np.float32)
FACES = np.array([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)], np.int32)
KINDS = ("ball", "box", "capsule", "mesh", "dumbbell", "plate")


def add_shape(builder, kind, body, config):
    if kind in ("ball", "plate"):
        builder.add_shape_sphere(body, radius=R, cfg=config)
    elif kind == "box":
        builder.add_shape_box(body, hx=R, hy=0.8 * R, hz=0.9 * R, cfg=config)
    elif kind == "capsule":
        builder.add_shape_capsule(body, radius=0.7 * R, half_height=0.5 * R, cfg=config)
    elif kind == "mesh":
        builder.add_shape_mesh(body, mesh=newton.Mesh(TETRAHEDRON, FACES.flatten()), cfg=config)
    else:  # off its origin, and its principal axes are not those of its frame
        for at, radius in (((R, 0.0, 0.3 * R), R), ((-R, 0.5 * R, 0.0), 0.8 * R)):
            builder.add_shape_sphere(body, xform=wp.transform(at), radius=radius, cfg=config)


def collided(builder, device):
    """The model, its state and its contacts."""
    model = builder.finalize(device=device)
    model.joint_count = 0  # all of them free
    state = model.state()
    pipeline = newton.CollisionPipeline(model, rigid_contact_max=CAPACITY)
    contacts = pipeline.contacts()
    pipeline.collide(state, contacts)
    return model, state, contacts


def heap(kind, device, ground=True):
    """Bodies that overlap and move, on the ground and on a moving belt; or a layer of balls below a plate."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.81 if ground else 0.0))
    config = newton.ModelBuilder.ShapeConfig(density=7874.0, gap=0.1 * R, mu=0.5, mu_torsional=0.1, mu_rolling=0.02)
    random = np.random.default_rng(3)
    if ground:
        builder.add_ground_plane(cfg=config)
        belt = builder.add_body(is_kinematic=True)
        builder.add_shape_box(belt, hx=0.1, hy=0.1, hz=0.1 * R, cfg=config)
        builder.body_qd[belt] = wp.spatial_vector(0.3, 0.2, 0.0, 0.0, 0.0, 1.0)
    if kind == "plate":
        plate = builder.add_body(xform=wp.transform((8.0 * R, 8.0 * R, 3.0 * R)))
        builder.add_shape_box(plate, hx=10.0 * R, hy=10.0 * R, hz=R, cfg=config)
    step, flat = (3.6 * R, 0.6) if kind == "dumbbell" else (1.99 * R, 0.95)
    for i, j, k in np.ndindex((9, 9, 1) if kind == "plate" else (3, 3, 3)):
        at = step * (i + 0.1 * k), step * (j - 0.1 * k), 1.05 * R + flat * step * k
        body = builder.add_body(xform=wp.transform(at, wp.quat_rpy(0.1 * i, 0.05 * j, 0.2 * k)))
        add_shape(builder, kind, body, config)
        builder.body_qd[body] = wp.spatial_vector(*random.normal(scale=0.1, size=6))
    return collided(builder, device)


def substep(solver, model, state, contacts, iterations=60):
    """Poses and velocities after a substep."""
    begin, end = model.state(), model.state()
    begin.assign(state)
    settings = {"rigid_contact_relaxation": 0.35, "rigid_contact_con_weighting": False}
    solver(model, CAPACITY, iterations=iterations, **settings).step(begin, end, None, contacts, DT)
    return end.body_q.numpy().astype(float), end.body_qd.numpy().astype(float)


class NewtonsXPBD(PileXPBD):
    """Newton's own kernels, with split masses as ours, but with lever arms as they take them."""

    def __init__(self, model, contact_max, **settings):
        super().__init__(model, contact_max, **settings)
        self._solve = None


class PlainXPBD(PileXPBD):
    """Ours, with lever arms as Newton's kernels take them."""

    def __init__(self, model, contact_max, **settings):
        super().__init__(model, contact_max, **settings)
        flag = int(newton.BodyFlags.KINEMATIC)
        bodies = self._view_bodies(model.state())
        self._solve = contact_solve.allocate(contact_max, bodies, levers=False, kinematic_flag=flag)


def altered(**changes):
    """The solver with other settings of its contact solve."""

    class Altered(PileXPBD):
        def __init__(self, *arguments, **settings):
            super().__init__(*arguments, **settings)
            self._solve = dataclasses.replace(self._solve, **changes)

    return Altered


@pytest.mark.parametrize("kind", KINDS)
def test_a_substep_is_that_of_newtons_kernels(kind, device):
    """Gaps are differences of positions, known to 6e-8 of the largest in float32, and impulses to that over dt.

    As many iterations add up as many errors of any sign, and the largest of some hundred sums is three times the usual.
    """
    model, state, contacts = heap(kind, device)
    free = model.state()
    newton.solvers.SolverXPBD(model).integrate_bodies(model, state, free, DT)
    for iterations in (1, 5, 60):
        theirs, ours = (substep(solver, model, state, contacts, iterations) for solver in (NewtonsXPBD, PlainXPBD))
        pushed = np.abs(theirs[1] - free.body_qd.numpy())[:, :3].max(1)
        assert (pushed > 1e-3).sum() > 20
        rounding = 6e-8 * np.abs(theirs[0][:, :3]).max()  # m
        error = 3.0 * rounding / DT * iterations**0.5  # m/s
        np.testing.assert_allclose(ours[1][:, :3], theirs[1][:, :3], rtol=0, atol=error)
        np.testing.assert_allclose(ours[1][:, 3:], theirs[1][:, 3:], rtol=0, atol=error / R)
        np.testing.assert_allclose(ours[0][:, :3], theirs[0][:, :3], rtol=0, atol=error * DT + rounding)
        np.testing.assert_allclose(ours[0][:, 3:], theirs[0][:, 3:], rtol=0, atol=error * DT / R + 2e-7)


def test_bodies_without_contacts_are_left_alone(device):
    """Newton's kernels stop what is slower than 1e-4 m/s, whether or not something is there to stop it."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for x in (0.0, 1.99 * R, 10.0 * R):
        body = builder.add_body(xform=wp.transform((x, 0.0, 0.0)))
        builder.add_shape_sphere(body, radius=R, cfg=newton.ModelBuilder.ShapeConfig(gap=0.1 * R))
    builder.body_qd[2] = wp.spatial_vector(3e-5, 0.0, 0.0, 0.0, 2e-5, 0.0)
    model, state, contacts = collided(builder, device)
    assert contacts.rigid_contact_count.numpy()[0] == 1
    q, qd = substep(PileXPBD, model, state, contacts)
    np.testing.assert_array_equal(qd[2], state.body_qd.numpy()[2])
    assert q[2, 0] > 10.0 * R * (1.0 + 6e-8)
    assert q[0, 0] < -0.004 * R and q[1, 0] > 1.994 * R  # the others part


def test_contacts_keep_momentum(device):
    """What both bodies of a contact are pushed by is opposite; each of 60 sums of velocities rounds by 6e-8 of them."""
    model, state, contacts = heap("ball", device, ground=False)
    _, qd = substep(PileXPBD, model, state, contacts)
    mass, before = model.body_mass.numpy(), state.body_qd.numpy()
    assert np.abs(qd - before).max() > 0.1
    gained = mass @ (qd - before)[:, :3]
    error = 6e-8 * np.abs(qd[:, :3]).max() * mass.max() * (60 * len(mass)) ** 0.5
    np.testing.assert_allclose(gained, 0.0, rtol=0, atol=error)


@pytest.mark.parametrize("kind", ["ball", "box", "plate"])
def test_a_substep_repeats_bit_by_bit(kind, device):
    """By any number of threads; on a GPU, by a cluster and by launches, for contacts that were found in any order."""
    on_gpu = wp.get_device(device).is_cuda
    model, state, contacts = heap(kind, device)
    forms = [({}, {}), ({"cluster": 0}, {"cluster": 0})] if on_gpu else [({}, {"most": 3})]
    first = [substep(altered(**changes), model, state, contacts) for changes, _ in forms]
    order = np.arange(contacts.rigid_contact_count.numpy()[0])
    if on_gpu:
        np.random.default_rng(0).shuffle(order)
    for name in "shape0 shape1 point0 point1 offset0 offset1 margin0 margin1 normal".split():
        array = getattr(contacts, f"rigid_contact_{name}")
        values = array.numpy()
        values[: len(order)] = values[order]
        array.assign(values)
    for (_, changes), before in zip(forms, first, strict=True):
        for value, expected in zip(substep(altered(**changes), model, state, contacts), before, strict=True):
            np.testing.assert_array_equal(value, expected)


def worlds(kind, device, count=20):
    """Worlds of some bodies each that overlap, on ground that they share."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(density=7874.0, gap=0.1 * R, mu=0.5, mu_torsional=0.1, mu_rolling=0.02)
    for world in range(count):
        part = newton.ModelBuilder()
        for i, j, k in list(np.ndindex(2, 3, 3))[world % 3 :]:
            at = 1.99 * R * (i + 0.1 * k), 1.99 * R * (j - 0.1 * k), (1.05 + 1.89 * k) * R
            body = part.add_body(xform=wp.transform(at, wp.quat_rpy(0.1 * i, 0.05 * j, 0.2 * k)))
            add_shape(part, kind, body, config)
        builder.add_world(part)
    builder.add_ground_plane(cfg=config)
    return collided(builder, device)


def assert_rounded_alike(ours, theirs):
    """Poses and velocities after 60 iterations, to the tolerance that Newton's kernels are compared with."""
    error = 3.0 * 6e-8 * np.abs(theirs[0][:, :3]).max() / DT * 60**0.5  # m/s
    np.testing.assert_allclose(ours[1][:, :3], theirs[1][:, :3], rtol=0, atol=error)
    np.testing.assert_allclose(ours[1][:, 3:], theirs[1][:, 3:], rtol=0, atol=error / R)


@pytest.mark.cuda
@pytest.mark.parametrize("kind", KINDS)
def test_a_cluster_solves_as_launches_do(kind, device):
    """What is too much for it, launches solve to the same bits; compilers may round what it solves otherwise."""
    model, state, contacts = heap(kind, device)
    launches, left, cluster = (
        substep(altered(**changes), model, state, contacts) for changes in ({"cluster": 0}, {"most": 10}, {})
    )
    for value, expected in zip(left, launches, strict=True):
        np.testing.assert_array_equal(value, expected)
    assert_rounded_alike(cluster, launches)


@pytest.mark.cuda
@pytest.mark.parametrize("kind", ["ball", "capsule"])
def test_a_block_solves_a_world_as_launches_do(kind, device):
    model, state, contacts = worlds(kind, device)
    launches, blocks = (substep(altered(**changes), model, state, contacts) for changes in ({"worlds": 0}, {}))
    assert_rounded_alike(blocks, launches)
    assert np.abs(launches[1] - state.body_qd.numpy()).max() > 0.1


def test_cubes_that_are_pressed_together_keep_their_turn(device):
    """Two cubes face to face, drawn together along their line, turn about an axis across it: nothing changes that.

    With the levers of Newton's solver their angular momentum grows e-fold in 5 h/(3 a dt) = 56 ms, sixfold in all.
    """
    h, pull, spin, dt = R, 300.0, 2.0, 5e-4  # m, m/s², rad/s, s
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for side in (-1.0, 1.0):
        body = builder.add_body(xform=wp.transform((side * h, 0.0, 0.0)))
        builder.body_qd[body] = wp.spatial_vector(0.0, side * spin * h, 0.0, 0.0, 0.0, spin)
        config = newton.ModelBuilder.ShapeConfig(density=7874.0, mu=0.5, gap=0.1 * h)
        builder.add_shape_box(body, hx=h, hy=h, hz=h, cfg=config)
    model = builder.finalize(device=device)
    model.joint_count = 0
    solver = PileXPBD(model, CAPACITY, iterations=60, rigid_contact_relaxation=0.35, rigid_contact_con_weighting=False)
    pipeline = newton.CollisionPipeline(model, rigid_contact_max=CAPACITY)
    contacts, now, then = pipeline.contacts(), model.state(), model.state()
    mass, inertia = model.body_mass.numpy()[0], model.body_inertia.numpy()[0, 2, 2]

    def turn():
        q, u = now.body_q.numpy().astype(float), now.body_qd.numpy().astype(float)
        return (mass * np.cross(q[:, :3], u[:, :3])[:, 2] + inertia * u[:, 5]).sum()

    start = turn()
    for _ in range(200):
        centers = now.body_q.numpy()[:, :3]
        along = (centers[1] - centers[0]) / np.linalg.norm(centers[1] - centers[0])
        forces = np.zeros((2, 6), np.float32)
        forces[:, :3] = mass * pull * np.array([along, -along])
        now.body_f.assign(forces)
        pipeline.collide(now, contacts)
        solver.step(now, then, None, contacts, dt)
        now, then = then, now
    assert contacts.rigid_contact_count.numpy()[0] >= 4
    # Levers change the turn by 3/5 a dt²/h = 1 % of it in a substep, which is known to some per cent from the mean of
    # before and after: 1e-4 or so in each of 200 substeps.
    assert turn() == pytest.approx(start, rel=0.02)
