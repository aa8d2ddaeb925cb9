"""What XPBD's iterations over joints lack in Newton's kernels: constraint forces of the right moment, and drives.

Newton evaluates where a joint acts at the poses of each iteration, which is implicit: a pendulum loses 1.5 % of its
amplitude in half a swing of 0.28 s. Here velocities are solved at the poses that a substep starts from, and joints act
where they are there, as in SHAKE (Ryckaert, Ciccotti and Berendsen 1977), which is symplectic: amplitudes stay.

Bodies that overlap are moved apart no faster than in ``contact_law.h``: Newton's kernel undoes all of an overlap in a
substep, and bodies keep the speed.

Newton also forgets in each iteration what a drive did in those before, so that n of them make it some n times too
stiff. A row of a drive here knows the impulse that it gave so far, and ends at a spring and a damper of the gains that
were asked for. No speed is taken for rest, however small.
"""

import math

import warp as wp

from warpmag.kernels.contacts.solve import PUSH_OUT
from warpmag.kernels.rigid.newton_views import BodyView, ContactView, contact_bodies, contact_count, contact_depth

wp.set_module_options({"enable_backward": False})

_PUSH_OUT = wp.constant(PUSH_OUT)
_CLOSING = wp.constant(2.0)
"""Most speed at which ends that are apart as a substep begins are pulled together, and slides into their limits [m/s]:
bodies keep it, and the shorter the substep, the faster would be what closes the whole of it."""
_TURNING = wp.constant(10.0)
"""The same of an angle that is outside of its limits [rad/s]."""


@wp.struct
class JointView:
    """Joints, and the axes of theirs that drives act on, one row for each.

    Attributes:
        parent: Body at one end, -1 for the world, shape [joints].
        child: Body at the other end, shape [joints].
        parent_frame: Frame of the joint in that of the parent, shape [joints].
        child_frame: Frame of the joint in that of the child, shape [joints].
        enabled: Whether the joint does anything, shape [joints].
        slides: Whether the ends may be at two places, shape [joints].
        pins: Whether the ends are to be at one place, shape [joints].
        one_axis: Whether the joint turns about or slides along one axis, shape [joints].
        dof_start: First degree of freedom, and the one after the last, shape [joints + 1].
        lower, upper: Limits of each degree of freedom [m or rad], shape [dofs].
        axis: Direction of each degree of freedom in the frame of the joint, shape [dofs].
        stiffness: Gain of the position [N/m or N·m/rad], shape [dofs].
        damping: Gain of the velocity [N·s/m or N·m·s/rad], shape [dofs].
        effort: Largest force or torque of a drive [N or N·m], shape [dofs].
        row_joint: Joint of each row, shape [rows].
        row_dof: Degree of freedom of each row, shape [rows].
        row_target: Where its target position stands, shape [rows].
        row_turns: Whether it turns, or slides, shape [rows].
    """

    parent: wp.array[wp.int32]
    child: wp.array[wp.int32]
    parent_frame: wp.array[wp.transform]
    child_frame: wp.array[wp.transform]
    enabled: wp.array[wp.bool]
    slides: wp.array[wp.bool]
    pins: wp.array[wp.bool]
    one_axis: wp.array[wp.bool]
    dof_start: wp.array[wp.int32]
    lower: wp.array[float]
    upper: wp.array[float]
    axis: wp.array[wp.vec3]
    stiffness: wp.array[float]
    damping: wp.array[float]
    effort: wp.array[float]
    row_joint: wp.array[wp.int32]
    row_dof: wp.array[wp.int32]
    row_target: wp.array[wp.int32]
    row_turns: wp.array[wp.bool]


@wp.func
def _pose(body_q: wp.array[wp.transform], body: int) -> wp.transform:
    if body < 0:
        return wp.transform_identity()
    return body_q[body]


@wp.func
def _center(bodies: BodyView, pose: wp.transform, body: int) -> wp.vec3:
    if body < 0:
        return wp.vec3(0.0)
    return wp.transform_point(pose, bodies.com[body])


