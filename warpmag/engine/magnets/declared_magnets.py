"""Adds magnets to Newton builders: inducible and permanent materials of bodies and shapes."""

import math
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.likely_units import warn_of_magnetization, warn_of_radius
from warpmag.declarations.magnets import Magnet, check_sizes
from warpmag.deprecation import keyword_arguments
from warpmag.engine.magnets.attributes import check_registered, mark_shapes
from warpmag.engine.magnets.body_mass import give_density
from warpmag.engine.magnets.sampling import lengths_of
from warpmag.engine.magnets.selection import selected
from warpmag.errors import InputError

_SOLID = [
    newton.GeoType[name]
    for name in ("SPHERE", "BOX", "CAPSULE", "CYLINDER", "ELLIPSOID", "CONE", "MESH", "CONVEX_MESH")
]
"""Types of shapes with a volume."""


@keyword_arguments("body")
def add_inducible(
    builder: newton.ModelBuilder,
    *,
    body: int | str | None = None,
    shape: int | str | None = None,
    material: str | None = None,
    saturation: float | None = None,
    susceptibility: float | None = None,
    curve: str | MagnetizationCurve | None = None,
    moment_spacing: float = 0.0,
    conductivity: float = 0.0,
) -> list[int]:
    """Mark bodies, or single shapes, as inducible magnets: iron, steel or soft ferrite.

    Args:
        builder: The builder, with :func:`register_custom_attributes` called on it.
        body: Index, label or pattern of labels of bodies, such as ``"gripper"`` or ``"*/ball_*"``. A label may be given
            without the part up to its last ``/``. All colliding shapes of a body, which must exist already, become one
            magnet.
        shape: Index, label or pattern of shapes, in place of ``body``: single shapes, for example static ones.
        material: Name of an inducible material of :mod:`warpmag.declarations.materials`. It replaces ``saturation`` and
            ``susceptibility``, and ``curve`` if the material has a measured curve. A body whose mass follows from
            Newton's default density gets the density of the material.
        saturation: Saturation magnetization Ms [A/m], 1.7e6 by default.
        susceptibility: Susceptibility χ [dimensionless], infinite by default.
        curve: Formula of the magnetization curve, ``tanh`` (default), ``langevin``, ``clamped``, ``frohlich`` or
            ``tanh-applied``. Or a measured curve: a :class:`warpmag.MagnetizationCurve`, or the name of a material that
            has one. A measured curve replaces saturation and susceptibility. For a ball of one moment, a formula is a
            function of the external field plus the fields of all other sources; for other shapes, of the field inside.
            For all shapes ``tanh-applied`` is a function of the external field plus the fields of all other sources.
        moment_spacing: Distance between sampled moments [m]. 0 means one moment for a ball, and at most 729 moments for
            other bodies. A body of more than 27 shapes may have 27 moments for each shape.
        conductivity: Electrical conductivity [S/m]. Eddy currents brake a conductor that moves through the field. Only
            a ball of one moment that is the only magnet of its body can conduct; :class:`warpmag.Magnetics` raises an
            error for others. 0 means no eddy currents. ``material`` does not set it, since eddy currents cost a sum
            over pairs; :class:`warpmag.declarations.materials.Material` lists values.

    Returns:
        Indices of the shapes that became magnets.

    Raises:
        InputError: The attributes are not declared, not exactly one of ``body`` and ``shape`` is given, no
            object or several objects match the label, the shapes have no volume, or a value is out of range.

    Warns:
        UnitWarning: A ball is so large that its radius is likely in another unit.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> ball = builder.add_body(label="tray/ball_1")
        >>> shape = builder.add_shape_sphere(ball, radius=0.005)
        >>> warpmag.add_inducible(builder, body="*/ball_*", material="iron") == [shape]
        True
    """
    numbers = {"saturation": saturation, "susceptibility": susceptibility}
    values = materials.inducible_from(material, curve, {k: v for k, v in numbers.items() if v is not None})
    magnet = Magnet("inducible", **values, moment_spacing=moment_spacing, conductivity=conductivity)
    shapes = magnet_shapes(builder, body=body, shape=shape)
    magnet.check(builder.shape_label[shapes[0]])
    warn_of_radius("add_inducible", _largest_ball(builder, shapes))
    mark_shapes(builder, shapes, magnet)
    if material is not None:
        give_density(builder, shapes, materials.material(material).density)
    return shapes


