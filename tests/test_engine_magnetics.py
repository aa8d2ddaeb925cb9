"""Forces and torques on Newton's bodies against sums by hand."""

import math

import newton
import numpy as np
import pytest
import warp as wp
from small_builders import R, add_ball, new_builder

import warpmag
from bench.reference import near_contact as contact_oracle
from bench.reference import oracle
from warpmag.declarations.magnets import SATURATION_OF_IRON
from warpmag.engine.magnets.grouping import find_magnets
from warpmag.engine.magnets.sampling import ShapeSampler

M = 1e6  # A/m
VOLUME = 4.0 / 3.0 * math.pi * R**3
SINGLE = 2e-6  # sums of a few float32 terms, relative to the largest


def wrenches(model, **arguments):
    """Return forces and torques on the bodies [N], [N·m], and the magnetics that made them."""
    magnetics = warpmag.Magnetics(model, **arguments)
    state = model.state()
    magnetics.apply(state)
    result = state.body_f.numpy().astype(float)
    return result[:, :3], result[:, 3:], magnetics


def test_two_permanent_balls_in_line(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    add_ball(builder, (0.0, 0.0, 0.03), (0.0, 0.0, M))
    forces, torques, _ = wrenches(builder.finalize(device=device))
    pull = 6.0 * oracle.MU0 * (M * VOLUME) ** 2 / (4.0 * math.pi * 0.03**4)  # two dipoles in line attract
    np.testing.assert_allclose(forces, [(0, 0, pull), (0, 0, -pull)], atol=SINGLE * pull)
    np.testing.assert_allclose(torques, 0.0, atol=SINGLE * pull * R)


def test_forces_are_added_to_those_already_there(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    model = builder.finalize(device=device)
    state = model.state()
    state.body_f.fill_(wp.spatial_vector(1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    warpmag.Magnetics(model).apply(state)
    np.testing.assert_array_equal(state.body_f.numpy(), [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])


def test_a_permanent_moment_turns_with_its_body_and_feels_the_field(device):
    builder = new_builder()
    half = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), math.radians(30.0))
    add_ball(builder, (0.1, 0.2, 0.3), (0.0, 0.0, M), half)
    field = (0.0, 0.0, 1e5)
    forces, torques, magnetics = wrenches(builder.finalize(device=device), external_field=field)
    moment = M * VOLUME * np.array([0.5, 0.0, math.sqrt(0.75)])
    expected = oracle.MU0 * np.cross(moment, field)
    np.testing.assert_allclose(torques[0], expected, atol=SINGLE * np.linalg.norm(expected))
    np.testing.assert_array_equal(forces, 0.0)  # a uniform field does not pull
    np.testing.assert_allclose(magnetics.shape_moments(), [moment], atol=SINGLE * np.linalg.norm(moment))


def test_an_inducible_ball_is_magnetized_and_pulled(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    add_ball(builder, (0.0, 0.0, 0.02))
    forces, torques, magnetics = wrenches(builder.finalize(device=device), rtol=1e-5)
    positions = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.02)])
    field = oracle.h_field(positions, np.array([(0.0, 0.0, M * VOLUME), (0.0, 0.0, 0.0)]), radii=R)[1:]
    induced = VOLUME * oracle.magnetization(field, 1.7e6)[0][0]
    moments = np.array([(0.0, 0.0, M * VOLUME), induced])
    expected = oracle.kelvin_force(moments, oracle.field_gradient(positions, moments, radii=R))
    size = np.linalg.norm(expected[0])
    np.testing.assert_allclose(forces, expected, atol=3e-5 * size)  # rtol, and float32
    np.testing.assert_allclose(torques, 0.0, atol=3e-5 * size * R)
    order = np.argsort(magnetics.shapes)
    np.testing.assert_allclose(magnetics.shape_moments()[order], moments, atol=3e-5 * M * VOLUME)


