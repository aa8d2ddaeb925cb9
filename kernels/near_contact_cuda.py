"""The near-contact model on a GPU with few balls: its passes in the launch that sums the pairs.

Where the sums over all pairs take ten microseconds, each launch that has to wait for another takes two more, and so
does each fork of streams. So the first blocks of a launch make the passes, and hear from each other what a pass has
found, while the others sum the pairs and add at the end what those tell them. All that goes in packets of three numbers
and a mark (see ``vector_passes``). Where a ball is heard again and again, the mark is its count of turns; where it is
heard once, whoever hears it takes the mark away.

Blocks start in the order of their numbers, and those that make passes, the first, all have a place on the GPU: none
waits for one that has not.
"""

from functools import cache

import warp as wp

from warpmag.kernels.field import INVERSE_4PI, summed_field
from warpmag.kernels.near_contact import ContactArrays, NearContactBuffers, passes
from warpmag.kernels.near_contact_code import FORCES, WAYS, contact_text
from warpmag.kernels.pair_code import FIELD, FORCE, WIDTHS, WRENCH
from warpmag.kernels.pair_sums_cuda import Shape, own_target, pair_summation, target_share, this_block, this_thread
from warpmag.kernels.vector_passes import HEAR
from warpmag.kernels.wrench import wrench_functions

# Measured on an H200, like ``pair_sums_cuda.SHAPES``: best where all blocks have a place at once, with those that make
# passes.
SHAPES = {
    FIELD: ((528, Shape(2, 2, 8, 1)), (1056, Shape(4, 2, 8, 2)), (None, Shape(5, 2, 4, 2))),
    FORCE: ((528, Shape(2, 2, 8, 1)), (1056, Shape(4, 2, 8, 2)), (None, Shape(3, 4, 4, 4))),
    WRENCH: ((528, Shape(2, 2, 8, 1)), (1056, Shape(4, 2, 8, 2)), (None, Shape(4, 2, 4, 2))),
}
_PLACES = 480
"""Threads of such blocks that a multiprocessor has at least."""


def _bounds(shape: Shape) -> tuple[int, int]:
    """Threads of a block, and blocks that a multiprocessor has a place for."""
    return shape.threads, -(-_PLACES // shape.threads)


@cache
def _heard():
    """Warp function that waits for what the passes tell of a ball, at ``place``, and has it forgotten."""
    text = f"""
    wp::vec_t<3, float> heard;
    #if defined(__CUDA_ARCH__)
    typedef float REAL;
    {HEAR}
    REAL* const packet = (REAL*)place + 4 * (size_t)i;
    Told told;
    do told = hear(packet); while (told.mark == 0);
    ((int*)packet)[3] = 0;
    heard = {{told.x, told.y, told.z}};
    #endif
    return heard;
    """

    @wp.func_native(text)
    def hear_of(i: int, place: wp.uint64) -> wp.vec3f: ...

    return hear_of


@cache
def _field_kernel(dtype, shape: Shape):
    vec3 = wp.types.vector(3, dtype)
    field_of_tile = summed_field(dtype, shape)
    make_passes = passes(dtype, contact_text, False, True)
    hear_of = _heard()

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=_bounds(shape))
    def sum_field_and_contacts(
        # inputs:
        first_tile: int,
        tiles: wp.array2d[int],
        packed: wp.array2d[dtype],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        base: wp.array[vec3],
        nobody: wp.array2d[wp.uint64],
        arrays: ContactArrays,
        # outputs:
        h_out: wp.array[vec3],
    ):
        block = this_block()
        thread = this_thread()
        tile = block - first_tile
        if tile < 0:
            number = wp.static(shape.threads) * block + thread
            if number < wp.static(WAYS) * arrays.balls:
                make_passes(number, 1, wp.static(FORCES), 1, nobody, arrays)
            return
        i = own_target(tile, thread, tiles)
        start = vec3()
        if i >= 0:
            start = base[i]  # here, so that nothing waits for it at the end
        h = field_of_tile(tile, thread, tiles, packed, packed, 1, neighbor, neighbor_count)
        if i >= 0:
            h_out[i] = start + h + dtype(wp.static(INVERSE_4PI)) * hear_of(i, arrays.field)

    return sum_field_and_contacts


