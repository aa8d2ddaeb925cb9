"""Gradients of functions of the forces between permanent bodies by their poses, and their launches.

``body_pair_gradients.h`` has the derivation. All numbers are in double precision.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.applied.sources import source_arrays_type
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

_STEP = 3e-6
"""Largest motion in a difference, in radii and radians: about the cube root of the precision."""


@wp.struct
class BodyPairArrays:
    """Arrays of the launch."""

    sources: source_arrays_type(wp.float64)
    # Data in:
    velocity: wp.array[wp.vec3d]  # cotangents of forces, shape [n]
    rotation: wp.array[wp.vec3d]  # cotangents of torques, shape [n]
    # Data out, added to:
    by_positions: wp.array[wp.vec3d]  # at the first moments of bodies, shape [n]
    by_rotations: wp.array[wp.vec3d]  # by small rotations about the first moments, shape [bodies]


@cache
def _kernel(group: int):
    arguments = {**PASS_ARGUMENTS, "arrays": BodyPairArrays}
    constants = {"STEP": _STEP, "MU0": MU0, "INVERSE_4PI": INVERSE_4PI, "GROUP": group}
    call = "differentiate_body_pairs(thread, first, last, threads, team.data, arrays)"
    return native_kernel(call, "applied/body_pair_gradients.h", arguments, dtype=wp.float64, **constants)


class BodyPairGradients:
    """The part of these gradients that symmetric second derivatives leave out, in the same arrays at each launch.

    Args:
        sources: Arrays of the sources, in double precision (``applied.sources.source_arrays_type``).
        worlds: World of each permanent body, NumPy, shape [bodies].
        velocity, rotation, by_positions, by_rotations: As in :class:`BodyPairArrays`.
    """

    def __init__(self, sources, worlds, velocity, rotation, by_positions, by_rotations):
        """Keep the arrays."""
        self._arrays = a = BodyPairArrays()
        a.sources, a.velocity, a.rotation = sources, velocity, rotation
        a.by_positions, a.by_rotations = by_positions, by_rotations
        self._device, self._count = velocity.device, len(worlds)
        self._has_pairs = len(np.unique(worlds)) < len(worlds)

    def launch(self) -> None:
        """Add the gradients at the poses of the sources."""
        if not self._has_pairs:
            return
        group = group_threads(self._device, long_lists=True)
        sizes = {"threads": threads_for(self._count, 1), "gpu_threads": group * self._count}
        launch_passes(_kernel(group), 0, 1, self._arrays, device=self._device, **sizes)
