"""Balls added in bulk, against Newton's own calls for each of them, and what very many bodies are made of."""

import gc
from collections.abc import Iterator
from typing import Any

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.engine.pile_xpbd.contacts import body_sizes
from warpmag.engine.stepping.simulation import Simulation
from warpmag.errors import InputError
from warpmag.moments.layout import MomentLayout
from warpmag.terminal import collection_paused

COUNT = 7  # two rows of two and three alone: every way in which copies come about


def _builder(*, world=False):
    builder = newton.ModelBuilder(gravity=(0.0, 1.0, -3.0))
    builder.rigid_gap = 3e-4
    builder.default_shape_cfg.restitution = 0.25
    warpmag.register_custom_attributes(builder)
    body = builder.add_body(label="first")
    builder.add_shape_box(body, hx=0.01, hy=0.01, hz=0.01)
    if world:
        builder.begin_world(gravity=(1.0, 0.0, 0.0))
    return builder


def _poses(count=COUNT):
    random = np.random.default_rng(3)
    turns = random.normal(size=(count, 4))
    return random.uniform(-1.0, 1.0, (count, 3)), turns / np.linalg.norm(turns, axis=1, keepdims=True)


def _finished(builder, world):
    if world:
        builder.end_world()
    body = builder.add_body(label="last")
    builder.add_shape_sphere(body, radius=0.1)
    return builder.finalize(device="cpu")


def _fields(thing) -> Iterator[tuple[str, Any]]:
    for name, value in sorted(vars(thing).items()):
        if isinstance(value, newton.Model.AttributeNamespace):
            yield from ((f"{name}.{inner}", entry) for inner, entry in _fields(value))
        elif isinstance(value, wp.array):
            yield name, value.numpy()
        elif isinstance(value, (list, dict, tuple, set, int, float, str, wp.vec3, np.ndarray, type(None))):
            yield name, value


def _same(computed, wanted):
    """Compare two models field by field; return how many there are."""
    computed, wanted = dict(_fields(computed)), dict(_fields(wanted))
    assert computed.keys() == wanted.keys()
    for name, value in wanted.items():
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            # a quotient or a product in single precision, rounded in another order
            np.testing.assert_allclose(computed[name], value, rtol=3e-7, atol=0.0, err_msg=name)
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(computed[name], value, err_msg=name)
        else:
            assert repr(computed[name]) == repr(value), name
    return len(wanted)


@pytest.mark.parametrize("world", [False, True])
@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("permanent", [False, True])
def test_model_is_that_of_newtons_own_calls(world, several, permanent):
    places, turns = _poses()
    radii = np.array([0.004, 0.005, 0.004, 0.007, 0.004, 0.005, 0.006]) if several else np.full(COUNT, 0.005)
    given = {"magnetization": (1e5, 0.0, 2e5)} if permanent else {"saturation": 1.1e6, "susceptibility": 40.0}
    first, many = _builder(world=world), _builder(world=world)
    cfg = first.default_shape_cfg.copy()
    cfg.density, cfg.mu = 7870.0, 0.3
    for number, (place, turn, radius) in enumerate(zip(places, turns, radii, strict=True)):
        body = first.add_body(xform=wp.transform(place, turn), label=f"ball_{number}")
        first.add_shape_sphere(body, radius=radius, cfg=cfg, color=(0.1, 0.2, 0.3), label=f"ball_{number}_shape")
        (warpmag.add_permanent if permanent else warpmag.add_inducible)(first, body=body, **given)
    added = warpmag.add_balls(
        *(many, places, radii if several else 0.005),
        orientations=turns,
        density=7870.0,
        friction=0.3,
        color=(0.1, 0.2, 0.3),
        label="ball",
        **given,
    )
    assert added == warpmag.Balls(range(1, 1 + COUNT), range(1, 1 + COUNT))
    assert _same(_finished(many, world), _finished(first, world)) > 150


