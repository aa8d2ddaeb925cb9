"""Fields and wrenches on arrays, against the float64 oracle, magpylib and conservation laws."""

import magpylib
import numpy as np
import pytest
import warp as wp
from arrangements import as_float32, overlapping, pile, relative

import warpmag
from bench.reference import oracle
from warpmag.kernels.pairs import fused_cuda, mirror_cuda
from warpmag.kernels.pairs.evaluate import FUSED, LOOP, MIRRORED, SHORT, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.shared import team

# Sums of n terms in float32 have an error of √n·2⁻²⁴ ≈ 2.7e-6·√(n/2000) at worst and 3e-7 in lanes; the limit is 1e-6.
TOLERANCE = {"float32": 1e-6, "float64": 1e-13}
DTYPES = ("float32", "float64")


@pytest.fixture(scope="module")
def touching():
    """2,000 touching balls of three radii, with the oracle's fields and wrenches."""
    x, radii, m = pile()
    h, gradient = oracle.h_field(x, m, radii=radii), oracle.field_gradient(x, m, radii=radii)
    return x, radii, m, h, oracle.kelvin_force(m, gradient), oracle.torque(m, h)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("method", ["direct", "reference"])
def test_touching_balls(touching, dtype, method, device):
    x, radii, m, h, force, torque = touching
    results = warpmag.h_field(x, m, radii=radii, method=method, dtype=dtype, device=device)
    assert relative(results, h) < TOLERANCE[dtype]
    forces, torques = warpmag.wrench(x, m, radii=radii, method=method, dtype=dtype, device=device)
    assert relative(forces, force) < TOLERANCE[dtype]
    assert relative(torques, torque) < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
def test_overlapping_balls(dtype, device):
    x, radii, m = overlapping()
    # deep overlap: terms of both signs cancel to about a tenth of their size
    tolerance = 10.0 * TOLERANCE[dtype]
    gradient = oracle.field_gradient(x, m, radii=radii)
    assert (
        relative(warpmag.h_field(x, m, radii=radii, dtype=dtype, device=device), oracle.h_field(x, m, radii=radii))
        < tolerance
    )
    forces, _ = warpmag.wrench(x, m, radii=radii, dtype=dtype, device=device)
    assert relative(forces, oracle.kelvin_force(m, gradient)) < tolerance


RATIOS = (1.0, 1.0 + 1e-6, 1.01, 1.5, 2.9, 10.0, 1000.0)
# distances over those at contact
DEPTHS = (0.0, 1e-30, 1e-22, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 0.3, 0.49, 0.51, 0.7, 0.9, 0.99, 0.999)


def balls_in_one_another(scale, dtype):
    """Pairs of balls of all ``RATIOS`` of radii at all ``DEPTHS``, the larger of radius ``scale`` [m]."""
    rng = np.random.default_rng(8)
    for ratio in RATIOS:
        for depth in DEPTHS:
            radii = scale * np.array([1.0, 1.0 / ratio])
            direction = rng.normal(size=3)
            x = np.array([np.zeros(3), depth * radii.sum() * direction / np.linalg.norm(direction)])
            m = rng.normal(size=(2, 3)) * 1e6 * radii[:, None] ** 3
            yield [np.asarray(a, dtype).astype(float) for a in (x, radii, m)]


