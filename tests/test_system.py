"""The moment system over time: worlds, bodies, warm starts, graphs."""

import numpy as np
import pytest
import warp as wp
from arrangements import as_float32, fcc_block, overlapping, pile, relative

import warpmag
from bench.reference import oracle
from bench.systems import moment_system
from warpmag.declarations import magnets
from warpmag.errors import InputError
from warpmag.kernels.pairs import evaluate
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.shared import team
from warpmag.moments.layout import make_layout

MS = 1.7e6


def two_worlds(device, **settings):
    """Two worlds at the same place: 60 balls under one permanent magnet, and 90 under another."""
    x, radii, _ = pile(count=150)
    positions = np.concatenate([x[:60], [[0.05, 0.05, 0.3]], x[:90] + np.array([0.002, 0, 0]), [[0.1, 0.0, 0.25]]])
    moments = np.zeros((152, 3))
    moments[60], moments[151] = [0.0, 0.0, 400.0], [300.0, 0.0, 100.0]
    sizes = np.concatenate([radii[:60], [0.01], radii[:90], [0.01]])
    system = moment_system(
        radii=sizes, worlds=np.repeat([0, 1], [61, 91]), permanent=np.isin(np.arange(152), [60, 151]),
        saturation=MS, rtol=1e-5, device=device, **settings,
    )  # fmt: skip
    system.positions.assign(positions)
    system.moments.assign(moments)
    return system, positions, moments, sizes


def test_worlds_never_see_each_other(device):
    system, positions, moments, radii = two_worlds(device)
    system.solve()
    system.apply_forces()
    assert system.converged.numpy().tolist() == [1, 1]
    for w, balls, magnet in ((0, slice(0, 60), 60), (1, slice(61, 151), 151)):
        alone = warpmag.solve_induction(
            positions[balls], radii[balls], saturation=MS, rtol=1e-5, device=device,
            external_field=oracle.h_field(
                positions[[magnet]], moments[[magnet]], positions[balls], radii=0.01, target_radii=radii[balls]
            ),
        )  # fmt: skip
        volume = 4.0 / 3.0 * np.pi * radii[balls, None] ** 3
        assert relative(system.moments.numpy()[balls] / volume, alone.magnetizations) < 1e-4
        assert abs(int(system.evaluations.numpy()[w]) - alone.evaluations) <= 1
    forces = system.forces.numpy().astype(float)
    for members in (slice(0, 61), slice(61, 152)):
        assert np.linalg.norm(forces[members].sum(0)) < 1e-6 * np.linalg.norm(forces[members], axis=1).sum()


def test_one_world_is_not_moved_by_another(device):
    """A world's result is bitwise the same, whatever another world holds."""
    results = []
    for strength in (1.0, 50.0):
        system, _, moments, _ = two_worlds(device)
        moments[151] *= strength
        system.moments.assign(moments)
        system.solve()
        results.append(system.moments.numpy()[:60])
    assert np.array_equal(*results)


def test_moments_of_one_body_exert_no_force_on_each_other(device):
    x, radii, m = pile(count=40)
    bodies = np.repeat([0, 1], 20)
    system = moment_system(radii=radii, permanent=np.ones(40, bool), bodies=bodies, device=device)
    system.positions.assign(x)
    system.moments.assign(m)
    system.solve()
    system.apply_forces()
    gradient = oracle.field_gradient(x, m, radii=radii, bodies=bodies)
    assert relative(system.forces.numpy(), oracle.kelvin_force(m, gradient)) < 1e-6
    assert relative(system.torques.numpy(), oracle.torque(m, oracle.h_field(x, m, radii=radii, bodies=bodies))) < 1e-6


