"""State machine of a step on the device: the next action, the acceptance of an attempt, and the log.

A step is attempted in substeps of one of ``LEVELS`` lengths, each half as long as that of the level before. By the
results of the ``monitor``, the step is accepted and logged. Otherwise the state is restored, and the step is attempted
at the next level, or a later one if motion is many times its limit. If a buffer was too small or a state was not
finite, stepping halts. While halted, steps do nothing, so that the host can read the status at any time and continue
from there.

Substeps are launched in pairs. Beyond the first level, several substeps share their magnetic forces, for at most the
length of a substep of the first level. Short substeps serve contacts between fast or strongly pressed bodies, and
forces vary more slowly. Shared forces are evaluated halfway between the poses at which the first and the last of these
substeps start, predicted from velocities. So they neither lag nor lead. Two substeps always share forces. More share
them, up to the length of one of the first level, where the motion of the last attempt is small compared with the
distance over which magnetic forces vary.
"""

import numpy as np
import warp as wp

from warpmag.kernels.rigid import monitor
from warpmag.kernels.rigid.monitor import STAGES, read_clock

wp.set_module_options({"enable_backward": False})

LEVELS = 5  # number of lengths of substeps, each half the one before

FLAG_ATTEMPT = 0  # the step must be attempted (again)
FLAG_REJECTED = 1  # the last attempt was rejected
FLAG_FORCES = 2  # the next substeps need new forces
FLAG_CONTACTS = 3  # the contacts are not those of the present state
FLAG_LEVEL = 4  # first of LEVELS flags: substeps of this level remain
FLAGS = FLAG_LEVEL + LEVELS

STATUS_HALT = 0  # reason why steps do nothing, see below
STATUS_DONE = 1  # number of completed steps
STATUS_LEVEL = 2  # level of the substeps
STATUS_ATTEMPTS = 3  # number of attempts at the present step
STATUS_REMAINING = 4  # remaining pairs of substeps of this attempt
STATUS_SUBSTEPS = 5  # completed substeps of this attempt
STATUS_REGROWN = 6  # 1 if buffers grew since the last step; set by the host
STATUS_SHARING = 7  # number of substeps that share forces beyond the first level, a power of two
STATUSES = 8

RUNNING, OVERFLOW, NOT_FINITE, PAUSED = range(4)  # values of ``STATUS_HALT``; the host sets ``PAUSED``
_WORDS_PER_THREAD = 16  # words of a state that a thread copies

LOG_SUBSTEPS, LOG_ATTEMPTS, LOG_CAPPED, LOG_REGROWN, LOG_EVALUATIONS, LOG_UNCONVERGED = range(6)
"""First entries of a record. ``LOG_CAPPED`` is 1 if the motion exceeded its limit although substeps were shortest."""
LOG_PEAKS = 6  # first of monitor.PEAKS
LOG_TICKS = LOG_PEAKS + monitor.PEAKS  # first of STAGES
LOG_FIELDS = LOG_TICKS + STAGES


@wp.struct
class StepArrays:
    """Arrays and limits of the state machine."""

    flags: wp.array[wp.int32]  # conditions of the loops around a step, see ``FLAG_*``
    status: wp.array[wp.int32]  # present state, see ``STATUS_*``
    peaks: wp.array[float]  # as in ``Monitor``, as are ``counts`` and ``ticks``
    counts: wp.array[wp.int32]
    # Deepest penetration over thickness, first of the last step, then of the last attempt at the present step. The
    # second number is infinite unless that attempt was rejected for its penetration.
    last_overlap: wp.array[float]
    ticks: wp.array[wp.uint64]
    log: wp.array2d[wp.float64]  # ring buffer with a record of each step, see ``LOG_*``, shape [records, LOG_FIELDS]
    capacities: wp.array[wp.int32]  # size of each monitored buffer
    travel: float  # limit of the motion in a substep over a body's thickness
    shared_travel: float  # limit of the motion over ``force_length`` while more than two substeps share forces
    overlap: float  # limit of a new penetration over the thickness of the thinner body
    growth_margin: float  # substeps double in length if the predicted motion stays below this fraction of ``travel``
    futile_ratio: float  # substeps are not shortened further if they leave more than this fraction of a penetration
    first_level_substeps: int  # substeps of a step at the first level, an even number


@wp.struct
class StateCopies:
    """Addresses of the arrays of a state and of its copy."""

    own: wp.array[wp.uint64]  # address of each array of the state, shape [arrays]
    saved: wp.array[wp.uint64]  # address of each array of the copy, shape [arrays]
    sizes: wp.array[wp.int32]  # bytes of each array, shape [arrays]
    ends: wp.array[wp.int32]  # cumulative number of whole words of the arrays, shape [arrays]


