"""Declarations of magnets, materials, coils and scenes: plain data and checks. Imports NumPy only."""
