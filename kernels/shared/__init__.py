"""Shared code of all rooms: native kernels, threads of a CPU, vectors, sums over threads, prefix sums.

Imports Warp and NumPy only.
"""
