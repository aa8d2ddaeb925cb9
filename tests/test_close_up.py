"""Permanent boxes and cylinders at short range: fields, and forces on each other and on balls.

References: magpylib's closed forms, differentiated and meshed, for fields and for forces in any pose; Akoun and Yonnet
and Vokoun et al. (``bench/reference/magnet_pairs.py``) for parallel ones in contact.
"""

import magpylib
import newton
import numpy as np
import pytest
import warp as wp
from permanent_bodies import (
    ALONG,
    ASKEW,
    BALL,
    CUBE,
    DISC,
    GAP,
    LARGE,
    SIDE,
    SINGLE,
    TILTED,
    UPRIGHT,
    M,
    add,
    force_on_second,
    gradient_of,
    magnets,
    reference,
)
from scipy.spatial.transform import Rotation

import warpmag
from bench.reference import ball_in_field, magnet_pairs, oracle
from bench.systems import moment_system
from warpmag.kernels.applied.solids import SolidMagnet
from warpmag.moments.probe import FieldProbe
from warpmag.shapes import polyhedra


def near_system(half, device, dtype="float64", places=((0.0, 0.0, 0.0),), balls=(), magnetization=ASKEW):
    """Return a system of equal boxes, and of permanent balls of 1 mm."""
    body, shape = polyhedra.box_moments(half), polyhedra.box(half)
    n = len(body.volumes)
    solids = [SolidMagnet(k * n, n, body.volumes[0], 0, body.reach, shape, body, True) for k in range(len(places))]
    count = n * len(places) + len(balls)
    radii = np.concatenate([np.tile(body.depths, len(places)), np.full(len(balls), 1e-3)])
    labels = np.concatenate([np.repeat(np.arange(len(places)), n), len(places) + np.arange(len(balls))])
    system = moment_system(
        radii=radii, permanent=np.ones(count, bool), bodies=labels, solids=solids, dtype=dtype, device=device
    )

    def put(places, balls):
        positions = np.concatenate([*(body.positions + p for p in places), np.reshape(balls, (-1, 3))])
        moments = np.concatenate(
            [*(body.volumes[:, None] * magnetization for _ in places), *([[0.1, 0.0, 0.3]],) * len(balls)]
        )
        system.positions.assign(positions)
        system.moments.assign(moments)
        frames = np.array([[*p, 0.0, 0.0, 0.0, 1.0] for p in places])
        system.sources.solid_frames.assign(frames)
        system.solve()

    put(places, balls)
    return system, put


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 2e-5)])
def test_field_of_a_box(dtype, tolerance, device):
    """Points lie inside, outside, near faces and edges, and on the lines through edges."""
    half = np.array([0.01, 0.007, 0.004])
    system, _ = near_system(half, device, dtype)
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.3, 1.3, (300, 3)) * half
    x[:60, :2] = half[:2] * (1.0 + 1e-3 * rng.normal(size=(60, 2)))  # near the line through an edge
    x[60:80] = half
    x[60:80, 2] *= np.linspace(1.01, 1.7, 20)  # on the line, up to the reach of the closed form
    probe = FieldProbe(system, len(x), gradients=True)
    probe.points.assign(x)
    probe.measure()
    magnet = reference("box", half, magnetization=ASKEW)
    x = probe.points.numpy().astype(float)
    h, b = magnet.getH(x), magnet.getB(x)
    np.testing.assert_allclose(probe.h.numpy(), h, atol=tolerance * M)
    np.testing.assert_allclose(probe.b.numpy(), b, atol=tolerance * oracle.MU0 * M)
    for k in range(0, len(x), 7):
        expected = gradient_of(magnet, x[k], 1e-8)
        # truncation (step/distance)² of the differences, or rounding of float32 positions: 1e-6 m from an edge
        allowed = (1e-4 if dtype == "float64" else 1e-3) * max(np.abs(expected).max(), M)
        np.testing.assert_allclose(probe.gradient.numpy()[k], expected, atol=allowed)


