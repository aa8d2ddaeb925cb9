"""Cells of one body: what moments that touch, or nearly do, lack as the balls that the sums over pairs take them for.

May import ``shared``, ``material`` and ``pairs``. Where the cells of a rigid body are to each other never changes, so
that what they lack is a matrix, computed once for a shape and applied in the frame of its body.
"""
