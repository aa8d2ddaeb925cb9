"""Magnetic equilibrium of inducible moments: θ flow and its rivals (Eqs. 5, 6, 8, 9, 11), convergence (Eq. 12).

May import ``shared``, ``material``, ``pairs`` and ``cells``.
"""
