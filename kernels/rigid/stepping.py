"""The state machine of a step, on the device: what to do next, whether an attempt holds, and what to report.

A step is attempted in substeps of one of ``LEVELS`` lengths, each half as long as that of the level before. What the
``monitor`` found decides: the step is accepted and logged, or the state is restored and the step attempted at the next
level, or stepping halts, because a buffer was too small or a state was not finite. While halted, steps do nothing, so
that the host may look at any time and continue from there.

Substeps come in pairs. Where they are shorter than those of the first level, several share their magnetic forces, for
no longer than forces act at that level: substeps are short because of contacts between bodies that are fast or pressed
together. The forces are those half-way between the poses that the first and the last of these substeps start from, as
predicted by velocities, so that they neither lag nor lead. Two substeps always share them; more, up to as many as make
one of the first level, while the motion in the last attempt keeps their poses close to each other.
"""

import numpy as np
import warp as wp

from warpmag.kernels.rigid import monitor
from warpmag.kernels.rigid.monitor import STAGES, now

wp.set_module_options({"enable_backward": False})

LEVELS = 5
"""Lengths of substeps, each half the one before."""

FLAG_ATTEMPT = 0  # the step is to be attempted (again)
FLAG_REJECTED = 1  # the last attempt was rejected
FLAG_FORCES = 2  # the next substeps need forces of their own
FLAG_CONTACTS = 3  # the contacts known are not those of the present state
FLAG_LEVEL = 4  # first of LEVELS: substeps of this level remain to be done
FLAGS = FLAG_LEVEL + LEVELS

STATUS_HALT = 0  # why steps do nothing: one of the reasons below
STATUS_DONE = 1  # steps done
STATUS_LEVEL = 2  # level of the substeps
STATUS_ATTEMPTS = 3  # attempts at the step under way
STATUS_REMAINING = 4  # pairs of substeps that this attempt still has to do
STATUS_SUBSTEPS = 5  # substeps that it has done
STATUS_REGROWN = 6  # buffers grew since the last step; set by the host
STATUS_SHARING = 7  # substeps that share their forces, a power of two; beyond the first level
STATUSES = 8

RUNNING, OVERFLOW, NOT_FINITE, PAUSED = range(4)
"""Values of ``STATUS_HALT``; the host pauses."""
_CHUNK = 16
"""Words of a state that a thread copies."""

LOG_SUBSTEPS, LOG_ATTEMPTS, LOG_CAPPED, LOG_REGROWN, LOG_EVALUATIONS, LOG_UNCONVERGED = range(6)
LOG_PEAKS = 6  # first of monitor.PEAKS
LOG_TICKS = LOG_PEAKS + monitor.PEAKS  # first of STAGES
LOG_FIELDS = LOG_TICKS + STAGES


@wp.struct
class StepArrays:
    """Arrays and limits of the state machine.

    Attributes:
        flags: Conditions of the loops around a step, see ``FLAG_*``.
        status: Present state, see ``STATUS_*``.
        peaks, counts: What the ``monitor`` writes.
        last_overlap: Deepest penetration of the last step done; and of the last attempt at the present step that was
            rejected for it, else infinite.
        ticks: Time spent in each stage since the last step was accepted, then the time of the last mark; nanoseconds on
            a GPU, clock cycles on a CPU.
        log: A ring with a record of each step done, see ``LOG_*``, shape [records, LOG_FIELDS].
        capacities: Size of each buffer whose fill is watched.
        travel: Largest motion in a substep over a body's thickness.
        shared_travel: The same while more than two substeps share their forces.
        overlap: Deepest new penetration over the thickness of the thinner body.
        ease: Substeps become longer again where the motion in twice their length is below this part of ``travel``.
        futile: Substeps that leave more than this part of a penetration that was too deep do not become shorter still.
        fewest: Substeps of the first level, an even number.
    """

    flags: wp.array[wp.int32]
    status: wp.array[wp.int32]
    peaks: wp.array[float]
    counts: wp.array[wp.int32]
    last_overlap: wp.array[float]
    ticks: wp.array[wp.uint64]
    log: wp.array2d[wp.float64]
    capacities: wp.array[wp.int32]
    travel: float
    shared_travel: float
    overlap: float
    ease: float
    futile: float
    fewest: int


