"""The state machine of a step, on the device: what to do next, whether what was done holds, and what to report.

A step is tried in substeps of one of ``LEVELS`` lengths, each half as long as that of the level before. What the
monitor (``kernels.monitor``) saw of it decides: it is accepted and reported, or the state is put back and the step
tried at the next level, or stepping halts, because a buffer was too small or a body left all finite numbers. While
halted, steps do nothing, so that the host may look whenever it likes and go on from exactly there.

Substeps come in pairs. Where they are shorter than those of the first level, several share their magnetic forces, which
then act no longer than they do at that level: what makes substeps short is contacts of bodies that are fast or pressed.
The forces are those half-way between the poses that the first and the last of these substeps start from, as far as
velocities tell, so that they neither lag nor lead. Two substeps always share them; more, up to as many as make one of
the first level, while the motion seen in the last attempt keeps their poses close to each other.

``flags`` [int32]: conditions of the loops around a step, see the ``FLAG_*`` indices.
``status`` [int32]: where stepping stands, see the ``STATUS_*`` indices.
``log`` [float64, shape [records, LOG_FIELDS]]: a ring with a record of each step done, see the ``LOG_*`` indices.
``last_overlap`` [float32]: deepest penetration of the last step done; and of the present step's last attempt that was
put back for it, else infinite.
``ticks`` [uint64]: time spent in each stage since the last step was accepted, then the time of the last mark;
nanoseconds on a GPU, clock cycles on a CPU.
"""

import math
from dataclasses import dataclass
from functools import cache

import warp as wp

from warpmag.kernels.rigid.monitor import (
    COUNT_BAD_BODY,
    COUNT_CAPACITIES,
    COUNT_EVALUATIONS,
    COUNT_UNCONVERGED,
    NO_BODY,
    PEAK_LONG_TRAVEL,
    PEAK_OVERLAP,
    PEAK_TRAVEL,
    PEAKS,
)

wp.set_module_options({"enable_backward": False})

LEVELS = wp.constant(5)
"""Lengths of substeps, each half the one before."""

FLAG_ATTEMPT = wp.constant(0)  # the step is to be tried (again)
FLAG_REJECTED = wp.constant(1)  # the last attempt did not hold
FLAG_FORCES = wp.constant(2)  # the next substeps need forces of their own
FLAG_LEVEL = wp.constant(3)  # first of LEVELS: substeps of this level remain to be done
FLAGS = 8

STATUS_HALT = wp.constant(0)  # why steps do nothing: one of the reasons below
STATUS_DONE = wp.constant(1)  # steps done
STATUS_LEVEL = wp.constant(2)  # level of the substeps
STATUS_ATTEMPTS = wp.constant(3)  # attempts at the step under way
STATUS_REMAINING = wp.constant(4)  # pairs of substeps that this attempt still has to do
STATUS_REGROWN = wp.constant(5)  # buffers grew since the last step; set by the host
STATUS_SHARING = wp.constant(6)  # substeps that share their forces, a power of two; beyond the first level
STATUSES = 7

RUNNING = wp.constant(0)
OVERFLOW = wp.constant(1)
NOT_FINITE = wp.constant(2)
PAUSED = wp.constant(3)  # by the host

STAGES = wp.constant(3)
"""Stages whose time is taken."""

LOG_SUBSTEPS = wp.constant(0)
LOG_ATTEMPTS = wp.constant(1)
LOG_CAPPED = wp.constant(2)
LOG_REGROWN = wp.constant(3)
LOG_EVALUATIONS = wp.constant(4)
LOG_UNCONVERGED = wp.constant(5)
LOG_PEAKS = wp.constant(6)  # first of monitor.PEAKS
LOG_TICKS = wp.constant(LOG_PEAKS + PEAKS)  # first of STAGES
LOG_FIELDS = int(LOG_TICKS) + int(STAGES)


@dataclass(frozen=True)
class Limits:
    """When a step holds.

    Attributes:
        travel: Largest motion in a substep, in parts of a body's thickness.
        shared_travel: Largest motion while more than two substeps share their forces, in parts of a body's thickness.
        overlap: Deepest new penetration, in parts of the thickness of the thinner body.
        ease: Substeps are made longer again where the motion in twice their length stays below this part of ``travel``.
        futile: Substeps that leave more than this part of a penetration that was too deep are not made shorter still.
        fewest: Substeps of the first level, an even number.
        capacities: Size of each buffer whose fill is watched, on the device.
    """

    travel: float
    shared_travel: float
    overlap: float
    ease: float
    futile: float
    fewest: int
    capacities: wp.array