@keyword_arguments("body")
def add_permanent(
    builder: newton.ModelBuilder,
    *,
    body: int | str | None = None,
    shape: int | str | None = None,
    magnetization: tuple[float, float, float] | None = None,
    remanence: float | None = None,
    material: str | None = None,
    direction: tuple[float, float, float] | None = None,
    recoil_permeability: float = 1.0,
    moment_spacing: float = 0.0,
    conductivity: float = 0.0,
) -> list[int]:
    """Make bodies, or single shapes, permanent magnets.

    The strength is one of three: ``magnetization``, or ``remanence`` or ``material`` with a ``direction``.

    Args:
        builder: The builder, with :func:`register_custom_attributes` called on it.
        body: Index, label or pattern of labels of bodies, see :func:`add_inducible`. All colliding shapes of a body
            become one magnet.
        shape: Index, label or pattern of shapes, in place of ``body``: single shapes, for example static ones.
        magnetization: Magnetization M [A/m] in the frame of the body, or of a static shape.
        remanence: Remanence Br [T] of a data sheet, M = Br/μ0.
        material: Name of a permanent material of :mod:`warpmag.declarations.materials`, such as ``"N42"``. A body whose
            mass follows from Newton's default density gets the density of the material.
        direction: Direction of the magnetization for ``remanence`` and ``material``, of any length, in the frame of the
            body, or of a static shape.
        recoil_permeability: μ of M = M_r + (μ − 1) H [dimensionless], with the internal field H and ``magnetization``
            M_r: about 1.05 for NdFeB, 1.1 for ferrite. At 1, the default, no field changes M. Above 1 the induction
            solve includes the magnet.
        moment_spacing: Distance between sampled moments [m]. 0 means one moment for a ball, 2 to 8 for most boxes and
            cylinders, and at most 729 for other shapes. Boxes and cylinders in models with coils, field maps, recoil
            permeability or gradients have up to 256.
        conductivity: Electrical conductivity [S/m], see :func:`add_inducible`.

    Returns:
        Indices of the shapes that became magnets.

    Raises:
        InputError: The attributes are not declared, not exactly one of ``body`` and ``shape`` or of the three strengths
            is given, no object or several objects match the label, the shapes have no volume, or a value is out of
            range.

    Warns:
        UnitWarning: The magnetization is not that of a real magnet, or a ball is so large that its radius is likely in
            another unit.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> gripper = builder.add_body(label="gripper")
        >>> shape = builder.add_shape_box(gripper, hx=0.01, hy=0.01, hz=0.01)
        >>> warpmag.add_permanent(builder, body="gripper", remanence=1.3, direction=(0.0, 0.0, 1.0)) == [shape]
        True
    """
    vector = materials.magnetization_from(magnetization, remanence, material, direction)
    values = {"moment_spacing": moment_spacing, "conductivity": conductivity}
    magnet = Magnet("permanent", magnetization=vector, recoil_permeability=recoil_permeability, **values)
    shapes = magnet_shapes(builder, body=body, shape=shape)
    for index in shapes:
        rotation = wp.quat_identity()
        if builder.shape_body[index] >= 0:
            frame: Any = builder.shape_transform[index]  # Newton annotates a tuple, but it is a transform
            rotation = frame.q
        rotated = in_shape_frame(magnet, rotation)
        rotated.check(builder.shape_label[index])
        mark_shapes(builder, [index], rotated)
    warn_of_magnetization(math.hypot(*vector))
    warn_of_radius("add_permanent", _largest_ball(builder, shapes))
    if material is not None:
        give_density(builder, shapes, materials.material(material).density)
    return shapes


def _largest_ball(builder: newton.ModelBuilder, shapes: list[int]) -> float:
    """Return the largest radius [m] of the balls among shapes, 0 without one."""
    balls = [shape for shape in shapes if builder.shape_type[shape] == newton.GeoType.SPHERE]
    return max((builder.shape_scale[ball][0] for ball in balls), default=0.0)


def in_shape_frame(magnet: Magnet, rotation: wp.quat) -> Magnet:
    """Return a magnet in the frame of a shape; ``rotation`` is from that frame to the magnet's, of a body or prim."""
    if not np.any(magnet.magnetization):
        return magnet
    return replace(magnet, magnetization=tuple(wp.quat_rotate_inv(rotation, wp.vec3(*magnet.magnetization))))


def axis_rotation(axis: str | None) -> Any:
    """Return the rotation from a shape's frame to the frame of its prim, from the prim's axis token or None.

    Newton's capsules, cylinders and cones have their axis along z.
    """
    return newton.math.quat_between_axes(newton.Axis.Z, newton.Axis.from_any(axis)) if axis else wp.quat_identity()


def magnet_shapes(builder: newton.ModelBuilder, *, body: int | str | None = None, shape=None) -> list[int]:
    """Return the shapes of magnets on bodies, or single shapes; :class:`InputError` where one has no volume."""
    check_registered(builder)
    if (body is None) == (shape is None):
        raise InputError(f"body, shape: give one of them, got {'none' if body is None else 'both'}")
    if body is None:
        return [_solid(builder, index) for index in selected("shape", shape, builder.shape_label, "shapes")]
    shapes = []
    for index in selected("body", body, builder.body_label, "bodies"):
        colliding = [
            number
            for number in builder.body_shapes[index]
            if builder.shape_flags[number] & newton.ShapeFlags.COLLIDE_SHAPES and builder.shape_type[number] in _SOLID
        ]
        if not colliding:
            raise InputError(f"{builder.body_label[index]}: has no colliding solid shape yet, add its shapes first")
        shapes += [_solid(builder, number) for number in colliding]
    return shapes


def _solid(builder: newton.ModelBuilder, shape: int) -> int:
    """Return ``shape``; raise :class:`InputError` unless it has a volume and valid sizes."""
    if builder.shape_type[shape] not in _SOLID:
        kind = newton.GeoType(builder.shape_type[shape]).name.lower()
        raise InputError(f"{builder.shape_label[shape]}: a {kind} has no volume to magnetize")
    if lengths := lengths_of(builder.shape_type[shape], builder.shape_scale[shape]):
        check_sizes(builder.shape_label[shape], lengths)
    return shape