def test_nothing_said_is_as_newton_has_it():
    first, many = _builder(), _builder()
    places, _ = _poses()
    for place in places:
        body = first.add_body(xform=wp.transform(place, wp.quat_identity()))
        first.add_shape_sphere(body, radius=0.005, color=(0.5, 0.5, 0.5))
        warpmag.add_inducible(first, body=body)
    warpmag.add_balls(many, places, 0.005, color=(0.5, 0.5, 0.5))
    _same(_finished(many, False), _finished(first, False))


def test_none_is_none():
    first, many = _builder(), _builder()
    assert warpmag.add_balls(many, np.zeros((0, 3)), 0.005).bodies == range(1, 1)
    _same(_finished(many, False), _finished(first, False))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": np.zeros((3, 2))}, r"positions: shape"),
        ({"positions": [[0.0, np.nan, 0.0]]}, r"positions: must be finite"),
        ({"positions": [[0.0, 1e300, 0.0]]}, r"positions: must be finite in single precision"),
        ({"radius": 0.0}, r"radius: must be positive"),
        ({"radius": [0.1, 0.2, 0.3]}, r"radius: shape"),
        ({"radius": "wide"}, r"radius: "),
        ({"orientations": [[0.0, 0.0, 0.0, 1.0]]}, r"orientations: shape"),
        ({"orientations": [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 2.0]]}, r"orientations: .* ball 1 has length 2"),
        ({"density": -1.0}, r"density: must be positive"),
        ({"friction": float("inf")}, r"friction: must be zero or positive and finite"),
        ({"saturation": -1.0}, r"saturation"),
        ({"material": "cheese"}, r"material: "),
        ({"magnetization": (0.0, 0.0, 1e6), "saturation": 1e6}, r"saturation: for inducible magnets only"),
        ({"recoil_permeability": 1.05}, r"recoil_permeability: for permanent magnets only"),
        ({"color": (2.0, 0.0)}, r"color: "),
        ({"builder": newton.ModelBuilder()}, r"builder: call warpmag.register_custom_attributes"),
    ],
)
def test_wrong_arguments_are_one_clear_line_and_add_nothing(change, message):
    builder = _builder()
    given = {"builder": builder, "positions": np.zeros((2, 3)), "radius": 0.005} | change
    with pytest.raises(InputError, match=message) as error:
        warpmag.add_balls(given.pop("builder"), given.pop("positions"), given.pop("radius"), **given)
    assert "\n" not in str(error.value)
    assert (builder.body_count, builder.shape_count) == (1, 1)


def test_runs_of_moments_are_those_of_each_world_by_itself():
    random = np.random.default_rng(0)
    for _ in range(200):
        count = int(random.integers(0, 12))
        worlds = np.sort(random.integers(0, 4, count))
        permanent = np.zeros(count, bool)
        ranges, runs, wanted = [], [], random.random(count) < 0.6
        for world in range(worlds.max(initial=-1) + 1):
            (inside,) = np.nonzero(worlds == world)
            first = int(np.searchsorted(worlds, world))
            middle = first + int(random.integers(0, len(inside) + 1))
            last = first + len(inside)
            permanent[middle:last] = True
            ranges.append((first, middle, last))
            edges = np.flatnonzero(np.diff([0, *wanted[first:last].astype(int), 0])).reshape(-1, 2) + first
            runs += [(int(begin), int(end), first, last) for begin, end in edges]
        layout = MomentLayout(np.zeros(count), worlds, permanent, worlds, wanted, wanted, ~wanted, wanted)
        assert layout.ranges() == ranges
        assert layout.runs(wanted) == runs


def _dimensions_of(kind, scale, source):
    """Half of the dimensions of a shape [m], sorted."""
    name, (a, b, c) = newton.GeoType(kind).name, scale
    if name in ("MESH", "CONVEX_MESH"):
        return sorted(0.5 * np.ptp(np.asarray(source.vertices) * scale, axis=0))
    half = {"SPHERE": (a, a, a), "CAPSULE": (a, a, a + b), "CYLINDER": (a, a, b), "CONE": (a, a, b)}
    half |= dict.fromkeys(("BOX", "ELLIPSOID"), (a, b, c))
    return sorted(half.get(name, 3 * (np.inf,)))


