"""Gradients on Warp's tape, against central differences in float64."""

import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.kernels.pairs import mirror_cuda, pair_gradients
from warpmag.kernels.pairs.packing import PackedMoments

EXACT = 1e-5
"""Relative error of central differences: their own, about 1e-8, and that of float64 sums, with a margin."""


def scene(count=23, seed=1, overlap=False):
    """Positions [m], moments [A·m²] and radii [m] of balls; some overlap, two of them by most of their size."""
    rng = np.random.default_rng(seed)
    x = (
        0.02 * np.stack(np.meshgrid(*[np.arange(3)] * 3), -1).reshape(-1, 3)[:count]
        + rng.normal(size=(count, 3)) * 1e-3
    )
    radii = rng.uniform(0.004, 0.006, count)
    if overlap:
        x[1], x[3], x[5] = x[0] + (0.003, 0.002, 0.001), x[2] + (0.007, 0.0, 0.004), x[4] + 1e-3
        radii[0], radii[5] = radii[1], 0.012
    return x, rng.normal(size=(count, 3)), radii


def warp_array(values, device, requires_grad=True):
    dtype = wp.vec3d if np.ndim(values) == 2 else wp.float64
    return wp.array(values, dtype=dtype, device=device, requires_grad=requires_grad)


def tape_gradients(function, arguments: dict, seeds, device):
    """Gradients of Σ seed·result by each argument, from a tape."""
    arrays = {name: warp_array(value, device) for name, value in arguments.items()}
    with wp.Tape() as tape:
        results = function(**arrays)
    for result, seed in zip(results, seeds, strict=True):
        result.grad.assign(seed)
    tape.backward()
    return {name: array.grad.numpy() for name, array in arrays.items()}


def check_gradients(function, arguments: dict, seeds, device, sizes):
    """Compare the gradients with slopes along random directions, central differences with Richardson's extrapolation.

    ``sizes`` are the steps of the arguments, as a share of their largest entry.
    """
    gradients = tape_gradients(function, arguments, seeds, device)
    rng = np.random.default_rng(3)

    def loss(name, value):
        moved = {**arguments, name: value}
        results = function(**{key: warp_array(entry, device, False) for key, entry in moved.items()})
        return sum(float(np.sum(seed * result.numpy())) for result, seed in zip(results, seeds, strict=True))

    for name, value in arguments.items():
        direction = rng.normal(size=value.shape)

        def slope(step, name=name, value=value, direction=direction):
            return (loss(name, value + step * direction) - loss(name, value - step * direction)) / (2.0 * step)

        size = sizes * np.abs(value).max()
        expected = (4.0 * slope(size) - slope(2.0 * size)) / 3.0
        # a slope of typical size: it may be small along a direction by chance
        typical = np.linalg.norm(gradients[name]) * np.linalg.norm(direction) / np.sqrt(value.size)
        assert abs(np.sum(gradients[name] * direction) - expected) < EXACT * typical, name


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("targets", [False, True])
def test_field(targets, overlap, device):
    x, m, radii = scene(overlap=overlap)
    rng = np.random.default_rng(5)
    arguments, count = {"positions": x, "moments": m}, len(x)
    options = {"radii": radii, "dtype": "float64"}
    if targets:
        count = 17
        arguments["targets"] = rng.uniform(-0.01, 0.05, (count, 3))
        options["target_radii"] = rng.uniform(0.001, 0.01, count) if overlap else None
        options["radii"] = radii if overlap else None
    seeds = [rng.normal(size=(count, 3))]

    def function(positions, moments, targets=None):
        return [warpmag.h_field(positions, moments, targets, **options)]

    check_gradients(function, arguments, seeds, device, 2e-5)


@pytest.mark.parametrize("overlap", [False, True])
def test_wrench(overlap, device):
    x, m, radii = scene(overlap=overlap)
    rng = np.random.default_rng(5)
    arguments = {"positions": x, "moments": m, "external_field": rng.normal(size=x.shape) * 1e4}
    seeds = [rng.normal(size=x.shape), 100.0 * rng.normal(size=x.shape)]

    def function(positions, moments, external_field):
        return warpmag.wrench(positions, moments, radii=radii, external_field=external_field, dtype="float64")

    check_gradients(function, arguments, seeds, device, 2e-5)


CASES = {
    "results": {},
    "forces": {"seeds": (0.0, 0.0, 1.0, 100.0)},
    "overlapping": {"overlap": True, "seeds": (1.0, 1.0, 1e6, 1e8)},
    "saturated": {"field": 2e6},
    "curves": {"curve": ["tanh", "langevin", "frohlich"] * 7 + ["1010-steel", "tanh"]},
    "points": {"curve": None, "field": 1.3e5},
}
"""Deviations from the defaults of :func:`test_equilibrium`."""