@wp.func
def _levers(joints: JointView, bodies: BodyView, body_q: wp.array[wp.transform], joint: int, rel: wp.vec3):
    """Where joint acts on its parent and its child, from their centres of mass, its ends ``rel`` apart [m]."""
    parent, child = joints.parent[joint], joints.child[joint]
    pose0, pose1 = _pose(body_q, parent), body_q[child]
    end0 = wp.transform_point(pose0, wp.transform_point(joints.parent_frame[joint], rel))
    end1 = wp.transform_point(pose1, wp.transform_get_translation(joints.child_frame[joint]))
    return end0 - _center(bodies, pose0, parent), end1 - _center(bodies, pose1, child)


@wp.func
def _offset(joints: JointView, body_q: wp.array[wp.transform], joint: int) -> wp.vec3:
    """How far the child's end is from the parent's, in the frame of the joint [m]."""
    frame0 = _pose(body_q, joints.parent[joint]) * joints.parent_frame[joint]
    frame1 = body_q[joints.child[joint]] * joints.child_frame[joint]
    return wp.transform_get_translation(wp.transform_inverse(frame0) * frame1)


@wp.kernel
def _turn_levers(
    # inputs:
    joints: JointView,
    bodies: BodyView,
    q_now_in: wp.array[wp.transform],
    # outputs:
    impulses_io: wp.array[wp.spatial_vector],
    deltas_io: wp.array[wp.spatial_vector],
):
    joint = wp.tid()
    impulse = wp.spatial_top(impulses_io[joint])
    impulses_io[joint] = wp.spatial_vector()
    if wp.length_sq(impulse) == 0.0:
        return
    rel0, rel1 = wp.vec3(0.0), wp.vec3(0.0)
    if joints.slides[joint]:
        rel0, rel1 = _offset(joints, bodies.q, joint), _offset(joints, q_now_in, joint)
    parent0, child0 = _levers(joints, bodies, bodies.q, joint, rel0)
    parent1, child1 = _levers(joints, bodies, q_now_in, joint, rel1)
    turn = wp.vec3(0.0)
    wp.atomic_add(deltas_io, joints.child[joint], wp.spatial_vector(turn, wp.cross(child0 - child1, impulse)))
    if joints.parent[joint] >= 0:
        wp.atomic_sub(deltas_io, joints.parent[joint], wp.spatial_vector(turn, wp.cross(parent0 - parent1, impulse)))


@wp.func
def _give(bodies: BodyView, body: int, linear: wp.vec3, angular: wp.vec3):
    """Change of velocity and angular velocity of a body by an impulse and one about its centre of mass."""
    if body < 0:
        return wp.vec3(0.0), wp.vec3(0.0)
    turn = wp.transform_get_rotation(bodies.q[body])
    spin = wp.quat_rotate(turn, bodies.inv_inertia[body] * wp.quat_rotate_inv(turn, angular))
    return bodies.inv_mass[body] * linear, spin


@wp.func
def _yield(bodies: BodyView, body: int, linear: wp.vec3, angular: wp.vec3) -> float:
    """Speed that a unit of impulse along a row lends a body [1/kg or 1/(kg·m²)]."""
    v, spin = _give(bodies, body, linear, angular)
    return wp.dot(v, linear) + wp.dot(spin, angular)


@wp.func
def _speed(bodies: BodyView, body: int, linear: wp.vec3, angular: wp.vec3) -> float:
    """Speed of a body along a row [m/s or rad/s]."""
    if body < 0:
        return float(0.0)
    return wp.dot(wp.spatial_top(bodies.qd[body]), linear) + wp.dot(wp.spatial_bottom(bodies.qd[body]), angular)


@wp.func
def _angle(joints: JointView, bodies: BodyView, joint: int, axis: wp.vec3) -> float:
    """How far the child is turned about an axis of the joint [rad], between -π and π."""
    q0 = wp.transform_get_rotation(_pose(bodies.q, joints.parent[joint]) * joints.parent_frame[joint])
    q1 = wp.transform_get_rotation(bodies.q[joints.child[joint]] * joints.child_frame[joint])
    rel = wp.quat_inverse(q0) * q1
    angle = 2.0 * wp.atan2(wp.dot(wp.vec3(rel[0], rel[1], rel[2]), axis), rel[3])
    return angle - 2.0 * wp.static(math.pi) * wp.round(angle / wp.static(2.0 * math.pi))


