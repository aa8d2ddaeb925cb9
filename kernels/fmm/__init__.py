"""Fast multipole method: far fields of moments by expansions in cells, near ones by pairs.

May import ``shared``, ``material`` and ``pairs``.
"""
