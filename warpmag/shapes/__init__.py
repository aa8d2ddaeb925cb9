"""Shapes of bodies, their cells, and the demagnetizing tensors of the cells.

May import ``declarations``. No Warp.
"""
