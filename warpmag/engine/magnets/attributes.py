"""Magnets on a Newton ``ModelBuilder``: custom attributes of its shapes, namespace ``warpmag``.

Shapes carry the magnet, not bodies, so that a static shape can be one and so that magnets survive ``add_builder``,
``add_world``, ``replicate`` and ``collapse_fixed_joints`` with their shapes.
"""

import math
from dataclasses import replace
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations import materials
from warpmag.declarations.checks import check_vector, check_whole, short_repr
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import CURVES, KINDS, SATURATION_OF_IRON, Magnet
from warpmag.errors import InputError

NAMESPACE = "warpmag"
NO_MAGNET = 0
"""Value of ``warpmag:kind`` on a shape that is no magnet; a magnet has 1 + the index of its kind in ``KINDS``."""

_ATTRIBUTES = {
    "kind": (wp.int32, NO_MAGNET),
    "saturation": (wp.float32, SATURATION_OF_IRON),
    "susceptibility": (wp.float32, math.inf),
    "curve": (wp.int32, 0),
    "magnetization": (wp.vec3, wp.vec3(0.0, 0.0, 0.0)),  # [A/m], frame of the shape
    "recoil_permeability": (wp.float32, 1.0),
    "moment_spacing": (wp.float32, 0.0),
    "conductivity": (wp.float32, 0.0),
}
_OF_SOURCES = {
    "source": (str, ""),  # what ``warpmag.declarations.coils`` writes; empty on a shape that is no source of a field
    "strength": (wp.float32, 0.0),
    "current_keys": (str, ""),  # what ``Keys.to_text`` writes of a coil's current; empty where it is constant
}
_SOLID = (
    newton.GeoType.SPHERE,
    newton.GeoType.BOX,
    newton.GeoType.CAPSULE,
    newton.GeoType.CYLINDER,
    newton.GeoType.ELLIPSOID,
    newton.GeoType.CONE,
    newton.GeoType.MESH,
    newton.GeoType.CONVEX_MESH,
)


def register_custom_attributes(builder: newton.ModelBuilder) -> None:
    """Declare the attributes that magnets are stored in; call it before :func:`add_inducible` and friends.

    Newton's solvers have class methods of this name; ``register_attributes`` is the same function.

    Newton's ``builder.add_usd(stage)`` then brings the magnets of a stage in, too: what colliders or their rigid bodies
    with ``WarpmagMagnetAPI`` say, or the defaults of what they do not say; and its coils and field maps.

    Args:
        builder: The builder; declaring twice does nothing.
    """
    _check_builder(builder)
    declare_attributes(builder, usd_attribute_name="*", usd_value_transformer=_of_prim)
    source = f"{NAMESPACE}:source_prim"
    builder.add_custom_frequency(
        newton.ModelBuilder.CustomFrequency(
            "source_prim", NAMESPACE, usd_prim_filter=_is_source, usd_entry_expander=_add_sources_of
        )
    )
    # without an attribute Newton does not look for prims of this kind
    builder.add_custom_attribute(
        newton.ModelBuilder.CustomAttribute("source_prim", str, source, namespace=NAMESPACE, default="")
    )


def _is_source(prim, _) -> bool:
    """Whether a prim of a stage is a coil or a field map."""
    from warpmag.usd import is_source  # noqa: PLC0415 - a builder can do without USD

    return is_source(prim)


def _add_sources_of(prim, context: dict[str, Any]) -> list[dict[str, Any]]:
    """Add the coil and the field map of a prim to the builder; return no values of Newton's, since they are sites."""
    from warpmag.engine.magnets.sources import add_sources_of_prim  # noqa: PLC0415 - which needs what is here

    add_sources_of_prim(prim, context["builder"], context["result"])
    return []


register_attributes = register_custom_attributes


def declare_attributes(builder: newton.ModelBuilder, **source) -> None:
    """Declare the attributes, of which Newton reads those of magnets from ``source``."""
    for name, (dtype, default) in (_ATTRIBUTES | _OF_SOURCES).items():
        builder.add_custom_attribute(
            newton.ModelBuilder.CustomAttribute(
                name=name,
                dtype=dtype,
                default=default,
                frequency=newton.Model.AttributeFrequency.SHAPE,
                assignment=newton.Model.AttributeAssignment.MODEL,
                namespace=NAMESPACE,
                **(source if name in _ATTRIBUTES else {}),
            )
        )


def _of_prim(_, context: dict[str, Any]):
    """Return the value of one attribute for the shape that Newton makes of a prim, None where that is no magnet."""
    from warpmag.usd import magnet_of, magnet_prim_of  # noqa: PLC0415 - a builder can do without USD

    prim = context["prim"]
    owner = magnet_prim_of(prim)
    if owner is None:
        return None
    turn = axis_turn(prim)
    if owner != prim:
        within = [newton.usd.get_transform(one, local=False).q for one in (owner, prim)]
        turn = wp.quat_inverse(within[0]) * within[1] * turn
    return _values(in_shape_frame(magnet_of(owner), turn))[context["attr"].name]


