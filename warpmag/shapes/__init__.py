"""Shapes of bodies, their cells and the demagnetizing tensors of these. Imports NumPy and ``declarations``."""
