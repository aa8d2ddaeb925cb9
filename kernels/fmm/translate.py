"""Translation of the multipoles of cells to the local expansions of others; ``translate.h`` has the equations.

A level is a grid of cells, of which only those that hold something exist. What a cell takes from afar comes from the
children of its parent's 26 neighbours, and of its parent, that are not its own neighbours: 189 where all of them exist.
Sums are in a fixed order, without atomics, so that results repeat bit by bit.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.passes import passes_kernel
from warpmag.kernels.shared.team import team, threads_for

_CELLS_PER_THREAD = 64
"""Cells that make another thread worth waking."""
_WARPS_TOGETHER = 12
"""Warps that a multiprocessor holds together in float32: what their registers allow."""
_CELLS = 32
"""Cells of a block of a GPU."""
_GROUP_ROWS = 8
"""Places for the rows of a thread of a GPU."""
_MOST_SPLIT = 8192
"""Most cells for which a GPU has room for several blocks that share the displacements of the same cells."""
OCTANTS = 8


def pitch(harmonics: int) -> int:
    """Coefficients of a row of an array of expansions, the last of them zero."""
    return -(-harmonics // 16) * 16


def displacements() -> np.ndarray:
    """The displacements, source − target, that have a matrix, in its order, shape [56, 3]."""
    x, y, z = np.arange(64) % 4, np.arange(64) // 4 % 4, np.arange(64) // 16
    return np.stack([x, y, z], axis=1)[np.maximum(np.maximum(x, y), z) > 1]


@cache
def translation_arrays(dtype):
    """Struct of what a translation works on."""

    @wp.struct
    class TranslationArrays:
        multipoles: wp.array2d[dtype]
        locals: wp.array2d[dtype]
        neighbors: wp.array2d[int]
        children: wp.array2d[int]
        parent: wp.array[int]
        order: wp.array[int]
        octant_begin: wp.array2d[int]
        parts: wp.array3d[dtype]
        matrices: wp.array[dtype]
        signs: wp.array2d[dtype]
        parity: wp.array[int]
        row_parity: wp.array[int]
        row_harmonic: wp.array[int]

    return TranslationArrays


class Translation:
    """Matrices and launch of the translation of multipoles of one degree.

    Args:
        matrices: Matrix of each of ``displacements``, harmonics of the target in rows, shape [56, K, K].
        parity: Signs ±1 that harmonics take where x, y or z changes its sign, shape [3, K].
        dtype: Warp scalar type of the coefficients.
        device: Warp device.
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
        """Partial sums for local expansions of a shape, which blocks of a GPU share where cells are few; else None."""
        splits = _splits(self._constants["ROWS"]) if self._device.is_cuda and shape[0] <= _MOST_SPLIT else 1
        return wp.zeros((splits, *shape), dtype=self._dtype, device=self._device) if splits > 1 else None

    def bind(self, multipoles, local, neighbors, children, parent, order, octant_begin, parts=None):
        """Return what :meth:`launch` works on; all evaluations have the same tables, and arrays of their own.

        Args:
            multipoles: Multipoles of c cells, and a row of zeros, shape [c + 1, pitch].
            local: Out, local expansions, of cells that are in ``order``, shape [c + 1, pitch].
            neighbors: Cell at each offset x + 3 y + 9 z, −1 for none, shape [c, 27].
            children: Child of each octant x + 2 y + 4 z of a cell, −1 for none, shape [c, 8].
            parent: Parent of each cell, −1 for none, shape [c].
            order: Cells of each level and octant.
            octant_begin: Where those of each octant begin and end in ``order``, shape [levels, 9].
            parts: What :meth:`parts` returned for these local expansions.
        """
        a = translation_arrays(self._dtype)()
        for name, table in self._tables.items():
            setattr(a, name, table)
        a.multipoles, a.locals, a.neighbors, a.children = multipoles, local, neighbors, children
        a.parent, a.order, a.octant_begin = parent, order, octant_begin
        if parts is not None:
            a.parts = parts
        return a

    def launch(self, arrays):
        """Set the far part of the local expansions of all cells, with what their parents do not have."""
        cells = arrays.multipoles.shape[0] - 1
        if self._device.is_cuda:
            self._launch_cuda(arrays, cells)
            return
        kernel = _cpu_kernel(self._dtype, tuple(self._constants.items()))
        threads = threads_for(cells, _CELLS_PER_THREAD)
        wp.launch(kernel, dim=1, inputs=[0, 1, threads, team(), arrays], device=self._device)

    def _launch_cuda(self, a, cells: int):
        """Launch the translation of arrays for so many cells on a GPU."""
        splits = 1 if a.parts is None else a.parts.shape[0]
        kernel, threads = _cuda_kernel(self._dtype, splits, tuple(self._constants.items()))
        blocks = splits * (-(-cells // _CELLS) + OCTANTS * a.octant_begin.shape[0])
        wp.launch(kernel, dim=blocks * threads, inputs=[a], device=self._device, block_dim=threads)
        if splits > 1:
            inputs = [a.octant_begin, a.locals.shape[1], a.parts.reshape((splits, -1)), a.locals.flatten()]
            wp.launch(_add_kernel(self._dtype), dim=a.locals.size, inputs=inputs, device=self._device)


def _slice(dtype) -> int:
    """Harmonics of the sources that a block has in shared memory at a time."""
    return 8 if dtype is wp.float32 else 4


def _grouped_rows(classes: np.ndarray, group: int, used: int) -> np.ndarray:
    """Harmonics sorted by class, in groups of which the first ``used`` hold some of one class, and −1 behind them."""
    groups = []
    for one in range(OCTANTS):
        members = np.flatnonzero(classes == one)
        padded = np.append(members, np.full(-len(members) % used, -1)).reshape(-1, used)
        groups.append(np.pad(padded, ((0, 0), (0, group - used)), constant_values=-1))
    return np.concatenate(groups).ravel()


def _threads(rows: int) -> int:
    """Threads of a block of a GPU for so many rows, in whole warps."""
    return -(-(_CELLS // 8 * rows // _GROUP_ROWS) // 32) * 32


def _splits(rows: int) -> int:
    """Blocks that share the 56 displacements of the same few cells: of small ones more have room."""
    return 14 if _threads(rows) <= 64 else 4


def _used_rows(classes: np.ndarray) -> int:
    """Rows of a thread of a GPU: 6 where classes fill groups of these so much better that a block has a tenth less."""
    work = {used: used * _threads(len(_grouped_rows(classes, _GROUP_ROWS, used))) for used in (6, 8)}
    return 6 if work[6] <= 0.9 * work[8] else 8


@cache
def _cpu_kernel(dtype, constants):
    return passes_kernel(
        "warpmag::cpu::translate(arrays, threads, team.data);",
        translation_arrays(dtype),
        native_options("fmm/translate_cpu.h", dtype=dtype, **dict(constants)),
    )


@cache
def _cuda_kernel(dtype, splits: int, constants):
    sizes = dict(constants)
    threads = _threads(sizes["ROWS"])
    arrays_struct = translation_arrays(dtype)
    blocks = max(1, _WARPS_TOGETHER // (threads // 32)) if dtype is wp.float32 else 1
    numbers = f"{_CELLS}, {_slice(dtype)}, {splits}"

    @wp.func_native(f"warpmag::translate_block<{numbers}>(thread, arrays);")
    def run(thread: int, arrays: arrays_struct): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(threads, blocks),
        module_options=native_options("fmm/translate_cuda.h", dtype=dtype, **sizes),
    )
    def translate_cuda(arrays: arrays_struct):
        run(wp.tid(), arrays)

    return translate_cuda, threads


@cache
def _add_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def add_parts(
        # inputs:
        octant_begin: wp.array2d[int],
        width: int,
        parts: wp.array2d[dtype],
        # outputs:
        locals_out: wp.array[dtype],
    ):
        i = wp.tid()
        if i >= octant_begin[octant_begin.shape[0] - 1, 8] * width:  # no cell
            return
        total = parts[0, i]
        for part in range(1, parts.shape[0]):
            total += parts[part, i]
        locals_out[i] = total

    return add_parts
