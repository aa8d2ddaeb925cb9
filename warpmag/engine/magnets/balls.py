"""Adding many balls at once: Newton's own calls make one ball, and Newton copies it."""

import math
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.checks import check_not_negative, check_positive, check_vector
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import check_registered, mark_shapes
from warpmag.errors import InputError
from warpmag.moments.arrays import host_array, host_radii, host_scalars, shape_message
from warpmag.terminal import collection_paused

_SUFFIXES = {"body": "", "joint": "_free_joint", "articulation": "_articulation", "shape": "_shape"}
"""Ends of the labels of what belongs to a body: Newton's ``add_body`` appends the first three, warpmag the last."""
_NOT_COPIED = ("body_q", "body_qd", "body_world", "body_label", "shape_body", "shape_world", "shape_label")
"""Lists of a builder whose entries differ between copies of a ball."""


@dataclass(frozen=True)
class Balls:
    """Bodies and shapes that :func:`add_balls` has added, in the order of the positions.

    Attributes:
        bodies: The bodies.
        shapes: Their shapes, one for each body.
    """

    bodies: range
    shapes: range


@collection_paused()
def add_balls(
    builder: newton.ModelBuilder,
    positions: npt.ArrayLike,
    radius: npt.ArrayLike,
    *,
    orientations: npt.ArrayLike | None = None,
    density: float | None = None,
    friction: float | None = None,
    material: str | None = None,
    saturation: float | None = None,
    susceptibility: float | None = None,
    curve: str | MagnetizationCurve | None = None,
    magnetization: tuple[float, float, float] | None = None,
    recoil_permeability: float = 1.0,
    color: tuple[float, float, float] | None = None,
    label: str | None = None,
) -> Balls:
    """Add many free balls, each of which is one magnet.

    The model equals that of ``add_body``, ``add_shape_sphere`` and :func:`add_inducible` or :func:`add_permanent` for
    each ball. A ball takes some microseconds. Other properties of shapes are those of ``builder.default_shape_cfg``.

    Args:
        builder: The builder, with :func:`register_custom_attributes` called on it.
        positions: Centers [m], shape [n, 3].
        radius: Radius of all, or of each, shape [n] [m].
        orientations: Rotations, unit quaternions x y z w, shape [n, 4]; by default the identity.
        density: Density [kg/m³].
        friction: Coefficient of friction [dimensionless].
        material: Name of a material of :mod:`warpmag.declarations.materials`: inducible, or permanent with
            ``magnetization``.
        saturation: Saturation magnetization Ms [A/m], 1.7e6 by default.
        susceptibility: Susceptibility χ [dimensionless], infinite by default.
        curve: Magnetization curve, as :func:`add_inducible` takes it.
        magnetization: Magnetization M [A/m] in the frame of each ball: makes them permanent magnets. With ``material``
            only its direction counts.
        recoil_permeability: As :func:`add_permanent` takes it.
        color: Color of all, RGB from 0 to 1; by default one of Newton's palette.
        label: Prefix of labels, before ``_`` and the number of the ball; by default Newton's labels.

    Returns:
        The bodies and the shapes.

    Raises:
        InputError: The attributes are not declared, a position or a value is out of range, or lengths of arrays differ.
    """
    check_registered(builder)
    poses = _poses(positions, orientations)
    if color is not None:
        check_vector("color", color)
    count = len(poses)
    radii = _radii(radius, count)
    response = {"saturation": saturation, "susceptibility": susceptibility, "curve": curve}
    magnet = _magnet(material, response, magnetization, recoil_permeability)
    magnet.check("add_balls")
    bodies = range(builder.body_count, builder.body_count + count)
    shapes = range(builder.shape_count, builder.shape_count + count)
    if count:
        config = _config(builder, density, friction)
        _add_copies(builder, _template(builder, radii[0], config, color), count)
        _place(builder, poses)
        _resize(builder, radii, config)
        _name(builder, count, label)
        mark_shapes(builder, shapes, magnet)
    return Balls(bodies, shapes)