def test_balls_that_nearly_touch_pull_harder_than_dipoles(device):
    builder = new_builder()
    x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.05 * R], [2.05 * R, 0.0, 0.0]])
    for position in x:
        add_ball(builder, tuple(position))
    add_ball(builder, (0.0, 0.0, 0.1), (0.0, 0.0, M))  # a permanent ball far off, which takes no part
    model = builder.finalize(device=device)
    field = np.array([0.0, 3e3, 1e4])
    forces, _, magnetics = wrenches(model, external_field=tuple(field), contact_model="multipole", rtol=1e-5)
    dipoles, _, _ = wrenches(model, external_field=tuple(field), rtol=1e-5)
    applied = field + oracle.h_field([[0.0, 0.0, 0.1]], [[0.0, 0.0, M * VOLUME]], x)
    exact, near = contact_oracle.equilibrium(x, R, applied, saturation=SATURATION_OF_IRON)
    pull = oracle.field_gradient([[0.0, 0.0, 0.1]], [[0.0, 0.0, M * VOLUME]], x)
    near += oracle.kelvin_force(VOLUME * exact.magnetizations, pull)
    np.testing.assert_allclose(forces[:3], near, atol=1e-3 * np.abs(near).max())  # of rtol, some ten times amplified
    assert np.abs(forces[:3]).max() > 2.0 * np.abs(dipoles[:3]).max()
    assert np.abs(forces.sum(0)).max() < 1e-5 * np.abs(forces).max()
    # captured and replayed
    state, again = model.state(), model.state()
    with wp.ScopedCapture(model.device) as capture:
        again.clear_forces()
        magnetics.apply(again)
    magnetics.apply(state)
    wp.capture_launch(capture.graph)
    np.testing.assert_allclose(again.body_f.numpy(), state.body_f.numpy(), atol=1e-4 * np.abs(forces).max())


def test_a_moment_off_the_centre_of_mass_turns_its_body(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.03), (0.0, 0.0, M))
    body = builder.add_body()
    builder.add_shape_sphere(body, radius=R)
    warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, M))
    arm = 0.02
    counterweight = newton.ModelBuilder.ShapeConfig(density=7000.0)  # seven times the ball's, not magnetic
    builder.add_shape_sphere(body, xform=wp.transform((arm, 0.0, 0.0), wp.quat_identity()), radius=R, cfg=counterweight)
    forces, torques, _ = wrenches(builder.finalize(device=device))
    center = arm * 7.0 / 8.0
    expected = np.cross((-center, 0.0, 0.0), forces[1])
    assert np.linalg.norm(expected) > 0.0
    np.testing.assert_allclose(torques[1], expected, atol=1e-5 * np.linalg.norm(expected))


@pytest.fixture(scope="module")
def box_and_ball(device):
    """A turned permanent box, off its body's origin, and a permanent ball: forces, torques, model, magnetics."""
    builder = new_builder()
    turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, 3.0)), 0.7)
    box = builder.add_body(xform=wp.transform((0.01, -0.02, 0.03), turn))
    pose = wp.transform((0.004, 0.0, 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.4))
    builder.add_shape_box(box, xform=pose, hx=0.01, hy=0.006, hz=0.004)
    warpmag.add_permanent(builder, body=box, magnetization=(0.3 * M, 0.0, M), moment_spacing=0.004)
    add_ball(builder, (0.03, -0.01, 0.05), (M, 0.0, 0.0))
    model = builder.finalize(device=device)
    return *wrenches(model), model


def test_a_box_has_its_exact_moment(box_and_ball):
    _, _, magnetics, model = box_and_ball
    turn = wp.transform_get_rotation(wp.transform(*model.body_q.numpy()[0].tolist()))
    expected = 8.0 * 0.01 * 0.006 * 0.004 * np.array(wp.quat_rotate(turn, wp.vec3(0.3 * M, 0.0, M)))
    actual = magnetics.shape_moments()[list(magnetics.shapes).index(0)]
    np.testing.assert_allclose(actual, expected, atol=SINGLE * np.linalg.norm(expected))


