"""Field at targets: the sums of the pair loop, or of this very kernel's blocks, with overlapping pairs corrected.

On a CPU ``finish_cpu`` does so.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs import finish_cpu
from warpmag.kernels.pairs.fused_cuda import (
    FusedShape,
    own_target,
    pair_summation,
    target_share,
    this_block,
    this_thread,
)
from warpmag.kernels.pairs.neighbors import pair_correction
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.shared import team as cpu_team
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.reductions import group_sum, group_threads

INVERSE_4PI = 0.07957747154594767


@cache
def finished_field(dtype):
    """Warp function that turns one target row's partial sums into the field [A/m] of its sources.

    Thread ``share`` of ``shares`` gets its share of it, for ``neighbors.group_sum`` to add up.
    """
    vec3 = wp.types.vector(3, dtype)
    correct_pairs = pair_correction(dtype, gradient=False, exclude_body=False)

    @wp.func
    def finish(
        partial: wp.array3d[dtype],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row: int,
        i: int,
        begin: int,
        end: int,
        same_set: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        share: int,
        shares: int,
    ):
        h = vec3()
        for split in range(share, partial.shape[0], shares):
            h += vec3(partial[split, row, 0], partial[split, row, 1], partial[split, row, 2])
        skip = wp.where(same_set == 1, i, -1)
        if neighbor_count[i] > share:
            h += correct_pairs(targets, sources, i, begin, end, skip, neighbor, neighbor_count, share, shares)
        return dtype(wp.static(INVERSE_4PI)) * h

    return finish


@cache
def summed_field(dtype, shape: FusedShape):
    """Warp function by which a block sums the field [A/m] of a tile's sources at its targets.

    All threads of the block call it. A thread that has a target, see ``fused_cuda.own_target``, gets its field.
    """
    vec3 = wp.types.vector(3, dtype)
    share_of = target_share(shape)
    correct_pairs = pair_correction(dtype, gradient=False, exclude_body=False)
    sum_pairs = pair_summation(dtype, Quantity.FIELD, shape)

    @wp.func
    def field_of_tile(
        tile: int,
        thread: int,
        tiles: wp.array2d[int],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        same_set: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
    ):
        correction = vec3()
        i, share = share_of(tile, thread, tiles)
        if i >= 0:
            begin = tiles[tile, 3]
            end = tiles[tile, 4]
            skip = wp.where(same_set == 1, i, -1)
            correction = correct_pairs(
                targets, sources, i, begin, end, skip, neighbor, neighbor_count, share, wp.static(shape.shares)
            )
        h = dtype(wp.static(INVERSE_4PI)) * sum_pairs(tile, thread, tiles, targets, sources, targets, correction)
        return h

    return field_of_tile


@cache
def _finish_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    finish = finished_field(dtype)
    sum_group = group_sum(vec3)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_field(
        # inputs:
        partial: wp.array3d[dtype],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        same_set: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        base: wp.array[vec3],
        shares: int,
        # outputs:
        h_out: wp.array[vec3],
    ):
        row = wp.tid() // shares
        share = wp.tid() % shares
        i = row_target[row]
        begin = row_begin[row]
        end = row_end[row]
        mine = finish(partial, targets, sources, row, i, begin, end, same_set, neighbor, neighbor_count, share, shares)
        h = sum_group(mine, shares)
        if share == 0:
            h_out[i] = base[i] + h

    return finish_field


@cache
def _sum_kernel(dtype, shape: FusedShape):
    vec3 = wp.types.vector(3, dtype)
    field_of_tile = summed_field(dtype, shape)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(shape.threads, 1),
        module_options=native_options("pairs/fused_cuda.h", dtype=dtype),
    )
    def sum_field(
        # inputs:
        tiles: wp.array2d[int],
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        same_set: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        base: wp.array[vec3],
        # outputs:
        h_out: wp.array[vec3],
    ):
        tile = this_block()
        thread = this_thread()
        i = own_target(tile, thread, tiles)
        start = vec3()
        if i >= 0:
            start = base[i]  # here, so that nothing waits for it at the end
        h = field_of_tile(tile, thread, tiles, targets, sources, same_set, neighbor, neighbor_count)
        if i >= 0:
            h_out[i] = start + h

    return sum_field


def launch_field(rows, partial, targets, sources, same_set, base, h):
    """Write the field of the sources at each target, on top of a given one.

    Args:
        rows: Work list.
        partial: Sums of the pair loop over it, see ``pair_loops``; nothing if ``rows.fused``.
        targets: Packed targets with their overlapping sources (``warpmag.packed.PackedMoments``), t of them.
        sources: Packed sources.
        same_set: Whether targets and sources are the same moments, none of which is its own neighbour.
        base: Field to start from [A/m], shape [t].
        h: Out, field [A/m], shape [t]; only the targets of ``rows`` are written.
    """
    if rows.count == 0:
        return
    near = [int(same_set), targets.overlaps, targets.overlap_counts]
    if rows.fused:
        wp.launch(
            _sum_kernel(targets.dtype, rows.shape),
            dim=rows.tiles.shape[0] * rows.shape.threads,
            inputs=[rows.tiles, targets.packed, sources.packed, *near, base],
            outputs=[h],
            block_dim=rows.shape.threads,
            device=targets.device,
        )
    elif targets.device.is_cpu and cpu_team.VECTORS:
        finish_cpu.launch_finish(rows, partial, targets, sources, same_set, base, h, INVERSE_4PI=INVERSE_4PI)
    else:
        shares = group_threads(targets.device)
        wp.launch(
            _finish_kernel(targets.dtype),
            dim=shares * rows.count,
            inputs=[partial, targets.packed, sources.packed, rows.target, rows.begin, rows.end, *near, base, shares],
            outputs=[h],
            device=targets.device,
        )
