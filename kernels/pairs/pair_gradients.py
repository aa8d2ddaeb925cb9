"""Gradients of functions of fields, forces and torques between moments, by positions and moments.

With D2 the pair law as a tensor, H(x_i) = H0_i + Σ_j D2(r_ij) m_j / 4π, and D3 and D4 its derivatives (``pair_law``,
with one more factor g4 = g3'/d), which are symmetric in all indices. D2 and D4 are even in r, D3 is odd.

**Fields.** A function L with the cotangents v = ∂L/∂H has the gradients

    ∂L/∂x_i = 1/4π Σ_j (D3[v_i, m_j] + D3[m_i, v_j])
    ∂L/∂m_i = 1/4π Σ_j D2[v_j].

**Forces and torques.** With the cotangents a = ∂L/∂F and b = ∂L/∂τ, and v = b × m, L = μ0 Σ_i [a_i·(m_i·∇)H + v_i·H]
and

    ∂L/∂x_i  = μ0/4π Σ_j (D4[a_i − a_j, m_i, m_j] + D3[v_i, m_j] + D3[m_i, v_j])
    ∂L/∂m_i  = μ0/4π Σ_j (D3[a_i − a_j, m_j] + D2[v_j]) + μ0 H × b_i
    ∂L/∂H0_i = μ0 v_i.

The gradient of forces by positions jumps where two balls begin to overlap, as the second derivative of the field does.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs.mirror_cuda import MirrorShape, MirrorTiles, make_mirror
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.work_list import TILE_COLUMNS, cpu_tiles, pair_count, target_rows, tile_size
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes

_FEWEST_WARP_SOURCES, _MOST_WARP_MOMENTS = 256, 8192
"""Fewest sources per moment, and most moments, for which a whole warp sums one moment.

