"""Expansions of boxes: moments to multipoles, translations between levels, and local expansions to fields.

The caller passes all matrices and coefficients that depend on the harmonics (``warpmag/moments/fmm.py``).
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.fmm.octree import Octree
from warpmag.kernels.fmm.translate import Translation, pitch
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.shared.native import native_kernel
from warpmag.kernels.shared.team import team, threads_for

_THREADS = 128  # threads of a block; a block processes one box at a time
_DOWNWARD_BLOCKS = 8  # blocks per multiprocessor in the downward pass
_BOXES_PER_THREAD = 64  # boxes per thread of a CPU, at least
TERMS = 5  # terms of a multipole's coefficient; as in ``expansions.h``


class _Step(IntEnum):
    UPWARD, DOWNWARD, EVALUATE = range(3)


@dataclass(frozen=True, eq=False)
class ExpansionTables:
    """Coefficients and matrices of the K = (p + 1)² solid harmonics up to degree p, in float64."""

    degree: int  # highest degree p
    # Factors of the recurrence R_n = growth z R_(n−1) − decay r² R_(n−2), degree n and order m, shape [K]. Where n = m,
    # ``growth`` is the factor of (x + iy) R_(m−1).
    growth: np.ndarray
    decay: np.ndarray
    derivatives: np.ndarray  # matrices D with ∇R_i = Σ_j D[:, i, j] R_j, shape [3, K, K]
    multipole_to_parent: np.ndarray  # M2M matrix of a child in octant 0, shape [K, K]
    local_to_child: np.ndarray  # L2L matrix of a child in octant 0, shape [K, K]
    multipole_to_local: np.ndarray  # M2L matrix of each displacement in ``translate.displacements``, shape [56, K, K]
    parity: np.ndarray  # signs of the harmonics under reflections x → −x, y → −y and z → −z, shape [3, K]


@cache
def _arrays_type(dtype):
    @wp.struct
    class ExpansionArrays:
        # Octree:
        counts: wp.array[int]
        level_begin: wp.array[int]
        leaves: wp.array[int]
        moment_begin: wp.array[int]
        children: wp.array2d[int]
        parent: wp.array[int]
        arrived: wp.array[int]
        frame: wp.array[wp.float64]
        # Moments in:
        leaf_position: wp.array2d[dtype]
        sorted: wp.array2d[dtype]
        effective: wp.array2d[dtype]
        # Expansions:
        multipoles: wp.array2d[dtype]
        locals: wp.array2d[dtype]
        # Sums out:
        sums: wp.array2d[dtype]
        # Harmonics:
        growth: wp.array[dtype]
        decay: wp.array[dtype]
        multipole_index: wp.array2d[int]
        multipole_weight: wp.array2d[dtype]
        derivative_index: wp.array3d[int]
        derivative_weight: wp.array3d[dtype]
        multipole_to_parent: wp.array2d[dtype]
        local_to_child: wp.array2d[dtype]
        signs: wp.array2d[dtype]
        source_harmonics: int

    return ExpansionArrays


class Expansions:
    """Multipoles and local expansions of an octree's boxes, and the fields of the local expansions at its moments.

    Args:
        quantity: Quantity at the moments, ``FIELD``, ``FORCE`` or ``WRENCH``.
        moments: Packed moments in the octree's order, shape [8, n]; written by the caller.
        effective: Effective moments e of the force in the same order, shape [3, n].
        sums: Sums that fields are added to: 4π times force and field in the same order, shape [n, 3 or 6].
    """

    def __init__(self, octree: Octree, tables: ExpansionTables, quantity: Quantity, moments, effective, sums):
        """Allocate the expansions and copy the tables to the device."""
        device, dtype = octree.device, moments.dtype
        harmonics = (tables.degree + 1) ** 2
        width = pitch(harmonics)
        self._octree, self._quantity, self._dtype = octree, quantity, dtype
        self._translation = _translation(tables, dtype, device.alias)
        self._constants = {"DEGREE": tables.degree, "HARMONICS": harmonics, "PITCH": width, "THREADS": _THREADS}
        self._arrays = a = _arrays_type(dtype)()
        for name in ("counts", "level_begin", "moment_begin", "children", "parent", "frame", "leaf_position"):
            setattr(a, name, getattr(octree, name))
        for name, array in _device_tables(tables, dtype, device.alias).items():
            setattr(a, name, array)
        a.sorted, a.effective, a.sums = moments, effective, sums
        a.multipoles = wp.zeros((octree.capacity + 1, width), dtype=dtype, device=device)
        a.locals = wp.zeros_like(a.multipoles)
        self._parts = self._translation.parts(a.locals.shape)  # not shared: captured graphs write to them
        a.arrived = wp.zeros(octree.capacity, dtype=wp.int32, device=device)
        # Forces use sources up to one degree less, so that action and reaction cancel.
        a.source_harmonics = harmonics if quantity == Quantity.FIELD else tables.degree**2

    def share(self, leaves, shares=None):
        """Set the range of leaves with targets, shape [2], and this process's share of the boxes (``BoxShares``)."""
        a, octree, boxes = self._arrays, self._octree, shares or self._octree
        a.leaves, self._shares = leaves, shares
        parts = None if shares else self._parts
        lists = octree.neighbors, a.children, a.parent, boxes.order, boxes.octant_begin
        self._translation_arrays = self._translation.bind(a.multipoles, a.locals, *lists, parts=parts)

    def compute_multipoles(self):
        """Launch the upward pass: the multipoles of all boxes."""
        self._launch(_Step.UPWARD)

    def translate(self):
        """Launch the local expansions of all boxes: translations of multipoles, then the downward pass."""
        if self._shares is not None:
            self._shares.translate(self._translation, self._translation_arrays)
        else:
            self._translation.launch(self._translation_arrays)
        self._launch(_Step.DOWNWARD)

    def add_fields(self):
        """Launch the evaluation of local expansions at all moments, added to ``sums``."""
        self._launch(_Step.EVALUATE)

    def _launch(self, step: _Step):
        octree, device = self._octree, self._octree.device
        kernel = _kernel(self._dtype, step, self._quantity, tuple(self._constants.items()))
        if device.is_cpu:
            threads = threads_for(octree.capacity, _BOXES_PER_THREAD)
            wp.launch(kernel, dim=1, inputs=[threads, team(), self._arrays], device=device)
            return
        blocks = min(octree.capacity, _DOWNWARD_BLOCKS * device.sm_count) if step == _Step.DOWNWARD else octree.capacity
        inputs = [blocks, None, self._arrays]
        wp.launch(kernel, dim=blocks * _THREADS, inputs=inputs, device=device, block_dim=_THREADS)


