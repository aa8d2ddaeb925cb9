"""Contacts of balls are those that Newton's narrow phase finds, in all that its contacts hold."""

from collections import Counter

import newton
import numpy as np
import pytest
import warp as wp
from test_broad_phase import FARTHEST, SUBSTEP, random_scene, set_motion

from warpmag.engine.pile_xpbd.broad_phase import NeighborBroadPhase

FIELDS = ("point0", "point1", "offset0", "offset1", "normal", "margin0", "margin1")
TOLERANCE = np.full(17, 1e-7)
"""Of each of these numbers: places [m] to several roundings of float32 at 0.1 m, on ways through poses of bodies and
back; and unit normals, which are differences of such places over 5 mm."""
TOLERANCE[12:15] = 1e-7 / 5e-3


class Finder:
    """Finds the contacts of a model, with Newton's pipeline alone or with the own search in it."""

    def __init__(self, model, own: bool, contact_max: int = 100_000):
        self.pipeline = newton.CollisionPipeline(
            model,
            broad_phase="nxn",
            speculative_contact_gap_max=FARTHEST,
            rigid_contact_max=contact_max,
            verify_buffers=False,
        )
        self.contacts = self.pipeline.contacts()
        self.own = None
        if own:
            self.own = self.pipeline.broad_phase = NeighborBroadPhase(model, FARTHEST)
            self.own.write_contacts(self.pipeline, self.contacts)

    def collide(self, state, dt: float = SUBSTEP) -> dict[tuple, np.ndarray]:
        """All numbers of each contact, by its shapes and its number among those of them."""
        if self.own is not None:
            self.own.set_motion(state, dt)
        self.pipeline.collide(state, self.contacts, dt=dt)
        count = min(self.contacts.rigid_contact_count.numpy()[0], self.contacts.rigid_contact_max)
        columns = [getattr(self.contacts, f"rigid_contact_{name}").numpy()[:count] for name in FIELDS]
        numbers = np.hstack([column.reshape(count, -1) for column in columns])
        shapes = np.stack([getattr(self.contacts, f"rigid_contact_shape{end}").numpy()[:count] for end in (0, 1)], 1)
        result, seen = {}, Counter()
        for row in np.lexsort((*numbers.T[::-1].round(5), *shapes.T[::-1])):
            key = tuple(shapes[row].tolist())
            result[*key, seen[key]] = numbers[row]
            seen[key] += 1
        return result

    def pairs(self) -> int:
        """Pairs that were left to Newton's narrow phase."""
        return int(self.pipeline.broad_phase_pair_count.numpy()[0])


def turned(rng, place=(0.0, 0.0, 0.0)):
    axis = rng.normal(size=4)
    return wp.transform(wp.vec3(*place), wp.quat(*(axis / np.linalg.norm(axis))))


def turned_scene(device) -> newton.Model:
    """Balls, boxes and capsules away from the middle of turned bodies, with margins; planes that lean, and balls inside
    boxes and at one place."""
    rng, builder = np.random.default_rng(5), newton.ModelBuilder()
    for number in range(90):
        body = -1 if number % 9 == 0 else builder.add_body(xform=turned(rng, rng.uniform(0.0, 0.06, 3)))
        where = turned(rng, rng.uniform(0.0, 0.06, 3) if body < 0 else rng.normal(0.0, 0.004, 3))
        config = newton.ModelBuilder.ShapeConfig(gap=1e-3, margin=float(rng.choice([0.0, 5e-4])))
        if number % 3 == 0:
            builder.add_shape_box(body, xform=where, hx=0.012, hy=0.009, hz=0.007, cfg=config)
        elif number % 3 == 1 and number % 2:
            builder.add_shape_capsule(body, xform=where, radius=0.004, half_height=0.006, cfg=config)
        else:
            builder.add_shape_sphere(body, xform=where, radius=rng.choice([0.004, 0.005]), cfg=config)
    for _ in range(2):
        builder.add_shape_sphere(builder.add_body(), radius=0.005)
    builder.add_shape_plane(xform=turned(rng, (0.03, 0.03, 0.03)), width=0.0, length=0.0)
    builder.add_shape_plane(xform=turned(rng, (0.02, 0.04, 0.03)), width=0.02, length=0.03)
    return builder.finalize(device=device)


