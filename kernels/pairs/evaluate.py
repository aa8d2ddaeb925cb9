"""Field (Eq. 1), and force and torque (Eqs. 4, 13, 14), of packed moments: sums over pairs, and what follows them.

A quantity is summed over all pairs of a target and its sources: 4π times the field H [A/m], or 4π times (e·∇)H [A²] for
an effective moment e of the target, or both. The native sums evaluate the dipole clamped at contact (see ``pair_law``).
They are stored as partial sums, several of a target where threads or blocks share out the pairs. ``finish.h`` adds them
up in a fixed order, so that results do not depend on scheduling, and corrects pairs that overlap. This is the one place
where the form of the sums is chosen:

| form | native code | for |
|---|---|---|
| ``LOOP`` | ``sums_cuda``, ``sums_cpu`` | anything; partial sums of tiles |
| ``FUSED`` | ``fused_cuda`` | few moments: one kernel sums a tile and finishes it, without partial sums |
| ``MIRRORED`` | ``mirror_cuda`` | many moments among themselves: each pair is evaluated once, for both of its ends |
| ``REFERENCE`` | ``reference`` | a plain Warp loop, exact for overlapping balls, or with the paper's smoothing |
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.pairs import fused_cuda, mirror_cuda, sums_cuda
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.pair_terms import TILE_COLUMNS, WIDTHS, Quantity
from warpmag.kernels.pairs.reference import launch_reference_sums
from warpmag.kernels.pairs.sums_cpu import launch_pair_loop_cpu
from warpmag.kernels.pairs.work_list import TargetRows, arrays_type, block_tiles, cpu_tiles, make_rows, pair_count
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.passes import passes_kernel
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for

LOOP, FUSED, MIRRORED, REFERENCE = "loop", "fused", "mirrored", "reference"

# Measured on an H200: the most targets for which the fused form is best, and the fewest for which the mirrored is.
_MOST_FUSED = {Quantity.FIELD: 7000, Quantity.FORCE: 2640, Quantity.MUTUAL_FORCE: 2640, Quantity.WRENCH: 2640}
_LEAST_MIRRORED = {Quantity.FIELD: 5281, Quantity.MUTUAL_FORCE: 2641}
_LEAST_MUTUAL = 0.75
"""Least part of the sources that are targets, for both ends of a pair to be worth what the mirrored form costs."""
_GROUP = 8
"""Threads of a GPU that finish a target row."""
_CONSTANTS = {"CAPACITY": CAPACITY, "MU0": MU0, "INVERSE_4PI": INVERSE_4PI}


# Each form: the number of partial sums of a target row, its tiles, and a launch of its sums.


class _CpuLoop:
    def __init__(self, quantity, segments, device):
        self.tiles, shares, self._threads = cpu_tiles(segments)
        self.parts, self._quantity = len(shares) - 1, quantity
        self._shares = wp.array(shares, dtype=wp.int32, device=device)

    def launch(self, a):
        launch_pair_loop_cpu(
            self._quantity, a.targets, a.sources, a.effective, a.tiles, self._shares, self._threads, a.partial
        )


class _CudaLoop:
    def __init__(self, quantity, segments, device):
        sizes, longest = segments[:, 1] - segments[:, 0], int(np.max(segments[:, 3] - segments[:, 2], initial=0))
        self._quantity, self._shape = quantity, sums_cuda.choose_loop_shape(quantity, int(sizes.sum()))
        width = 32 * self._shape.targets
        tiles = int(np.sum(-(-sizes // width)))
        self.parts = sums_cuda.choose_splits(self._shape, tiles, longest, device.sm_count)
        self.tiles = block_tiles(segments, width, self.parts)

    def launch(self, a):
        sums_cuda.launch_pair_loop_cuda(
            self._quantity, self._shape, a.targets, a.sources, a.effective, a.tiles, a.partial
        )


class _MirroredSums:
    tiles = ()

    def __init__(self, quantity, segments, device):
        begin, end = segments[0, :2]
        self._mirror = mirror_cuda.make_mirror(int(begin), int(end - begin), quantity, device)
        self.parts = self._mirror.slabs + self._mirror.splits

    def launch(self, a):
        mirror_cuda.launch_pair_loop_mirrored(self._mirror, a.sources, a.partial)


class _FusedSums:
    parts = 0

    def __init__(self, quantity, segments, device):
        self._quantity, self._device = quantity, device
        self._shape = fused_cuda.choose_fused_shape(quantity, int(np.sum(segments[:, 1] - segments[:, 0])))
        self.tiles = block_tiles(segments, self._shape.targets)

    def launch(self, a):
        threads = self._shape.threads
        wp.launch(
            _fused_kernel(a.targets.dtype, self._quantity, self._shape),
            dim=len(self.tiles) * threads,
            inputs=[a],
            device=self._device,
            block_dim=threads,
        )


class _ReferenceSums:
    tiles, parts = (), 1

    def __init__(self, quantity, smoothing):
        self._quantity, self._smoothing = quantity, smoothing

    def launch(self, a):
        launch_reference_sums(self._quantity, a, self._smoothing)


class PairEvaluation:
    """Field, or force and torque, of packed sources at packed targets, again and again in the same arrays.

    Attributes:
        form: How the sums are made: ``LOOP``, ``FUSED``, ``MIRRORED`` or ``REFERENCE``.
        rows: Target rows.
        pair_count: Pairs of a target and a source.
        partial: Partial sums, shape [parts, rows, sums]; the last ``extra_parts`` of them are written by the caller.
    """

    rows: TargetRows

    def __init__(
        self, quantity, segments, targets, sources, *, extra_parts=0, smoothing=0.0, form=None, effective=None, **given
    ):
        """Allocate for :func:`field_evaluation` or :func:`wrench_evaluation`, which see.

        Args:
            quantity: What is summed.
            segments: Integers [k, 4]: packed column of targets begin and end, and of their sources begin and end.
            targets: Packed targets with their overlapping sources (``packing.PackedMoments``).
            sources: Packed sources.
            extra_parts: Partial sums that the caller adds.
            smoothing: Length ℓ [m] of the paper's smoothing, with the form ``REFERENCE``.
            form: Form of the sums; None means the fastest.
            effective: Effective moments [A·m²], shape [3, targets]; None means the targets' moments.
            given: Other arrays of the struct.
        """
        segments = np.asarray(segments, np.int64).reshape(-1, 4)
        device, dtype = targets.device, targets.dtype
        self.form = form or _choose_form(quantity, segments, device, targets is sources, extra_parts)
        if self.form == MIRRORED:
            segments = segments[:1, [2, 3, 2, 3]]
        self.rows, self.pair_count = make_rows(segments, device), pair_count(segments)
        self._finished = Quantity.FORCE if quantity == Quantity.MUTUAL_FORCE else quantity
        if self.form == REFERENCE:
            self._sums = _ReferenceSums(self._finished, smoothing)
        elif self.form == MIRRORED:
            self._sums = _MirroredSums(quantity, segments, device)
        elif self.form == FUSED:
            self._sums = _FusedSums(self._finished, segments, device)
        elif device.is_cuda:
            self._sums = _CudaLoop(self._finished, segments, device)
        else:
            self._sums = _CpuLoop(quantity, segments, device)
        shape = self._sums.parts + extra_parts, max(self.rows.count, 1), WIDTHS[quantity]
        self.partial = wp.zeros(shape, dtype=dtype, device=device)
        self._arrays = a = arrays_type(dtype)()
        a.target, a.begin, a.end, a.partial = self.rows.target, self.rows.begin, self.rows.end, self.partial
        a.tiles = wp.array(np.reshape(self._sums.tiles, (-1, TILE_COLUMNS)), dtype=wp.int32, device=device)
        a.targets, a.sources, a.same_set = targets.packed, sources.packed, int(targets is sources)
        a.overlap, a.overlap_count = targets.overlaps, targets.overlap_counts
        a.effective = targets.moments if effective is None else effective
        for name, array in given.items():
            setattr(a, name, array)
        self._finish = None

    def launch(self, wait=None):
        """Evaluate at all target rows; ``wait``, if given, is called before the partial sums are added up."""
        if self.rows.count == 0:
            return
        self._sums.launch(self._arrays)
        if wait is not None:
            wait()
        if self.form != FUSED:
            self._launch_finish()

    def _launch_finish(self):
        """Launch what follows the sums, recorded, which spares packing the struct each time."""
        if self._finish is None:
            device, count = self.partial.device, self.rows.count
            self._finish = wp.launch(
                _finish_kernel(self.partial.dtype, self._finished),
                # whole warps, since all threads of one take part in sums over groups
                dim=32 * -(-_GROUP * count // 32) if device.is_cuda else 1,
                inputs=[0, 1, threads_for(count, MOMENTS_PER_THREAD), None if device.is_cuda else team(), self._arrays],
                device=device,
                record_cmd=True,
            )
        self._finish.launch()


def field_evaluation(segments, targets, sources, base, h, **options) -> PairEvaluation:
    """Evaluation of the field (Eq. 1) of the sources at the targets, on top of a given one.

    Moments that are targets and sources have no field at their own place.

    Args:
        segments: See :class:`PairEvaluation`.
        targets: Packed targets, t of them.
        sources: Packed sources.
        base: Field to start from [A/m], shape [t].
        h: Out, field [A/m], shape [t]; written are the targets of ``segments``, in the form ``MIRRORED`` others, too.
        options: See :class:`PairEvaluation`.
    """
    return PairEvaluation(Quantity.FIELD, segments, targets, sources, base=base, out=h, **options)


def wrench_evaluation(
    quantity, segments, moments, external_field, turned, forces, torques, **options
) -> PairEvaluation:
    """Evaluation of the force (e·∇)H (Eqs. 4, 13, 14) and the torque e × H on moments by those of other bodies.

    Args:
        quantity: ``WRENCH``; or ``FORCE``, with no torque; or ``MUTUAL_FORCE``, the same where e is the moment.
        segments: See :class:`PairEvaluation`.
        moments: Packed moments, n of them.
        external_field: Applied field [A/m], shape [n].
        turned: Whether the torque on a moment is wanted, shape [n].
        forces: Out, forces [N], shape [n].
        torques: Out, torques about each moment [N·m], shape [n].
        options: See :class:`PairEvaluation`.
    """
    given = {"base": external_field, "turned": turned, "out": forces, "torques": torques}
    return PairEvaluation(quantity, segments, moments, moments, **given, **options)


def _choose_form(quantity, segments, device, among, extra_parts) -> str:
    """The fastest form; ``among`` says whether targets and sources are the same moments."""
    if not device.is_cuda:
        return LOOP
    count = int(np.sum(segments[:, 1] - segments[:, 0]))
    if among and count >= _LEAST_MIRRORED.get(quantity, np.inf) and _are_mutual(segments, count):
        return MIRRORED
    return FUSED if count <= _MOST_FUSED[quantity] and not extra_parts else LOOP


def _are_mutual(segments, count: int) -> bool:
    """Whether ``count`` targets are most of the only range of sources, so that both ends of most pairs are wanted."""
    if (segments[:, 2:] != segments[0, 2:]).any():
        return False
    begin, end = segments[0, 2:]
    inside = segments[:, 0].min() >= begin and segments[:, 1].max() <= end
    return bool(inside and count >= _LEAST_MUTUAL * (end - begin))


@cache
def _finish_kernel(dtype, quantity: Quantity):
    return passes_kernel(
        f"warpmag::finish<warpmag::Quantity({quantity:d})>(thread, threads, team.data, arrays);",
        arrays_type(dtype),
        native_options("pairs/finish.h", dtype=dtype, GROUP=_GROUP, **_CONSTANTS),
    )


@cache
def _fused_kernel(dtype, quantity: Quantity, shape):
    sums_arrays = arrays_type(dtype)
    numbers = f"{shape.held}, {shape.lanes}, {shape.warps}, {shape.unrolled}"

    @wp.func_native(f"warpmag::sum_and_finish<warpmag::Quantity({quantity:d}), {numbers}>(arrays);")
    def run(arrays: sums_arrays): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(shape.threads, 1),
        module_options=native_options("pairs/fused_finish_cuda.h", dtype=dtype, GROUP=shape.shares, **_CONSTANTS),
    )
    def sum_and_finish(arrays: sums_arrays):
        run(arrays)

    return sum_and_finish