def test_a_box_is_pulled_and_turned_as_the_sum_of_its_moments(box_and_ball):
    forces, torques, magnetics, model = box_and_ball
    system = magnetics.system
    positions, moments = system.positions.numpy().astype(float), system.moments.numpy().astype(float)
    counts = [len(magnet.lattice.volumes) for magnet in magnetics.magnets]
    radii = np.concatenate([magnet.lattice.radii for magnet in magnetics.magnets])
    bodies = np.repeat([magnet.body for magnet in magnetics.magnets], counts)
    arguments = {"radii": radii, "bodies": bodies}
    each = oracle.kelvin_force(moments, oracle.field_gradient(positions, moments, **arguments))
    turning = oracle.torque(moments, oracle.h_field(positions, moments, **arguments))
    poses, centers = model.body_q.numpy(), model.body_com.numpy()
    for body in range(2):
        mine = bodies == body
        center = np.array(wp.transform_point(wp.transform(*poses[body].tolist()), wp.vec3(*centers[body].tolist())))
        wrench = turning[mine].sum(axis=0) + np.cross(positions[mine] - center, each[mine]).sum(axis=0)
        size = np.linalg.norm(each[mine], axis=1).sum()
        np.testing.assert_allclose(forces[body], each[mine].sum(axis=0), atol=SINGLE * size)
        np.testing.assert_allclose(torques[body], wrench, atol=SINGLE * size * 0.02)


def test_action_equals_reaction(box_and_ball):
    forces, torques, _, model = box_and_ball
    poses, centers = model.body_q.numpy(), model.body_com.numpy()
    at = [
        np.array(wp.transform_point(wp.transform(*q.tolist()), wp.vec3(*c.tolist())))
        for q, c in zip(poses, centers, strict=True)
    ]
    size = np.linalg.norm(forces, axis=1).sum()
    np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=SINGLE * size)
    np.testing.assert_allclose((torques + np.cross(at, forces)).sum(axis=0), 0.0, atol=SINGLE * size * 0.1)


def test_moments_of_one_body_do_not_pull_each_other(device):
    builder = new_builder()
    body = builder.add_body()
    for x in (-0.006, 0.006):
        builder.add_shape_sphere(body, xform=wp.transform((x, 0.0, 0.0), wp.quat_identity()), radius=R)
    warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, M))
    forces, torques, magnetics = wrenches(builder.finalize(device=device))
    assert len(magnetics.system.positions) == 2  # balls apart from each other stay one moment each
    np.testing.assert_array_equal(forces, 0.0)
    np.testing.assert_array_equal(torques, 0.0)


def test_overlapping_shapes_of_a_body_are_one_volume(device):
    builder = new_builder()
    body = builder.add_body()
    builder.add_shape_box(body, hx=0.01, hy=0.01, hz=0.01)
    middle = wp.transform((0.01, 0.0, 0.0), wp.quat_identity())
    builder.add_shape_box(body, xform=middle, hx=0.01, hy=0.01, hz=0.01)  # half of it inside the first
    warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, M), moment_spacing=0.005)
    _, _, magnetics = wrenches(builder.finalize(device=device))
    volumes = magnetics.shape_moments()[:, 2] / M
    np.testing.assert_allclose(volumes, [8e-6, 4e-6], rtol=0.02)  # the lattice's test grid knows cuts to 1 %


def test_kinematic_bodies_pull_but_take_no_force(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M), is_kinematic=True)
    add_ball(builder, (0.0, 0.0, 0.03), (0.0, 0.0, M))
    forces, _, _ = wrenches(builder.finalize(device=device))
    assert forces[1, 2] < 0.0
    np.testing.assert_array_equal(forces[0], 0.0)


def test_static_magnets_pull(device):
    builder = new_builder()
    shape = builder.add_shape_sphere(-1, xform=wp.transform((0.0, 0.0, 0.03), wp.quat_identity()), radius=R)
    warpmag.add_permanent(builder, shape=shape, magnetization=(0.0, 0.0, M))
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    forces, _, _ = wrenches(builder.finalize(device=device))
    pull = 6.0 * oracle.MU0 * (M * VOLUME) ** 2 / (4.0 * math.pi * 0.03**4)
    np.testing.assert_allclose(forces, [(0.0, 0.0, pull)], atol=SINGLE * pull)


