"""Watches a simulation on the device: what decides whether a substep holds (``stepping``).

Every kernel writes into two small arrays that are cleared before an attempt at a step and judged after it. Maxima and
minima do not depend on the order of threads, so that a run repeats bit by bit.

``peaks`` [float32]: maxima, see the ``PEAK_*`` indices.
``counts`` [int32]: see the ``COUNT_*`` indices; from ``COUNT_CAPACITIES`` on, the fill of each buffer watched.

A substep takes the plane between two bodies that are about to touch for what it was when the substep began. So it must
be short where bodies glide along each other and touch: they would be stopped where they pass, and slip between others
that no plane keeps them from. Bodies that fly together do not glide, those that fly alone or straight at each other
only have to be seen coming, and those that part do not touch. Motion is measured by velocities: they say how far a body
has come in the last substep, held by its contacts.

How far forces would pull a body in a substep matters where contacts hold it: that is what the solver has to undo, and
what it leaves of it keeps a pile hot (held balls of Sakura Tree, under 1,500 times their weight, move at 9 cm/s after
0.6 s in substeps of 0.5 ms, and at 2 in such of 0.25 ms).
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

PEAK_TRAVEL = 0  # motion in a substep that tells, over the thickness of the thinner body [1]
PEAK_NEXT_TRAVEL = 1  # the same in the substep that would follow
PEAK_LONG_TRAVEL = 2  # the same in any of these if it were twice as long
PEAK_SPEED = 3  # speed of a body's centre of mass [m/s]
PEAK_OVERLAP = 4  # penetration over the thickness of the thinner body [1]
PEAK_DEPTH = 5  # penetration [m]
PEAK_ERROR = 6  # magnetization error [1]
PEAKS = 7

COUNT_BAD_BODY = 0  # first body whose state was not finite, by substeps; else NO_BODY
COUNT_EVALUATIONS = 1  # field evaluations, summed over substeps
COUNT_UNCONVERGED = 2  # substeps whose induction did not converge
COUNT_OVERLAPS = 3  # contacts deeper than a threshold
COUNT_CAPACITIES = 4

NO_BODY = 2**31 - 1

STAGES = 3
"""Stages whose time is measured: induction, forces, rigid bodies."""
INDUCTION, FORCE, RIGID = range(STAGES)

FREE = 0.25
"""Weight of a body's own motion against gliding along another: contacts are sought as far ahead as twice its thickness,
and two bodies may meet."""


NEXT = -1
"""Number of the substep that would follow those of an attempt."""


@wp.struct
class Watched:
    """What is watched, and where it goes.

    Attributes:
        thickness: How far a body may move before it can pass through another [m], the radius of a ball; infinite for
            bodies that do not move by forces. Shape [body_count].
        reach: How far a turn moves the surface of a body per radian [m], zero for a ball. Shape [body_count].
        fills: Addresses of the numbers that tell how full each buffer is, 0 for what :func:`watch_flags` watches.
        level: How often substeps were halved, shape [1].
        substeps: Substeps done in this attempt, shape [1].
        ticks: Time spent in each stage since the last step was accepted, then the time of the last mark; nanoseconds on
            a GPU, clock cycles on a CPU.
        peaks, counts: See above.
    """

    thickness: wp.array[float]
    reach: wp.array[float]
    fills: wp.array[wp.uint64]
    level: wp.array[wp.int32]
    substeps: wp.array[wp.int32]
    ticks: wp.array[wp.uint64]
    peaks: wp.array[float]
    counts: wp.array[wp.int32]


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


@wp.func
def mark_time(ticks: wp.array[wp.uint64], stage: int):
    """Count the time since the last mark as spent in ``stage``."""
    time = now()
    ticks[stage] = ticks[stage] + time - ticks[STAGES]
    ticks[STAGES] = time


@wp.func
def _raise(peaks: wp.array[float], which: int, value: float):
    """Take a value into a maximum; most are below it, and need no atomic."""
    if value > peaks[which]:
        wp.atomic_max(peaks, which, value)


@wp.func
def _take_travel(w: Watched, travel: float, long_travel: float, substep: int):
    _raise(w.peaks, wp.where(substep == NEXT, PEAK_NEXT_TRAVEL, PEAK_TRAVEL), travel)
    _raise(w.peaks, PEAK_LONG_TRAVEL, long_travel)


@wp.func
def _watch_body(w: Watched, bodies: BodyView, body: int, substep: int, dt: float):
    """Note a body that is not finite; take how far it moves into the peaks, weighed as alone."""
    total = wp.abs(bodies.q[body][0])
    for k in range(1, 7):
        total += wp.abs(bodies.q[body][k])
    for k in range(6):
        total += wp.abs(bodies.qd[body][k])
    # a spin whose square is infinite leaves an orientation of zero
    if not wp.isfinite(total) or wp.length(wp.transform_get_rotation(bodies.q[body])) < 0.5:
        wp.atomic_min(w.counts, COUNT_BAD_BODY, (w.substeps[0] + wp.max(substep, 0)) * bodies.qd.shape[0] + body)
    thickness = w.thickness[body]
    if thickness < wp.inf:
        speed = wp.length(wp.spatial_top(bodies.qd[body]))
        turning = w.reach[body] * wp.length(wp.spatial_bottom(bodies.qd[body]))
        travel = FREE * (speed + turning) * dt / thickness
        _take_travel(w, travel, 2.0 * travel, substep)
        _raise(w.peaks, PEAK_SPEED, speed)


@wp.func
def _body_thickness(w: Watched, body: int) -> float:
    if body < 0:
        return wp.inf
    return w.thickness[body]


@wp.func
def _body_velocity(bodies: BodyView, body: int) -> wp.vec3:
    if body < 0:
        return wp.vec3(0.0)
    return wp.spatial_top(bodies.qd[body])


@wp.func
def _watch_contact(
    w: Watched,
    contacts: ContactView,
    bodies: BodyView,
    i: int,
    substep: int,
    dt: float,
    overlap_threshold: float,
    overlaps: wp.array[float],
):
    """Note a contact's depth; take how far its bodies glide along each other into the peaks if they touch."""
    overlaps[i] = -wp.inf
    body0, body1 = contact_bodies(contacts, i)
    thickness = wp.min(_body_thickness(w, body0), _body_thickness(w, body1))
    if thickness == wp.inf:
        return
    depth = contact_depth(contacts, bodies.q, i)
    overlap = depth / thickness
    overlaps[i] = overlap
    _raise(w.peaks, PEAK_DEPTH, depth)
    _raise(w.peaks, PEAK_OVERLAP, overlap)
    if overlap > overlap_threshold:
        wp.atomic_add(w.counts, COUNT_OVERLAPS, 1)
    moved = (_body_velocity(bodies, body1) - _body_velocity(bodies, body0)) * (dt / thickness)
    apart = wp.dot(contacts.normal[i], moved)
    along = wp.length(moved - apart * contacts.normal[i])
    touch, touch_later = apart < overlap, 2.0 * apart < overlap
    _take_travel(w, wp.where(touch, along, 0.0), wp.where(touch_later, 2.0 * along, 0.0), substep)


