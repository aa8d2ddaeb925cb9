"""All-pairs loops: field, and force, of packed moments at packed targets.

Moments travel packed, one scalar row per component, so that one layout serves vector loads on a CPU and coalesced
loads on a GPU:

| packed row | 0 1 2 | 3 | 4 5 6 | 7 |
|---|---|---|---|---|
| content | position [m] | radius [m] | moment [A·m²] | body label |

A ``Rows`` object says which target sees which contiguous range of sources, and what is summed over them (quantities of
``pair_terms``): 4π times the field H [A/m], or 4π times (e·∇)H [A²] for an effective moment e of the target, or both,
the latter first. There are the plain Warp loop, readable, exact for overlapping balls, and kept as the reference; and
native code, which evaluates the dipole clamped at contact (see ``pair_law``) and leaves overlapping pairs to
``neighbors``. Sums leave in ``partial`` rows, several per target where threads or blocks share out the pairs; the
caller's finishing kernel adds them up in a fixed order, so that results do not depend on scheduling. On a GPU there are
three forms, of which ``Rows`` holds the fastest that a caller allows:

| form | native code | for |
|---|---|---|
| ``FUSED`` | ``fused_cuda`` | few moments: no loop, the kernel that needs the sums makes them itself |
| ``MIRRORED`` | ``mirror_cuda`` | many moments among themselves: each pair is met once, for both of its ends |
| ``LOOP`` | ``sums_cuda``, ``sums_cpu`` | anything |
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import warp as wp

from warpmag.kernels.pairs import fused_cuda as pair_sums_cuda
from warpmag.kernels.pairs import mirror_cuda as pair_mirror_cuda
from warpmag.kernels.pairs.pair_law import field_of, gradient_of, gradient_times, pair_factors, smoothed_factors
from warpmag.kernels.pairs.pair_terms import TILE_COLUMNS, WIDTHS, Quantity
from warpmag.kernels.pairs.sums_cpu import TILE_SIZE, launch_pair_loop_cpu
from warpmag.kernels.pairs.sums_cuda import LoopShape, choose_loop_shape, choose_splits, launch_pair_loop_cuda
from warpmag.kernels.shared.team import threads_for

PACKED_ROWS = 8
PITCH = 128
"""Packed rows are a multiple of so many moments apart, and as many of nothing follow the last, for vector loads."""
EXCLUDE_NOTHING, EXCLUDE_SELF, EXCLUDE_BODY = 0, 1, 2
"""Sources that a loop leaves out: none, the target itself, or everything with the target's body label."""
LOOP, FUSED, MIRRORED = FORMS = "loop", "fused", "mirrored"
"""How sums are made: by a loop that goes before the kernel that needs them; by that kernel itself; by a loop that meets
each pair of moments once, for both of its ends."""

# Measured on an H200: the most targets for which the fused form is best, and the fewest for which the mirrored is.
_MOST_FUSED = {Quantity.FIELD: 7000, Quantity.FORCE: 2640, Quantity.MUTUAL_FORCE: 2640, Quantity.WRENCH: 2640}
_LEAST_MIRRORED = {Quantity.FIELD: 5281, Quantity.MUTUAL_FORCE: 2641}
_LEAST_MUTUAL = 0.75
"""Least part of the sources that are targets, for both ends of a pair to be worth what the mirrored form costs."""

_PAIRS_PER_START = 200_000
"""Pairs that a CPU sums while another of its threads wakes: 50 to 100 µs."""
_TILES_PER_THREAD = 16
"""Tiles that a thread should have, so that they can be shared out evenly."""
_ROUNDS, _MOST_SHARES = 3, 12
"""Shares of a thread, each round of them half as large as the one before; unless there are so many threads that adding
up their sums would take longer than waiting for each other."""
_LANES = 16
"""Width of the widest vectors: a stripe of a multiple of it wastes none."""


