"""Named curves of cells act on the field inside the material, as measured curves do; ``tanh-applied`` does not."""

import newton
import numpy as np
import pytest
from cell_bodies import demagnetizing_matrix, make_system
from scipy.optimize import root, root_scalar

import warpmag
from bench.reference import oracle
from warpmag.declarations import magnets
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.shapes import lattice

MS = 1.7e6
BOX = lattice.fill(lattice.box([0.002, 0.002, 0.005]), 0.002)  # 20 equal cells
FIELD = np.array([1e5, -5e4, 4e5])  # A/m, at which the middle of the box saturates and its corners do not


def magnetizations(curves, saturation, susceptibility):
    """Magnetizations of the cells of the box, by SciPy, from H = H0 − D M and M = Ms c(χ H/Ms) in each cell.

    The unknown is the reduced field, in which the curve is written: inside, or of all others for ``tanh-applied``.
    """
    count = len(BOX.volumes)
    curves = [curves] * count if isinstance(curves, str) else curves
    saturation, susceptibility = (np.broadcast_to(x, count)[:, None] for x in (saturation, susceptibility))
    applied = np.array([[curve == "tanh-applied"] for curve in curves])
    slope = np.where(applied, oracle.curve_slope(susceptibility), susceptibility)
    operator = demagnetizing_matrix(BOX)

    def magnetized(reduced):
        size = np.linalg.norm(reduced, axis=1)
        value = np.array([oracle.reduced_curve(s, curve)[0] for s, curve in zip(size, curves, strict=True)])
        return saturation * (value / size)[:, None] * reduced

    def excess(unknown):
        reduced = unknown.reshape(count, 3)
        m = magnetized(reduced)
        inside = FIELD - (operator @ m.ravel()).reshape(count, 3)
        return (reduced * saturation / slope - inside - np.where(applied, m / 3.0, 0.0)).ravel() / MS

    result = root(excess, np.tile(FIELD * 3.0 / MS, count), method="lm", options={"xtol": 1e-14, "ftol": 1e-14})
    assert np.abs(result.fun).max() < 1e-10
    return magnetized(result.x.reshape(count, 3))


def relative_error(system, exact):
    assert system.converged.numpy().all()
    return np.linalg.norm(system.magnetizations().numpy() - exact) / np.linalg.norm(exact)


@pytest.mark.parametrize("curve", magnets.CURVES)
def test_cells_follow_the_formula_in_the_field_inside(curve, device):
    assert np.ptp(BOX.volumes) < 1e-12 * BOX.volumes.max()
    material = {"curve": curve, "saturation": MS, "susceptibility": 20.0}
    system = make_system(BOX, external_field=FIELD, dtype="float64", rtol=1e-9, device=device, **material)
    system.solve()
    exact = magnetizations(curve, MS, 20.0)
    reached = np.linalg.norm(exact, axis=1) / MS
    assert reached.max() > 0.7 and np.ptp(reached) > 0.05
    assert relative_error(system, exact) < 1e-8  # ten times rtol


@pytest.mark.parametrize("dynamics", ["theta-euler", "llg-damping"])
def test_every_dynamics_takes_the_field_inside(dynamics, device):
    material = {"curve": "tanh", "saturation": MS, "susceptibility": 20.0}
    settings = {"dynamics": dynamics, "max_evaluations": 5000, "rtol": 1e-6, "dtype": "float64", "device": device}
    system = make_system(BOX, external_field=FIELD, **material, **settings)
    system.solve()
    # explicit dynamics stop at a residual, which is the error over the rate of the slowest mode
    assert relative_error(system, magnetizations("tanh", MS, 20.0)) < 2e-5


@pytest.mark.parametrize("dtype, rtol", [("float32", 1e-5), ("float64", 1e-9)])
def test_cells_of_several_materials(dtype, rtol, device):
    rng, count = np.random.default_rng(1), len(BOX.volumes)
    curves = [("tanh", "langevin", "frohlich", "tanh-applied")[k % 4] for k in range(count)]
    saturation, susceptibility = rng.uniform(0.5, 2.0, count) * 1e6, 10.0 ** rng.uniform(0.0, 2.0, count)
    material = {"curve": curves, "saturation": saturation, "susceptibility": susceptibility}
    system = make_system(BOX, external_field=FIELD, dtype=dtype, rtol=rtol, device=device, **material)
    system.solve()
    assert relative_error(system, magnetizations(curves, saturation, susceptibility)) < 10.0 * rtol


