"""Plain loop over pairs: the reference for the native sums, exact for overlapping balls.

It also implements the paper's smoothing (section 5).
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_law import WIDTHS, Quantity, field_of, force_of, pair_factors
from warpmag.kernels.pairs.work_list import arrays_type
from warpmag.kernels.shared.native import native_options


@cache
def _kernel(dtype, quantity: Quantity):
    vec3, sums_arrays = wp.types.vector(3, dtype), arrays_type(dtype)
    factors = pair_factors(dtype)
    field, force = quantity in (Quantity.FIELD, Quantity.WRENCH), quantity != Quantity.FIELD

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("pairs/pair_law.h", dtype=dtype))
    def reference_sums(arrays: sums_arrays, epsilon2: dtype):
        row = wp.tid()
        i = arrays.target[row]
        x = vec3(arrays.targets[0, i], arrays.targets[1, i], arrays.targets[2, i])
        e = vec3()
        if wp.static(force):
            e = vec3(arrays.effective[0, i], arrays.effective[1, i], arrays.effective[2, i])
        h = vec3()
        f = vec3()
        for j in range(arrays.begin[row], arrays.end[row]):
            left_out = arrays.same_set == 1 and i == j
            if wp.static(force):
                left_out = arrays.targets[7, i] == arrays.sources[7, j]
            if not left_out:
                r = x - vec3(arrays.sources[0, j], arrays.sources[1, j], arrays.sources[2, j])
                m = vec3(arrays.sources[4, j], arrays.sources[5, j], arrays.sources[6, j])
                d = wp.length(r)
                u = wp.normalize(r)
                g = factors(d, arrays.targets[3, i], arrays.sources[3, j], epsilon2)
                if wp.static(field):
                    h += field_of(g, d, u, m)
                if wp.static(force):
                    f += force_of(g, u, m, e)
        for c in range(3):
            if wp.static(force):
                arrays.partial[0, row, c] = f[c]
            if wp.static(field):
                arrays.partial[0, row, wp.static(WIDTHS[quantity] - 3) + c] = h[c]

    return reference_sums


def launch_reference_sums(quantity: Quantity, arrays, smoothing: float):
    """Sum ``FIELD``, ``FORCE`` or ``WRENCH`` over all pairs of target rows and their sources, in one partial sum.

    A field leaves out the target itself if targets and sources are the same. A force leaves out sources with the
    target's label. ``smoothing`` is the length ℓ [m] of the paper's smoothing; 0 for none.
    """
    dtype, rows = arrays.partial.dtype, arrays.target.shape[0]
    inputs = [arrays, dtype(smoothing**5)]
    wp.launch(_kernel(dtype, quantity), dim=rows, inputs=inputs, device=arrays.partial.device)