@dataclass(frozen=True)
class Rows:
    """Which target rows see which sources, on one device.

    Attributes:
        quantity: What is summed: ``FIELD``, ``FORCE`` or ``WRENCH``, on a CPU also ``MUTUAL_FORCE``.
        count: Number of target rows.
        target: Packed column of each target row, shape [count].
        begin: First source of each target row, shape [count].
        end: One past the last source of each target row, shape [count].
        tiles: Work list of the native loop, see ``pair_terms``, shape [tiles, TILE_COLUMNS].
        shares: On a CPU the tile at which each share begins, and the end, shape [splits + 1].
        threads: On a CPU the threads that take them.
        form: How the sums are made: ``LOOP``, ``FUSED`` or ``MIRRORED``.
        shape: On a GPU the shape of the blocks, one a tile.
        mirror: What takes the tiles' place in the mirrored form.
        splits: Partial sums per target row.
        pair_count: Pairs that the loop evaluates.
    """

    quantity: Quantity
    count: int
    target: wp.array
    begin: wp.array
    end: wp.array
    tiles: wp.array
    shares: wp.array
    threads: int
    form: str
    shape: pair_sums_cuda.FusedShape | LoopShape | None
    mirror: pair_mirror_cuda.Mirror | None
    splits: int
    pair_count: int

    @property
    def fused(self) -> bool:
        """Whether the kernel that needs the sums makes them itself, so that no loop goes before it."""
        return self.form == FUSED


def make_rows(segments, device, quantity=Quantity.FIELD, *, forms=FORMS) -> Rows:
    """Build the work list of target ranges that each see one source range.

    Args:
        segments: Integers [k, 4]: target column begin and end, source begin and end.
        device: Warp device.
        quantity: What is to be summed.
        forms: Ways in which the sums may be made. ``MIRRORED`` is for targets that are most of one range of sources,
            and brings the sums of the rest, too; ``FUSED`` for kernels that call ``fused_cuda`` themselves. A CPU
            has a ``LOOP`` only.
    """
    segments = np.asarray(segments, np.int64).reshape(-1, 4)
    device = wp.get_device(device)
    form = _choose_form(segments, quantity, forms) if device.is_cuda else LOOP
    if form == MIRRORED:
        segments = segments[:1, [2, 3, 2, 3]]
    sizes = segments[:, 1] - segments[:, 0]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    count = int(starts[-1])
    within = np.arange(count) - np.repeat(starts[:-1], sizes)
    target = np.repeat(segments[:, 0], sizes) + within
    begin, end = np.repeat(segments[:, 2], sizes), np.repeat(segments[:, 3], sizes)
    pair_count = int(np.sum(sizes * (segments[:, 3] - segments[:, 2])))

    shape, mirror, tiles, shares, threads = None, None, np.zeros(0), np.zeros(0), 1
    if form == MIRRORED:
        mirror = pair_mirror_cuda.make_mirror(int(segments[0, 0]), count, quantity, device)
        splits = mirror.slabs + mirror.splits
    if quantity == Quantity.MUTUAL_FORCE and device.is_cuda:
        quantity = Quantity.FORCE
    if form == FUSED:
        shape = pair_sums_cuda.choose_fused_shape(quantity, count)
        tiles, splits = _block_tiles(segments, starts, shape.targets, 1), 0
    elif form == LOOP and device.is_cuda:
        shape = choose_loop_shape(quantity, count)
        tiles, splits = _cuda_tiles(segments, starts, shape, device.sm_count)
    elif form == LOOP:
        threads = threads_for(pair_count, 2 * _PAIRS_PER_START)
        tiles, shares = _cpu_tiles(segments, starts, threads)
        splits = len(shares) - 1

    def to_device(a):
        return wp.array(a.astype(np.int32), dtype=wp.int32, device=device)

    return Rows(
        quantity=quantity,
        count=count,
        target=to_device(target),
        begin=to_device(begin),
        end=to_device(end),
        tiles=to_device(tiles.reshape(-1, TILE_COLUMNS)),
        shares=to_device(shares),
        threads=threads,
        form=form,
        shape=shape,
        mirror=mirror,
        splits=splits,
        pair_count=pair_count,
    )


