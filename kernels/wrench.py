"""Forces and torques of moments from the field and gradient that the other bodies make.

| law | force | source |
|---|---|---|
| kelvin | F = μ0 (m·∇)H | Kim and Han 2022, Eqs. 13 and 14 (both r⁴ of Eq. 14 are r⁵) |
| zeeman | F = μ0 V [f'(H) ∇H (2M + H) + ∇H M] | Eq. 4 |

Both are μ0 (e·∇)H for an effective moment e, m or m + f'(H)(2m + V H), which the pair loop contracts with as it sums.
The torque on a moment is τ = μ0 e × H. The moments of one body make neither force nor torque on each other: with
Kelvin's law what they would add up to is zero, and rounding must not make it otherwise. With Eq. 4 the paper, which
handles no torque, sums pairs of one body, too (Algorithm 1). In equilibrium the two agree: e is λm with λ of 1 to 8 and
m is parallel to the whole field, so that the body's own pairs turn it by −λm × H_own = λm × H, as far as λ is one
number in the body; where it is not, they also push it, which no body can do to itself.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.curves import curve_derivative_times
from warpmag.kernels.field import INVERSE_4PI
from warpmag.kernels.neighbors import pair_correction
from warpmag.kernels.packing import ball_volume
from warpmag.kernels.pair_code import WRENCH
from warpmag.kernels.pair_law import gradient_times

MU0 = 1.2566370614359173e-06
"""Vacuum permeability [T·m/A], the conventional 4π·10⁻⁷."""

KELVIN, ZEEMAN = 0, 1
FORCE_IDS = {"kelvin": KELVIN, "zeeman": ZEEMAN}


@dataclass(frozen=True)
class Material:
    """What each moment is made of, on one device.

    Attributes:
        inducible: 1 for inducible moments, 0 for permanent ones, shape [n].
        saturation: Saturation magnetization Ms [A/m], shape [n].
        slope: Initial slope k = 3χ/(3+χ) [dimensionless], shape [n].
        curve: Curve id of ``kernels.curves``, shape [n].
    """

    inducible: wp.array
    saturation: wp.array
    slope: wp.array
    curve: wp.array


@cache
def _effective_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def zeeman_moments(
        # inputs:
        packed: wp.array2d[dtype],
        h: wp.array[vec3],
        inducible: wp.array[int],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        # outputs:
        effective_out: wp.array2d[dtype],
    ):
        i = wp.tid()
        m = vec3(packed[4, i], packed[5, i], packed[6, i])
        e = m
        if inducible[i] == 1:
            v = dtype(2.0) * m + ball_volume(packed[3, i]) * h[i]
            e += curve_derivative_times(h[i], v, slope[i], saturation[i], curve[i])
        for c in range(3):
            effective_out[c, i] = e[c]

    return zeeman_moments


def launch_zeeman_moments(moments, h, material: Material, effective):
    """Write the effective moments of the Zeeman law.

    Args:
        moments: Packed moments (``warpmag.packed.PackedMoments``).
        h: Whole field at inducible moments [A/m], shape [n].
        material: What the moments are made of.
        effective: Out, effective moments [A·m²], shape [3, n].
    """
    wp.launch(
        _effective_kernel(effective.dtype),
        dim=moments.count,
        inputs=[moments.packed, h, material.inducible, material.saturation, material.slope, material.curve],
        outputs=[effective],
        device=effective.device,
    )


@cache
def _wrench_kernel(dtype, quantity: str):
    vec3 = wp.types.vector(3, dtype)
    summed_field = quantity == WRENCH
    correct_pairs = pair_correction(dtype, gradient=True, exclude_body=True)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_wrench(
        # inputs:
        partial: wp.array3d[dtype],
        packed: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        external_field: wp.array[vec3],
        twisted: wp.array[int],
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        row = wp.tid()
        i = row_target[row]
        f = vec3()
        h = vec3()
        for split in range(partial.shape[0]):
            f += vec3(partial[split, row, 0], partial[split, row, 1], partial[split, row, 2])
            if wp.static(summed_field):
                h += vec3(partial[split, row, 3], partial[split, row, 4], partial[split, row, 5])
        if neighbor_count[i] > 0:
            c = correct_pairs(packed, packed, i, row_begin[row], row_end[row], i, neighbor, neighbor_count)
            h += vec3(c[0], c[1], c[2])
            e = vec3(effective[0, i], effective[1, i], effective[2, i])
            f += gradient_times(wp.vector(c[3], c[4], c[5], c[6], c[7], c[8], length=6), e)
        force_out[i] = dtype(wp.static(MU0 * INVERSE_4PI)) * f
        torque = vec3()
        if wp.static(summed_field):
            if twisted[i] == 1:
                e = vec3(effective[0, i], effective[1, i], effective[2, i])
                torque = dtype(wp.static(MU0)) * wp.cross(e, dtype(wp.static(INVERSE_4PI)) * h + external_field[i])
        torque_out[i] = torque

    return finish_wrench


def launch_finish_wrench(rows, partial, moments, effective, external_field, twisted, forces, torques):
    """Write the force and the torque on each moment.

    Args:
        rows: Work list that ``partial`` was summed over, of forces or of wrenches; without fields there is no torque.
        partial: Sums of the native loop, shape as ``pair_loops.partial_shape`` says.
        moments: Packed moments with their overlapping neighbours (``warpmag.packed.PackedMoments``).
        effective: Effective moments that the loop summed with [A·m²], shape [3, n].
        external_field: Applied field [A/m], shape [n].
        twisted: Whether a moment feels its torque m × H, shape [n]; a lone inducible ball's is parallel to H.
        forces: Out, forces [N], shape [n].
        torques: Out, torques about each moment [N·m], shape [n].
    """
    if rows.count == 0:
        return
    wp.launch(
        _wrench_kernel(partial.dtype, rows.quantity),
        dim=rows.count,
        inputs=[
            partial,
            moments.packed,
            effective,
            rows.target,
            rows.begin,
            rows.end,
            moments.neighbors,
            moments.neighbor_counts,
            external_field,
            twisted,
        ],
        outputs=[forces, torques],
        device=partial.device,
    )
