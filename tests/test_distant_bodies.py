"""Few moments in place of the cells of iron bodies while every other magnet keeps a distance from them."""

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.engine.magnets import magnetics as magnetics_module
from warpmag.moments.arrays import restore_snapshot, take_snapshot
from warpmag.moments.probe import FieldProbe
from warpmag.shapes import demagnetization, distant_response, lattice
from warpmag.shapes.linear_cells import with_slopes
from warpmag.shapes.uniform_response import cell_matrix, with_surface_response

PLATE = (0.03, 0.03, 0.0015)


def model_of(device, gap, *, worlds=1, balls=(), spacing=0.0, **material):
    """Return a disc magnet at rest and an iron plate ``gap`` [m] below it, in each world, and balls."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(world)
    disc = world.add_body(label="disc")
    world.add_shape_cylinder(disc, radius=0.01, half_height=0.0025)
    warpmag.add_permanent(world, body=disc, magnetization=(0.0, 0.0, 1.03e6))
    pose = wp.transform((0.002, 0.001, -0.0025 - PLATE[2] - gap), wp.quat_identity())
    plate = world.add_body(xform=pose, label="plate")
    world.add_shape_box(plate, hx=PLATE[0], hy=PLATE[1], hz=PLATE[2])
    warpmag.add_inducible(world, body=plate, moment_spacing=spacing, **material)
    for position in balls:
        ball = world.add_body(xform=wp.transform(position, wp.quat_identity()))
        world.add_shape_sphere(ball, radius=0.004)
        warpmag.add_inducible(world, body=ball)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    builder.replicate(world, worlds)
    return builder.finalize(device=device)


def with_cells(monkeypatch, model, **options):
    """Return ``Magnetics`` in which all bodies act by cells."""
    with monkeypatch.context() as context:
        context.setattr(magnetics_module, "distant_bodies", lambda *_, **__: {})
        return warpmag.Magnetics(model, **options)


def wrenches(magnetics, state):
    state.clear_forces()
    magnetics.apply(state)
    assert magnetics.converged.numpy().all()
    return state.body_f.numpy().astype(float)


def put(state, bodies, offset):
    poses = state.body_q.numpy()
    poses[bodies, :3] = offset
    state.body_q.assign(poses)


def rests(magnetics):
    """Return True for the worlds whose cells rest."""
    return magnetics.system.resting.numpy() == 1


def reaches(magnetics):
    """Return the distances of the levels of the first body with few moments [m]."""
    return magnetics._distant._launches._bodies[0].reach.numpy()[0].astype(float)


def levels(magnetics):
    """Return the number of the system that acts in each world; the last one has the cells."""
    resting = np.array([system.resting.numpy() for system in magnetics._distant.systems])
    assert ((resting == 0).sum(axis=0) == 1).all()
    return resting.argmin(axis=0)


def relative(values, reference):
    return np.linalg.norm(np.subtract(values, reference)) / np.linalg.norm(reference)


def dipole_field(points, source, moment):
    """Return the field of a dipole, and its derivatives along the axes, shapes [n, 3] and [n, 3, 3]."""
    r = points - source
    d, m = np.linalg.norm(r, axis=1)[:, None], r @ moment
    field = (3.0 * r * m[:, None] / d**5 - moment / d**3) / (4.0 * np.pi)
    unit = np.eye(3)
    gradient = 3.0 * (r[:, :, None] * moment + moment[:, None] * r[:, None] + m[:, None, None] * unit)
    gradient = gradient / d[:, None] ** 5 - 15.0 * m[:, None, None] * r[:, :, None] * r[:, None] / d[:, None] ** 7
    return field, gradient / (4.0 * np.pi)


def force(points, moments, source, moment):
    return np.einsum("nij,nj->i", dipole_field(points, source, moment)[1], moments)


@pytest.mark.parametrize(
    ("solid", "spacing", "count"),
    [
        (lattice.box(PLATE), 0.003, 3),
        (lattice.box([0.01] * 3), 0.0032, 3),
        (lattice.cylinder(0.002, 0.03), 0.0015, 2),
        (lattice.box(PLATE), 0.006, 2),
    ],
    ids=["plate", "cube", "rod", "coarse plate"],
)
def test_few_moments_respond_to_a_dipole_as_the_cells_do(solid, spacing, count):
    # the stated error is that of 26 other places at each level; it falls off with the third power or faster
    body = lattice.fill(solid, spacing, together=True)
    linear = with_slopes(demagnetization.coupling(body, body.radii), body)
    coupling = with_surface_response(linear, body, [solid]).among(1, balls=False)
    bodies = distant_response.distant_bodies(body, coupling)
    assert bodies is not None and len(bodies) == count
    root = np.repeat(np.sqrt(body.volumes), 3)
    uniform = root[:, None] * np.tile(np.eye(3), (len(body.volumes), 1))
    solve = np.linalg.inv(cell_matrix(coupling, body) - uniform @ coupling.common @ uniform.T)
    for few in bodies:
        _check_response(body, few, lambda field: (root * (solve @ (root * field.ravel()))).reshape(-1, 3))


def _check_response(body, few, magnetize):
    """Compare few moments and the cells, with moments ``magnetize(field)``, in fields of balls of that diameter."""
    k = len(few.volumes)
    assert 3 < k <= max(distant_response.POINT_COUNTS) and few.volumes.sum() == pytest.approx(body.volumes.sum())
    law = demagnetization.pair_law_tensors(few.coupling.positions, few.coupling.radii)
    tensors = (few.coupling.grid_tensor + demagnetization.full_tensors(law.reshape(-1, 6))).reshape(k, k, 3, 3)
    tensors = tensors.transpose(0, 2, 1, 3).reshape(3 * k, 3 * k)
    np.testing.assert_allclose(tensors, tensors.T, atol=1e-12 * np.abs(tensors).max())
    response = np.linalg.inv(np.diag(np.repeat(1.0 / (3.0 * few.volumes), 3)) - tensors)
    generator, errors, cells = np.random.default_rng(0), [], []
    for distance in (1.5 * few.reach, 3.0 * few.reach):
        for _ in range(50):
            outside = 2.0 * (few.upper.max() + distance) * generator.normal(size=3)
            nearest = np.clip(outside, few.lower, few.upper)
            source = nearest + distance * (outside - nearest) / np.linalg.norm(outside - nearest)
            moment = generator.normal(size=3)
            m = magnetize(dipole_field(body.positions, source, moment)[0])
            few_m = response @ dipole_field(few.coupling.positions, source, moment)[0].ravel()
            expected = force(body.positions, m, source, moment)
            actual = force(few.coupling.positions, few_m.reshape(-1, 3), source, moment)
            errors.append(relative(actual, expected))
            spread = body.volumes[:, None] * np.einsum("cpn,p->nc", few.patterns, few.coefficients @ few_m)
            cells.append(relative(spread.sum(axis=0), m.sum(axis=0)))
    limit = 1.2 * distant_response.BALL_ERROR
    assert max(errors[:50]) < limit and max(errors[50:]) < limit / 4.0
    assert max(cells) < limit


def test_forces_along_a_path_have_no_jump_and_equal_those_of_cells(device, monkeypatch):
    model = model_of(device, 0.2)
    magnetics, cells = warpmag.Magnetics(model, rtol=1e-4), with_cells(monkeypatch, model, rtol=1e-4)
    state, seen, gaps = model.state(), [], [0.12]
    for reach in reaches(magnetics):  # either side of each switch, on the way in and on the way out
        gaps += [1.1 * reach + 0.003, reach - 0.003]
    gaps += [0.005, *gaps[:0:-1]]
    for gap in [*gaps, 0.2]:
        put(state, [1], (0.002, 0.001, -0.004 - gap))
        actual, expected = wrenches(magnetics, state), wrenches(cells, state)
        seen.append(int(levels(magnetics)[0]))
        # few moments differ less from cells than a jump may be; cells by the tolerance of two solves
        for columns in (slice(3), slice(3, 6)):
            scale = np.abs(expected[:, columns]).max()
            assert np.abs(actual - expected)[:, columns].max() < (5e-3 if seen[-1] < 3 else 2e-3) * scale
        # moments are chosen by the errors of forces, up to BALL_ERROR; those of the total moment are of that order
        assert relative(magnetics.shape_moments()[0], cells.shape_moments()[0]) < 1e-2
        np.testing.assert_allclose(actual[:, :3].sum(axis=0), 0.0, atol=1e-5 * np.abs(actual).max())
    # each switch is at the reach on the way in, and at 1.1 times it on the way out
    assert seen == [0, 0, 1, 1, 2, 2, 3, 3, 3, 2, 2, 1, 1, 0, 0]


@pytest.mark.long
def test_far_forces_equal_refined_ones(device, monkeypatch):
    model = model_of(device, 0.1, spacing=0.0025)
    refined = with_cells(monkeypatch, model)
    assert refined.system.count > 1100
    expected = wrenches(refined, model.state())
    coarse = model_of(device, 0.1)
    actual = wrenches(warpmag.Magnetics(coarse), coarse.state())
    assert relative(actual[1, :3], expected[1, :3]) < 0.02  # the cells themselves differ by 1 %


def test_a_passing_magnet_keeps_its_energy(device):
    model = model_of(device, 0.2)
    magnetics, state = warpmag.Magnetics(model), model.state()
    mass, dt, steps = 0.01, 1e-3, 500
    position, velocity, energies, seen = np.array([-0.25, 0.0, 0.012]), np.array([1.0, 0.0, 0.0]), [], []
    put(state, [1], (0.0, 0.0, 0.0))
    acceleration = np.zeros(3)
    for _ in range(steps + 1):  # leapfrog; rotations are held
        put(state, [0], position)
        previous, acceleration = acceleration, wrenches(magnetics, state)[0, :3] / mass
        velocity += 0.5 * dt * (previous + acceleration)
        energies.append(0.5 * mass * velocity @ velocity)
        seen.append(int(levels(magnetics)[0]))
        position = position + dt * velocity + 0.5 * dt**2 * acceleration
        position[2], velocity[2] = 0.012, 0.0  # a rail
    assert seen[0] == seen[-1] == 0 and {*seen} == {0, 1, 2, 3}
    assert max(energies) > 1.01 * energies[0]
    assert abs(energies[-1] - energies[0]) < 1e-3 * (max(energies) - energies[0])


def test_worlds_choose_by_themselves(device, monkeypatch):
    model = model_of(device, 0.2, worlds=3)
    magnetics, cells, state = warpmag.Magnetics(model), with_cells(monkeypatch, model), model.state()
    bodies = state.body_q.numpy()
    probes = [FieldProbe(each.system, 6, worlds=[0, 0, 1, 1, 2, 2]) for each in (magnetics, cells)]
    for probe in probes:  # near the disc, where it acts by closed forms, and near the plate where it is far
        probe.points.assign([[0.0, 0.0, 0.005], [0.0, 0.0, -0.198]] * 3)
    for near in ([1], [0, 1], [], [2]):  # near enough for cells, or so far that few moments act
        for world in range(3):
            bodies[2 * world + 1, 2] = -0.004 - (0.006 if world in near else 0.2)
        state.body_q.assign(bodies)
        actual, expected = wrenches(magnetics, state), wrenches(cells, state)
        assert np.flatnonzero(~rests(magnetics)).tolist() == near
        for world in range(3):
            rows = slice(2 * world, 2 * world + 2)
            assert relative(actual[rows], expected[rows]) < 5e-3
        np.testing.assert_allclose(magnetics.energy(), cells.energy(), rtol=1e-5)
        for probe in probes:  # of the systems themselves: moments of cells at rest are those of this solve
            probe.measure()
        for row in range(6):
            assert relative(*(probe.b.numpy()[row] for probe in probes)) < 2e-2


@pytest.mark.cuda
def test_a_captured_step_switches(device):
    model = model_of(device, 0.2)
    magnetics, state = warpmag.Magnetics(model), model.state()
    wrenches(magnetics, state)
    with wp.ScopedCapture(device) as capture:
        magnetics.apply(state)
    for gap in (0.2, 0.006, 0.2):
        put(state, [1], (0.002, 0.001, -0.004 - gap))
        state.clear_forces()
        wp.capture_launch(capture.graph)
        forces = state.body_f.numpy()
        assert levels(magnetics)[0] == (0 if gap > 0.1 else 3)
        assert relative(forces, wrenches(warpmag.Magnetics(model), state)) < 2e-3


def test_fields_moments_and_values_of_few_moments_are_those_of_cells(device, monkeypatch):
    options = {"saturation": 1.7e6, "susceptibility": 50.0}
    model = model_of(device, 0.12, balls=[(0.1, 0.0, 0.12)], **options)
    magnetics, cells, state = warpmag.Magnetics(model), with_cells(monkeypatch, model), model.state()
    points = [[0.0, 0.0, -0.1], [0.002, 0.001, -0.124], [0.02, -0.01, -0.1235]]  # outside, and in the plate
    material = model.warpmag.susceptibility.numpy()
    for field, susceptibility in (((0.0, 0.0, 0.0), 50.0), ((3e4, 0.0, 1e4), 50.0), ((3e4, 0.0, 1e4), 5.0)):
        model.warpmag.susceptibility.assign(np.where(material == 50.0, susceptibility, material))
        for each in (magnetics, cells):
            each.notify_model_changed()
            each.set_external_field(field)
        # few moments are those of ideal permeability, with which the magnetization is distributed differently
        assert relative(wrenches(magnetics, state), wrenches(cells, state)) < 1e-2
        assert rests(magnetics).all() and not rests(cells).any()
        actual, expected = magnetics.b_field(points), cells.b_field(points)
        # inside, the patterns are those of ideal permeability
        assert relative(actual[0], expected[0]) < 5e-3 and relative(actual[1:], expected[1:]) < 0.08
        actual, expected = magnetics.shape_moments(), cells.shape_moments()
        assert (np.linalg.norm(actual - expected, axis=-1) < 1e-2 * np.linalg.norm(expected, axis=-1)).all()
        np.testing.assert_allclose(magnetics.energy(), cells.energy(), rtol=1e-3)


def test_cells_act_where_they_saturate(device, monkeypatch):
    model = model_of(device, 0.12)
    magnetics, cells = warpmag.Magnetics(model), with_cells(monkeypatch, model)
    for strength, few in ((1e4, True), (1e5, False), (1e6, False), (1e4, False), (1e4, True)):
        for each in (magnetics, cells):
            each.set_external_field((strength, 0.0, 0.0))
            each.apply(model.state())
        assert rests(magnetics).all() == few
        assert relative(magnetics.shape_moments()[0], cells.shape_moments()[0]) < 5e-3


def test_steps_repeat_and_worlds_start_again(device):
    model = model_of(device, 0.2, worlds=2)
    magnetics, state = warpmag.Magnetics(model), model.state()
    first = wrenches(magnetics, state)
    put(state, [1], (0.002, 0.001, -0.01))
    saved = take_snapshot(magnetics.persistent_arrays())
    near = wrenches(magnetics, state)
    assert rests(magnetics).tolist() == [False, True]
    restore_snapshot(magnetics.persistent_arrays(), saved)
    assert rests(magnetics).all()
    np.testing.assert_array_equal(wrenches(magnetics, state), near)
    before = magnetics.shape_moments()
    moments = magnetics.moments_at(model.state())
    assert relative(moments[0], before[0]) > 0.5 and relative(moments[2], before[2]) < 1e-3
    np.testing.assert_array_equal(magnetics.shape_moments(), before)
    magnetics.reset()
    np.testing.assert_array_equal(wrenches(magnetics, model.state()), first)


def test_gradients_are_those_of_cells(device):
    model = model_of(device, 0.15)
    magnetics, state = warpmag.Magnetics(model), model.state(requires_grad=True)
    with wp.Tape():
        magnetics.apply(state)
    assert not rests(magnetics).any()
