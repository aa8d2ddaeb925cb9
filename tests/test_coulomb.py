"""A substep's contacts meet Coulomb's law: its conditions in float64, from the impulses that the solve ended with.

With friction they have no unique solution, so that two solvers may end apart and both be right. Impulses are read as a
CPU lays them out; that a GPU ends alike is compared elsewhere.
"""

from typing import NamedTuple

import newton
import numpy as np
import pytest
import warp as wp

from tests.test_engine_xpbd import CAPACITY, CONTACT, DT, NewtonsXPBD, heap, substep
from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.kernels.contacts.solve import RECOVERY_SPEED
from warpmag.kernels.shared.native import CHUNK

G = 9.81  # m/s²
SETTINGS = {"rigid_contact_relaxation": 0.35, "rigid_contact_con_weighting": False}


class Ends(NamedTuple):
    """A contact in the world's frame: bodies, arms to where it acts, whether they give way, normal, gap, impulse."""

    bodies: list
    arms: list
    gives: list
    normal: np.ndarray
    gap: float
    impulse: np.ndarray


def contact_ends(model, state, contacts, impulses):
    """The contacts, with the ``impulses`` [N·s] on their second bodies."""
    count = contacts.rigid_contact_count.numpy()[0]
    value = {name: getattr(contacts, f"rigid_contact_{name}").numpy()[:count].astype(float) for name in CONTACT}
    shape_body, body_q, com = model.shape_body.numpy(), state.body_q.numpy(), model.body_com.numpy()
    mass = masses(model)
    results = []
    for c in range(count):
        shapes = int(value["shape0"][c]), int(value["shape1"][c])
        bodies = [shape_body[shape] for shape in shapes]
        inverse = [1.0 / mass[body] if body >= 0 else 0.0 for body in bodies]
        if sum(inverse) == 0.0:
            continue
        frames = [wp.transform(*body_q[body]) if body >= 0 else wp.transform_identity() for body in bodies]

        def world(end, point, frames=frames):
            return np.array(wp.transform_point(frames[end], wp.vec3(*point)), float)

        points = [world(end, value[f"point{end}"][c]) for end in (0, 1)]
        surfaces = [world(end, value[f"point{end}"][c] + value[f"offset{end}"][c]) for end in (0, 1)]
        at = (inverse[0] * surfaces[0] + inverse[1] * surfaces[1]) / sum(inverse)
        normal = value["normal"][c]
        gap = normal @ (points[1] - points[0]) - value["margin0"][c] - value["margin1"][c]
        arms = [at - world(end, com[body]) if body >= 0 else at for end, body in enumerate(bodies)]
        results.append(Ends(bodies, arms, [entry > 0.0 for entry in inverse], normal, gap, impulses[c]))
    return results


def masses(model):
    kinematic = (model.body_flags.numpy() & newton.BodyFlags.KINEMATIC) != 0
    return np.where(kinematic, np.inf, model.body_mass.numpy().astype(float))


def velocities(model, state, ends, gravity):
    """Velocities that gravity and the impulses of contacts give the bodies, before they turn, shape [bodies, 6]."""
    mass, qd = masses(model), state.body_qd.numpy().astype(float)
    gains = np.zeros_like(qd)
    for end in ends:
        for body, arm, sign in zip(end.bodies, end.arms, (-1.0, 1.0), strict=True):
            if body >= 0:
                gains[body] += sign * np.concatenate([end.impulse, np.cross(arm, end.impulse)])
    for body in np.flatnonzero(np.isfinite(mass)):
        turn = np.array(wp.quat_to_matrix(wp.quat(*state.body_q.numpy()[body, 3:].tolist())), float).reshape(3, 3)
        qd[body, :3] += gains[body, :3] / mass[body] - (0.0, 0.0, gravity * DT)
        qd[body, 3:] += turn @ model.body_inv_inertia.numpy()[body] @ turn.T @ gains[body, 3:]
    return qd


