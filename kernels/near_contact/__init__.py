"""What dipoles lack between balls that nearly touch: the table of two balls, passes over near pairs, launches.

May import ``shared``, ``material`` and ``pairs``.
"""