@pytest.mark.parametrize("dtype, scale", [("float32", 1e-4), ("float32", 5e3), ("float64", 1e-8), ("float64", 1e3)])
def test_balls_in_one_another(dtype, scale, device):
    """Fields, forces and torques to a few roundings, of the result and of the distance, down to coincident centers."""
    cases = [*balls_in_one_another(scale, dtype)]
    x, radii, m = (np.concatenate(arrays) for arrays in zip(*cases, strict=True))
    worlds = np.arange(len(x)) // 2
    segments = [(i, i + 2, i, i + 2) for i in range(0, len(x), 2)]
    eps = float(np.finfo(dtype).eps)
    for form in forms(device):
        (h,) = sums(x, radii, m, segments, Quantity.FIELD, dtype, device, groups=worlds, form=form)
        forces, torques = sums(x, radii, m, segments, Quantity.WRENCH, dtype, device, groups=worlds, form=form)
        pairs = [np.reshape(array, (-1, 2, 3)) for array in (h, forces, torques)]
        for (at, size, moments), *results in zip(cases, *pairs, strict=True):
            exact, moved = (pair_at(place, size, moments) for place in (at, (1.0 + 8.0 * eps) * at))
            # the clamped dipole, to which corrections of overlapping balls are added
            field = np.linalg.norm(moments[::-1], axis=1) / (2.0 * np.pi * size.sum() ** 3)
            turn = oracle.MU0 * np.linalg.norm(moments, axis=1) * field
            for result, value, other, unit in zip(
                results, exact, moved, (field, 3.0 * turn / size.sum(), turn), strict=True
            ):
                error, spread = np.linalg.norm(result - value, axis=1), np.linalg.norm(other - value, axis=1)
                assert (error <= 20.0 * eps * (unit + np.linalg.norm(value, axis=1)) + 5.0 * spread).all()


def pair_at(x, radii, m):
    """The oracle's field, forces and torques of two balls."""
    h = oracle.h_field(x, m, radii=radii)
    return h, oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=radii)), oracle.torque(m, h)


@pytest.mark.parametrize("dtype, scale", [("float32", 2.5e-5), ("float32", 2e6), ("float64", 1e-20), ("float64", 1e20)])
def test_any_scale(dtype, scale, device):
    """Balls of 0.1 µm and of 10 km, and in float64 of any size."""
    x, radii, m = pile(count=300)
    x, radii, m = (np.asarray(a, dtype).astype(float) for a in (scale * x, 0.9999 * scale * radii, scale**3 * m))
    h, force, torque = pair_at(x, radii, m)
    # positions are rounded, and with them the contact distances
    assert relative(warpmag.h_field(x, m, radii=radii, dtype=dtype, device=device), h) < TOLERANCE[dtype]
    results = warpmag.wrench(x, m, radii=radii, dtype=dtype, device=device)
    assert relative(results[0], force) < 2.0 * TOLERANCE[dtype]
    assert relative(results[1], torque) < TOLERANCE[dtype]


@pytest.mark.parametrize("distance", [1e-9, 2e-8, 2e-7, 1e3, 5e6])
@pytest.mark.parametrize("strength", [1e-17, 1e-6, 1e6, 1e18])
def test_points_at_any_distance(distance, strength, device):
    """In float32 the field and the force of point dipoles are correct, or an error names the cause."""
    x, m = as_float32([[0.0, 0.0, 0.0], [0.6 * distance, 0.0, 0.8 * distance]], [[0.0, 0.0, 1.0], [1.0, 0.5, 0.0]])
    m = as_float32(strength * m)[0]
    exact, force, _ = pair_at(x, None, m)
    try:
        assert relative(warpmag.h_field(x, m, device=device), exact) < TOLERANCE["float32"]
        results = warpmag.wrench(x, m, device=device)[0]
        # underflow gives zero
        assert np.abs(results - force).max() < TOLERANCE["float32"] * np.abs(force).max() + 1e-36
    except warpmag.InputError as error:
        assert str(error).startswith(("positions, moments", "moments"))
        assert distance < 1e-7 or not 1e-36 < np.abs(force).max() < 1e30  # of which 4π/μ0 is a float32


@pytest.mark.parametrize("extent", [1e-3, 0.0])
def test_neighbor_lists_that_overflow(extent, device):
    """More overlapping neighbors than a list holds: each target visits all sources, and none is dropped."""
    x, radii, m = overlapping(count=150, extent=extent)
    assert relative(warpmag.h_field(x, m, radii=radii, device=device), oracle.h_field(x, m, radii=radii)) < 1e-5


