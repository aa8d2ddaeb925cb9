"""Magnets and sources as custom attributes of shapes, namespace ``warpmag``, on Newton builders and models.

The attributes belong to shapes, not to bodies. A static shape can therefore be a magnet, and magnets survive
``add_builder``, ``add_world``, ``replicate`` and ``collapse_fixed_joints``. The fields of
:class:`warpmag.declarations.magnets.Magnet` define the attributes of magnets.
"""

from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE, Attribute, attributes_of
from warpmag.declarations.checks import short_repr
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import CURVES, KINDS, Magnet
from warpmag.errors import InputError

NO_MAGNET = 0
"""Value of ``warpmag:kind`` on a shape that is not a magnet; a magnet has 1 + the index of its kind in ``KINDS``."""

MAGNET_ATTRIBUTES = attributes_of(Magnet)
"""Attributes of magnets. A model has one array over its shapes for each, named after the field of ``Magnet``."""
_TYPES = {"token": wp.int32, "float": wp.float32, "vector3f": wp.vec3}
"""Warp type of a model's attribute by its USD type; a token is stored as an index."""
_SOURCE_ATTRIBUTES = {
    "source": (str, ""),  # text of a ``declarations.coils.SourceRecord``; empty on a shape that is not a source
    "strength": (wp.float32, 0.0),
    "voltage": (wp.float32, 0.0),  # [V], of a coil with a resistance
    "current_keys": (str, ""),  # text of the ``Keys`` of a coil's current or voltage; empty where it is constant
}
"""Warp type and default of the attributes of sources."""
_measured_curves: dict[MagnetizationCurve, int] = {}
_curve_of_number: dict[int, str | MagnetizationCurve] = dict(enumerate(CURVES))
"""Numbers of measured curves and their inverse, with tokens first: a model stores numbers.

Equal curves share a number. A curve stays as long as the process: arrays of models and attributes of builders hold its
number, and their copies and ends are not announced. One of 20 points takes 2 kB.
"""


def declare_attributes(builder: newton.ModelBuilder, usd_value: Callable[[Any, dict], Any] | None = None) -> None:
    """Declare the attributes of magnets and sources on a builder; declaring twice does nothing.

    Newton's ``add_usd`` calls ``usd_value`` for the value of a magnet's attribute on a shape.
    """
    check_builder(builder)
    from_usd = {} if usd_value is None else {"usd_attribute_name": "*", "usd_value_transformer": usd_value}

    def declare(name, dtype, default, **options):
        of_shapes, make = newton.Model.AttributeFrequency.SHAPE, newton.ModelBuilder.CustomAttribute
        builder.add_custom_attribute(make(name, dtype, of_shapes, namespace=NAMESPACE, default=default, **options))

    for row in MAGNET_ATTRIBUTES:
        default = NO_MAGNET if row.field == "kind" else _stored(row, row.default)
        declare(row.field, _TYPES[row.usd_type], default, **from_usd)
    for name, (dtype, default) in _SOURCE_ATTRIBUTES.items():
        declare(name, dtype, default)


def check_builder(builder: newton.ModelBuilder) -> None:
    """Raise :class:`InputError` unless ``builder`` is one of Newton's builders."""
    if not isinstance(builder, newton.ModelBuilder):
        raise InputError(f"builder: must be a newton.ModelBuilder, got {short_repr(builder)}")


def check_registered(builder: newton.ModelBuilder) -> None:
    """Raise :class:`InputError` unless the attributes are declared on ``builder``."""
    check_builder(builder)
    if f"{NAMESPACE}:source" not in builder.custom_attributes:
        raise InputError("builder: call warpmag.register_custom_attributes(builder) before magnets are added")


def mark_shapes(builder: newton.ModelBuilder, shapes: range | list[int], magnet: Magnet) -> None:
    """Store a valid ``magnet`` on shapes, with its magnetization in the frame of each shape."""
    for name, value in stored_values(magnet).items():
        values: Any = builder.custom_attributes[f"{NAMESPACE}:{name}"].values  # Newton's annotation also allows a list
        values.update(dict.fromkeys(shapes, value))


def stored_values(magnet: Magnet) -> dict[str, Any]:
    """Return a shape's attribute values by name, with the magnetization of ``magnet`` in the frame of the shape."""
    return {row.field: _stored(row, getattr(magnet, row.field)) for row in MAGNET_ATTRIBUTES}


def _stored(row: Attribute, value: Any) -> Any:
    """Return the value that a model stores for an attribute."""
    if row.field == "kind":
        return 1 + KINDS.index(value)
    if row.field == "curve":
        if not isinstance(value, MagnetizationCurve):
            return CURVES.index(value)
        number = _measured_curves.setdefault(value, len(CURVES) + len(_measured_curves))
        _curve_of_number[number] = value
        return number
    if row.usd_type == "vector3f":
        return wp.vec3(*(float(component) for component in value))
    return float(value)


def marked_shapes(model: newton.Model) -> dict[int, Magnet]:
    """Return the magnets of a model by shape, in the frames of the shapes; no magnets raise :class:`InputError`."""
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
    """Return the distinct rows of an array, shape [k, m], and the index of each row among them, shape [n]."""
    order = np.lexsort(rows.T)
    differs = np.ones(len(rows), bool)
    differs[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    index = np.empty(len(rows), int)
    index[order] = np.cumsum(differs) - 1
    return rows[order[differs]], index


def close_rows(labels: np.ndarray, columns: np.ndarray, tolerance: float) -> np.ndarray:
    """Return a number for each row, equal for rows of equal ``labels`` and nearly equal ``columns``, shape [n].

    Rows with the same number differ by at most ``tolerance`` in every column, shape [n, m]. Groups of rows that are
    farther apart than this, and narrower, are always recognized: no fixed grid cuts them.
    """
    for column in columns.T:
        order = np.lexsort((column, labels))
        sorted_labels, values = labels[order], column[order]
        first = np.ones(len(order), bool)
        first[1:] = (sorted_labels[1:] != sorted_labels[:-1]) | ~(values[1:] - values[:-1] <= tolerance)
        group = np.cumsum(first) - 1
        part = np.floor((values - values[first][group]) / tolerance)  # above 0 only in a group that is too wide
        first[1:] |= part[1:] != part[:-1]
        labels = np.empty_like(group)
        labels[order] = np.cumsum(first) - 1
    return labels


def _magnet_of(values: list[np.ndarray]) -> Magnet:
    """Return the magnet of the stored values of one shape, in the order of ``MAGNET_ATTRIBUTES``."""
    fields = {}
    for row, value in zip(MAGNET_ATTRIBUTES, values, strict=True):
        if row.field == "kind":
            fields["kind"] = KINDS[int(value[0]) - 1]
        elif row.field == "curve":
            fields["curve"] = _curve_of_number[int(value[0])]
        else:
            fields[row.field] = tuple(value.tolist()) if row.usd_type == "vector3f" else float(value[0])
    return Magnet(**fields)
