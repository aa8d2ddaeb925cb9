"""The near-contact model against the exact solution of two, three and thirteen balls, and against its own energy."""

import re
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from arrangements import as_float32, fcc_block, relative

import warpmag
from bench.reference import clusters, oracle
from bench.reference import near_contact as contact_oracle
from bench.reference.near_contact import NearContacts
from bench.reference.near_contact_table import pair_conductance
from bench.reference.spheres import MU0, pair
from bench.systems import moment_system
from warpmag.kernels.near_contact import contact_table

ALONG, ACROSS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
PERMEABILITIES = [2.0, 4.0, 10.0, 1000.0, np.inf]


def linear(positions, radii, permeability, field, near=True):
    """Moments [A·m²] and forces [N] of linear balls with the near-contact model, or of dipoles alone."""
    n = len(positions)
    volumes = 4.0 / 3.0 * np.pi * np.broadcast_to(np.asarray(radii, float), n) ** 3
    slope = np.broadcast_to(oracle.curve_slope(np.asarray(permeability) - 1.0), n)
    contacts = NearContacts(positions, radii, np.asarray(permeability) - 1.0)
    coupling = oracle.coupling_matrix(positions, radii) / np.repeat(volumes, 3)
    stiffness = np.diag(np.repeat(1.0 / (slope * volumes), 3)) - coupling
    if near:
        stiffness -= contacts.coupling()
    moments = np.linalg.solve(stiffness, np.tile(field, n)).reshape(n, 3)
    forces = oracle.kelvin_force(moments, oracle.field_gradient(positions, moments, radii=radii))
    return moments, forces + contacts.forces(moments) if near else forces


@pytest.mark.parametrize("own, other", [(np.inf, np.inf), (1000.0, 1000.0), (4.0, 4.0), (2.0, np.inf), (50.0, 3.0)])
@pytest.mark.parametrize("gap", [0.0113, 0.07, 0.2, 0.38])
def test_table_is_the_exact_solution(own, other, gap):
    y = [np.atleast_1d(contact_table.hardness(mu - 1.0)) for mu in (own, other)]
    value, slope = contact_oracle.conductances(np.array([gap]), *y)
    exact = pair_conductance(2.0 + gap, [min(mu, 1e12) for mu in (own, other)])
    # cubic splines of 26 and 11 nodes
    np.testing.assert_allclose(value[0], exact, atol=2e-3 * np.abs(exact).max())
    step = 1e-5 * gap
    high, low = (contact_oracle.conductances(np.array([gap + s * step]), *y)[0][0] for s in (1.0, -1.0))
    np.testing.assert_allclose((high - low) / (2.0 * step), slope[0], rtol=1e-6, atol=1e-8 * np.abs(slope).max())


@pytest.mark.parametrize("permeability", PERMEABILITIES)
@pytest.mark.parametrize("field", [ALONG, ACROSS])
def test_two_balls_are_exact_to_five_percent(permeability, field):
    """Force and moment at gaps from 1 % of the radius up; 1 % of error until the pair's part fades."""
    for gap in (0.01, 0.02, 0.05, 0.1, 0.3, 0.4, 0.5, 0.6, 0.8, 0.95, 1.1, 1.2, 1.3, 1.5, 2.0, 5.0):
        two = pair(2.0 + gap, (1.0, 1.0), (permeability, permeability), tolerance=1e-8)
        direction = 0 if field is ALONG else 1
        exact = np.linalg.solve(two.resistance[direction], np.ones(2))
        force = -0.5 * MU0 * exact @ two.slope[direction] @ exact
        moments, forces = linear(np.array([0 * ALONG, (2.0 + gap) * ALONG]), 1.0, permeability, field)
        assert abs(forces[1, 2] / force - 1.0) < (0.01 if gap <= contact_table.CONTACT_GAP[0] else 0.05)
        assert np.abs(moments @ field / exact - 1.0).max() < 2e-3


