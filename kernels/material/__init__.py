"""Magnetization curves M = f(H) (Kim and Han 2022, Eqs. 7, 10) and the materials of moments.

May import ``shared``.
"""