def surface_velocities(contact, qd):
    ends = zip(contact.bodies, contact.arms, strict=True)
    return [qd[body, :3] + np.cross(qd[body, 3:], arm) if body >= 0 else np.zeros(3) for body, arm in ends]


def opening_speed(contact, v):
    """By which surfaces open faster than they have to; those that are moved do not close gaps."""
    return (contact.gives[1] * v[1] - contact.gives[0] * v[0]) @ contact.normal + max(contact.gap / DT, -RECOVERY_SPEED)


def solve(solver, model, state, contacts):
    """The contacts with their impulses, and the state after a substep."""
    begin, end = model.state(), model.state()
    begin.assign(state)
    solver.step(begin, end, None, contacts, DT)
    work = solver._solve.work
    last = work["impulse"].numpy().reshape(-1, 12, CHUNK)[:, :3].swapaxes(1, 2).reshape(-1, 3).astype(float)
    listed = work["entry"].numpy()[: len(last)].tolist()
    impulses = dict(zip(listed[::-1], last[::-1], strict=True))  # of a repeated entry, the first one counts
    return contact_ends(model, state, contacts, impulses), end.body_qd.numpy().astype(float)


@pytest.mark.parametrize(
    "kind, mu, ground", [("ball", 0.5, True), ("capsule", 0.5, True), ("box", 0.5, True), ("mesh", 0.1, False)]
)
def test_contacts_meet_coulombs_law(kind, mu, ground):
    """They open, or push, not both; what sticks does not slip; what slips is rubbed against, by μ times the push.

    Tetrahedra that overlap and wedge each other with more friction have no solution near: impulses grow without end.
    """
    model, state, contacts = heap(kind, "cpu", ground=ground)
    model.shape_material_mu.fill_(mu)
    for material in (model.shape_material_mu_torsional, model.shape_material_mu_rolling):
        material.zero_()
    ends, after = solve(PileXPBD(model, CAPACITY, iterations=30_000, **SETTINGS), model, state, contacts)
    qd = velocities(model, state, ends, G if ground else 0.0)
    size = np.abs(qd - state.body_qd.numpy())[:, :3].max()
    np.testing.assert_allclose(after[:, :3], qd[:, :3], rtol=0, atol=1e-4 * size)
    most = max(end.impulse @ end.normal for end in ends)
    kinds = set()
    for end in ends:
        v = surface_velocities(end, qd)
        slip = v[1] - v[0]
        slip -= (slip @ end.normal) * end.normal
        opening = opening_speed(end, v)
        push = end.impulse @ end.normal
        rub = end.impulse - push * end.normal
        assert opening > -1e-4 * size and push >= -1e-6 * most and np.linalg.norm(rub) <= mu * push + 1e-6 * most
        if push < 1e-4 * most:  # as good as none
            continue
        sticks = np.linalg.norm(rub) < (1.0 - 1e-4) * mu * push
        kinds.add("sticks" if sticks else "slips")
        assert opening < 1e-4 * size
        along = np.zeros(3) if sticks else -rub / np.linalg.norm(rub)
        assert np.linalg.norm(slip - max(0.0, slip @ along) * along) < 1e-4 * size
    assert ("sticks" if mu == 0.5 else "slips") in kinds


@pytest.mark.parametrize("kind", ["ball", "box", "capsule", "mesh"])
def test_thirty_iterations_leave_no_more_overlap_than_newtons_sixty(kind):
    model, state, contacts = heap(kind, "cpu")
    ends, ours = solve(PileXPBD(model, CAPACITY, iterations=30, **SETTINGS), model, state, contacts)
    theirs = substep(NewtonsXPBD, model, state, contacts, 60)[1]
    left, newtons = (min(opening_speed(end, surface_velocities(end, qd)) for end in ends) for qd in (ours, theirs))
    assert left >= min(0.0, newtons)
