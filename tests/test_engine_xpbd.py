"""Newton's XPBD as mended here: what it solves, what that conserves, and that it repeats."""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp

from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.kernels.contacts.solve import RECOVERY_SPEED

R, DT = 0.005, 5e-4  # m, s
OVERLAP = 2e-4  # of balls over their radius, where friction should not depend on it
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


def search(model):
    """Newton's search for contacts, in the form that a run compiles, too, although nothing is sought ahead."""
    pipeline = newton.CollisionPipeline(model, rigid_contact_max=CAPACITY, speculative_contact_gap_max=0.0)
    return pipeline, pipeline.contacts()


def collided(builder, device):
    """The model, its state and its contacts."""
    model = builder.finalize(device=device)
    model.joint_count = 0  # all of them free
    state = model.state()
    pipeline, contacts = search(model)
    pipeline.collide(state, contacts, dt=DT)
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


def substep(solver, model, state, contacts, iterations=60, count=1):
    """Poses and velocities after a substep, or more of them with the same contacts."""
    begin, end = model.state(), model.state()
    begin.assign(state)
    settings = {"rigid_contact_relaxation": 0.35, "rigid_contact_con_weighting": False}
    solver = solver(model, CAPACITY, iterations=iterations, **settings)
    for _ in range(count):
        solver.step(begin, end, None, contacts, DT)
        begin, end = end, begin
    return begin.body_q.numpy().astype(float), begin.body_qd.numpy().astype(float)


class NewtonsXPBD(PileXPBD):
    """Newton's own kernels, with split masses as ours."""

    def __init__(self, model, contact_max, **settings):
        super().__init__(model, contact_max, **settings)
        self._solve = None


def altered(**changes):
    """The solver with other settings of its contact solve."""

    class Altered(PileXPBD):
        def __init__(self, *arguments, **settings):
            super().__init__(*arguments, **settings)
            self._solve = dataclasses.replace(self._solve, **changes)

    return Altered


