"""Joints in XPBD: corrections of Newton's iterations over joints, and implicit drives.

Four things differ from Newton's kernels:

* **Lever arms.** Newton evaluates lever arms at the poses of each iteration, which is implicit. A pendulum loses 1.5 %
  of its amplitude in half a swing of 0.28 s. Here joints act where they are at the start of the substep, as in SHAKE
  (Ryckaert, Ciccotti and Berendsen 1977). That is symplectic: amplitudes stay.
* **Penetration recovery.** Overlapping bodies separate at ``RECOVERY_SPEED`` at most, as in ``contact_law.h``. Newton's
  kernel undoes an overlap within a substep, and bodies keep the speed.
* **Drives.** Newton's iterations do not accumulate the impulse of a drive, so that n of them make it about n times too
  stiff. Here a drive accumulates its impulse and converges to the spring and damper of its gains.
* **No rest threshold.** Low speeds are not set to zero.
"""

import math

import warp as wp

from warpmag.kernels.contacts.free_motion import velocity_change
from warpmag.kernels.contacts.solve import RECOVERY_SPEED
from warpmag.kernels.rigid.newton_views import (
    BodyView,
    ContactView,
    body_pose,
    contact_bodies,
    contact_count,
    contact_depth,
)

wp.set_module_options({"enable_backward": False})

_RECOVERY_SPEED = wp.constant(RECOVERY_SPEED)
_CLOSING_SPEED = wp.constant(2.0)
"""Limit of the speed at which separated ends of a joint approach, and slides return into their limits [m/s]. Bodies
keep that speed, and it would grow with shorter substeps if each closed the whole distance."""
_RETURN_RATE = wp.constant(10.0)  # limit of the angular speed at which hinges return into their limits [rad/s]


@wp.struct
class JointView:
    """Joints of a model, and a row for each axis that has a drive."""

    # Joints:
    parent: wp.array[wp.int32]  # body at one end, -1 for the world, shape [joints]
    child: wp.array[wp.int32]  # body at the other end, shape [joints]
    parent_frame: wp.array[wp.transform]  # frame of the joint in the parent's frame, shape [joints]
    child_frame: wp.array[wp.transform]  # frame of the joint in the child's frame, shape [joints]
    enabled: wp.array[wp.bool]  # false for joints without effect, shape [joints]
    slides: wp.array[wp.bool]  # true if the ends may be at different points, shape [joints]
    pins: wp.array[wp.bool]  # true if the ends must coincide, shape [joints]
    one_axis: wp.array[wp.bool]  # true if the joint rotates about or slides along one axis, shape [joints]
    # Degrees of freedom:
    dof_start: wp.array[wp.int32]  # first degree of freedom, and the one after the last, shape [joints + 1]
    lower: wp.array[float]  # limits of each degree of freedom [m or rad], shape [dofs]
    upper: wp.array[float]
    axis: wp.array[wp.vec3]  # direction of each degree of freedom in the frame of the joint, shape [dofs]
    stiffness: wp.array[float]  # gain of the position [N/m or N·m/rad], shape [dofs]
    damping: wp.array[float]  # gain of the velocity [N·s/m or N·m·s/rad], shape [dofs]
    effort: wp.array[float]  # largest force or torque of a drive [N or N·m], shape [dofs]
    # Driven axes:
    row_joint: wp.array[wp.int32]  # joint of each row, shape [rows]
    row_dof: wp.array[wp.int32]  # degree of freedom of each row, shape [rows]
    row_target: wp.array[wp.int32]  # index of its target position, shape [rows]
    row_is_angular: wp.array[wp.bool]  # true for a rotation, false for a slide, shape [rows]


# -------------------- Geometry of joints --------------------


@wp.func
def _center(bodies: BodyView, pose: wp.transform, body: int) -> wp.vec3:
    """Return the center of mass of a body at a pose [m], the origin for the world."""
    if body < 0:
        return wp.vec3(0.0)
    return wp.transform_point(pose, bodies.com[body])


