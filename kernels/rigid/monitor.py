"""Monitor of a simulation on the device: the quantities by which ``stepping`` accepts or rejects a step.

All kernels write to two small arrays, which are cleared before an attempt at a step and evaluated after it. Maxima and
minima do not depend on the order of threads, so runs are repeatable bit by bit.

``peaks`` [float32]: maxima, see the ``PEAK_*`` indices.
``counts`` [int32]: see the ``COUNT_*`` indices; from ``COUNT_CAPACITIES`` on, the use of each monitored buffer.

**Sliding.** In a substep the contact plane between two bodies is fixed. So substeps must be short where bodies in
contact slide along each other. In a long substep a body would stop at a plane that it has passed, or enter a gap that
no plane closes. Only the tangential relative velocity of closing contacts counts. The motion of a single body counts
with a smaller weight: its contacts only have to be detected in time. Motion is computed from velocities, which contacts
have limited in the last substep.

**Displacement by forces** within a substep counts, too. Where contacts hold the body, the solver has to undo this
displacement. The part that it does not undo keeps the balls of a pile moving. In Sakura Tree contacts hold balls
against 1,500 times their weight. After 0.6 s these balls still move at 9 cm/s with substeps of 0.5 ms, and at 2 cm/s
with 0.25 ms.

**Forces** are shared by substeps as long as bodies move little compared with the distance over which their magnetic
forces vary. In a sheet this distance is much longer than the thickness, which limits motion in contact. Far from all
other magnets it is longer still (``force_spans``).
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

PEAK_TRAVEL = 0  # weighted motion in a substep, over the thickness of the thinner body [1]
PEAK_NEXT_TRAVEL = 1  # the same, predicted for the substep after the attempt
PEAK_LONG_TRAVEL = 2  # the largest of both, for substeps of twice the length
PEAK_FORCE_TRAVEL = 3  # the same over the distance in which magnetic forces vary, in place of the thickness [1]
PEAK_SPEED = 4  # speed of a body's center of mass [m/s]
PEAK_OVERLAP = 5  # penetration over the thickness of the thinner body [1]
PEAK_DEPTH = 6  # penetration [m]
PEAK_ERROR = 7  # magnetization error [1]
PEAKS = 8

HIGHEST_SPEED = 1e7  # [m/s]; a faster body is lost, as one whose state is not finite. Newtonian mechanics ends there.
COUNT_BAD_BODY = 0  # first body whose state was not finite or that was faster, see ``watch``; else NO_BODY
COUNT_EVALUATIONS = 1  # field evaluations, summed over solves
COUNT_UNCONVERGED = 2  # induction solves that did not converge
COUNT_OVERLAPS = 3  # contacts deeper than a threshold
COUNT_CAPACITIES = 4

NO_BODY = 2**31 - 1

STAGES = 3  # stages with a timer: induction, forces, rigid bodies
INDUCTION, FORCE, RIGID = range(STAGES)

UNCONSTRAINED_WEIGHT = 0.25
"""Weight of a single body's motion relative to sliding: contacts are detected up to twice its thickness ahead, and two
bodies may approach each other."""

NEXT_SUBSTEP = -1  # index of the substep after those of an attempt


@wp.struct
class Monitor:
    """Arrays of the monitor."""

    # Distance that a body may move before it can pass through another [m], the radius of a ball; infinite for bodies
    # that forces do not move. Shape [body_count].
    thickness: wp.array[float]
    force_length: wp.array[float]  # distance over which the force on a body in contact varies [m]; infinite as above
    force_span: wp.array[float]  # distance over which the force on a body varies now [m], [body_count]
    reach: wp.array[float]  # largest displacement of a body's surface per radian [m], zero for a ball, [body_count]
    fill_counts: wp.array[wp.uint64]  # addresses of each buffer's number of used entries; 0 for :func:`watch_flags`
    level: wp.array[wp.int32]  # number of times that substeps were halved, shape [1]
    substeps: wp.array[wp.int32]  # number of completed substeps of this attempt, shape [1]
    # Time of each stage since the last accepted step, then the clock at the last mark; nanoseconds on a GPU, clock
    # cycles on a CPU.
    ticks: wp.array[wp.uint64]
    peaks: wp.array[float]  # see the module's docstring, as for ``counts``
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
def read_clock() -> wp.uint64:
    """Return the device's clock: nanoseconds on a GPU, clock cycles on a CPU."""


@wp.func
def mark_time(ticks: wp.array[wp.uint64], stage: int):
    """Add the time since the last mark to ``stage``."""
    time = read_clock()
    ticks[stage] = ticks[stage] + time - ticks[STAGES]
    ticks[STAGES] = time


