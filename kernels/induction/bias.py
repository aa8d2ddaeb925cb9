"""The remanence of permanent magnets that respond to the field, M = M_r + χ H' with the field H' inside.

In its ball's curve M = k (H + M_r/χ), k = 3χ/(3 + χ): a linear curve in the field H and a bias M_r/χ, which is no field
that acts on moments, only where a solve starts from.
"""

from functools import cache

import warp as wp


@cache
def _bias_kernel(vec3):
    @wp.kernel(module="unique", enable_backward=False)
    def add_bias(bias: wp.array[vec3], moments: wp.array[int], h0: wp.array[vec3]):
        i = moments[wp.tid()]
        h0[i] = h0[i] + bias[i]

    return add_bias


def launch_add_bias(bias, moments, h0):
    """Add a bias [A/m] to the applied field at some moments.

    Args:
        bias: M_r/χ [A/m], shape [n].
        moments: The moments that have one.
        h0: Applied field [A/m], shape [n].
    """
    wp.launch(_bias_kernel(h0.dtype), dim=len(moments), inputs=[bias, moments, h0], device=h0.device)