@pytest.mark.parametrize(("strength", "tolerance"), [(1e3, 1e-7), (1e9, 1e-7)])
@pytest.mark.parametrize("force", ["kelvin", "zeeman"])
def test_a_body_is_turned_as_by_all_pairs_of_moments(force, strength, tolerance, device):
    """The paper's Algorithm 1 has no torque, but forces between the moments of one body, which come to the same.

    With Eq. 4 that is so where its forces are one multiple of Kelvin's in all of the body: 8 in weak fields, 1 in
    saturation, up to the square of M/Ms and to what is left of the curve's slope.
    """
    radius, magnets = 0.002, np.array([[0.02, 0.03, 0.025], [-0.03, 0.01, -0.02]])
    letter = 2.2 * radius * np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [0, 2, 0], [0, 0, 1]])
    x, n = np.concatenate([letter, magnets]), len(letter)
    moments = np.concatenate([np.zeros((n, 3)), strength * 1e-5 * np.array([[1.0, -2.0, 0.5], [0.3, 1.0, 2.0]])])
    system = moment_system(
        radii=np.full(n + 2, radius), permanent=np.arange(n + 2) >= n, bodies=np.r_[np.zeros(n, int), 1, 2],
        saturation=MS, force=force, rtol=1e-10, dtype="float64", device=device,
    )  # fmt: skip
    system.positions.assign(x)
    system.moments.assign(moments)
    system.solve()
    system.apply_forces()
    m = system.moments.numpy()
    gradient = oracle.field_gradient(x, m, radii=radius)[:n]
    if force == "kelvin":
        expected = oracle.kelvin_force(m[:n], gradient)
    else:
        h = oracle.h_field(x, m, radii=radius)[:n]
        volumes = np.full(n, 4.0 / 3.0 * np.pi * radius**3)
        expected = oracle.zeeman_force(volumes, h, gradient, *oracle.magnetization(h, MS))
    forces, torques = system.forces.numpy()[:n], system.torques.numpy()[:n]
    turned = np.sum(torques + np.cross(letter, forces), axis=0)
    assert relative(turned, np.cross(letter, expected).sum(axis=0)) < tolerance
    assert relative(forces.sum(axis=0), expected.sum(axis=0)) < tolerance


def test_forces_on_balls_and_on_magnets(device, monkeypatch):
    """Balls, a fixed magnet and a free one, which is turned, too; on a GPU by both ends of each pair."""
    monkeypatch.setattr(evaluate, "_LEAST_MIRRORED", dict.fromkeys((Quantity.FIELD, Quantity.MUTUAL_FORCE), 1))
    x, radii, m = pile(count=700)
    balls, fixed, free = np.arange(700) < 600, slice(600, 660), slice(660, 700)
    bodies, movable = np.where(balls, np.arange(700), 600), np.ones(700, bool)
    bodies[free], movable[fixed] = 601, False
    system = moment_system(
        radii=radii, permanent=~balls, bodies=bodies, movable=movable, saturation=MS, rtol=1e-5, device=device
    )
    system.positions.assign(x)
    system.moments.assign(np.where(balls[:, None], 0.0, m))
    system.solve()
    system.apply_forces()
    m = system.moments.numpy().astype(float)
    force = oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=radii, bodies=bodies))
    torque = oracle.torque(m, oracle.h_field(x, m, radii=radii, bodies=bodies))
    assert system.converged.numpy().all()
    assert relative(system.forces.numpy()[movable], force[movable]) < 2e-6  # rounding
    assert relative(system.torques.numpy()[free], torque[free]) < 2e-6
    assert not system.torques.numpy()[balls].any()


def test_only_movable_moments_get_forces(device):
    x, radii, m = pile(count=30)
    movable = np.arange(30) % 7 < 4
    everything, some = (
        moment_system(radii=radii, permanent=np.ones(30, bool), movable=which, device=device)
        for which in (None, movable)
    )
    for system in (everything, some):
        system.positions.assign(x)
        system.moments.assign(m)
        system.solve()
        system.apply_forces()
    assert relative(some.forces.numpy()[movable], everything.forces.numpy()[movable]) < 1e-6
    assert np.abs(some.forces.numpy()[~movable]).max() == 0.0


def test_lone_inducible_ball_feels_no_torque(device):
    system, *_ = two_worlds(device)
    system.solve()
    system.apply_forces()
    torques = np.linalg.norm(system.torques.numpy(), axis=1)
    assert torques[:60].max() == 0.0 and torques[60] > 0.0


