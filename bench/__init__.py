"""Benchmarks of warpmag: against the paper, exact references and other libraries."""

import warp as wp

wp.config.enable_backward = False  # before Newton is imported, as the command does: halves the time to compile
