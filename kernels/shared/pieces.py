"""Pieces of ranges: the items of a work list."""

import numpy as np


def cut(begin, end, size) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the range, the begin and the end of each piece of at most ``size`` elements, in order, shape [pieces].

    Args:
        begin, end: Begin and end of each range, shape [ranges]. An empty range has no piece.
        size: Most elements of a piece, a number or shape [ranges].

    Example:
        >>> [values.tolist() for values in cut([0, 10], [5, 12], 4)]
        [[0, 0, 1], [0, 4, 10], [4, 5, 12]]
    """
    begin, end = np.asarray(begin, np.int64), np.asarray(end, np.int64)
    size = np.broadcast_to(size, begin.shape)
    counts = np.maximum(-(-(end - begin) // size), 0)
    of_range = np.repeat(np.arange(len(begin)), counts)
    piece = np.arange(len(of_range)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = begin[of_range] + piece * size[of_range]
    return of_range, first, np.minimum(first + size[of_range], end[of_range])