@pytest.mark.parametrize("permeabilities", [(2.0, np.inf), (4.0, 100.0)])
def test_unlike_materials(permeabilities):
    for gap in (0.01, 0.2):
        x = np.array([0 * ALONG, (2.0 + gap) * ALONG])
        for direction, field in ((0, ALONG), (1, ACROSS)):
            two = pair(2.0 + gap, (1.0, 1.0), permeabilities)
            exact = np.linalg.solve(two.resistance[direction], np.ones(2))
            moments, forces = linear(x, 1.0, np.array(permeabilities), field)
            assert forces[1, 2] == pytest.approx(-0.5 * MU0 * exact @ two.slope[direction] @ exact, rel=2e-3)
            np.testing.assert_allclose(moments @ field, exact, rtol=2e-3)


def test_unlike_radii():
    """Balls of 4:5 keep 90 % of the force that the dipoles miss by 94 %; from 1:2 on they are dipoles."""
    for ratio, error in ((0.8, 0.12), (0.5, 0.96)):
        two = pair(1.0 + ratio + 0.01 * ratio, (1.0, ratio), (np.inf, np.inf))
        exact = np.linalg.solve(two.resistance[0], np.ones(2))
        x = np.array([0 * ALONG, (1.0 + ratio + 0.01 * ratio) * ALONG])
        _, forces = linear(x, np.array([1.0, ratio]), np.inf, ALONG)
        assert abs(forces[1, 2] / (-0.5 * MU0 * exact @ two.slope[0] @ exact) - 1.0) < error
    _, dipoles = linear(x, np.array([1.0, ratio]), np.inf, ALONG, near=False)
    np.testing.assert_allclose(forces, dipoles, atol=1e-12 * np.abs(dipoles).max())


@pytest.mark.parametrize("name", clusters.FIELDS)
@pytest.mark.parametrize("gap", clusters.GAPS)
def test_clusters(name, gap):
    """Relative L2 error of all forces within 10 %, of the moments within 4 %; dipoles are off by twice as much."""
    x = clusters.positions(name, gap)
    rows = [row for row in clusters.load() if (row["cluster"], row["gap"]) == (name, gap)]
    assert len(rows) == len(clusters.PERMEABILITIES) * len(clusters.FIELDS[name])
    for row in rows:
        exact, exact_moments = np.array(row["forces"]), np.array(row["moments"])
        field = np.array(clusters.FIELDS[name][row["field"]])
        moments, forces = linear(x, 1.0, row["permeability"], field)
        error = np.linalg.norm(forces - exact)
        assert error < 0.1 * np.linalg.norm(exact)
        assert np.linalg.norm(moments - exact_moments) < 0.04 * np.linalg.norm(exact_moments)
        _, dipoles = linear(x, 1.0, row["permeability"], field, near=False)
        assert np.linalg.norm(dipoles - exact) > 2.0 * error


def test_forces_are_the_gradient_of_the_energy():
    x = np.array([[0.0, 0.0, 0.0], [2.08, 0.1, 0.2], [0.4, 2.2, 0.3], [1.5, 1.6, 1.3]])
    radii, mu = np.array([1.0, 1.0, 1.1, 0.9]), np.array([5.0, np.inf, 50.0, 10.0])
    field = np.array([0.4, -0.3, 0.9])
    moments, forces = linear(x, radii, mu, field)

    def energy(positions):
        return -0.5 * MU0 * np.sum(linear(positions, radii, mu, field)[0] @ field)

    size, step = np.abs(forces).max(), 1e-5
    for ball in range(4):
        for axis in range(3):
            shift = np.zeros((4, 3))
            shift[ball, axis] = step
            derivative = (energy(x + shift) - energy(x - shift)) / (2.0 * step)
            # central differences: step² of truncation, eps/step of rounding
            assert abs(derivative + forces[ball, axis]) < 1e-7 * size
    assert np.abs(forces.sum(0)).max() < 1e-13 * size
    torque = MU0 * np.cross(moments, field).sum(0)
    assert np.abs(np.cross(x, forces).sum(0) - torque).max() < 1e-13 * size


