"""Measurements: of this library against the paper, its rivals and its peers."""