@wp.struct
class StateCopies:
    """Arrays of a state and of its copy, as addresses.

    Attributes:
        own, saved: Where each array begins, shape [arrays].
        sizes: Bytes of each array, shape [arrays].
        ends: Whole words of all arrays up to the end of each, shape [arrays].
    """

    own: wp.array[wp.uint64]
    saved: wp.array[wp.uint64]
    sizes: wp.array[wp.int32]
    ends: wp.array[wp.int32]


@wp.func
def _copy_chunk(chunk: int, copies: StateCopies, sources: wp.array[wp.uint64], targets: wp.array[wp.uint64]):
    """Copy some words, and with the first ones the bytes that fill none."""
    parts = copies.ends.shape[0]
    part = int(0)
    begin = int(0)
    for i in range(chunk * _CHUNK, wp.min((chunk + 1) * _CHUNK, copies.ends[parts - 1])):
        while i >= copies.ends[part]:
            begin = copies.ends[part]
            part += 1
        source = wp.array(ptr=sources[part], shape=(copies.sizes[part] // 4,), dtype=wp.uint32)
        target = wp.array(ptr=targets[part], shape=(copies.sizes[part] // 4,), dtype=wp.uint32)
        target[i - begin] = source[i - begin]
    if chunk == 0:
        for k in range(parts):
            size = copies.sizes[k]
            source_bytes = wp.array(ptr=sources[k], shape=(size,), dtype=wp.uint8)
            target_bytes = wp.array(ptr=targets[k], shape=(size,), dtype=wp.uint8)
            for i in range(size // 4 * 4, size):
                target_bytes[i] = source_bytes[i]


@wp.func
def _open_attempt(a: StepArrays):
    """Clear what the monitor writes and open the loop of the present level."""
    level = a.status[STATUS_LEVEL]
    a.status[STATUS_ATTEMPTS] = a.status[STATUS_ATTEMPTS] + 1
    a.status[STATUS_REMAINING] = (a.fewest // 2) << level
    a.status[STATUS_SUBSTEPS] = 0
    a.flags[FLAG_ATTEMPT] = 1
    a.flags[FLAG_FORCES] = 1
    for k in range(LEVELS):
        a.flags[FLAG_LEVEL + k] = wp.where(k == level, 1, 0)
    for k in range(a.peaks.shape[0]):
        a.peaks[k] = 0.0
    for k in range(a.counts.shape[0]):
        a.counts[k] = 0
    a.counts[monitor.COUNT_BAD_BODY] = monitor.NO_BODY
    a.ticks[STAGES] = now()


@wp.kernel
def _begin_step(a: StepArrays, copies: StateCopies):
    if a.status[STATUS_HALT] == RUNNING:
        _copy_chunk(wp.tid(), copies, copies.own, copies.saved)
        if wp.tid() == 0:
            _open_attempt(a)


@wp.kernel
def _restore(a: StepArrays, copies: StateCopies):
    if a.flags[FLAG_REJECTED] != 0:
        _copy_chunk(wp.tid(), copies, copies.saved, copies.own)


@wp.kernel
def _set_status(a: StepArrays, index: int, value: int):
    a.status[index] = value


@wp.kernel
def _forget_contacts(a: StepArrays):
    a.flags[FLAG_CONTACTS] = 1


@wp.kernel
def _end_pair(a: StepArrays, level: int):
    remaining = a.status[STATUS_REMAINING] - 1
    a.status[STATUS_REMAINING] = remaining
    a.status[STATUS_SUBSTEPS] = a.status[STATUS_SUBSTEPS] + 2
    a.flags[FLAG_CONTACTS] = 1
    a.flags[FLAG_LEVEL + level] = wp.where(remaining > 0, 1, 0)
    # when forces are due, the pairs that remain are a multiple of those that share them
    a.flags[FLAG_FORCES] = wp.where((2 * remaining) % wp.max(a.status[STATUS_SHARING], 2) == 0, 1, 0)


@wp.kernel
def _tell_time(a: StepArrays, step: wp.float64, longest: wp.float64, time_out: wp.array[wp.float64]):
    substeps = wp.float64(a.status[STATUS_SUBSTEPS]) / wp.float64(1 << a.status[STATUS_LEVEL])
    time_out[0] = wp.float64(a.status[STATUS_DONE]) * step + substeps * longest


@wp.func
def _sharing(level: int, long_travel: float, seen_at: int, limit: float) -> int:
    """Number of substeps of ``level`` to share forces, from the motion in two substeps of level ``seen_at``."""
    count = 1 << level
    travel = 0.5 * long_travel * float(1 << seen_at)
    while count > 2 and not travel <= limit:
        count /= 2
        travel *= 0.5
    return count


@wp.func
def _log_step(a: StepArrays, level: int):
    """Write the record of a step that was done at ``level``."""
    record = a.status[STATUS_DONE] % a.log.shape[0]
    capped = a.peaks[monitor.PEAK_TRAVEL] > a.travel
    a.log[record, LOG_SUBSTEPS] = wp.float64(a.fewest << level)
    a.log[record, LOG_ATTEMPTS] = wp.float64(a.status[STATUS_ATTEMPTS])
    a.log[record, LOG_CAPPED] = wp.where(capped, wp.float64(1.0), wp.float64(0.0))
    a.log[record, LOG_REGROWN] = wp.float64(a.status[STATUS_REGROWN])
    a.log[record, LOG_EVALUATIONS] = wp.float64(a.counts[monitor.COUNT_EVALUATIONS])
    a.log[record, LOG_UNCONVERGED] = wp.float64(a.counts[monitor.COUNT_UNCONVERGED])
    for k in range(a.peaks.shape[0]):
        a.log[record, LOG_PEAKS + k] = wp.float64(a.peaks[k])
    for k in range(STAGES):
        a.log[record, LOG_TICKS + k] = wp.float64(a.ticks[k])
        a.ticks[k] = wp.uint64(0)
    a.status[STATUS_DONE] = a.status[STATUS_DONE] + 1
    a.status[STATUS_ATTEMPTS] = 0
    a.status[STATUS_REGROWN] = 0


@wp.kernel
def _judge(a: StepArrays):
    a.flags[FLAG_ATTEMPT] = 0
    a.flags[FLAG_REJECTED] = 1
    a.flags[FLAG_CONTACTS] = 1
    for k in range(a.capacities.shape[0]):
        if a.counts[monitor.COUNT_CAPACITIES + k] > a.capacities[k]:
            a.status[STATUS_HALT] = OVERFLOW
            return
    level = a.status[STATUS_LEVEL]
    overlap = a.peaks[monitor.PEAK_OVERLAP]
    long_travel = a.peaks[monitor.PEAK_LONG_TRAVEL]
    pressed = overlap > wp.max(a.overlap, a.last_overlap[0])
    # shorter substeps undo what was pressed too fast, but not a contact that found another normal
    helped = overlap < a.futile * a.last_overlap[1]
    lost = a.counts[monitor.COUNT_BAD_BODY] != monitor.NO_BODY
    if (a.peaks[monitor.PEAK_TRAVEL] > a.travel or (pressed and helped) or lost) and level + 1 < LEVELS:
        a.status[STATUS_LEVEL] = level + 1
        a.status[STATUS_SHARING] = _sharing(level + 1, long_travel, level, a.shared_travel)
        if pressed:
            a.last_overlap[1] = overlap
        _open_attempt(a)
        return
    if lost:
        a.status[STATUS_HALT] = NOT_FINITE
        return

    a.flags[FLAG_REJECTED] = 0
    a.flags[FLAG_CONTACTS] = 0
    a.last_overlap[0] = overlap
    a.last_overlap[1] = wp.inf
    _log_step(a, level)
    calm = overlap < 0.5 * a.overlap or (pressed and not helped)
    next_level = int(level)
    if a.peaks[monitor.PEAK_NEXT_TRAVEL] > a.travel:
        next_level = wp.min(level + 1, LEVELS - 1)
    elif calm and long_travel < a.ease * a.travel and level > 0:
        next_level = level - 1
    a.status[STATUS_LEVEL] = next_level
    a.status[STATUS_SHARING] = _sharing(next_level, long_travel, level, a.shared_travel)


@wp.kernel
def _read_clock(time_out: wp.array[wp.uint64]):
    time_out[0] = now()


def launch_read_clock(time):
    """Write the device's time into ``time`` [1]."""
    wp.launch(_read_clock, dim=1, outputs=[time], device=time.device)


class StepMachine:
    """The state machine on one device; every method only launches a kernel.

    Attributes:
        arrays: Its arrays and limits.
        attempting: Condition: the step is to be attempted (again).
        forces_due: Condition: the next substeps need forces of their own.
        contacts_due: Condition: the contacts known are not those of the present state.
        sharing: Number of substeps that share their forces, shape [1].
        remaining: Condition for each level: substeps of it remain to be done.
    """

    def __init__(self, records: int, capacities: int, device, **limits: float):
        """Allocate the arrays.

        Args:
            records: Steps that the log holds.
            capacities: How many buffers are watched.
            device: Device.
            **limits: The limits of ``StepArrays``.
        """

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self.arrays = a = StepArrays()
        a.flags, a.status = zeros(FLAGS, wp.int32), zeros(STATUSES, wp.int32)
        a.peaks, a.counts = zeros(monitor.PEAKS, wp.float32), zeros(monitor.COUNT_CAPACITIES + capacities, wp.int32)
        a.last_overlap = wp.array([0.0, np.inf], dtype=wp.float32, device=device)
        a.ticks, a.log = zeros(STAGES + 1, wp.uint64), zeros((records, LOG_FIELDS), wp.float64)
        a.capacities = zeros(capacities, wp.int32)
        for name, limit in limits.items():
            setattr(a, name, limit)
        self.attempting, _, self.forces_due, self.contacts_due, *self.remaining = (
            a.flags[k : k + 1] for k in range(FLAGS)
        )
        self.sharing = a.status[STATUS_SHARING : STATUS_SHARING + 1]
        self.forget_contacts()

    def watched(self, thickness, reach) -> monitor.Watched:
        """Return what the monitor is to watch.

        Args:
            thickness, reach: Sizes of the bodies [m], see ``monitor``, shape [body_count].
        """
        a, watched = self.arrays, monitor.Watched()
        watched.thickness, watched.reach = (
            wp.array(values, dtype=float, device=a.status.device) for values in (thickness, reach)
        )
        watched.fills = wp.zeros(len(a.capacities), dtype=wp.uint64, device=a.status.device)
        watched.level = a.status[STATUS_LEVEL : STATUS_LEVEL + 1]
        watched.substeps = a.status[STATUS_SUBSTEPS : STATUS_SUBSTEPS + 1]
        watched.ticks, watched.peaks, watched.counts = a.ticks, a.peaks, a.counts
        return watched

    def _launch(self, kernel, *inputs, dim: int = 1) -> None:
        wp.launch(kernel, dim=dim, inputs=[self.arrays, *inputs], device=self.arrays.status.device)

    def set_status(self, index: int, value: int) -> None:
        """Change one of the ``STATUS_*`` entries, for the host."""
        self._launch(_set_status, index, value)

    def forget_contacts(self) -> None:
        """Have contacts found anew before the next substep: the state, or what finds them, may have changed."""
        self._launch(_forget_contacts)

    def keep(self, state: list, saved: list) -> None:
        """Say which arrays make up a state, and which their copies.

        Args:
            state: Contiguous arrays.
            saved: Arrays like them.
        """
        device = self.arrays.status.device
        sizes = np.array([one.size * wp.types.type_size_in_bytes(one.dtype) for one in state], np.int32)
        ends = np.cumsum(sizes // 4, dtype=np.int32)
        self._kept = state, saved  # alive: kernels know addresses alone
        self._chunks = max(1, -(-int(ends[-1]) // _CHUNK))
        self._copies = copies = StateCopies()
        copies.own, copies.saved = (
            wp.array(np.array([one.ptr for one in arrays], np.uint64), device=device) for arrays in (state, saved)
        )
        copies.sizes, copies.ends = (wp.array(values, device=device) for values in (sizes, ends))

    def begin_step(self) -> None:
        """Save the state and let a step be attempted, unless stepping is halted."""
        self._launch(_begin_step, self._copies, dim=self._chunks)

    def restore(self) -> None:
        """Take the state back to where the step began if the attempt was rejected."""
        self._launch(_restore, self._copies, dim=self._chunks)

    def tell_time(self, step: float, longest: float, time) -> None:
        """Write the time at which the next two substeps begin [s] into ``time`` [1].

        Args:
            step: Length of a step [s].
            longest: Length of the substeps of the first level [s].
            time: Out.
        """
        self._launch(_tell_time, wp.float64(step), wp.float64(longest), time)

    def end_pair(self, level: int) -> None:
        """Count two substeps of ``level`` as done."""
        self._launch(_end_pair, level)

    def judge(self) -> None:
        """Accept and log the attempt that was just made, or order another one, or halt."""
        self._launch(_judge)
