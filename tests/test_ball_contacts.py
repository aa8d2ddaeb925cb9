"""Contacts of balls are those that Newton's narrow phase finds, in all that its contacts hold."""

import newton
import numpy as np
import pytest
import warp as wp

from tests.test_broad_phase import FARTHEST, SUBSTEP, random_scene, set_motion
from warpmag.engine.broad_phase import NeighborBroadPhase

FIELDS = ("point0", "point1", "offset0", "offset1", "normal", "margin0", "margin1")
TOLERANCE = 1e-6
"""Of places [m] and unit vectors: float32 at 0.1 m, through the poses of bodies and back."""


def collide(model, state, own: bool, dt: float = SUBSTEP) -> dict[tuple, np.ndarray]:
    """Contacts by their shapes, each of several of one pair by its number, with all numbers of each."""
    pipeline = newton.CollisionPipeline(
        model, broad_phase="nxn", speculative_contact_gap_max=FARTHEST, rigid_contact_max=100_000, verify_buffers=False
    )
    contacts = pipeline.contacts()
    if own:
        pipeline.broad_phase = NeighborBroadPhase(model, FARTHEST)
        pipeline.broad_phase.write_contacts(pipeline, contacts)
        pipeline.broad_phase.set_motion(state, dt)
    pipeline.collide(state, contacts, dt=dt)
    count = int(contacts.rigid_contact_count.numpy()[0])
    numbers = np.hstack([getattr(contacts, f"rigid_contact_{name}").numpy()[:count].reshape(count, -1) for name in FIELDS])
    shapes = np.stack([getattr(contacts, f"rigid_contact_shape{end}").numpy()[:count] for end in (0, 1)], 1)
    found: dict[tuple, np.ndarray] = {}
    for row in np.lexsort((*numbers.T[::-1].round(5), *shapes.T[::-1])):
        key = tuple(shapes[row].tolist())
        found[*key, sum(key == other[:2] for other in found)] = numbers[row]
    return found


def assert_same(own, newtons):
    assert own.keys() == newtons.keys()
    assert len(own) > 0
    np.testing.assert_allclose(list(own.values()), [newtons[key] for key in own], rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize(("worlds", "seed"), [(0, 1), (3, 2)])
def test_contacts_are_newtons(worlds, seed, device):
    model = random_scene(seed, worlds, device)
    state, rng = model.state(), np.random.default_rng(seed)
    for shift, speed in ((0.0, 0.0), (1e-3, 0.1), (1e-3, 10.0), (0.01, 1.0)):
        set_motion(model, state, rng, shift, speed)
        for dt in (SUBSTEP, 0.0):
            assert_same(collide(model, state, True, dt), collide(model, state, False, dt))
