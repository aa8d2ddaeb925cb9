"""Work lists whose entries belong to worlds: entries of worlds that rest become empty, or are not listed."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _leave_out(
    whole_in: wp.array2d[int],
    world_in: wp.array[int],
    resting_in: wp.array[int],
    column: int,
    begin: int,
    empty: int,
    entries_out: wp.array2d[int],
):
    entry = wp.tid()
    end = whole_in[entry, column]
    if resting_in[world_in[entry]] != 0:
        end = empty
        if begin >= 0:
            end = whole_in[entry, begin]
    entries_out[entry, column] = end


def record_leave_out(whole, world, resting, column: int, entries, *, begin: int = -1, empty: int = 0) -> wp.Launch:
    """Return a launch that empties the entries of resting worlds, and restores those of other worlds.

    Args:
        whole: All entries, shape [entries, columns].
        world: World of each entry, shape [entries].
        resting: Not 0 for worlds that rest, shape [worlds].
        column: Column that holds the end of a range, or the number of its items.
        entries: Out, the list that is read; only ``column`` is written.
        begin: Column that holds the begin of the range, which is written to ``column``; -1 to write ``empty``.
        empty: Value of ``column`` in an empty entry without a begin.
    """
    inputs = [whole, world, resting, column, begin, empty]
    return wp.launch(_leave_out, len(whole), inputs, outputs=[entries], device=entries.device, record_cmd=True)


@wp.kernel
def _list_active(world_in: wp.array[int], resting_in: wp.array[int], active_out: wp.array[int]):
    item = wp.tid()
    if resting_in[world_in[item]] == 0:
        active_out[wp.atomic_add(active_out, 0, 1) + 1] = item


def record_list_active(world, resting, active) -> wp.Launch:
    """Return a launch that lists the items of worlds that do not rest, in any order.

    Args:
        world: World of each item, shape [items].
        resting: Not 0 for worlds that rest, shape [worlds].
        active: Out, number of listed items, which must be 0 before, then the items, shape [items + 1].
    """
    inputs = [world, resting]
    return wp.launch(_list_active, len(world), inputs, outputs=[active], device=active.device, record_cmd=True)