def test_field_of_a_cylinder(device):
    """A prism stands for the cylinder: within 1 % of M a tenth of the radius from the rim, 1e-3 elsewhere."""
    magnetics, _ = magnets(device, ("cylinder", (0.01, 0.008), (0.1, 0.0, 0.0), TILTED, ASKEW))
    magnet = reference("cylinder", (0.01, 0.008), (0.1, 0.0, 0.0), TILTED, ASKEW)
    rng = np.random.default_rng(1)
    local = rng.uniform(-1.6, 1.6, (400, 3)) * [0.01, 0.01, 0.008]
    r, z = np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])
    away = np.hypot(np.where(z < 0.008, 0.0, z - 0.008), r - 0.01)
    keep = (away > 1e-3) & ((np.abs(z - 0.008) > 1e-4) | (r > 0.011))
    x = np.add(Rotation.from_quat(TILTED).apply(local[keep]), [0.1, 0.0, 0.0])
    np.testing.assert_allclose(magnetics.h_field(x), magnet.getH(x), atol=3e-3 * M)
    np.testing.assert_allclose(magnetics.b_field(x), magnet.getB(x), atol=3e-3 * oracle.MU0 * M)


@pytest.mark.parametrize(("half_height", "turn"), [(0.002, UPRIGHT), (0.002, TILTED), (0.03, TILTED)])
def test_field_of_a_cylinder_magnetized_along_its_axis(half_height, turn, device):
    """The closed form is exact: on the axis, near it, inside, 1e-4 radii from wall and rim, and far away.

    The field is a difference between the ends, so that rounding is relative to M. Gradients grow towards the rim.
    """
    radius, center = 0.01, [0.1, 0.0, 0.0]
    magnetics, _ = magnets(device, ("cylinder", (radius, half_height), tuple(center), turn, ALONG))
    magnet = reference("cylinder", (radius, half_height), center, turn, ALONG)
    rng = np.random.default_rng(1)
    rho, z = rng.uniform(0.0, 3.0, 400) * radius, rng.uniform(-3.0, 3.0, 400) * half_height
    rho[:40], rho[40:60] = 0.0, np.geomspace(1e-9, 1e-3, 20) * radius
    rho[60:120], z[120:180] = radius * rng.choice([0.9999, 1.0001], 60), half_height * rng.choice([0.9999, 1.0001], 60)
    rho[-40:] *= 2.0
    angle = rng.uniform(0.0, 2.0 * np.pi, 400)
    local = np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)
    x = (Rotation.from_quat(turn).apply(local) + center).astype(np.float32).astype(float)
    rim = np.hypot(rho - radius, np.abs(z) - half_height)
    # rounding of float32 positions, 0.1 m from the origin, next to a wall or a rim
    allowed = M * (2e-6 + 1e-8 / rim)[:, None]
    assert (np.abs(magnetics.h_field(x) - magnet.getH(x)) < allowed).all()
    assert (np.abs(magnetics.b_field(x) - magnet.getB(x)) < oracle.MU0 * allowed).all()
    # inside, the gradients of the moments of the system cancel; differences of the reference must not cross a wall
    apart = (rim > 1e-3) & ((rho > 1.001 * radius) | (np.abs(z) > 1.001 * half_height))
    gradients = magnetics.field_gradient(x[apart])
    expected = np.array([gradient_of(magnet, point) for point in x[apart]])
    largest = np.abs(expected).max(axis=(1, 2))
    assert (np.abs(gradients - expected).max(axis=(1, 2)) < 1e-4 * largest + 1e-5 * M / radius).all()


PLACES = [(0.0, 0.0, SIDE + gap) for gap in (0.0, 1e-4, 5e-4, 2e-3)]
PLACES += [(k * SIDE / 36.0, 0.0, SIDE) for k in (1, 2, 3, 4, 11)]  # quarters of a cell of nine
PLACES += [(SIDE, 0.0, 0.0), (SIDE, 0.0, SIDE / 36.0), (SIDE, 0.002, 0.003), (0.003, -0.004, SIDE)]


@pytest.mark.parametrize("place", PLACES)
def test_cubes_in_contact(place, device):
    """Quadrature errors are 2e-3 at most, where an edge of one cube crosses the other's face."""
    result = force_on_second(device, (*CUBE,), (*CUBE, place))
    half = np.array(CUBE[1])
    expected = magnet_pairs.box_force(half, half, place, M, M)
    np.testing.assert_allclose(result, expected, atol=2e-3 * np.linalg.norm(expected))


