"""Work lists of the sums over pairs: target rows, and tiles of some rows and some sources.

Segments say which range of packed targets has which range of packed sources; the targets of all of them, one after the
other, are the target rows. A tile is a row of ``TILE_COLUMNS`` integers, see ``pair_terms``.
"""

import math
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np
import warp as wp

from warpmag.kernels.pairs.pair_terms import TILE_COLUMNS
from warpmag.kernels.pairs.sums_cuda import LoopShape, choose_splits
from warpmag.kernels.shared.team import MOST_THREADS, threads_for

PAIRS_PER_THREAD = 400_000
"""Pairs that make another thread worth waking, which takes 50 to 100 µs: in these a thread sums half of them."""
_LEAST_SHARE = 50_000
"""Pairs of a share, of several blocks if they are few."""
_TILE_BYTES = 2560
"""Of a component of the sources, and of targets that are sources, too, that a CPU keeps in its first-level cache."""
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
    sizes, starts, segments = segments[:, 1] - segments[:, 0], row_starts(segments), segments.astype(np.int32)
    target = np.arange(starts[-1], dtype=np.int32) + np.repeat(segments[:, 0] - starts[:-1].astype(np.int32), sizes)
    rows = target, np.repeat(segments[:, 2], sizes), np.repeat(segments[:, 3], sizes)
    return [wp.array(values, dtype=wp.int32, device=device) for values in rows]


def row_starts(segments):
    """First target row of each segment, and the end."""
    return np.concatenate([[0], np.cumsum(segments[:, 1] - segments[:, 0])])


def block_tiles(segments, width: int, splits: int = 1):
    """Tiles of at most ``width`` targets, each for every one of ``splits`` parts of the sources."""
    starts = row_starts(segments)
    counts = -(-np.diff(starts) // width)
    of = np.repeat(np.arange(len(segments)), counts)
    within = width * (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts))
    first, _, begin, end = segments[of].T[:, :, None]
    cuts = begin + (end - begin) * np.arange(splits + 1) // splits
    tiles = np.zeros((len(of), splits, TILE_COLUMNS), np.int64)
    columns = (starts[of] + within, np.minimum(starts[of] + within + width, starts[of + 1]), first[:, 0] + within)
    for column, values in enumerate((*(one[:, None] for one in columns), cuts[:, :-1], cuts[:, 1:], np.arange(splits))):
        tiles[..., column] = values
    return tiles.reshape(-1, TILE_COLUMNS)


def loop_tiles(segments, shape: LoopShape, multiprocessors: int):
    """Tiles of the looped sums on a GPU, each for one part of the sources; and the number of these."""
    width = 32 * shape.targets
    longest = int(np.max(segments[:, 3] - segments[:, 2], initial=0))
    splits = choose_splits(shape, len(block_tiles(segments, width)), longest, multiprocessors)
    return block_tiles(segments, width, splits), splits


def tile_size(dtype) -> int:
    """Most sources that a CPU loads at a time, and most targets of a tile that stands for its mirror image, too."""
    return _TILE_BYTES // wp.types.type_size_in_bytes(dtype)


def cpu_tiles(segments, mutual: bool, dtype):
    """Tiles of a CPU; where each share of them begins; the number of partial sums; and threads to take shares.

    A segment of many pairs is cut into blocks, stripes of targets by stripes of sources. Blocks that have targets in
    common write partial sums of their own there. How a segment is cut depends on nothing else, and so does the order in
    which the sums of a target are added up. Threads take shares, which are runs of whole blocks, the largest first.

    Args:
        segments: Integers [k, 4]: target column begin and end, source begin and end.
        mutual: Whether a pair may be summed for both its ends. Then targets among their own sources need the blocks
            above the diagonal only, each standing for its mirror image.
        dtype: Warp scalar type of the sums.
    """
    tiles, begin, parts = _cut(tuple(map(tuple, segments.tolist())), mutual, tile_size(dtype))
    threads = min(threads_for(pair_count(segments), PAIRS_PER_THREAD), max(len(begin) - 1, 1))
    return tiles, begin, parts, threads


def tiles_of_rank(tiles, begin, ranks):
    """Tiles of one of several processes, and where each share of them begins: every so manieth share of all.

    Shares are sorted by size, so that each process has as much to do.
    """
    own = range(ranks.rank, len(begin) - 1, ranks.size)
    pieces = [tiles[begin[share] : begin[share + 1]] for share in own]
    return np.concatenate([tiles[:0], *pieces]), np.cumsum([0, *map(len, pieces)])


