"""Gradient of a function L of the forces and torques between moments, by positions, moments and external field.

With the cotangents a = ∂L/∂F and b = ∂L/∂τ, and v = b × m, force and torque are

    L = μ0 Σ_i [a_i·(m_i·∇)H + v_i·H],    H(x_i) = H0_i + Σ_j D2(r_ij) m_j / 4π.

D2 is the pair law as a tensor, D3 and D4 its derivatives (``pair_law``, with one more factor g4 = g3'/d). They are
symmetric in all indices. D3 is odd in r, so that a pair contributes D3[a_i − a_j, m_i, m_j], and

    ∂L/∂x_i  = μ0/4π Σ_j (D4[a_i − a_j, m_i, m_j] + D3[v_i, m_j] + D3[m_i, v_j])
    ∂L/∂m_i  = μ0/4π Σ_j (D3[a_i − a_j, m_j] + D2[v_j]) + μ0 H × b_i
    ∂L/∂H0_i = μ0 v_i.

The gradient by positions jumps where two balls begin to overlap, as the second derivative of the field does.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

_PAIRS_PER_THREAD = 50_000  # pairs per thread, at least; a pair takes about eight times as long as in a field


@cache
def _arrays_type(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class WrenchGradientArrays:
        # Data in:
        packed: wp.array2d[dtype]  # moments, shape [8, n]
        external_field: wp.array[vec3]  # [A/m], shape [n]
        force_cotangents: wp.array[vec3]  # ∂L/∂F [1/N], shape [n]
        torque_cotangents: wp.array[vec3]  # ∂L/∂τ [1/(N·m)], shape [n]
        # Data out:
        by_positions: wp.array[vec3]  # ∂L/∂x [1/m], shape [n]
        by_moments: wp.array[vec3]  # ∂L/∂m [1/(A·m²)], shape [n]
        by_external_field: wp.array[vec3]  # ∂L/∂H0 [m/A], shape [n]

    return WrenchGradientArrays


@cache
def _kernel(dtype, group: int):
    call = "differentiate_wrench(thread, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}
    constants = {"MU0": MU0, "INVERSE_4PI": INVERSE_4PI, "GROUP": group}
    return native_kernel(call, "pairs/wrench_gradient.h", arguments, dtype=dtype, **constants)


def launch_wrench_gradient(moments, external_field, force_cotangents, torque_cotangents) -> tuple[wp.array, ...]:
    """Return the gradients by positions, moments and external field, each of shape [n], from sums over all pairs.

    Args:
        moments: Packed moments (``packing.PackedMoments``). Moments of one body do not act on each other.
        external_field: Applied field H0 [A/m], shape [n].
        force_cotangents: ∂L/∂F [1/N], shape [n].
        torque_cotangents: ∂L/∂τ [1/(N·m)], shape [n].
    """
    arrays, device, count = _arrays_type(moments.dtype)(), moments.device, moments.count
    arrays.packed, arrays.external_field = moments.packed, external_field
    arrays.force_cotangents, arrays.torque_cotangents = force_cotangents, torque_cotangents
    out = tuple(wp.empty(count, dtype=external_field.dtype, device=device) for _ in range(3))
    arrays.by_positions, arrays.by_moments, arrays.by_external_field = out
    if count:
        group = group_threads(device)
        threads = threads_for(count * count, _PAIRS_PER_THREAD)
        kernel = _kernel(moments.dtype, group)
        launch_passes(kernel, 0, 1, arrays, device=device, threads=threads, gpu_threads=group * count)
    return out
