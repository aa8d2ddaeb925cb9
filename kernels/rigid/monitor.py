"""Watches a simulation from the device: what a substep must report before the next one may rely on it.

Every kernel folds its findings into two small arrays that are cleared before a step is tried and judged after it
(``kernels.stepping``). Maxima and minima do not depend on the order of threads, so a run repeats bit by bit.

``peaks`` [float32], each the largest since the arrays were cleared: see the ``PEAK_*`` indices.
``counts`` [int32]: see the ``COUNT_*`` indices; from ``COUNT_CAPACITIES`` on, the fill of each capacity watched.
``thickness`` [body_count]: how far a body may move before it can pass through another [m], the radius of a ball;
infinite for bodies that do not move by forces.
``reach`` [body_count]: how far a turn moves the surface of a body per radian [m], zero for a ball.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

PEAK_TRAVEL = wp.constant(0)  # predicted motion of a body in one substep over its thickness [1]
PEAK_LONG_TRAVEL = wp.constant(1)  # the same in a substep twice as long
PEAK_SPEED = wp.constant(2)  # speed of a body's centre of mass [m/s]
PEAK_OVERLAP = wp.constant(3)  # penetration over the thickness of the thinner body [1]
PEAK_DEPTH = wp.constant(4)  # penetration [m]
PEAK_ERROR = wp.constant(5)  # magnetization error [1]
PEAKS = 6

COUNT_BAD_BODY = wp.constant(0)  # the first body whose state was not finite, see kernels.stepping; else NO_BODY
COUNT_EVALUATIONS = wp.constant(1)  # field evaluations, summed over substeps
COUNT_UNCONVERGED = wp.constant(2)  # substeps whose induction did not converge
COUNT_OVERLAPS = wp.constant(3)  # contacts deeper than a threshold, last substep
COUNT_CAPACITIES = wp.constant(4)

NO_BODY = wp.constant(2**31 - 1)


@wp.kernel
def _watch_motion(
    # inputs:
    body_q_in: wp.array[wp.transform],
    body_qd_in: wp.array[wp.spatial_vector],
    body_f_in: wp.array[wp.spatial_vector],
    body_inv_mass_in: wp.array[float],
    body_inv_inertia_in: wp.array[wp.mat33],
    body_world_in: wp.array[wp.int32],
    gravity_in: wp.array[wp.vec3],
    thickness_in: wp.array[float],
    reach_in: wp.array[float],
    dt: float,
    # outputs:
    peaks_out: wp.array[float],
):
    """Fold in how far each body would move in ``dt`` and in twice that without contacts.

    That is |v| dt + |a| dt²/2, and the same of turning.
    """
    body = wp.tid()
    if thickness_in[body] == wp.inf:
        return
    speed = wp.length(wp.spatial_top(body_qd_in[body]))
    gravity = gravity_in[body_world_in[body]]
    acceleration = wp.length(wp.spatial_top(body_f_in[body]) * body_inv_mass_in[body] + gravity)
    steady = speed * dt
    gained = 0.5 * acceleration * dt * dt
    if reach_in[body] > 0.0:
        rotation = wp.transform_get_rotation(body_q_in[body])
        torque = wp.quat_rotate_inv(rotation, wp.spatial_bottom(body_f_in[body]))
        steady += reach_in[body] * wp.length(wp.spatial_bottom(body_qd_in[body])) * dt
        gained += 0.5 * reach_in[body] * wp.length(body_inv_inertia_in[body] * torque) * dt * dt
    wp.atomic_max(peaks_out, PEAK_TRAVEL, (steady + gained) / thickness_in[body])
    wp.atomic_max(peaks_out, PEAK_LONG_TRAVEL, (2.0 * steady + 4.0 * gained) / thickness_in[body])
    wp.atomic_max(peaks_out, PEAK_SPEED, speed)


def watch_motion(model, state, thickness, reach, dt, peaks):
    """Fold the bodies' predicted motion in the next ``dt`` and in twice that, and their speed, into ``peaks``."""
    wp.launch(
        _watch_motion,
        dim=model.body_count,
        inputs=[
            state.body_q,
            state.body_qd,
            state.body_f,
            model.body_inv_mass,
            model.body_inv_inertia,
            model.body_world,
            model.gravity,
            thickness,
            reach,
            dt,
        ],
        outputs=[peaks],
        device=peaks.device,
    )


