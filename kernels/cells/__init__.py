"""Corrections between the cells of one body, which the sums over pairs treat as balls.

May import ``shared``, ``material`` and ``pairs``. The relative positions of a rigid body's cells never change. So the
corrections are a matrix, computed once per shape and applied in the frame of the body.
"""
