"""Host code of every launch on a GPU, run without a GPU: kernels, numbers of threads, and arguments."""

import ctypes
import dataclasses
import itertools
from types import SimpleNamespace

import cuda_on_cpu
import newton
import numpy as np
import pytest
import warp as wp
from small_builders import add_ball, new_builder
from warp._src import context

import warpmag
from bench.systems import moment_system
from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.engine.stepping.simulation import Simulation
from warpmag.kernels.applied.solids import SolidMagnet
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.kernels.contacts import solve as contact_solve
from warpmag.kernels.fmm import expansions, sharing
from warpmag.kernels.induction.solve_state import BLOCK_CHUNK
from warpmag.kernels.near_contact.images import IronFaces
from warpmag.kernels.pairs import evaluate, fused_cuda, mirror_cuda, sums_cuda
from warpmag.kernels.pairs.evaluate import FUSED, GIVEN, LOOP, MIRRORED, REFERENCE, SHORT, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import WIDTHS, Quantity
from warpmag.moments import fmm, system
from warpmag.moments.probe import FieldProbe
from warpmag.moments.system import MomentSystem
from warpmag.shapes import demagnetization, flat_faces, lattice, polyhedra

pytestmark = [
    pytest.mark.skipif("not config.getoption('--device') == 'cpu'"),
    pytest.mark.skipif(not hasattr(context, "invoke_cpu_blocks"), reason="needs Warp 1.19, whose launches it records"),
]


@dataclasses.dataclass
class Launch:
    """A launched kernel: number of threads, threads per block, and arguments as Warp packed them."""

    kernel: wp.Kernel
    threads: int
    block: int
    arguments: tuple

    @property
    def name(self) -> str:
        """Name of the kernel's function."""
        return self.kernel.func.__name__