def test_radii_of_two_decades(device):
    rng = np.random.default_rng(5)
    x, radii = as_float32(rng.uniform(-0.05, 0.05, (300, 3)), 10.0 ** rng.uniform(-4, -2, 300))
    m = as_float32(rng.normal(size=(300, 3)) * radii[:, None] ** 3)[0]
    reference = oracle.h_field(x, m, radii=radii)
    assert relative(warpmag.h_field(x, m, radii=radii, device=device), reference) < 1e-5
    assert relative(warpmag.h_field(x, m, radii=radii, dtype="float64", device=device), reference) < 1e-12


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [1, 2, 15, 17, 255, 257, 1025])
def test_any_count_of_sources_and_targets(count, dtype, device):
    rng = np.random.default_rng(count)
    x, m = as_float32(rng.uniform(-1, 1, (count, 3)), rng.normal(size=(count, 3)))
    targets = as_float32(rng.uniform(-1, 1, (count + 3, 3)))[0]
    results = warpmag.h_field(x, m, targets, dtype=dtype, device=device)
    # a random target may lie next to a source: its own differences lose up to a digit
    assert relative(results, oracle.h_field(x, m, targets)) < 10.0 * TOLERANCE[dtype]
    if count > 1:
        assert (
            relative(warpmag.h_field(x, m, dtype=dtype, device=device), oracle.h_field(x, m)) < 10.0 * TOLERANCE[dtype]
        )


@pytest.mark.parametrize("dtype", DTYPES)
def test_as_many_targets_as_moments(dtype, device):
    """As many other targets as moments, one of them at a moment: no moment is excluded."""
    x, radii, m = pile(count=700)
    targets = as_float32(x + 0.003)[0]
    targets[5] = x[5]
    results = warpmag.h_field(x, m, targets, radii=radii, dtype=dtype, device=device)
    assert relative(results, oracle.h_field(x, m, targets, radii=radii)) < 10.0 * TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("threads", [1, 3])
def test_segments(dtype, threads, device, monkeypatch):
    """Two worlds of one radius each, with more moments than a tile, and moments with sources in both worlds."""
    monkeypatch.setattr(team, "cores", lambda: threads)
    x, _, m = pile(count=1500)
    radii = as_float32(np.where(np.arange(1500) < 900, 0.0049, 0.0045))[0]
    segments = [(0, 901, 0, 901), (901, 1490, 901, 1490), (1490, 1500, 3, 1489)]
    for form in forms(device):
        (h,) = sums(x, radii, m, segments, Quantity.FIELD, dtype, device, form=form)
        for t0, t1, s0, s1 in segments:
            own = {} if t0 == s0 else {"targets": x[t0:t1], "target_radii": radii[t0:t1]}
            expected = oracle.h_field(x[s0:s1], m[s0:s1], radii=radii[s0:s1], **own)
            assert relative(h[t0:t1], expected) < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("quantity", [Quantity.MUTUAL_FORCE, Quantity.FORCE, Quantity.WRENCH])
def test_moments_of_one_body_leave_each_other_alone(quantity, dtype, device):
    """Bodies of seven moments each, out of order."""
    x, radii, m = pile(count=1100)
    radii = as_float32(0.8 * radii)[0]
    bodies = np.random.default_rng(4).permutation(1100) // 7
    force = oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=radii, bodies=bodies))
    torque = oracle.torque(m, oracle.h_field(x, m, radii=radii, bodies=bodies))
    for form in forms(device, *[MIRRORED] * (quantity == Quantity.MUTUAL_FORCE)):
        results = sums(x, radii, m, [(0, 1100, 0, 1100)], quantity, dtype, device, bodies, form=form)
        assert relative(results[0], force) < TOLERANCE[dtype]
        if quantity == Quantity.WRENCH:
            assert relative(results[1], torque) < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [1, 2, 31, 33, 127, 243, 257])
def test_any_count_of_touching_balls(count, dtype, device):
    """All forms of the sums, with incomplete vectors, warps and tiles."""
    x, radii, m = pile(count=count)
    every = [(0, count, 0, count)]
    h = oracle.h_field(x, m, radii=radii)
    force, torque = oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=radii)), oracle.torque(m, h)
    for form in forms(device, MIRRORED):
        results = [*sums(x, radii, m, every, Quantity.FIELD, dtype, device, form=form)]
        if form == MIRRORED:  # has no torques
            results += [sums(x, radii, m, every, Quantity.MUTUAL_FORCE, dtype, device, form=form)[0], torque]
        else:
            results += sums(x, radii, m, every, Quantity.WRENCH, dtype, device, form=form)
        for value, expected in zip(results, (h, force, torque), strict=True):
            # no relative error: the wrench of a lone ball is zero
            assert np.linalg.norm(value - expected) <= TOLERANCE[dtype] * np.linalg.norm(expected)


