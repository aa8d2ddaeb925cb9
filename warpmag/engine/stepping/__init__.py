"""Advances a Newton model with magnets in time.

May import ``declarations``, ``shapes``, ``moments``, ``usd/write``, ``engine/magnets`` and ``engine/pile_xpbd``.
"""
