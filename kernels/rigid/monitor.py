"""Watches a simulation on the device: what decides whether a substep holds (``stepping``).

Every kernel writes into two small arrays that are cleared before an attempt at a step and judged after it. Maxima and
minima do not depend on the order of threads, so that a run repeats bit by bit.

``peaks`` [float32]: maxima, see the ``PEAK_*`` indices.
``counts`` [int32]: see the ``COUNT_*`` indices; from ``COUNT_CAPACITIES`` on, the fill of each buffer watched.
``thickness`` [body_count]: how far a body may move before it can pass through another [m], the radius of a ball;
infinite for bodies that do not move by forces.
``reach`` [body_count]: how far a turn moves the surface of a body per radian [m], zero for a ball.
"""

import warp as wp

from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

PEAK_TRAVEL = 0  # predicted motion of a body in one substep over its thickness [1]
PEAK_LONG_TRAVEL = 1  # the same in a substep twice as long
PEAK_SPEED = 2  # speed of a body's centre of mass [m/s]
PEAK_OVERLAP = 3  # penetration over the thickness of the thinner body [1]
PEAK_DEPTH = 4  # penetration [m]
PEAK_ERROR = 5  # magnetization error [1]
PEAKS = 6

COUNT_BAD_BODY = 0  # first body whose state was not finite, see ``stepping``; else NO_BODY
COUNT_EVALUATIONS = 1  # field evaluations, summed over substeps
COUNT_UNCONVERGED = 2  # substeps whose induction did not converge
COUNT_OVERLAPS = 3  # contacts deeper than a threshold
COUNT_CAPACITIES = 4

NO_BODY = 2**31 - 1


@wp.kernel
def _watch_motion(
    # inputs:
    bodies: BodyView,
    gravity_in: wp.array[wp.vec3],
    thickness_in: wp.array[float],
    reach_in: wp.array[float],
    dt: float,
    # outputs:
    peaks_out: wp.array[float],
):
    """Bound how far the surface of each body moves without contacts: |v| dt + |a| dt²/2, and the same of turning."""
    body = wp.tid()
    thickness = thickness_in[body]
    if thickness == wp.inf:
        return
    speed = wp.length(wp.spatial_top(bodies.qd[body]))
    gravity = gravity_in[bodies.world[body]]
    acceleration = wp.length(wp.spatial_top(bodies.f[body]) * bodies.inv_mass[body] + gravity)
    steady = speed * dt
    gained = 0.5 * acceleration * dt * dt
    reach = reach_in[body]
    if reach > 0.0:
        rotation = wp.transform_get_rotation(bodies.q[body])
        torque = wp.quat_rotate_inv(rotation, wp.spatial_bottom(bodies.f[body]))
        steady += reach * wp.length(wp.spatial_bottom(bodies.qd[body])) * dt
        gained += 0.5 * reach * wp.length(bodies.inv_inertia[body] * torque) * dt * dt
    wp.atomic_max(peaks_out, PEAK_TRAVEL, (steady + gained) / thickness)
    wp.atomic_max(peaks_out, PEAK_LONG_TRAVEL, (2.0 * steady + 4.0 * gained) / thickness)
    wp.atomic_max(peaks_out, PEAK_SPEED, speed)


def watch_motion(bodies: BodyView, gravity, thickness, reach, dt: float, peaks):
    """Take the bodies' predicted motion in the next ``dt`` and in twice that, and their speed, into ``peaks``."""
    inputs = [bodies, gravity, thickness, reach, dt]
    wp.launch(_watch_motion, dim=len(thickness), inputs=inputs, outputs=[peaks], device=peaks.device)


@wp.func
def _body_thickness(thickness: wp.array[float], body: int) -> float:
    if body < 0:
        return wp.inf
    return thickness[body]


@wp.kernel
def _watch_contacts(
    # inputs:
    contacts: ContactView,
    body_q_in: wp.array[wp.transform],
    thickness_in: wp.array[float],
    overlap_threshold: float,
    # outputs:
    overlaps_out: wp.array[float],
    peaks_out: wp.array[float],
    counts_out: wp.array[wp.int32],
):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    overlaps_out[i] = -wp.inf
    body0, body1 = contact_bodies(contacts, i)
    thickness = wp.min(_body_thickness(thickness_in, body0), _body_thickness(thickness_in, body1))
    if thickness == wp.inf:
        return
    depth = contact_depth(contacts, body_q_in, i)
    overlaps_out[i] = depth / thickness
    wp.atomic_max(peaks_out, PEAK_DEPTH, depth)
    wp.atomic_max(peaks_out, PEAK_OVERLAP, depth / thickness)
    if depth > overlap_threshold * thickness:
        wp.atomic_add(counts_out, COUNT_OVERLAPS, 1)


def watch_contacts(contacts: ContactView, body_q, thickness, overlap_threshold: float, overlaps, peaks, counts):
    """Write the depth of each contact over the thickness of its thinner body into ``overlaps`` [contact_max].

    The largest goes into ``peaks``, the number of those above ``overlap_threshold`` into ``counts``.
    """
    inputs, outputs = [contacts, body_q, thickness, overlap_threshold], [overlaps, peaks, counts]
    wp.launch(_watch_contacts, dim=len(overlaps), inputs=inputs, outputs=outputs, device=peaks.device)


@wp.kernel
def _watch_capacity(fill_in: wp.array[wp.int32], index: int, counts_out: wp.array[wp.int32]):
    counts_out[index] = wp.max(counts_out[index], fill_in[0])


def watch_capacity(fill, index: int, counts):
    """Take the fill of one buffer, ``fill`` [1], into the maximum ``counts[index]``."""
    wp.launch(_watch_capacity, dim=1, inputs=[fill, index], outputs=[counts], device=counts.device)


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
    error_in: wp.array[wp.float64],
    evaluations_in: wp.array[wp.int32],
    converged_in: wp.array[wp.int32],
    # outputs:
    peaks_out: wp.array[float],
    counts_out: wp.array[wp.int32],
):
    error = error_in[0]
    evaluations = evaluations_in[0]
    converged = converged_in[0]
    for world in range(1, error_in.shape[0]):
        error = wp.max(error, error_in[world])
        evaluations = wp.max(evaluations, evaluations_in[world])
        converged = wp.min(converged, converged_in[world])
    peaks_out[PEAK_ERROR] = wp.max(peaks_out[PEAK_ERROR], float(error))
    counts_out[COUNT_EVALUATIONS] = counts_out[COUNT_EVALUATIONS] + evaluations
    if converged == 0:
        counts_out[COUNT_UNCONVERGED] = counts_out[COUNT_UNCONVERGED] + 1


def watch_induction(error, evaluations, converged, peaks, counts):
    """Take the outcome of one induction, an entry per world, into ``peaks`` and ``counts``."""
    inputs, outputs = [error, evaluations, converged], [peaks, counts]
    wp.launch(_watch_induction, dim=1, inputs=inputs, outputs=outputs, device=peaks.device)