@pytest.mark.filterwarnings("ignore:Inertia validation corrected")  # Newton's bodies are larger
@pytest.mark.parametrize("side", [1.0, 3e-6])
def test_cubes_of_any_size(side, device):
    """Forces scale as the square of sizes, up to rounding of positions; r⁻⁷ would overflow at a micrometer."""
    result = [
        force_on_second(device, ("box", (a / 2,) * 3), ("box", (a / 2,) * 3, (0.1 * a, 0.2 * a, 1.1 * a))) / a**2
        for a in (SIDE, side)
    ]
    np.testing.assert_allclose(result[1], result[0], atol=1e-5 * np.linalg.norm(result[0]))


@pytest.mark.parametrize("gap", [0.0, 1e-4, 5e-4, 2e-3])
@pytest.mark.parametrize("angle", [0.0, 5.625])
def test_discs_in_line(gap, angle, device):
    """Rims are circles: the force does not depend on the angle about the axis, and rounding remains."""
    turn = tuple(Rotation.from_euler("z", angle, degrees=True).as_quat())
    result = force_on_second(device, (*DISC,), (*DISC, (0.0, 0.0, SIDE / 2 + gap), turn))
    expected = magnet_pairs.cylinder_force(DISC[1][0], SIDE / 2, SIDE / 2, gap, M, M)
    np.testing.assert_allclose(result, [0.0, 0.0, expected], atol=1e-5 * abs(expected))


@pytest.mark.parametrize(("place", "turn"), [((0.001, 0.0, SIDE / 2 + GAP), UPRIGHT), ((0.001, 0.002, 0.009), TILTED)])
def test_torque_between_discs(place, turn, device):
    """The torque has an error of 2e-5 of the force times the radius, as that of magpylib's 20,000 cells."""
    other = (*DISC, place, turn)
    _, wrenches = magnets(device, (*DISC,), other)
    force, torque = magpylib.getFT(reference(*DISC), reference(*other), meshing=20000, eps=1e-7)
    np.testing.assert_allclose(wrenches[1, 3:], torque, atol=5e-5 * np.linalg.norm(force) * DISC[1][0])


POSES = {
    "tilted cubes": ((*CUBE,), (*CUBE, (0.001, 0.002, 0.0135), TILTED, ASKEW)),
    "cube and plate": ((*CUBE,), ("box", (0.005, 0.005, 0.001), (0.001, 0.002, 0.006 + GAP), UPRIGHT, ASKEW)),
    "discs, slid": ((*DISC,), (*DISC, (0.001, 0.0, SIDE / 2 + GAP))),
    "discs, tilted": ((*DISC,), (*DISC, (0.001, 0.002, 0.009), TILTED, ASKEW)),
    "rods side by side": (
        ("cylinder", (0.005, 0.005), (0.0, 0.0, 0.0), UPRIGHT, (M, 0.0, 0.0)),
        ("cylinder", (0.005, 0.005), (0.01 + GAP, 0.002, 0.001), UPRIGHT, (M, 0.0, 0.0)),
    ),
    "disc and tilted cube": ((*DISC,), (*CUBE, (0.001, 0.002, 0.012), TILTED, ASKEW)),
    "ball at a face": ((*LARGE,), (*BALL, (0.004, 0.003, 0.025), UPRIGHT, ASKEW)),
    "ball at an edge": ((*LARGE,), (*BALL, (0.0236, 0.003, 0.0236), UPRIGHT, ASKEW)),
    "ball at a corner": ((*LARGE,), (*BALL, (0.0229, 0.0229, 0.0229), UPRIGHT, ASKEW)),
    "ball at a disc": (("cylinder", (0.02, 0.005)), (*BALL, (0.0236, 0.001, 0.0086), UPRIGHT, ASKEW)),
}