def in_shape_frame(magnet: Magnet, turn: wp.quat) -> Magnet:
    """Return ``magnet`` with its magnetization in the frame of a shape that is turned by ``turn`` from the prim's."""
    if not np.any(magnet.magnetization):
        return magnet
    turned = wp.quat_rotate_inv(turn, wp.vec3(*magnet.magnetization))
    return replace(magnet, magnetization=tuple(turned))


def axis_turn(prim):
    """Return how Newton turns the frame of a capsule, cylinder or cone prim, whose axis it puts along z."""
    axis = prim.GetAttribute("axis")
    value = axis.Get() if axis else None
    return newton.math.quat_between_axes(newton.Axis.Z, newton.Axis.from_any(value)) if value else wp.quat_identity()


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
        body: The body; all its colliding shapes, which must exist already, become one magnet.
        shape: Instead of all shapes of the body only this one; the way to make a static shape a magnet.
        material: Name of an inducible material of :mod:`warpmag.declarations.materials`, in place of the next two,
            and of the curve where the material has a measured one.
        saturation: Saturation magnetization Ms [A/m], 1.7e6 by default.
        susceptibility: Susceptibility χ [dimensionless], infinite by default.
        curve: Magnetization curve: one of ``magnets.CURVES``, ``tanh`` by default, or a measured one, a
            :class:`warpmag.MagnetizationCurve` or the name of a material that has one, in place of saturation and
            susceptibility.
        moment_spacing: Distance between sampled moments [m]; 0 means one moment for a ball, automatic otherwise.
        conductivity: Electrical conductivity [S/m] of a ball of one moment, its body's only magnet: eddy currents brake
            what moves through the field. 0 means none, with ``material``, too
            (:class:`warpmag.declarations.materials.Material` has it), since it costs a sum over pairs.

    Raises:
        InputError: The attributes are not declared, body or shape do not exist or have no volume, or a value is out
            of range.
    """
    given = {"saturation": saturation, "susceptibility": susceptibility}
    values = materials.inducible_from(material, curve, {k: v for k, v in given.items() if v is not None})
    magnet = Magnet("inducible", **values, moment_spacing=moment_spacing, conductivity=conductivity)
    for index in magnet_shapes(builder, body, shape):
        mark_shape(builder, index, magnet)


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
        body: The body; all its colliding shapes, which must exist already, become one magnet.
        shape: Instead of all shapes of the body only this one; the way to make a static shape a magnet.
        material: Name of a permanent material of :mod:`warpmag.declarations.materials`, which says how strong the
            magnet is.
        magnetization: Magnetization M [A/m] in the frame of the body, of the shape if that is static; with
            ``material`` only its direction counts.
        recoil_permeability: μ of M = M_r + (μ − 1) H, H the field inside and M_r the ``magnetization``: 1.05 or so of
            NdFeB, 1.1 of ferrite [dimensionless]. By default, 1, no field changes M; above, the magnet is one more
            body that induction solves for.
        moment_spacing: Distance between sampled moments [m]; 0 means one moment for a ball, automatic otherwise.
        conductivity: Electrical conductivity [S/m] of a ball of one moment, its body's only magnet: eddy currents brake
            what moves through the field. 0 means none, with ``material``, too
            (:class:`warpmag.declarations.materials.Material` has it), since it costs a sum over pairs.

    Raises:
        InputError: The attributes are not declared, body or shape do not exist or have no volume, or a value is out
            of range.
    """
    check_vector("magnetization", magnetization)
    if material is not None:
        magnetization = materials.permanent("material", material, magnetization)
    for index in magnet_shapes(builder, body, shape):
        in_shape = magnetization
        if builder.shape_body[index] >= 0:
            place: Any = builder.shape_transform[index]  # Newton declares a tuple where it holds a transform
            in_shape = wp.quat_rotate_inv(place.q, wp.vec3(*magnetization))
        magnet = Magnet(
            "permanent",
            magnetization=tuple(in_shape),
            recoil_permeability=recoil_permeability,
            moment_spacing=moment_spacing,
            conductivity=conductivity,
        )
        mark_shape(builder, index, magnet)


def magnet_shapes(builder: newton.ModelBuilder, body: int, shape: int | None = None) -> list[int]:
    """Return the shapes that a magnet on ``body``, or on ``shape`` alone, covers."""
    check_registered(builder)
    if shape is not None:
        _check_index("shape", shape, builder.shape_count, "shapes")
        check_whole("body", body)
        if body not in (-1, builder.shape_body[shape]):
            raise InputError(f"shape: {builder.shape_label[shape]} belongs to body {builder.shape_body[shape]}")
        if builder.shape_type[shape] not in _SOLID:
            kind = newton.GeoType(builder.shape_type[shape]).name.lower()
            raise InputError(f"{builder.shape_label[shape]}: a {kind} has no volume to magnetize")
        return [shape]
    check_body(builder, body)
    shapes = [
        index
        for index in builder.body_shapes[body]
        if builder.shape_flags[index] & newton.ShapeFlags.COLLIDE_SHAPES and builder.shape_type[index] in _SOLID
    ]
    if not shapes:
        raise InputError(f"{builder.body_label[body]}: has no colliding solid shape yet, add its shapes first")
    return shapes


