"""What all rooms share: building native code, threads of a CPU, vectors, sums over threads, prefix sums.

Imports Warp and NumPy only.
"""
