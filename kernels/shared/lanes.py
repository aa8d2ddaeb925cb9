"""How arrays of passes over balls are laid out; ``lanes.h`` and ``vectors.h`` have the vectors that read them.

A pass is written once for both devices: on a CPU it works on a vector of balls, on a GPU a group of threads shares one.
Arrays have ``CHUNK`` balls along their last axis, and what a ball reads of others stands in a cache line for each, of
``LINE`` numbers: on a CPU lines are transposed into vectors in registers, which is faster than to gather numbers.
"""

CHUNK = 16
"""Multiple that the number of balls is padded to, the lanes of the widest vectors; as in ``lanes.h``."""
LINE = 16
"""Numbers in a ball's cache line; as in ``lanes.h``."""
