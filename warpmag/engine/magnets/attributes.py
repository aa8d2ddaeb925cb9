"""Magnets and sources as custom attributes of shapes, namespace ``warpmag``, on Newton builders and models.

Shapes carry magnets, not bodies: so a static shape can be a magnet, and magnets survive ``add_builder``, ``add_world``,
``replicate`` and ``collapse_fixed_joints``. The attributes of magnets follow from the table of attributes
(``warpmag.declarations.magnets``).
"""

from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE, Attribute, attributes_of
from warpmag.declarations.checks import check_whole, short_repr
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import CURVES, KINDS, Magnet
from warpmag.errors import InputError

NO_MAGNET = 0
"""Value of ``warpmag:kind`` on a shape that is no magnet; a magnet has 1 + the index of its kind in ``KINDS``."""

MAGNET_ATTRIBUTES = attributes_of(Magnet)
"""Rows of the table; a model has one array of shapes for each, named like the field of ``Magnet``."""
_TYPES = {"token": wp.int32, "float": wp.float32, "vector3f": wp.vec3}
"""Type in a model by type in USD; a token is stored as a number."""
_SOURCE_ATTRIBUTES = {
    "source": (str, ""),  # text of a ``declarations.coils.SourceRecord``; empty on a shape that is no source
    "strength": (wp.float32, 0.0),
    "current_keys": (str, ""),  # text of the ``Keys`` of a coil's current; empty where it is constant
}


def declare_attributes(builder: newton.ModelBuilder, usd_value: Callable[[Any, dict], Any] | None = None) -> None:
    """Declare the attributes of magnets and sources on a builder; declaring twice does nothing.

    Args:
        builder: The builder.
        usd_value: Function by which Newton's ``add_usd`` gets the value of a magnet's attribute for a shape.
    """
    check_builder(builder)
    from_usd = {} if usd_value is None else {"usd_attribute_name": "*", "usd_value_transformer": usd_value}
    for row in MAGNET_ATTRIBUTES:
        default = NO_MAGNET if row.field == "kind" else _stored(row, row.default)
        _declare(builder, row.field, _TYPES[row.usd_type], default, **from_usd)
    for name, (dtype, default) in _SOURCE_ATTRIBUTES.items():
        _declare(builder, name, dtype, default)


def _declare(builder: newton.ModelBuilder, name: str, dtype: Any, default: Any, **from_usd: Any) -> None:
    """Declare one attribute of shapes."""
    builder.add_custom_attribute(
        newton.ModelBuilder.CustomAttribute(
            name=name,
            dtype=dtype,
            default=default,
            frequency=newton.Model.AttributeFrequency.SHAPE,
            assignment=newton.Model.AttributeAssignment.MODEL,
            namespace=NAMESPACE,
            **from_usd,
        )
    )


def check_builder(builder: newton.ModelBuilder) -> None:
    """Raise :class:`InputError` unless ``builder`` is one of Newton's builders."""
    if not isinstance(builder, newton.ModelBuilder):
        raise InputError(f"builder: must be a newton.ModelBuilder, got {short_repr(builder)}")


def check_registered(builder: newton.ModelBuilder) -> None:
    """Raise :class:`InputError` unless the attributes are declared on ``builder``."""
    check_builder(builder)
    if f"{NAMESPACE}:source" not in builder.custom_attributes:
        raise InputError("builder: call warpmag.register_custom_attributes(builder) before magnets are added")


def check_body(builder: newton.ModelBuilder, body: int) -> None:
    """Raise :class:`InputError` unless ``builder`` has the body."""
    check_index("body", body, builder.body_count, "bodies")


def check_index(name: str, index: int, count: int, things: str) -> None:
    """Raise :class:`InputError` unless ``index`` is one of ``count`` things of the builder."""
    check_whole(name, index)
    if not 0 <= index < count:
        raise InputError(f"{name}: {short_repr(index)} is out of range, the builder has {count} {things}")


def mark_shapes(builder: newton.ModelBuilder, shapes: range | list[int], magnet: Magnet) -> None:
    """Store a checked ``magnet`` on shapes, its magnetization in the frame of each shape."""
    for name, value in stored_values(magnet).items():
        values: Any = builder.custom_attributes[f"{NAMESPACE}:{name}"].values  # Newton declares a list, too
        values.update(dict.fromkeys(shapes, value))


def stored_values(magnet: Magnet) -> dict[str, Any]:
    """Return the values of a shape's attributes; ``magnet`` is in the frame of the shape."""
    return {row.field: _stored(row, getattr(magnet, row.field)) for row in MAGNET_ATTRIBUTES}


def _stored(row: Attribute, value: Any) -> Any:
    """Return the value of a field as a model stores it."""
    if row.field == "kind":
        return 1 + KINDS.index(value)
    if row.field == "curve":
        return _curve_number(value)
    if row.usd_type == "vector3f":
        return wp.vec3(*(float(component) for component in value))
    return float(value)


_measured_curves: list[MagnetizationCurve] = []
"""Measured curves of all shapes; a model stores the position in this list, after those of ``CURVES``."""


def _curve_number(curve: str | MagnetizationCurve) -> int:
    """Return the number by which a model stores a curve."""
    if not isinstance(curve, MagnetizationCurve):
        return CURVES.index(curve)
    if curve not in _measured_curves:
        _measured_curves.append(curve)
    return len(CURVES) + _measured_curves.index(curve)


def _curve_of(number: int) -> str | MagnetizationCurve:
    """Return the curve that a model stores by a number."""
    return CURVES[number] if number < len(CURVES) else _measured_curves[number - len(CURVES)]


def marked_shapes(model: newton.Model) -> dict[int, Magnet]:
    """Return the magnets of a finished model by shape, magnetizations in the frame of the shape.

    Raises:
        InputError: The model has no magnets.
    """
    attributes = getattr(model, NAMESPACE, None)
    kinds = attributes.kind.numpy() if attributes is not None else np.zeros(0, int)
    marked = np.flatnonzero(kinds != NO_MAGNET)
    if not len(marked):
        raise InputError("model: has no magnets, add some with add_inducible or add_permanent before finalize()")
    columns = [getattr(attributes, row.field).numpy()[marked].reshape(len(marked), -1) for row in MAGNET_ATTRIBUTES]
    rows, row_of = unique_rows(np.column_stack(columns))
    ends = np.cumsum([column.shape[1] for column in columns])[:-1]
    magnets = [_magnet_of(np.split(row, ends)) for row in rows]
    return {shape: magnets[row] for shape, row in zip(marked.tolist(), row_of.tolist(), strict=True)}


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different rows of numbers, shape [k, m], and the index among them of each row, shape [n]."""
    order = np.lexsort(rows.T)
    differs = np.ones(len(rows), bool)
    differs[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    index = np.empty(len(rows), int)
    index[order] = np.cumsum(differs) - 1
    return rows[order[differs]], index


def _magnet_of(values: list[np.ndarray]) -> Magnet:
    """Return the magnet of the stored values of one shape, in the order of the table."""
    fields = {}
    for row, value in zip(MAGNET_ATTRIBUTES, values, strict=True):
        if row.field == "kind":
            fields["kind"] = KINDS[int(value[0]) - 1]
        elif row.field == "curve":
            fields["curve"] = _curve_of(int(value[0]))
        else:
            fields[row.field] = tuple(value.tolist()) if row.usd_type == "vector3f" else float(value[0])
    return Magnet(**fields)
