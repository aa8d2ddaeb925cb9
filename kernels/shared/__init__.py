"""What all rooms share: native code, threads of a CPU, vectors, sums over threads, prefix sums, keys over time.

Imports Warp and NumPy only.
"""