def magnetized(device, add_shape, field, *, spacing=0.0, **material):
    """Mean magnetization along a uniform field [A/m] of an iron shape of a model."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    body = builder.add_body()
    add_shape(builder, body)
    warpmag.add_inducible(builder, body=body, moment_spacing=spacing, **material)
    model = builder.finalize(device=device)
    magnetics = warpmag.Magnetics(model, external_field=tuple(field), rtol=1e-5)
    magnetics.apply(model.state())
    volume = sum(magnet.lattice.volumes.sum() for magnet in magnetics.magnets)
    return magnetics.shape_moments()[0] @ field / np.linalg.norm(field) / volume


@pytest.mark.parametrize("half, axis", [((0.02, 0.02, 0.002), 0), ((0.02, 0.02, 0.002), 2), ((0.01, 0.01, 0.01), 2)])
@pytest.mark.parametrize("susceptibility", [5.0, 200.0])
def test_a_plate_and_a_cube_are_those_of_the_table(half, axis, susceptibility, device):
    """A table of 160 points of tanh; tanh in the field of all others is up to 30 % below."""
    y = np.r_[0.0, np.geomspace(0.02, 12.0, 160)]
    table = MagnetizationCurve.from_mh(y * MS / susceptibility, MS * np.tanh(y))
    named = {"saturation": MS, "susceptibility": susceptibility}
    differences = []
    for strength in (0.1, 0.5):
        field = strength * MS * np.eye(3)[axis]
        measured, formula, applied = (
            magnetized(device, lambda builder, body: builder.add_shape_box(body, hx=half[0], hy=half[1], hz=half[2]),
                       field, **material)
            for material in ({"curve": table}, {"curve": "tanh", **named}, {"curve": "tanh-applied", **named})
        )  # fmt: skip
        assert formula == pytest.approx(measured, rel=1e-4)  # ten times rtol
        differences.append(1.0 - applied / measured)
    assert 0.03 < max(differences) < 0.31


@pytest.mark.parametrize("susceptibility", [2.0, 20.0, 200.0])
def test_a_sphere_of_cells_takes_the_moment_of_the_closed_form(susceptibility, device):
    """M = Ms tanh(χ (H0 − M/3)/Ms), uniform in a sphere. At 0.9 Ms the cells that the surface cuts saturate: 1.2 %."""
    for strength in (0.1, 0.3, 0.5):
        magnetization = magnetized(
            device, lambda builder, body: builder.add_shape_sphere(body, radius=0.01), strength * MS * np.eye(3)[2],
            spacing=0.0025, saturation=MS, susceptibility=susceptibility,
        )  # fmt: skip
        excess = lambda m, h=strength: m - np.tanh(susceptibility * (h - m / 3.0))  # noqa: E731
        exact = root_scalar(excess, bracket=(0.0, 1.0)).root
        assert magnetization == pytest.approx(MS * exact, rel=1.2e-2)


@pytest.mark.parametrize("curve", ["tanh", "langevin", "frohlich"])
def test_force_on_a_saturating_body_is_the_gradient_of_its_energy(curve, device):
    """A strong magnet beside the box, by central differences over its places."""
    place, moment = np.array([0.006, 0.001, 0.004]), np.array([0.3, 0.2, 1.0])
    settings = {"saturation": MS, "susceptibility": 50.0, "curve": curve, "external_field": FIELD}
    settings |= {"dtype": "float64", "rtol": 1e-11, "device": device}

    def solved(at):
        system = make_system(BOX, permanent=[(at, moment)], **settings)
        system.solve()
        return system

    step, system = 1e-6, solved(place)
    system.apply_forces()
    reached = np.linalg.norm(system.magnetizations().numpy()[:-1], axis=1) / MS
    assert reached.max() > 0.9
    slope = [(solved(place + d).energy()[0] - solved(place - d).energy()[0]) / (2.0 * step) for d in step * np.eye(3)]
    forces = system.forces.numpy()
    scale = float(np.linalg.norm(slope))
    np.testing.assert_allclose(forces[-1], -np.array(slope), rtol=0, atol=1e-5 * scale)  # step² over the distance²
    np.testing.assert_allclose(forces[:-1].sum(axis=0), slope, rtol=0, atol=1e-5 * scale)


@pytest.mark.parametrize("dynamics", ["theta", "theta-euler"])
def test_both_names_of_tanh_are_one_for_balls(dynamics, device):
    x = 0.0101 * np.array(list(np.ndindex(3, 2, 2)))
    given = {"saturation": MS, "external_field": FIELD, "dynamics": dynamics, "device": device}
    named, applied = (warpmag.solve_induction(x, 0.005, curve=curve, **given) for curve in ("tanh", "tanh-applied"))
    assert np.array_equal(named.magnetizations, applied.magnetizations)
