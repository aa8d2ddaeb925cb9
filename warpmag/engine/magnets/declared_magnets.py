"""Adds magnets to Newton builders: inducible and permanent materials of bodies and shapes."""

from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.checks import check_vector, check_whole
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import check_index, check_registered, mark_shapes
from warpmag.errors import InputError

_SOLID = [
    newton.GeoType[name]
    for name in ("SPHERE", "BOX", "CAPSULE", "CYLINDER", "ELLIPSOID", "CONE", "MESH", "CONVEX_MESH")
]
"""Types of shapes with a volume."""


def add_inducible(
    builder: newton.ModelBuilder,
    body: int = -1,
    *,
    shape: int | None = None,
    material: str | None = None,
    saturation: float | None = None,
    susceptibility: float | None = None,
    curve: str | MagnetizationCurve | None = None,
    moment_spacing: float = 0.0,
    conductivity: float = 0.0,
) -> None:
    """Make a body, or one shape, a magnet that the field magnetizes: iron, steel, ferrite.

    Args:
        builder: The builder, with :func:`register_custom_attributes` called on it.
        body: The body. All its colliding shapes, which must exist already, become one magnet.
        shape: One shape in place of all shapes of the body, for example a static shape.
        material: Name of an inducible material of :mod:`warpmag.declarations.materials`. It replaces ``saturation`` and
            ``susceptibility``, and ``curve`` if the material has a measured curve.
        saturation: Saturation magnetization Ms [A/m], 1.7e6 by default.
        susceptibility: Susceptibility χ [dimensionless], infinite by default.
        curve: Magnetization curve: one of ``magnets.CURVES``, ``tanh`` by default, or a measured curve: a
            :class:`warpmag.MagnetizationCurve` or the name of a material with a measured curve. A measured curve
            replaces saturation and susceptibility. A formula gives M in the field of all others for a ball of one
            moment, and in the field inside for other shapes. ``tanh-applied`` takes the field of all others for both.
        moment_spacing: Distance between sampled moments [m]; 0 means one moment for a ball, automatic otherwise.
        conductivity: Electrical conductivity [S/m] of a ball of one moment, its body's only magnet. Eddy currents brake
            a conductor that moves through the field. 0 means no eddy currents. ``material`` does not set it, since eddy
            currents cost a sum over pairs; :class:`warpmag.declarations.materials.Material` lists values.

    Raises:
        InputError: The attributes are not declared, body or shape do not exist or have no volume, or a value is out
            of range.
    """
    numbers = {"saturation": saturation, "susceptibility": susceptibility}
    values = materials.inducible_from(material, curve, {k: v for k, v in numbers.items() if v is not None})
    magnet = Magnet("inducible", **values, moment_spacing=moment_spacing, conductivity=conductivity)
    shapes = magnet_shapes(builder, body, shape)
    magnet.check(builder.shape_label[shapes[0]])
    mark_shapes(builder, shapes, magnet)


def add_permanent(
    builder: newton.ModelBuilder,
    body: int = -1,
    *,
    shape: int | None = None,
    material: str | None = None,
    magnetization: tuple[float, float, float],
    recoil_permeability: float = 1.0,
    moment_spacing: float = 0.0,
    conductivity: float = 0.0,
) -> None:
    """Make a body, or one shape, a permanent magnet.

    Args:
        builder: The builder, with :func:`register_custom_attributes` called on it.
        body: The body. All its colliding shapes, which must exist already, become one magnet.
        shape: One shape in place of all shapes of the body, for example a static shape.
        material: Name of a permanent material of :mod:`warpmag.declarations.materials`, which sets the strength.
        magnetization: Magnetization M [A/m] in the frame of the body, or of a static shape. With ``material`` only
            its direction counts.
        recoil_permeability: μ of M = M_r + (μ − 1) H [dimensionless], with the internal field H and ``magnetization``
            M_r: about 1.05 for NdFeB, 1.1 for ferrite. At 1, the default, no field changes M. Above 1 the induction
            solve includes the magnet.
        moment_spacing: Distance between sampled moments [m]; 0 means one moment for a ball, automatic otherwise.
        conductivity: Electrical conductivity [S/m], see :func:`add_inducible`.

    Raises:
        InputError: The attributes are not declared, body or shape do not exist or have no volume, or a value is out
            of range.
    """
    check_vector("magnetization", magnetization)
    if material is not None:
        magnetization = materials.permanent("material", material, magnetization)
    values = {"moment_spacing": moment_spacing, "conductivity": conductivity}
    magnet = Magnet("permanent", magnetization=magnetization, recoil_permeability=recoil_permeability, **values)
    for index in magnet_shapes(builder, body, shape):
        rotation = wp.quat_identity()
        if builder.shape_body[index] >= 0:
            frame: Any = builder.shape_transform[index]  # Newton annotates a tuple, but it is a transform
            rotation = frame.q
        rotated = in_shape_frame(magnet, rotation)
        rotated.check(builder.shape_label[index])
        mark_shapes(builder, [index], rotated)


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


def magnet_shapes(builder: newton.ModelBuilder, body: int, shape: int | None = None) -> list[int]:
    """Return the shapes of a magnet on ``body``, or on ``shape`` alone; no solid shape raises :class:`InputError`."""
    check_registered(builder)
    if shape is not None:
        check_index("shape", shape, builder.shape_count, "shapes")
        check_whole("body", body)
        if body not in (-1, builder.shape_body[shape]):
            raise InputError(f"shape: {builder.shape_label[shape]} belongs to body {builder.shape_body[shape]}")
        if builder.shape_type[shape] not in _SOLID:
            kind = newton.GeoType(builder.shape_type[shape]).name.lower()
            raise InputError(f"{builder.shape_label[shape]}: a {kind} has no volume to magnetize")
        return [shape]
    check_index("body", body, builder.body_count, "bodies")
    shapes = [
        index
        for index in builder.body_shapes[body]
        if builder.shape_flags[index] & newton.ShapeFlags.COLLIDE_SHAPES and builder.shape_type[index] in _SOLID
    ]
    if not shapes:
        raise InputError(f"{builder.body_label[body]}: has no colliding solid shape yet, add its shapes first")
    return shapes