def test_warm_start_follows_a_slow_motion(device):
    system, positions, *_ = two_worlds(device)
    system.solve()
    cold = system.evaluations.numpy().max()
    positions[60, 2] -= 1e-4
    system.positions.assign(positions)
    system.solve()
    warm = system.evaluations.numpy().max()
    assert warm < cold
    system.start_cold()
    system.solve()
    assert system.evaluations.numpy().max() >= cold - 1


def test_extrapolation_follows_a_steady_motion(device):
    """A field that turns steadily costs one evaluation a solve, which no earlier solution would be good enough for."""
    x, radii, _ = pile(count=150)
    evaluations, errors = [], []
    for remembering in (True, False):
        system = moment_system(radii=radii, saturation=MS, rtol=1e-3, device=device)
        system.positions.assign(x)
        for angle in 0.01 * np.arange(12.0):
            field = 0.5 * MS * np.array([np.sin(angle), 0.0, np.cos(angle)])
            system.external_field.assign(np.tile(field, (150, 1)))
            if not remembering:
                system.start_from(system.magnetizations())
            system.solve()
            errors.append(system.error.numpy()[0])
            evaluations.append(system.evaluations.numpy()[0])
    # two changes are known from the fourth solve on
    assert max(evaluations[4:12]) == 1 and min(evaluations[13:]) > 1
    assert max(errors) <= 1e-3


def test_a_start_knows_where_the_neighbors_have_gone(device):
    """What balls that shift at random do to their neighbours, the first moments have in them, before any field."""
    x, radii, _ = pile(count=150)
    field = np.array([0.0, 0.0, 0.1 * MS])
    system = moment_system(radii=radii, saturation=MS, external_field=field, rtol=1e-5, device=device)
    system.positions.assign(x)
    for _ in range(4):
        system.solve()
    last = system.magnetizations().numpy().astype(float)
    x = x + 0.02 * radii[:, None] * np.random.default_rng(2).normal(size=x.shape)
    system.positions.assign(x)
    system.begin()
    system.iterate()
    volumes = 4.0 / 3.0 * np.pi * radii[:, None] ** 3
    h = field + oracle.h_field(x, volumes * last, radii=radii)
    strength = np.linalg.norm(h, axis=1, keepdims=True)
    unmoved = relative(last, MS * np.tanh(3.0 * strength / MS) * h / strength)
    # two sweeps, each of which leaves 0.4 of what a ball's field has changed by and some of its neighbours' changes
    assert system.error.numpy()[0] < 0.4 * unmoved


@pytest.mark.parametrize("motion", ["drift", "jitter"])
def test_error_is_one_in_every_step(motion, device):
    """A heap that moves in a weak field, where errors are largest: what earlier solves taught holds in later ones."""
    rng = np.random.default_rng(6)
    x, field = fcc_block((3, 3, 3)), MS * np.array([1e-4, 0.0, 2e-4])
    velocity = 1e-5 * rng.normal(size=x.shape)  # m a step; 5 mm balls
    system = moment_system(radii=np.full(108, 0.005), saturation=MS, external_field=field, rtol=1e-3, device=device)
    evaluations = []
    for step in range(12):
        moved = step * velocity if motion == "drift" else 2.5e-5 * rng.normal(size=x.shape)
        positions = (x + moved).astype(np.float32).astype(float)
        system.positions.assign(positions)
        system.solve()
        exact = oracle.equilibrium(positions, float(np.float32(0.005)), field, saturation=MS)
        error = relative(system.magnetizations().numpy(), exact.magnetizations)
        # in the mean the estimate is three times the error, and here and there a little less than it
        assert error <= min(1e-3, 1.5 * system.error.numpy()[0]) and system.error.numpy()[0] <= 1e-3
        evaluations.append(system.evaluations.numpy()[0])
    assert max(evaluations[4:]) <= 3