@wp.func
def _lever_arms(joints: JointView, bodies: BodyView, body_q: wp.array[wp.transform], joint: int, rel: wp.vec3):
    """Return the lever arms of a joint about the centers of mass of parent and child [m], for ends ``rel`` apart."""
    parent, child = joints.parent[joint], joints.child[joint]
    pose0, pose1 = body_pose(body_q, parent), body_q[child]
    end0 = wp.transform_point(pose0, wp.transform_point(joints.parent_frame[joint], rel))
    end1 = wp.transform_point(pose1, wp.transform_get_translation(joints.child_frame[joint]))
    return end0 - _center(bodies, pose0, parent), end1 - _center(bodies, pose1, child)


@wp.func
def _offset(joints: JointView, body_q: wp.array[wp.transform], joint: int) -> wp.vec3:
    """Return the child's end relative to the parent's end, in the frame of the joint [m]."""
    frame0 = body_pose(body_q, joints.parent[joint]) * joints.parent_frame[joint]
    frame1 = body_q[joints.child[joint]] * joints.child_frame[joint]
    return wp.transform_get_translation(wp.transform_inverse(frame0) * frame1)


@wp.func
def _angle(joints: JointView, bodies: BodyView, joint: int, axis: wp.vec3) -> float:
    """Return the rotation of the child about an axis of the joint [rad], between -π and π."""
    q0 = wp.transform_get_rotation(body_pose(bodies.q, joints.parent[joint]) * joints.parent_frame[joint])
    q1 = wp.transform_get_rotation(bodies.q[joints.child[joint]] * joints.child_frame[joint])
    rel = wp.quat_inverse(q0) * q1
    angle = 2.0 * wp.atan2(wp.dot(wp.vec3(rel[0], rel[1], rel[2]), axis), rel[3])
    return angle - 2.0 * wp.static(math.pi) * wp.round(angle / wp.static(2.0 * math.pi))


# -------------------- Frames and limits that a substep can reach --------------------


@wp.func
def _remaining_offset(joints: JointView, bodies: BodyView, joint: int, dt: float) -> wp.vec3:
    """Return the offset of a joint's ends that may remain at the end of a substep, in the parent's frame [m]."""
    pose0, pose1 = body_pose(bodies.q, joints.parent[joint]), bodies.q[joints.child[joint]]
    end0 = wp.transform_get_translation(pose0 * joints.parent_frame[joint])
    end1 = wp.transform_get_translation(pose1 * joints.child_frame[joint])
    apart = wp.length(end1 - end0)
    if apart <= _CLOSING_SPEED * dt:
        return wp.vec3(0.0)
    return (1.0 - _CLOSING_SPEED * dt / apart) * wp.quat_rotate_inv(wp.transform_get_rotation(pose0), end1 - end0)


