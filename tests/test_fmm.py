"""Fast multipole method: the octree, and fields and forces against sums over all pairs in float64."""

import gc
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warpmag
from bench.systems import moment_system
from warpmag.kernels.fmm.octree import Octree
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments import fmm, pair_sums
from warpmag.moments.arrays import resolve_dtype, vec3_type


def apart(a, b) -> float:
    """Relative difference, NaN where anything is."""
    return float(np.linalg.norm(np.asarray(a, float) - b) / np.linalg.norm(b))


def jittered(count: int, seed: int = 0) -> np.ndarray:
    """About ``count`` places of which no two are near each other, edge 1 apart, exact in float32."""
    side = round(count ** (1 / 3))
    axis = np.arange(side)
    places = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return (places + np.random.default_rng(seed).uniform(-0.2, 0.2, places.shape)).astype(np.float32).astype(float)


def moments_of(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((count, 3)).astype(np.float32).astype(float)


def make_octree(places, worlds, occupancy, device) -> Octree:
    n = len(places)
    vectors = wp.array(places, dtype=wp.vec3, device=device)
    radii = wp.zeros(n, dtype=wp.float32, device=device)
    packed = PackedMoments(radii, largest_radius=0.0, groups=worlds, moving=False)
    packed.pack(vectors, vectors)
    octree = Octree(packed.packed, packed.groups, int(worlds.max()) + 1, occupancy=occupancy)
    octree.build()
    return octree


ARRANGEMENTS = {
    "one": (np.zeros((1, 3)), 1),
    "heap": (np.ones((500, 3)), 1),
    "chain": (np.arange(900)[:, None] * [1.0, 0.1, 0.0], 1),
    "box": (np.random.default_rng(2).random((4000, 3)), 1),
    "worlds": (np.random.default_rng(3).random((4000, 3)), 7),
    "stray": (np.concatenate([np.random.default_rng(4).random((2000, 3)), [[1e3, 2e3, -5e2]]]), 1),
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_every_moment_is_in_one_box_of_each_level(name, device):
    places, worlds = ARRANGEMENTS[name]
    places = places.astype(np.float32)
    world = np.sort(np.random.default_rng(5).integers(0, worlds, len(places)))
    octree = make_octree(places, world, 20, device)
    frame, begin, (depth, boxes) = octree.frame.numpy(), octree.level_begin.numpy(), octree.counts.numpy()
    source, firsts = octree.packed_index.numpy(), octree.moment_begin.numpy()[: begin[1] + 1]
    assert boxes <= octree.capacity
    assert sorted(source) == list(range(len(places)))
    assert firsts[-1] == len(places)
    assert (np.diff(firsts) > 0).all()
    place = (places[source].astype(float) - frame[:3]) / frame[4]
    # float32 positions round to either side of a box's face
    center = np.floor(place) + 0.5
    assert np.abs(octree.leaf_position.numpy().T).max() <= 0.5 + 1e-6
    assert np.abs(center + octree.leaf_position.numpy().T - place).max() <= 1.0 + 1e-6
    box_index = np.column_stack([np.round(place - octree.leaf_position.numpy().T - 0.5).astype(int), world[source]])
    parents, octants, children = octree.parent.numpy(), octree.octant.numpy(), octree.children.numpy()
    box_of, numbers = np.repeat(np.arange(begin[1]), np.diff(firsts)), {}
    for height in range(depth + 1):
        own = np.array([box_index[np.flatnonzero(box_of == box)[0]] for box in range(begin[height], begin[height + 1])])
        numbers = {tuple(key): begin[height] + k for k, key in enumerate(own)}
        assert len(numbers) == len(own)  # none twice
        assert (np.diff(own[:, [3, 2, 1, 0]] @ [2**42, 2**28, 2**14, 1]) > 0).all() or depth > 13
        assert (box_index == own[box_of - begin[height]]).all()
        neighbors = octree.neighbors.numpy()[begin[height] : begin[height + 1]]
        for k in range(27):
            offset = np.array([k % 3 - 1, k // 3 % 3 - 1, k // 9 - 1, 0])
            assert neighbors[:, k].tolist() == [numbers.get(tuple(key), -1) for key in own + offset]
        if height < depth:
            assert (octants[begin[height] : begin[height + 1]] == own[:, :3] % 2 @ [1, 2, 4]).all()
            children_of = children[parents[box_of], octants[box_of]]
            assert (children_of == box_of).all()
            box_of = parents[box_of]
        box_index = box_index // [2, 2, 2, 1]


def order_is_by_octant(octree) -> bool:
    depth, boxes = octree.counts.numpy()
    order, octants, begin = octree.order.numpy()[:boxes], octree.octant.numpy(), octree.octant_begin.numpy()
    level = octree.level_begin.numpy()
    for height in range(depth + 1):
        for octant in range(8):
            own = order[begin[height, octant] : begin[height, octant + 1]]
            expected = level[height] + np.flatnonzero(octants[level[height] : level[height + 1]] == octant)
            if own.tolist() != expected.tolist():
                return False
    return True


def test_boxes_are_listed_by_octant(device):
    octree = make_octree(np.random.default_rng(2).random((4000, 3)), np.zeros(4000, int), 20, device)
    assert order_is_by_octant(octree)


@pytest.mark.parametrize(("rtol", "dtype"), [(1e-3, "float32"), (1e-5, "float32"), (1e-5, "float64")])
def test_field_and_wrench_are_those_of_all_pairs(rtol, dtype, device):
    places = jittered(3500)
    moments = moments_of(len(places))
    expected = warpmag.h_field(places, moments, radii=0.4, dtype="float64", device=device)
    field = warpmag.h_field(places, moments, radii=0.4, method="fmm", rtol=rtol, dtype=dtype, device=device)
    assert apart(field, expected) <= rtol
    expected = warpmag.wrench(places, moments, radii=0.4, dtype="float64", device=device)
    forces, torques = warpmag.wrench(places, moments, radii=0.4, method="fmm", rtol=rtol, dtype=dtype, device=device)
    assert apart(forces, expected[0]) <= rtol
    assert apart(torques, expected[1]) <= rtol
    # action and reaction cancel up to rounding
    unit = 1e-7 if dtype == "float32" else 1e-15
    assert np.abs(forces.astype(float).sum(axis=0)).max() <= unit * np.linalg.norm(forces, axis=1).sum()


def test_overlapping_balls_and_targets_elsewhere(device):
    places = jittered(3000)
    moments, targets = moments_of(len(places)), np.random.default_rng(4).uniform(-3, 18, (400, 3))
    for radii in (0.0, 0.6):
        options = {"radii": radii, "target_radii": 0.3, "device": device}
        expected = warpmag.h_field(places, moments, targets, dtype="float64", **options)
        assert apart(warpmag.h_field(places, moments, targets, method="fmm", **options), expected) <= 1e-3


@pytest.mark.parametrize("name", ["one", "heap", "chain", "stray"])
def test_odd_arrangements(name, device):
    places = ARRANGEMENTS[name][0]
    moments = moments_of(len(places))
    expected = warpmag.h_field(places, moments, radii=0.3, dtype="float64", device=device)
    field = warpmag.h_field(places, moments, radii=0.3, method="fmm", device=device)
    assert np.linalg.norm(field - expected) <= 1e-3 * np.linalg.norm(expected)


def test_kinds_of_arrays_and_bad_arguments(device):
    places = jittered(200)
    moments, vec3 = moments_of(len(places)), vec3_type(resolve_dtype("float32"))
    options = [wp.array(values, dtype=vec3, device=device) for values in (places, moments)]
    field = warpmag.h_field(*options, method="fmm")
    assert isinstance(field, wp.array)
    assert (field.numpy() == warpmag.h_field(places, moments, method="fmm", device=device)).all()
    with pytest.raises(warpmag.InputError, match="rtol"):
        warpmag.h_field(places, moments, method="fmm", rtol=3e-7, device=device)
    with pytest.raises(warpmag.InputError, match="smoothing"):
        warpmag.h_field(places, moments, method="fmm", smoothing=0.1, device=device)
    assert warpmag.h_field(np.zeros((0, 3)), np.zeros((0, 3)), method="fmm", device=device).shape == (0, 3)


def test_calls_cache_no_arrays_but_tables(device):
    """Only the tables of harmonics are cached. Cached boxes could be shared with a call in another thread."""

    def arrays():
        pair_sums._cache.clear()
        gc.collect()
        return {id(item): item for item in gc.get_objects() if isinstance(item, wp.array)}

    known = {}
    for count in (300, 500):
        places, known = jittered(count), arrays()
        for function in (warpmag.h_field, warpmag.wrench):
            function(places, moments_of(len(places)), method="fmm", device=device)
    assert not [array.shape for key, array in arrays().items() if key not in known]


def test_auto_is_exact_unless_an_error_is_allowed(device, monkeypatch):
    places = jittered(9261 if device == "cpu" else 64000)
    moments = moments_of(len(places))
    exact = warpmag.h_field(places, moments, method="direct", device=device)
    assert (warpmag.h_field(places, moments, device=device) == exact).all()
    assert (warpmag.h_field(places, moments, rtol=5e-6, device=device) == exact).all()
    assert 0.0 < apart(warpmag.h_field(places, moments, rtol=1e-3, device=device), exact) <= 1e-3
    few = [array[:1000] for array in (places, moments)]
    options = {"smoothing": 0.5, "device": device}  # expansions have no smoothed law
    monkeypatch.setattr(fmm, "_COSTS", dict.fromkeys(fmm._COSTS, (0.0, 0.0)))
    assert (warpmag.h_field(*few, rtol=1e-3, **options) == warpmag.h_field(*few, **options)).all()
    assert (warpmag.wrench(*few, rtol=1e-3, **options)[0] == warpmag.wrench(*few, **options)[0]).all()
    monkeypatch.undo()
    assert (warpmag.h_field(*few, rtol=1e-3, device=device) == warpmag.h_field(*few, device=device)).all()


def clump(radius: float) -> np.ndarray:
    places = jittered(round(2 * radius + 1) ** 3, seed=6)
    return places[np.linalg.norm(places - places.mean(axis=0), axis=1) < radius]


BALLS = {
    "clump": clump(8.0),
    "two clumps": np.concatenate([clump(5.0), clump(6.0) + np.array([200.0, 30.0, 0.0])]),
    "chain": np.arange(1500)[:, None] * np.array([1.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", BALLS)
def test_induction_has_the_solution_of_all_pairs(name, device):
    places = 0.005 * BALLS[name]
    magnet = np.array([[-0.02, 0.01, 0.0]]), np.array([[3.0, 1.0, 0.0]])
    options = {"saturation": 1.7e6, "external_field": (0.0, 1e4, 2e4), "permanent": magnet, "device": device}
    exact = warpmag.solve_induction(places, 0.0015, method="direct", rtol=1e-5, **options)
    result = warpmag.solve_induction(places, 0.0015, method="fmm", rtol=1e-3, **options)
    assert result.converged
    assert result.field_error <= 1e-3
    assert exact.field_error == 0.0
    assert apart(result.magnetizations, exact.magnetizations) <= 1e-3
    (forces, _), (expected, _) = result.wrench(), exact.wrench()
    # a force combines the errors of two magnetizations and of a gradient
    assert apart(forces, expected) <= 3e-3


def test_the_error_of_fields_is_of_the_sums_alone(device, monkeypatch):
    """Corrections of touching balls do not count, since both forms of the sums add them. Where only forces use
    multipoles, the field has no error."""
    places = 0.0101 * np.stack(np.meshgrid(*3 * [np.arange(4.0)]), axis=-1).reshape(-1, 3)
    options = {"saturation": 1.7e6, "external_field": (0.0, 0.0, 1e4), "contact_model": "multipole", "device": device}
    result = warpmag.solve_induction(places, 0.005, method="fmm", **options)
    assert result._system.is_fast
    assert result.field_error <= 1e-6  # one box holds them all, and every pair is summed
    kinds = {key: (0.0 if key[1] == Quantity.WRENCH else 1e9, 0.0) for key in fmm._COSTS}
    monkeypatch.setattr(fmm, "_COSTS", kinds)
    result = warpmag.solve_induction(places, 0.005, method="auto", **options)
    assert result._system.is_fast
    assert result.field_error == 0.0


def test_worlds_do_not_see_each_other(device):
    """Worlds at one place with different moments: each result equals that of the world alone."""
    places = 0.005 * clump(4.0)
    n, count = len(places), 6
    system = moment_system(
        radii=np.full(n * count, 0.0015), worlds=np.repeat(np.arange(count), n), saturation=1.7e6,
        external_field=np.repeat(np.linspace(1e4, 2e6, count), n)[:, None] * [0.0, 0.0, 1.0], method="fmm",
        device=device,
    )  # fmt: skip
    system.positions.assign(np.tile(places, (count, 1)).astype(np.float32))
    system.solve()
    assert system.converged.numpy().all()
    assert system.field_error() <= 1e-3
    solved = system.magnetizations().numpy().reshape(count, n, 3)
    for world, strength in enumerate(np.linspace(1e4, 2e6, count)):
        lone = warpmag.solve_induction(
            places, 0.0015, saturation=1.7e6, external_field=(0.0, 0.0, strength), method="direct", device=device
        )
        assert apart(solved[world], lone.magnetizations) <= 2e-3  # errors of two solves


def test_small_worlds_are_summed_over_all_pairs(device):
    """Even many small worlds: the multipole method costs the same per moment, direct sums only the pairs of a world."""
    count, worlds = 64, 300
    places = 0.005 * jittered(count)
    system = moment_system(
        radii=np.full(count * worlds, 0.0015), worlds=np.repeat(np.arange(worlds), count), saturation=1.7e6,
        external_field=[0.0, 0.0, 1e5], rtol=3e-3, device=device,
    )  # fmt: skip
    system.positions.assign(np.tile(places, (worlds, 1)).astype(np.float32))
    system.solve()
    assert system.field_error() == 0.0  # direct sums


def test_bodies_of_several_moments_are_refused():
    with pytest.raises(warpmag.InputError, match="several moments"):
        moment_system(radii=[0.1, 0.1], bodies=[0, 0], method="fmm", device="cpu")


@pytest.mark.parametrize(("quantity", "count"), [(Quantity.FIELD, 45_000), (Quantity.WRENCH, 25_000)])
def test_the_method_is_chosen_later_where_python_launches_its_kernels(quantity, count):
    gpu = SimpleNamespace(is_cuda=True)
    assert fmm.is_fast(count**2, count, quantity, 1e-3, gpu)
    assert not fmm.is_fast(count**2, count, quantity, 1e-3, gpu, launched=True)
    assert fmm.is_fast(4 * count**2, 2 * count, quantity, 1e-3, gpu, launched=True)