@dataclass(frozen=True)
class StepBuffers:
    """What the state machine keeps on the device; see the module."""

    flags: wp.array
    status: wp.array
    peaks: wp.array
    counts: wp.array
    last_overlap: wp.array
    ticks: wp.array
    log: wp.array

    @property
    def attempting(self) -> wp.array:
        """Condition: the step is to be tried (again)."""
        return self.flags[0:1]

    @property
    def forces_due(self) -> wp.array:
        """Condition: the next substeps need forces of their own."""
        return self.flags[int(FLAG_FORCES) : int(FLAG_FORCES) + 1]

    @property
    def sharing(self) -> wp.array:
        """Number of substeps that share their forces."""
        return self.status[int(STATUS_SHARING) : int(STATUS_SHARING) + 1]

    def remaining(self, level: int) -> wp.array:
        """Condition: substeps of ``level`` remain to be done."""
        return self.flags[int(FLAG_LEVEL) + level : int(FLAG_LEVEL) + level + 1]


def allocate(records: int, capacities: int, device) -> StepBuffers:
    """Allocate the buffers, for a log of ``records`` steps and as many ``capacities`` to watch."""

    def zeros(shape, dtype):
        return wp.zeros(shape, dtype=dtype, device=device)

    return StepBuffers(
        flags=zeros(FLAGS, wp.int32),
        status=zeros(STATUSES, wp.int32),
        peaks=zeros(PEAKS, wp.float32),
        counts=zeros(int(COUNT_CAPACITIES) + capacities, wp.int32),
        last_overlap=wp.array([0.0, math.inf], dtype=wp.float32, device=device),
        ticks=zeros(int(STAGES) + 1, wp.uint64),
        log=zeros((records, LOG_FIELDS), wp.float64),
    )


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
    ...


@wp.kernel
def _begin_step(
    # inputs:
    status_in: wp.array[wp.int32],
    # outputs:
    flags_out: wp.array[wp.int32],
):
    flags_out[FLAG_ATTEMPT] = wp.where(status_in[STATUS_HALT] == RUNNING, 1, 0)


@wp.kernel
def _set_status(
    # inputs:
    index: int,
    value: int,
    # outputs:
    status_out: wp.array[wp.int32],
):
    status_out[index] = value


def launch_set_status(index: int, value: int, b: StepBuffers):
    """Let the host change one of the ``STATUS_*`` entries."""
    wp.launch(_set_status, dim=1, inputs=[index, value], outputs=[b.status], device=b.status.device)


def launch_begin_step(b: StepBuffers):
    """Let a step be attempted, unless stepping is halted."""
    wp.launch(_begin_step, dim=1, inputs=[b.status], outputs=[b.flags], device=b.status.device)


@cache
def _copy_kernel(dtype):
    # A generic kernel would do, but graphs on the CPU replay the wrong one of its overloads (Warp 1.19).
    @wp.kernel(module="unique", enable_backward=False)
    def copy_where(
        # inputs:
        flags_in: wp.array[wp.int32],
        flag: int,
        source_in: wp.array[dtype],
        # outputs:
        target_out: wp.array[dtype],
    ):
        i = wp.tid()
        if flags_in[flag] != 0:
            target_out[i] = source_in[i]

    return copy_where


def launch_copy_where(flag: int, source, target, b: StepBuffers):
    """Copy an array if a flag stands."""
    wp.launch(
        _copy_kernel(source.dtype),
        dim=source.shape[0],
        inputs=[b.flags, flag, source],
        outputs=[target],
        device=source.device,
    )