@wp.kernel
def _drive(
    # inputs:
    joints: JointView,
    bodies: BodyView,
    target_q_in: wp.array[float],
    target_qd_in: wp.array[float],
    relaxation: float,
    dt: float,
    # outputs:
    given_io: wp.array[float],
    deltas_io: wp.array[wp.spatial_vector],
):
    row = wp.tid()
    joint, dof = joints.row_joint[row], joints.row_dof[row]
    stiffness, damping = joints.stiffness[dof], joints.damping[dof]
    if not joints.enabled[joint] or (stiffness <= 0.0 and damping <= 0.0):
        return
    parent, child = joints.parent[joint], joints.child[joint]
    frame = _pose(bodies.q, parent) * joints.parent_frame[joint]
    axis = wp.transform_vector(frame, joints.axis[dof])
    linear, angular0, angular1, error = wp.vec3(0.0), axis, axis, float(0.0)
    if joints.row_turns[row]:
        error = _angle(joints, bodies, joint, joints.axis[dof]) - target_q_in[joints.row_target[row]]
        error -= 2.0 * wp.static(math.pi) * wp.round(error / wp.static(2.0 * math.pi))
    else:
        offset = _offset(joints, bodies.q, joint)
        lever0, lever1 = _levers(joints, bodies, bodies.q, joint, offset)
        linear, angular0, angular1 = axis, wp.cross(lever0, axis), wp.cross(lever1, axis)
        error = wp.dot(offset, joints.axis[dof]) - target_q_in[joints.row_target[row]]
    gain = _yield(bodies, child, linear, angular1) + _yield(bodies, parent, linear, angular0)
    if gain == 0.0:
        return
    speed = _speed(bodies, child, linear, angular1) - _speed(bodies, parent, linear, angular0)
    # Explicit where the substep resolves the spring, so that it swings on, and implicit where it does not.
    stiff = dt * dt * stiffness * gain
    ahead = dt * stiff / (4.0 + stiff)
    wanted = -dt * (stiffness * (error + ahead * speed) + damping * (speed - target_qd_in[dof]))
    change = relaxation * (wanted - given_io[row]) / (1.0 + gain * dt * (stiffness * ahead + damping))
    limit = dt * joints.effort[dof]
    change = wp.clamp(given_io[row] + change, -limit, limit) - given_io[row]
    given_io[row] += change
    wp.atomic_add(deltas_io, child, change * wp.spatial_vector(linear, angular1))
    if parent >= 0:
        wp.atomic_sub(deltas_io, parent, change * wp.spatial_vector(linear, angular0))


@wp.func
def _left_apart(joints: JointView, bodies: BodyView, joint: int, dt: float) -> wp.vec3:
    """How far the ends of a joint may still be apart at the end of a substep, in the parent's frame [m]."""
    pose0, pose1 = _pose(bodies.q, joints.parent[joint]), bodies.q[joints.child[joint]]
    end0 = wp.transform_get_translation(pose0 * joints.parent_frame[joint])
    end1 = wp.transform_get_translation(pose1 * joints.child_frame[joint])
    apart = wp.length(end1 - end0)
    if apart <= _CLOSING * dt:
        return wp.vec3(0.0)
    return (1.0 - _CLOSING * dt / apart) * wp.quat_rotate_inv(wp.transform_get_rotation(pose0), end1 - end0)