@pytest.fixture(scope="module")
def starts():
    """Radii of a pile, and positions, field and exact magnetizations of one arrangement after the other, in float32."""
    rng = np.random.default_rng(8)
    x, radii, _ = pile(count=100)
    up, across = MS * np.array([0.1, 0.0, 0.5]), MS * np.array([0.5, -0.2, 0.0])
    moving = [((1.0 + 0.002 * step) * x, (1.0 + 0.01 * step) * up) for step in range(5)]
    scattered = x + 0.004 * rng.normal(size=x.shape)
    states = [
        *moving, (x[::-1], up), *moving[3:], moving[-1], moving[0], (scattered, up), (x, up), (x, -up), (x, up),
        (x, 1e3 * up), (x, -1e3 * up), (x, 1e-6 * up), (x, 0.0 * up), (x, 0.0 * up), (x, -up), (scattered, across),
    ]  # fmt: skip
    states = [as_float32(*state) for state in states]
    return radii, [(p, h, oracle.equilibrium(p, radii, h, saturation=MS).magnetizations) for p, h in states]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_starts_never_decide_the_solution(dtype, device, starts):
    """Whatever was extrapolated before it, a jump, a restored state or a reversed field ends in the one solution."""
    radii, states = starts
    rtol = 1e-5 if dtype == "float32" else 1e-10
    system = moment_system(radii=radii, saturation=MS, rtol=rtol, dtype=dtype, device=device)
    for step, (positions, field, exact) in enumerate(states):
        system.positions.assign(positions)
        system.external_field.assign(np.tile(field, (100, 1)))
        system.solve()
        assert system.converged.numpy()[0] == 1, step
        # the residual is amplified by the inverse Jacobian, some ten times in a pile
        assert np.linalg.norm(system.magnetizations().numpy() - exact) <= 100.0 * rtol * np.linalg.norm(exact), step