@wp.kernel
def _watch(
    # inputs:
    w: Watched,
    contacts: ContactView,
    bodies: BodyView,
    substep: int,
    longest: float,
    overlap_threshold: float,
    # outputs:
    overlaps_out: wp.array[float],
):
    i = wp.tid()
    dt = longest / float(1 << w.level[0])
    if i == 0:
        mark_time(w.ticks, RIGID)
    if i < w.fills.shape[0]:
        if w.fills[i] != wp.uint64(0):
            fill = wp.array(ptr=w.fills[i], shape=(1,), dtype=wp.int32)
            w.counts[COUNT_CAPACITIES + i] = wp.max(w.counts[COUNT_CAPACITIES + i], fill[0])
    if i < bodies.qd.shape[0]:
        _watch_body(w, bodies, i, substep, dt)
    if i < contact_count(contacts):
        _watch_contact(w, contacts, bodies, i, substep, dt, overlap_threshold, overlaps_out)


def watch(w: Watched, contacts: ContactView, bodies: BodyView, overlaps, *, substep, longest: float, threshold: float):
    """Take a state whose contacts were just found into ``peaks`` and ``counts``, and mark the time of rigid bodies.

    ``COUNT_BAD_BODY`` is the lowest body that was not finite in the first such substep, plus the number of that substep
    times that of the bodies: magnets pass what is not finite to all others within a substep.

    Args:
        w: What is watched.
        contacts: The contacts.
        bodies: The bodies.
        overlaps: Out, depth of each contact over the thickness of its thinner body, shape [contact_max].
        substep: Substeps since ``w.substeps`` were counted, or ``NEXT``.
        longest: Length of the substeps of the first level [s].
        threshold: Overlap from which on a contact is counted.
    """
    dim = max(len(overlaps), len(w.thickness), len(w.fills), 1)
    inputs = [w, contacts, bodies, substep, longest, threshold]
    wp.launch(_watch, dim=dim, inputs=inputs, outputs=[overlaps], device=w.peaks.device)


