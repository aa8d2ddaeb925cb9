"""Finishing of the field loop: split sums added up, overlapping pairs corrected."""

from functools import cache

import warp as wp

from warpmag.kernels.neighbors import pair_correction

INVERSE_4PI = 0.07957747154594767


@cache
def finished_field(dtype):
    """Warp function that turns one target row's partial sums into the field [A/m] of its sources."""
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
    ):
        h = vec3()
        for split in range(partial.shape[0]):
            h += vec3(partial[split, row, 0], partial[split, row, 1], partial[split, row, 2])
        skip = wp.where(same_set == 1, i, -1)
        if neighbor_count[i] > 0:
            h += correct_pairs(targets, sources, i, begin, end, skip, neighbor, neighbor_count)
        return dtype(wp.static(INVERSE_4PI)) * h

    return finish


@cache
def _finish_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    finish = finished_field(dtype)

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
        # outputs:
        h_out: wp.array[vec3],
    ):
        row = wp.tid()
        i = row_target[row]
        h_out[i] = base[i] + finish(
            partial, targets, sources, row, i, row_begin[row], row_end[row], same_set, neighbor, neighbor_count
        )

    return finish_field


def launch_finish_field(rows, partial, targets, sources, same_set, base, h):
    """Write the field of the sources at each target, on top of a given one.

    Args:
        rows: Work list that ``partial`` was summed over.
        partial: Sums of the native field loop, shape [splits, rows, 3].
        targets: Packed targets with their overlapping sources (``warpmag.packed.PackedMoments``), t of them.
        sources: Packed sources.
        same_set: Whether targets and sources are the same moments, none of which is its own neighbour.
        base: Field to start from [A/m], shape [t].
        h: Out, field [A/m], shape [t]; only the targets of ``rows`` are written.
    """
    if rows.count == 0:
        return
    wp.launch(
        _finish_kernel(partial.dtype),
        dim=rows.count,
        inputs=[
            partial,
            targets.packed,
            sources.packed,
            rows.target,
            rows.begin,
            rows.end,
            int(same_set),
            targets.neighbors,
            targets.neighbor_counts,
            base,
        ],
        outputs=[h],
        device=partial.device,
    )