@wp.kernel
def _align(
    # inputs:
    joints: JointView,
    bodies: BodyView,
    dt: float,
    # outputs:
    parent_frame_out: wp.array[wp.transform],
    child_frame_out: wp.array[wp.transform],
    axis_out: wp.array[wp.vec3],
    lower_out: wp.array[float],
    upper_out: wp.array[float],
):
    joint = wp.tid()
    first = joints.dof_start[joint]
    for dof in range(first, joints.dof_start[joint + 1]):
        lower_out[dof] = joints.lower[dof]
        upper_out[dof] = joints.upper[dof]
    turn, apart = wp.quat_identity(), wp.vec3(0.0)
    if joints.one_axis[joint]:
        x, axis = wp.vec3(1.0, 0.0, 0.0), wp.normalize(joints.axis[first])
        middle = x + axis
        turn = wp.quat(0.0, 0.0, 1.0, 0.0)
        if wp.length_sq(middle) > 1.0e-6:
            half = wp.normalize(middle)
            turn = wp.quat(wp.cross(x, half), wp.dot(x, half))
        axis_out[first] = x
        place, step = _angle(joints, bodies, joint, axis), _TURNING * dt
        if joints.slides[joint]:
            place, step = wp.dot(_offset(joints, bodies.q, joint), axis), _CLOSING * dt
        lower_out[first] = wp.min(joints.lower[first], place + step)
        upper_out[first] = wp.max(joints.upper[first], place - step)
    if joints.pins[joint]:
        apart = _left_apart(joints, bodies, joint, dt)
    aligned = wp.transform(wp.vec3(0.0), turn)
    parent_frame_out[joint] = wp.transform(apart, wp.quat_identity()) * joints.parent_frame[joint] * aligned
    child_frame_out[joint] = joints.child_frame[joint] * aligned


@wp.func
def _lent(bodies: BodyView, kinematic_flag: int, body: int, point: wp.vec3) -> wp.vec3:
    """Velocity of a point of a body's frame if the body is kinematic, else zero [m/s]."""
    if body < 0 or (bodies.flags[body] & kinematic_flag) == 0:
        return wp.vec3(0.0)
    arm = wp.transform_vector(bodies.q[body], point - bodies.com[body])
    return wp.spatial_top(bodies.qd[body]) + wp.cross(wp.spatial_bottom(bodies.qd[body]), arm)


@wp.kernel
def _limit_push_out(
    # inputs:
    contacts: ContactView,
    bodies: BodyView,
    kinematic_flag: int,
    dt: float,
    # outputs:
    margin_out: wp.array[float],
):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    body0, body1 = contact_bodies(contacts, i)
    # kinematic bodies stand where they do at the end already: what they come closer by is no overlap of the start
    lent = _lent(bodies, kinematic_flag, body1, contacts.point1[i])
    lent -= _lent(bodies, kinematic_flag, body0, contacts.point0[i])
    overlap = contact_depth(contacts, bodies.q, i) + dt * wp.dot(contacts.normal[i], lent)
    margin_out[i] = contacts.margin0[i] - wp.max(overlap - dt * _PUSH_OUT, 0.0)