@pytest.mark.parametrize("field", [ALONG, ACROSS])
def test_force_is_continuous_and_bounded(field):
    """From beyond the cut-off through contact to coincident centers: steps half as long jump half as far."""

    def force(distances):
        pairs = (np.array([0 * ALONG, d * ALONG]) for d in distances)
        return np.array([linear(x, 1.0, np.inf, field)[1][1, 2] for x in pairs]) / MU0

    everywhere = force(np.linspace(1e-6, 3.6, 200))
    assert np.isfinite(everywhere).all() and np.abs(everywhere).max() < 150.0  # 14 times two dipoles in line
    jumps = [np.abs(np.diff(force(np.linspace(1.65, 2.05, points)))).max() for points in (200, 400)]
    assert jumps[1] < 0.6 * jumps[0]


def test_cut_off_is_smooth():
    for end in (contact_table.REACH, contact_table.RANGE, 2.0 + contact_table.CONTACT_GAP[1]):
        near, far = (
            linear(np.array([0 * ALONG, (end + shift) * ALONG]), 1.0, np.inf, ALONG)[1] for shift in (-1e-6, 1e-6)
        )
        assert np.abs(near - far).max() < 1e-4 * MU0  # a force of 10 μ0 that changes over a radius
    dipoles = linear(np.array([0 * ALONG, (contact_table.REACH + 1e-6) * ALONG]), 1.0, np.inf, ALONG, near=False)[1]
    far = linear(np.array([0 * ALONG, (contact_table.REACH + 1e-6) * ALONG]), 1.0, np.inf, ALONG)[1]
    np.testing.assert_array_equal(far, dipoles)


def test_slope_of_langevins_curve():
    """Literals of ``curves.h``: c' at a magnetization c over that of Cohen's approximation, 3 (1 − c²)²/(3 + c⁴)."""
    header = (Path(warpmag.kernels.__file__).parent / "material" / "curves.h").read_text(encoding="utf-8")
    literals = [float(x) for x in re.search(r"fitted\[\d+\] = {(.*?)}", header, re.DOTALL)[1].split(",")]
    s = np.concatenate([np.linspace(0.0, 10.0, 2000), np.geomspace(10.0, 1e4, 1000)])
    c, slope = oracle.reduced_curve(s, "langevin")
    ratio = slope * (3.0 + c**4) / (3.0 * (1.0 - c**2) ** 2)
    fit = np.polyfit(2.0 * c - 1.0, ratio, len(literals) - 1)
    np.testing.assert_allclose(literals, fit, rtol=1e-6, atol=1e-6)  # of powers that cancel
    np.testing.assert_allclose(np.polyval(literals, 2.0 * c - 1.0), ratio, rtol=2e-4)


@pytest.mark.parametrize("strength, dipole", [(1e-4, False), (0.1, False), (3.0, True), (1e3, True)])
def test_saturated_balls_are_dipoles(strength, dipole):
    x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.05], [1.9, 0.0, 1.0]])
    h0 = strength * np.array([0.3, 0.0, 1.0])
    result, forces = contact_oracle.equilibrium(x, 1.0, h0, saturation=1.0)
    assert result.residual < 1e-12
    alone = oracle.equilibrium(x, 1.0, h0, saturation=1.0)
    moments = 4.0 / 3.0 * np.pi * alone.magnetizations
    dipoles = oracle.kelvin_force(moments, oracle.field_gradient(x, moments, radii=1.0))
    ratio = np.linalg.norm(forces) / np.linalg.norm(dipoles)
    assert abs(ratio - 1.0) < 1e-6 if dipole else ratio > 3.0
    assert np.abs(forces.sum(0)).max() < 1e-13 * np.abs(forces).max()


@pytest.mark.parametrize("extent", [4.0, 8.0, 9.0, 20.0])
def test_any_arrangement_has_one_solution(extent):
    """1 + ΔC M has positive eigenvalues and the whole Jacobian too, also where balls overlap at will."""
    x = np.random.default_rng(1).uniform(-0.5, 0.5, (80, 3)) * extent
    near = NearContacts(x, 1.0, np.inf)
    eigenvalues = np.linalg.eigvals(np.eye(720) + near.conductance @ near.short_range)
    assert eigenvalues.real.min() > 0.5
    coupling = oracle.coupling_matrix(x, 1.0) + near.coupling() * 4.0 / 3.0 * np.pi
    assert np.linalg.eigvalsh(0.5 * (coupling + coupling.T)).max() < 1.0 / 3.0


