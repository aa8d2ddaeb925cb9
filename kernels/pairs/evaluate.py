"""Field (Eq. 1), and force and torque (Eqs. 4, 13, 14), of packed moments from sums over pairs.

A quantity is summed over all pairs of a target and its sources: 4π times the field H [A/m], or 4π times (e·∇)H [A²] for
an effective moment e of the target, or both. The native sums evaluate the dipole clamped at contact (``pair_law``). A
target has several partial sums where threads or blocks share its pairs. ``finish.h`` adds them up in a fixed order, so
that results do not depend on scheduling, and corrects overlapping pairs. Only this module chooses the form of the sums:

| form | native code | for |
|---|---|---|
| ``LOOP`` | ``sums_cuda``, ``sums_cpu`` | any moments; partial sums of tiles |
| ``FUSED`` | ``fused_cuda`` | few moments: one kernel sums a tile and finishes it, without partial sums |
| ``SHORT`` | ``short_finish_cuda`` | many targets with few sources each: one kernel, a group of threads a target |
| ``MIRRORED`` | ``mirror_cuda`` | many moments among themselves: each pair is evaluated once, for both its moments |
| ``REFERENCE`` | ``reference`` | a plain Warp loop, exact for overlapping balls, or with the paper's smoothing |

A caller may supply the sums, as ``fmm`` does (``GIVEN``). Where several processes have the same moments, each process
sums a part of the work list. The processes merge their partial sums, and each finishes all targets.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs import fused_cuda, mirror_cuda, sums_cuda, work_list
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import INVERSE_4PI, WIDTHS, Quantity
from warpmag.kernels.pairs.reference import launch_reference_sums
from warpmag.kernels.pairs.work_list import PAIRS_PER_THREAD
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads, most_blocks
from warpmag.kernels.shared.team import launch_passes, threads_for

LOOP, FUSED, SHORT, MIRRORED, REFERENCE, GIVEN = "loop", "fused", "short", "mirrored", "reference", "given"

# Measured on an H200: most targets for which the fused form is fastest, and fewest for which the mirrored form is
# fastest.
_MOST_FUSED = {Quantity.FIELD: 7000, Quantity.FORCE: 2640, Quantity.MUTUAL_FORCE: 2640, Quantity.WRENCH: 2640}
_LEAST_MIRRORED = {Quantity.FIELD: 5281, Quantity.MUTUAL_FORCE: 2641}
_LEAST_MUTUAL = 0.75  # least fraction of the sources that are targets, for which the mirrored form is faster
_MOST_SHORT = 160, 256
"""Most targets and most sources of a segment with the form ``SHORT``. A tile of the loop has 96 to 256 targets, most of
which would be copies."""
_FEWEST_PAIRS_OF_RANKS = {"cpu": 800_000, "cuda": 1_000_000_000}
"""Fewest pairs for which several processes share the sums, by kind of device."""
_CONSTANTS = {"CAPACITY": CAPACITY, "MU0": MU0, "INVERSE_4PI": INVERSE_4PI}


class PairEvaluation:
    """Field, or force and torque, of packed sources at packed targets, evaluated repeatedly in the same arrays.

    The field is H plus a base field. If targets and sources are the same moments, a moment's own field is left out. The
    force is μ0 (e·∇)H, the torque about the moment's position is μ0 e × H, of sources of other bodies.

    Args:
        quantity: Summed quantity: ``FIELD``; ``WRENCH``; ``FORCE``, with zero torque; or ``MUTUAL_FORCE``, a force
            where e is the moment itself.
        segments: Integers [k, 4]: targets begin and end, sources begin and end, as packed columns.
        copies: Number of equal runs of the segments, each as many columns after the run before.
        targets: Packed targets with their overlapping sources (``packing.PackedMoments``), t of them.
        base: Base field [A/m], which also exerts torques, shape [t].
        out: Out, field [A/m] or forces [N] at the targets of ``segments``, shape [t]. The form ``MIRRORED`` also writes
            other sources' elements.
        effective: Effective moments e [A·m²], shape [3, t]; None means the moments.
        with_torque: Nonzero where a torque is computed, shape [t].
        torques: Out, torques [N·m], shape [t].
        smoothing: Length ℓ [m] of the paper's smoothing, with the form ``REFERENCE``.
        form: Form of the sums; None means the fastest.
        sums: Function (effective moments, packed columns of the target rows, partial sums out) that launches the sums,
            in place of the forms of this module.
        ranks: Processes that share the sums (``warpmag.moments.ranks.Ranks``); None for a single process.

    Attributes:
        form: ``LOOP``, ``FUSED``, ``SHORT``, ``MIRRORED``, ``REFERENCE`` or ``GIVEN``.
        count: Number of target rows.
        target: Packed column of each target row, shape [count].
        tiles: Work list on the device (``work_list``), shape [tiles, TILE_COLUMNS].
        pair_count: Number of pairs of a target and a source.
        partial: Partial sums, shape [parts, rows, sums]; the caller's ``extra_parts`` are last.
    """

    def __init__(
        self, quantity, segments, targets, sources, base, out, *, copies=1, effective=None, with_torque=None,
        torques=None, extra_parts=0, smoothing=0.0, form=None, sums=None, ranks=None,
    ):  # fmt: skip
        """Choose the form and allocate its buffers."""
        segments = np.asarray(segments, np.int64).reshape(-1, 4)
        device, dtype = targets.device, targets.dtype
        self._given_sums = sums
        self.form = GIVEN if sums else form or _choose_form(quantity, segments, device, targets is sources, extra_parts)
        if self.form == MIRRORED:
            segments = segments[:1, [2, 3, 2, 3]]
        self._arrays = a = work_list.arrays_type(dtype)()
        a.target, a.begin, a.end = work_list.target_rows(segments, device, copies)
        self.target, self.count, self.pair_count = a.target, a.target.shape[0], work_list.pair_count(segments)
        fewest_pairs = _FEWEST_PAIRS_OF_RANKS["cuda" if device.is_cuda else "cpu"]
        shared = self.form in (LOOP, MIRRORED) and self.pair_count >= fewest_pairs
        self._ranks = ranks if shared else None
        self._finished = Quantity.FORCE if quantity == Quantity.MUTUAL_FORCE else quantity
        parts, tiles = self._plan_sums(quantity, segments, targets, targets is sources, smoothing)
        shape = parts + extra_parts, max(self.count, 1), WIDTHS[quantity]
        self.partial = a.partial = (wp.zeros if extra_parts else wp.empty)(shape, dtype=dtype, device=device)
        self._summed = self.partial[:parts] if self._ranks is not None else None
        self.tiles = a.tiles = wp.array(np.reshape(tiles, (-1, work_list.TILE_COLUMNS)), dtype=wp.int32, device=device)
        a.targets, a.sources, a.same_set = targets.packed, sources.packed, int(targets is sources)
        a.overlap, a.overlap_count = targets.overlaps, targets.overlap_counts
        a.effective = targets.moments if effective is None else effective
        a.base, a.out = base, out
        if quantity != Quantity.FIELD:
            a.with_torque, a.torques = with_torque, torques
        self._recorded = {}

    def _plan_sums(self, quantity, segments, targets, same_set, smoothing):
        """Set the function that launches the sums; return the number of partial sums per row, and the tiles."""
        device, finished, count = targets.device, self._finished, self.count
        launch_given = self._given_sums
        if launch_given is not None:
            self._launch_sums = lambda a: launch_given(a.effective, a.target, a.partial)
            return 1, ()
        if self.form == REFERENCE:
            self._launch_sums = lambda a: launch_reference_sums(finished, a, smoothing)
            return 1, ()
        if self.form == MIRRORED:
            shape = mirror_cuda.shape_for(quantity, count)
            plan = int(segments[0, 0]), count, shape, targets.dtype, device
            mirror = mirror_cuda.make_mirror(*plan, ranks=self._ranks)
            self._launch_sums = lambda a: mirror_cuda.launch_pair_loop_mirrored(quantity, mirror, a.sources, a.partial)
            return mirror.slabs + mirror.splits, ()
        if self.form == FUSED:
            shape = fused_cuda.choose_fused_shape(finished, count)
            self._launch_sums = lambda a: _launch_fused(finished, shape, a)
            return 0, work_list.block_tiles(segments, shape.targets)
        if self.form == SHORT:
            group = group_threads(device)
            kernel = _short_kernel(targets.dtype, finished, group)
            self._launch_sums = lambda _: self._launch_pass(kernel, 1, group)
            return 0, ()
        if device.is_cuda:
            shape = sums_cuda.choose_loop_shape(finished, count)
            tiles, parts = work_list.loop_tiles(segments, shape, device.sm_count)
            if self._ranks is not None:
                tiles = tiles[slice(*self._ranks.share(len(tiles)))]
            self._launch_sums = lambda a: sums_cuda.launch_pair_loop_cuda(
                finished, shape, a.targets, a.sources, a.effective, a.tiles, a.partial
            )
            return parts, tiles
        mutual = same_set and quantity in (Quantity.FIELD, Quantity.MUTUAL_FORCE)
        tiles, shares, parts, threads = work_list.cpu_tiles(segments, mutual, targets.dtype)
        if self._ranks is not None:
            tiles, shares = work_list.tiles_of_rank(tiles, shares, self._ranks)
        self._arrays.shares = wp.array(shares, dtype=wp.int32, device=device)
        pair_loop = _cpu_loop_kernel(targets.dtype, quantity)
        self._launch_sums = lambda _: self._launch_pass(pair_loop, threads, 1)
        return parts, tiles

    def launch(self, wait=None):
        """Launch the evaluation at all target rows; ``wait`` is called before the partial sums are added up."""
        if self.count == 0:
            return
        if self._ranks is not None:
            self._summed.zero_()
        self._launch_sums(self._arrays)
        if self._ranks is not None:
            self._ranks.merge(self._summed)
        if wait is not None:
            wait()
        if self.form not in (FUSED, SHORT):
            group = group_threads(self.partial.device, moments=self.count)
            finish = _finish_kernel(self.partial.dtype, self._finished, group)
            # the threads that summed are awake, and a row whose overlap list is full visits all its sources
            self._launch_pass(finish, threads_for(self.pair_count, PAIRS_PER_THREAD), group)

    def finish_active(self, active):
        """Finish only the rows in ``active`` from now on, on a GPU: their number, then the rows, shape [count + 1]."""
        self._arrays.active = active
        self._recorded.clear()

    def _launch_pass(self, kernel, threads, group):
        """Launch a pass over the target rows, with ``group`` threads a row on a GPU.

        The launch is recorded, so that the struct is packed only once.
        """
        if kernel not in self._recorded:
            device = self.partial.device
            sizes = dict(threads=threads, gpu_threads=group * self.count)
            sizes["max_blocks"] = most_blocks(device) if self._arrays.active else 0
            self._recorded[kernel] = launch_passes(kernel, 0, 1, self._arrays, device=device, record_cmd=True, **sizes)
        self._recorded[kernel].launch()


def _choose_form(quantity, segments, device, same_set, extra_parts) -> str:
    """Return the fastest form; ``same_set`` is true if targets and sources are the same moments."""
    if not device.is_cuda:
        return LOOP
    count = int(np.sum(segments[:, 1] - segments[:, 0]))
    if same_set and count >= _LEAST_MIRRORED.get(quantity, np.inf) and _are_mutual(segments, count):
        return MIRRORED
    if extra_parts:
        return LOOP
    if count <= _MOST_FUSED[quantity]:
        return FUSED
    sizes = segments[:, [1, 3]] - segments[:, [0, 2]]
    return SHORT if (sizes.max(axis=0) <= _MOST_SHORT).all() else LOOP


def _are_mutual(segments, count: int) -> bool:
    """Return whether the segments have one range of sources, and ``count`` targets are most of it."""
    if (segments[:, 2:] != segments[0, 2:]).any():
        return False
    begin, end = segments[0, 2:]
    inside = segments[:, 0].min() >= begin and segments[:, 1].max() <= end
    return bool(inside and count >= _LEAST_MUTUAL * (end - begin))


@cache
def _finish_kernel(dtype, quantity: Quantity, group: int):
    call = f"finish<warpmag::Quantity({quantity:d})>(thread, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": work_list.arrays_type(dtype)}
    return native_kernel(call, "pairs/finish.h", arguments, dtype=dtype, GROUP=group, **_CONSTANTS)


@cache
def _short_kernel(dtype, quantity: Quantity, group: int):
    call = f"sum_and_finish_row<warpmag::Quantity({quantity:d})>(arrays, thread / warpmag::GROUP)"
    arguments = {**PASS_ARGUMENTS, "arrays": work_list.arrays_type(dtype)}
    return native_kernel(call, "pairs/short_finish_cuda.h", arguments, dtype=dtype, GROUP=group, **_CONSTANTS)


@cache
def _cpu_loop_kernel(dtype, quantity: Quantity):
    call = f"cpu::sum_tiles<warpmag::Quantity({quantity:d})>(arrays, threads, team.data)"
    arguments = {**PASS_ARGUMENTS, "arrays": work_list.arrays_type(dtype)}
    return native_kernel(call, "pairs/sums_cpu.h", arguments, dtype=dtype, TILE_SIZE=work_list.tile_size(dtype))


@cache
def _fused_kernel(dtype, quantity: Quantity, shape):
    numbers = f"{shape.targets_per_lane}, {shape.lanes}, {shape.warps}, {shape.unrolled}"
    return native_kernel(
        f"sum_and_finish<warpmag::Quantity({quantity:d}), {numbers}>(arrays)",
        "pairs/fused_finish_cuda.h",
        {"arrays": work_list.arrays_type(dtype)},
        dtype=dtype,
        launch={"grid_stride": False, "launch_bounds": (shape.threads, 1)},
        GROUP=shape.shares,
        **_CONSTANTS,
    )


def _launch_fused(quantity: Quantity, shape, arrays):
    kernel, blocks = _fused_kernel(arrays.targets.dtype, quantity, shape), arrays.tiles.shape[0]
    threads, device = shape.threads, arrays.targets.device
    wp.launch(kernel, dim=blocks * threads, inputs=[arrays], device=device, block_dim=threads)