def _choose_form(segments, quantity, forms) -> str:
    """Form of the sums on a GPU, the fastest of those that may be."""
    count = int(np.sum(segments[:, 1] - segments[:, 0]))
    if MIRRORED in forms and quantity in _LEAST_MIRRORED and _are_mutual(segments, count):
        if count >= _LEAST_MIRRORED[quantity] or len(forms) == 1:
            return MIRRORED
    if FUSED in forms and (count <= _MOST_FUSED[quantity] or LOOP not in forms):
        return FUSED
    return LOOP


def _are_mutual(segments, count: int) -> bool:
    """Whether ``count`` targets are most of the only range of sources, so that both ends of most pairs are wanted."""
    if count == 0 or (segments[:, 2:] != segments[0, 2:]).any():
        return False
    begin, end = segments[0, 2:]
    inside = segments[:, 0].min() >= begin and segments[:, 1].max() <= end
    return bool(inside and count >= _LEAST_MUTUAL * (end - begin))


def _cuda_tiles(segments, starts, shape: LoopShape, multiprocessors: int):
    """Tiles of as many targets as a block holds, each for every part of the sources; and the number of parts."""
    width = 32 * shape.targets
    sizes = segments[:, 1] - segments[:, 0]
    longest = int(np.max(segments[:, 3] - segments[:, 2], initial=0))
    splits = choose_splits(shape, int(np.sum(-(-sizes // width))), longest, multiprocessors)
    return _block_tiles(segments, starts, width, splits), splits


def _block_tiles(segments, starts, width: int, splits: int):
    """Tiles of at most ``width`` targets, each for every part of the sources."""
    tiles = [
        (row, min(row + width, starts[k + 1]), t0 + row - starts[k], *source, split, 0, 0)
        for k, (t0, _, s0, s1) in enumerate(segments)
        for row in range(starts[k], starts[k + 1], width)
        for split, source in enumerate(_cut(s0, s1, splits))
    ]
    return np.array(tiles, np.int64)


def _cpu_tiles(segments, starts, threads: int):
    """Tiles of stripes of targets and stripes of sources; and where each share of them begins.

    Targets among their own sources need the tiles above the diagonal only, each standing for its mirror image.
    """
    tiles, work = [], []
    for (t0, t1, s0, s1), row in zip(segments, starts, strict=False):
        among = s0 <= t0 and t1 <= s1
        for j0, j1 in ((t0, t1), (s0, t0), (t1, s1)) if among else ((s0, s1),):
            mirrored = (t0, t1) == (j0, j1)
            wanted = int(np.ceil(np.sqrt((2 if mirrored else 1) * _TILES_PER_THREAD * threads)))
            targets, sources = (_stripes(*ends, wanted if threads > 1 else 1) for ends in ((t0, t1), (j0, j1)))
            for a, (i0, i1) in enumerate(targets):
                for b, (j0, j1) in enumerate(sources):
                    if not mirrored or a <= b:
                        tiles.append((row + i0 - t0, row + i1 - t0, i0, j0, j1, 0, mirrored, 0))
                        work.append((i1 - i0) * (j1 - j0) * (2.0 if mirrored and a < b else 1.0))
    rounds = int(np.clip(_MOST_SHARES // threads, 1, _ROUNDS)) if threads > 1 else 1
    sizes = np.repeat(0.5 ** np.arange(rounds), threads)
    # a tile goes to the share in which its middle lies
    done = np.concatenate([[0.0], np.cumsum(work)])
    ends = np.searchsorted((done[:-1] + done[1:]) / 2.0, done[-1] * np.cumsum(sizes)[:-1] / sizes.sum())
    return np.array(tiles, np.int64), np.concatenate([[0], ends, [len(tiles)]])


def _cut(begin, end, parts):
    """Ranges that cut one into equal parts."""
    return list(pairwise(begin + (end - begin) * np.arange(parts + 1) // parts))


def _stripes(begin, end, wanted):
    """Ranges of at most ``TILE_SIZE`` that cut one into about as many equal parts as wanted, or more."""
    parts = max(wanted, -(-(end - begin) // TILE_SIZE), 1)
    width = max(-(-(end - begin) // (parts * _LANES)) * _LANES, _LANES)
    return [(a, min(a + width, end)) for a in range(begin, end, width)]


# ---------------------------------------------------------------------------------------------------------------------
# Reference loop
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _reference_kernel(dtype, quantity: Quantity):
    vec3 = wp.types.vector(3, dtype)
    summed_field, summed_force = quantity in (Quantity.FIELD, Quantity.WRENCH), quantity != Quantity.FIELD

    @wp.kernel(module="unique", enable_backward=False)
    def pair_loop_reference(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        exclude: int,
        epsilon2: dtype,
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        row = wp.tid()
        i = row_target[row]
        x = vec3(targets[0, i], targets[1, i], targets[2, i])
        radius = targets[3, i]
        label = targets[7, i]
        e = vec3()
        if wp.static(summed_force):
            e = vec3(effective[0, i], effective[1, i], effective[2, i])
        h = vec3()
        f = vec3()
        for j in range(row_begin[row], row_end[row]):
            left_out = (exclude == 1 and i == j) or (exclude == 2 and label == sources[7, j])
            if not left_out:
                r = x - vec3(sources[0, j], sources[1, j], sources[2, j])
                m = vec3(sources[4, j], sources[5, j], sources[6, j])
                d2 = wp.dot(r, r)
                g = pair_factors(d2, radius, sources[3, j])
                if epsilon2 > dtype(0.0):
                    g = smoothed_factors(d2, epsilon2)
                if wp.static(summed_field):
                    h += field_of(g, r, m)
                if wp.static(summed_force):
                    f += gradient_times(gradient_of(g, r, m), e)
        for c in range(3):
            if wp.static(summed_force):
                partial_out[0, row, c] = f[c]
            if wp.static(summed_field):
                partial_out[0, row, wp.static(WIDTHS[quantity] - 3) + c] = h[c]

    return pair_loop_reference


# ---------------------------------------------------------------------------------------------------------------------
# Launch
# ---------------------------------------------------------------------------------------------------------------------


def partial_shape(rows: Rows) -> tuple[int, int, int]:
    """Shape of the ``partial`` array that :func:`launch_pair_loop` fills: splits, target rows, sums."""
    return rows.splits, max(rows.count, 1), WIDTHS[rows.quantity]


def launch_pair_loop(rows: Rows, targets, sources, partial, *, effective=None, reference_exclude=None, epsilon2=0.0):
    """Sum the quantity of ``rows`` of packed sources over the target rows.

    The native loops clamp the distance at contact and leave out pairs of points at the same place. The field leaves
    out the target's own moment, if targets and sources are the same array; a force what bears the target's label.

    Args:
        rows: Work list.
        targets: Packed targets, shape [8, targets].
        sources: Packed sources, shape [8, sources].
        partial: Sums, shape as :func:`partial_shape` says.
        effective: Effective moments e of the targets [A·m²], shape [3, targets]; needed for a force.
        reference_exclude: One of ``EXCLUDE_...`` to run the reference loop, which leaves those sources out and takes
            overlapping pairs exactly; None for the native loop.
        epsilon2: Smoothing ε² [m⁵], reference loop only.
    """
    if rows.count == 0 or rows.form == FUSED:
        return
    device, dtype = partial.device, partial.dtype
    effective = targets if effective is None else effective
    if reference_exclude is not None:
        wp.launch(
            _reference_kernel(dtype, rows.quantity),
            dim=rows.count,
            inputs=[targets, sources, effective, rows.target, rows.begin, rows.end, reference_exclude, dtype(epsilon2)],
            outputs=[partial],
            device=device,
        )
    elif rows.form == MIRRORED:
        pair_mirror_cuda.launch_pair_loop_mirrored(rows.mirror, sources, partial)
    elif device.is_cuda:
        launch_pair_loop_cuda(rows.quantity, rows.shape, targets, sources, effective, rows.tiles, partial)
    else:
        launch_pair_loop_cpu(rows.quantity, targets, sources, effective, rows.tiles, rows.shares, rows.threads, partial)