@cache
def _translation(tables: ExpansionTables, dtype, device: str) -> Translation:
    """Return the translation matrices on a device; all evaluations share one copy."""
    return Translation(tables.multipole_to_local, tables.parity, dtype, device)


@cache
def _device_tables(tables: ExpansionTables, dtype, device: str) -> dict[str, wp.array]:
    """Return the other tables on a device, by their names in ``ExpansionArrays``."""
    harmonics = (tables.degree + 1) ** 2
    padding = (0, 0), (0, pitch(harmonics) - harmonics)

    def numbers(values):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    def integers(values):
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)

    multipole, derivative = _sparse_derivatives(tables)
    octants = np.arange(8)[:, None, None] >> np.arange(3)[None, :, None] & 1
    signs = np.where(octants & (tables.parity < 0)[None], -1.0, 1.0).prod(axis=1)
    return {
        "growth": numbers(tables.growth),
        "decay": numbers(tables.decay),
        "multipole_index": integers(multipole[0]),
        "multipole_weight": numbers(multipole[1]),
        "derivative_index": integers(derivative[0]),
        "derivative_weight": numbers(derivative[1]),
        "multipole_to_parent": numbers(np.pad(tables.multipole_to_parent.T, padding)),
        "local_to_child": numbers(np.pad(tables.local_to_child.T, padding)),
        "signs": numbers(np.pad(signs, padding)),
    }


def _sparse_derivatives(tables: ExpansionTables):
    """Return indices and weights of the nonzero terms of multipoles, and of derivatives of expansions."""
    lower, derivatives = tables.degree**2, tables.derivatives
    size = derivatives.shape[1]
    multipole = np.zeros((size, TERMS), int), np.zeros((size, TERMS))
    derivative = np.zeros((lower, 3, 2), int), np.zeros((lower, 3, 2))
    multipole_terms, derivative_terms = np.zeros(size, int), np.zeros((lower, 3), int)
    for axis, i, j in np.argwhere(np.abs(derivatives) > 1e-12):
        weight = derivatives[axis, i, j]
        for (index, weights), row, term, column in (
            (multipole, i, multipole_terms[i], 3 * j + axis),
            (derivative, (j, axis), derivative_terms[j, axis], i),
        ):
            index[row][term], weights[row][term] = column, weight
        multipole_terms[i] += 1
        derivative_terms[j, axis] += 1
    return multipole, derivative


@cache
def _kernel(dtype, step: _Step, quantity: Quantity, constants):
    call = (
        f"expansion_step<warpmag::Step({step:d}), warpmag::Quantity({quantity:d})>(thread, threads, team.data, arrays)"
    )
    arguments = {"threads": int, "team": wp.array2d[wp.uint64], "arrays": _arrays_type(dtype)}
    launch = {"grid_stride": False}
    return native_kernel(call, "fmm/expansions.h", arguments, dtype=dtype, launch=launch, **dict(constants))
