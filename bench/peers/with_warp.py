"""warpmag, the whole call of ``warpmag.h_field``, and two plain Warp kernels."""

import numpy as np
import warp as wp

from bench.cases import RADIUS
from bench.peers import Evaluation, evaluation_of
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments import fields

TILE = wp.constant(64)


def warpmag(positions, moments, device) -> Evaluation:
    """Sums over all pairs and the pass over overlaps, on arrays of the device."""
    n = len(positions)
    x, m = (wp.array(a, dtype=wp.vec3, device=device) for a in (positions, moments))
    packed = PackedMoments(wp.full(n, 0.9 * RADIUS, dtype=wp.float32, device=device), largest_radius=0.9 * RADIUS)
    packed.pack(x, m)
    packed.find_overlaps()
    h = wp.zeros_like(x)
    return captured(PairEvaluation(Quantity.FIELD, [(0, n, 0, n)], packed, packed, wp.zeros_like(x), h).launch, h)


def h_field(positions, moments, device) -> Evaluation:
    """The whole call of ``warpmag.h_field`` on NumPy arrays."""
    return evaluation_of(lambda: fields.h_field(positions, moments, device=device))


@wp.func
def dipole_field(r: wp.vec3, m: wp.vec3):
    """4π times the field of moment ``m`` at separation ``r``; 0 at r = 0."""
    d2 = wp.dot(r, r)
    h = wp.vec3()
    if d2 > 0.0:
        inv = 1.0 / wp.sqrt(d2)
        h = inv * inv * inv * (3.0 * wp.dot(r, m) * inv * inv * r - m)
    return h


@wp.kernel(enable_backward=False)
def sum_field(x: wp.array[wp.vec3], m: wp.array[wp.vec3], h_out: wp.array[wp.vec3]):
    """Field at each moment."""
    i = wp.tid()
    h = wp.vec3()
    for j in range(x.shape[0]):
        h += dipole_field(x[i] - x[j], m[j])
    h_out[i] = 0.07957747154594767 * h


@wp.kernel(enable_backward=False)
def sum_field_tiled(x: wp.array[wp.vec3], m: wp.array[wp.vec3], tiles: int, h_out: wp.array[wp.vec3]):
    """Field at each moment; sources are loaded one tile at a time."""
    i = wp.tid()
    target = x[i]
    h = wp.vec3()
    for k in range(tiles):
        x_tile = wp.tile_load(x, shape=TILE, offset=k * TILE)
        m_tile = wp.tile_load(m, shape=TILE, offset=k * TILE)
        for j in range(TILE):
            h += dipole_field(target - x_tile[j], m_tile[j])
    h_out[i] = 0.07957747154594767 * h


def warp_plain(positions, moments, device) -> Evaluation:
    """The textbook loop: one thread per target."""
    x, m = (wp.array(a, dtype=wp.vec3, device=device) for a in (positions, moments))
    h = wp.zeros_like(x)
    return captured(lambda: wp.launch(sum_field, len(x), [x, m], [h], device=device, block_dim=256), h)


def warp_tile(positions, moments, device) -> Evaluation:
    """Warp's ``example_tile_nbody`` for dipoles, padded to whole tiles as it needs."""
    n, tile = len(positions), int(TILE)
    padding = np.zeros((-n % tile, 3), np.float32)
    x = wp.array(np.concatenate([positions, padding + 1e9]), dtype=wp.vec3, device=device)
    m = wp.array(np.concatenate([moments, padding]), dtype=wp.vec3, device=device)
    h, tiles = wp.zeros_like(x), x.shape[0] // tile
    return captured(lambda: wp.launch(sum_field_tiled, len(x), [x, m, tiles], [h], device=device, block_dim=tile), h, n)


def captured(launch, h, count=None) -> Evaluation:
    """Evaluation that launches a captured graph of ``launch``, which writes ``h``."""
    launch()
    with wp.ScopedCapture(h.device) as capture:
        launch()
    graph = capture.graph
    return Evaluation(
        lambda: wp.capture_launch(graph), lambda: wp.synchronize_device(h.device), lambda: h.numpy()[:count], launch
    )