@pytest.fixture
def launches(monkeypatch):
    """Launches on a device that looks like a CUDA device, recorded in place of running."""
    records = []

    def record(kernel, hooks, params, _):
        assert params[0].size % hooks.block_dim == 0 or kernel.grid_stride, kernel.key
        assert hooks.block_dim <= np.ravel(kernel.options.get("launch_bounds") or 1024)[0], kernel.key
        assert -(-params[0].size // hooks.block_dim) % hooks.cluster_dim == 0, kernel.key
        records.append(Launch(kernel, params[0].size, hooks.block_dim, tuple(params[1:])))

    real = context.Module.load

    def load(module, device, block_dim=None):
        if not all(map(cuda_on_cpu.ours, module._get_live_kernels())):
            return real(module, device, block_dim)
        module.get_module_hash(block_dim)  # resolves kernels that share a module
        hooks = SimpleNamespace(forward=1, backward=None, det_launch_meta=None, block_dim=block_dim)
        hooks.cluster_dim = module.options.get("cluster_dim") or 1
        return SimpleNamespace(get_kernel_hooks=lambda _: hooks)

    class Capture:
        graph = None

        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

    for function in (expansions._translation, expansions._device_tables):
        function.cache_clear()
    with monkeypatch.context() as patch:
        cuda_on_cpu.look_like_cuda(patch.setattr, arch=90)
        patch.setattr(context, "invoke_cpu_blocks", record)
        patch.setattr(context.Module, "load", load)
        patch.setattr(context.Device, "get_cuda_compile_arch", lambda device: device.arch)
        patch.setattr(wp, "get_cuda_max_cluster_dim", lambda kernel, device, block_dim: 16)
        patch.setattr(wp, "capture_if", lambda _, body, **arguments: body(**arguments))
        patch.setattr(wp, "capture_while", lambda _, body, **arguments: body(**arguments))
        patch.setattr(wp, "ScopedCapture", Capture)
        patch.setattr(wp, "capture_launch", lambda _: None)
        yield records
    for function in (expansions._translation, expansions._device_tables):
        function.cache_clear()


def packed(count: int, dtype=wp.float32) -> PackedMoments:
    return PackedMoments(wp.zeros(count, dtype=dtype, device="cpu"), largest_radius=0.0, moving=False)


def evaluation(quantity, count, segments=None, *, among=True, dtype=wp.float32, **settings) -> PairEvaluation:
    """Sums of ``count`` moments, over all pairs or those of segments."""
    moments = packed(count, dtype)
    vectors = (wp.zeros(count, dtype=wp.types.vector(3, dtype), device="cpu") for _ in range(3))
    base, out, torques = vectors
    segments = [(0, count, 0, count)] if segments is None else segments
    targets = moments if among else packed(count, dtype)
    turned = wp.ones(count, dtype=int, device="cpu")
    arrays = targets, moments, base, out
    return PairEvaluation(quantity, segments, *arrays, with_torque=turned, torques=torques, **settings)


def integers(array) -> np.ndarray:
    """Integers of a packed array argument."""
    shape = array.shape[: array.ndim]
    return np.ctypeslib.as_array((ctypes.c_int * int(np.prod(shape))).from_address(array.data)).reshape(shape)


class Half:
    """The second of two processes, as ``warpmag.moments.ranks.Ranks``."""

    rank, size = 1, 2

    def __init__(self):
        self.merged = []

    def share(self, count):
        return count // 2, count

    def merge(self, array):
        self.merged.append(array.shape)


def assert_each_pair_once(sums, segments, tiles, width):
    """Check that tiles of at most ``width`` targets cover each pair once, and write each partial sum once."""
    count = sums.count
    expected, covered = np.zeros((2, count, 1 + max(s[3] for s in segments)), int)
    row = 0
    for t0, t1, s0, s1 in segments:
        expected[row : row + t1 - t0, s0:s1] += 1
        row += t1 - t0
    written = np.zeros((max(1, tiles[:, 5].max() + 1), count), int)
    for begin, end, column, first, last, part, *_ in tiles:
        assert 0 < end - begin <= width
        assert column == sums.target.numpy()[begin]
        covered[begin:end, first:last] += 1
        written[part, begin:end] += 1
    assert (covered == expected).all()
    assert (written == 1).all()


SEGMENTS = {"all": [(0, 300, 0, 300)], "parts": [(0, 40, 3, 90), (40, 41, 0, 100), (60, 100, 50, 70)]}
QUANTITIES = Quantity.FIELD, Quantity.FORCE, Quantity.MUTUAL_FORCE, Quantity.WRENCH


def finish_of(sums, launch, parts: int):
    """Check the kernel that adds up ``parts`` partial sums, with a group of threads for each target row."""
    assert launch.name == "finish"
    assert launch.threads == 8 * sums.count
    assert sums.partial.shape == (parts, sums.count, WIDTHS[sums._finished])
    assert tuple(launch.arguments[-1].partial.shape[:3]) == sums.partial.shape


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("which", SEGMENTS)
def test_few_moments_take_one_kernel(quantity, which, launches):
    sums = evaluation(quantity, 300, SEGMENTS[which])
    sums.launch()
    (launch,), tiles = launches, sums._arrays.tiles.numpy()
    assert sums.form == FUSED
    shape = fused_cuda.choose_fused_shape(sums._finished, sums.count)
    assert_each_pair_once(sums, SEGMENTS[which], tiles, shape.targets)
    assert (launch.threads, launch.block) == (len(tiles) * shape.threads, shape.threads)
    assert shape.shares * shape.targets <= shape.correcting


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_many_small_worlds_take_one_kernel(quantity, launches):
    """A group of threads takes a row, and a small one where rows alone fill a GPU; larger worlds take tiles."""
    for size, count, form, group in (
        (12, 9600, SHORT, 8),
        (160, 9600, SHORT, 8),
        (192, 9600, LOOP, 8),
        (192, 57600, LOOP, 2),
    ):
        segments = [(k, k + size, k, k + size) for k in range(0, count, size)]
        sums = evaluation(quantity, count, segments)
        assert sums.form == form
        launches.clear()
        sums.launch()
        assert launches[0].name == ("sum_and_finish_row" if form == SHORT else "sum_tile")
        assert launches[-1].threads == group * sums.count and len(launches) == (1 if form == SHORT else 2)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("which", SEGMENTS)
@pytest.mark.parametrize("extra", [0, 1])
def test_tiles_of_the_loop(quantity, which, extra, launches):
    sums = evaluation(quantity, 300, SEGMENTS[which], among=False, form=LOOP, extra_parts=extra)
    sums.launch()
    (launch, finish), tiles = launches, sums._arrays.tiles.numpy()
    shape = sums_cuda.choose_loop_shape(sums._finished, sums.count)
    assert_each_pair_once(sums, SEGMENTS[which], tiles, 32 * shape.targets)
    assert (launch.threads, launch.block) == (len(tiles) * 32 * shape.warps, 32 * shape.warps)
    finish_of(sums, finish, 1 + tiles[:, 5].max() + extra)


@pytest.mark.parametrize("dtype", [wp.float32, wp.float64])
@pytest.mark.parametrize("quantity", [Quantity.FIELD, Quantity.MUTUAL_FORCE])
@pytest.mark.parametrize("memory", [2**28, 2**19])
def test_mirrored_walk(quantity, memory, dtype, launches, monkeypatch):
    """Each home tile covers each distance between tiles once, in passes whose slabs fit the partial sums."""
    count = 5500
    monkeypatch.setattr(mirror_cuda, "_SLAB_BYTES", memory)
    sums = evaluation(quantity, count, dtype=dtype)
    sums.launch()
    assert sums.form == MIRRORED
    *passes, finish = launches
    assert len(passes) == 1 if memory > 2**20 else len(passes) > 1
    walk = passes[0].arguments[1]
    blocks, edges = integers(walk.blocks), integers(walk.edges)
    tiles, stages = len(edges) - 1, walk.stages
    assert edges[0] == 0 and edges[-1] == count and (np.diff(edges) <= 32 * stages).all()
    finish_of(sums, finish, walk.slabs + 1 + blocks[:, 3].max())
    done = np.zeros((tiles, stages * (tiles // 2 + 1)), int)
    for launch in passes:
        first, nearest = launch.arguments[2].value, launch.arguments[3].value
        assert launch.threads == launch.block * tiles * (1 + blocks[:, 3].max())
        for tile, begin, end, _ in blocks[first : first + launch.threads // launch.block]:
            assert begin // stages == 0 or begin // stages >= nearest
            assert -(-end // stages) - nearest <= walk.slabs
            done[tile, begin:end] += 1
    assert (done == 1).all()


def test_given_and_plain_sums(launches):
    """Sums of the caller and of the reference loop have one partial sum."""
    called = []
    for settings in ({"sums": lambda *arguments: called.append(arguments)}, {"form": REFERENCE, "smoothing": 0.1}):
        launches.clear()
        sums = evaluation(Quantity.WRENCH, 300, **settings)
        sums.launch(wait=lambda: called.append("waited"))
        finish_of(sums, launches[-1], 1)
        assert len(launches) == (1 if sums.form == GIVEN else 2)
    assert [arguments if arguments == "waited" else len(arguments) for arguments in called] == [3, "waited", "waited"]
    evaluation(Quantity.FIELD, 0).launch()


@pytest.mark.parametrize(("form", "count"), [(LOOP, 300), (MIRRORED, 5500), (FUSED, 300)])
def test_processes_share_out_the_sums(form, count, launches, monkeypatch):
    """A process sums half of the work and merges the shared partial sums, but not the caller's."""
    whole = evaluation(Quantity.FIELD, count, form=form)
    whole.launch()
    alone = launches[0].threads
    launches.clear()
    monkeypatch.setitem(evaluate._FEWEST_PAIRS_OF_RANKS, "cuda", 1)
    half = evaluation(Quantity.FIELD, count, form=form, extra_parts=form == LOOP, ranks=(ranks := Half()))
    half.launch()
    if form == FUSED:
        assert launches[0].threads == alone and not ranks.merged
    else:
        assert abs(2 * launches[0].threads - alone) <= launches[0].block
        assert ranks.merged == [(len(half.partial) - (form == LOOP), *half.partial.shape[1:])]


BOX, COIL = [0.01, 0.01, 0.02], AppliedSource(SourceKind.LOOP, (0.02,), movable=True)
LINES = AppliedSource(SourceKind.POLYLINE, (1e-4,), 0.05 * np.eye(3))


def solid(first: int, **settings) -> SolidMagnet:
    """A box with one moment."""
    return SolidMagnet(first, 1, 8e-6, 0, 0.1, polyhedra.box(BOX), polyhedra.box_moments(BOX), True, **settings)


def cells(spacing: float) -> dict:
    """Arguments of a system with one body of cells."""
    body = lattice.fill([lattice.box(BOX).posed((0.0,) * 3, (0.0, 0.0, 0.0, 1.0))], spacing, 3, together=True)
    coupling = demagnetization.coupling(body, body.radii)
    return {"radii": body.radii, "bodies": np.zeros(len(body.radii), int), "couplings": [(0, coupling)]}


def ball_on_box(spacing: float) -> dict:
    """Arguments of a system with a body of cells and a ball, which has images in its faces."""
    body = cells(spacing)
    faces = flat_faces.faces_of_polyhedron(polyhedra.box(BOX), 6)
    count = len(body["radii"])
    iron = IronFaces(0, 0, count, 0, body["couplings"][0][1].positions[0], faces.planes, faces.edges)
    radii, bodies = np.append(body["radii"], 0.005), np.append(body["bodies"], 1)
    return body | {"radii": radii, "bodies": bodies, "faces": [iron], "contact_model": "multipole"}


MANY = {"radii": np.full(40, 0.005), "worlds": np.repeat([0, 1], 20), "permanent": np.arange(40) % 20 > 16}
SYSTEMS = {
    "balls": MANY,
    "paper": MANY | {"dynamics": "theta-euler", "force": "zeeman"},
    "gilbert": MANY | {"dynamics": "llg"},
    "near": MANY | {"contact_model": "multipole"},
    "turned": MANY | {"contact_model": "multipole", "single_torque": True},
    "yielding": MANY | {"contact_model": "multipole", "curve": ["linear"] * 40},
    "cells": cells(0.005),
    "whole": cells(0.02),
    "images": ball_on_box(0.005),
    "coils": MANY | {"sources": [COIL, LINES], "contact_model": "multipole"},
    "solids": MANY | {"solids": [solid(18)], "sources": [COIL]},
    "fast": MANY | {"method": "fmm"},
    "most": {"radii": np.full(7001, 0.005)},
}


EXPECTED = {
    "balls": {
        "sum_and_finish",
        "begin_flow",
        "sweep_moment",
        "check_convergence",
        "advance_moment",
        "add_eddy_moments",
        "eddy_passes",
    },
    "paper": {"sum_and_finish", "begin_worlds", "step_pairs", "check_convergence", "zeeman_moments"},
    "gilbert": {"sum_and_finish", "begin_worlds", "step_pairs", "check_convergence"},
    "near": {"sum_tile", "make_passes", "begin_flow"},
    "turned": {"sum_tile", "finish", "begin_flow"},
    "yielding": {"sum_tile", "finish", "begin_flow", "add_bias"},
    "cells": {"sum_and_finish", "multiply_bodies", "sweep_moment"},
    "whole": {"sum_and_finish", "multiply_bodies", "sweep_moment"},
    "images": {"make_passes", "add_couplings", "add_reactions"},
    "coils": {"sum_tile", "apply_sources", "add_forces", "add_to_probe", "add_eddy_moments"},
    "solids": {"sum_and_finish", "apply_sources", "add_forces", "add_to_probe", "add_eddy_moments"},
    "fast": {"build_octree", "sum_leaf", "translate_block", "add_parts", "expansion_step", "return_sums"},
    "most": {"sum_mirrored", "finish", "sweep_moment", "list_neighbors"},
}
"""Kernels that a system must launch on a GPU."""


def drive(which: str, dtype: str) -> MomentSystem:
    """Launch induction, forces and fields at points, and eddy currents of balls."""
    magnets = moment_system(saturation=1e6, dtype=dtype, device="cpu", **SYSTEMS[which])
    if which in ("balls", "coils", "solids"):
        magnets.set_conductivity(np.full(magnets.count, 1e7), 1e-3)
    for step in (magnets.solve, magnets.evaluate, magnets.apply_forces, magnets.start_cold):
        step()
    magnets.start_from(wp.zeros_like(magnets.moments))
    FieldProbe(magnets, 70, gradients=True).measure()
    return magnets


@pytest.mark.parametrize("which", SYSTEMS)
def test_systems(which, launches):
    driven = drive(which, "float32")
    ranges, threads = driven.world_ranges, {}
    for launch in launches:
        threads.setdefault(launch.name, set()).add(launch.threads)
    assert EXPECTED[which] <= threads.keys()
    induced = sum(middle - first for first, middle, _ in ranges)
    if "sweep_moment" in threads:
        assert threads["sweep_moment"] == {8 * induced}  # a group per moment
    if "advance_moment" in threads:
        assert threads["advance_moment"] == {induced}
    chunks = sum(-(-(middle - first) // BLOCK_CHUNK) for first, middle, _ in ranges)
    block = max(32, driven._induction.block_moments) if "advance_moment" in threads else BLOCK_CHUNK
    assert threads["check_convergence"] == {block * chunks}


@pytest.mark.parametrize("which", ["fast", "most"])
def test_systems_of_two_processes(which, launches, monkeypatch):
    """Each process has half of the boxes, or half of the blocks of each pass, in whole splits."""
    ranks = Half()
    for module in (system, fmm):
        monkeypatch.setattr(module, "current_ranks", lambda: ranks)
    monkeypatch.setattr(sharing, "_LEAST_BOXES", {"cuda": 1})
    monkeypatch.setattr(evaluate, "_FEWEST_PAIRS_OF_RANKS", {"cuda": 1})
    monkeypatch.setattr(mirror_cuda, "_SLAB_BYTES", 2**20)
    drive(which, "float64")
    names = {launch.name for launch in launches}
    assert "_choose_boxes" in names if which == "fast" else "sum_mirrored" in names
    assert len(ranks.merged) > 2


def test_simulation(launches):
    """A step of balls on the ground below a magnet."""
    advance(magnets())
    threads = {launch.name: launch.threads for launch in launches}
    assert threads["advance_moment"] == threads["_move"] == 2
    assert {
        "_watch",
        "_end_attempt",
        "solve_in_cluster",
        "list_neighbors",
        "sum_and_finish",
        "add_forces",
    } <= threads.keys()


def magnets() -> newton.ModelBuilder:
    """Two iron balls on the ground below a fixed magnet."""
    builder = new_builder()
    builder.add_ground_plane()
    for k in range(2):
        add_ball(builder, (0.02 * k, 0.0, 0.005))
    magnet = builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, 0.045)), hx=0.01, hy=0.01, hz=0.01)
    warpmag.add_permanent(builder, shape=magnet, magnetization=(0.0, 0.0, 1e6), moment_spacing=0.01)
    return builder


def advance(builder, **settings):
    """Launch a step without a graph."""
    Simulation(builder, device="cpu", **settings)._stepper._launch()


def pile(worlds: int, contact_max: int, bodies: int = 3) -> tuple:
    """A solver of balls in several worlds, its model, and contacts."""
    builder = newton.ModelBuilder()
    for _ in range(worlds):
        part = newton.ModelBuilder()
        for k in range(bodies):
            body = part.add_body(xform=wp.transform((0.0, 0.0, 0.02 * k)))
            part.add_shape_sphere(body, radius=0.005)
        builder.add_world(part)
    model = builder.finalize(device="cpu")
    model.joint_count = 0
    contacts = newton.CollisionPipeline(model, rigid_contact_max=contact_max).contacts()
    solver = PileXPBD(model, contact_max, iterations=3, rigid_contact_con_weighting=False)
    return solver, model, contacts


@pytest.mark.parametrize(("worlds", "contact_max"), [(1, 1000), (1, 6000), (1, 60_000), (20, 1000)])
def test_contact_solve(worlds, contact_max, launches):
    """Contacts solved by a cluster with launches for the rest, by launches alone, or by a block per world."""
    solver, model, contacts = pile(worlds, contact_max)
    solver.step(model.state(), model.state(), None, contacts, 1e-3)
    bodies, solve = model.body_count, solver._solve
    calls = ("COUNT", "PLACE", "LIST", "WRITE", "ITERATE", "FINISH", "SOLVE", "SOLVE_WORLD")
    names = {getattr(contact_solve, call).split("(")[0] for call in calls}
    launched = [(launch.kernel, launch.threads) for launch in launches if launch.name in names]

    def kernel(call, **form):
        return contact_solve.solve_kernel(call, True, solve.group, **form)

    lists = [(contact_solve.COUNT, contact_max), (contact_solve.PLACE, -(-(bodies + 1) // 32) * 32)]
    lists += [(contact_solve.LIST, contact_max), (contact_solve.WRITE, 2 * contact_max)]
    threads = contact_solve._WIDE_BLOCKS * contact_solve._BLOCK + solve.group * bodies
    iterations = [(contact_solve.ITERATE, threads)] * 3 + [(contact_solve.FINISH, threads)]
    expected = lists if contact_max > 50_000 or worlds > 1 else []
    if worlds == 1 and contact_max > 3000:
        expected = expected + iterations
    expected = [(kernel(call)[0], count) for call, count in expected]
    if worlds > 1:
        of_world, block = kernel(contact_solve.SOLVE_WORLD, cluster=1, lines=32)
        expected.append((of_world, worlds * block))
    elif contact_max <= 50_000:
        in_cluster, block = kernel(contact_solve.SOLVE, cluster=16)
        expected.insert(0, (in_cluster, 16 * block))
    assert launched == expected


@pytest.mark.long
def test_every_kernel_compiles(launches, tmp_path):
    """NVRTC compiles every kernel, without a GPU, for the architecture of the H200."""
    for which, dtype in itertools.product(SYSTEMS, ("float32", "float64")):
        drive(which, dtype)
    for quantity, dtype in itertools.product(QUANTITIES, (wp.float32, wp.float64)):
        for most, _ in (*fused_cuda._SHAPES.get(quantity, ()), *mirror_cuda._SHAPES.get(quantity, ())):
            evaluation(quantity, most or 100_000, dtype=dtype).launch()
        for most, _ in sums_cuda._SHAPES.get(quantity, ()):
            evaluation(quantity, most or 100_000, dtype=dtype, form=LOOP).launch()
        evaluation(quantity, 100, dtype=dtype, form=SHORT).launch()
    for worlds, contact_max, bodies in ((1, 1000, 3), (1, 60_000, 3), (20, 1000, 3), (20, 1000, 60), (1, 1000, 150)):
        solver, model, contacts = pile(worlds, contact_max, bodies)
        solver.step(model.state(), model.state(), None, contacts, 1e-3)
    advance(magnets(), contact_model="multipole")
    compiled = {(launch.kernel.module, launch.block) for launch in launches}
    for module, block in compiled:
        module.options["block_dim"] = block
        wp.compile_aot_module(module, device=None, arch=90, module_dir=tmp_path, use_ptx=False)
    assert len(list(tmp_path.glob("*.cubin"))) == len(compiled) > 150
