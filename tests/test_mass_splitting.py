"""Shares of bodies, and what goes wrong without them: iterations that overshoot."""

import newton
import numpy as np
import pytest
import warp as wp
from test_engine_xpbd import search

import warpmag
from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.kernels.contacts.solve import FRICTION, MOMENTUM
from warpmag.scenes_usd import bundled

R, DT, RELAXATION = 0.005, 5e-4, 0.35
STABLE = 2.0 * (1.0 + MOMENTUM) / (1.0 + 2.0 * MOMENTUM)


def turned(q, v):
    return np.array(wp.quat_rotate(wp.quat(*q.tolist()), wp.vec3(*v.tolist())), float)


def heap(device, friction):
    """Boxes face to face, capsules, and small balls below a large light one."""
    builder = newton.ModelBuilder()
    mu = {"mu": 0.5, "mu_torsional": 0.1, "mu_rolling": 0.02} if friction else dict.fromkeys(
        ("mu", "mu_torsional", "mu_rolling"), 0.0
    )  # fmt: skip
    config = newton.ModelBuilder.ShapeConfig(density=7874.0, gap=0.1 * R, **mu)
    light = newton.ModelBuilder.ShapeConfig(density=100.0, gap=0.1 * R, **mu)
    for k in range(4):
        body = builder.add_body(
            xform=wp.transform((0.1 * R * k, 0.0, 2.0 * 0.599 * R * k), wp.quat_rpy(0.0, 0.0, 0.3 * k))
        )
        builder.add_shape_box(body, hx=2.0 * R, hy=R, hz=0.6 * R, cfg=config)
    for k in range(3):
        body = builder.add_body(xform=wp.transform((0.0, 1.9 * R + 0.99 * R * k, 0.0), wp.quat_rpy(0.0, 1.5, 0.0)))
        builder.add_shape_capsule(body, radius=0.5 * R, half_height=R, cfg=config)
    large = builder.add_body(xform=wp.transform((0.3, 0.0, 0.0)))
    builder.add_shape_sphere(large, radius=4.0 * R, cfg=light)
    for x, y in np.ndindex(5, 5):
        at = np.array([0.3 * (x - 2), 0.3 * (y - 2), -1.0])
        body = builder.add_body(xform=wp.transform(at / np.linalg.norm(at) * 4.395 * R + (0.3, 0.0, 0.0)))
        builder.add_shape_sphere(body, radius=0.4 * R, cfg=config)
    return builder


@pytest.mark.parametrize("friction", [False, True])
def test_all_contacts_together_overshoot_less_than_momentum_bears(friction, device):
    """The largest eigenvalue of the iteration, with all rows as if none of them were clamped, in float64."""
    model = heap(device, friction).finalize(device=device)
    model.joint_count = 0
    state = model.state()
    pipeline, contacts = search(model)
    pipeline.collide(state, contacts, dt=DT)
    solver = PileXPBD(model, 1000, rigid_contact_relaxation=RELAXATION, rigid_contact_con_weighting=False)
    solver.step(state, model.state(), None, contacts, DT)
    shares = solver._shares.numpy().astype(float)
    count = int(contacts.rigid_contact_count.numpy()[0])
    assert count > 40 and shares.max() > 2.0
    q, body_of = state.body_q.numpy().astype(float), model.shape_body.numpy()
    roots = np.zeros((model.body_count, 6, 6))  # M^-½, of a symmetric root in the world's frame
    for body in range(model.body_count):
        turn = np.array([turned(q[body, 3:], axis) for axis in np.eye(3)]).T
        values, vectors = np.linalg.eigh(turn @ model.body_inv_inertia.numpy()[body] @ turn.T)
        roots[body, :3, :3] = np.sqrt(model.body_inv_mass.numpy()[body]) * np.eye(3)
        roots[body, 3:, 3:] = vectors * np.sqrt(values) @ vectors.T
    rows = []
    for i in range(count):
        n = contacts.rigid_contact_normal.numpy()[i].astype(float)
        a = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        a /= np.linalg.norm(a)
        groups = [(RELAXATION, [n], False)]
        if friction:
            groups += [(FRICTION * RELAXATION, [a, np.cross(n, a)], False), (FRICTION * RELAXATION, np.eye(3), True)]
        for part, directions, turns in groups:
            block, ease = np.zeros((len(directions), model.body_count, 6)), 0.0
            for end, sign in ((0, -1.0), (1, 1.0)):
                body = body_of[getattr(contacts, f"rigid_contact_shape{end}").numpy()[i]]
                at = [getattr(contacts, f"rigid_contact_{name}{end}").numpy()[i] for name in ("point", "offset")]
                arm = turned(q[body, 3:], (at[0] + at[1] - model.body_com.numpy()[body]).astype(float))
                for k, t in enumerate(directions):
                    wrench = np.concatenate([np.zeros(3), t] if turns else [t, np.cross(arm, t)])
                    block[k, body] = sign * roots[body] @ wrench
                ease += shares[body] * np.linalg.eigvalsh(block[:, body] @ block[:, body].T)[-1]
            rows += list(np.sqrt(part / ease) * block.reshape(len(directions), -1))
    largest = np.linalg.norm(np.array(rows), 2) ** 2
    # what turns is bound by a row sum in the solve; shares are in steps of 1/16,384 of an entry
    assert largest < STABLE * (1.0 + 1e-3)
    assert largest > 0.3 * STABLE  # and not by splitting for nothing