def spread(device):
    """Balls by themselves on the ground or on a moving belt, fast and slow, and pairs of them in the air."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(density=7874.0, gap=0.1 * R, mu=0.3, mu_torsional=0.0, mu_rolling=0.0)
    builder.add_ground_plane(cfg=config)
    belt = builder.add_body(xform=wp.transform((0.0, 0.2, 0.0)), is_kinematic=True)
    builder.add_shape_box(belt, hx=1.0, hy=0.1, hz=0.1 * R, cfg=config)
    builder.body_qd[belt] = wp.spatial_vector(0.3, 0.2, 0.0, 0.0, 0.0, 0.1)
    random = np.random.default_rng(3)
    for i, j in np.ndindex(6, 6):
        height = (1.0, 1.1, 10.0)[j // 2] * R
        at = np.array([5.0 * R * (i - 3), 0.15 * (j // 2 % 2) + 5.0 * R * (j % 2), height - OVERLAP * R])
        for k in range(1 + (j >= 4)):
            along = (2.0 - OVERLAP) * R * np.array([2.0, 2.0, 1.0]) / 3.0
            body = builder.add_body(xform=wp.transform(at + k * along, wp.quat_rpy(0.3 + 0.1 * i, 0.4, 0.2 * j)))
            add_shape(builder, "ball", body, config)
            velocity = random.normal(scale=0.1 if i < 3 else 0.4, size=6)
            velocity[2] = -0.2 - abs(velocity[2]) if k == 0 and j < 4 else 0.5 * (1 - 2 * k)
            builder.body_qd[body] = wp.spatial_vector(*velocity[:3], *velocity[3:])
    return collided(builder, device)


def test_a_substep_of_balls_ends_as_newtons_kernels_do(device):
    """Where no push has to be taken back, both end at the same velocities, of contacts that slip and that do not.

    They need not in a heap: pushes that overshoot, and stay, make Newton's end depend on its relaxation. And friction
    acts on two balls at one point here, which is off the surfaces by half of their overlap.
    """
    model, state, contacts = spread(device)
    theirs, ours = (substep(solver, model, state, contacts) for solver in (NewtonsXPBD, PileXPBD))
    push = theirs[1] - state.body_qd.numpy()
    assert (np.abs(push[:, :3]).max(1) > 1e-2).sum() > 40 and (np.abs(push[:, 3:]).max(1) > 1.0).sum() > 20
    # positions of up to 0.2 m in float32, from which Newton's kernels take gaps and slips, 60 times
    rounding = 3.0 * 6e-8 * 0.2 / DT * 60**0.5  # m/s
    for part, size in ((slice(0, 3), 1.0), (slice(3, 6), R)):
        scale = np.abs(push[:, part]).max()
        np.testing.assert_allclose(
            ours[1][:, part], theirs[1][:, part], rtol=0, atol=(1e-4 + OVERLAP) * scale + rounding / size
        )


def matrices(model, state, contacts):
    """Gaps [m] and a row of six for each contact and body, in float64: how velocities of bodies open them."""
    count = contacts.rigid_contact_count.numpy()[0]
    shape_body, body_q = model.shape_body.numpy(), state.body_q.numpy().astype(float)
    rows, gaps = np.zeros((count, model.body_count, 6)), np.zeros(count)
    values = {name: getattr(contacts, f"rigid_contact_{name}").numpy()[:count].astype(float) for name in CONTACT}
    for c in range(count):
        points, surfaces, centers, bodies = [], [], [], []
        for end in (0, 1):
            body = shape_body[int(values[f"shape{end}"][c])]
            q = wp.transform(*body_q[body]) if body >= 0 else wp.transform_identity()
            point, offset = values[f"point{end}"][c], values[f"offset{end}"][c]
            points.append(np.array(wp.transform_point(q, wp.vec3(*point)), float))
            surfaces.append(np.array(wp.transform_point(q, wp.vec3(*(point + offset))), float))
            center = model.body_com.numpy()[body] if body >= 0 else np.zeros(3)
            centers.append(np.array(wp.transform_point(q, wp.vec3(*center)), float))
            bodies.append(body)
        normal = values["normal"][c]
        gaps[c] = normal @ (points[1] - points[0]) - values["margin0"][c] - values["margin1"][c]
        weights = [model.body_inv_mass.numpy()[body] if body >= 0 else 0.0 for body in bodies]
        at = (weights[0] * surfaces[0] + weights[1] * surfaces[1]) / sum(weights)
        for end, sign in ((0, -1.0), (1, 1.0)):
            if bodies[end] >= 0:
                arm = at - centers[end]
                rows[c, bodies[end]] += sign * np.concatenate([normal, np.cross(arm, normal)])
    return rows, gaps


CONTACT = "shape0 shape1 point0 point1 offset0 offset1 normal margin0 margin1".split()


@pytest.mark.parametrize("kind", KINDS)
def test_a_substep_pushes_as_little_as_it_has_to(kind, device):
    """Without friction contacts ask for a convex problem, the least impulses that leave no overlap; here in float64.

    Bodies with many contacts take many iterations: meshes are 15 % of the correction off after 300 and 1.4 after 3,000.
    """
    model, state, contacts = heap(kind, device, ground=False)
    for material in (model.shape_material_mu, model.shape_material_mu_torsional, model.shape_material_mu_rolling):
        material.zero_()
    rows, gaps = matrices(model, state, contacts)
    inverse = np.zeros((model.body_count, 6, 6))
    for body in range(model.body_count):
        turn = np.array(wp.quat_to_matrix(wp.quat(*state.body_q.numpy()[body, 3:].tolist())), float).reshape(3, 3)
        inverse[body, :3, :3] = model.body_inv_mass.numpy()[body] * np.eye(3)
        inverse[body, 3:, 3:] = turn @ model.body_inv_inertia.numpy()[body] @ turn.T
    moved = np.einsum("bij,cbj->cbi", inverse, rows)
    before = state.body_qd.numpy().astype(float)
    system = np.einsum("cbi,dbi->cd", rows, moved)
    start = np.einsum("cbi,bi->c", rows, before) + np.maximum(gaps / DT, -RECOVERY_SPEED)
    impulse = ahead = np.zeros(len(gaps))
    step = 1.0 / np.linalg.eigvalsh(system)[-1]
    for iteration in range(10_000):  # Nesterov's, begun anew where it goes too far
        last, impulse = impulse, np.maximum(ahead - step * (system @ ahead + start), 0.0)
        onward = 0.0 if (ahead - impulse) @ (impulse - last) > 0.0 else iteration / (iteration + 3)
        ahead = impulse + onward * (impulse - last)
    change = np.einsum("cbi,c->bi", moved, impulse)
    assert (system @ impulse + start).min() > -1e-5 * np.abs(change[:, :3]).max()  # the oracle has arrived
    _, qd = substep(PileXPBD, model, state, contacts, 30_000)
    # a turn by ω dt changes the angular velocity of a body that keeps its angular momentum
    turn = DT * np.abs(before[:, 3:] + change[:, 3:]).max()
    size, rounding = np.abs(change[:, :3]).max(), 3.0 * 6e-8 / DT * np.abs(state.body_q.numpy()[:, :3]).max()
    np.testing.assert_allclose(qd[:, :3], (before + change)[:, :3], rtol=0, atol=1e-4 * size + rounding)
    tolerance = (1e-4 + turn) * np.abs(change[:, 3:]).max() + (1e-5 * size + rounding) / R
    np.testing.assert_allclose(qd[:, 3:], (before + change)[:, 3:], rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", ["ball", "box", "capsule"])
def test_a_clump_keeps_momentum_and_angular_momentum(kind, device):
    """Bodies that rub and are drawn together by forces without a sum or a moment, for 1,000 substeps.

    In each, float32 rounds a velocity and a position of some tens of bodies by 3e-8: 1e-6 in all where errors add up as
    squares, ten times that where they do not.
    """
    model, state, _ = heap(kind, device, ground=False)
    (pipeline, contacts), other = search(model), model.state()
    settings = {"rigid_contact_relaxation": 0.35, "rigid_contact_con_weighting": False}
    solver = PileXPBD(model, CAPACITY, iterations=20, **settings)
    mass, inertia = model.body_mass.numpy().astype(float), model.body_inertia.numpy().astype(float)

    def momenta(state):
        q, qd = state.body_q.numpy().astype(float), state.body_qd.numpy().astype(float)
        x, (a, b, c, w), v, spin = q[:, :3], q[:, 3:].T, qd[:, :3], qd[:, 3:]
        turn = np.array(
            [
                [1 - 2 * (b * b + c * c), 2 * (a * b - c * w), 2 * (a * c + b * w)],
                [2 * (a * b + c * w), 1 - 2 * (a * a + c * c), 2 * (b * c - a * w)],
                [2 * (a * c - b * w), 2 * (b * c + a * w), 1 - 2 * (a * a + b * b)],
            ]
        ).transpose(2, 0, 1)
        own = np.einsum("nij,njk,nlk,nl->ni", turn, inertia, turn, spin)
        return x, v, mass @ v, (np.cross(x, mass[:, None] * v) + own).sum(0)

    x, v, linear, angular = momenta(state)
    sizes = (mass * np.linalg.norm(v, axis=1)).sum(), (mass * np.linalg.norm(np.cross(x, v), axis=1)).sum()
    speed = 0.0
    for _ in range(1000):
        x = momenta(state)[0]
        forces = np.zeros((len(mass), 6), np.float32)
        forces[:, :3] = -2e4 * mass[:, None] * (x - mass @ x / mass.sum())
        state.body_f.assign(forces)
        pipeline.collide(state, contacts, dt=DT)
        solver.step(state, other, None, contacts, DT)
        state, other = other, state
        speed = max(speed, np.abs(state.body_qd.numpy()[:, :3]).max())
    assert contacts.rigid_contact_count.numpy()[0] > len(mass) and speed > 0.2
    _, _, linear_after, angular_after = momenta(state)
    assert np.linalg.norm(linear_after - linear) < 1e-5 * sizes[0]
    assert np.linalg.norm(angular_after - angular) < 1e-5 * sizes[1]


@pytest.mark.parametrize("kind", ["ball", "box", "plate"])
def test_a_substep_repeats_bit_by_bit(kind, device):
    """By any number of threads; on a GPU, by a cluster and by launches, for contacts that were found in any order.

    Each remembers in the second substep how far it slipped in the first.
    """
    on_gpu = wp.get_device(device).is_cuda
    model, state, contacts = heap(kind, device)
    forms = [({}, {}), ({"cluster": 0}, {"cluster": 0})] if on_gpu else [({}, {"limit": 3})]
    first = [substep(altered(**changes), model, state, contacts, count=2) for changes, _ in forms]
    order = np.arange(contacts.rigid_contact_count.numpy()[0])
    if on_gpu:
        np.random.default_rng(0).shuffle(order)
    for name in "shape0 shape1 point0 point1 offset0 offset1 margin0 margin1 normal".split():
        array = getattr(contacts, f"rigid_contact_{name}")
        values = array.numpy()
        values[: len(order)] = values[order]
        array.assign(values)
    for (_, changes), before in zip(forms, first, strict=True):
        for value, expected in zip(substep(altered(**changes), model, state, contacts, count=2), before, strict=True):
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
        substep(altered(**changes), model, state, contacts) for changes in ({"cluster": 0}, {"limit": 10}, {})
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
    (pipeline, contacts), now, then = search(model), model.state(), model.state()
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
        pipeline.collide(now, contacts, dt=dt)
        solver.step(now, then, None, contacts, dt)
        now, then = then, now
    assert contacts.rigid_contact_count.numpy()[0] >= 4
    assert turn() == pytest.approx(start, rel=1e-4)  # 200 substeps whose rounding errors of 1e-7 need not cancel


@pytest.mark.parametrize("seconds", [0.5, pytest.param(10.0, marks=pytest.mark.long)])
def test_a_stack_of_boxes_stays(seconds, device):
    """Ten boxes, of which the lowest bears ten times its weight; a tenth of a radius in 10 s is what they may creep."""
    builder = newton.ModelBuilder()
    config = newton.ModelBuilder.ShapeConfig(density=7874.0, mu=0.5, gap=0.1 * R)
    builder.add_ground_plane(cfg=config)
    for level in range(10):
        body = builder.add_body(xform=wp.transform((0.0, 0.0, (1 + 2 * level) * R), wp.quat_rpy(0.0, 0.0, 0.1 * level)))
        builder.add_shape_box(body, hx=R, hy=R, hz=R, cfg=config)
    model = builder.finalize(device=device)
    model.joint_count = 0
    solver = PileXPBD(model, CAPACITY, iterations=30, rigid_contact_relaxation=0.35, rigid_contact_con_weighting=False)
    (pipeline, contacts), now, then = search(model), model.state(), model.state()

    def run(seconds):
        nonlocal now, then
        for _ in range(round(seconds / DT)):
            pipeline.collide(now, contacts, dt=DT)
            solver.step(now, then, None, contacts, DT)
            now, then = then, now
        return now.body_q.numpy()[:, :3].astype(float)

    before = run(0.1)
    crept = np.linalg.norm(run(seconds) - before, axis=1).max()
    assert crept < 0.1 * R * seconds / 10.0
