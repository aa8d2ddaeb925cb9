"""Writes a run's motion as a USD layer over its scene.

May import ``declarations``, ``usd`` and ``usd/read``.
"""
