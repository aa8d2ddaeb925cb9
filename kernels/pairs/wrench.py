"""Effective moments of Eq. 4, for forces and torques between moments of different bodies (Eqs. 4, 13, 14).

| law | force | source |
|---|---|---|
| kelvin | F = μ0 (m·∇)H | Kim and Han 2022, Eqs. 13 and 14 (r⁴, twice in Eq. 14, is a misprint of r⁵) |
| zeeman | F = μ0 V [f'(H) ∇H (2M + H) + ∇H M] | Eq. 4 |

Both are μ0 (e·∇)H for an effective moment e, which is m or m + f'(H)(2m + V H). The torque on a moment is τ = μ0 e × H.
Pairs of moments of one body are left out: with Kelvin's law they add up to zero, which rounding would violate.

With Eq. 4 the paper, which has no torque, also sums pairs of one body (Algorithm 1). In equilibrium e = λm, with λ from
1 to 8, and m is parallel to the total field H + H_own. If λ is uniform in a body, the forces between its moments exert
the torque −Σ λm × H_own = Σ λm × H. That is the torque computed here, where those forces are left out. If λ is not
uniform, they would also exert a net force of the body on itself.
"""

from functools import cache

import warp as wp

from warpmag.kernels.material.curves import LINEAR, CurveParameters, curve_derivative_times
from warpmag.kernels.pairs.packing import ball_volume
from warpmag.kernels.shared.native import native_options

MU0 = 1.2566370614359173e-06  # vacuum permeability [T·m/A], the conventional 4π·10⁻⁷


@cache
def _zeeman_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def zeeman_moments(
        packed: wp.array2d[dtype],
        h: wp.array[vec3],
        inducible: wp.array[int],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        tables: wp.array2d[dtype],
        effective_out: wp.array2d[dtype],
    ):
        i = wp.tid()
        m = vec3(packed[4, i], packed[5, i], packed[6, i])
        e = m
        if inducible[i] == 1 and curve[i] != wp.static(LINEAR):  # the response of permanent moments is small
            # e = m + f'(H) (2m + V H)
            v = dtype(2.0) * m + ball_volume(packed[3, i]) * h[i]
            e += curve_derivative_times(h[i], v, slope[i], saturation[i], curve[i], tables)
        for c in range(3):
            effective_out[c, i] = e[c]

    return zeeman_moments


def launch_zeeman_moments(moments, h, material: CurveParameters, effective):
    """Write the effective moments of the Zeeman law [A·m²], shape [3, n]; h is the total field [A/m], shape [n]."""
    kernel, device = _zeeman_kernel(effective.dtype), effective.device
    inputs = [moments.packed, h, material.inducible]
    inputs += [material.saturation, material.slope, material.curve, material.tables]
    wp.launch(kernel, dim=moments.count, inputs=inputs, outputs=[effective], device=device)