@wp.kernel
def _begin_attempt(
    # inputs:
    fewest: int,
    # outputs:
    status_out: wp.array[wp.int32],
    flags_out: wp.array[wp.int32],
    peaks_out: wp.array[float],
    counts_out: wp.array[wp.int32],
    ticks_out: wp.array[wp.uint64],
):
    status_out[STATUS_ATTEMPTS] = status_out[STATUS_ATTEMPTS] + 1
    level = status_out[STATUS_LEVEL]
    status_out[STATUS_REMAINING] = (fewest // 2) << level
    flags_out[FLAG_FORCES] = 1
    for k in range(LEVELS):
        flags_out[FLAG_LEVEL + k] = wp.where(k == level, 1, 0)
    for k in range(peaks_out.shape[0]):
        peaks_out[k] = 0.0
    for k in range(counts_out.shape[0]):
        counts_out[k] = 0
    counts_out[COUNT_BAD_BODY] = NO_BODY
    ticks_out[STAGES] = now()


def launch_begin_attempt(limits: Limits, b: StepBuffers):
    """Clear what the monitor writes and open the loop of the present level."""
    wp.launch(
        _begin_attempt,
        dim=1,
        inputs=[limits.fewest],
        outputs=[b.status, b.flags, b.peaks, b.counts, b.ticks],
        device=b.status.device,
    )


@wp.kernel
def _mark(
    # inputs:
    stage: int,
    # outputs:
    ticks_out: wp.array[wp.uint64],
):
    time = now()
    ticks_out[stage] = ticks_out[stage] + time - ticks_out[STAGES]
    ticks_out[STAGES] = time


def launch_mark(stage: int, b: StepBuffers):
    """Count the time since the last mark, or since the attempt began, as spent in ``stage``."""
    wp.launch(_mark, dim=1, inputs=[stage], outputs=[b.ticks], device=b.ticks.device)


@wp.kernel
def _watch_finite(
    # inputs:
    body_q_in: wp.array[wp.transform],
    body_qd_in: wp.array[wp.spatial_vector],
    half: int,
    fewest: int,
    status_in: wp.array[wp.int32],
    # outputs:
    counts_out: wp.array[wp.int32],
):
    body = wp.tid()
    total = wp.abs(body_q_in[body][0])
    for k in range(1, 7):
        total += wp.abs(body_q_in[body][k])
    for k in range(6):
        total += wp.abs(body_qd_in[body][k])
    if not wp.isfinite(total):
        pair = ((fewest // 2) << status_in[STATUS_LEVEL]) - status_in[STATUS_REMAINING]
        wp.atomic_min(counts_out, COUNT_BAD_BODY, (2 * pair + half) * body_q_in.shape[0] + body)


def launch_watch_finite(half: int, state, limits: Limits, b: StepBuffers):
    """Note the first body whose pose or velocity is not finite: magnets infect all others within a substep.

    ``COUNT_BAD_BODY`` is the number of the substep times that of the bodies, plus the lowest such body in it.

    Args:
        half: Which substep of a pair ``state`` stands before, 0 or 1.
        state: The state.
        limits: When a step holds.
        b: The state machine.
    """
    wp.launch(
        _watch_finite,
        dim=state.body_q.shape[0],
        inputs=[state.body_q, state.body_qd, half, limits.fewest, b.status],
        outputs=[b.counts],
        device=b.status.device,
    )


@wp.kernel
def _end_pair(
    # inputs:
    level: int,
    # outputs:
    status_out: wp.array[wp.int32],
    flags_out: wp.array[wp.int32],
):
    remaining = status_out[STATUS_REMAINING] - 1
    status_out[STATUS_REMAINING] = remaining
    flags_out[FLAG_LEVEL + level] = wp.where(remaining > 0, 1, 0)
    # what remains is a multiple of what shares forces whenever the next begin to
    flags_out[FLAG_FORCES] = wp.where((2 * remaining) % wp.max(status_out[STATUS_SHARING], 2) == 0, 1, 0)


def launch_end_pair(level: int, b: StepBuffers):
    """Count two substeps of ``level`` as done."""
    wp.launch(_end_pair, dim=1, inputs=[level], outputs=[b.status, b.flags], device=b.status.device)


@wp.func
def _sharing(level: int, long_travel: float, seen_at: int, limit: float) -> int:
    """Number of substeps of ``level`` to share forces, from the motion seen in two substeps at ``seen_at``."""
    count = 1 << level
    travel = 0.5 * long_travel * float(1 << seen_at)
    while count > 2 and not travel <= limit:
        count /= 2
        travel *= 0.5
    return count


@wp.kernel
def _judge(
    # inputs:
    peaks_in: wp.array[float],
    counts_in: wp.array[wp.int32],
    capacities_in: wp.array[wp.int32],
    travel_limit: float,
    shared_travel_limit: float,
    overlap_limit: float,
    ease: float,
    futile: float,
    fewest: int,
    # outputs:
    status_out: wp.array[wp.int32],
    flags_out: wp.array[wp.int32],
    last_overlap_out: wp.array[float],
    ticks_out: wp.array[wp.uint64],
    log_out: wp.array2d[wp.float64],
):
    flags_out[FLAG_ATTEMPT] = 0
    flags_out[FLAG_REJECTED] = 1
    for k in range(capacities_in.shape[0]):
        if counts_in[COUNT_CAPACITIES + k] > capacities_in[k]:
            status_out[STATUS_HALT] = OVERFLOW
            return
    level = status_out[STATUS_LEVEL]
    travel = peaks_in[PEAK_TRAVEL]
    overlap = peaks_in[PEAK_OVERLAP]
    pressed = overlap > wp.max(overlap_limit, last_overlap_out[0])
    # shorter substeps undo what was pressed too fast, but not a contact that found another normal
    helped = overlap < futile * last_overlap_out[1]
    lost = counts_in[COUNT_BAD_BODY] != NO_BODY
    if (travel > travel_limit or (pressed and helped) or lost) and level + 1 < LEVELS:
        status_out[STATUS_LEVEL] = level + 1
        status_out[STATUS_SHARING] = _sharing(level + 1, peaks_in[PEAK_LONG_TRAVEL], level, shared_travel_limit)
        flags_out[FLAG_ATTEMPT] = 1
        if pressed:
            last_overlap_out[1] = overlap
        return
    if lost:
        status_out[STATUS_HALT] = NOT_FINITE
        return

    flags_out[FLAG_REJECTED] = 0
    last_overlap_out[0] = overlap
    last_overlap_out[1] = wp.inf
    record = status_out[STATUS_DONE] % log_out.shape[0]
    log_out[record, LOG_SUBSTEPS] = wp.float64(fewest << level)
    log_out[record, LOG_ATTEMPTS] = wp.float64(status_out[STATUS_ATTEMPTS])
    log_out[record, LOG_CAPPED] = wp.where(travel > travel_limit, wp.float64(1.0), wp.float64(0.0))
    log_out[record, LOG_REGROWN] = wp.float64(status_out[STATUS_REGROWN])
    log_out[record, LOG_EVALUATIONS] = wp.float64(counts_in[COUNT_EVALUATIONS])
    log_out[record, LOG_UNCONVERGED] = wp.float64(counts_in[COUNT_UNCONVERGED])
    for k in range(peaks_in.shape[0]):
        log_out[record, LOG_PEAKS + k] = wp.float64(peaks_in[k])
    for k in range(STAGES):
        log_out[record, LOG_TICKS + k] = wp.float64(ticks_out[k])
        ticks_out[k] = wp.uint64(0)
    status_out[STATUS_DONE] = status_out[STATUS_DONE] + 1
    status_out[STATUS_ATTEMPTS] = 0
    status_out[STATUS_REGROWN] = 0
    calm = overlap < 0.5 * overlap_limit or (pressed and not helped)
    if calm and peaks_in[PEAK_LONG_TRAVEL] < ease * travel_limit and level > 0:
        status_out[STATUS_LEVEL] = level - 1
    next_level = status_out[STATUS_LEVEL]
    status_out[STATUS_SHARING] = _sharing(next_level, peaks_in[PEAK_LONG_TRAVEL], level, shared_travel_limit)


def launch_judge(limits: Limits, b: StepBuffers):
    """Accept and log the attempt that was just made, or order another one, or halt."""
    wp.launch(
        _judge,
        dim=1,
        inputs=[
            b.peaks,
            b.counts,
            limits.capacities,
            limits.travel,
            limits.shared_travel,
            limits.overlap,
            limits.ease,
            limits.futile,
            limits.fewest,
        ],
        outputs=[b.status, b.flags, b.last_overlap, b.ticks, b.log],
        device=b.status.device,
    )


@wp.kernel
def _read_clock(
    # outputs:
    time_out: wp.array[wp.uint64],
):
    time_out[0] = now()


def launch_read_clock(time):
    """Write the device's time into ``time`` [1]."""
    wp.launch(_read_clock, dim=1, outputs=[time], device=time.device)
