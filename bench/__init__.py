"""Measurements: of this library against the paper, its rivals and its peers."""

import warp as wp

wp.config.enable_backward = False  # as the command does, before Newton is imported: half the time to compile