@pytest.mark.parametrize("curve", magnets.CURVES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_stage_of_a_step(dtype, curve, device):
    """Two worlds on the move, with magnets among the balls, and more neighbours than lists hold, against the oracle.

    Tolerance: rounding; where balls overlap deeply, terms of both signs cancel to about a tenth of their size.
    """
    x, radii, _ = pile(count=61)
    y, _, _ = overlapping(150, extent=0.03)
    radii = as_float32(np.r_[radii, np.random.default_rng(4).uniform(0.005, 0.01, 150)])[0]
    velocities = np.random.default_rng(3).normal(size=(211, 3)) * 2e-4
    permanent, external = np.isin(np.arange(211), [60, 210]), np.array([0.0, 0.0, 1e5])
    system = moment_system(
        radii=radii, worlds=np.repeat([0, 1], [61, 150]), permanent=permanent, saturation=MS, curve=curve,
        external_field=external, dtype=dtype, device=device,
    )  # fmt: skip
    system.moments.assign(np.where(permanent[:, None], [0.2, 0.0, 0.3], 0.0))
    tolerance = {"float32": 1e-5, "float64": 1e-12}[dtype]
    worlds = [(slice(0, 60), slice(60, 61), slice(0, 61)), (slice(61, 210), slice(210, 211), slice(61, 211))]
    for step in range(6):
        system.positions.assign(np.r_[x, y] + step * velocities)
        at = system.positions.numpy().astype(float)
        system.begin()
        system.evaluate()
        moments, h0, h = (_host(a) for a in (system.moments, system._induction.h0, system.h))
        for balls, fixed, both in worlds:
            given = {"radii": radii[fixed], "target_radii": radii[balls]}
            applied = external + oracle.h_field(at[fixed], moments[fixed], at[balls], **given)
            assert relative(h0[balls], applied) < tolerance
            whole = external + oracle.h_field(at[both], moments[both], radii=radii[both])[:-1]
            assert relative(h[balls], whole) < tolerance
        system.iterate()
        system.apply_forces()
        moments, forces, torques = (_host(a) for a in (system.moments, system.forces, system.torques))
        for balls, fixed, both in worlds:
            gradient = oracle.field_gradient(at[both], moments[both], radii=radii[both])
            assert relative(forces[both], oracle.kelvin_force(moments[both], gradient)) < tolerance
            whole = external + oracle.h_field(at[both], moments[both], radii=radii[both])
            lack = torques[fixed] - oracle.torque(moments[fixed], whole[-1:])
            # the two are nearly parallel: rounding of their sizes, not of their cross product
            size = oracle.MU0 * np.linalg.norm(moments[fixed]) * np.linalg.norm(whole[-1])
            assert np.linalg.norm(lack) < tolerance * size
            assert not torques[balls].any()
        wp.capture_while(system._induction.condition, system.iterate)
        assert system.converged.numpy().all()
        magnetizations, moments = _host(system.magnetizations()), _host(system.moments)
        for balls, _, both in worlds:
            whole = external + oracle.h_field(at[both], moments[both], radii=radii[both])[:-1]
            goal = oracle.magnetization(whole, MS, curve=curve)[0]
            assert relative(magnetizations[balls], goal) < 2.0 * system.rtol
    assert (system._packed.neighbor_counts.numpy() > CAPACITY).any()


def _host(array):
    return array.numpy().astype(float)


def test_magnet_in_a_world_of_its_own(device):
    """A ball in another world is in the external field alone."""
    system = moment_system(
        radii=np.full(2, 0.005), worlds=[0, 1], permanent=[False, True], saturation=MS, external_field=[0.0, 0.0, 1e5],
        rtol=1e-5, device=device,
    )  # fmt: skip
    system.moments.assign([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    system.solve()
    expected = oracle.magnetization(np.array([[0.0, 0.0, 1e5]]), MS)[0]
    assert relative(system.magnetizations().numpy()[:1], expected) < 1e-5


def test_bodies_that_cannot_be_told_apart_are_refused(device, monkeypatch):
    """Neighbouring numbers that are one in single precision would be one body, whose moments do not act."""
    given = {"radii": [0.01, 0.01], "bodies": [2**24, 2**24 + 1], "device": device}
    with pytest.raises(InputError, match="bodies: numbers too large, at most 16777216 in float32; use float64"):
        moment_system(**given)
    assert moment_system(dtype="float64", **given).count == 2
    monkeypatch.setattr("warpmag.moments.arrays.MOST_BODIES", {wp.float32: 2, wp.float64: 3})
    places = np.eye(3)
    with pytest.raises(InputError, match="positions: 3 moments that act on each other, at most 2 in float32"):
        warpmag.wrench(places, places, device=device)
    assert warpmag.wrench(places, places, dtype="float64", device=device)[0].any()


def test_moments_out_of_order_are_refused(device):
    """Inducible moments come first in each world, and worlds one after the other."""
    for wrong in ({"permanent": [True, False]}, {"worlds": [1, 0]}):
        with pytest.raises(InputError, match="ordered by world"):
            moment_system(radii=np.ones(2), device=device, **wrong)


def test_threads_do_not_show(device, monkeypatch):
    """Balls enough for three threads to share every pass, on the move: the same bits again, and those of one."""
    x = 0.01 * np.stack(np.meshgrid(*[np.arange(20.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    velocities = np.random.default_rng(5).normal(size=x.shape) * 2e-4
    results = []
    for cores in (3, 3, 1):
        monkeypatch.setattr(team, "cores", lambda cores=cores: cores)
        system = moment_system(
            radii=np.full(len(x), 0.005), saturation=MS, external_field=[0.0, 0.0, 1e5], rtol=1e-5, device=device
        )
        for step in range(4):
            system.positions.assign(x + step * velocities)
            system.solve()
        system.apply_forces()
        results.append((system.moments.numpy().copy(), system.forces.numpy().copy()))
    for first, second, alone in zip(*results, strict=True):
        assert np.array_equal(first, second)
        assert np.array_equal(first, alone)


def test_magnet_that_goes_away(device):
    """Without a field the only solution is no magnetization, from a warm start too."""
    system, _, moments, _ = two_worlds(device)
    system.solve()
    system.moments.assign(0.0 * moments)
    system.solve()
    assert np.abs(system.moments.numpy()).max() == 0.0
    assert system.converged.numpy().tolist() == [1, 1]


def test_state_that_is_not_finite(device):
    """NaN positions are not silent, end at once, and do not poison the solve after."""
    system, positions, moments, _ = two_worlds(device)
    broken = positions.copy()
    broken[3, 0] = np.nan
    system.positions.assign(broken)
    system.solve()
    assert system.converged.numpy().tolist() == [0, 1]
    assert np.isnan(system.error.numpy()[0]) and system.evaluations.numpy()[0] <= 2
    system.positions.assign(positions)
    system.moments.assign(moments)
    system.solve()
    assert system.converged.numpy().tolist() == [1, 1]


def test_captured_graph_gives_the_same_bits(device):
    plain, positions, *_ = two_worlds(device)
    captured, *_ = two_worlds(device)
    for system in (plain, captured):
        system.solve()
        system.apply_forces()
    with wp.ScopedCapture(device=device) as capture:
        captured.solve()
        captured.apply_forces()
    for step in range(3):
        positions[:60] *= 1.0 - 1e-4 * step
        for system in (plain, captured):
            system.positions.assign(positions)
        plain.solve()
        plain.apply_forces()
        wp.capture_launch(capture.graph)
        for name in ("moments", "forces", "torques", "evaluations", "error"):
            assert np.array_equal(getattr(plain, name).numpy(), getattr(captured, name).numpy()), (step, name)


def test_solves_inside_a_loop_of_a_graph(device):
    """What a solve launches may stand in the body of a conditional node, whole substeps in a loop on the device."""

    @wp.kernel(module="unique")
    def shrink(positions: wp.array[wp.vec3], left: wp.array[int]):
        i = wp.tid()
        positions[i] = 0.999 * positions[i]
        if i == 0:
            left[0] = left[0] - 1

    def substep(system, left):
        system.solve()
        system.apply_forces()
        wp.launch(shrink, dim=60, outputs=[system.positions, left], device=device)

    plain, looped = (two_worlds(device)[0] for _ in range(2))
    left = wp.zeros(1, dtype=int, device=device)
    for system in (plain, looped):
        substep(system, left)
    left.fill_(0)
    with wp.ScopedCapture(device=device) as capture:
        wp.capture_while(left, substep, system=looped, left=left)
    left.fill_(5)
    wp.capture_launch(capture.graph)
    other = wp.zeros(1, dtype=int, device=device)
    for _ in range(5):
        substep(plain, other)
    for name in ("positions", "moments", "forces", "evaluations", "error"):
        assert np.array_equal(getattr(plain, name).numpy(), getattr(looped, name).numpy()), name
    assert left.numpy()[0] == 0


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_two_runs_are_bitwise_equal(dtype, device):
    results = []
    for _ in range(2):
        system, *_ = two_worlds(device, dtype=dtype)
        system.solve()
        system.apply_forces()
        results.append((system.moments.numpy(), system.forces.numpy()))
    assert all(np.array_equal(a, b) for a, b in zip(*results, strict=True))


def test_large_bodies_leave_out_their_own_pairs():
    """At the start and the end of a world, alone in a world, and as small bodies, which are summed with others."""
    bodies = np.concatenate([np.full(20, 0), np.full(3, 1), np.full(30, 2), np.full(40, 3), np.arange(4, 9)])
    worlds = np.concatenate([np.zeros(53, int), np.ones(40, int), np.full(5, 2)])
    layout = make_layout(np.ones(98), worlds, None, bodies, None, wp.float32)
    movable = np.ones(98, bool)
    movable[[5, 60]] = False
    assert layout.wrench_runs(movable) == [
        *((0, 5, 20, 53), (6, 20, 20, 53), (20, 23, 0, 53), (23, 53, 0, 23)),
        *((53, 60, 92, 93), (61, 93, 92, 93)),
        (93, 98, 93, 98),
    ]


def test_forces_without_own_pairs_are_those_of_all_pairs(device):
    """Two bodies of 20 moments and one of 3, against the oracle."""
    rng = np.random.default_rng(3)
    bodies = np.concatenate([np.full(20, 0), np.full(3, 1), np.full(20, 2)])
    positions, moments = 0.01 * rng.normal(size=(43, 3)) + 0.1 * bodies[:, None], rng.normal(size=(43, 3))
    radii, permanent = np.full(43, 1e-4), np.ones(43, bool)
    system = moment_system(radii=radii, permanent=permanent, bodies=bodies, dtype="float64", device=device)
    system.positions.assign(positions)
    system.moments.assign(moments)
    system.solve()
    system.apply_forces()
    gradients = oracle.field_gradient(positions, moments, bodies=bodies)
    forces = oracle.kelvin_force(moments, gradients)
    np.testing.assert_allclose(system.forces.numpy(), forces, atol=1e-12 * np.abs(forces).max())