def test_a_hinge_elsewhere_changes_no_shares(device):
    """Contacts that forces close within the substep count in scenes with joints, too."""
    shares = []
    for hinged in (False, True):
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        light, heavy = (newton.ModelBuilder.ShapeConfig(density=rho, mu=0.0, gap=1e-3) for rho in (100.0, 7874.0))
        builder.add_shape_sphere(builder.add_body(), radius=4.0 * R, cfg=light)
        for x, y in np.ndindex(5, 5):
            at = np.array([0.3 * (x - 2), 0.3 * (y - 2), -1.0])
            body = builder.add_body(xform=wp.transform(at / np.linalg.norm(at) * (4.4 * R + 5e-4)))
            builder.add_shape_sphere(body, radius=0.4 * R, cfg=heavy)
        if hinged:
            arm = builder.add_link(xform=wp.transform((1.0, 0.0, 0.0)))
            builder.add_shape_sphere(arm, radius=R)
            builder.add_articulation([builder.add_joint_revolute(-1, arm, axis=(0.0, 0.0, 1.0))])
        model = builder.finalize(device=device)
        (pipeline, contacts), state = search(model), model.state()
        pipeline.collide(state, contacts, dt=DT)
        pull = np.zeros((model.body_count, 6), np.float32)
        pull[0, 2] = -2.0 * 5e-4 / DT**2 * model.body_mass.numpy()[0]  # closes the gaps twice over
        state.body_f.assign(pull)
        solver = PileXPBD(model, 1000, rigid_contact_relaxation=RELAXATION, rigid_contact_con_weighting=False)
        solver.step(state, model.state(), None, contacts, DT)
        shares.append(solver._shares.numpy()[:26])
    assert shares[0][0] > 2.0
    np.testing.assert_array_equal(*shares)


def test_small_balls_that_hit_a_light_large_one_are_stopped(device):
    """Eighty of them at once, from all sides; nothing is faster afterwards than what came."""
    builder, speed, far = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0)), 0.3, 4.0 * R
    warpmag.register_attributes(builder)
    for radius, density, directions in ((far, 100.0, np.zeros((1, 3))), (0.6 * R, 7874.0, spread(80))):
        for direction in directions:
            body = builder.add_body(xform=wp.transform((far + 0.62 * R) * direction))
            builder.add_shape_sphere(body, radius=radius, cfg=newton.ModelBuilder.ShapeConfig(density=density, mu=0.5))
            builder.body_qd[body] = wp.spatial_vector(*(-speed * direction), 0.0, 0.0, 0.0)
    magnet = builder.add_shape_sphere(-1, xform=wp.transform((5.0, 0.0, 0.0)), radius=R)
    warpmag.add_permanent(builder, shape=magnet, magnetization=(0.0, 0.0, 1.0))
    simulation = warpmag.Simulation(builder, device=device)
    for _ in range(20):
        simulation.step()
    v = np.linalg.norm(simulation.state.body_qd.numpy()[:, :3], axis=1)
    assert np.all(v < 0.1 * speed) and simulation.finish().peak_speed < 1.01 * speed


def spread(count):
    """Unit vectors all around, on a golden spiral."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], axis=1)


def test_letters_that_are_pulled_together_stay(device):
    """Each of them has up to 16 contacts, with friction.

    Their impacts are chaotic: over 24 runs, from starts 0.1 µm apart and with AVX2 and AVX-512, the deepest overlap is
    11 to 36 µm. The contact solve takes at least nine tenths of what an impact would overlap in one substep.
    """
    simulation = warpmag.Simulation(bundled()["alphabets"], device=device)
    for _ in range(100):
        simulation.step()
    figures = simulation.finish()
    substep = 5e-4  # s, the longest
    assert figures.peak_speed < 1.5 and figures.depth < 0.1 * figures.peak_speed * substep
    assert figures.final_overlap < 0.01
