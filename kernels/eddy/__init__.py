"""Eddy currents in single-moment balls.

May import ``shared``, ``material`` and ``pairs``.
"""