@wp.kernel
def _watch_contacts(
    # inputs:
    count_in: wp.array[wp.int32],
    shape0_in: wp.array[wp.int32],
    shape1_in: wp.array[wp.int32],
    point0_in: wp.array[wp.vec3],
    point1_in: wp.array[wp.vec3],
    margin0_in: wp.array[float],
    margin1_in: wp.array[float],
    normal_in: wp.array[wp.vec3],
    shape_body_in: wp.array[wp.int32],
    body_q_in: wp.array[wp.transform],
    thickness_in: wp.array[float],
    overlap_threshold: float,
    # outputs:
    overlaps_out: wp.array[float],
    peaks_out: wp.array[float],
    counts_out: wp.array[wp.int32],
):
    """Write and fold in how deep each contact is, at the poses ``body_q_in``."""
    i = wp.tid()
    if i >= wp.min(count_in[0], shape0_in.shape[0]):
        return
    overlaps_out[i] = -wp.inf
    body0 = shape_body_in[shape0_in[i]]
    body1 = shape_body_in[shape1_in[i]]
    point0 = point0_in[i]
    point1 = point1_in[i]
    thickness = float(wp.inf)
    if body0 >= 0:
        point0 = wp.transform_point(body_q_in[body0], point0)
        thickness = thickness_in[body0]
    if body1 >= 0:
        point1 = wp.transform_point(body_q_in[body1], point1)
        thickness = wp.min(thickness, thickness_in[body1])
    if thickness == wp.inf:
        return
    depth = margin0_in[i] + margin1_in[i] - wp.dot(normal_in[i], point1 - point0)
    overlaps_out[i] = depth / thickness
    wp.atomic_max(peaks_out, PEAK_DEPTH, depth)
    wp.atomic_max(peaks_out, PEAK_OVERLAP, depth / thickness)
    if depth > overlap_threshold * thickness:
        wp.atomic_add(counts_out, COUNT_OVERLAPS, 1)


def watch_contacts(model, state, contacts, thickness, overlap_threshold, overlaps, peaks, counts):
    """Write the depth of each contact over the thickness of its thinner body into ``overlaps`` [rigid_contact_max].

    The largest goes into ``peaks``, the number of those above ``overlap_threshold`` into ``counts``.
    """
    wp.launch(
        _watch_contacts,
        dim=contacts.rigid_contact_max,
        inputs=[
            contacts.rigid_contact_count,
            contacts.rigid_contact_shape0,
            contacts.rigid_contact_shape1,
            contacts.rigid_contact_point0,
            contacts.rigid_contact_point1,
            contacts.rigid_contact_margin0,
            contacts.rigid_contact_margin1,
            contacts.rigid_contact_normal,
            model.shape_body,
            state.body_q,
            thickness,
            overlap_threshold,
        ],
        outputs=[overlaps, peaks, counts],
        device=peaks.device,
    )


@wp.kernel
def _watch_capacity(
    # inputs:
    fill_in: wp.array[wp.int32],
    index: int,
    # outputs:
    counts_out: wp.array[wp.int32],
):
    fill = fill_in[0]
    counts_out[index] = wp.max(counts_out[index], fill)


def watch_capacity(fill, index, counts):
    """Fold the fill of one buffer, ``fill`` [1], into ``counts[index]``."""
    wp.launch(_watch_capacity, dim=1, inputs=[fill, index], outputs=[counts], device=counts.device)


@wp.kernel
def _watch_flags(
    # inputs:
    flags_in: wp.array[wp.bool],
    index: int,
    # outputs:
    counts_out: wp.array[wp.int32],
):
    if flags_in[wp.tid()]:
        counts_out[index] = 1


def watch_flags(flags, index, counts):
    """Set ``counts[index]`` to 1 if any of ``flags`` [n] stands."""
    wp.launch(_watch_flags, dim=flags.shape[0], inputs=[flags, index], outputs=[counts], device=counts.device)


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
    """Fold the outcome of one induction, an entry per world, into ``peaks`` and ``counts``."""
    wp.launch(
        _watch_induction,
        dim=1,
        inputs=[error, evaluations, converged],
        outputs=[peaks, counts],
        device=peaks.device,
    )
