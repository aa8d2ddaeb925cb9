"""Forces and torques on bodies of cells, also on a Newton model."""

import math

import newton
import numpy as np
import pytest
import warp as wp
from cell_bodies import (
    FAINT,
    TURN,
    demagnetizing_factors,
    make_system,
)

import warpmag
from bench.reference import oracle
from warpmag.shapes import lattice


def coenergy(system):
    """μ0/2 Σ m·H0 of inducible moments that do not saturate, for an applied field H0 [J]."""
    system.solve()
    moments, applied = system.moments.numpy(), system._induction.h0.numpy()
    return 0.5 * oracle.MU0 * (moments * applied)[: len(applied)].sum()


def test_torque_on_a_turned_body_is_the_gradient_of_its_energy(device):
    body = lattice.fill(lattice.box([0.001, 0.002, 0.006]), 0.001)
    settings = {"dtype": "float64", "rtol": 1e-10, "susceptibility": 50.0, "external_field": (2e3, -1e3, 4e3)}
    system = make_system(body, turn=TURN, device=device, **settings)
    system.solve()
    system.apply_forces()
    torque = system.torques.numpy().sum(axis=0)
    step = 1e-4
    for axis in range(3):
        energies = []
        for sign in (1, -1):
            turn = np.append(math.sin(sign * step / 2) * np.eye(3)[axis], math.cos(step / 2))
            v, w = turn[:3], turn[3]
            product = np.append(w * TURN[:3] + TURN[3] * v + np.cross(v, TURN[:3]), w * TURN[3] - v @ TURN[:3])
            energies.append(coenergy(make_system(body, turn=product, device=device, **settings)))
        slope = (energies[0] - energies[1]) / (2 * step)
        assert torque[axis] == pytest.approx(slope, abs=1e-6 * np.abs(torque).max())  # step² and rtol


def test_a_soft_ellipsoid_turns_with_the_torque_of_the_closed_form(device):
    """1 %, as for its moments: the torque is μ0 V H0² (κ∥ − κ⊥) sin α cos α; down to a fifth without cells."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    body = builder.add_body()
    builder.add_shape_ellipsoid(body, rx=0.01, ry=0.01, rz=0.1)
    warpmag.add_inducible(builder, body=body, saturation=FAINT, susceptibility=179.0)
    model = builder.finalize(device=device)
    across, along = 1.0 / (demagnetizing_factors((1.0, 1.0, 10.0))[[0, 2]] + 1.0 / 179.0)
    volume = 4.0 / 3.0 * math.pi * 1e-5
    for angle in (0.3, 0.25 * math.pi, 1.3):
        state, field = model.state(), 1e4 * np.array([math.sin(angle), 0.0, math.cos(angle)])
        warpmag.Magnetics(model, external_field=tuple(field)).apply(state)
        expected = oracle.MU0 * volume * (along - across) * field[0] * field[2]
        np.testing.assert_allclose(state.body_f.numpy()[0, 3:], [0.0, expected, 0.0], rtol=1e-2, atol=1e-3 * expected)


def test_a_body_neither_pushes_nor_turns_itself(device):
    """Forces and torques of an iron plate and a magnet are opposite and equal."""
    body = lattice.fill(lattice.box([0.01, 0.01, 0.002]), 0.001)
    magnet = np.array([[0.004, 0.002, 0.006]]), np.array([[0.1, -0.3, 0.5]])
    system = make_system(body, turn=TURN, permanent=[magnet], susceptibility=1e3, dtype="float64", device=device)
    system.solve()
    system.apply_forces()
    forces, torques = system.forces.numpy(), system.torques.numpy()
    turning = torques + np.cross(system.positions.numpy(), forces)
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-12 * np.abs(forces[-1]).max())
    np.testing.assert_allclose(turning.sum(axis=0), 0.0, atol=1e-12 * np.abs(turning[-1]).max())


def add_needle(builder, rotation, position=(0.0, 0.0, 0.0), body=None, **settings):
    body = builder.add_body(xform=wp.transform(position, rotation)) if body is None else body
    frame = wp.transform_identity() if body >= 0 else wp.transform(position, rotation)
    shape = builder.add_shape_box(body, xform=frame, hx=0.005, hy=0.005, hz=0.05)
    warpmag.add_inducible(builder, **({"body": body} if body >= 0 else {"shape": shape}), **settings)
    return body


def test_a_needle_of_a_model_turns_into_the_field(device):
    """At the rod's trial values of χ = 1000 along and across the field: 40.9 and about 2.3 times V H0."""
    field, angle = np.array([0.0, 0.0, 1e3]), math.radians(30.0)
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    rotation = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), angle)
    add_needle(builder, rotation, (0.1, 0.2, 0.3), susceptibility=1e3)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=tuple(field), rtol=1e-4)
    state = model.state()
    magnetics.apply(state)
    wrench = state.body_f.numpy()[0]
    along = np.array([0.0, -math.sin(angle), math.cos(angle)])
    volume = 1e-5
    moment = volume * 1e3 * (2.28 * np.array([0, 0, 1]) + (40.9 - 2.28) * along[2] * along)
    np.testing.assert_allclose(
        wrench[3:], oracle.MU0 * np.cross(moment, field), rtol=0.05, atol=1e-4 * np.abs(wrench[3:]).max()
    )
    np.testing.assert_allclose(wrench[:3], 0.0, atol=1e-6 * np.abs(wrench).max() / 0.05)
    # bitwise equal when repeated, and from a graph
    again = model.state()
    magnetics.reset()
    with wp.ScopedCapture(device=device) as capture:
        magnetics.apply(again)
    again.clear_forces()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(again.body_f.numpy()[0], wrench)


def test_bodies_of_one_shape_share_a_table_and_balls_have_none(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for k in range(3):
        add_needle(builder, wp.quat_identity(), (0.1 * k, 0.0, 0.0))
    magnetics = warpmag.Magnetics(builder.finalize(device=device))
    couplings = {id(magnet.lattice.coupling) for magnet in magnetics.magnets}
    assert len(couplings) == 1
    assert len(magnetics.system.rotations) == 3
    balls = newton.ModelBuilder()
    warpmag.register_attributes(balls)
    body = balls.add_body()
    balls.add_shape_sphere(body, radius=0.01)
    warpmag.add_inducible(balls, body=body)
    assert warpmag.Magnetics(balls.finalize(device=device)).system.rotations is None