@cache
def _wrench_kernel(dtype, quantity: str, shape: Shape):
    vec3 = wp.types.vector(3, dtype)
    sums = wp.types.vector(WIDTHS[quantity], dtype)
    correct, store = wrench_functions(dtype, quantity)
    share_of = target_share(shape)
    sum_pairs = pair_summation(dtype, quantity, shape)
    make_passes = passes(dtype, contact_text, True, True)
    hear_of = _heard()

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=_bounds(shape))
    def sum_wrench_and_contacts(
        # inputs:
        first_tile: int,
        tiles: wp.array2d[int],
        packed: wp.array2d[dtype],
        moments: wp.array2d[dtype],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        external_field: wp.array[vec3],
        twisted: wp.array[int],
        contact_twisted: wp.array[int],
        nobody: wp.array2d[wp.uint64],
        arrays: ContactArrays,
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        block = this_block()
        thread = this_thread()
        tile = block - first_tile
        if tile < 0:
            number = wp.static(shape.threads) * block + thread
            if number < wp.static(WAYS) * arrays.balls:
                make_passes(number, 1, wp.static(FORCES + 2), 1, nobody, arrays)
            return
        correction = sums()
        i, share = share_of(tile, thread, tiles)
        if i >= 0:
            begin = tiles[tile, 3]
            end = tiles[tile, 4]
            correction = correct(
                packed, moments, i, begin, end, neighbor, neighbor_count, share, wp.static(shape.shares)
            )
        total = sum_pairs(tile, thread, tiles, packed, packed, moments, correction)
        i = own_target(tile, thread, tiles)
        if i >= 0:
            pull = hear_of(i, arrays.pulled)
            for k in range(3):
                total[k] += pull[k]
            if wp.static(quantity == WRENCH):
                if contact_twisted[i] == 1:
                    h = hear_of(i, arrays.field)
                    for k in range(3):
                        total[wp.static(WIDTHS[quantity] - 3) + k] += h[k]
            store(i, total, moments, external_field, twisted, force_out, torque_out)

    return sum_wrench_and_contacts


def fits(count: int, dtype, device) -> bool:
    """Whether ``count`` balls may go in one launch; packets are of float32, and read at once from Volta on."""
    return device.is_cuda and device.arch >= 70 and dtype is wp.float32 and WAYS * count <= _PLACES * device.sm_count


def _first_tile(b: NearContactBuffers, shape: Shape) -> int:
    """Blocks that make passes."""
    return -(-WAYS * b.balls // shape.threads)


def launch_field(rows, moments, base, h, b: NearContactBuffers):
    """Write the field of the moments at each other, with that of near contacts, on top of a given one.

    Args:
        rows: Work list, ``rows.fused``.
        moments: Packed moments with their overlapping neighbours (``warpmag.packed.PackedMoments``).
        base: Field to start from [A/m], shape [n].
        h: Out, field [A/m], shape [n]; only the targets of ``rows`` are written.
        b: The buffers.
    """
    first_tile = _first_tile(b, rows.shape)
    near = [moments.overlaps, moments.overlap_counts]
    wp.launch(
        _field_kernel(moments.dtype, rows.shape),
        dim=(first_tile + rows.tiles.shape[0]) * rows.shape.threads,
        inputs=[first_tile, rows.tiles, moments.packed, *near, base, None, b.given],
        outputs=[h],
        block_dim=rows.shape.threads,
        device=moments.device,
    )


def launch_wrench(passes, moments, external_field, twisted, forces, torques, b: NearContactBuffers):
    """Write the force and the torque on each moment, with those of near contacts, Kelvin's law.

    Args:
        passes: Work lists of forces or of wrenches, all of them ``fused``, for moments that differ.
        moments: Packed moments with their overlapping neighbours (``warpmag.packed.PackedMoments``).
        external_field: Applied field [A/m], shape [n].
        twisted: Whether a moment feels its torque m × H, shape [n].
        forces: Out, forces [N], shape [n].
        torques: Out, torques about each moment [N·m], shape [n].
        b: The buffers.
    """
    near = [moments.overlaps, moments.overlap_counts, external_field, twisted, b.arrays["twisted"]]
    for k, rows in enumerate(passes):
        first_tile = 0 if k else _first_tile(b, rows.shape)  # the others hear what the first launch has told
        wp.launch(
            _wrench_kernel(moments.dtype, rows.quantity, rows.shape),
            dim=(first_tile + rows.tiles.shape[0]) * rows.shape.threads,
            inputs=[first_tile, rows.tiles, moments.packed, moments.moments, *near, None, b.given],
            outputs=[forces, torques],
            block_dim=rows.shape.threads,
            device=moments.device,
        )