@wp.kernel
def _apply(
    # inputs:
    bodies: BodyView,
    deltas_io: wp.array[wp.spatial_vector],
    # outputs:
    qd_out: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    delta = deltas_io[body]
    deltas_io[body] = wp.spatial_vector()
    v, spin = _give(bodies, body, wp.spatial_top(delta), wp.spatial_bottom(delta))
    qd_out[body] += wp.spatial_vector(v, spin)


@wp.kernel
def _move_by(
    # inputs:
    bodies: BodyView,
    deltas_in: wp.array[wp.spatial_vector],
    inv_weights_in: wp.array[float],
    dt: float,
    # outputs:
    q_out: wp.array[wp.transform],
    qd_out: wp.array[wp.spatial_vector],
):
    body = wp.tid()
    weight = float(1.0)
    if inv_weights_in and inv_weights_in[body] > 0.0:
        weight = 1.0 / inv_weights_in[body]
    delta, pose, com = deltas_in[body] * weight, bodies.q[body], bodies.com[body]
    v, spin = _give(bodies, body, wp.spatial_top(delta), wp.spatial_bottom(delta))
    q = wp.transform_get_rotation(pose)
    turned = wp.normalize(q + 0.5 * wp.quat(dt * spin, 0.0) * q)
    center = wp.transform_point(pose, com) + dt * v
    q_out[body] = wp.transform(center - wp.quat_rotate(turned, com), turned)
    qd_out[body] = bodies.qd[body] + wp.spatial_vector(v, spin)


@wp.kernel
def _count_down(
    # outputs:
    left_out: wp.array[int],
):
    left_out[0] = left_out[0] - 1


def launch_count_down(left):
    """Take one from a counter, shape [1]."""
    wp.launch(_count_down, dim=1, outputs=[left], device=left.device)


def launch_align(joints: JointView, bodies: BodyView, dt: float, frames, axes, limits):
    """Write joints as Newton's kernel is to solve them in a substep.

    Frames have the axis of the joint as their x axis, where it has one: Newton's limits know no other. Ends that are
    apart come together, and joints outside of their limits go back, no faster than ``_CLOSING`` and ``_TURNING``.

    Args:
        joints: The joints.
        bodies: The bodies at the start of the substep.
        dt: Length of the substep [s].
        frames: Out, frames in the parents and in the children, shape [joints].
        axes: In and out, axes of the degrees of freedom in those frames, shape [dofs].
        limits: Out, lower and upper limits that can be reached, shape [dofs].
    """
    outputs = [*frames, axes, *limits]
    wp.launch(_align, dim=len(joints.parent), inputs=[joints, bodies, dt], outputs=outputs, device=axes.device)


def launch_limit_push_out(contacts: ContactView, bodies: BodyView, kinematic_flag: int, dt: float, margin):
    """Write margins with which what overlaps is moved apart at no more than ``PUSH_OUT`` in a substep.

    Args:
        contacts: The contacts.
        bodies: The bodies at the start of the substep, kinematic ones where they are at its end.
        kinematic_flag: Newton's flag of kinematic bodies.
        dt: Length of the substep [s].
        margin: Out, what stands for ``contacts.margin0`` [m], shape [contact_max].
    """
    inputs = [contacts, bodies, kinematic_flag, dt]
    wp.launch(_limit_push_out, dim=len(margin), inputs=inputs, outputs=[margin], device=margin.device)


def launch_turn_levers(joints: JointView, bodies: BodyView, q_now, impulses, deltas):
    """Let the impulses of an iteration act where the joints were at the start of the substep.

    Args:
        joints: The joints.
        bodies: The bodies at the start.
        q_now: Poses that the iteration saw, shape [bodies].
        impulses: In, impulses and torques on the children [N·s, N·m·s]; zero afterwards, shape [joints].
        deltas: In and out, what all impulses of the iteration give each body, shape [bodies].
    """
    inputs = [joints, bodies, q_now]
    wp.launch(_turn_levers, dim=len(impulses), inputs=inputs, outputs=[impulses, deltas], device=deltas.device)


def launch_drive(joints: JointView, bodies: BodyView, targets, given, deltas, *, relaxation: float, dt: float):
    """Add what drives give in an iteration.

    Args:
        joints: The joints.
        bodies: The bodies: poses at the start, velocities as they are in the iteration.
        targets: Target positions and velocities.
        given: In and out, impulses that the drives gave so far [N·s or N·m·s], shape [rows].
        deltas: In and out, what all impulses of the iteration give each body, shape [bodies].
        relaxation: Part of each correction that is done.
        dt: Length of the substep [s].
    """
    inputs = [joints, bodies, *targets, relaxation, dt]
    wp.launch(_drive, dim=len(given), inputs=inputs, outputs=[given, deltas], device=deltas.device)


def launch_apply(bodies: BodyView, deltas):
    """Change the velocities of bodies by impulses, which are zero afterwards.

    Args:
        bodies: The bodies.
        deltas: In, impulses and torques about the centres of mass [N·s, N·m·s], shape [bodies]; zero afterwards.
    """
    wp.launch(_apply, dim=len(deltas), inputs=[bodies, deltas], outputs=[bodies.qd], device=deltas.device)


def launch_move_by(bodies: BodyView, deltas, inv_weights, dt: float, q, qd):
    """Write poses and velocities that impulses lead to; what Newton's kernel does, which stops slow bodies, too.

    Args:
        bodies: The bodies.
        deltas: Impulses and torques about the centres of mass [N·s, N·m·s], shape [bodies].
        inv_weights: How many parts the impulses are taken in, shape [bodies], or None.
        dt: Length of the substep [s].
        q: Out, poses, shape [bodies].
        qd: Out, velocities, shape [bodies].
    """
    inputs = [bodies, deltas, inv_weights, dt]
    wp.launch(_move_by, dim=len(deltas), inputs=inputs, outputs=[q, qd], device=deltas.device)