@pytest.mark.parametrize("scene", ["one world", "three worlds", "turned"])
def test_contacts_are_newtons(scene, device):
    model = turned_scene(device) if scene == "turned" else random_scene(1, 3 if scene == "three worlds" else 0, device)
    kinds, names = model.shape_type.numpy(), newton.GeoType
    finders = [Finder(model, own) for own in (True, False)]
    state, rng, together = model.state(), np.random.default_rng(1), set()
    for shift, speed in ((0.0, 0.0), (1e-3, 0.1), (1e-3, 10.0), (0.01, 1.0)):
        set_motion(model, state, rng, shift, speed)
        for dt in (SUBSTEP, 0.0):
            own, newtons = (finder.collide(state, dt) for finder in finders)
            assert own.keys() == newtons.keys()
            difference = np.array(list(own.values())) - [newtons[key] for key in own]
            assert (abs(difference) <= TOLERANCE).all()
            together |= {frozenset(kinds[list(key[:2])].tolist()) for key in own}
    assert together >= {
        frozenset((names.SPHERE, kind)) for kind in (names.PLANE, names.SPHERE, names.CAPSULE, names.BOX)
    }


def test_boxes_apart_are_left_out(device):
    """None that touches or comes near, and nearly all that are too far apart for contacts."""
    rng, builder = np.random.default_rng(3), newton.ModelBuilder()
    for number in range(250):
        size = np.exp(rng.uniform(np.log(0.001), np.log(0.015), 3))
        # some stand along each other, whose edges have no normal together
        axes = turned(rng) if number % 3 else wp.transform_identity()
        place = wp.transform(wp.vec3(*rng.uniform(0.0, 0.1, 3)), wp.transform_get_rotation(axes))
        config = newton.ModelBuilder.ShapeConfig(gap=2e-4, margin=float(rng.choice([0.0, 1e-4])), density=1e5)
        body = builder.add_body(xform=place)
        builder.add_shape_box(
            body, xform=turned(rng, (0.0, 0.0, 0.003)), hx=size[0], hy=size[1], hz=size[2], cfg=config
        )
    model = builder.finalize(device=device)
    own, newtons, state = Finder(model, True), Finder(model, False), model.state()
    for speed in (0.0, 1.0, 20.0):
        set_motion(model, state, rng, 0.0, speed)
        result = own.collide(state)
        assert result.keys() == newtons.collide(state).keys()
        touching = len({key[:2] for key in result})
        assert 100 < touching <= own.pairs() < newtons.pairs()
        assert speed > 0.0 or own.pairs() < 1.1 * touching < 0.5 * newtons.pairs()


def test_too_many_contacts_are_counted(device):
    """Both what chunks of targets note and what contacts have room for are exceeded."""
    builder = newton.ModelBuilder()
    for place in np.random.default_rng(0).normal(0.0, 0.004, (150, 3)):
        builder.add_shape_sphere(builder.add_body(xform=wp.transform(place, wp.quat_identity())), radius=0.005)
    model = builder.finalize(device=device)
    state, few = model.state(), Finder(model, True, contact_max=1000)
    newtons, own = Finder(model, False).collide(state), Finder(model, True)
    result = own.collide(state)
    assert (result.keys(), own.pairs()) == (newtons.keys(), 0)
    assert len(result) > 16 * 150
    kept = few.collide(state)
    assert few.contacts.rigid_contact_count.numpy()[0] == len(result)
    assert len(kept) == 1000
    assert kept.keys() <= result.keys()