@pytest.mark.parametrize("case", CASES)
def test_equilibrium(case, device):
    """Magnetizations, fields, forces and torques of balls that induce each other, by every argument."""
    case = {"overlap": False, "field": 1e5, "curve": "tanh", "seeds": (1.0, 1.0, 0.0, 0.0), **CASES[case]}
    x, _, radii = scene(overlap=case["overlap"])
    rng = np.random.default_rng(7)
    count, shape = len(x), x.shape
    arguments = {
        "positions": x,
        "external_field": case["field"] * (rng.normal(size=shape) * 0.3 + (0.0, 0.0, 1.0)),
        "saturation": rng.uniform(4e5, 6e5, count),
        "susceptibility": rng.uniform(2.0, 50.0, count),
        "magnet_positions": rng.uniform(0.06, 0.08, (2, 3)),
        "magnet_moments": rng.normal(size=(2, 3)),
    }
    if not case["overlap"]:
        arguments["radii"] = radii
    if case["curve"] != "tanh":
        del arguments["saturation"], arguments["susceptibility"]
    if case["curve"] is None:
        arguments |= {
            "fields": np.array([2e3, 7e3, 2e4, 5e4]), "magnetizations": np.array([1e5, 2e5, 2.6e5, 3e5]),
        }  # fmt: skip

    def function(positions, magnet_positions, magnet_moments, radii=radii, fields=None, magnetizations=None, **options):
        if case["curve"] is None:
            options["curve_points"] = fields, magnetizations
        elif case["curve"] != "tanh":
            options |= {"saturation": np.full(count, 5e5), "susceptibility": 20.0, "curve": case["curve"]}
        result = warpmag.solve_induction(
            positions, radii, permanent=(magnet_positions, magnet_moments), rtol=1e-13, dtype="float64", **options,
        )  # fmt: skip
        return [result.magnetizations, result.h_field, *result.wrench()]

    seeds = [rng.normal(size=shape) * scale for scale in case["seeds"]]
    check_gradients(function, arguments, seeds, device, 1e-4)


def test_multipoles_agree_with_direct_sums(device):
    """The field's gradients by the fast multipole method have its relative error."""
    rng = np.random.default_rng(2)
    x, m, targets, seed = (rng.uniform(-1.0, 1.0, (count, 3)) for count in (900, 900, 700, 700))

    def gradients(method):
        arrays = [wp.array(values, dtype=wp.vec3, device=device, requires_grad=True) for values in (x, m, targets)]
        with wp.Tape() as tape:
            field = warpmag.h_field(*arrays, method=method)
        tape.backward(grads={field: wp.array(seed, dtype=wp.vec3, device=device)})
        return [array.grad.numpy() for array in arrays]

    for fast, exact in zip(gradients("fmm"), gradients("direct"), strict=True):
        assert 1e-7 < np.linalg.norm(fast - exact) / np.linalg.norm(exact) < 1e-3


