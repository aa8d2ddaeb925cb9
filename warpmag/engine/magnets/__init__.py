"""Magnets of a Newton model: declared on a builder, evaluated on a model.

May import ``declarations``, ``shapes``, ``moments`` and ``usd/write``.
"""
