"""Warp, as its example_tile_nbody: sources loaded a tile at a time; padded to whole tiles, which the example needs."""

import numpy as np
import warp as wp

from bench.peers import Evaluation
from bench.peers.with_warp_plain import capture, dipole_field

TILE = wp.constant(64)


@wp.kernel(enable_backward=False)
def sum_field_tiled(x: wp.array[wp.vec3], m: wp.array[wp.vec3], tiles: int, h_out: wp.array[wp.vec3]):
    """Field at each moment."""
    i = wp.tid()
    target = x[i]
    h = wp.vec3()
    for k in range(tiles):
        x_tile = wp.tile_load(x, shape=TILE, offset=k * TILE)
        m_tile = wp.tile_load(m, shape=TILE, offset=k * TILE)
        for j in range(TILE):
            h += dipole_field(target - x_tile[j], m_tile[j])
    h_out[i] = 0.07957747154594767 * h


def prepare(positions, moments, device):
    """See ``bench.peers``."""
    n, tile = len(positions), int(TILE)
    padding = np.zeros((-n % tile, 3), np.float32)
    x = wp.array(np.concatenate([positions, padding + 1e9]), dtype=wp.vec3, device=device)
    m = wp.array(np.concatenate([moments, padding]), dtype=wp.vec3, device=device)
    e = capture(sum_field_tiled, x.shape[0], [x, m, x.shape[0] // tile], x, device, tile)
    return Evaluation(e.run, e.wait, lambda: e.result()[:n])