@wp.func
def _copy_chunk(chunk: int, copies: StateCopies, sources: wp.array[wp.uint64], targets: wp.array[wp.uint64]):
    """Copy a chunk of words; the first chunk also copies the trailing bytes of each array."""
    parts = copies.ends.shape[0]
    part = int(0)
    begin = int(0)
    for i in range(chunk * _WORDS_PER_THREAD, wp.min((chunk + 1) * _WORDS_PER_THREAD, copies.ends[parts - 1])):
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
def _begin_attempt(a: StepArrays):
    """Clear the monitor's arrays and start the loop of the present level."""
    level = a.status[STATUS_LEVEL]
    a.status[STATUS_ATTEMPTS] = a.status[STATUS_ATTEMPTS] + 1
    a.status[STATUS_REMAINING] = (a.first_level_substeps // 2) << level
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
    a.ticks[STAGES] = read_clock()


@wp.kernel
def _begin_step(a: StepArrays, copies: StateCopies):
    if a.status[STATUS_HALT] == RUNNING:
        _copy_chunk(wp.tid(), copies, copies.own, copies.saved)
        if wp.tid() == 0:
            _begin_attempt(a)


@wp.kernel
def _restore(a: StepArrays, copies: StateCopies):
    if a.flags[FLAG_REJECTED] != 0:
        _copy_chunk(wp.tid(), copies, copies.saved, copies.own)


@wp.kernel
def _set_status(a: StepArrays, index: int, value: int):
    a.status[index] = value


@wp.kernel
def _invalidate_contacts(a: StepArrays):
    a.flags[FLAG_CONTACTS] = 1


@wp.kernel
def _end_pair(a: StepArrays, level: int):
    remaining = a.status[STATUS_REMAINING] - 1
    a.status[STATUS_REMAINING] = remaining
    a.status[STATUS_SUBSTEPS] = a.status[STATUS_SUBSTEPS] + 2
    a.flags[FLAG_CONTACTS] = 1
    a.flags[FLAG_LEVEL + level] = wp.where(remaining > 0, 1, 0)
    # forces are due when the remaining substeps are a multiple of those that share them
    a.flags[FLAG_FORCES] = wp.where((2 * remaining) % wp.max(a.status[STATUS_SHARING], 2) == 0, 1, 0)


@wp.kernel
def _write_time(a: StepArrays, step: wp.float64, longest: wp.float64, time_out: wp.array[wp.float64]):
    substeps = wp.float64(a.status[STATUS_SUBSTEPS]) / wp.float64(1 << a.status[STATUS_LEVEL])
    time_out[0] = wp.float64(a.status[STATUS_DONE]) * step + substeps * longest


@wp.func
def _sharing_substeps(level: int, force_travel: float, travel_level: int, limit: float) -> int:
    """Return the number of substeps of ``level`` that share forces, from the motion in two of ``travel_level``."""
    count = 1 << level
    travel = 0.5 * force_travel * float(1 << travel_level)
    while count > 2 and not travel <= limit:
        count /= 2
        travel *= 0.5
    return count


@wp.func
def _needed_halvings(excess: float) -> int:
    """Return how often substeps are halved if motion is ``excess`` times its limit: never more than needed.

    A displacement by forces falls to a quarter when substeps are halved, other motion to half.
    """
    halvings = int(1)
    rest = float(excess)
    for _ in range(LEVELS):
        if rest > 4.0:
            halvings += 1
            rest *= 0.25
    return halvings


@wp.func
def _log_step(a: StepArrays, level: int):
    """Write the record of a step that was completed at ``level``."""
    record = a.status[STATUS_DONE] % a.log.shape[0]
    capped = a.peaks[monitor.PEAK_TRAVEL] > a.travel
    a.log[record, LOG_SUBSTEPS] = wp.float64(a.first_level_substeps << level)
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
def _end_attempt(a: StepArrays):
    a.flags[FLAG_ATTEMPT] = 0
    a.flags[FLAG_REJECTED] = 1
    a.flags[FLAG_CONTACTS] = 1
    for k in range(a.capacities.shape[0]):
        if a.counts[monitor.COUNT_CAPACITIES + k] > a.capacities[k]:
            a.status[STATUS_HALT] = OVERFLOW
            return
    level = a.status[STATUS_LEVEL]
    overlap = a.peaks[monitor.PEAK_OVERLAP]
    long_travel, force_travel = a.peaks[monitor.PEAK_LONG_TRAVEL], a.peaks[monitor.PEAK_FORCE_TRAVEL]
    is_deeper = overlap > wp.max(a.overlap, a.last_overlap[0])
    # shorter substeps reduce a penetration by fast bodies, but not one by a contact whose normal has changed
    improves = overlap < a.futile_ratio * a.last_overlap[1]
    not_finite = a.counts[monitor.COUNT_BAD_BODY] != monitor.NO_BODY
    if (a.peaks[monitor.PEAK_TRAVEL] > a.travel or (is_deeper and improves) or not_finite) and level + 1 < LEVELS:
        next_level = wp.min(level + _needed_halvings(a.peaks[monitor.PEAK_TRAVEL] / a.travel), LEVELS - 1)
        a.status[STATUS_LEVEL] = next_level
        a.status[STATUS_SHARING] = _sharing_substeps(next_level, force_travel, level, a.shared_travel)
        if is_deeper:
            a.last_overlap[1] = overlap
        _begin_attempt(a)
        return
    if not_finite:
        a.status[STATUS_HALT] = NOT_FINITE
        return

    a.flags[FLAG_REJECTED] = 0
    a.flags[FLAG_CONTACTS] = 0
    a.last_overlap[0] = overlap
    a.last_overlap[1] = wp.inf
    _log_step(a, level)
    may_grow = overlap < 0.5 * a.overlap or (is_deeper and not improves)
    next_level = level
    if a.peaks[monitor.PEAK_NEXT_TRAVEL] > a.travel:
        next_level = wp.min(level + 1, LEVELS - 1)
    elif may_grow and long_travel < a.growth_margin * a.travel and level > 0:
        next_level = level - 1
    a.status[STATUS_LEVEL] = next_level
    a.status[STATUS_SHARING] = _sharing_substeps(next_level, force_travel, level, a.shared_travel)


@wp.kernel
def _read_clock(time_out: wp.array[wp.uint64]):
    time_out[0] = read_clock()


def launch_read_clock(time):
    """Write the device's clock to ``time`` [1]."""
    wp.launch(_read_clock, dim=1, outputs=[time], device=time.device)


class StepMachine:
    """State machine of a step on a device. Its methods only launch kernels.

    Attributes:
        arrays: Arrays and limits.
        attempting: Condition that the step must be attempted (again).
        rejected: Condition that the last attempt was rejected.
        forces_due: Condition that the next substeps need new forces.
        contacts_due: Condition that the contacts are not those of the present state.
        sharing: Number of substeps that share forces, shape [1].
        remaining: For each level, the condition that substeps of it remain.
    """

    def __init__(self, records: int, capacities: int, device, **limits: float):
        """Allocate a log of ``records`` steps and ``capacities`` counts; ``limits`` are those of ``StepArrays``."""

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
        self.attempting, self.rejected, self.forces_due, self.contacts_due, *self.remaining = (
            a.flags[k : k + 1] for k in range(FLAGS)
        )
        self.sharing = a.status[STATUS_SHARING : STATUS_SHARING + 1]
        self.invalidate_contacts()

    def make_monitor(self, thickness, force_length, reach) -> monitor.Monitor:
        """Return the arrays of the monitor, for bodies of these sizes [m], shape [body_count]."""
        a, m = self.arrays, monitor.Monitor()
        m.thickness, m.force_length, m.reach = (
            wp.array(values, dtype=float, device=a.status.device) for values in (thickness, force_length, reach)
        )
        m.force_span = wp.clone(m.force_length)
        m.fill_counts = wp.zeros(len(a.capacities), dtype=wp.uint64, device=a.status.device)
        m.level = a.status[STATUS_LEVEL : STATUS_LEVEL + 1]
        m.substeps = a.status[STATUS_SUBSTEPS : STATUS_SUBSTEPS + 1]
        m.ticks, m.peaks, m.counts = a.ticks, a.peaks, a.counts
        return m

    def _launch(self, kernel, *inputs, dim: int = 1) -> None:
        wp.launch(kernel, dim=dim, inputs=[self.arrays, *inputs], device=self.arrays.status.device)

    def set_status(self, index: int, value: int) -> None:
        """Set one of the ``STATUS_*`` entries."""
        self._launch(_set_status, index, value)

    def invalidate_contacts(self) -> None:
        """Request new contacts before the next substep, after a change of the state or of the contact pipeline."""
        self._launch(_invalidate_contacts)

    def set_state_arrays(self, state: list, saved: list) -> None:
        """Set the contiguous arrays of the state that steps save and restore, and their copies."""
        device = self.arrays.status.device
        sizes = np.array([array.size * wp.types.type_size_in_bytes(array.dtype) for array in state], np.int32)
        ends = np.cumsum(sizes // 4, dtype=np.int32)
        self._arrays_alive = state, saved  # kernels hold only addresses
        self._chunks = max(1, -(-int(ends[-1]) // _WORDS_PER_THREAD))
        self._copies = copies = StateCopies()
        copies.own, copies.saved = (
            wp.array(np.array([array.ptr for array in arrays], np.uint64), device=device) for arrays in (state, saved)
        )
        copies.sizes, copies.ends = (wp.array(values, device=device) for values in (sizes, ends))

    def begin_step(self) -> None:
        """Save the state and begin the first attempt at a step, unless stepping is halted."""
        self._launch(_begin_step, self._copies, dim=self._chunks)

    def restore(self) -> None:
        """Restore the state at the beginning of the step if the attempt was rejected."""
        self._launch(_restore, self._copies, dim=self._chunks)

    def write_time(self, step: float, longest: float, time) -> None:
        """Write the time at which the next two substeps begin [s] to ``time`` [1].

        ``step`` is the length of a step, ``longest`` that of the substeps of the first level [s].
        """
        self._launch(_write_time, wp.float64(step), wp.float64(longest), time)

    def end_pair(self, level: int) -> None:
        """Count two completed substeps of ``level``."""
        self._launch(_end_pair, level)

    def end_attempt(self) -> None:
        """Accept and log the last attempt, or begin another one, or halt."""
        self._launch(_end_attempt)