def test_worlds_do_not_see_each_other(device):
    single = new_builder()
    add_ball(single, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    add_ball(single, (0.0, 0.01, 0.02))
    alone, _, _ = wrenches(single.finalize(device=device))
    both = newton.ModelBuilder()
    both.replicate(single, 3)  # all at the same place
    forces, _, _ = wrenches(both.finalize(device=device))
    np.testing.assert_allclose(forces, np.tile(alone, (3, 1)), rtol=1e-6)


def test_a_magnet_outside_all_worlds_needs_one_world(device):
    first = new_builder()
    add_ball(first, (0.0, 0.0, 0.02))
    scene = new_builder()
    shape = scene.add_shape_sphere(-1, radius=R, label="stray")
    warpmag.add_permanent(scene, shape=shape, magnetization=(0.0, 0.0, M))
    scene.add_world(first)
    forces, _, _ = wrenches(scene.finalize(device=device))
    assert forces[0, 2] < 0.0
    scene.add_world(first)
    with pytest.raises(warpmag.InputError, match="stray: a magnet outside all worlds, while 2 worlds"):
        warpmag.Magnetics(scene.finalize(device=device))


def test_settings_are_checked(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0))
    model = builder.finalize(device=device)
    for bad in ({"force": "lorentz"}, {"dynamics": "magic"}, {"rtol": 0.0}, {"external_field": (math.nan, 0.0, 0.0)}):
        with pytest.raises(warpmag.InputError, match="Magnetics: "):
            warpmag.Magnetics(model, **bad)


def test_a_magnet_of_a_size_that_cannot_be_is_refused_by_name():
    builder = new_builder()
    shape, large = (builder.add_shape_sphere(-1, radius=radius, label="odd") for radius in (2e-8, 3e4))
    with pytest.raises(warpmag.InputError, match="^odd: sizes must be from 1e-08 to 20000 m, got 30000$"):
        warpmag.add_permanent(builder, shape=large, magnetization=(0.0, 0.0, M))
    warpmag.add_permanent(builder, shape=shape, magnetization=(0.0, 0.0, M))
    with pytest.raises(warpmag.InputError, match="^odd: its moments have radii of .* m, must be 5e-08 to 20000$"):
        warpmag.Magnetics(builder.finalize(device="cpu"))


def test_apply_can_be_captured(device):
    builder = new_builder()
    add_ball(builder, (0.0, 0.0, 0.0), (0.0, 0.0, M))
    add_ball(builder, (0.0, 0.01, 0.02))
    model = builder.finalize(device=device)
    expected, _, _ = wrenches(model)
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state)
    state.clear_forces()
    with wp.ScopedCapture(device) as capture:
        magnetics.apply(state)
    state.clear_forces()
    wp.capture_launch(capture.graph)
    np.testing.assert_allclose(state.body_f.numpy()[:, :3], expected, rtol=2e-3)  # a warm start ends elsewhere in rtol


@pytest.mark.parametrize("shape", ["capsule", "cylinder", "cone", "ellipsoid", "mesh", "convex", "sphere"])
def test_every_solid_has_its_volume_as_moment(device, shape):
    builder = new_builder()
    body = builder.add_body()
    cube = newton.Mesh.create_box(0.01, 0.01, 0.01, compute_inertia=False)
    r, h = 0.01, 0.02
    volume = {
        "capsule": math.pi * r * r * (2.0 * h + 4.0 / 3.0 * r),
        "cylinder": math.pi * r * r * 2.0 * h,
        "cone": math.pi * r * r * 2.0 * h / 3.0,
        "ellipsoid": 4.0 / 3.0 * math.pi * r * h * 0.5 * h,
        "mesh": 8e-6,
        "convex": 8e-6,
        "sphere": 4.0 / 3.0 * math.pi * r**3,
    }[shape]
    if shape in ("capsule", "cylinder", "cone"):
        getattr(builder, f"add_shape_{shape}")(body, radius=r, half_height=h)
    elif shape == "ellipsoid":
        builder.add_shape_ellipsoid(body, rx=r, ry=h, rz=0.5 * h)
    elif shape == "sphere":
        builder.add_shape_sphere(body, radius=r)
    elif shape == "mesh":
        builder.add_shape_mesh(body, mesh=cube)
    else:
        builder.add_shape_convex_hull(body, mesh=cube)
    warpmag.add_permanent(builder, body=body, magnetization=(0.0, 0.0, M), moment_spacing=0.005)
    magnetics = warpmag.Magnetics(builder.finalize(device=device))
    assert len(magnetics.system.positions) > 8
    np.testing.assert_allclose(magnetics.shape_volumes, [volume], rtol=1e-5)  # float32 sizes


