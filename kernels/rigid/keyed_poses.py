"""Poses and velocities of kinematic bodies with time-sampled transforms.

A body's frame is a product of transforms, and each transform has keys of its own, as in USD. So a body that rotates by
angles moves along arcs, not along chords between poses. The product is evaluated in double precision at the given time.
Velocities are means over an interval Δt: v = (c₁ − c₀)/Δt of the center of mass, and ω = the rotation vector from q₀ to
q₁ over Δt. A solver that moves bodies by their velocities moves the body to its next pose.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.rigid import keys

wp.set_module_options({"enable_backward": False})

TRANSFORMS = (
    *("translate", "scale", "orient", "matrix"),
    *("rotateXYZ", "rotateXZY", "rotateYXZ", "rotateYZX", "rotateZXY", "rotateZYX"),
)
_TRANSLATE, _SCALE, _ORIENT, _MATRIX, _ROTATE = (wp.constant(k) for k in range(5))
_RADIANS = wp.constant(wp.float64(np.pi / 180.0))


@wp.struct
class KeyedPoses:
    """Bodies that follow keys, for b bodies with o transforms."""

    time: wp.array[wp.float64]  # time on the device [s], shape [1]
    keyed: keys.KeyedValues  # the keys, a curve for each transform
    kind: wp.array[wp.int32]  # index of each transform's type in ``TRANSFORMS``, shape [o]
    inverse: wp.array[wp.int32]  # 1 for inverted transforms, shape [o]
    first: wp.array[wp.int32]  # first (outermost) transform of each body, and the one after the last, shape [b + 1]
    body: wp.array[wp.int32]  # index of each body in the model, shape [b]
    com: wp.array[wp.vec3]  # centers of mass of all bodies in their frames [m]
    joint: wp.array[wp.int32]  # free joint of each body, -1 for bodies without one, shape [b]
    # Newton's arrays of all joints.
    joint_q_start: wp.array[wp.int32]
    joint_qd_start: wp.array[wp.int32]
    parent_frame: wp.array[wp.transform]
    child_frame: wp.array[wp.transform]


@wp.func
def _axis_rotation(axis: int, angle: wp.float64) -> wp.quatd:
    """Return the rotation about a coordinate axis by an angle [degrees]."""
    unit = wp.vec3d()
    unit[axis] = wp.float64(1.0)
    return wp.quat_from_axis_angle(unit, angle * _RADIANS)


@wp.func
def _euler_rotation(order: int, angles: wp.vec3d) -> wp.quatd:
    """Return the rotation by three angles [degrees]; orders 2 k and 2 k + 1 of the six begin with axis k."""
    first = order // 2
    second = (first + 1) % 3
    if order % 2 == 0:
        second = wp.where(first == 1, 0, wp.where(first == 0, 1, 0))
    else:
        second = wp.where(first == 2, 1, 2)
    third = 3 - first - second
    return (
        _axis_rotation(third, angles[third])
        * _axis_rotation(second, angles[second])
        * _axis_rotation(first, angles[first])
    )


@wp.func
def _transform_at(poses: KeyedPoses, o: int, time: wp.float64) -> wp.mat44d:
    """Return the matrix of a transform at a time; it multiplies column vectors."""
    key = keys.key_before(poses.keyed, o, time)
    fraction = keys.fraction_after(poses.keyed, o, key, time)
    kind = poses.kind[o]
    matrix = wp.identity(n=4, dtype=wp.float64)
    if kind == _MATRIX:
        for i in range(4):
            for j in range(4):
                matrix[i, j] = keys.interpolate_number(poses.keyed, o, key, fraction, 4 * j + i)
        return matrix
    zero, unscaled = wp.vec3d(), wp.vec3d(wp.float64(1.0))
    if kind == _ORIENT:
        return wp.transform_compose(zero, keys.interpolate_quaternion(poses.keyed, o, key, fraction), unscaled)
    values = wp.vec3d()
    for i in range(3):
        values[i] = keys.interpolate_number(poses.keyed, o, key, fraction, i)
    if kind == _TRANSLATE:
        return wp.transform_compose(values, wp.quat_identity(dtype=wp.float64), unscaled)
    if kind == _SCALE:
        for i in range(3):
            matrix[i, i] = values[i]
        return matrix
    return wp.transform_compose(zero, _euler_rotation(kind - _ROTATE, values), unscaled)


@wp.func
def _pose(poses: KeyedPoses, k: int, time: wp.float64) -> wp.transformd:
    """Return the frame of a body at a time, without its scale, as in Newton."""
    matrix = wp.identity(n=4, dtype=wp.float64)
    for o in range(poses.first[k], poses.first[k + 1]):
        step = _transform_at(poses, o, time)
        if poses.inverse[o] != 0:
            step = wp.inverse(step)
        matrix = matrix * step
    rotation = wp.mat33d()
    for j in range(3):
        axis = wp.normalize(wp.vec3d(matrix[0, j], matrix[1, j], matrix[2, j]))
        for i in range(3):
            rotation[i, j] = axis[i]
    position = wp.vec3d(matrix[0, 3], matrix[1, 3], matrix[2, 3])
    return wp.transformd(position, wp.normalize(wp.quat_from_matrix(rotation)))


@wp.func
def _write_joint(
    poses: KeyedPoses, joint: int, pose: wp.transform, qd: wp.spatial_vector, joint_q: wp.array[float],
    joint_qd: wp.array[float],
):  # fmt: skip
    """Write the coordinates and velocities of a free joint, relative to its frames."""
    parent = poses.parent_frame[joint]
    local = wp.transform_inverse(parent) * pose * poses.child_frame[joint]
    for k in range(7):
        joint_q[poses.joint_q_start[joint] + k] = local[k]
    q = wp.transform_get_rotation(parent)
    linear, angular = wp.quat_rotate_inv(q, wp.spatial_top(qd)), wp.quat_rotate_inv(q, wp.spatial_bottom(qd))
    for k in range(3):
        joint_qd[poses.joint_qd_start[joint] + k] = linear[k]
        joint_qd[poses.joint_qd_start[joint] + 3 + k] = angular[k]


@wp.kernel
def _write_poses(
    poses: KeyedPoses,
    begin: wp.float64,
    duration: wp.float64,
    at_end: int,
    body_q_out: wp.array[wp.transform],
    body_qd_out: wp.array[wp.spatial_vector],
    joint_q_out: wp.array[float],
    joint_qd_out: wp.array[float],
):
    k = wp.tid()
    body = poses.body[k]
    pose0, pose1 = _pose(poses, k, poses.time[0] + begin), _pose(poses, k, poses.time[0] + begin + duration)
    com = wp.vec3d(poses.com[body])
    moved = wp.transform_point(pose1, com) - wp.transform_point(pose0, com)
    rotation = wp.transform_get_rotation(pose1) * wp.quat_inverse(wp.transform_get_rotation(pose0))
    axis, w = wp.vec3d(rotation[0], rotation[1], rotation[2]), rotation[3]
    if w < wp.float64(0.0):
        axis, w = -axis, -w
    sine = wp.length(axis)
    rate = wp.float64(2.0)  # limit of angle / sin(angle / 2) at small angles
    if sine > wp.float64(1e-12):
        rate = wp.float64(2.0) * wp.atan2(sine, w) / sine
    qd = wp.spatial_vector(wp.vec3(moved / duration), wp.vec3((rate / duration) * axis))
    frame = wp.where(at_end != 0, pose1, pose0)
    orientation = wp.quaternion(wp.transform_get_rotation(frame), dtype=wp.float32)
    pose = wp.transform(wp.vec3(wp.transform_get_translation(frame)), orientation)
    body_q_out[body] = pose
    body_qd_out[body] = qd
    if poses.joint[k] >= 0:
        _write_joint(poses, poses.joint[k], pose, qd, joint_q_out, joint_qd_out)


def keyed_poses(bodies: dict[int, Sequence], joints: Sequence[int], model, time: wp.array) -> Any:
    """Return the :class:`KeyedPoses` of bodies that follow keys by the time on the device [s], float64, shape [1].

    Each body has transforms, the outermost first, with ``kind``, ``keys`` and ``inverse``. ``joints`` are the bodies'
    free joints, -1 for bodies without one.
    """
    transforms = [transform for own in bodies.values() for transform in own]

    def put(values):
        return wp.array(np.array(values, np.int32), dtype=wp.int32, device=time.device)

    a = KeyedPoses()
    a.time, a.keyed = time, keys.keyed_values([transform.keys for transform in transforms], time.device)
    a.kind = put([TRANSFORMS.index(transform.kind) for transform in transforms])
    a.inverse = put([transform.inverse for transform in transforms])
    a.first, a.body, a.joint = put(np.cumsum([0, *map(len, bodies.values())])), put(list(bodies)), put(joints)
    a.com = model.body_com
    if model.joint_count:
        a.joint_q_start, a.joint_qd_start = model.joint_q_start, model.joint_qd_start
        a.parent_frame, a.child_frame = model.joint_X_p, model.joint_X_c
    return a


def write_keyed_poses(poses, state, begin: float, duration: float, *, at_end: bool):
    """Write poses, and the mean velocities over an interval, of bodies to a state; capturable in a graph.

    The interval of length ``duration`` [s] starts at ``begin`` [s], relative to the clock. Poses are those at its end
    or at its start. Coordinates of free joints are written, too.
    """
    inputs = [poses, wp.float64(begin), wp.float64(duration), int(at_end)]
    outputs = [state.body_q, state.body_qd, state.joint_q, state.joint_qd]
    wp.launch(_write_poses, dim=len(poses.body), inputs=inputs, outputs=outputs, device=poses.time.device)
