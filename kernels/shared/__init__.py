"""Code that all kernels share: native kernels, CPU threads, vectors, sums over threads, prefix sums.

Imports Warp and NumPy only.
"""