A warp per moment occupies all processors if there are few moments. With more moments smaller groups occupy them, too,
and load the sources less often.
"""

_FEWEST_EVALUATED, _MOST_IN_ONE_SUM = 512, 4096
"""Fewest sources per moment for which a GPU computes gradients of fields faster as a field and two forces, in systems
of several worlds with more than so many moments."""
_LEAST_MIRRORED, _MIRROR_SHAPE = 2048, MirrorShape(moments=2, warps=4, blocks=4, unrolled=1)
"""Fewest moments of one world whose pairs a GPU evaluates once, for both their moments, and the shape of the blocks."""


def one_sum_is_faster(device, pairs: float, count: int) -> bool:
    """Return True if :class:`PairGradients` of fields is faster than a field and two forces (``pairs.evaluate``).

    ``pairs`` counts pairs of two moments, ``count`` moments.
    """
    is_one_world = pairs >= count**2
    return device.is_cpu or is_one_world or count <= _MOST_IN_ONE_SUM or pairs < _FEWEST_EVALUATED * count


@cache
def _arrays_type(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class PairGradientArrays:
        # Pairs:
        begin: wp.array[int]  # range of sources of each moment, shape [n]
        end: wp.array[int]
        tiles: wp.array2d[int]  # of a CPU, as in ``work_list``
        shares: wp.array[int]
        partial: wp.array3d[dtype]  # partial sums of pairs that are visited once, shape [parts, rows, n or more]
        # Data in:
        packed: wp.array2d[dtype]  # moments, shape [8, n]
        cotangents: wp.array2d[dtype]  # v and, for forces, a, shape [3 or 6, n]
        external_field: wp.array[vec3]  # H0 [A/m], shape [n]
        torque_cotangents: wp.array[vec3]  # b [1/(N·m)], shape [n]
        # Data out:
        by_positions: wp.array[vec3]  # ∂L/∂x [1/m], shape [n]
        by_moments: wp.array[vec3]  # ∂L/∂m [1/(A·m²)], shape [n]
        by_external_field: wp.array[vec3]  # ∂L/∂H0 [m/A], shape [n]

    return PairGradientArrays


def _constants(dtype, group: int, wrench: bool) -> dict:
    constants = {"MU0": MU0, "INVERSE_4PI": INVERSE_4PI, "GROUP": group, "WRENCH": int(wrench)}
    return constants | {"TILE_SIZE": tile_size(dtype)}


@cache
def _kernel(dtype, group: int, wrench: bool):
    call = "differentiate_pairs(thread, threads, team.data, arrays)"
    arguments, constants = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}, _constants(dtype, group, wrench)
    return native_kernel(call, "pairs/pair_gradients.h", arguments, dtype=dtype, **constants)


@cache
def _mirrored_kernel(dtype, shape, wrench: bool):
    return native_kernel(
        f"sum_mirrored_gradients<{shape.moments}, {shape.warps}>"
        "(first_block + blockIdx.x, threadIdx.x, arrays, tiles, nearest)",
        "pairs/mirrored_gradients_cuda.h",
        {"arrays": _arrays_type(dtype), "tiles": MirrorTiles, "first_block": int, "nearest": int},
        dtype=dtype,
        launch={"grid_stride": False, "launch_bounds": (32 * shape.warps, shape.blocks if dtype is wp.float32 else 1)},
        **_constants(dtype, 1, wrench),
    )


@cache
def _cotangents_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def write_cotangents(
        packed: wp.array2d[dtype],
        force_cotangents: wp.array[vec3],
        torque_cotangents: wp.array[vec3],
        cotangents_out: wp.array2d[dtype],
    ):
        i = wp.tid()
        v = wp.cross(torque_cotangents[i], vec3(packed[4, i], packed[5, i], packed[6, i]))
        a = force_cotangents[i]
        for c in range(3):
            cotangents_out[c, i] = v[c]
            cotangents_out[c + 3, i] = a[c]

    return write_cotangents


class PairGradients:
    """Gradients from sums over all pairs of moments of one world, evaluated repeatedly in the same arrays.

    Args:
        moments: Packed moments (``packing.PackedMoments``), n of them.
        ends: First moment of each world, in ascending order, and n.
        cotangents: Cotangents v of fields, shape [3, n] (``PackedMoments.vectors``); None for forces and torques, where
            moments of one body do not act on each other.
        external_field: Applied field H0 [A/m], shape [n]; for forces and torques.

    Attributes:
        by_positions, by_moments, by_external_field: Gradients, shape [n] each; the last is written for forces and
            torques only.
    """

    def __init__(self, moments, ends, *, cotangents=None, external_field=None):
        """Allocate the buffers."""
        device, dtype, n, ends = moments.device, moments.dtype, moments.count, np.asarray(ends)
        self._device, self._count, self._threads, self._is_wrench = device, n, 1, cotangents is None
        self._arrays = a = _arrays_type(dtype)()
        a.packed, a.cotangents = moments.packed, moments.vectors(6) if cotangents is None else cotangents
        out = [wp.zeros(n, dtype=wp.types.vector(3, dtype), device=device) for _ in range(3 if self._is_wrench else 2)]
        a.by_positions, a.by_moments = self.by_positions, self.by_moments = out[:2]
        if self._is_wrench:
            a.external_field, a.by_external_field = external_field, out[2]
        self.by_external_field = out[-1]
        segments = np.stack([ends[:-1], ends[1:]] * 2, axis=1)
        is_shared = device.is_cuda and n <= _MOST_WARP_MOMENTS and pair_count(segments) >= _FEWEST_WARP_SOURCES * n
        self._group = group_threads(device, long_lists=is_shared)
        _, a.begin, a.end = target_rows(segments, device)
        self._mirror, parts = None, 0
        if device.is_cpu:
            tiles, shares, parts, self._threads = cpu_tiles(segments, True, dtype)
            a.tiles = wp.array(np.reshape(tiles, (-1, TILE_COLUMNS)), dtype=wp.int32, device=device)
            a.shares = wp.array(shares, dtype=wp.int32, device=device)
        elif len(segments) == 1 and n >= _LEAST_MIRRORED:
            self._mirror = make_mirror(0, n, _MIRROR_SHAPE, dtype, device, numbers=3 * len(out))
            parts = self._mirror.slabs + self._mirror.splits
        if parts:
            pitch = a.packed.strides[0] // a.packed.strides[1]
            a.partial = wp.zeros((parts, 3 * len(out), pitch), dtype=dtype, device=device)

    def launch(self, force_cotangents=None, torque_cotangents=None) -> None:
        """Launch the sums; a and b, shape [n], are for forces and torques only."""
        a, dtype, device, n = self._arrays, self._arrays.packed.dtype, self._device, self._count
        if n == 0:
            return
        if self._is_wrench:
            a.torque_cotangents = torque_cotangents
            inputs = [a.packed, force_cotangents, torque_cotangents]
            wp.launch(_cotangents_kernel(dtype), n, inputs=inputs, outputs=[a.cotangents], device=device)
        if self._mirror is not None:
            self._launch_mirrored(self._mirror)
        kernel = _kernel(dtype, self._group, self._is_wrench)
        launch_passes(kernel, 0, 1, a, device=device, threads=self._threads, gpu_threads=self._group * n)

    def _launch_mirrored(self, mirror) -> None:
        """Launch the partial sums of all pairs."""
        a, block = self._arrays, 32 * mirror.shape.warps
        kernel = _mirrored_kernel(a.packed.dtype, mirror.shape, self._is_wrench)
        for first_block, blocks, nearest in mirror.passes:
            inputs = [a, mirror.tiles, first_block, nearest]
            wp.launch(kernel, block * blocks, inputs=inputs, device=self._device, block_dim=block)
