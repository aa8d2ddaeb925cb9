"""Work lists of the sums over pairs: target rows, and tiles of some rows and some sources.

Segments say which range of packed targets has which range of packed sources; the targets of all of them, one after the
other, are the target rows. A tile is a row of ``TILE_COLUMNS`` integers, see ``pair_terms``.
"""

import math
from functools import cache
from itertools import pairwise

import numpy as np
import warp as wp

from warpmag.kernels.pairs.pair_terms import TILE_COLUMNS
from warpmag.kernels.pairs.sums_cuda import LoopShape, choose_splits
from warpmag.kernels.shared.team import MOST_THREADS, threads_for

_PAIRS_PER_START = 200_000
"""Pairs that a CPU sums while another of its threads wakes: 50 to 100 µs."""
TILE_SIZE = 640
"""Most sources of a tile of a CPU, and most targets if it stands for its mirror image, too."""
_LEAST_TARGETS = 32
"""Targets that are worth loading a tile of sources for."""
_LANES = 16
"""Width of the widest vectors: a stripe of a multiple of it wastes none."""


def target_rows(segments, device):
    """Packed column, first source and end of the sources of each target row, Warp arrays.

    Args:
        segments: Integers [k, 4]: target column begin and end, source begin and end.
        device: Warp device.
    """
    sizes, starts = segments[:, 1] - segments[:, 0], row_starts(segments)
    target = np.arange(starts[-1]) + np.repeat(segments[:, 0] - starts[:-1], sizes)
    rows = target, np.repeat(segments[:, 2], sizes), np.repeat(segments[:, 3], sizes)
    return [wp.array(values, dtype=wp.int32, device=device) for values in rows]


def row_starts(segments):
    """First target row of each segment, and the end."""
    return np.concatenate([[0], np.cumsum(segments[:, 1] - segments[:, 0])])


