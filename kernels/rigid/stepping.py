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

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.rigid import monitor

wp.set_module_options({"enable_backward": False})

LEVELS = 5
"""Lengths of substeps, each half the one before."""

FLAG_ATTEMPT = 0  # the step is to be attempted (again)
FLAG_REJECTED = 1  # the last attempt was rejected
FLAG_FORCES = 2  # the next substeps need forces of their own
FLAG_LEVEL = 3  # first of LEVELS: substeps of this level remain to be done
FLAGS = 8

STATUS_HALT = 0  # why steps do nothing: one of the reasons below
STATUS_DONE = 1  # steps done
STATUS_LEVEL = 2  # level of the substeps
STATUS_ATTEMPTS = 3  # attempts at the step under way
STATUS_REMAINING = 4  # pairs of substeps that this attempt still has to do
STATUS_REGROWN = 5  # buffers grew since the last step; set by the host
STATUS_SHARING = 6  # substeps that share their forces, a power of two; beyond the first level
STATUSES = 7

RUNNING, OVERFLOW, NOT_FINITE, PAUSED = range(4)
"""Values of ``STATUS_HALT``; the host pauses."""
STAGES = 3
"""Stages whose time is measured: induction, forces, rigid bodies."""

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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned long long t;
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(t));
    return t;
#elif defined(__aarch64__)
    return __builtin_arm_rsr64("cntvct_el0");
#else
    return __builtin_readcyclecounter();
#endif
""")
def now() -> wp.uint64:
    """Time of the device: nanoseconds on a GPU, clock cycles on a CPU."""


@wp.kernel
def _begin_step(a: StepArrays):
    a.flags[FLAG_ATTEMPT] = wp.where(a.status[STATUS_HALT] == RUNNING, 1, 0)


@wp.kernel
def _set_status(a: StepArrays, index: int, value: int):
    a.status[index] = value


@cache
def _copy_kernel(dtype):
    # A generic kernel would do, but graphs on the CPU replay the wrong one of its overloads (Warp 1.19).
    @wp.kernel(module="unique", enable_backward=False)
    def copy_where(flags_in: wp.array[wp.int32], flag: int, source_in: wp.array[dtype], target_out: wp.array[dtype]):
        i = wp.tid()
        if flags_in[flag] != 0:
            target_out[i] = source_in[i]

    return copy_where


@wp.kernel
def _begin_attempt(a: StepArrays):
    a.status[STATUS_ATTEMPTS] = a.status[STATUS_ATTEMPTS] + 1
    level = a.status[STATUS_LEVEL]
    a.status[STATUS_REMAINING] = (a.fewest // 2) << level
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
def _mark(a: StepArrays, stage: int):
    time = now()
    a.ticks[stage] = a.ticks[stage] + time - a.ticks[STAGES]
    a.ticks[STAGES] = time


@wp.kernel
def _watch_finite(a: StepArrays, half: int, body_q_in: wp.array[wp.transform], body_qd_in: wp.array[wp.spatial_vector]):
    body = wp.tid()
    total = wp.abs(body_q_in[body][0])
    for k in range(1, 7):
        total += wp.abs(body_q_in[body][k])
    for k in range(6):
        total += wp.abs(body_qd_in[body][k])
    if not wp.isfinite(total):
        pair = ((a.fewest // 2) << a.status[STATUS_LEVEL]) - a.status[STATUS_REMAINING]
        wp.atomic_min(a.counts, monitor.COUNT_BAD_BODY, (2 * pair + half) * body_q_in.shape[0] + body)


@wp.kernel
def _end_pair(a: StepArrays, level: int):
    remaining = a.status[STATUS_REMAINING] - 1
    a.status[STATUS_REMAINING] = remaining
    a.flags[FLAG_LEVEL + level] = wp.where(remaining > 0, 1, 0)
    # when forces are due, the pairs that remain are a multiple of those that share them
    a.flags[FLAG_FORCES] = wp.where((2 * remaining) % wp.max(a.status[STATUS_SHARING], 2) == 0, 1, 0)


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
        a.flags[FLAG_ATTEMPT] = 1
        if pressed:
            a.last_overlap[1] = overlap
        return
    if lost:
        a.status[STATUS_HALT] = NOT_FINITE
        return

    a.flags[FLAG_REJECTED] = 0
    a.last_overlap[0] = overlap
    a.last_overlap[1] = wp.inf
    _log_step(a, level)
    calm = overlap < 0.5 * a.overlap or (pressed and not helped)
    next_level = int(level)
    if calm and long_travel < a.ease * a.travel and level > 0:
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
        self.attempting, self.forces_due, *self.remaining = (
            a.flags[k : k + 1] for k in (FLAG_ATTEMPT, FLAG_FORCES, *range(FLAG_LEVEL, FLAG_LEVEL + LEVELS))
        )
        self.sharing = a.status[STATUS_SHARING : STATUS_SHARING + 1]

    def _launch(self, kernel, *inputs, dim: int = 1) -> None:
        wp.launch(kernel, dim=dim, inputs=[self.arrays, *inputs], device=self.arrays.status.device)

    def set_status(self, index: int, value: int) -> None:
        """Change one of the ``STATUS_*`` entries, for the host."""
        self._launch(_set_status, index, value)

    def begin_step(self) -> None:
        """Let a step be attempted, unless stepping is halted."""
        self._launch(_begin_step)

    def copy_where(self, flag: int, source, target) -> None:
        """Copy an array if a flag is set."""
        inputs = [self.arrays.flags, flag, source]
        wp.launch(_copy_kernel(source.dtype), len(source), inputs=inputs, outputs=[target], device=source.device)

    def begin_attempt(self) -> None:
        """Clear what the monitor writes and open the loop of the present level."""
        self._launch(_begin_attempt)

    def mark(self, stage: int) -> None:
        """Count the time since the last mark, or since the attempt began, as spent in ``stage``."""
        self._launch(_mark, stage)

    def watch_finite(self, half: int, state) -> None:
        """Note the first body whose pose or velocity is not finite: magnets pass that to all others within a substep.

        ``COUNT_BAD_BODY`` is the number of the substep times that of the bodies, plus the lowest such body in it.

        Args:
            half: Which substep of a pair begins with ``state``, 0 or 1.
            state: The state.
        """
        self._launch(_watch_finite, half, state.body_q, state.body_qd, dim=len(state.body_q))

    def end_pair(self, level: int) -> None:
        """Count two substeps of ``level`` as done."""
        self._launch(_end_pair, level)

    def judge(self) -> None:
        """Accept and log the attempt that was just made, or order another one, or halt."""
        self._launch(_judge)
