"""Multipole-to-local translation (M2L) of boxes of the octree; ``translate.h`` has the equations.

Sources of a box's far field are children of its parent's neighborhood that are not its own neighbors: at most 189. Sums
run in a fixed order without atomics, so results are bitwise reproducible.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.team import launch_passes, threads_for

_BOXES_PER_THREAD = 64  # boxes per thread of a CPU, at least
_WARPS_TOGETHER = 12  # warps per multiprocessor in float32, limited by registers
_BOXES = 32  # boxes per block of a GPU
_GROUP_ROWS = 8  # row slots per thread of a GPU
_MOST_SPLIT = 8192
"""Most boxes for which several blocks of a GPU share the displacements of a box. Few boxes do not fill the GPU."""
OCTANTS = 8


def pitch(harmonics: int) -> int:
    """Return the padded row length of arrays of expansions; the padding is zero."""
    return -(-harmonics // 16) * 16


def displacements() -> np.ndarray:
    """Return the displacements source − target in the order of their matrices, shape [56, 3]."""
    x, y, z = np.arange(64) % 4, np.arange(64) // 4 % 4, np.arange(64) // 16
    return np.stack([x, y, z], axis=1)[np.maximum(np.maximum(x, y), z) > 1]


@cache
def _arrays_type(dtype):
    @wp.struct
    class TranslationArrays:
        # Expansions:
        multipoles: wp.array2d[dtype]
        locals: wp.array2d[dtype]
        # Boxes in:
        neighbors: wp.array2d[int]
        children: wp.array2d[int]
        parent: wp.array[int]
        order: wp.array[int]
        octant_begin: wp.array2d[int]
        # Partial local expansions:
        parts: wp.array3d[dtype]
        # Matrices, and parities of harmonics:
        matrices: wp.array[dtype]
        signs: wp.array2d[dtype]
        parity: wp.array[int]
        row_parity: wp.array[int]
        row_harmonic: wp.array[int]

    return TranslationArrays


class Translation:
    """Translation of multipoles of one degree: its matrices on a device, and its launch.

    The arguments are ``multipole_to_local`` and ``parity`` of ``expansions.ExpansionTables``.
    """

    def __init__(self, matrices, parity, dtype, device):
        """Sort and pad the rows of the matrices by parity, and copy them to the device."""
        device = wp.get_device(device)
        matrices, odd = np.asarray(matrices, np.float64), np.asarray(parity) < 0
        harmonics = matrices.shape[1]
        classes = odd[0] + 2 * odd[1] + 4 * odd[2]
        group = _GROUP_ROWS if device.is_cuda else 4
        used = _used_rows(classes) if device.is_cuda else group
        rows = _grouped_rows(classes, group, used)
        slice_size = _slice(dtype)
        length = -(-harmonics // slice_size) * slice_size if device.is_cuda else harmonics
        table = np.zeros((len(matrices), length, len(rows)))
        table[:, :harmonics, rows >= 0] = matrices[:, rows[rows >= 0]].transpose(0, 2, 1)
        if not device.is_cuda:
            table = table.reshape(len(matrices), length, -1, group).transpose(0, 2, 1, 3)
        octants = np.arange(OCTANTS)[:, None, None] >> np.arange(3)[None, :, None] & 1
        width = pitch(harmonics)
        signs = np.zeros((OCTANTS, width))
        signs[:, :harmonics] = np.where(octants & odd[None], -1.0, 1.0).prod(axis=1)

        def integers(values):
            return wp.array(values, dtype=wp.int32, device=device)

        self._device, self._dtype = device, dtype
        self._constants = {"HARMONICS": harmonics, "PITCH": width, "ROWS": len(rows), "GROUP_ROWS": used}
        self._tables = {
            "matrices": wp.array(table.ravel(), dtype=dtype, device=device),
            "signs": wp.array(signs, dtype=dtype, device=device),
            "parity": integers(np.pad(classes, (0, width - harmonics))),
            "row_parity": integers(np.repeat(classes[rows[::group]], group)),
            "row_harmonic": integers(rows),
        }

    def parts(self, shape) -> wp.array | None:
        """Return buffers for partial sums of local expansions, for GPUs with few boxes; else None."""
        splits = _splits(self._constants["ROWS"]) if self._device.is_cuda and shape[0] <= _MOST_SPLIT else 1
        return wp.zeros((splits, *shape), dtype=self._dtype, device=self._device) if splits > 1 else None

    def bind(self, multipoles, local, neighbors, children, parent, order, octant_begin, parts=None):
        """Return the arrays for :meth:`launch`: shared tables, and the given arrays.

        Args:
            multipoles: Multipoles of c boxes, then a row of zeros, shape [c + 1, pitch].
            local: Out: local expansions of the boxes in ``order``, shape [c + 1, pitch].
            neighbors, children, parent, order, octant_begin: Boxes, as in ``octree``.
            parts: Buffers from :meth:`parts` for these local expansions.
        """
        a = _arrays_type(self._dtype)()
        for name, table in self._tables.items():
            setattr(a, name, table)
        a.multipoles, a.locals, a.neighbors, a.children = multipoles, local, neighbors, children
        a.parent, a.order, a.octant_begin = parent, order, octant_begin
        if parts is not None:
            a.parts = parts
        return a

    def launch(self, arrays):
        """Launch the local expansions of all boxes, from the sources that are near neighbors of their parents."""
        boxes = arrays.multipoles.shape[0] - 1
        if self._device.is_cuda:
            self._launch_cuda(arrays, boxes)
            return
        kernel = _cpu_kernel(self._dtype, tuple(self._constants.items()))
        threads = threads_for(boxes, _BOXES_PER_THREAD)
        launch_passes(kernel, 0, 1, arrays, device=self._device, threads=threads)

    def _launch_cuda(self, a, boxes: int):
        """Launch the translation on a GPU, for at most ``boxes`` boxes."""
        splits = 1 if a.parts is None else a.parts.shape[0]
        kernel, threads = _cuda_kernel(self._dtype, splits, tuple(self._constants.items()))
        blocks = splits * (-(-boxes // _BOXES) + OCTANTS * a.octant_begin.shape[0])
        wp.launch(kernel, dim=blocks * threads, inputs=[a], device=self._device, block_dim=threads)
        if splits > 1:
            inputs = [a.octant_begin, a.locals.shape[1], a.parts.reshape((splits, -1)), a.locals.flatten()]
            wp.launch(_add_kernel(self._dtype), dim=a.locals.size, inputs=inputs, device=self._device)


def _slice(dtype) -> int:
    """Return the number of the sources' harmonics in shared memory at a time."""
    return 8 if dtype is wp.float32 else 4


