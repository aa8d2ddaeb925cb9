"""Prefix sums without allocation, for conditional nodes of CUDA graphs (``engine/pile_xpbd/capture.py``)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

_TILE = wp.constant(2048)
_BLOCK = 256


@wp.kernel
def _scan(values_in: wp.array[wp.int32], inclusive: int, sums_out: wp.array[wp.int32]):
    """Scan the tiles one after the other in one block; loads beyond the end return zero, stores there do nothing."""
    before = int(0)
    for tile in range((values_in.shape[0] + _TILE - 1) // _TILE):
        values = wp.tile_load(values_in, shape=_TILE, offset=tile * _TILE)
        sums = wp.tile_scan_inclusive(values)
        base = wp.tile_full(shape=_TILE, value=before, dtype=int)
        if inclusive != 0:
            wp.tile_store(sums_out, sums + base, offset=tile * _TILE)
        else:
            wp.tile_store(sums_out, sums - values + base, offset=tile * _TILE)
        before += wp.tile_extract(sums, _TILE - 1)


def launch_scan(values, sums, inclusive: bool = True):
    """Write the prefix sums of integers, as ``wp.utils.array_scan`` does; ``sums`` may be ``values``.

    A value is part of its own sum if ``inclusive``.
    """
    inputs, device = [values, int(inclusive)], values.device
    wp.launch_tiled(_scan, dim=1, inputs=inputs, outputs=[sums], block_dim=_BLOCK, device=device)