@wp.func
def _raise_maximum(peaks: wp.array[float], index: int, value: float):
    """Raise a maximum to a value; most values are below it and need no atomic operation."""
    if value > peaks[index]:
        wp.atomic_max(peaks, index, value)


@wp.func
def _raise_travel(m: Monitor, travel: float, long_travel: float, force_travel: float, substep: int):
    """Raise the peaks of motion."""
    _raise_maximum(m.peaks, wp.where(substep == NEXT_SUBSTEP, PEAK_NEXT_TRAVEL, PEAK_TRAVEL), travel)
    _raise_maximum(m.peaks, PEAK_LONG_TRAVEL, long_travel)
    _raise_maximum(m.peaks, PEAK_FORCE_TRAVEL, force_travel)


@wp.func
def _watch_body(m: Monitor, bodies: BodyView, body: int, substep: int, dt: float):
    """Detect a body that is not finite, and raise the peaks by its motion."""
    total = wp.abs(bodies.q[body][0])
    for k in range(1, 7):
        total += wp.abs(bodies.q[body][k])
    for k in range(6):
        total += wp.abs(bodies.qd[body][k])
    speed = wp.length(wp.spatial_top(bodies.qd[body]))
    # an angular velocity whose square overflows leaves an orientation of zero
    has_orientation = wp.length(wp.transform_get_rotation(bodies.q[body])) >= 0.5
    thickness = m.thickness[body]
    is_lost = thickness < wp.inf and speed > wp.static(HIGHEST_SPEED)  # keys may move a body to anywhere
    if not wp.isfinite(total) or not has_orientation or is_lost:
        wp.atomic_min(m.counts, COUNT_BAD_BODY, (m.substeps[0] + wp.max(substep, 0)) * bodies.qd.shape[0] + body)
    if thickness < wp.inf:
        turning = m.reach[body] * wp.length(wp.spatial_bottom(bodies.qd[body]))
        weighted_time = UNCONSTRAINED_WEIGHT * dt
        travel = weighted_time * (speed + turning) / thickness
        force_travel = 2.0 * weighted_time * (speed / m.force_span[body] + turning / m.force_length[body])
        _raise_travel(m, travel, 2.0 * travel, force_travel, substep)
        _raise_maximum(m.peaks, PEAK_SPEED, speed)


@wp.func
def _body_length(lengths: wp.array[float], body: int) -> float:
    if body < 0:
        return wp.inf
    return lengths[body]


@wp.func
def _body_velocity(bodies: BodyView, body: int) -> wp.vec3:
    if body < 0:
        return wp.vec3(0.0)
    return wp.spatial_top(bodies.qd[body])


@wp.func
def _watch_contact(
    m: Monitor,
    contacts: ContactView,
    bodies: BodyView,
    i: int,
    substep: int,
    dt: float,
    overlap_threshold: float,
    overlaps: wp.array[float],
):
    """Raise the peaks by a contact's depth, and by the sliding of its bodies where it closes."""
    overlaps[i] = -wp.inf
    body0, body1 = contact_bodies(contacts, i)
    thickness = wp.min(_body_length(m.thickness, body0), _body_length(m.thickness, body1))
    if thickness == wp.inf:
        return
    depth = contact_depth(contacts, bodies.q, i)
    overlap = depth / thickness
    overlaps[i] = overlap
    _raise_maximum(m.peaks, PEAK_DEPTH, depth)
    _raise_maximum(m.peaks, PEAK_OVERLAP, overlap)
    if overlap > overlap_threshold:
        wp.atomic_add(m.counts, COUNT_OVERLAPS, 1)
    moved = (_body_velocity(bodies, body1) - _body_velocity(bodies, body0)) * (dt / thickness)
    apart = wp.dot(contacts.normal[i], moved)
    along = wp.length(moved - apart * contacts.normal[i])
    closes, closes_later = apart < overlap, 2.0 * apart < overlap
    ratio = thickness / wp.min(_body_length(m.force_length, body0), _body_length(m.force_length, body1))
    long_travel = wp.where(closes_later, 2.0 * along, 0.0)
    _raise_travel(m, wp.where(closes, along, 0.0), long_travel, ratio * long_travel, substep)


