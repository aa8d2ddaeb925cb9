"""The search for shapes that may touch finds what Newton's comparison of all pairs finds."""

import newton
import numpy as np
import pytest
import warp as wp

from warpmag.engine.pile_xpbd.broad_phase import NeighborBroadPhase
from warpmag.engine.pile_xpbd.contacts import RigidSolver, body_sizes
from warpmag.kernels.contacts.broad_phase import allocate

FARTHEST = 0.02
"""How far ahead contacts are sought [m]: twice the radius of the balls."""
SUBSTEP = 5e-4


def random_scene(seed: int, worlds: int, device, largest: float = 0.03) -> newton.Model:
    """Balls of many sizes, boxes and capsules above a plane, some fixed, kinematic, or not to collide with others."""
    rng = np.random.default_rng(seed)
    scene = newton.ModelBuilder()
    for _ in range(max(worlds, 1)):
        builder = newton.ModelBuilder()
        for number in range(80):
            place = wp.transform(rng.uniform(0.0, 0.07, 3), wp.quat_identity())
            config = newton.ModelBuilder.ShapeConfig(gap=1e-3, collision_group=int(rng.choice([1, 1, 1, 1, 2, -1, -2])))
            body = -1 if number % 10 == 0 else builder.add_body(xform=place, is_kinematic=number % 17 == 0)
            where = place if body < 0 else wp.transform_identity()
            if number % 7 == 1:
                builder.add_shape_box(body, xform=where, hx=0.01, hy=0.004, hz=rng.uniform(0.003, largest), cfg=config)
            elif number % 7 == 2:
                builder.add_shape_capsule(body, xform=where, radius=0.004, half_height=0.01, cfg=config)
            else:
                radius = rng.choice([0.008, 0.01, largest], p=[0.5, 0.45, 0.05])
                builder.add_shape_sphere(body, xform=where, radius=radius, cfg=config)
        for a, b in rng.choice(builder.shape_count, (20, 2)):
            if a != b:
                builder.add_shape_collision_filter_pair(int(a), int(b))
        if worlds:
            scene.add_world(builder)
        else:
            scene.add_builder(builder)
    scene.add_ground_plane()
    return scene.finalize(device=device)


class Search:
    """Finds pairs and contacts of a model, by Newton's comparison of all pairs or by another search in its place."""

    def __init__(self, model, broad_phase=None):
        self.pipeline = newton.CollisionPipeline(
            model,
            broad_phase="nxn",
            speculative_contact_gap_max=FARTHEST,
            rigid_contact_max=100_000,
            verify_buffers=False,
        )
        if broad_phase is not None:
            self.pipeline.broad_phase = broad_phase
        self.contacts = self.pipeline.contacts()

    def find(self, state) -> tuple[set, list]:
        """Pairs of shapes, and contacts: both shapes and the first one's point [m]."""
        self.pipeline.collide(state, self.contacts, dt=SUBSTEP)
        count = int(self.pipeline.broad_phase_pair_count.numpy()[0])
        pairs = list(map(tuple, self.pipeline.broad_phase_shape_pairs.numpy()[:count].tolist()))
        assert len(set(pairs)) == len(pairs)
        count = int(self.contacts.rigid_contact_count.numpy()[0])
        shapes = [getattr(self.contacts, f"rigid_contact_shape{side}").numpy()[:count] for side in (0, 1)]
        points = self.contacts.rigid_contact_point0.numpy()[:count]
        return set(pairs), sorted(zip(*map(list, shapes), points.tolist(), strict=True))


def set_motion(model, state, rng, shift: float, speed: float):
    """Shift all bodies by up to ``shift`` [m] and give them velocities of up to ``speed`` [m/s]."""
    poses = state.body_q.numpy()
    poses[:, :3] += rng.uniform(-shift, shift, (len(poses), 3))
    state.body_q.assign(poses)
    velocities = rng.uniform(-speed, speed, (len(poses), 6)) * (1.0, 1.0, 1.0, 30.0, 30.0, 30.0)
    state.body_qd.assign(velocities.astype(np.float32))


@pytest.mark.parametrize(("worlds", "seed"), [(0, 0), (3, 2)])
def test_contacts_are_those_of_all_pairs(worlds, seed, device):
    model = random_scene(seed, worlds, device)
    state, rng = model.state(), np.random.default_rng(seed)
    newtons, own = Search(model), Search(model, NeighborBroadPhase(model, FARTHEST))
    balls = model.shape_type.numpy() == newton.GeoType.SPHERE
    # still, and moved by less and by more than lists allow; slow, and faster than contacts are sought ahead
    for shift, speed in ((0.0, 0.0), (1e-3, 0.1), (1e-3, 10.0), (1e-3, 100.0), (0.01, 1.0), (1e-4, 0.0)):
        set_motion(model, state, rng, shift, speed)
        pairs, contacts = newtons.find(state)
        result, own_contacts = own.find(state)
        assert own_contacts == contacts
        assert result <= pairs
        assert {pair for pair in pairs - result if not balls[list(pair)].all()} == set()
        assert len(contacts) > 100