def block_tiles(segments, width: int, splits: int = 1):
    """Tiles of at most ``width`` targets, each for every one of ``splits`` parts of the sources."""
    starts = row_starts(segments)
    tiles = [
        (row, min(row + width, starts[k + 1]), t0 + row - starts[k], *source, split, 0, 0)
        for k, (t0, _, s0, s1) in enumerate(segments)
        for row in range(starts[k], starts[k + 1], width)
        for split, source in enumerate(pairwise(s0 + (s1 - s0) * np.arange(splits + 1) // splits))
    ]
    return np.array(tiles, np.int64)


def loop_tiles(segments, shape: LoopShape, multiprocessors: int):
    """Tiles of the looped sums on a GPU, each for one part of the sources; and the number of these."""
    width = 32 * shape.targets
    longest = int(np.max(segments[:, 3] - segments[:, 2], initial=0))
    splits = choose_splits(shape, len(block_tiles(segments, width)), longest, multiprocessors)
    return block_tiles(segments, width, splits), splits


def cpu_tiles(segments):
    """Tiles of a CPU; where each share of them begins; the number of partial sums; and threads to take shares.

    Pairs are cut into blocks, stripes of targets by stripes of sources, two for each thread that they could keep busy.
    Targets among their own sources need the blocks above the diagonal only, each standing for its mirror image. Blocks
    that have targets in common write partial sums of their own there. How pairs are cut depends on the segments alone,
    and so does the order in which the sums of a target are added up. Threads take shares, which are runs of whole
    blocks, the largest first.
    """
    pairs = pair_count(segments)
    busy = min(pairs // (2 * _PAIRS_PER_START), MOST_THREADS)
    grain = pairs / (2 * busy) if busy > 1 else np.inf
    starts = row_starts(segments).tolist()
    cut = [_cut_segment(segment, row, grain) for segment, row in zip(segments.tolist(), starts[:-1], strict=True)]
    blocks = [block for found in cut for block in found] + _idle_rows(cut, np.diff(starts))
    blocks.sort(key=_work, reverse=True)
    work = np.array([_work(block) for block in blocks])
    # blocks of a quarter of the usual size or less go together
    _, first = np.unique((np.cumsum(work) - 0.5 * work) // (0.25 * grain), return_index=True)
    begin = np.cumsum([0, *map(len, blocks)])
    tiles = np.array([tile for block in blocks for tile in block], np.int64).reshape(-1, TILE_COLUMNS)
    threads = min(threads_for(pairs, 2 * _PAIRS_PER_START), max(len(first), 1))
    return tiles, begin[[*first, -1]], 1 + int(tiles[:, [5, 7]].max(initial=0)), threads


def _cut_segment(segment, row, grain):
    """Blocks of about ``grain`` pairs, each a list of tiles, of a segment that has its first target in ``row``."""
    t0, t1, s0, s1 = segment
    count, shift, part, blocks = t1 - t0, row - t0, 0, []
    whole = count * (s1 - s0) <= grain  # in one block, and in one partial sum
    rest = [(s0, s1)]
    if s0 <= t0 and t1 <= s1:
        # half as wide as two for each thread would be, of which all but the diagonal count twice: these fill gaps
        stripes = _stripes(t0, t1, 1 if whole else 2 * math.ceil(count / math.sqrt(2.0 * grain)))
        blocks = [
            _block(shift, stripes[a], stripes[b], b, a) for a in range(len(stripes)) for b in range(a, len(stripes))
        ]
        part, rest = len(stripes), [(s0, t0), (t1, s1)]
    for j0, j1 in rest:
        wanted = 1 if whole else math.ceil(count * (j1 - j0) / grain)
        rows = max(min(wanted, count // _LEAST_TARGETS), 1)
        edges = [t0 + count * k // rows for k in range(rows + 1)]
        sources = _stripes(j0, j1, -(-wanted // rows))
        blocks += [
            _block(shift, targets, ends, 0 if whole else part + k)
            for k, ends in enumerate(sources)
            for targets in pairwise(edges)
        ]
        part += len(sources)
    return [[tile for block in blocks for tile in block]] if whole else blocks


def _idle_rows(cut, counts):
    """Blocks without sources, for partial sums that no block of a row's segment writes."""
    written = [1 + max((max(tile[5], tile[7]) for block in found for tile in block), default=-1) for found in cut]
    written = np.repeat(written, counts)
    return [
        [(begin, end, 0, 0, 0, part, 0, 0)]
        for part in range(max([1, *written]))
        for begin, end in np.flatnonzero(np.diff(written <= part, prepend=False, append=False)).reshape(-1, 2).tolist()
    ]


def _block(shift, targets, sources, part, mirror_part=None):
    """Tiles of some targets and some sources, and what they are added to; ``shift`` leads from columns to rows."""
    mirrored = mirror_part is not None
    return [
        (i0 + shift, i1 + shift, i0, j0, j1, part, int(mirrored), mirror_part or 0)
        for i0, i1 in (_short_stripes(*targets) if mirrored else [targets])
        for j0, j1 in _short_stripes(*sources)
        if not mirrored or i0 <= j0
    ]


def _work(block) -> int:
    """Pairs of a block, with those of mirror images."""
    return sum((t[1] - t[0]) * (t[4] - t[3]) * (2 if t[6] and t[2] < t[3] else 1) for t in block)


def pair_count(segments) -> int:
    """Pairs of a target and a source."""
    return int(np.sum((segments[:, 1] - segments[:, 0]) * (segments[:, 3] - segments[:, 2])))


def _short_stripes(begin, end):
    """Ranges of at most ``TILE_SIZE``, about equal."""
    return _stripes(begin, end, -(-(end - begin) // TILE_SIZE))


def _stripes(begin, end, wanted):
    """At most so many ranges that cut one into equal parts, of a multiple of ``_LANES``."""
    width = max(-(-(end - begin) // (max(wanted, 1) * _LANES)), 1) * _LANES
    return [(a, min(a + width, end)) for a in range(begin, end, width)]


@cache
def arrays_type(dtype):
    """Struct of what sums over pairs are made from and of what becomes of them, see ``evaluate``."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class EvaluationArrays:
        target: wp.array[int]
        begin: wp.array[int]
        end: wp.array[int]
        tiles: wp.array2d[int]
        targets: wp.array2d[dtype]
        sources: wp.array2d[dtype]
        same_set: int
        effective: wp.array2d[dtype]
        partial: wp.array3d[dtype]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        base: wp.array[vec3]
        turned: wp.array[int]
        out: wp.array[vec3]
        torques: wp.array[vec3]
        shares: wp.array[int]

    return EvaluationArrays