@lru_cache(maxsize=4)
def _cut(segments, mutual: bool, most: int):
    """Tiles, where each share begins, and the number of partial sums; kept for one-shot calls that repeat."""
    starts = row_starts(np.array(segments, np.int64).reshape(-1, 4)).tolist()
    blocks, written = [], []
    for segment, row in zip(segments, starts[:-1], strict=True):
        found, parts = _cut_segment(segment, row, mutual, most)
        blocks += found
        written.append(parts)
    parts = max([1, *written])
    blocks.sort(key=lambda block: block[0], reverse=True)
    blocks += [(0, [tile]) for tile in _idle_rows(starts, written, parts)]
    begin, tiles, begun = [], [], 0
    for work, block in blocks:
        if not begin or begun >= _LEAST_SHARE:
            begin.append(len(tiles))
            begun = 0
        begun += work
        tiles += block
    return np.reshape(np.array(tiles, np.int32), (-1, TILE_COLUMNS)), [*begin, len(tiles)], parts


def _cut_segment(segment, row, mutual, most):
    """Work and tiles of the blocks of a segment whose first target has a given row, and the number of partial sums."""
    t0, t1, s0, s1 = segment
    count, shift, parts, blocks = t1 - t0, row - t0, 0, []
    pairs = count * (s1 - s0)
    busy = min(pairs // PAIRS_PER_THREAD, MOST_THREADS)
    whole, grain = busy < 2, pairs / (2 * max(busy, 1))
    rest = [(s0, s1)]
    if mutual and s0 <= t0 and t1 <= s1:
        # as wide as makes two blocks for each thread, one on the diagonal being half of another
        wanted = 1 if whole or count**2 <= grain else 2 * math.ceil(count / math.sqrt(2.0 * grain))
        stripes = _stripes(t0, t1, wanted)
        cut = [_stripes(*ends, -(-(ends[1] - ends[0]) // most)) for ends in stripes]
        blocks = [_square(shift, cut, a, b) for a in range(len(cut)) for b in range(a, len(cut))]
        parts, rest = len(stripes), [(s0, t0), (t1, s1)]
    for j0, j1 in rest:
        wanted = 1 if whole else math.ceil(count * (j1 - j0) / grain)
        rows = max(min(wanted, count // _LEAST_TARGETS), 1)
        edges = [t0 + count * k // rows for k in range(rows + 1)]
        sources = _stripes(j0, j1, -(-wanted // rows))
        part = 0 if whole else parts
        blocks += [
            ((i1 - i0) * (end - begin), [(i0 + shift, i1 + shift, i0, begin, end, part + k, 0, 0)])
            for k, (begin, end) in enumerate(sources)
            for i0, i1 in pairwise(edges)
        ]
        parts += len(sources)
    if whole and blocks:  # in one block, and in one partial sum
        return [(sum(work for work, _ in blocks), [tile for _, block in blocks for tile in block])], 1
    return blocks, parts


def _idle_rows(starts, written, parts):
    """Tiles without sources, for the partial sums that no block of a row's segment writes."""
    idle = [
        (begin, end, 0, 0, 0, part, 0, 0)
        for part in range(min(written, default=parts), parts)
        for (begin, end), own in zip(pairwise(starts), written, strict=True)
        if own <= part
    ]
    joined = idle[:1]
    for tile in idle[1:]:
        last = joined[-1]
        if last[5] == tile[5] and last[1] == tile[0]:
            joined[-1] = (last[0], *tile[1:])
        else:
            joined.append(tile)
    return joined


def _square(shift, stripes, a, b):
    """Work and tiles of targets in stripe a and sources in stripe b, on or above the diagonal.

    Stripes are cut into ranges of a tile's width; ``shift`` leads from columns to rows.
    """
    targets, sources = stripes[a], stripes[b]
    tiles = [
        (i0 + shift, i1 + shift, i0, j0, j1, b, 1, a) for i0, i1 in targets for j0, j1 in sources if a < b or i0 <= j0
    ]
    pairs = (targets[-1][1] - targets[0][0]) * (sources[-1][1] - sources[0][0])
    return pairs if a == b else 2 * pairs, tiles


def pair_count(segments) -> int:
    """Pairs of a target and a source."""
    return int(np.sum((segments[:, 1] - segments[:, 0]) * (segments[:, 3] - segments[:, 2])))


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
