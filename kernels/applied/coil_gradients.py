"""Gradients of functions of the fields, forces and torques of coils and field maps.

A source of strength I has the field I H(x) at a moment m at x. With the cotangents a and b of the moment's force and
torque and η of the field in the induction, a function L of them changes like

    Φ = μ0 a'·∇(m·I H) + μ0 b'·(m × I H) + η·I H.

The reaction acts on the source's body with the opposite force, and the opposite torque about its center of mass c. With
the cotangents A and B of that body's wrench, a' = a − A − B × (x − c) and b' = b − B, both 0 if the moment is on the
same body. Gradients by x and m are those of Φ, less F × B by x for the lever arm x − c of the force F. That by the
source's origin is −∂Φ/∂x. The sum over moments of (x − o) × ∂Φ/∂x + m × ∂Φ/∂m + a' × F + b' × τ + η × I H is minus the
gradient by a rotation of the source about its origin o, because Φ does not change if everything turns together. Second
derivatives of H along a' are central differences of first derivatives in double precision, exact to about 1e-7.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.applied.sources import FieldSources, SourceKind, coil_arrays_type
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.team import launch_passes, threads_for

BY_MOMENTS, OF_ROWS, BY_SOURCES = range(3)  # passes; as in ``coil_gradients.h``
_PER_ROW = 32  # moments in a row of a source
_ITEMS_PER_THREAD = 50  # moments, or rows, per thread of a CPU, at least
_ROW_SUMS = 10  # as in ``coil_gradients.h``


@cache
def _arrays_type(dtype):
    vec3, coil_arrays = wp.types.vector(3, dtype), coil_arrays_type(dtype)

    @wp.struct
    class CoilGradientArrays:
        coils: coil_arrays
        packed: wp.array2d[dtype]  # moments with their bodies, shape [8, n]
        lists: wp.array[wp.vec2i]  # range of ``coils.list`` of each moment, shape [n]
        row: wp.array[wp.vec3i]  # source and range of moments of each row
        row_begin: wp.array[int]  # first row of each source, shape [coils + 1]
        partial: wp.array2d[wp.float64]  # sums of each row
        # Data in:
        force_cotangents: wp.array[vec3]  # a [1/N], shape [n]
        torque_cotangents: wp.array[vec3]  # b [1/(N·m)], shape [n]
        by_field: wp.array[vec3]  # η [m/A], shape [n]
        source_force_cotangents: wp.array[vec3]  # A [1/N], shape [coils]
        source_torque_cotangents: wp.array[vec3]  # B [1/(N·m)], shape [coils]
        centers: wp.array[vec3]  # c [m], shape [coils]
        # Data out:
        by_positions: wp.array[vec3]  # added to, shape [n]
        by_moments: wp.array[vec3]  # added to, shape [n]
        by_sources: wp.array2d[dtype]  # gradients by strength, origin, rotation and c, shape [coils, 10]

    return CoilGradientArrays


@cache
def _kernel(dtype, only_pass: int):
    call = "differentiate_coils(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}
    constants = {"MU0": MU0, "PASS": only_pass, **{kind.name: kind.value for kind in SourceKind}}
    return native_kernel(call, "applied/coil_gradients.h", arguments, dtype=dtype, **constants)


class CoilGradients:
    """Gradients of a function of what coils and field maps do, evaluated repeatedly in the same arrays.

    Args:
        sources: The coils and maps.
        packed: Packed moments with their bodies (``packing.PackedMoments``), n of them.
        worlds: World of each moment, NumPy, shape [n].

    Attributes:
        frames, strengths: State at which gradients are computed, as in ``sources``; written by the caller.
        source_force_cotangents, source_torque_cotangents: Cotangents A [1/N] and B [1/(N·m)] of the wrench on the body
            of each coil, 0 for a coil that forces do not move, shape [coils]; written by the caller.
        centers: Center of mass of that body [m], shape [coils]; written by the caller.
        by_sources: Gradients by strength (1 column), origin (3), rotation (3) and center of mass (3) of each coil;
            launches add to them, shape [coils, 10].
    """

    def __init__(self, sources: FieldSources, packed, worlds):
        """Allocate the buffers."""
        dtype, device, count = sources.dtype, sources.device, len(sources.applied)
        self._arrays = a = _arrays_type(dtype)()
        vec3, coils = wp.types.vector(3, dtype), coil_arrays_type(dtype)
        for name in coils.vars:
            setattr(a.coils, name, getattr(sources.coil_arrays, name))
        self.frames, self.strengths = wp.clone(sources.frames), wp.clone(sources.strengths)
        a.coils.frame, a.coils.strength, a.packed = self.frames, self.strengths, packed.packed
        vectors = [wp.zeros(count, dtype=vec3, device=device) for _ in range(3)]
        self.source_force_cotangents, self.source_torque_cotangents, self.centers = vectors
        a.source_force_cotangents, a.source_torque_cotangents, a.centers = vectors
        self.by_sources = a.by_sources = wp.zeros((count, _ROW_SUMS), dtype=dtype, device=device)
        self._lay_out(sources, np.asarray(worlds))

    def _lay_out(self, sources: FieldSources, worlds) -> None:
        """List the coils of each moment, and the rows of moments of each coil."""
        a, device = self._arrays, self.by_sources.device

        def integers(values, kind=wp.int32):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=device)

        a.lists = integers(np.stack([sources.lists[worlds], sources.lists[worlds + 1]], axis=1), wp.vec2i)
        rows, begin = [], [0]
        for s, source in enumerate(sources.applied):
            ends = (source.world, source.world + 1) if source.world >= 0 else (0, sources.world_count)
            first, end = np.searchsorted(worlds, ends)
            rows += [(s, k, min(k + _PER_ROW, end)) for k in range(first, end, _PER_ROW)]
            begin.append(len(rows))
        a.row, a.row_begin = integers(np.reshape(rows, (-1, 3)), wp.vec3i), integers(begin)
        a.partial = wp.zeros((len(rows), _ROW_SUMS), dtype=wp.float64, device=device)

    def launch_wrench(self, force_cotangents, torque_cotangents, by_positions, by_moments) -> None:
        """Launch the gradients of forces, torques and reactions, from a and b, shape [n] each.

        Those by positions and moments are added, shape [n] each, and those by sources to ``by_sources``.
        """
        self._launch(force_cotangents, torque_cotangents, None, by_positions, by_moments)

    def launch_field(self, by_field, by_positions, by_moments) -> None:
        """Launch the gradients of the field in the induction, from η, shape [n]; results as above."""
        self._launch(None, None, by_field, by_positions, by_moments)

    def _launch(self, force_cotangents, torque_cotangents, by_field, by_positions, by_moments):
        a, device = self._arrays, self.by_sources.device
        a.force_cotangents, a.torque_cotangents, a.by_field = force_cotangents, torque_cotangents, by_field
        a.by_positions, a.by_moments = by_positions, by_moments
        counts = a.lists.shape[0], a.row.shape[0], self.by_sources.shape[0]
        if device.is_cpu:
            threads = threads_for(counts[0], _ITEMS_PER_THREAD)
            kernel = _kernel(a.packed.dtype, -1)
            launch_passes(kernel, BY_MOMENTS, BY_SOURCES + 1, a, device=device, threads=threads)
            return
        for only_pass, count in enumerate(counts):
            kernel = _kernel(a.packed.dtype, only_pass)
            launch_passes(kernel, only_pass, only_pass + 1, a, device=device, threads=1, gpu_threads=count)
