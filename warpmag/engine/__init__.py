"""Magnets in Newton: the only part of warpmag that imports ``newton``."""