def test_gradients_are_added_through_any_array(device):
    """Arrays of another scalar type, strided arrays, and one array as two arguments."""
    x, m, _ = scene()
    packed = warp_array(np.repeat(x, 2, axis=0), device)
    moments = wp.array(m, dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        positions = packed[::2]
        field = warpmag.h_field(positions, moments, positions, dtype="float64")
    seed = np.random.default_rng(4).normal(size=x.shape)
    field.grad.assign(seed)
    moments.grad.fill_(1.0)
    tape.backward()
    alone = tape_gradients(
        lambda positions, moments: [warpmag.h_field(positions, moments, dtype="float64")],
        {"positions": x, "moments": m.astype(np.float32)}, [seed], device,
    )  # fmt: skip
    by_x = packed.grad.numpy()
    assert np.allclose(by_x[::2], alone["positions"], rtol=1e-9, atol=1e-9 * np.abs(by_x).max())
    assert not by_x[1::2].any()
    assert np.allclose(moments.grad.numpy() - 1.0, alone["moments"], rtol=1e-3, atol=1e-3)


def test_what_has_no_gradient_raises(device):
    x, m, radii = scene()
    positions, size = warp_array(x, device), warp_array(radii, device)
    options = {"dtype": "float64", "device": device}

    def solve(radii=radii, positions=positions, **more):
        return warpmag.solve_induction(
            positions, radii, saturation=1e6, external_field=(0, 0, 1e4), rtol=1e-3, **options, **more
        )

    cases = {
        "radii: requires a gradient, but the field has none": lambda: warpmag.h_field(
            positions, m, radii=size, **options
        ),
        "radii: requires a gradient, but forces": lambda: warpmag.wrench(positions, m, radii=size, **options),
        "positions: .*smoothing has none": lambda: warpmag.h_field(positions, m, smoothing=0.01, **options),
        "moments: .*results are NumPy": lambda: warpmag.h_field(x, warp_array(m, device), **options),
        "positions: .*'llg' has none": lambda: solve(dynamics="llg"),
        "positions: .*'multipole' has none": lambda: solve(contact_model="multipole"),
        "radii: .*overlapping": lambda: solve(radii=warp_array(3.0 * radii, device)),
        "curve: fields require a gradient": lambda: warpmag.MagnetizationCurve.from_mh(size, radii),
        "positions: .*'zeeman' has none": lambda: solve().wrench("zeeman"),
        "positions: an indexed array": lambda: warpmag.h_field(
            wp.indexedarray1d(positions, [wp.array(np.arange(len(x)), dtype=int, device=device)]), m, **options
        ),
    }
    for message, call in cases.items():
        with wp.Tape(), pytest.raises(warpmag.InputError, match=message):
            call()


def test_a_gradient_that_is_not_finite_raises(device):
    x, _, radii = scene()
    positions = warp_array(x, device)
    with wp.Tape() as tape:
        result = warpmag.solve_induction(positions, radii, saturation=1e6, external_field=(0, 0, 1e4), dtype="float64")
    result.magnetizations.grad.fill_(np.nan)
    with pytest.raises(warpmag.InputError, match="not finite"):
        tape.backward()


def test_wrong_points_of_a_curve_raise(device):
    h, m = [1e3, 1e4, 2e4], [1e5, 2e5, 2e5]

    def solve(points, **more):
        return warpmag.solve_induction(
            [[0.0, 0.0, 0.0]], 0.005, curve_points=points, external_field=(0, 0, 1e5), device=device, **more
        )

    for message, points, more in (
        ("curve_points: replace curve", (h, m), {"curve": "1010-steel"}),
        ("curve_points: must be", h, {}),
        ("curve_points: 3 fields, but 2", (h, m[:2]), {}),
        ("saturation: a measured curve has its own", (h, m), {"saturation": 1e6}),
    ):
        with pytest.raises(warpmag.InputError, match=message):
            solve(points, **more)
    with wp.Tape() as tape:
        position = wp.array([[0.0, 0.0, 0.0]], dtype=wp.vec3d, device=device)
        points = h, warp_array(m, device)
        result = warpmag.solve_induction(position, 0.005, curve_points=points, external_field=(0, 0, 1e5))
    result.magnetizations.grad.fill_(1.0)
    with pytest.raises(
        warpmag.InputError, match="curve_points: at H = 10000 and 20000 A/m the magnetization is the same"
    ):
        tape.backward()


def test_nothing_is_recorded_without_need(device):
    x, m, radii = scene()
    with wp.Tape() as tape:
        field = warpmag.h_field(x, m, device=device)
        warpmag.wrench(wp.array(x, dtype=wp.vec3, device=device), m)
        warpmag.solve_induction(wp.array(x, dtype=wp.vec3, device=device), radii, saturation=1e6).wrench()
    assert not tape.launches and isinstance(field, np.ndarray)
    result = warpmag.h_field(warp_array(x, device), m, dtype="float64")  # no tape
    assert not result.requires_grad


@pytest.mark.cuda
@pytest.mark.parametrize("slabs", [1, 100])
@pytest.mark.parametrize("of_forces", [False, True])
def test_pairs_visited_once_on_a_gpu(of_forces, slabs, device, monkeypatch):
    """Mirrored tiles, also in several passes, agree with sums by targets; balls overlap, bodies have three balls."""
    count, rng = 403, np.random.default_rng(0)
    x, vectors = rng.uniform(0.0, 0.05, (count, 3)), rng.normal(size=(4, count, 3))
    radii = wp.array(rng.uniform(0.002, 0.003, count), dtype=wp.float64, device=device)
    labels = np.arange(count) // 3 if of_forces else None
    moments = PackedMoments(radii, largest_radius=0.003, labels=labels)
    x, m, v, a, h = (wp.array(part, dtype=wp.vec3d, device=device) for part in (x, *vectors))
    moments.pack(x, m)
    cotangents = None if of_forces else moments.twin()
    if cotangents is not None:
        cotangents.pack(x, v)
    results = []
    for least in (count + 1, 0):
        monkeypatch.setattr(pair_gradients, "_LEAST_MIRRORED", least)
        monkeypatch.setattr(mirror_cuda, "_SLAB_BYTES", slabs * 36 * count)
        given = {"external_field": h} if cotangents is None else {"cotangents": cotangents.moments}
        sums = pair_gradients.PairGradients(moments, [0, count], **given)
        sums.launch(*((a, v) if of_forces else ()))
        results.append(np.array([sums.by_positions.numpy(), sums.by_moments.numpy()]))
    for expected, values in zip(*results, strict=True):
        assert np.linalg.norm(values - expected) < 1e-12 * np.linalg.norm(expected)
