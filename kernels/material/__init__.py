"""Magnetization curves M = f(H) (Kim and Han 2022, Eqs. 7, 10).

May import ``shared``.
"""
