"""Bodies that a permanent or fixed magnet holds, from the contacts of a model."""

import numpy as np

from warpmag.engine.magnets.magnetics import Magnetics
from warpmag.engine.pile_xpbd.contacts import BodySizes, RigidSolver

_TOUCHING = 0.05
"""Largest ratio of gap to thickness of bodies that count as touching."""


def held_bodies(magnetics: Magnetics, solver: RigidSolver, sizes: BodySizes) -> np.ndarray:
    """Return True for each body that a magnet holds, shape [bodies]; waits for the device."""
    model, contacts = magnetics.model, solver.contacts
    shape_body = model.shape_body.numpy()
    # each static shape counts as a body, numbered after the bodies of the model
    node = np.where(shape_body >= 0, shape_body, model.body_count + np.arange(model.shape_count))
    fixed = np.ones(model.body_count + model.shape_count, dtype=bool)
    fixed[: model.body_count] = ~np.isfinite(sizes.thickness)
    permanent = [magnet.magnet.kind == "permanent" for magnet in magnetics.magnets for _ in magnet.shapes]
    holds = np.zeros_like(fixed)
    holds[node[magnetics.shapes[fixed[node[magnetics.shapes]] | permanent]]] = True

    count = int(contacts.rigid_contact_count.numpy()[0])
    sides = [getattr(contacts, f"rigid_contact_shape{k}").numpy()[:count] for k in (0, 1)]
    pairs = node[np.stack(sides, axis=1)]
    touching = solver.overlaps.numpy()[:count] > -_TOUCHING
    return find_held(pairs[touching], holds, fixed)[: model.body_count]


def find_held(pairs: np.ndarray, holders: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Return True for each body that a magnet holds, from the bodies that touch, shape [n, 2].

    A held body touches a holder, a permanent or fixed magnet. Or it touches a held body, and neither of them is on the
    ground, a fixed body without magnets.
    """

    def neighbors(bodies: np.ndarray) -> np.ndarray:
        """Return True for each body that touches one of ``bodies``."""
        touched = np.zeros(len(fixed), dtype=bool)
        for first, second in (pairs.T, pairs.T[::-1]):
            touched[second[bodies[first]]] = True
        return touched

    grounded = neighbors(fixed & ~holders)
    touching = neighbors(holders) & ~fixed & ~holders
    held = touching
    while True:
        next_held = touching | (neighbors(held & ~grounded) & ~grounded & ~fixed & ~holders)
        if (next_held == held).all():
            return held
        held = next_held
