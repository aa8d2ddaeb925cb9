"""Solves of iron bodies of cells end when the error of the magnetization in the energy norm is at most ``rtol``."""

import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.shapes import demagnetization, lattice
from warpmag.shapes.linear_cells import with_slopes

PLATE, BAR = (
    lattice.fill(lattice.box(sides), spacing, together=True)
    for sides, spacing in (((0.03, 0.03, 0.0015), 0.005), ((0.03, 0.0015, 0.001), 0.0015))
)
MAGNET = np.array([0.004, 0.002, 0.012]), np.array([0.0, 0.1, 1.6])  # position [m] and moment [A·m²] of a dipole


def solved(body, rtol, *, device, **material):
    """Return a system of one body near a dipole, solved in float64 to ``rtol``."""
    coupling = with_slopes(demagnetization.coupling(body, body.radii), body)
    field = oracle.h_field(MAGNET[0][None], MAGNET[1][None], body.positions)
    system = moment_system(
        radii=body.radii, bodies=np.zeros(len(body.radii), int), couplings=[(0, coupling)], external_field=field,
        rtol=rtol, max_evaluations=5000, dtype="float64", device=device, **material,
    )  # fmt: skip
    system.positions.assign(body.positions)
    system.rotations.assign(np.array([[0.0, 0.0, 0.0, 1.0]]))
    system.solve()
    assert system.converged.numpy()[0]
    return system


@pytest.mark.parametrize("body", [PLATE, BAR], ids=["plate", "bar"])
@pytest.mark.parametrize("susceptibility", [50.0, math.inf])
def test_the_error_is_that_in_the_energy_norm(body, susceptibility, device):
    """The energy norm of an error e is the root of ∫ e·(e/χ − H(e)), that of the solution M the root of ∫ M·H0."""

    def solution(rtol):
        system = solved(body, rtol, device=device, susceptibility=susceptibility, saturation=1e7)  # far from saturation
        magnetizations, error = system.magnetizations().numpy(), system.error.numpy()[0]
        system.evaluate()
        return magnetizations, system.h.numpy() - magnetizations / 3.0, error  # field inside

    exact, field, _ = solution(1e-9)
    volumes, applied = body.volumes[:, None], oracle.h_field(MAGNET[0][None], MAGNET[1][None], body.positions)
    for rtol in (1e-1, 1e-2, 1e-3):
        magnetizations, inside, error = solution(rtol)
        change = magnetizations - exact
        square = (volumes * change * (change / susceptibility - (inside - field))).sum()
        norm = np.sqrt(square / (volumes * exact * applied).sum())
        assert norm <= 1.1 * error <= 1.1 * rtol  # an estimate, here between 1 and 5 times the norm


def magnet_at_a_plate(rtol, device):
    """Return a model of a disc magnet on a steel plate, and its magnetics."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    magnet = builder.add_body(xform=wp.transform((0.0, 0.0, 0.0041), wp.quat_identity()))
    builder.add_shape_cylinder(magnet, radius=0.01, half_height=0.0025)
    warpmag.add_permanent(builder, body=magnet, material="N42", direction=(0.0, 0.0, 1.0))
    plate = builder.add_body()
    builder.add_shape_box(plate, hx=0.03, hy=0.03, hz=0.0015)
    warpmag.add_inducible(builder, body=plate, material="1010-steel")
    model = builder.finalize(device=device)
    return model, warpmag.Magnetics(model, rtol=rtol, max_evaluations=5000)


def test_a_magnet_that_rattles_on_a_plate_takes_few_evaluations(device):
    """Closed loops of magnetization in saturated steel, which have no field, do not prolong a solve."""
    (model, magnetics), (_, tight) = (magnet_at_a_plate(rtol, device) for rtol in (1e-3, 1e-5))
    rng, state, evaluations = np.random.default_rng(0), model.state(), []
    poses = state.body_q.numpy()
    for _ in range(8):
        moved = poses.copy()
        moved[0, :3] += 4e-5 * rng.normal(size=3)
        moved[0, 3:] = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 3e-3 * rng.normal())
        state.body_q.assign(moved)
        results = []
        for solver in (magnetics, tight):
            state.clear_forces()
            solver.apply(state)
            results.append((state.body_f.numpy()[1].astype(float), solver.shape_moments()[1]))
        (wrench, moment), (exact_wrench, exact_moment) = results
        force, error = np.linalg.norm(exact_wrench[:3]), wrench - exact_wrench
        assert np.linalg.norm(error[:3]) <= 1e-3 * force
        assert np.linalg.norm(error[3:]) <= 1e-3 * force * 0.03  # half a side of the plate
        assert np.linalg.norm(moment - exact_moment) <= 1e-3 * np.linalg.norm(exact_moment)
        evaluations.append(int(magnetics.evaluations.numpy()[0]))
    # the bound on the magnetization itself took 60 to 70
    assert np.mean(evaluations[1:]) <= 25
