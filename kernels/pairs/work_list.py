"""Work lists of the sums over pairs: target rows, and tiles of target rows and sources.

A segment is a range of packed targets with a range of packed sources: begin and end of both, as packed columns. The
targets of all segments, one after the other, are the target rows. A tile is a range of target rows with a range of
sources.
"""

import math
from functools import cache, lru_cache
from itertools import pairwise

import numpy as np
import warp as wp

from warpmag.kernels.pairs.sums_cuda import LoopShape, choose_splits
from warpmag.kernels.shared.copies import put_copies
from warpmag.kernels.shared.team import MOST_THREADS, threads_for

TILE_COLUMNS = 8
"""Columns of a work list, ``TileEntry`` of ``pair_terms.h``: target rows begin and end, packed column of the first
target, sources begin and end, partial sums of the targets, 1 for a mirrored tile, partial sums of its sources. A
mirrored tile also stands for the tile with targets and sources exchanged. A GPU reads a row as two vectors."""
PAIRS_PER_THREAD = 400_000
"""Pairs per thread, at least. Waking a thread takes 50 to 100 µs, the time of half as many pairs."""
_LEAST_SHARE = 50_000  # pairs per share, at least; small blocks are joined into one share
_TILE_BYTES = 2560  # bytes per component of a tile's sources that a CPU keeps in its first-level cache
_LEAST_TARGETS = 32  # targets per tile, at least, so that loading its sources is worthwhile
_LANES = 16  # lanes of the widest vectors; stripes are a multiple of it, so that no lane is idle


def target_rows(segments, device, copies: int = 1):
    """Return the packed column, first source and end of sources of each target row, as Warp arrays.

    The segments are ``copies`` of the first ones, one after the other, as many columns apart.
    """
    count = len(segments) // copies
    step = int(segments[count, 0] - segments[0, 0]) if copies > 1 and count else 0
    part = segments[:count].astype(np.int32)
    sizes, starts = part[:, 1] - part[:, 0], row_starts(part)
    target = np.arange(starts[-1], dtype=np.int32) + np.repeat(part[:, 0] - starts[:-1].astype(np.int32), sizes)
    rows = target, np.repeat(part[:, 2], sizes), np.repeat(part[:, 3], sizes)
    return [put_copies(values, wp.int32, device, copies, step) for values in rows]


def row_starts(segments):
    """Return the first target row of each segment, then the number of target rows."""
    return np.concatenate([[0], np.cumsum(segments[:, 1] - segments[:, 0])])


def block_tiles(segments, width: int, splits: int = 1):
    """Return the tiles of at most ``width`` targets, one for each of ``splits`` parts of the sources."""
    starts = row_starts(segments)
    counts = -(-np.diff(starts) // width)
    segment = np.repeat(np.arange(len(segments)), counts)
    within = width * (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts))
    first, _, begin, end = segments[segment].T[:, :, None]
    cuts = begin + (end - begin) * np.arange(splits + 1) // splits
    tiles = np.zeros((len(segment), splits, TILE_COLUMNS), np.int64)
    row_begin = starts[segment] + within
    row_end = np.minimum(row_begin + width, starts[segment + 1])
    for column, values in enumerate((row_begin, row_end, first[:, 0] + within)):
        tiles[..., column] = values[:, None]
    tiles[..., 3], tiles[..., 4], tiles[..., 5] = cuts[:, :-1], cuts[:, 1:], np.arange(splits)
    return tiles.reshape(-1, TILE_COLUMNS)


def loop_tiles(segments, shape: LoopShape, multiprocessors: int):
    """Return the tiles of ``LOOP`` sums on a GPU, each for one part of the sources, and the number of parts."""
    width = 32 * shape.targets
    longest = int(np.max(segments[:, 3] - segments[:, 2], initial=0))
    splits = choose_splits(shape, len(block_tiles(segments, width)), longest, multiprocessors)
    return block_tiles(segments, width, splits), splits


def tile_size(dtype) -> int:
    """Most sources that a CPU loads at a time, and most targets of a mirrored tile."""
    return _TILE_BYTES // wp.types.type_size_in_bytes(dtype)


def cpu_tiles(segments, mutual: bool, dtype):
    """Return the tiles of a CPU, first tile of each share, number of partial sums, and number of threads.

    A segment of many pairs is cut into blocks: stripes of targets by stripes of sources. Blocks with common targets
    write separate partial sums. The cuts depend on the arguments alone, and so does the order of each sum, whatever the
    number of threads. Threads take shares, which are runs of whole blocks, the largest first.

    If ``mutual``, a pair may be summed for both its moments. Targets among their own sources then need only the blocks
    on and above the diagonal, as mirrored tiles.
    """
    tiles, begin, parts = _cut(tuple(map(tuple, segments.tolist())), mutual, tile_size(dtype))
    threads = min(threads_for(pair_count(segments), PAIRS_PER_THREAD), max(len(begin) - 1, 1))
    return tiles, begin, parts, threads


def tiles_of_rank(tiles, begin, ranks):
    """Return every ``ranks.size``-th share of the work list: tiles of one process, and first tile of each share.

    Shares are sorted by size, so that the processes get about equal work.
    """
    own = range(ranks.rank, len(begin) - 1, ranks.size)
    pieces = [tiles[begin[share] : begin[share + 1]] for share in own]
    return np.concatenate([tiles[:0], *pieces]), np.cumsum([0, *map(len, pieces)])