@pytest.mark.parametrize("name", POSES)
def test_force_and_torque_in_any_pose(name, device):
    """Forces agree with magpylib's for 2,000 cells (1e-3); action equals reaction."""
    body, other = POSES[name]
    _, wrenches = magnets(device, body, other)
    force, torque = magpylib.getFT(reference(*body), reference(*other), meshing=2000, eps=1e-7)
    size = np.linalg.norm(force)
    np.testing.assert_allclose(wrenches[1, :3], force, atol=2e-3 * size)
    np.testing.assert_allclose(wrenches[1, 3:], torque, atol=2e-3 * size * 0.005)
    np.testing.assert_allclose(wrenches[0, :3], -wrenches[1, :3], atol=SINGLE * size)
    turn = wrenches[:, 3:].sum(axis=0) + np.cross(other[2], wrenches[1, :3])
    np.testing.assert_allclose(turn, 0.0, atol=SINGLE * size * 0.02)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.025), (0.02 + 0.0036, 0.0, 0.0236), (0.0229, 0.0229, 0.0229)])
def test_iron_ball_at_a_large_cube(place, device):
    """The force on a ball follows from the exact field's gradient; the reaction acts on the cube."""
    magnetics, wrenches = magnets(device, (*LARGE,), (*BALL, place, UPRIGHT, None))
    magnet, moment = reference(*LARGE), magnetics.shape_moments()[list(magnetics.shapes).index(1)]
    applied = magnet.getH(place)
    expected = oracle.MU0 * gradient_of(magnet, np.array(place)) @ moment
    size = np.linalg.norm(expected)
    np.testing.assert_allclose(wrenches[1, :3], expected, atol=1e-5 * size)
    np.testing.assert_allclose(wrenches[0, :3], -expected, atol=1e-5 * size)
    volume = 4.0 / 3.0 * np.pi * 0.005**3
    curve = np.tanh(3.0 * np.linalg.norm(applied) / 1.7e6) * 1.7e6 / np.linalg.norm(applied)
    np.testing.assert_allclose(moment, volume * curve * applied, atol=3e-5 * volume * 1.7e6)


@pytest.mark.parametrize("touched", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 1.0), (1.0, 1.0, 1.0)])
def test_iron_ball_with_its_multipoles_at_a_large_cube(touched, device):
    """Total force at face, edge and corner: degrees above 4 contribute 3 % at an edge."""
    half, radius, weak = LARGE[1][0], BALL[1][0], 0.1 * M  # far from saturation: the tanh curve deviates by 3e-3
    outward = np.array(touched)
    place = half * outward + 1.00001 * radius * outward / np.linalg.norm(outward)
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    add(builder, *LARGE, magnetization=(0.0, 0.0, weak))
    add(builder, *BALL, tuple(place), UPRIGHT, None)
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, contact_model="multipole"), model.state()
    magnetics.apply(state)
    whole = ball_in_field.force_in_field(
        lambda x: ball_in_field.box_field(x, np.full(3, half), weak), place, radius, order=20
    )
    result = state.body_f.numpy()
    np.testing.assert_allclose(result[1, :3], whole, atol=0.03 * np.linalg.norm(whole))
    np.testing.assert_allclose(result[0, :3], -result[1, :3], atol=1e-4 * np.linalg.norm(whole))