def _grouped_rows(classes: np.ndarray, group: int, used: int) -> np.ndarray:
    """Return harmonics sorted by parity class, in groups of one class: ``used`` harmonics or −1, then −1."""
    groups = []
    for parity_class in range(OCTANTS):
        members = np.flatnonzero(classes == parity_class)
        padded = np.append(members, np.full(-len(members) % used, -1)).reshape(-1, used)
        groups.append(np.pad(padded, ((0, 0), (0, group - used)), constant_values=-1))
    return np.concatenate(groups).ravel()


def _threads(rows: int) -> int:
    """Return the threads of a GPU's block for ``rows`` rows, in whole warps."""
    return -(-(_BOXES // 8 * rows // _GROUP_ROWS) // 32) * 32


def _splits(rows: int) -> int:
    """Return the number of blocks that share the 56 displacements: more where blocks are small."""
    return 14 if _threads(rows) <= 64 else 4


def _used_rows(classes: np.ndarray) -> int:
    """Return the rows per thread of a GPU: 6 if groups of 6 take at least a tenth less work, else 8."""
    work = {used: used * _threads(len(_grouped_rows(classes, _GROUP_ROWS, used))) for used in (6, 8)}
    return 6 if work[6] <= 0.9 * work[8] else 8


@cache
def _cpu_kernel(dtype, constants):
    arguments = {**PASS_ARGUMENTS, "arrays": _arrays_type(dtype)}
    call = "cpu::translate(arrays, threads, team.data)"
    return native_kernel(call, "fmm/translate_cpu.h", arguments, dtype=dtype, **dict(constants))


@cache
def _cuda_kernel(dtype, splits: int, constants):
    """Return the kernel and the threads of its blocks."""
    constants = dict(constants)
    threads = _threads(constants["ROWS"])
    blocks = max(1, _WARPS_TOGETHER // (threads // 32)) if dtype is wp.float32 else 1
    call = f"translate_block<{_BOXES}, {_slice(dtype)}, {splits}>(thread, arrays)"
    arguments, launch = {"arrays": _arrays_type(dtype)}, {"grid_stride": False, "launch_bounds": (threads, blocks)}
    return native_kernel(call, "fmm/translate_cuda.h", arguments, dtype=dtype, launch=launch, **constants), threads


@cache
def _add_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def add_parts(octant_begin: wp.array2d[int], width: int, parts: wp.array2d[dtype], locals_out: wp.array[dtype]):
        i = wp.tid()
        if i >= octant_begin[octant_begin.shape[0] - 1, 8] * width:  # beyond the last box
            return
        total = parts[0, i]
        for part in range(1, parts.shape[0]):
            total += parts[part, i]
        locals_out[i] = total

    return add_parts