def check_registered(builder: newton.ModelBuilder) -> None:
    """Raise :class:`InputError` unless the attributes are declared on ``builder``."""
    _check_builder(builder)
    if f"{NAMESPACE}:source" not in builder.custom_attributes:
        raise InputError("builder: call warpmag.register_custom_attributes(builder) before magnets are added")


def check_body(builder: newton.ModelBuilder, body: int) -> None:
    """Raise :class:`InputError` unless ``builder`` has the body."""
    _check_index("body", body, builder.body_count, "bodies")


def _check_builder(builder: newton.ModelBuilder) -> None:
    if not isinstance(builder, newton.ModelBuilder):
        raise InputError(f"builder: must be a newton.ModelBuilder, got {short_repr(builder)}")


def _check_index(name: str, index: int, count: int, kind: str) -> None:
    check_whole(name, index)
    if not 0 <= index < count:
        raise InputError(f"{name}: {short_repr(index)} is out of range, the builder has {count} {kind}")


def mark_shape(builder: newton.ModelBuilder, shape: int, magnet: Magnet) -> None:
    """Store ``magnet``, its magnetization in the frame of the shape, on one shape."""
    mark_shapes(builder, range(shape, shape + 1), magnet)


def mark_shapes(builder: newton.ModelBuilder, shapes: range, magnet: Magnet) -> None:
    """Store ``magnet``, its magnetization in the frame of each shape, on shapes."""
    if shapes:
        magnet.check(builder.shape_label[shapes[0]])
    for name, value in _values(magnet).items():
        values: Any = builder.custom_attributes[f"{NAMESPACE}:{name}"].values  # a dictionary, by Newton a list too
        values.update(dict.fromkeys(shapes, value))


def _values(magnet: Magnet) -> dict[str, Any]:
    """Return the values of the attributes of a shape, in whose frame ``magnet`` is."""
    return {
        "kind": 1 + KINDS.index(magnet.kind),
        "saturation": float(magnet.saturation),
        "susceptibility": float(magnet.susceptibility),
        "curve": _curve_number(magnet.curve),
        "magnetization": wp.vec3(*(float(x) for x in magnet.magnetization)),
        "recoil_permeability": float(magnet.recoil_permeability),
        "moment_spacing": float(magnet.moment_spacing),
        "conductivity": float(magnet.conductivity),
    }


_MEASURED: list[MagnetizationCurve] = []
"""Measured curves of shapes: a model has the place in this list, after those with a token."""


def _curve_number(curve: str | MagnetizationCurve) -> int:
    """Number that stands for a curve in the attributes of a model."""
    if not isinstance(curve, MagnetizationCurve):
        return CURVES.index(curve)
    if curve not in _MEASURED:
        _MEASURED.append(curve)
    return len(CURVES) + _MEASURED.index(curve)


def _curve_of(number: int) -> str | MagnetizationCurve:
    return CURVES[number] if number < len(CURVES) else _MEASURED[number - len(CURVES)]


def marked_shapes(model: newton.Model) -> dict[int, Magnet]:
    """Return the magnets of a finished model by shape, magnetizations in the frame of the shape.

    Raises:
        InputError: The model has none.
    """
    attributes = getattr(model, NAMESPACE, None)
    kinds = attributes.kind.numpy() if attributes is not None else np.zeros(0, int)
    marked = np.flatnonzero(kinds != NO_MAGNET)
    if not len(marked):
        raise InputError("model: has no magnets, add some with add_inducible or add_permanent before finalize()")
    columns = [getattr(attributes, name).numpy()[marked] for name in _ATTRIBUTES]
    rows, which = unique_rows(np.column_stack([column.reshape(len(marked), -1) for column in columns]))
    kinds = [_magnet_of_row(*row) for row in rows.tolist()]
    return dict(zip(marked.tolist(), map(kinds.__getitem__, which.tolist()), strict=True))


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different rows of numbers, shape [k, m], and which of them each row is, shape [n]."""
    order = np.lexsort(rows.T)
    differs = np.ones(len(rows), bool)
    differs[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    which = np.empty(len(rows), int)
    which[order] = np.cumsum(differs) - 1
    return rows[order[differs]], which


def _magnet_of_row(kind, saturation, susceptibility, curve, *rest: float) -> Magnet:
    """The magnet of a row of all attributes of ``_ATTRIBUTES``, in their order."""
    *magnetization, recoil_permeability, moment_spacing, conductivity = rest
    return Magnet(
        kind=KINDS[int(kind) - 1],
        saturation=saturation,
        susceptibility=susceptibility,
        curve=_curve_of(int(curve)),
        magnetization=tuple(magnetization),
        recoil_permeability=recoil_permeability,
        moment_spacing=moment_spacing,
        conductivity=conductivity,
    )
