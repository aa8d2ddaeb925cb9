"""Effective moments of Eq. 4, for forces and torques between moments of different bodies (Eqs. 4, 13, 14).

| law | force | source |
|---|---|---|
| kelvin | F = μ0 (m·∇)H | Kim and Han 2022, Eqs. 13 and 14 (both r⁴ of Eq. 14 are r⁵) |
| zeeman | F = μ0 V [f'(H) ∇H (2M + H) + ∇H M] | Eq. 4 |

Both are μ0 (e·∇)H for an effective moment e, m or m + f'(H)(2m + V H), and the torque on a moment is τ = μ0 e × H, see
``evaluate``. The moments of one body make neither force nor torque on each other: with Kelvin's law what they would add
up to is zero, and rounding must not make it otherwise. With Eq. 4 the paper, which handles no torque, sums pairs of one
body, too (Algorithm 1). In equilibrium the two agree: e is λm with λ of 1 to 8 and m is parallel to the whole field, so
that the body's own pairs turn it by −λm × H_own = λm × H, as far as λ is one number in the body; where it is not, they
also push it, which no body can do to itself.
"""

from functools import cache

import warp as wp

from warpmag.kernels.material.curves import LINEAR, CurveParameters, curve_derivative_times
from warpmag.kernels.pairs.packing import ball_volume
from warpmag.kernels.shared.native import native_options

MU0 = 1.2566370614359173e-06
"""Vacuum permeability [T·m/A], the conventional 4π·10⁻⁷."""


@cache
def _zeeman_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def zeeman_moments(
        # inputs:
        packed: wp.array2d[dtype],
        h: wp.array[vec3],
        inducible: wp.array[int],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        tables: wp.array2d[dtype],
        # outputs:
        effective_out: wp.array2d[dtype],
    ):
        i = wp.tid()
        m = vec3(packed[4, i], packed[5, i], packed[6, i])
        e = m
        if inducible[i] == 1 and curve[i] != wp.static(LINEAR):  # permanent ones respond little
            v = dtype(2.0) * m + ball_volume(packed[3, i]) * h[i]
            e += curve_derivative_times(h[i], v, slope[i], saturation[i], curve[i], tables)
        for c in range(3):
            effective_out[c, i] = e[c]

    return zeeman_moments


def launch_zeeman_moments(moments, h, material: CurveParameters, effective):
    """Write the effective moments of the Zeeman law.

    Args:
        moments: Packed moments (``packing.PackedMoments``).
        h: Whole field at inducible moments [A/m], shape [n].
        material: What the moments are made of.
        effective: Out, effective moments [A·m²], shape [3, n].
    """
    wp.launch(
        _zeeman_kernel(effective.dtype),
        dim=moments.count,
        inputs=[
            *(moments.packed, h, material.inducible),
            *(material.saturation, material.slope, material.curve, material.tables),
        ],
        outputs=[effective],
        device=effective.device,
    )
