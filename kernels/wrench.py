"""Forces and torques of moments from the field and gradient that the other bodies make.

| law | force | source |
|---|---|---|
| kelvin | F = μ0 (m·∇)H | Kim and Han 2022, Eqs. 13 and 14 (both r⁴ of Eq. 14 are r⁵) |
| zeeman | F = μ0 V [f'(H) ∇H (2M + H) + ∇H M] | Eq. 4 |

The torque on a moment is τ = μ0 m × H. The moments of one body make neither force nor torque on each other: what they
would add up to is zero, and rounding must not make it otherwise.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.curves import curve_derivative_times
from warpmag.kernels.field import INVERSE_4PI
from warpmag.kernels.neighbors import pair_correction
from warpmag.kernels.packing import ball_volume

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

    @classmethod
    def permanent(cls, count: int, dtype, device) -> "Material":
        """Material of ``count`` permanent moments."""
        integers = wp.zeros(count, dtype=int, device=device)
        ones = wp.ones(count, dtype=dtype, device=device)
        return cls(integers, ones, ones, integers)


@cache
def _wrench_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    mat33 = wp.types.matrix((3, 3), dtype)
    sums = wp.types.vector(9, dtype)
    correct_pairs = pair_correction(dtype, gradient=True, exclude_body=True)

    @wp.kernel(module="unique", enable_backward=False)
    def finish_wrench(
        # inputs:
        partial: wp.array3d[dtype],
        packed: wp.array2d[dtype],
        row_target: wp.array[int],
        row_begin: wp.array[int],
        row_end: wp.array[int],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        external_field: wp.array[vec3],
        h: wp.array[vec3],
        inducible: wp.array[int],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        twisted: wp.array[int],
        force_law: int,
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        row = wp.tid()
        i = row_target[row]
        t = sums()
        for split in range(partial.shape[0]):
            for c in range(9):
                t[c] += partial[split, row, c]
        if neighbor_count[i] > 0:
            t += correct_pairs(packed, packed, i, row_begin[row], row_end[row], i, neighbor, neighbor_count)
        t *= dtype(wp.static(INVERSE_4PI))
        gradient = mat33(t[3], t[6], t[8], t[6], t[4], t[7], t[8], t[7], t[5])
        m = vec3(packed[4, i], packed[5, i], packed[6, i])
        effective = m
        if force_law == wp.static(ZEEMAN) and inducible[i] == 1:
            v = dtype(2.0) * m + ball_volume(packed[3, i]) * h[i]
            effective += curve_derivative_times(h[i], v, slope[i], saturation[i], curve[i])
        force_out[i] = dtype(wp.static(MU0)) * (gradient * effective)
        torque = vec3()
        if twisted[i] == 1:
            torque = dtype(wp.static(MU0)) * wp.cross(m, vec3(t[0], t[1], t[2]) + external_field[i])
        torque_out[i] = torque

    return finish_wrench


def launch_finish_wrench(
    rows, partial, moments, external_field, h, material: Material, twisted, force_law: int, forces, torques
):
    """Write the force and the torque on each moment.

    Args:
        rows: Work list that ``partial`` was summed over.
        partial: Sums of the native gradient loop, shape [splits, rows, 9].
        moments: Packed moments with their overlapping neighbours (``warpmag.packed.PackedMoments``).
        external_field: Applied field [A/m], shape [n].
        h: Whole field at inducible moments [A/m], shape [n]; used by the Zeeman law.
        material: What the moments are made of.
        twisted: Whether a moment feels its torque m × H, shape [n]; a lone inducible ball's is parallel to H.
        force_law: ``KELVIN`` or ``ZEEMAN``.
        forces: Out, forces [N], shape [n].
        torques: Out, torques about each moment [N·m], shape [n].
    """
    if rows.count == 0:
        return
    wp.launch(
        _wrench_kernel(partial.dtype),
        dim=rows.count,
        inputs=[
            partial,
            moments.packed,
            rows.target,
            rows.begin,
            rows.end,
            moments.neighbors,
            moments.neighbor_counts,
            external_field,
            h,
            material.inducible,
            material.saturation,
            material.slope,
            material.curve,
            twisted,
            force_law,
        ],
        outputs=[forces, torques],
        device=partial.device,
    )
