"""Sums of arrays, total ← total + factor · values, for scalars and vectors."""

from functools import cache

import warp as wp


@cache
def _kernel(dtype):
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_scaled(factor: scalar, values: wp.array[dtype], total: wp.array[dtype]):
        i = wp.tid()
        total[i] = total[i] + factor * values[i]

    return add_scaled


def launch_add_scaled(values, total, factor: float = 1.0):
    """Add ``factor`` times an array to another array of the same type. Both may be strided."""
    wp.launch(_kernel(total.dtype), len(total), inputs=[factor, values], outputs=[total], device=total.device)
