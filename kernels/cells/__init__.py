"""Corrections between cells, which the sums over pairs treat as balls.

May import ``shared``, ``material`` and ``pairs``. The relative positions of one body's cells never change. So their
corrections are a matrix, computed once per shape and applied in the frame of the body (``couplings``). Near cells of
different bodies act on each other as boxes, at the present poses of their bodies (``cell_pairs``).
"""
