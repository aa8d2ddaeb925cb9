"""Work lists of the sums over pairs: target rows, and tiles of some rows and some sources.

Segments say which range of packed targets has which range of packed sources; the targets of all of them, one after the
other, are the target rows. A tile is a row of ``TILE_COLUMNS`` integers, see ``pair_terms``.
"""

from functools import cache
from itertools import pairwise

import numpy as np
import warp as wp

from warpmag.kernels.pairs.sums_cpu import TILE_SIZE
from warpmag.kernels.pairs.sums_cuda import LoopShape, choose_splits
from warpmag.kernels.shared.team import threads_for

_PAIRS_PER_START = 200_000
"""Pairs that a CPU sums while another of its threads wakes: 50 to 100 µs."""
_TILES_PER_THREAD = 16
"""Tiles that a thread should have, so that they can be shared out evenly."""
_ROUNDS, _MOST_SHARES = 3, 12
"""Shares of a thread, each round of them half as large as the one before; unless there are so many threads that adding
up their sums would take longer than waiting for each other."""
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
    """Tiles of stripes of targets and stripes of sources; where each share of them begins; and threads to take them.

    Targets among their own sources need the tiles above the diagonal only, each standing for its mirror image.
    """
    threads = threads_for(pair_count(segments), 2 * _PAIRS_PER_START)
    tiles, work = [], []
    for (t0, t1, s0, s1), row in zip(segments, row_starts(segments), strict=False):
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
    return np.array(tiles, np.int64), np.concatenate([[0], ends, [len(tiles)]]), threads


def pair_count(segments) -> int:
    """Pairs of a target and a source."""
    return int(np.sum((segments[:, 1] - segments[:, 0]) * (segments[:, 3] - segments[:, 2])))


def _stripes(begin, end, wanted):
    """Ranges of at most ``TILE_SIZE`` that cut one into about as many equal parts as wanted, or more."""
    parts = max(wanted, -(-(end - begin) // TILE_SIZE), 1)
    width = max(-(-(end - begin) // (parts * _LANES)) * _LANES, _LANES)
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

    return EvaluationArrays