# ---------------------------------------------------------------------------------------------------------------------
# On the device
# ---------------------------------------------------------------------------------------------------------------------

IRON = 1.7e6
MIXED = 0.005 * np.array([[0.0, 0.0, 0.0], [2.05, 0.0, 0.0], [0.4, 2.2, 0.3], [1.5, 1.6, 1.6], [0.0, 0.0, -2.3]])
MIXED_RADII = 0.005 * np.array([1.0, 1.0, 1.0, 0.9, 1.0])
MIXED_SUSCEPTIBILITIES = np.array([5.0, np.inf, 50.0, 10.0, 3.0])


def solve(x, radii, field, device, dtype="float64", **settings):
    rtol = 1e-11 if dtype == "float64" else 3e-6
    return warpmag.solve_induction(
        x, radii, saturation=IRON, external_field=field, contact_model="multipole", dtype=dtype, device=device,
        **{"rtol": rtol} | settings,
    )  # fmt: skip


@pytest.mark.parametrize("dtype, error", [("float64", 1e-6), ("float32", 1e-3)])
@pytest.mark.parametrize("strength", [1e-3, 0.2, 2.0])
def test_device_solution_is_the_reference(strength, dtype, error, device):
    """Balls of five materials and two sizes, at gaps of 5 to 60 %, unsaturated to saturated."""
    field = strength * IRON * np.array([0.4, -0.3, 0.9])
    settings = {"susceptibility": MIXED_SUSCEPTIBILITIES}
    exact, exact_forces = contact_oracle.equilibrium(MIXED, MIXED_RADII, field, saturation=IRON, **settings)
    actual = solve(MIXED, MIXED_RADII, field, device, dtype, **settings)
    assert actual.converged
    assert relative(actual.magnetizations, exact.magnetizations) < error
    assert relative(actual.h_field, exact.h) < error
    forces, torques = actual.wrench()
    assert relative(forces, exact_forces) < error  # float32: forces add up from parts ten times as large
    assert np.abs(forces.sum(0)).max() < (1e-12 if dtype == "float64" else 1e-5) * np.abs(forces).max()
    assert np.abs(torques).max() < error * 0.005 * np.abs(forces).max()


@pytest.mark.parametrize(
    "curve, strength", [("langevin", 1e-3), ("langevin", 0.2), ("langevin", 2.0), ("clamped", 1e-2), ("frohlich", 0.2)]
)
def test_device_follows_the_curve(curve, strength, device):
    field = strength * IRON * np.array([0.4, -0.3, 0.9])
    settings = {"susceptibility": MIXED_SUSCEPTIBILITIES, "curve": curve}
    exact, exact_forces = contact_oracle.equilibrium(MIXED, MIXED_RADII, field, saturation=IRON, **settings)
    actual = solve(MIXED, MIXED_RADII, field, device, **settings)
    # the slope of Langevin's curve is good to 2e-4 there
    assert relative(actual.magnetizations, exact.magnetizations) < 1e-4
    assert relative(actual.wrench()[0], exact_forces) < 1e-4


def test_device_pair_is_exact(device):
    """Balls of infinite permeability at 1 % of the radius in a weak field, against the exact force."""
    two = pair(2.01 * 0.005, (0.005, 0.005), (np.inf, np.inf))
    m = np.linalg.solve(two.resistance[0], np.full(2, 100.0))
    result = solve(np.array([0 * ALONG, 2.01 * 0.005 * ALONG]), 0.005, 100.0 * ALONG, device)
    # a field of 6e-5 Ms already softens the contact by (M/Ms)²
    assert result.wrench()[0][1, 2] == pytest.approx(-0.5 * MU0 * m @ two.slope[0] @ m, rel=2e-3)


