"""Worlds that start again: masks of worlds, and rows of arrays that return to earlier values."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _complete_mask(mask_in: wp.array[wp.bool], mask_out: wp.array[wp.bool]):
    w = wp.tid()
    last = mask_out.shape[0] - 1
    chosen = False
    if w < mask_in.shape[0]:
        chosen = mask_in[w]
    if w == 1 and last == 1:  # the only world also owns what is outside all worlds
        chosen = chosen or mask_in[0]
    mask_out[w] = chosen


def complete_mask(mask, full_mask):
    """Write a mask of worlds with Newton's last entry, for everything outside all worlds.

    Args:
        mask: True for chosen worlds, shape [worlds] or [worlds + 1].
        full_mask: Out, shape [worlds + 1]. The last entry is false if ``mask`` has none, except in a single world.
    """
    wp.launch(_complete_mask, len(full_mask), inputs=[mask], outputs=[full_mask], device=full_mask.device)


@wp.func
def is_chosen(mask: wp.array[wp.bool], world: int) -> bool:
    """Return true if a complete mask chooses a world; -1 stands for outside all worlds."""
    return mask[wp.where(world < 0, mask.shape[0] - 1, world)]


@wp.kernel
def _choose(mask_in: wp.array[wp.bool], world_in: wp.array[wp.int32], chosen_out: wp.array[wp.int32]):
    i = wp.tid()
    chosen_out[i] = wp.where(is_chosen(mask_in, world_in[i]), 1, 0)


def choose(mask, world, chosen):
    """Write 1 to ``chosen`` for each entry of ``world`` that a complete mask chooses, else 0."""
    wp.launch(_choose, len(chosen), inputs=[mask, world], outputs=[chosen], device=chosen.device)


@wp.kernel
def _number_worlds(number_in: wp.array[wp.int32], world_in: wp.array[wp.int32], number_out: wp.array[wp.int32]):
    i = wp.tid()
    number_out[i] = number_in[world_in[i]]


def number_worlds(numbers, world) -> wp.array:
    """Return the number of each world in ``world``, shape [n], from those of all worlds."""
    result = wp.empty_like(world)
    wp.launch(
        _number_worlds, len(world), inputs=[numbers, world], outputs=[result], device=world.device, record_tape=False
    )
    return result


@wp.kernel
def _restore_rows(
    mask_in: wp.array[wp.bool],
    world_in: wp.array[wp.int32],
    saved_in: wp.array2d[wp.uint8],
    rows_out: wp.array2d[wp.uint8],
):
    row, byte = wp.tid()
    if is_chosen(mask_in, world_in[row]):
        rows_out[row, byte] = saved_in[row, byte]


def restore_rows(mask, world, saved, rows):
    """Copy the rows of chosen worlds from one array of bytes, shape [rows, bytes], to another one.

    Args:
        mask: True for chosen worlds, complete, shape [worlds + 1].
        world: World of each row, -1 for outside all worlds, shape [rows].
        saved: The values to copy.
        rows: In and out.
    """
    wp.launch(_restore_rows, rows.shape, inputs=[mask, world, saved], outputs=[rows], device=rows.device)