@wp.kernel
def _prepare_joints(
    joints: JointView,
    bodies: BodyView,
    dt: float,
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
    rotation, apart = wp.quat_identity(), wp.vec3(0.0)
    if joints.one_axis[joint]:
        x, axis = wp.vec3(1.0, 0.0, 0.0), wp.normalize(joints.axis[first])
        middle = x + axis
        rotation = wp.quat(0.0, 0.0, 1.0, 0.0)
        if wp.length_sq(middle) > 1.0e-6:
            half = wp.normalize(middle)
            rotation = wp.quat(wp.cross(x, half), wp.dot(x, half))
        axis_out[first] = x
        position, reach = _angle(joints, bodies, joint, axis), _RETURN_RATE * dt
        if joints.slides[joint]:
            position, reach = wp.dot(_offset(joints, bodies.q, joint), axis), _CLOSING_SPEED * dt
        lower_out[first] = wp.min(joints.lower[first], position + reach)
        upper_out[first] = wp.max(joints.upper[first], position - reach)
    if joints.pins[joint]:
        apart = _remaining_offset(joints, bodies, joint, dt)
    aligned = wp.transform(wp.vec3(0.0), rotation)
    parent_frame_out[joint] = wp.transform(apart, wp.quat_identity()) * joints.parent_frame[joint] * aligned
    child_frame_out[joint] = joints.child_frame[joint] * aligned


def launch_prepare_joints(joints: JointView, bodies: BodyView, dt: float, frames, axes, limits):
    """Write the joint frames, axes and limits that Newton's kernel uses in a substep of ``dt`` [s].

    Frames of joints with one axis are rotated so that it is their x axis, because Newton applies limits only there.
    Separated ends approach, and joints outside of their limits return, at ``_CLOSING_SPEED`` and ``_RETURN_RATE`` at
    most.

    Args:
        bodies: The bodies at the start of the substep.
        frames: Out, joint frames in the parents' and in the children's frames, shape [joints].
        axes: In and out, axes of the degrees of freedom in those frames, shape [dofs].
        limits: Out, lower and upper limits that a substep can reach, shape [dofs].
    """
    outputs = [*frames, axes, *limits]
    wp.launch(_prepare_joints, dim=len(joints.parent), inputs=[joints, bodies, dt], outputs=outputs, device=axes.device)


# -------------------- Lever arms --------------------


@wp.kernel
def _correct_lever_arms(
    joints: JointView,
    bodies: BodyView,
    q_now_in: wp.array[wp.transform],
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
    parent0, child0 = _lever_arms(joints, bodies, bodies.q, joint, rel0)
    parent1, child1 = _lever_arms(joints, bodies, q_now_in, joint, rel1)
    linear = wp.vec3(0.0)
    wp.atomic_add(deltas_io, joints.child[joint], wp.spatial_vector(linear, wp.cross(child0 - child1, impulse)))
    if joints.parent[joint] >= 0:
        wp.atomic_sub(deltas_io, joints.parent[joint], wp.spatial_vector(linear, wp.cross(parent0 - parent1, impulse)))


def launch_correct_lever_arms(joints: JointView, bodies: BodyView, q_now, impulses, deltas):
    """Correct the angular impulses of an iteration to the lever arms at the start of the substep.

    Args:
        bodies: The bodies at the start.
        q_now: Poses that the iteration used, shape [bodies].
        impulses: In and out, impulses and angular impulses on the children [N·s, N·m·s]; set to zero, shape [joints].
        deltas: In and out, sums of the iteration's impulses on each body, shape [bodies].
    """
    inputs = [joints, bodies, q_now]
    wp.launch(_correct_lever_arms, dim=len(impulses), inputs=inputs, outputs=[impulses, deltas], device=deltas.device)


# -------------------- Drives --------------------


@wp.func
def _row_mobility(bodies: BodyView, body: int, linear: wp.vec3, angular: wp.vec3) -> float:
    """Return the inverse effective mass of a body along a row [1/kg or 1/(kg·m²)]."""
    v, omega = velocity_change(bodies, body, linear, angular)
    return wp.dot(v, linear) + wp.dot(omega, angular)


@wp.func
def _row_speed(bodies: BodyView, body: int, linear: wp.vec3, angular: wp.vec3) -> float:
    """Return the velocity of a body along a row [m/s or rad/s]."""
    if body < 0:
        return float(0.0)
    return wp.dot(wp.spatial_top(bodies.qd[body]), linear) + wp.dot(wp.spatial_bottom(bodies.qd[body]), angular)


@wp.kernel
def _add_drives(
    joints: JointView,
    bodies: BodyView,
    target_q_in: wp.array[float],
    target_qd_in: wp.array[float],
    relaxation: float,
    dt: float,
    impulses_io: wp.array[float],
    deltas_io: wp.array[wp.spatial_vector],
):
    row = wp.tid()
    joint, dof = joints.row_joint[row], joints.row_dof[row]
    stiffness, damping = joints.stiffness[dof], joints.damping[dof]
    if not joints.enabled[joint] or (stiffness <= 0.0 and damping <= 0.0):
        return
    parent, child = joints.parent[joint], joints.child[joint]
    frame = body_pose(bodies.q, parent) * joints.parent_frame[joint]
    axis = wp.transform_vector(frame, joints.axis[dof])
    linear, angular0, angular1, error = wp.vec3(0.0), axis, axis, float(0.0)
    if joints.row_is_angular[row]:
        error = _angle(joints, bodies, joint, joints.axis[dof]) - target_q_in[joints.row_target[row]]
        error -= 2.0 * wp.static(math.pi) * wp.round(error / wp.static(2.0 * math.pi))
    else:
        offset = _offset(joints, bodies.q, joint)
        lever0, lever1 = _lever_arms(joints, bodies, bodies.q, joint, offset)
        linear, angular0, angular1 = axis, wp.cross(lever0, axis), wp.cross(lever1, axis)
        error = wp.dot(offset, joints.axis[dof]) - target_q_in[joints.row_target[row]]
    mobility = _row_mobility(bodies, child, linear, angular1) + _row_mobility(bodies, parent, linear, angular0)
    if mobility == 0.0:
        return
    speed = _row_speed(bodies, child, linear, angular1) - _row_speed(bodies, parent, linear, angular0)
    # explicit where the substep resolves the spring, so that its oscillation is kept, and implicit elsewhere:
    # impulse = −dt (k (x + t v) + d (v − v₀)) with the time t between 0 and dt
    stiff = dt * dt * stiffness * mobility
    ahead = dt * stiff / (4.0 + stiff)
    target = -dt * (stiffness * (error + ahead * speed) + damping * (speed - target_qd_in[dof]))
    change = relaxation * (target - impulses_io[row]) / (1.0 + mobility * dt * (stiffness * ahead + damping))
    limit = dt * joints.effort[dof]
    change = wp.clamp(impulses_io[row] + change, -limit, limit) - impulses_io[row]
    impulses_io[row] += change
    wp.atomic_add(deltas_io, child, change * wp.spatial_vector(linear, angular1))
    if parent >= 0:
        wp.atomic_sub(deltas_io, parent, change * wp.spatial_vector(linear, angular0))


def launch_add_drives(joints: JointView, bodies: BodyView, targets, impulses, deltas, *, relaxation: float, dt: float):
    """Add the impulses of drives in an iteration.

    Args:
        bodies: The bodies, with poses at the start of the substep and present velocities.
        impulses: In and out, accumulated impulses of the drives [N·s or N·m·s], shape [rows].
        deltas: In and out, sums of the iteration's impulses on each body, shape [bodies].
        relaxation: Fraction of each correction that is applied.
    """
    inputs = [joints, bodies, *targets, relaxation, dt]
    wp.launch(_add_drives, dim=len(impulses), inputs=inputs, outputs=[impulses, deltas], device=deltas.device)


# -------------------- Penetration recovery of contacts, and the loop of iterations --------------------


@wp.func
def _kinematic_velocity(bodies: BodyView, kinematic_flag: int, body: int, point: wp.vec3) -> wp.vec3:
    """Return the velocity of a point of a body's frame if the body is kinematic, else zero [m/s]."""
    if body < 0 or (bodies.flags[body] & kinematic_flag) == 0:
        return wp.vec3(0.0)
    arm = wp.transform_vector(bodies.q[body], point - bodies.com[body])
    return wp.spatial_top(bodies.qd[body]) + wp.cross(wp.spatial_bottom(bodies.qd[body]), arm)


@wp.kernel
def _limit_recovery_speed(
    contacts: ContactView, bodies: BodyView, kinematic_flag: int, dt: float, margin_out: wp.array[float]
):
    i = wp.tid()
    if i >= contact_count(contacts):
        return
    body0, body1 = contact_bodies(contacts, i)
    # kinematic bodies are already at their poses of the substep's end: subtract their motion from the overlap
    kinematic_velocity = _kinematic_velocity(bodies, kinematic_flag, body1, contacts.point1[i])
    kinematic_velocity -= _kinematic_velocity(bodies, kinematic_flag, body0, contacts.point0[i])
    overlap = contact_depth(contacts, bodies.q, i) + dt * wp.dot(contacts.normal[i], kinematic_velocity)
    margin_out[i] = contacts.margin0[i] - wp.max(overlap - dt * _RECOVERY_SPEED, 0.0)


def launch_limit_recovery_speed(contacts: ContactView, bodies: BodyView, kinematic_flag: int, dt: float, margin):
    """Write margins with which Newton's kernel separates overlapping bodies at ``RECOVERY_SPEED`` at most.

    They take the place of ``contacts.margin0``. Bodies are at the start of the substep, but kinematic ones at its end.
    """
    inputs = [contacts, bodies, kinematic_flag, dt]
    wp.launch(_limit_recovery_speed, dim=len(margin), inputs=inputs, outputs=[margin], device=margin.device)


@wp.kernel
def _count_down(count_out: wp.array[int]):
    count_out[0] = count_out[0] - 1


def launch_count_down(count):
    """Decrement a counter, shape [1]."""
    wp.launch(_count_down, dim=1, outputs=[count], device=count.device)