@pytest.mark.parametrize("extent", [0.5, 0.2, 0.08])
def test_device_heaps(extent, device):
    """300 balls with no regard for one another: the solve ends converged, and forces add up to nothing."""
    x = np.random.default_rng(1).uniform(-0.5, 0.5, (300, 3)) * extent
    result = solve(x, 0.01, 0.1 * IRON * ALONG, device, rtol=1e-9)
    assert result.converged
    forces, _ = result.wrench()
    assert np.isfinite(forces).all()
    assert np.abs(forces.sum(0)).max() < 1e-9 * np.abs(forces).max()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_device_scale(scale, device):
    """Lengths times s: the same magnetizations, forces times s², also in float32."""
    first = solve(MIXED, MIXED_RADII, 1e5 * ALONG, device, "float32", rtol=1e-5)
    other = solve(scale * MIXED, scale * MIXED_RADII, 1e5 * ALONG, device, "float32", rtol=1e-5)
    assert relative(other.magnetizations, first.magnetizations) < 1e-4  # roundings, and rtol
    assert relative(other.wrench()[0] / scale**2, first.wrench()[0]) < 1e-3


def test_device_zero_field_and_no_near_pair(device):
    none = solve(MIXED, MIXED_RADII, np.zeros(3), device)
    assert none.converged and np.abs(none.wrench()[0]).max() == 0.0
    far = solve(10.0 * MIXED, MIXED_RADII, 1e5 * ALONG, device)
    dipoles = warpmag.solve_induction(
        10.0 * MIXED, MIXED_RADII, saturation=IRON, external_field=1e5 * ALONG, rtol=1e-11, dtype="float64",
        device=device,
    )  # fmt: skip
    np.testing.assert_array_equal(far.wrench()[0], dipoles.wrench()[0])


def test_device_worlds_and_bodies_keep_apart(device):
    """Worlds do not see each other, and only single inducible moments take part."""
    x = np.concatenate([MIXED, MIXED, MIXED])
    n = len(MIXED)
    system = moment_system(
        radii=np.tile(MIXED_RADII, 3), worlds=np.repeat([0, 1, 2], n), saturation=IRON, contact_model="multipole",
        bodies=np.concatenate([np.arange(2 * n), np.full(n, 2 * n)]), external_field=1e5 * ALONG, rtol=1e-11,
        dtype="float64", device=device,
    )  # fmt: skip
    system.positions.assign(x)
    system.solve()
    system.apply_forces()
    forces = system.forces.numpy().reshape(3, n, 3)
    alone, _ = solve(MIXED, MIXED_RADII, 1e5 * ALONG, device).wrench()
    np.testing.assert_allclose(forces[0], alone, rtol=1e-6, atol=1e-9 * np.abs(alone).max())
    np.testing.assert_allclose(forces[1], alone, rtol=1e-6, atol=1e-9 * np.abs(alone).max())
    assert np.abs(forces[2]).max() == 0.0  # one body of five moments