def test_crowded_balls_are_found(device):
    """More neighbours than a list holds."""
    builder = newton.ModelBuilder()
    for place in np.random.default_rng(0).normal(0.0, 0.004, (150, 3)):
        builder.add_shape_sphere(builder.add_body(xform=wp.transform(place, wp.quat_identity())), radius=0.005)
    model = builder.finalize(device=device)
    contacts = Search(model).find(model.state())[1]
    result, own_contacts = Search(model, NeighborBroadPhase(model, FARTHEST)).find(model.state())
    assert own_contacts == contacts
    assert len(result) > 64 * 150 / 2


def test_many_other_shapes_are_swept(device, monkeypatch):
    monkeypatch.setattr("warpmag.kernels.contacts.broad_phase._MOST_COMPARISONS", 100)
    model = random_scene(3, 2, device)
    pairs, contacts = Search(model).find(model.state())
    result, own_contacts = Search(model, NeighborBroadPhase(model, FARTHEST)).find(model.state())
    assert (result, own_contacts) == (pairs, contacts)


@pytest.mark.parametrize(("balls", "others", "swept"), [(50_000, 600, False), (2_000, 9_000, True)])
def test_very_many_balls_find_each_other_among_some_hundred_others(balls, others, swept, device):
    """More comparisons than of fewer shapes, and still a small part of what a sort of all boxes compares."""
    count = balls + others
    radius = np.where(np.arange(count) < balls, 0.005, np.nan)
    world, body, all_of_them = np.zeros(count, int), np.arange(count), np.ones(count, bool)
    search = allocate(world, body, all_of_them, radius, farthest=FARTHEST, device=wp.get_device(device))
    assert (search is None) == swept


def test_nothing_collides(device):
    builder = newton.ModelBuilder()
    builder.add_body()
    model = builder.finalize(device=device)
    assert Search(model, NeighborBroadPhase(model, FARTHEST)).find(model.state()) == (set(), [])


def heap(device, *, free_box=False, static_cylinder=False):
    """Balls on a plane, a static box, and kinematic capsules that stand in the plane."""
    builder, rng = newton.ModelBuilder(), np.random.default_rng(4)
    builder.rigid_gap = 1e-3
    for place in rng.uniform(0.0, 0.05, (60, 3)):
        builder.add_shape_sphere(builder.add_body(xform=wp.transform(place, wp.quat_identity())), radius=0.005)
    for x in (0.0, 0.03):
        place = wp.transform((x, 0.02, 0.0), wp.quat_identity())
        builder.add_shape_capsule(builder.add_body(xform=place, is_kinematic=True), radius=0.004, half_height=0.02)
    at = wp.transform((0.02, 0.02, 0.01), wp.quat_identity())
    builder.add_shape_box(builder.add_body(xform=at) if free_box else -1, hx=0.02, hy=0.02, hz=0.01)
    if static_cylinder:
        builder.add_shape_cylinder(-1, xform=at, radius=0.02, half_height=0.01)
    builder.add_ground_plane()
    return builder.finalize(device=device)


@pytest.mark.parametrize("others", [{}, {"free_box": True}, {"static_cylinder": True}], ids="".join)
def test_newtons_narrow_phase_looks_where_something_is_left_to_it(others, device, monkeypatch):
    """And what moves by forces has all contacts that it has by comparing all pairs."""
    model = heap(device, **others)
    looked, narrow = [], newton.geometry.NarrowPhase.launch_custom_write

    def watched(self, **arguments):
        looked.append(1)
        narrow(self, **arguments)

    monkeypatch.setattr(newton.geometry.NarrowPhase, "launch_custom_write", watched)
    solver, state = RigidSolver(model, body_sizes(model)), model.state()
    solver.collide(state, SUBSTEP)
    assert bool(looked) == bool(others)
    count = int(solver.contacts.rigid_contact_count.numpy()[0])
    shapes = np.stack([getattr(solver.contacts, f"rigid_contact_shape{side}").numpy()[:count] for side in (0, 1)], 1)
    monkeypatch.undo()
    search = Search(model)
    search.pipeline = newton.CollisionPipeline(
        model, broad_phase="nxn", speculative_contact_gap_max=solver._speculation, rigid_contact_max=100_000
    )
    search.contacts = search.pipeline.contacts()
    held = (np.append(model.body_flags.numpy(), newton.BodyFlags.KINEMATIC) & newton.BodyFlags.KINEMATIC) != 0
    held = held[model.shape_body.numpy()]
    expected = [(a, b) for a, b, _ in search.find(state)[1] if not (held[a] and held[b])]
    assert sorted(map(tuple, shapes.tolist())) == expected
    assert len(expected) > 60