def copy_ball(
    builder: newton.ModelBuilder, body: int, poses: np.ndarray, velocities: np.ndarray, first: str, others: list[str]
) -> Balls:
    """Add copies of a ball of the builder, magnet included, at other poses.

    Args:
        builder: The builder.
        body: A free body with one shape, a ball.
        poses: Positions [m] and quaternions x y z w, shape [n, 7].
        velocities: Linear [m/s] and angular velocities [rad/s], world frame, shape [n, 6].
        first: Prefix of the labels of the body and its shape.
        others: Prefix of the labels of each copy.

    Returns:
        The bodies and the shapes of the copies.
    """
    (shape,) = builder.body_shapes[body]
    rows, count = {"body": body, "shape": shape}, len(poses)
    template = _template(builder, builder.shape_scale[shape][0], builder.default_shape_cfg, None)
    for name, values in vars(template).items():
        kind = name.partition("_")[0]
        if kind in rows and name not in _NOT_COPIED and isinstance(values, list) and len(values) == 1:
            values[0] = getattr(builder, name)[rows[kind]]
    new = {
        "body": range(builder.body_count, builder.body_count + count),
        "shape": range(builder.shape_count, builder.shape_count + count),
    }
    _add_copies(builder, template, count)
    _place(builder, poses)
    velocities = np.ascontiguousarray(velocities, np.float32)
    builder.body_qd[-count:] = map(wp.spatial_vector.from_buffer_copy, velocities)
    builder.joint_qd[-velocities.size :] = velocities.ravel().tolist()
    _name(builder, count, None)
    for kind, row in rows.items():
        labels = getattr(builder, f"{kind}_label")
        end = labels[row].removeprefix(first)
        labels[-count:] = [f"{prefix}{end}" for prefix in others]
    builder.articulation_label[-count:] = builder.body_label[-count:]  # as Newton's import of stages names them
    for attribute in builder.custom_attributes.values():
        kind = getattr(attribute.frequency, "name", "").lower()
        values: Any = attribute.values
        if kind in rows and rows[kind] in values:
            values.update(dict.fromkeys(new[kind], values[rows[kind]]))
    return Balls(new["body"], new["shape"])


def _poses(positions, orientations) -> np.ndarray:
    """Return checked positions and unit quaternions, shape [n, 7]."""
    places = host_array("positions", positions)
    if places.ndim != 2 or places.shape[1] != 3:
        raise InputError(shape_message("positions", "[n, 3]", places))
    poses = np.zeros((len(places), 7), np.float32)
    if (np.abs(places) > np.finfo(np.float32).max).any():
        raise InputError("positions: must be finite in single precision")
    poses[:, :3], poses[:, 6] = places, 1.0
    if orientations is not None:
        turns = host_array("orientations", orientations)
        if turns.shape != (len(places), 4):
            raise InputError(shape_message("orientations", f"[{len(places)}, 4]", turns))
        lengths = np.linalg.norm(turns, axis=1)
        if (np.abs(lengths - 1.0) > 1e-3).any():  # components are often rounded to few digits
            worst = int(np.argmax(np.abs(lengths - 1.0)))
            raise InputError(
                f"orientations: must be unit quaternions, that of ball {worst} has length {lengths[worst]:g}"
            )
        poses[:, 3:] = turns / lengths[:, None]
    return poses


def _radii(radius, count: int) -> np.ndarray:
    """Return the checked radius of each ball [m], shape [n]."""
    radii = host_scalars("radius", host_radii("radius", radius, wp.float32), count)
    if not (radii > 0.0).all():
        raise InputError("radius: must be positive")
    return radii


def _config(builder: newton.ModelBuilder, density, friction) -> newton.ModelBuilder.ShapeConfig:
    """Return the builder's properties of shapes with another density and friction, where given."""
    config = builder.default_shape_cfg.copy()
    if density is not None:
        check_positive("density", density)
        config.density = float(density)
    if friction is not None:
        check_not_negative("friction", friction)
        config.mu = float(friction)
    return config


