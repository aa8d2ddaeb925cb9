"""Rigid bodies: moments on bodies, substeps and their monitor, what XPBD needs for piles.

May import ``shared`` only.
"""