def test_device_runs_repeat_bit_by_bit(device):
    x = as_float32(fcc_block((3, 3, 3)))[0]
    first, second = (solve(x, 0.00499, 1e4 * ALONG, device, "float32", rtol=1e-3).wrench()[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_device_precisions_agree_before_a_solve_has_ended(device):
    """Sweep by sweep the same field, forces and torques, with a magnet and a ball that cannot move among the others."""
    x = np.concatenate([MIXED, [[0.02, 0.01, 0.0]]])
    magnet = np.zeros((6, 3))
    magnet[5] = [0.3, 0.0, 0.4]
    results = {}
    for dtype in ("float64", "float32"):
        system = moment_system(
            radii=np.append(MIXED_RADII, 0.005), permanent=np.arange(6) == 5, movable=np.arange(6) != 1,
            saturation=IRON, susceptibility=np.append(MIXED_SUSCEPTIBILITIES, 1.0), contact_model="multipole",
            external_field=1e5 * np.array([0.4, -0.3, 0.9]), single_torque=True, max_evaluations=2, dtype=dtype,
            device=device,
        )  # fmt: skip
        system.positions.assign(x)
        system.moments.assign(magnet)
        steps = []
        for _ in range(3):
            system.solve()
            system.apply_forces()
            steps.append([getattr(system, name).numpy() for name in ("h", "forces", "torques")])
            system.positions.assign(1.01 * x)
        results[dtype] = steps
    for single, double in zip(results["float32"], results["float64"], strict=True):
        for entry, other in zip(single, double, strict=True):
            assert relative(entry, other) < 1e-4  # roundings, and what they make of a torque near equilibrium
        assert np.abs(single[1][1]).max() == 0.0 and np.abs(single[2]).max() > 0.0


def test_device_graph_gives_the_same_bits(device):
    x = as_float32(fcc_block((3, 3, 3)))[0]
    plain, captured = (
        moment_system(
            radii=np.full(len(x), 0.00499), saturation=IRON, contact_model="multipole",
            external_field=1e4 * np.array([0.4, -0.3, 0.9]), device=device,
        )
        for _ in range(2)
    )  # fmt: skip
    for system in (plain, captured):
        system.positions.assign(x)
        system.solve()
        system.apply_forces()
    with wp.ScopedCapture(device=device) as capture:
        captured.evaluate()
        captured.solve()
        captured.apply_forces()
    for step in range(3):
        for system in (plain, captured):
            system.positions.assign((1.0 - 1e-3 * step) * x)
        plain.evaluate()
        plain.solve()
        plain.apply_forces()
        wp.capture_launch(capture.graph)
        for name in ("h", "moments", "forces", "evaluations"):
            np.testing.assert_array_equal(getattr(plain, name).numpy(), getattr(captured, name).numpy())


@pytest.mark.parametrize("side", [7, 15, 20])
def test_device_piles_of_any_size(side, device):
    """Float32 against float64 in cubic grids at a gap of 1 %, few to many: the form of the pair sums depends on it."""
    grid = np.stack(np.meshgrid(*[np.arange(float(side))] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = as_float32(0.005 * 2.01 * grid)[0]
    field = 0.2 * IRON * np.array([0.4, -0.3, 0.9])
    single, double = (solve(x, 0.005, field, device, dtype, rtol=1e-5) for dtype in ("float32", "float64"))
    assert single.converged and double.converged
    assert relative(single.magnetizations, double.magnetizations) < 1e-4  # both within rtol
    assert relative(single.wrench()[0], double.wrench()[0]) < 1e-3


def test_only_the_kelvin_law(device):
    result = solve(MIXED, MIXED_RADII, 1e5 * ALONG, device)
    with pytest.raises(warpmag.InputError, match="multipole"):
        result.wrench("zeeman")
    with pytest.raises(warpmag.InputError, match="multipole"):
        moment_system(radii=np.ones(2), force="zeeman", contact_model="multipole", device=device)


def test_two_balls_that_approach_conserve_energy(device):
    """Velocity Verlet, frictionless, oblique to the field, stopped before contact: error of order two in the step.

    Energy is kinetic plus the co-energy −½ μ0 Σ m·H0 of unsaturated balls.
    """
    field, mass, end = np.array([0.0, 0.0, 200.0]), 4.1e-3, 0.0
    system = moment_system(
        radii=np.full(2, 0.005), saturation=1e12, external_field=field, contact_model="multipole", rtol=1e-11,
        dtype="float64", device=device,
    )  # fmt: skip

    def pull(x):
        system.positions.assign(x)
        system.solve()
        system.apply_forces()
        return system.forces.numpy(), -0.5 * MU0 * np.sum(system.moments.numpy() @ field)

    drifts = []
    for steps in (800, 1600):
        x, v = 0.005 * np.array([[0.0, 0.0, -1.3], [0.6, 0.0, 1.3]]), np.zeros((2, 3))
        force, start = pull(x)
        step, drift = 6.0 / steps, 0.0
        while True:
            v = v + 0.5 * step * force / mass
            x = x + step * v
            force, co_energy = pull(x)
            v = v + 0.5 * step * force / mass
            end = np.linalg.norm(x[1] - x[0])
            assert np.isfinite([end, co_energy]).all()  # else neither the loop nor max() would notice
            if end < 0.005 * 2.05 or drift > 1.0:
                break
            kinetic = 0.5 * mass * np.sum(v * v)
            drift = max(drift, abs(kinetic + co_energy - start) / abs(start))
            assert np.abs(v.sum(0)).max() <= 1e-6 * max(np.abs(v).max(), 1e-30)
        drifts.append(drift)
    assert drifts[1] < 1e-4
    assert 3.0 < drifts[0] / drifts[1] < 5.0
