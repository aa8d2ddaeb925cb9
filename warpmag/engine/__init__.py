"""Magnets in Newton, in three rooms: ``magnets``, ``pile_xpbd`` and ``stepping``."""
