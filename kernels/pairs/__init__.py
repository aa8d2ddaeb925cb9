"""Pairs of moments: pair laws, all-pairs sums, overlapping neighbors, field (Eq. 1) and wrench (Eqs. 4, 13, 14).

May import ``shared`` and ``material``.
"""