def test_meshes_of_the_same_triangles_are_sampled_once(device):
    """As readers make a mesh of its own for each prim; one that differs in a corner is another."""
    corners = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]])
    faces = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3])
    builder = new_builder()
    for k, height in enumerate((1.0, 1.0, 1.5)):
        body = builder.add_body(xform=wp.transform((0.05 * k, 0.0, 0.0)))
        builder.add_shape_mesh(body, mesh=newton.Mesh(corners * [1.0, 1.0, height], faces))
        warpmag.add_inducible(builder, body=body, moment_spacing=0.003)
    magnetics = warpmag.Magnetics(builder.finalize(device=device))
    first, other, longer = (magnet.lattice for magnet in magnetics.magnets)
    assert first is other
    assert longer.volumes.sum() == pytest.approx(1.5 * first.volumes.sum(), rel=1e-2)  # of what cells resolve


def nail(builder, lean, stretch=1.0, shift=0.0):
    """A body of shaft and head, whose frames have the rounding of a body's rotation and back."""
    body = builder.add_body()
    turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(0.3, 1.0, 0.2)), lean)
    world = wp.transform((0.1 * lean, 0.2, -0.3), turn)
    for radius, half_height, height in ((0.0015, 0.025 * stretch, 0.025), (0.004, 0.0005, 0.0505 + shift)):
        placed = wp.transform_multiply(world, wp.transform((0.0, 0.0, height), wp.quat(0.5, 0.5, 0.5, 0.5)))
        frame = wp.transform_multiply(wp.transform_inverse(world), placed)
        if lean > 1.5:
            frame = wp.transform(frame.p, -frame.q)  # the same rotation
        builder.add_shape_cylinder(body, xform=frame, radius=radius, half_height=half_height)
    return body


def test_shapes_equal_up_to_rounding_are_sampled_once(monkeypatch):
    builder = new_builder()
    for lean in np.linspace(0.0, 3.0, 40):
        warpmag.add_inducible(builder, body=nail(builder, float(lean)))
    model = builder.finalize(device="cpu")
    assert len(np.unique(model.shape_transform.numpy(), axis=0)) > 20
    sampled, sample = [], ShapeSampler._sample

    def counted(sampler, *arguments):
        sampled.append(arguments)
        return sample(sampler, *arguments)

    monkeypatch.setattr(ShapeSampler, "_sample", counted)
    magnets, _ = find_magnets(model)
    assert len(magnets) == 40
    assert len(sampled) == 1
    assert len({id(magnet.lattice) for magnet in magnets}) == 1


@pytest.mark.parametrize("difference", ["stretch", "shift", "lean"])
def test_shapes_that_differ_by_a_ten_thousandth_are_different(difference):
    """In length, in place, relative to the body's size, and in angle [rad]; also in a chain of small steps."""
    builder = new_builder()
    for k in range(30):
        step = 3e-6 * k if k < 29 else 1e-4
        if difference == "lean":
            body, half = builder.add_body(), 0.5 * step
            turned = wp.transform((0.0, 0.0, 0.01), wp.quat(float(np.sin(half)), 0.0, 0.0, float(np.cos(half))))
            builder.add_shape_cylinder(body, xform=turned, radius=0.0015, half_height=0.025)
        else:
            size = {"stretch": 1.0, "shift": 0.05}[difference]
            body = nail(builder, 0.0, **{difference: step * size + (difference == "stretch")})
        warpmag.add_inducible(builder, body=body)
    kinds = ShapeSampler(builder.finalize(device="cpu")).kinds
    kinds = kinds.reshape(30, -1)
    assert (kinds[0] != kinds[29]).any()
    for k in range(28):  # steps of 3e-6 join, but no two shapes 3e-5 apart
        assert (kinds[k] != kinds[k + 10 : 29]).any(axis=1).all()
    assert len(np.unique(kinds, axis=0)) < 20
