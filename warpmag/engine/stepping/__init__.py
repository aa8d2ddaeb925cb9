"""Advances a Newton model with magnets in time."""