@wp.kernel
def _watch_forces(w: Watched, bodies: BodyView, gravity_in: wp.array[wp.vec3], longest: float):
    body = wp.tid()
    if body == 0:
        mark_time(w.ticks, FORCE)
    if body < w.thickness.shape[0]:
        thickness = w.thickness[body]
        if thickness < wp.inf:
            dt = longest / float(1 << w.level[0])
            force = wp.spatial_top(bodies.f[body])
            acceleration = wp.length(force * bodies.inv_mass[body] + gravity_in[bodies.world[body]])
            pulled = 0.5 * acceleration * dt * dt / thickness
            _raise(w.peaks, PEAK_TRAVEL, pulled)
            _raise(w.peaks, PEAK_LONG_TRAVEL, 4.0 * pulled)


def watch_forces(w: Watched, bodies: BodyView, gravity, longest: float):
    """Take how far forces would pull bodies within a substep into ``peaks``, and mark the time of forces.

    Args:
        w: What is watched.
        bodies: The bodies, forces evaluated.
        gravity: Gravity of each world [m/s²].
        longest: Length of the substeps of the first level [s].
    """
    inputs = [w, bodies, gravity, longest]
    wp.launch(_watch_forces, dim=max(len(w.thickness), 1), inputs=inputs, device=w.peaks.device)


@wp.kernel
def _watch_flags(flags_in: wp.array[wp.bool], index: int, counts_out: wp.array[wp.int32]):
    if flags_in[wp.tid()]:
        counts_out[index] = 1


def watch_flags(flags, index: int, counts):
    """Set ``counts[index]`` to 1 if any of ``flags`` [n] is set."""
    wp.launch(_watch_flags, dim=len(flags), inputs=[flags, index], outputs=[counts], device=counts.device)


@wp.kernel
def _watch_induction(
    # inputs:
    w: Watched,
    error_in: wp.array[wp.float64],
    evaluations_in: wp.array[wp.int32],
    converged_in: wp.array[wp.int32],
):
    mark_time(w.ticks, INDUCTION)
    error = error_in[0]
    evaluations = evaluations_in[0]
    converged = converged_in[0]
    for world in range(1, error_in.shape[0]):
        error = wp.max(error, error_in[world])
        evaluations = wp.max(evaluations, evaluations_in[world])
        converged = wp.min(converged, converged_in[world])
    w.peaks[PEAK_ERROR] = wp.max(w.peaks[PEAK_ERROR], float(error))
    w.counts[COUNT_EVALUATIONS] = w.counts[COUNT_EVALUATIONS] + evaluations
    if converged == 0:
        w.counts[COUNT_UNCONVERGED] = w.counts[COUNT_UNCONVERGED] + 1


def watch_induction(w: Watched, error, evaluations, converged):
    """Take the outcome of one induction, an entry per world, into ``peaks`` and ``counts``, and mark its time."""
    wp.launch(_watch_induction, dim=1, inputs=[w, error, evaluations, converged], device=w.peaks.device)
