"""Structs of Newton's arrays of bodies and contacts, and functions that several kernels share.

The structs refer to Newton's arrays without copies. They are filled before each launch, because states alternate and
contact buffers are replaced when they grow.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class BodyView:
    """Bodies of a model in one state, arrays of shape [bodies]."""

    q: wp.array[wp.transform]  # pose
    qd: wp.array[wp.spatial_vector]  # velocity of the center of mass and angular velocity [m/s, rad/s]
    f: wp.array[wp.spatial_vector]  # force and torque about the center of mass [N, N·m]
    com: wp.array[wp.vec3]  # center of mass in the body's frame [m]
    inertia: wp.array[wp.mat33]  # inertia in the body's frame [kg·m²]
    inv_mass: wp.array[float]  # inverse mass, zero for bodies that forces do not move [1/kg]
    inv_inertia: wp.array[wp.mat33]  # inverse inertia in the body's frame [1/(kg·m²)]
    flags: wp.array[wp.int32]  # Newton's ``BodyFlags``
    world: wp.array[wp.int32]  # world of the body


@wp.struct
class ContactView:
    """Contacts of rigid bodies, and their shapes."""

    count: wp.array[wp.int32]  # number of contacts, more than ``contact_max`` if some were dropped, shape [1]
    shape0: wp.array[wp.int32]  # shapes of each contact, shape [contact_max]
    shape1: wp.array[wp.int32]
    point0: wp.array[wp.vec3]  # contact points in the frames of the two bodies [m], shape [contact_max]
    point1: wp.array[wp.vec3]
    offset0: wp.array[wp.vec3]  # vectors from the points to the surfaces, in those frames [m], shape [contact_max]
    offset1: wp.array[wp.vec3]
    margin0: wp.array[float]  # distance of the surface from each point [m], shape [contact_max]
    margin1: wp.array[float]
    normal: wp.array[wp.vec3]  # unit vector from the first shape to the second, shape [contact_max]
    shape_body: wp.array[wp.int32]  # body of each shape, -1 for the world, shape [shapes]
    shape_gap: wp.array[float]  # distance up to which contacts are detected [m], shape [shapes]
    mu: wp.array[float]  # coefficients of friction of each shape, shape [shapes]
    mu_torsional: wp.array[float]
    mu_rolling: wp.array[float]


def view_bodies(model, state) -> BodyView:
    """Return the bodies of ``model`` in ``state``."""
    view = BodyView()
    view.q, view.qd, view.f = state.body_q, state.body_qd, state.body_f
    view.com, view.inertia = model.body_com, model.body_inertia
    view.inv_mass, view.inv_inertia = model.body_inv_mass, model.body_inv_inertia
    view.flags, view.world = model.body_flags, model.body_world
    return view


def view_contacts(model, contacts) -> ContactView:
    """Return Newton's ``contacts`` between the shapes of ``model``."""
    view = ContactView()
    view.count = contacts.rigid_contact_count
    for name in ("shape0", "shape1", "point0", "point1", "offset0", "offset1", "margin0", "margin1", "normal"):
        setattr(view, name, getattr(contacts, f"rigid_contact_{name}"))
    view.shape_body, view.shape_gap = model.shape_body, model.shape_gap
    for name in ("mu", "mu_torsional", "mu_rolling"):
        setattr(view, name, getattr(model, f"shape_material_{name}"))
    return view


@wp.func
def body_pose(body_q: wp.array[wp.transform], body: int) -> wp.transform:
    """Return the pose of a body, the identity for the world, -1."""
    if body < 0:
        return wp.transform_identity()
    return body_q[body]


@wp.func
def velocity_at(bodies: BodyView, body: int, x: wp.vec3):
    """Return the velocity of a point x, in the world's frame, of a body [m/s]."""
    center = wp.transform_point(bodies.q[body], bodies.com[body])
    return wp.spatial_top(bodies.qd[body]) + wp.cross(wp.spatial_bottom(bodies.qd[body]), x - center)


@wp.func
def contact_count(contacts: ContactView) -> int:
    """Return the number of contacts in the buffers."""
    return wp.min(contacts.count[0], contacts.shape0.shape[0])


@wp.func
def contact_bodies(contacts: ContactView, i: int):
    """Return the two bodies of contact i, -1 for the world."""
    return contacts.shape_body[contacts.shape0[i]], contacts.shape_body[contacts.shape1[i]]


@wp.func
def _world_point(body_q: wp.array[wp.transform], body: int, point: wp.vec3) -> wp.vec3:
    """Return a point of a body's frame in the world's frame."""
    if body < 0:
        return point
    return wp.transform_point(body_q[body], point)


@wp.func
def contact_depth(contacts: ContactView, body_q: wp.array[wp.transform], i: int) -> float:
    """Return the penetration of contact i at the poses ``body_q`` [m], negative for a gap."""
    body0, body1 = contact_bodies(contacts, i)
    apart = _world_point(body_q, body1, contacts.point1[i]) - _world_point(body_q, body0, contacts.point0[i])
    return contacts.margin0[i] + contacts.margin1[i] - wp.dot(contacts.normal[i], apart)
