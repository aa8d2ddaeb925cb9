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

from functools import cache

import warp as wp

from warpmag.kernels.material.curves import CurveParameters, curve_derivative_times
from warpmag.kernels.pairs import finish_cpu
from warpmag.kernels.pairs.field import INVERSE_4PI
from warpmag.kernels.pairs.fused_cuda import (
    FusedShape,
    own_target,
    pair_summation,
    target_share,
    this_block,
    this_thread,
)
from warpmag.kernels.pairs.neighbors import pair_correction
from warpmag.kernels.pairs.packing import ball_volume
from warpmag.kernels.pairs.pair_law import gradient_times
from warpmag.kernels.pairs.pair_terms import WIDTHS, Quantity
from warpmag.kernels.shared import team as cpu_team
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.reductions import group_sum, group_threads

MU0 = 1.2566370614359173e-06
"""Vacuum permeability [T·m/A], the conventional 4π·10⁻⁷."""

KELVIN, ZEEMAN = 0, 1
FORCE_IDS = {"kelvin": KELVIN, "zeeman": ZEEMAN}


@cache
def _effective_kernel(dtype):
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


def launch_zeeman_moments(moments, h, material: CurveParameters, effective):
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
def wrench_functions(dtype, quantity: Quantity):
    """Warp functions that correct a target's sums, and that make force and torque of what they come to."""
    vec3 = wp.types.vector(3, dtype)
    sums = wp.types.vector(WIDTHS[quantity], dtype)
    summed_field = quantity == Quantity.WRENCH
    correct_pairs = pair_correction(dtype, gradient=True, exclude_body=True)

    @wp.func
    def correct(
        packed: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        i: int,
        begin: int,
        end: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        share: int,
        shares: int,
    ):
        total = sums()
        if neighbor_count[i] > share:
            c = correct_pairs(packed, packed, i, begin, end, i, neighbor, neighbor_count, share, shares)
            e = vec3(effective[0, i], effective[1, i], effective[2, i])
            f = gradient_times(wp.vector(c[3], c[4], c[5], c[6], c[7], c[8], length=6), e)
            for k in range(3):
                total[k] = f[k]
                if wp.static(summed_field):
                    total[3 + k] = c[k]
        return total

    @wp.func
    def store(
        i: int,
        total: sums,
        effective: wp.array2d[dtype],
        external_field: wp.array[vec3],
        twisted: wp.array[int],
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        force_out[i] = dtype(wp.static(MU0 * INVERSE_4PI)) * vec3(total[0], total[1], total[2])
        torque = vec3()
        if wp.static(summed_field):
            if twisted[i] == 1:
                e = vec3(effective[0, i], effective[1, i], effective[2, i])
                h = dtype(wp.static(INVERSE_4PI)) * vec3(total[3], total[4], total[5]) + external_field[i]
                torque = dtype(wp.static(MU0)) * wp.cross(e, h)
        torque_out[i] = torque

    return correct, store


@cache
def _finish_kernel(dtype, quantity: Quantity):
    vec3 = wp.types.vector(3, dtype)
    correct, store = wrench_functions(dtype, quantity)
    sum_group = group_sum(wp.types.vector(WIDTHS[quantity], dtype))

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
        shares: int,
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        row = wp.tid() // shares
        share = wp.tid() % shares
        i = row_target[row]
        mine = correct(packed, effective, i, row_begin[row], row_end[row], neighbor, neighbor_count, share, shares)
        for split in range(share, partial.shape[0], shares):
            for c in range(wp.static(WIDTHS[quantity])):
                mine[c] += partial[split, row, c]
        total = sum_group(mine, shares)
        if share == 0:
            store(i, total, effective, external_field, twisted, force_out, torque_out)

    return finish_wrench


@cache
def _sum_kernel(dtype, quantity: Quantity, shape: FusedShape):
    vec3 = wp.types.vector(3, dtype)
    sums = wp.types.vector(WIDTHS[quantity], dtype)
    correct, store = wrench_functions(dtype, quantity)
    share_of = target_share(shape)
    sum_pairs = pair_summation(dtype, quantity, shape)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(shape.threads, 1),
        module_options=native_options("pairs/fused_cuda.h", dtype=dtype),
    )
    def sum_wrench(
        # inputs:
        tiles: wp.array2d[int],
        packed: wp.array2d[dtype],
        effective: wp.array2d[dtype],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        external_field: wp.array[vec3],
        twisted: wp.array[int],
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        tile = this_block()
        thread = this_thread()
        correction = sums()
        i, share = share_of(tile, thread, tiles)
        if i >= 0:
            begin = tiles[tile, 3]
            end = tiles[tile, 4]
            correction = correct(
                packed, effective, i, begin, end, neighbor, neighbor_count, share, wp.static(shape.shares)
            )
        total = sum_pairs(tile, thread, tiles, packed, packed, effective, correction)
        i = own_target(tile, thread, tiles)
        if i >= 0:
            store(i, total, effective, external_field, twisted, force_out, torque_out)

    return sum_wrench


def launch_wrench(rows, partial, moments, effective, external_field, twisted, forces, torques):
    """Write the force and the torque on each moment.

    Args:
        rows: Work list, of forces or of wrenches; without fields there is no torque.
        partial: Sums of the pair loop over it, see ``pair_loops``; nothing if ``rows.fused``.
        moments: Packed moments with their overlapping neighbours (``warpmag.packed.PackedMoments``).
        effective: Effective moments that are summed with [A·m²], shape [3, n].
        external_field: Applied field [A/m], shape [n].
        twisted: Whether a moment feels its torque m × H, shape [n]; a lone inducible ball's is parallel to H.
        forces: Out, forces [N], shape [n].
        torques: Out, torques about each moment [N·m], shape [n].
    """
    if rows.count == 0:
        return
    near = [moments.overlaps, moments.overlap_counts]
    if rows.fused:
        wp.launch(
            _sum_kernel(moments.dtype, rows.quantity, rows.shape),
            dim=rows.tiles.shape[0] * rows.shape.threads,
            inputs=[rows.tiles, moments.packed, effective, *near, external_field, twisted],
            outputs=[forces, torques],
            block_dim=rows.shape.threads,
            device=moments.device,
        )
    elif moments.device.is_cpu and cpu_team.VECTORS:
        finish_cpu.launch_finish(
            rows, partial, moments, moments, True, external_field, forces, effective=effective, twisted=twisted,
            torques=torques, INVERSE_4PI=INVERSE_4PI, MU0=MU0,
        )  # fmt: skip
    else:
        ends = [rows.target, rows.begin, rows.end]
        shares = group_threads(moments.device)
        wp.launch(
            _finish_kernel(moments.dtype, rows.quantity),
            dim=shares * rows.count,
            inputs=[partial, moments.packed, effective, *ends, *near, external_field, twisted, shares],
            outputs=[forces, torques],
            device=moments.device,
        )