@pytest.mark.parametrize("across", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_boxes_that_sink_into_each_other(across, device):
    """Bodies may penetrate as contact solvers allow: the force still grows smoothly, by 1 % per 10 µm."""
    result = [
        force_on_second(device, (*CUBE,), (*CUBE, tuple((SIDE + gap) * np.array(across)))) @ across
        for gap in (2e-5, 1e-5, 0.0, -1e-5, -2e-5)
    ]
    assert np.isfinite(result).all()
    steps = np.diff(result) / result[2]
    assert (steps > 0.0).all()
    np.testing.assert_allclose(steps, steps[1], rtol=0.3)


def test_gradient_of_the_energy_is_the_force(device):
    """Forces are minus the gradient of the energy: two boxes half a millimeter apart and a ball, in float64."""
    places, balls = np.array([[0.0, 0.0, 0.0], [0.004, 0.002, 0.0105]]), np.array([[0.0075, 0.0005, -0.001]])
    system, put = near_system((0.005, 0.005, 0.005), device, places=places, balls=balls)
    system.apply_forces()
    result = system.forces.numpy()
    n = (len(result) - 1) // 2
    forces = np.array([result[:n].sum(axis=0), result[n : 2 * n].sum(axis=0), result[-1]])
    step = 1e-6
    for axis in range(3):
        for k, (box, ball) in enumerate(((0, None), (1, None), (None, 0))):
            energies = []
            for sign in (1.0, -1.0):
                there, around = places.copy(), balls.copy()
                if ball is None:
                    there[box, axis] += sign * step
                else:
                    around[ball, axis] += sign * step
                put(there, around)
                energies.append(system.energy()[0])
            slope = (energies[0] - energies[1]) / (2.0 * step)
            # quadrature on the faces leaves 3e-5; truncation of the differences is (step/gap)²
            assert abs(slope + forces[k, axis]) < 3e-4 * np.abs(forces).max()


def test_what_has_no_closed_form_launches_nothing(device):
    assert magnets(device, BALL, (*BALL, (0.02, 0.0, 0.0)))[0].system.sources is None


def test_magnets_of_one_body_and_of_other_worlds_do_not_feel_each_other(device):
    """Two boxes of one body with different magnetizations, and a disc above them: alone, and in two worlds."""

    def fill(builder, parts=2):
        body = builder.add_body()
        for z, strength in ((0.0, M), (SIDE, -0.5 * M)):
            frame = wp.transform((0.0, 0.0, z), wp.quat_identity())
            shape = builder.add_shape_box(body, xform=frame, hx=0.005, hy=0.005, hz=0.005)
            warpmag.add_permanent(builder, shape=shape, magnetization=(strength, 0.0, strength))
        if parts == 2:
            add(builder, *DISC, (0.001, 0.0, 0.019), UPRIGHT, ASKEW)

    result = []
    for worlds, parts in ((1, 1), (1, 2), (2, 2)):
        world, builder = newton.ModelBuilder(), newton.ModelBuilder()
        warpmag.register_attributes(world)
        warpmag.register_attributes(builder)
        fill(world, parts)
        builder.replicate(world, worlds)
        model = builder.finalize(device=device)
        magnetics, state = warpmag.Magnetics(model), model.state()
        magnetics.apply(state)
        result.append(state.body_f.numpy())
    np.testing.assert_array_equal(result[0], 0.0)
    assert np.abs(result[1]).max() > 1.0
    np.testing.assert_allclose(result[2], np.tile(result[1], (2, 1)), rtol=1e-5, atol=1e-5)


def test_a_magnet_of_several_boxes(device):
    """Two legs of one magnet, apart and touching, under a cube; legs that share volume are a lattice."""
    for place, solids in ((0.006, 2), (0.005, 2), (0.003, 0)):
        builder = newton.ModelBuilder()
        warpmag.register_attributes(builder)
        legs = builder.add_body()
        for x in (-place, place):
            frame = wp.transform((x, 0.0, 0.0), wp.quat_identity())
            builder.add_shape_box(legs, xform=frame, hx=0.005, hy=0.005, hz=0.01)
        warpmag.add_permanent(builder, body=legs, magnetization=ASKEW)
        cube = (*CUBE, (0.001, 0.002, 0.0155))
        add(builder, *cube)
        model = builder.finalize(device=device)
        magnetics, state = warpmag.Magnetics(model), model.state()
        assert len(magnetics.magnets[0].lattice.solids) == solids
        magnetics.apply(state)
        if solids:
            apart = [reference("box", (0.005, 0.005, 0.01), (x, 0.0, 0.0), UPRIGHT, ASKEW) for x in (-place, place)]
            force = magpylib.getFT(apart, reference(*cube), meshing=2000, eps=1e-7)[0].sum(axis=0)
            result = state.body_f.numpy()
            np.testing.assert_allclose(result[1, :3], force, atol=2e-3 * np.linalg.norm(force))
            np.testing.assert_allclose(result[0, :3], -result[1, :3], atol=SINGLE * np.linalg.norm(force))


def test_a_magnet_that_is_switched_is_switched_close_up(device):
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    add(builder, *CUBE)
    add(builder, *CUBE, (0.0, 0.0, SIDE + GAP))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model), model.state()
    forces = []
    for strength in (M, 0.0, -0.5 * M):
        magnetics.set_magnetization((0.0, 0.0, strength), body=0)
        state.clear_forces()
        magnetics.apply(state)
        forces.append(state.body_f.numpy()[1, 2])
    np.testing.assert_allclose(forces, forces[0] * np.array([1.0, 0.0, -0.5]), atol=SINGLE * abs(forces[0]))