def test_sizes_of_bodies_are_those_of_their_shapes():
    """Sizes of bodies from shapes of all kinds, several on a body, the largest and the smallest anywhere."""
    rng, builder = np.random.default_rng(5), newton.ModelBuilder()
    tetrahedron = newton.Mesh(np.eye(4, 3), np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]))
    for number in range(20):
        body = builder.add_body(
            xform=wp.transform(rng.uniform(-1.0, 1.0, 3), wp.quat_identity()), is_kinematic=number % 7 == 3
        )
        for _ in range(int(rng.integers(0, 4))):
            a, b, c = rng.uniform(0.1, 0.5, 3).tolist()
            where = wp.transform(rng.uniform(-1.0, 1.0, 3), wp.quat_identity())
            passive = newton.ModelBuilder.ShapeConfig(has_shape_collision=bool(rng.random() < 0.8))
            for add, given in (
                (builder.add_shape_sphere, {"radius": a}),
                (builder.add_shape_capsule, {"radius": a, "half_height": b}),
                (builder.add_shape_cylinder, {"radius": a, "half_height": b}),
                (builder.add_shape_cone, {"radius": a, "half_height": b}),
                (builder.add_shape_box, {"hx": a, "hy": b, "hz": c}),
                (builder.add_shape_ellipsoid, {"rx": a, "ry": b, "rz": c}),
                (builder.add_shape_mesh, {"mesh": tetrahedron, "scale": (a, b, c)}),
            ):
                if rng.random() < 0.3:
                    add(body, xform=where, cfg=passive, **given)
    builder.add_shape_sphere(builder.add_body(), radius=0.2)
    builder.add_ground_plane()
    model = builder.finalize(device="cpu")
    result = body_sizes(model)
    scales, middles = model.shape_scale.numpy(), model.shape_transform.numpy()[:, :3]
    sizes = [_dimensions_of(*entry) for entry in zip(model.shape_type.numpy(), scales, model.shape_source, strict=True)]
    thickness, reach = np.full(model.body_count, np.inf), np.zeros(model.body_count)
    force_length = thickness.copy()
    for shape, body in enumerate(model.shape_body.numpy()):
        kinematic = model.body_flags.numpy()[body] & newton.BodyFlags.KINEMATIC
        if body >= 0 and not kinematic and model.shape_flags.numpy()[shape] & newton.ShapeFlags.COLLIDE_SHAPES:
            small, middle, _ = sizes[shape]
            thickness[body] = min(thickness[body], small)
            force_length[body] = min(force_length[body], middle, np.prod(sizes[shape]) ** (1 / 3))
            far = np.linalg.norm(middles[shape].astype(float) - model.body_com.numpy()[body])
            radius = model.shape_collision_radius.numpy()[shape]
            if far > 1e-3 * radius or model.shape_type.numpy()[shape] != newton.GeoType.SPHERE:
                reach[body] = max(reach[body], far + radius)
    np.testing.assert_array_equal(result.thickness, thickness)
    np.testing.assert_allclose(result.reach, reach, rtol=1e-6)  # single precision
    np.testing.assert_allclose(result.force_length, force_length, rtol=1e-6)
    assert np.isfinite(thickness).sum() > 10 and model.shape_count > 40


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_collected_afterwards_as_before(enabled):
    """Whatever building a scene ends with."""
    before = gc.isenabled()
    (gc.enable if enabled else gc.disable)()
    try:
        builder = _builder()
        warpmag.add_balls(builder, np.eye(3), 0.005)
        Simulation(builder, device="cpu")
        assert gc.isenabled() == enabled
        with pytest.raises(warpmag.InputError):
            Simulation(builder, device="cpu", rtol=-1.0)
        assert gc.isenabled() == enabled
        with collection_paused(), collection_paused():
            assert not gc.isenabled()
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if before else gc.disable)()