def _magnet(material, response: dict, magnetization, recoil_permeability: float) -> Magnet:
    """Return the magnet of the arguments of :func:`add_balls`; ``response`` are those of inducible magnets."""
    fields = {name: value for name, value in response.items() if value is not None}
    if magnetization is None:
        if recoil_permeability != 1.0:
            raise InputError("recoil_permeability: is of permanent magnets only, which have a magnetization")
        curve = fields.pop("curve", None)
        return Magnet("inducible", **materials.inducible_from(material, curve, fields))
    if fields:
        raise InputError(f"{next(iter(fields))}: is of inducible magnets only, and magnetization makes permanent ones")
    check_vector("magnetization", magnetization)
    if material is not None:
        magnetization = materials.permanent("material", material, magnetization)
    return Magnet("permanent", magnetization=tuple(magnetization), recoil_permeability=recoil_permeability)


def _empty_like(builder: newton.ModelBuilder) -> newton.ModelBuilder:
    """Return an empty builder that Newton can merge into ``builder`` without changing its settings."""
    empty = newton.ModelBuilder(up_axis=builder.up_axis)
    empty.rigid_gap = builder.rigid_gap
    world = builder.current_world
    empty.gravity = builder.world_gravity[world] if 0 <= world < len(builder.world_gravity) else builder.gravity
    return empty


def _template(builder: newton.ModelBuilder, radius: float, config, color) -> newton.ModelBuilder:
    """Return a builder with one ball, made by Newton's own calls."""
    template = _empty_like(builder)
    body = template.add_body()
    template.add_shape_sphere(body, radius=float(radius), cfg=config, color=color)
    return template


def _add_copies(builder: newton.ModelBuilder, template: newton.ModelBuilder, count: int) -> None:
    """Add ``count`` copies of a builder with one ball: a row of copies, and many copies of that row.

    Newton loops over copies in Python, but adds the contents of one copy as a whole: n copies take about 2√n passes.
    """
    row_length = math.isqrt(count)
    row = _empty_like(template)
    row.replicate(template, row_length, separate_worlds=False)
    builder.replicate(row, count // row_length, separate_worlds=False)
    builder.replicate(template, count % row_length, separate_worlds=False)


def _place(builder: newton.ModelBuilder, poses: np.ndarray) -> None:
    """Set the poses of the last bodies and of their free joints."""
    poses = np.ascontiguousarray(poses, np.float32)
    builder.body_q[-len(poses) :] = map(wp.transform.from_buffer_copy, poses)
    builder.joint_q[-poses.size :] = poses.ravel().tolist()


def _resize(builder: newton.ModelBuilder, radii: np.ndarray, config: Any) -> None:
    """Set scale, mass and inertia of the last balls where radii differ, computed by Newton once for each radius."""
    sizes, size_of = np.unique(radii, return_inverse=True)
    if len(sizes) == 1:
        return
    density, solid, margin = config.density, config.is_solid, config.margin
    kind, size_of = newton.GeoType.SPHERE, size_of.tolist()
    scales = [(float(size), 0.0, 0.0) for size in sizes]
    properties = [newton.geometry.compute_inertia_shape(kind, scale, None, density, solid, margin) for scale in scales]
    masses, inertias = [mass for mass, _, _ in properties], [inertia for _, _, inertia in properties]
    about_axis = [float(np.array(inertia).flat[0]) for inertia in inertias]  # the same about every axis
    inverses = [wp.mat33(*(np.eye(3) * (1.0 / value if value else 0.0)).ravel().tolist()) for value in about_axis]
    for name, values in (
        ("body_mass", masses),
        ("body_inv_mass", [1.0 / mass if mass else 0.0 for mass in masses]),
        ("body_inertia", inertias),
        ("body_inv_inertia", inverses),
        ("shape_scale", scales),
        ("shape_collision_radius", [scale[0] for scale in scales]),
    ):
        getattr(builder, name)[-len(size_of) :] = [values[size] for size in size_of]


def _name(builder: newton.ModelBuilder, count: int, label: str | None) -> None:
    """Label the last balls, their joints and shapes as if each ball had been added alone."""
    for kind, suffix in _SUFFIXES.items():
        labels = getattr(builder, f"{kind}_label")
        before = len(labels) - count
        if label is None:
            first = before + int(labels[-1].removeprefix(f"{kind}_"))  # Newton counts some from 0, some from 1
            labels[before:] = [f"{kind}_{number}" for number in range(first, first + count)]
        else:
            labels[before:] = [f"{label}_{number}{suffix}" for number in range(count)]