@pytest.mark.cuda
@pytest.mark.parametrize(
    "module, quantity, shape",
    [
        (module, quantity, shape)
        for module in (fused_cuda, mirror_cuda)
        for quantity, table in module._SHAPES.items()
        for _, shape in table
    ],
)
def test_every_shape_of_blocks(module, quantity, shape, device, monkeypatch):
    """All forms for many moments, with an incomplete tile; nearly all moments have one radius."""
    monkeypatch.setitem(module._SHAPES, quantity, ((None, shape),))
    form = MIRRORED if module is mirror_cuda else FUSED
    x, radii, m = pile(count=1103)
    radii[40:] = 0.005
    (results, *_) = sums(x, radii, m, [(0, 1103, 0, 1103)], quantity, "float32", device, form=form)
    if quantity == Quantity.FIELD:
        expected = oracle.h_field(x, m, radii=radii)
    else:
        expected = oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=radii))
    assert relative(results, expected) < TOLERANCE["float32"]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("quantity", [Quantity.FIELD, Quantity.MUTUAL_FORCE])
@pytest.mark.parametrize("slabs", [1, 3, 100])
def test_mirrored_passes(slabs, quantity, dtype, device, monkeypatch):
    """Mirrored tiles in several passes, for little memory; bodies of three moments."""
    monkeypatch.setattr(mirror_cuda, "_SLAB_BYTES", slabs * 12 * 2001)
    x, _, m = pile(count=2001)
    radii, bodies = as_float32(np.where(np.arange(2001) < 1500, 0.0049, 0.004))[0], np.arange(2001) // 3
    form = MIRRORED if device != "cpu" else LOOP
    (results, *_) = sums(x, radii, m, [(0, 2001, 0, 2001)], quantity, dtype, device, bodies, form=form)
    if quantity == Quantity.FIELD:
        assert relative(results, oracle.h_field(x, m, radii=radii)) < TOLERANCE[dtype]
    else:
        gradient = oracle.field_gradient(x, m, radii=radii, bodies=bodies)
        assert relative(results, oracle.kelvin_force(m, gradient)) < TOLERANCE[dtype]


def forms(device, *mirrored):
    """Forms of the sums on the device, with or without the mirrored form; a CPU has one form."""
    return (LOOP,) if device == "cpu" else (LOOP, FUSED, SHORT, *mirrored)


def sums(x, radii, m, segments, quantity, dtype, device, bodies=None, *, groups=None, form):
    """Field [A/m], or forces [N] and torques [N·m], of segments of one moment set, in one form of the native sums."""
    kind = {"float32": wp.float32, "float64": wp.float64}[dtype]
    vectors = [wp.array(a, dtype=wp.types.vector(3, kind), device=device) for a in (x, m)]
    sizes = wp.array(radii, dtype=kind, device=device)
    packed = PackedMoments(sizes, largest_radius=radii.max(), labels=bodies, groups=groups)
    packed.pack(*vectors)
    packed.find_overlaps()
    none, out, torques = (wp.zeros_like(vectors[0]) for _ in range(3))
    turned = wp.ones(len(x), dtype=int, device=device)
    evaluation = PairEvaluation(
        quantity, segments, packed, packed, none, out, with_torque=turned, torques=torques, form=form
    )
    evaluation.partial.fill_(np.nan)
    evaluation.launch()
    return [a.numpy().astype(float) for a in ([out] if quantity == Quantity.FIELD else [out, torques])]


