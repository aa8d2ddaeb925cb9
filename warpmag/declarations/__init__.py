"""Declarations of magnets, materials, coils and scenes: plain data and its checks.

Imports NumPy and the standard library only.
"""