@wp.kernel
def _watch(
    m: Monitor,
    contacts: ContactView,
    bodies: BodyView,
    substep: int,
    longest: float,
    overlap_threshold: float,
    overlaps_out: wp.array[float],
):
    i = wp.tid()
    dt = longest / float(1 << m.level[0])
    if i == 0:
        mark_time(m.ticks, RIGID)
    if i < m.fill_counts.shape[0]:
        if m.fill_counts[i] != wp.uint64(0):
            fill = wp.array(ptr=m.fill_counts[i], shape=(1,), dtype=wp.int32)
            m.counts[COUNT_CAPACITIES + i] = wp.max(m.counts[COUNT_CAPACITIES + i], fill[0])
    if i < bodies.qd.shape[0]:
        _watch_body(m, bodies, i, substep, dt)
    if i < contact_count(contacts):
        _watch_contact(m, contacts, bodies, i, substep, dt, overlap_threshold, overlaps_out)


def watch(m: Monitor, contacts: ContactView, bodies: BodyView, overlaps, *, substep, longest: float, threshold: float):
    """Update ``peaks`` and ``counts`` by a state with new contacts, and mark the time of rigid bodies.

    ``COUNT_BAD_BODY`` is the lowest body that was not finite in the first such substep, plus the index of that substep
    times the number of bodies. Only the first counts, because magnets spread infinite values to all others in a
    substep.

    Args:
        overlaps: Out, depth of each contact over the thickness of its thinner body, shape [contact_max].
        substep: Index of the substep after ``m.substeps``, or ``NEXT_SUBSTEP``.
        longest: Length of the substeps of the first level [s].
        threshold: Overlap above which a contact is counted.
    """
    dim = max(len(overlaps), len(m.thickness), len(m.fill_counts), 1)
    inputs = [m, contacts, bodies, substep, longest, threshold]
    wp.launch(_watch, dim=dim, inputs=inputs, outputs=[overlaps], device=m.peaks.device)


@wp.kernel
def _watch_forces(m: Monitor, bodies: BodyView, gravity_in: wp.array[wp.vec3], longest: float):
    body = wp.tid()
    if body == 0:
        mark_time(m.ticks, FORCE)
    if body < m.thickness.shape[0]:
        thickness = m.thickness[body]
        if thickness < wp.inf:
            dt = longest / float(1 << m.level[0])
            force = wp.spatial_top(bodies.f[body])
            acceleration = wp.length(force * bodies.inv_mass[body] + gravity_in[bodies.world[body]])
            pull = 0.5 * acceleration * dt * dt / thickness
            _raise_maximum(m.peaks, PEAK_TRAVEL, pull)
            _raise_maximum(m.peaks, PEAK_LONG_TRAVEL, 4.0 * pull)
            _raise_maximum(m.peaks, PEAK_FORCE_TRAVEL, 4.0 * pull * thickness / m.force_span[body])


def watch_forces(m: Monitor, bodies: BodyView, gravity, longest: float):
    """Raise ``peaks`` by the displacement of bodies by forces within a substep, and mark the time of forces.

    ``gravity`` [m/s²] has an entry for each world; ``longest`` is the length of the substeps of the first level [s].
    """
    inputs = [m, bodies, gravity, longest]
    wp.launch(_watch_forces, dim=max(len(m.thickness), 1), inputs=inputs, device=m.peaks.device)


@wp.kernel
def _watch_flags(flags_in: wp.array[wp.bool], index: int, counts_out: wp.array[wp.int32]):
    if flags_in[wp.tid()]:
        counts_out[index] = 1


def watch_flags(flags, index: int, counts):
    """Set ``counts[index]`` to 1 if any of ``flags`` [n] is set."""
    wp.launch(_watch_flags, dim=len(flags), inputs=[flags, index], outputs=[counts], device=counts.device)


@wp.kernel
def _watch_induction(
    m: Monitor, error_in: wp.array[wp.float64], evaluations_in: wp.array[wp.int32], converged_in: wp.array[wp.int32]
):
    mark_time(m.ticks, INDUCTION)
    error = error_in[0]
    evaluations = evaluations_in[0]
    converged = converged_in[0]
    for world in range(1, error_in.shape[0]):
        error = wp.max(error, error_in[world])
        evaluations = wp.max(evaluations, evaluations_in[world])
        converged = wp.min(converged, converged_in[world])
    m.peaks[PEAK_ERROR] = wp.max(m.peaks[PEAK_ERROR], float(error))
    m.counts[COUNT_EVALUATIONS] = m.counts[COUNT_EVALUATIONS] + evaluations
    if converged == 0:
        m.counts[COUNT_UNCONVERGED] = m.counts[COUNT_UNCONVERGED] + 1


def watch_induction(m: Monitor, error, evaluations, converged):
    """Update ``peaks`` and ``counts`` by the result of an induction, an entry per world, and mark its time."""
    wp.launch(_watch_induction, dim=1, inputs=[m, error, evaluations, converged], device=m.peaks.device)
