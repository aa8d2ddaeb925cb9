"""Writes a run's motion as a USD layer over its scene."""