@lru_cache(maxsize=4)
def _cut(segments, mutual: bool, largest_tile: int):
    """Return tiles, first tile of each share, and number of partial sums; cached for repeated calls."""
    starts = row_starts(np.array(segments, np.int64).reshape(-1, 4)).tolist()
    blocks, written = [], []
    for segment, row in zip(segments, starts[:-1], strict=True):
        segment_blocks, parts = _cut_segment(segment, row, mutual, largest_tile)
        blocks += segment_blocks
        written.append(parts)
    parts = max([1, *written])
    blocks.sort(key=lambda block: block[0], reverse=True)
    blocks += [(0, [tile]) for tile in _idle_rows(starts, written, parts)]
    begin, tiles, share_work = [], [], 0
    for work, block in blocks:
        if not begin or share_work >= _LEAST_SHARE:
            begin.append(len(tiles))
            share_work = 0
        share_work += work
        tiles += block
    return np.reshape(np.array(tiles, np.int32), (-1, TILE_COLUMNS)), [*begin, len(tiles)], parts


def _cut_segment(segment, row, mutual, largest_tile):
    """Return work and tiles of each block of a segment with first target row ``row``, and number of partial sums."""
    t0, t1, s0, s1 = segment
    count, shift, parts, blocks = t1 - t0, row - t0, 0, []
    pairs = count * (s1 - s0)
    busy = min(pairs // PAIRS_PER_THREAD, MOST_THREADS)
    single, pairs_per_block = busy < 2, pairs / (2 * max(busy, 1))
    rest = [(s0, s1)]
    if mutual and s0 <= t0 and t1 <= s1:
        # two blocks per thread, where a block on the diagonal counts half
        divided = not single and count**2 > pairs_per_block
        stripe_count = 2 * math.ceil(count / math.sqrt(2.0 * pairs_per_block)) if divided else 1
        stripes = _stripes(t0, t1, stripe_count)
        cut = [_stripes(*ends, -(-(ends[1] - ends[0]) // largest_tile)) for ends in stripes]
        blocks = [_square(shift, cut, a, b) for a in range(len(cut)) for b in range(a, len(cut))]
        parts, rest = len(stripes), [(s0, t0), (t1, s1)]
    for j0, j1 in rest:
        block_count = 1 if single else math.ceil(count * (j1 - j0) / pairs_per_block)
        rows = max(min(block_count, count // _LEAST_TARGETS), 1)
        edges = [t0 + count * k // rows for k in range(rows + 1)]
        sources = _stripes(j0, j1, -(-block_count // rows))
        part = 0 if single else parts
        blocks += [
            ((i1 - i0) * (end - begin), [(i0 + shift, i1 + shift, i0, begin, end, part + k, 0, 0)])
            for k, (begin, end) in enumerate(sources)
            for i0, i1 in pairwise(edges)
        ]
        parts += len(sources)
    if single and blocks:  # one block with one partial sum
        return [(sum(work for work, _ in blocks), [tile for _, block in blocks for tile in block])], 1
    return blocks, parts


def _idle_rows(starts, written, parts):
    """Return tiles without sources, which zero the partial sums that no block of a segment writes."""
    idle = [
        (begin, end, 0, 0, 0, part, 0, 0)
        for part in range(min(written, default=parts), parts)
        for (begin, end), own_parts in zip(pairwise(starts), written, strict=True)
        if own_parts <= part
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
    """Return work and mirrored tiles of targets in stripe a and sources in stripe b, on or above the diagonal.

    Stripes are lists of ranges of at most a tile's width. A row is a column plus ``shift``.
    """
    targets, sources = stripes[a], stripes[b]
    tiles = [
        (i0 + shift, i1 + shift, i0, j0, j1, b, 1, a) for i0, i1 in targets for j0, j1 in sources if a < b or i0 <= j0
    ]
    pairs = (targets[-1][1] - targets[0][0]) * (sources[-1][1] - sources[0][0])
    return pairs if a == b else 2 * pairs, tiles


def pair_count(segments) -> int:
    """Number of pairs of a target and a source."""
    return int(np.sum((segments[:, 1] - segments[:, 0]) * (segments[:, 3] - segments[:, 2])))


def _stripes(begin, end, count):
    """Split a range into at most ``count`` ranges of equal width, a multiple of ``_LANES``."""
    width = max(-(-(end - begin) // (max(count, 1) * _LANES)), 1) * _LANES
    return [(a, min(a + width, end)) for a in range(begin, end, width)]


@cache
def arrays_type(dtype):
    """Struct of the arrays that an evaluation reads and writes; see ``evaluate.PairEvaluation``."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class EvaluationArrays:
        # Model: target rows and work list
        target: wp.array[int]  # packed column of a row
        begin: wp.array[int]  # range of sources of a row
        end: wp.array[int]
        tiles: wp.array2d[int]
        shares: wp.array[int]  # first tile of each share of a CPU, and the end
        active: wp.array[int]  # on a GPU the number of rows to finish, then these; None for all
        same_set: int  # 1 if targets and sources are the same moments
        with_torque: wp.array[int]  # 1 where a torque is computed
        # Data in:
        targets: wp.array2d[dtype]
        sources: wp.array2d[dtype]
        effective: wp.array2d[dtype]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        base: wp.array[vec3]
        # Data out:
        partial: wp.array3d[dtype]
        out: wp.array[vec3]
        torques: wp.array[vec3]

    return EvaluationArrays
