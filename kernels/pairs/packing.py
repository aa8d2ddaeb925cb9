"""Packing of moments into the component rows that the pair loops read; see ``pair_loops``."""

from functools import cache
from typing import Any

import warp as wp

from warpmag.kernels.pairs.neighbors import SKIN


@wp.func
def ball_volume(radius: Any):
    """Volume 4π/3 R³ [m³] of a ball."""
    return type(radius)(4.18879020478639) * radius * radius * radius


@wp.func
def store_magnetization(i: int, magnetization: Any, moments: wp.array(dtype=Any), packed: wp.array2d(dtype=Any)):
    """Set the moment of ball ``i`` to its volume times a magnetization [A/m], plain and packed."""
    m = ball_volume(packed[3, i]) * magnetization
    moments[i] = m
    for c in range(3):
        packed[c + 4, i] = m[c]


@cache
def _pack_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def pack(
        # inputs:
        positions: wp.array[vec3],
        moments: wp.array[vec3],
        radii: wp.array[dtype],
        labels: wp.array[int],
        found_at: wp.array[vec3],
        # outputs:
        packed_out: wp.array2d[dtype],
        moved_out: wp.array[int],
    ):
        i = wp.tid()
        x = positions[i]
        m = moments[i]
        for c in range(3):
            packed_out[c, i] = x[c]
            packed_out[c + 4, i] = m[c]
        packed_out[3, i] = radii[i]
        packed_out[7, i] = dtype(labels[i])
        if not wp.length(x - found_at[i]) <= dtype(wp.static(SKIN)) * radii[i]:
            moved_out[0] = 1

    return pack


def launch_pack(positions, moments, radii, labels, lists, packed):
    """Pack moments, and tell whether they have moved so far that their neighbours must be sought anew.

    Args:
        positions: Positions [m], shape [n].
        moments: Moments [A·m²], shape [n].
        radii: Radii [m], shape [n].
        labels: Body labels, shape [n]; exact in float32 up to 2²⁴.
        lists: Their neighbours (``neighbors.allocate``); its ``moved`` is set.
        packed: Out, shape [8, n].
    """
    wp.launch(
        _pack_kernel(packed.dtype),
        dim=packed.shape[1],
        inputs=[positions, moments, radii, labels, lists.found_at],
        outputs=[packed, lists.moved],
        device=packed.device,
    )


@cache
def _divide_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def divide_by_volume(
        # inputs:
        moments: wp.array[vec3],
        radii: wp.array[dtype],
        # outputs:
        magnetizations_out: wp.array[vec3],
    ):
        i = wp.tid()
        volume = ball_volume(radii[i])
        m = vec3()
        if volume > dtype(0.0):
            m = moments[i] / volume
        magnetizations_out[i] = m

    return divide_by_volume


def launch_divide_by_volume(moments, radii, magnetizations):
    """Magnetizations M = m/V [A/m] of balls, shape [n]; zero where the radius is."""
    wp.launch(
        _divide_kernel(radii.dtype),
        dim=radii.shape[0],
        inputs=[moments, radii],
        outputs=[magnetizations],
        device=radii.device,
    )
