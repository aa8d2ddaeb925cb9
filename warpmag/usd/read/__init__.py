"""Reads magnets, scenes and motions from USD stages, and checks them.

May import ``declarations``, ``shapes`` and ``usd``.
"""