def test_runs_are_bitwise_equal(device):
    """More sums than one thread or block makes; they repeat bit by bit."""
    x, radii, m = pile(count=2000)
    first, second = (warpmag.h_field(x, m, radii=radii, device=device) for _ in range(2))
    assert np.array_equal(first, second)
    first, second = (warpmag.wrench(x, m, radii=radii, device=device) for _ in range(2))
    assert np.array_equal(first, second)


def test_long_sums_keep_their_digits(device):
    """Many aligned moments, whose terms have one sign: a single float32 sum would lose digits."""
    rng = np.random.default_rng(6)
    x, m = as_float32(rng.uniform(0.0, 1.0, (60000, 3)), rng.normal(size=(60000, 3)) * 0.1 + [0.0, 0.0, 1.0])
    at = as_float32(rng.uniform(0.0, 1.0, (20, 3)) + np.array([0.0, 0.0, 1.1]))[0]
    # a single sum: √n·2⁻²⁴ = 1.5e-5 in the worst case; the limit is 2e-6
    assert relative(warpmag.h_field(x, m, at, device=device), oracle.h_field(x, m, at)) < 2e-6


def test_nothing_at_all(device):
    empty = np.zeros((0, 3))
    assert warpmag.h_field(empty, empty, device=device).shape == (0, 3)
    assert warpmag.h_field(empty, empty, np.zeros((4, 3)), device=device).tolist() == [[0.0] * 3] * 4
    forces, torques = warpmag.wrench(empty, empty, device=device)
    assert forces.shape == torques.shape == (0, 3)


@pytest.mark.parametrize("dtype", DTYPES)
def test_magpylib_dipoles_and_spheres(dtype, device):
    rng = np.random.default_rng(7)
    x, m = as_float32(rng.uniform(-0.1, 0.1, (40, 3)), rng.normal(size=(40, 3)))
    at = as_float32(rng.uniform(0.15, 0.3, (50, 3)))[0]
    dipoles = magpylib.Collection([magpylib.misc.Dipole(moment=mi, position=xi) for xi, mi in zip(x, m, strict=True)])
    assert relative(warpmag.h_field(x, m, at, dtype=dtype, device=device), dipoles.getH(at)) < 1e-6
    radius = 0.01
    magnetization = m / (4.0 / 3.0 * np.pi * radius**3)
    spheres = magpylib.Collection(
        [
            magpylib.magnet.Sphere(diameter=2 * radius, magnetization=mi, position=xi)
            for xi, mi in zip(x, magnetization, strict=True)
        ]
    )
    inside = np.concatenate([at, x[:1] + 0.003, x[1:2]])
    results = warpmag.h_field(x, m, inside, radii=radius, dtype=dtype, device=device)
    assert relative(results, spheres.getH(inside)) < 1e-6


def test_third_law_and_angular_momentum(touching, device):
    x, radii, m, *_ = touching
    forces, torques = warpmag.wrench(x, m, radii=radii, device=device)
    forces, torques = forces.astype(float), torques.astype(float)
    center = x.mean(0)
    arms = np.cross(x - center, forces)
    assert np.linalg.norm(forces.sum(0)) < 1e-6 * np.linalg.norm(forces, axis=1).sum()
    total = (arms + torques).sum(0)
    assert np.linalg.norm(total) < 1e-6 * (np.linalg.norm(arms, axis=1) + np.linalg.norm(torques, axis=1)).sum()


def test_force_is_the_gradient_of_the_energy(device):
    """F = −∂E/∂x of E = −½ μ0 Σ m·H at fixed moments, overlaps included; float64 central differences."""
    x, radii, m = overlapping(count=12, extent=0.03)
    forces, _ = warpmag.wrench(x, m, radii=radii, dtype="float64", device=device)
    step = 1e-7

    def energy(y):
        h = warpmag.h_field(y, m, radii=radii, dtype="float64", device=device)
        return -0.5 * oracle.MU0 * np.sum(m * h)

    for i, axis in ((0, 0), (3, 1), (7, 2)):
        high, low = x.copy(), x.copy()
        high[i, axis] += step
        low[i, axis] -= step
        # truncation (step/R)² = 1e-10, rounding eps·E/(step·F) ≈ 1e-8
        assert forces[i, axis] == pytest.approx(-(energy(high) - energy(low)) / (2 * step), rel=1e-5)


