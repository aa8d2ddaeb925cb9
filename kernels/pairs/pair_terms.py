"""What is summed over pairs of moments, and the work list of tiles, as ``pair_terms.h`` has them."""

from enum import IntEnum


class Quantity(IntEnum):
    """What is summed over pairs: H; (e·∇)H for an effective moment e of the target; both; (m·∇)H for its moment m.

    The values are those of ``pair_terms.h``.
    """

    FIELD = 0
    FORCE = 1
    WRENCH = 2
    MUTUAL_FORCE = 3


WIDTHS = {Quantity.FIELD: 3, Quantity.FORCE: 3, Quantity.WRENCH: 6, Quantity.MUTUAL_FORCE: 3}
"""Numbers that are stored for a target."""

TILE_COLUMNS = 8
"""Columns of a work list of tiles, ``TileEntry`` of ``pair_terms.h``: target rows begin and end, packed column of the
first of them, sources begin and end, partial sums that the tile is added to, whether it stands also for the tile with
sources and targets exchanged, and partial sums that this is added to. A GPU reads a row as two vectors."""
