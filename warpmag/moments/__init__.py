"""Magnetic moments on a device: fields, induction, forces. Imports Warp; neither Newton nor USD."""