def test_external_field_turns_but_does_not_pull(device):
    m = np.array([[0.0, 0.0, 2.0]])
    forces, torques = warpmag.wrench(np.zeros((1, 3)), m, external_field=[100.0, 0.0, 0.0], device=device)
    assert np.abs(forces).max() == 0.0
    np.testing.assert_allclose(torques, oracle.MU0 * np.array([[0.0, 200.0, 0.0]]), rtol=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
def test_smoothing(dtype, device):
    """The paper's smoothing: bounded at zero distance, a dipole far away."""
    x, _, m = overlapping(count=200, extent=0.05)
    results = warpmag.h_field(x, m, smoothing=0.004, dtype=dtype, device=device)
    assert relative(results, oracle.h_field(x, m, smoothing=0.004)) < 10.0 * TOLERANCE[dtype]
    forces, _ = warpmag.wrench(x, m, smoothing=0.004, dtype=dtype, device=device)
    assert (
        relative(forces, oracle.kelvin_force(m, oracle.field_gradient(x, m, smoothing=0.004))) < 10.0 * TOLERANCE[dtype]
    )
    pair = np.array([[0.0, 0, 0], [0, 0, 0]])
    assert np.isfinite(warpmag.h_field(pair, m[:2], smoothing=0.004, dtype=dtype, device=device)).all()


def test_coincident_point_dipoles_are_left_out(device):
    x = np.zeros((3, 3))
    x[2, 0] = 1.0
    h = warpmag.h_field(x, np.ones((3, 3)), device=device)
    assert np.isfinite(h).all()
    assert relative(h, oracle.h_field(x, np.ones((3, 3)))) < 1e-6


def test_far_from_the_origin(device):
    """Offset of 1e4 m: the error is the rounding of the inputs."""
    x, radii, m = pile(count=300)
    shifted = as_float32(x * 100.0 + 1e4)[0]
    reference = oracle.h_field(shifted, m, radii=radii)
    assert relative(warpmag.h_field(shifted, m, radii=radii, device=device), reference) < 1e-6


def test_warp_arrays_in_and_out(device):
    x, radii, m = pile(count=100)
    arrays = [wp.array(a, dtype=wp.vec3, device=device) for a in (x, m)]
    h = warpmag.h_field(*arrays, radii=wp.array(radii, dtype=wp.float32, device=device))
    assert isinstance(h, wp.array) and h.dtype is wp.vec3 and str(h.device) == device
    assert relative(h.numpy(), oracle.h_field(x, m, radii=radii)) < 1e-6


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"positions": np.zeros((2, 2))}, r"positions: shape must be \[n, 3\], got \[2, 2\]"),
        ({"moments": np.zeros((3, 3))}, r"moments: shape must be \[3\] or \[2, 3\]"),
        ({"positions": [[0, 0, np.nan], [0, 0, 1]]}, "positions: contains NaN"),
        ({"positions": [[0, 0, 1e300], [0, 0, 1]]}, "positions: not finite in float32"),
        ({"radii": -1.0}, "radii: must not be negative"),
        ({"radii": [1.0, 2.0, 3.0]}, r"radii: shape must be \[\] or \[2\]"),
        ({"target_radii": 1.0}, "target_radii: only with targets"),
        ({"dtype": "float16"}, "dtype: 'float16' is not one of"),
        ({"method": "magic"}, "method: 'magic' is not one of"),
        ({"device": "cuda:97"}, "device: no 'cuda:97' here"),
        ({"rtol": 1e-9}, "rtol: must be at least 2e-06 in float32"),
        ({"smoothing": -1.0}, "smoothing: must be zero or positive"),
    ],
)
def test_bad_arguments(arguments, message, device):
    good = {"positions": np.array([[0.0, 0, 0], [0, 0, 1]]), "moments": np.ones((2, 3)), "device": device}
    with pytest.raises(warpmag.InputError, match=message) as caught:
        warpmag.h_field(**{**good, **arguments})
    assert "\n" not in str(caught.value)
