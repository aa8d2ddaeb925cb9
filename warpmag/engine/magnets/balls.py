"""Adds many balls at once: Newton's own calls add one ball, and Newton replicates it."""

import math
from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.checks import check_not_negative, check_positive, check_text, real_number, vector
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.likely_units import warn_of_magnetization, warn_of_radius
from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import check_registered, mark_shapes
from warpmag.engine.newton_versions import add_copies
from warpmag.errors import InputError
from warpmag.moments.arrays import host_array, host_radii, host_scalars, shape_message
from warpmag.terminal import collection_paused

_SUFFIXES = {"body": "", "joint": "_free_joint", "articulation": "_articulation", "shape": "_shape"}
"""Label suffixes of the objects of a body. Newton's ``add_body`` appends the first three, warpmag the last."""
_NOT_COPIED = ("body_q", "body_qd", "body_world", "body_label", "shape_body", "shape_world", "shape_label")
"""Lists of a builder that differ between copies of a ball."""


@dataclass(frozen=True)
class Balls:
    """Bodies and shapes that :func:`add_balls` has added, in the order of the positions.

    Attributes:
        bodies: Indices of the bodies.
        shapes: Indices of their shapes, one for each body.
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
    remanence: float | None = None,
    direction: tuple[float, float, float] | None = None,
    recoil_permeability: float = 1.0,
    color: tuple[float, float, float] | None = None,
    label: str | None = None,
) -> Balls:
    """Add many free balls, each one a magnet.

    Equivalent to calls of ``add_body``, ``add_shape_sphere`` and :func:`add_inducible` or :func:`add_permanent` for
    each ball, but much faster. ``builder.default_shape_cfg`` sets all other shape properties.

    Args:
        builder: The builder, with :func:`register_custom_attributes` called on it.
        positions: Centers [m], shape [n, 3].
        radius: Radius [m], one number or shape [n].
        orientations: Rotations, unit quaternions x y z w, shape [n, 4]; by default the identity.
        density: Density [kg/m³]; by default the density of ``builder.default_shape_cfg``. If this is Newton's default
            and ``material`` is given, the density of the material.
        friction: Coefficient of friction [dimensionless].
        material: Name of a material of :mod:`warpmag.declarations.materials`: inducible, or permanent with a
            ``direction``.
        saturation: Saturation magnetization Ms [A/m], 1.7e6 by default.
        susceptibility: Susceptibility χ [dimensionless], infinite by default.
        curve: Magnetization curve, see :func:`add_inducible`.
        magnetization, remanence, direction: Magnetization in the frame of each ball, see :func:`add_permanent`. If
            given, the balls are permanent magnets.
        recoil_permeability: Recoil permeability, see :func:`add_permanent`.
        color: Color of all balls, RGB from 0 to 1; by default a color of Newton's palette.
        label: Prefix of labels, before ``_`` and the number of the ball; by default Newton's labels.

    Returns:
        The bodies and the shapes.

    Raises:
        InputError: The attributes are not declared, a position or a value is out of range, or lengths of arrays differ.

    Warns:
        UnitWarning: The magnetization is not that of a real magnet, or a radius is likely in another unit.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> balls = warpmag.add_balls(builder, [[0, 0, 0.01], [0, 0, 0.03]], radius=0.005, saturation=1.7e6)
        >>> len(balls.bodies)
        2
    """
    check_registered(builder)
    poses = _poses(positions, orientations)
    color = None if color is None else vector("color", color)
    if label is not None:
        check_text("label", label)
    count = len(poses)
    radii = _radii(radius, count)
    response = {"saturation": saturation, "susceptibility": susceptibility, "curve": curve}
    permanent = {"magnetization": magnetization, "remanence": remanence, "direction": direction}
    own_magnetization = None
    if any(value is not None for value in permanent.values()):
        own_magnetization = materials.magnetization_from(material=material, **permanent)
        warn_of_magnetization(math.hypot(*own_magnetization))
    magnet = _magnet(material, response, own_magnetization, recoil_permeability)
    magnet.check("add_balls")
    warn_of_radius("add_balls", float(radii.max(initial=0.0)))
    balls = _next_balls(builder, count)
    if count:
        config = _config(builder, density, friction, material)
        _add_copies(builder, _template(builder, radii[0], config, color), count)
        _place(builder, poses)
        _resize(builder, radii, config)
        _name(builder, count, label)
        mark_shapes(builder, balls.shapes, magnet)
    return balls


def copy_ball(
    builder: newton.ModelBuilder, body: int, poses: np.ndarray, velocities: np.ndarray, prefix: str, prefixes: list[str]
) -> Balls:
    """Add copies of a free ball, a body with one shape, and of its magnet; return the bodies and shapes of the copies.

    Args:
        builder: The builder.
        body: The body.
        poses: Positions [m] and quaternions x y z w, shape [n, 7].
        velocities: Linear [m/s] and angular velocities [rad/s], world frame, shape [n, 6].
        prefix: Prefix of the labels of the body and its shape.
        prefixes: Prefix of the labels of each copy, in place of ``prefix``.
    """
    (shape,) = builder.body_shapes[body]
    originals, count = {"body": body, "shape": shape}, len(poses)
    template = _template(builder, builder.shape_scale[shape][0], builder.default_shape_cfg, None)
    for name, values in vars(template).items():
        kind = name.partition("_")[0]
        if kind in originals and name not in _NOT_COPIED and isinstance(values, list) and len(values) == 1:
            values[0] = getattr(builder, name)[originals[kind]]
    copies = _next_balls(builder, count)
    copied = {"body": copies.bodies, "shape": copies.shapes}
    _add_copies(builder, template, count)
    _place(builder, poses)
    velocities = np.ascontiguousarray(velocities, np.float32)
    builder.body_qd[-count:] = map(wp.spatial_vector.from_buffer_copy, velocities)
    builder.joint_qd[-velocities.size :] = velocities.ravel().tolist()
    _name(builder, count, None)
    for kind, original in originals.items():
        labels = getattr(builder, f"{kind}_label")
        suffix = labels[original].removeprefix(prefix)
        labels[-count:] = [f"{new_prefix}{suffix}" for new_prefix in prefixes]
    builder.articulation_label[-count:] = builder.body_label[-count:]  # the labels of Newton's USD import
    for attribute in builder.custom_attributes.values():
        kind = getattr(attribute.frequency, "name", "").lower()
        values: Any = attribute.values
        if kind in originals and originals[kind] in values:
            values.update(dict.fromkeys(copied[kind], values[originals[kind]]))
    return copies


def _next_balls(builder: newton.ModelBuilder, count: int) -> Balls:
    """Return the bodies and shapes of the next ``count`` balls that the builder gets."""
    bodies, shapes = builder.body_count, builder.shape_count
    return Balls(range(bodies, bodies + count), range(shapes, shapes + count))


def _poses(positions, orientations) -> np.ndarray:
    """Return checked positions and unit quaternions, shape [n, 7]."""
    centers = host_array("positions", positions)
    if centers.ndim != 2 or centers.shape[1] != 3:
        raise InputError(shape_message("positions", "[n, 3]", centers))
    poses = np.zeros((len(centers), 7), np.float32)
    if (np.abs(centers) > np.finfo(np.float32).max).any():
        raise InputError("positions: must be finite in single precision")
    poses[:, :3], poses[:, 6] = centers, 1.0
    if orientations is not None:
        quaternions = host_array("orientations", orientations)
        if quaternions.shape != (len(centers), 4):
            raise InputError(shape_message("orientations", f"[{len(centers)}, 4]", quaternions))
        lengths = np.linalg.norm(quaternions, axis=1)
        if (np.abs(lengths - 1.0) > 1e-3).any():  # components are often rounded to few digits
            worst = int(np.argmax(np.abs(lengths - 1.0)))
            raise InputError(
                f"orientations: must be unit quaternions, that of ball {worst} has length {lengths[worst]:g}"
            )
        poses[:, 3:] = quaternions / lengths[:, None]
    return poses


def _radii(radius, count: int) -> np.ndarray:
    """Return the checked radius of each ball [m], shape [n]."""
    radii = host_scalars("radius", host_radii("radius", radius, wp.float32), count)
    if not (radii > 0.0).all():
        raise InputError("radius: must be positive")
    return radii


def _config(builder: newton.ModelBuilder, density, friction, material) -> newton.ModelBuilder.ShapeConfig:
    """Return the builder's shape configuration with the given density and friction, or a material's density."""
    config = builder.default_shape_cfg.copy()
    if material is not None and config.density == newton.ModelBuilder.ShapeConfig().density:
        config.density = materials.material(material).density
    if density is not None:
        check_positive("density", density)
        config.density = float(density)
    if friction is not None:
        check_not_negative("friction", friction)
        config.mu = float(friction)
    return config


def _magnet(material, response: dict, magnetization, recoil_permeability: float) -> Magnet:
    """Return the magnet that :func:`add_balls` describes; ``response`` has the arguments of inducible magnets."""
    fields = {name: value for name, value in response.items() if value is not None}
    if magnetization is None:
        if real_number("recoil_permeability", recoil_permeability) != 1.0:
            raise InputError("recoil_permeability: for permanent magnets only, which need a magnetization")
        curve = fields.pop("curve", None)
        return Magnet("inducible", **materials.inducible_from(material, curve, fields))
    if fields:
        raise InputError(f"{next(iter(fields))}: for inducible magnets only, but magnetization makes permanent magnets")
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
    """Add ``count`` copies of a builder with one ball: replicate a row of √count balls, then single balls.

    Newton loops over copies in Python. Replicating rows takes about 2√count iterations in place of ``count``.
    """
    row_length = math.isqrt(count)
    row = _empty_like(template)
    add_copies(row, template, row_length)
    add_copies(builder, row, count // row_length)
    add_copies(builder, template, count % row_length)


def _place(builder: newton.ModelBuilder, poses: np.ndarray) -> None:
    """Set the poses of the last bodies and of their free joints."""
    poses = np.ascontiguousarray(poses, np.float32)
    builder.body_q[-len(poses) :] = map(wp.transform.from_buffer_copy, poses)
    builder.joint_q[-poses.size :] = poses.ravel().tolist()


def _resize(builder: newton.ModelBuilder, radii: np.ndarray, config: Any) -> None:
    """Set scale, mass and inertia of the last balls if radii differ; Newton computes them once for each radius."""
    unique_radii, index_of = np.unique(radii, return_inverse=True)
    if len(unique_radii) == 1:
        return
    density, solid, margin = config.density, config.is_solid, config.margin
    kind, index_of = newton.GeoType.SPHERE, index_of.tolist()
    scales = [(float(ball_radius), 0.0, 0.0) for ball_radius in unique_radii]
    properties = [newton.geometry.compute_inertia_shape(kind, scale, None, density, solid, margin) for scale in scales]
    masses, inertias = [mass for mass, _, _ in properties], [inertia for _, _, inertia in properties]
    diagonal = [float(np.array(inertia).flat[0]) for inertia in inertias]  # equal about every axis
    inverses = [wp.mat33(*(np.eye(3) * (1.0 / value if value else 0.0)).ravel().tolist()) for value in diagonal]
    for name, values in (
        ("body_mass", masses),
        ("body_inv_mass", [1.0 / mass if mass else 0.0 for mass in masses]),
        ("body_inertia", inertias),
        ("body_inv_inertia", inverses),
        ("shape_scale", scales),
        ("shape_collision_radius", [scale[0] for scale in scales]),
    ):
        getattr(builder, name)[-len(index_of) :] = [values[index] for index in index_of]


def _name(builder: newton.ModelBuilder, count: int, label: str | None) -> None:
    """Label the last balls, their joints and shapes as separate calls of ``add_body`` would."""
    for kind, suffix in _SUFFIXES.items():
        labels = getattr(builder, f"{kind}_label")
        before = len(labels) - count
        if label is None:
            first = before + int(labels[-1].removeprefix(f"{kind}_"))  # Newton numbers some kinds from 0, some from 1
            labels[before:] = [f"{kind}_{number}" for number in range(first, first + count)]
        else:
            labels[before:] = [f"{label}_{number}{suffix}" for number in range(count)]
