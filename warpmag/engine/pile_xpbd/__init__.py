"""Contact search and rigid-body solver for piles.

The only package that uses internals of Newton and Warp, besides the tape of ``moments``. May import ``declarations``.
"""
