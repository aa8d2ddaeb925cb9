"""Iron balls in the non-uniform field of permanent magnets: images, exact multipoles, energy, conservation laws."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from arrangements import relative

import warpmag
from bench.reference import ball_in_field
from bench.systems import moment_system
from warpmag.kernels.near_contact import contact_table, near_pairs

R = 0.005
LINEAR = 1e15
"""Saturation [A/m] of a ball that is linear to rounding."""
PLACES = R * np.array([[0.0, 0.0, 0.0], [0.3, 0.2, -3.5], [1.2, -1.1, 1.4], [-2.5, 0.3, 0.4], [0.5, 4.0, 8.2]])
"""Two iron balls, and three permanent moments of which the last is where the weight fades."""
RADII = R * np.array([1.0, 0.8, 0.7, 0.3, 1.0])
MOMENTS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.3, -0.2], [0.05, -0.1, 0.02], [0.8, -0.5, 0.6]])
SUSCEPTIBILITY = np.array([np.inf, 4.0, 1.0, 1.0, 1.0])


def system(radii, device, *, contact_model="multipole", dtype="float64", saturation=LINEAR, **settings):
    n = len(radii)
    balls = settings.pop("balls", 1)
    return moment_system(
        radii=radii, saturation=saturation, contact_model=contact_model, dtype=dtype, device=device,
        **{"permanent": np.arange(n) >= balls, "rtol": 1e-11 if dtype == "float64" else 1e-5} | settings,
    )  # fmt: skip


def wrench(magnets, positions, moments):
    magnets.positions.assign(positions)
    magnets.moments.assign(moments)
    magnets.solve()
    magnets.apply_forces()
    return magnets.forces.numpy().astype(float), magnets.torques.numpy().astype(float)


@pytest.mark.parametrize("dtype, error", [("float64", 1e-3), ("float32", 1e-3)])
@pytest.mark.parametrize("size", [0.2, 0.5, 1.0, 3.0])
def test_a_permanent_ball_beside_an_iron_ball(size, dtype, error, device):
    """From contact to a gap of 2 R, against image charges; a dipole has 40 % of it at worst for balls of one size."""
    magnets = system([R, size * R], device, dtype=dtype)
    for direction in ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]):
        for gap in (0.0, 0.02, 0.1, 0.3, 1.0, 2.0):
            place, moment = np.array([0.0, 0.0, (1.0 + size + gap) * R]), 0.2 * np.array(direction)
            forces, _ = wrench(magnets, [np.zeros(3), place], [np.zeros(3), moment])
            exact = ball_in_field.image_force(*ball_in_field.dipole_charges(place, moment, 1e-4 * R), R)
            # cut off nowhere; charges 1e-4 R apart; a gap of zero rounds to an overlap, which takes nothing away
            assert np.linalg.norm(forces[0] - exact) < error * np.linalg.norm(exact), (direction, gap)


@pytest.mark.parametrize("susceptibility", [1.0, 10.0, 1000.0])
@pytest.mark.parametrize("along", [True, False])
def test_finite_permeability(susceptibility, along, device):
    """Degrees above 4 share the polarizability of degree 6, which is off by 2 % of their part at most."""
    magnets = system([R, R], device, susceptibility=[susceptibility, 1.0])
    for gap in (0.0, 0.1, 0.5, 2.0):
        distance = (2.0 + gap) * R
        moment = [0.0, 0.0, 0.2] if along else [0.2, 0.0, 0.0]
        forces, _ = wrench(magnets, [np.zeros(3), [0.0, 0.0, distance]], [np.zeros(3), moment])
        exact = 0.04 * ball_in_field.dipole_pull(distance, R, susceptibility, along)
        assert abs(forces[0, 2] / exact - 1.0) < 2e-3


@pytest.mark.parametrize("cells", [False, True])
def test_forces_are_the_gradient_of_the_energy(cells, device):
    """What permanent moments, and cells of one body, add to dipoles, against finite differences of the oracle's energy.

    The iron balls are too far from each other to be near contacts.
    """
    bodies = np.array([0, 1, 2, 2, 2]) if cells else np.arange(5)
    radii = RADII * np.where(cells & (np.arange(5) > 1), 0.55, 1.0)  # larger cells would not act
    result = [
        wrench(
            system(radii, device, balls=2, contact_model=model, bodies=bodies, susceptibility=SUSCEPTIBILITY),
            PLACES, MOMENTS,
        )
        for model in ("multipole", "dipole")
    ]  # fmt: skip
    added, torques = (entry - other for entry, other in zip(*result, strict=True))

    def energy(x, m):
        return sum(
            ball_in_field.model_energy(
                x[i], radii[i], SUSCEPTIBILITY[i], x[2:], radii[2:], m[2:], np.full(3, not cells)
            )
            for i in (0, 1)
        )

    step = 1e-5 * R
    for i in range(5):
        for axis in range(3):
            shift = np.zeros((5, 3))
            shift[i, axis] = step
            slope = (energy(PLACES + shift, MOMENTS) - energy(PLACES - shift, MOMENTS)) / (2.0 * step)
            # central differences: step² of truncation, eps/step of rounding, and rtol of the dipoles' solutions
            assert abs(slope + added[i, axis]) < 1e-6 * np.abs(added).max()
            turn = np.cross(np.eye(3)[axis], MOMENTS)
            entry, other = (energy(PLACES, MOMENTS + s * 1e-5 * turn * (np.arange(5) == i)[:, None]) for s in (1, -1))
            assert abs((entry - other) / 2e-5 + torques[i, axis]) < 1e-6 * np.abs(torques).max()
    assert np.abs(added[:2]).max() > 0.1 * np.abs(result[1][0][:2]).max()


@pytest.mark.parametrize(
    "touched", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 1.0), (0.111, 1.0, 1.0), (1.0, 1.0, 1.0)]
)
def test_a_ball_at_a_cube_of_cells(touched, device):
    """What multipoles add to a ball an eighth of the cube's size that touches its face, edge or corner.

    Within 5.5 % of the whole force, against the closed form of the cube's field. Of that 3 % at edges are degrees above
    4; the rest is what cells make of a field 1.6 cells away.
    """
    half, count = 0.02, 9
    axis = (np.arange(count) + 0.5) * 2.0 * half / count - half
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    n = len(cells)
    outward = np.floor(np.abs(touched))
    place = half * np.array(touched) + 1.00001 * R * outward / np.linalg.norm(outward)
    moments = np.zeros((n + 1, 3))
    moments[1:, 2] = 1e6 * (2.0 * half) ** 3 / n
    radii = np.append(R, np.full(n, half / count))
    actual = [
        wrench(
            system(radii, device, dtype="float32", bodies=np.append(0, np.ones(n, int)), contact_model=model),
            np.concatenate([[place], cells]), moments,
        )
        for model in ("multipole", "dipole")
    ]  # fmt: skip
    added = (actual[0][0] - actual[1][0])[0]

    def exact(order):
        return ball_in_field.force_in_field(
            lambda x: ball_in_field.box_field(x, np.full(3, half), 1e6), place, R, order=order
        )

    whole = exact(20)
    assert np.linalg.norm(added + exact(1) - whole) < 0.055 * np.linalg.norm(whole)


@pytest.mark.parametrize("touched", [(0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (1.0, 1.0, 1.0)])
def test_a_ball_at_a_cube_magnet(touched, device):
    """In a Newton model within 3 % of the exact force; a dipole lacks 24 % of it at an edge, 23 % at a corner."""
    half, outward = 0.02, np.array(touched) / np.linalg.norm(touched)
    place = half * np.array(touched) + 1.0001 * R * outward
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    ball, cube = builder.add_body(xform=wp.transform(tuple(place), wp.quat_identity())), builder.add_body()
    builder.add_shape_sphere(ball, radius=R)
    builder.add_shape_box(cube, hx=half, hy=half, hz=half)
    warpmag.add_inducible(builder, body=ball)
    warpmag.add_permanent(builder, body=cube, magnetization=(0.0, 0.0, 1e4))
    model = builder.finalize(device=device)
    magnetics, state = warpmag.Magnetics(model, contact_model="multipole", rtol=1e-5), model.state()
    magnetics.apply(state)
    forces = state.body_f.numpy()[:, :3]
    exact = ball_in_field.force_in_field(
        lambda x: ball_in_field.box_field(x, np.full(3, half), 1e4), place, R, order=20
    )
    assert np.linalg.norm(forces[ball] - exact) < 0.03 * np.linalg.norm(exact)
    assert np.abs(forces.sum(0)).max() < 1e-5 * np.abs(forces).max()


@pytest.mark.parametrize("dtype, error", [("float64", 1e-12), ("float32", 1e-5)])
def test_momentum_and_angular_momentum_are_kept(dtype, error, device):
    forces, torques = wrench(
        system(RADII, device, balls=2, dtype=dtype, susceptibility=SUSCEPTIBILITY), PLACES, MOMENTS
    )
    assert np.abs(forces.sum(0)).max() < error * np.abs(forces).max()  # roundings of a few terms each
    turn = np.cross(PLACES, forces)
    assert np.abs(turn.sum(0) + torques.sum(0)).max() < 10.0 * error * np.abs(turn).max()
    assert np.abs(torques[:2]).max() == 0.0


def test_only_what_may_move_is_pushed(device):
    free = wrench(system(RADII, device, balls=2), PLACES, MOMENTS)
    held = wrench(system(RADII, device, balls=2, movable=np.array([True, False, False, True, False])), PLACES, MOMENTS)
    for entry, other in zip(free, held, strict=True):
        np.testing.assert_allclose(other[[0, 3]], entry[[0, 3]], rtol=1e-12, atol=1e-14 * np.abs(entry).max())
        assert not other[[1, 2, 4]].any()


def test_magnets_of_a_recoil_permeability(device):
    """They act by the moments that they have when the induction is solved, wherever they stand among the moments."""
    order = [2, 0, 3, 1, 4]
    x, radii = PLACES[order], RADII[order]
    linear = np.array([magnet in (2, 3) for magnet in order])
    actual, moments = [], np.zeros((5, 3))
    for model in ("multipole", "dipole"):
        magnets = system(
            radii, device, balls=4, contact_model=model,
            curve=["linear" if entry else "tanh" for entry in linear], susceptibility=np.where(linear, 0.05, np.inf),
        )  # fmt: skip
        remanence = MOMENTS[order] / (4.0 / 3.0 * np.pi * radii[:, None] ** 3)
        magnets.bias.assign(np.where(linear[:, None], remanence / 0.05, 0.0))
        actual.append(wrench(magnets, x, np.where(linear[:, None], 0.0, MOMENTS[order])))
        moments = magnets.moments.numpy()
    fixed = [
        wrench(system(RADII, device, balls=2, contact_model=model), PLACES, moments[np.argsort(order)])
        for model in ("multipole", "dipole")
    ]
    for part in (0, 1):
        added, expected = actual[0][part] - actual[1][part], fixed[0][part] - fixed[1][part]
        np.testing.assert_allclose(added[np.argsort(order)], expected, atol=1e-6 * np.abs(expected).max())


def test_worlds_are_apart(device):
    """Forty worlds at once are each what it is alone, though they share vectors of balls."""
    rng, alone = np.random.default_rng(3), []
    places = PLACES[None] + 0.1 * R * rng.normal(size=(40, 5, 3))
    for x in places[:3]:
        alone.append(wrench(system(RADII, device, balls=2), x, MOMENTS))
    radii, moments = np.tile(RADII, 40), np.tile(MOMENTS, (40, 1))
    together = wrench(
        system(radii, device, worlds=np.repeat(np.arange(40), 5), permanent=np.arange(200) % 5 >= 2),
        places.reshape(-1, 3), moments,
    )  # fmt: skip
    for k in range(3):
        for entry, all_of_them in zip(alone[k], together, strict=True):
            assert relative(all_of_them[5 * k : 5 * k + 5], entry) < 1e-9  # rtol of the solutions


@pytest.mark.parametrize("curve", ["tanh", "langevin", "clamped"])
def test_saturated_balls_are_dipoles(curve, device):
    """What multipoles add is less the more the ball saturates, and nothing in the end."""
    gains = []
    for saturation in (LINEAR, 1e8, 1e6, 3e5, 1e5, 1e4, 1e2):
        pulls = [
            wrench(
                system([R, R], device, saturation=saturation, contact_model=model, curve=curve, rtol=1e-9),
                [np.zeros(3), [0.0, 0.0, 2.02 * R]], [np.zeros(3), [0.0, 0.0, 0.2]],
            )[0][0, 2]
            for model in ("multipole", "dipole")
        ]  # fmt: skip
        gains.append(pulls[0] / pulls[1])
    assert gains[0] > 2.4  # 40 %
    # the fit of Langevin's curve is good to 2e-4
    assert all(1.0 - 1e-3 < low < high + 1e-3 for high, low in itertools.pairwise(gains))
    assert gains[-1] < 1.0 + 1e-3


def test_force_is_continuous(device):
    """From beyond the reach through contact to coincident centers: steps half as long jump half as far."""
    magnets = system([R, 0.5 * R], device)

    def forces(distances):
        along = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.2]])
        return np.array([wrench(magnets, [np.zeros(3), [0.0, 0.0, d * R]], along)[0][0] for d in distances])

    assert np.isfinite(forces([0.0, 1e-9, 1e-3, 0.5, 1.0, 1.2])).all()
    for low, high in ((1.2, 1.6), (7.5, 10.5)):
        jumps = [np.abs(np.diff(forces(np.linspace(low, high, points)), axis=0)).max() for points in (60, 120)]
        assert jumps[1] < 0.6 * jumps[0]
    end = 1.000001 * contact_table.MAGNET_REACH[1]
    dipole = wrench(
        system([R, 0.5 * R], device, contact_model="dipole"),
        [np.zeros(3), [0.0, 0.0, end * R]], [np.zeros(3), [0.0, 0.0, 0.2]],
    )[0]  # fmt: skip
    fresh = system([R, 0.5 * R], device)  # the changes of earlier solves would differ by rounding
    far = wrench(fresh, [np.zeros(3), [0.0, 0.0, end * R]], [np.zeros(3), [0.0, 0.0, 0.2]])[0]
    np.testing.assert_array_equal(far, dipole)


def test_threads_give_the_same_bits(device, monkeypatch):
    """However many threads of a CPU share the balls."""
    results = []
    for count in (1, 2, 5):
        monkeypatch.setattr(near_pairs, "threads_for", lambda *_, count=count: count)
        magnets = system(
            np.tile(RADII, 80), device, dtype="float32", worlds=np.repeat(np.arange(80), 5),
            permanent=np.arange(400) % 5 >= 2,
        )  # fmt: skip
        results.append(wrench(magnets, np.tile(PLACES, (80, 1)), np.tile(MOMENTS, (80, 1))))
    for entry in results[1:]:
        np.testing.assert_array_equal(entry, results[0])


def test_graph_gives_the_same_bits(device):
    plain, captured = (system(RADII, device, balls=2, dtype="float32") for _ in range(2))
    wrench(captured, PLACES, MOMENTS)
    with wp.ScopedCapture(device=device) as capture:
        captured.solve()
        captured.apply_forces()
    captured.start_cold()
    for step in range(3):
        x = (1.0 + 1e-3 * step) * PLACES
        if step == 0:
            plain.start_cold()
        expected = wrench(plain, x, MOMENTS)
        captured.positions.assign(x)
        captured.moments.assign(MOMENTS)
        wp.capture_launch(capture.graph)
        np.testing.assert_array_equal(captured.forces.numpy(), expected[0].astype(np.float32))
        np.testing.assert_array_equal(captured.torques.numpy(), expected[1].astype(np.float32))
