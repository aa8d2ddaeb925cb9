"""Imports magnets, coils and field maps of a stage with Newton's own ``builder.add_usd``.

Newton calls the functions here with prims, and ``warpmag.usd`` reads them.
"""

from collections.abc import Iterable
from typing import Any

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import NAMESPACE, declare_attributes, stored_values
from warpmag.engine.magnets.declared_magnets import axis_rotation, in_shape_frame
from warpmag.engine.magnets.declared_sources import add_placed_source
from warpmag.errors import InputError


def register_custom_attributes(builder: newton.ModelBuilder) -> None:
    """Declare the attributes of magnets, coils and field maps; call it before the functions that add them.

    Newton's ``builder.add_usd(stage)`` then imports the magnets, coils and field maps of a stage, too. Magnets are
    colliders, or their rigid bodies, with ``WarpmagMagnetAPI``; unauthored attributes have their default values.

    Newton's solvers have class methods of the same name. ``register_attributes`` is an earlier name of this function.

    Args:
        builder: The builder. A second call for it does nothing.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> ball = builder.add_body()
        >>> shape = builder.add_shape_sphere(ball, radius=0.005)
        >>> warpmag.add_inducible(builder, body=ball, material="iron") == [shape]
        True
    """
    declare_attributes(builder, usd_value=_attribute_value)
    name, functions = "source_prim", {"usd_prim_filter": _is_source, "usd_entry_expander": _add_sources}
    builder.add_custom_frequency(newton.ModelBuilder.CustomFrequency(name, NAMESPACE, **functions))
    # without an attribute of this frequency Newton does not call the two functions
    make, frequency = newton.ModelBuilder.CustomAttribute, f"{NAMESPACE}:{name}"
    builder.add_custom_attribute(make(name, str, frequency, namespace=NAMESPACE, default=""))


register_attributes = register_custom_attributes


def _attribute_value(_, context: dict[str, Any]) -> Any:
    """Return the value of one attribute for the shape of a prim, None if the shape is not a magnet."""
    magnet = shape_magnet(context["prim"])
    return None if magnet is None else stored_values(magnet)[context["attr"].name]


def shape_magnet(prim: Any) -> Magnet | None:
    """Return the magnet of a collider in the frame of Newton's shape, None if the collider is not a magnet."""
    from warpmag.usd import collider_magnet  # noqa: PLC0415 - a builder can do without USD

    collider = collider_magnet(prim)
    if collider is None:
        return None
    rotation = axis_rotation(collider.axis)
    if collider.frames:
        magnet_rotation, shape_rotation = (_transform(matrix).q for matrix in collider.frames)
        rotation = wp.quat_inverse(magnet_rotation) * shape_rotation * rotation
    return in_shape_frame(collider.magnet, rotation)


def _transform(matrix: np.ndarray) -> wp.transform:
    """Return the transform of a matrix for row vectors, with the scale removed as in Newton's import."""
    position, rotation, _ = wp.transform_decompose(wp.mat44(matrix.astype(np.float32).T))
    return wp.transform(position, rotation)


def _is_source(prim: Any, _) -> bool:
    """Return True if a prim is a coil or a field map."""
    from warpmag.usd import is_source  # noqa: PLC0415 - a builder can do without USD

    return is_source(prim)


def _add_sources(prim: Any, context: dict[str, Any]) -> Iterable[dict[str, Any]]:
    """Add the coil and the field map of a prim to the builder; return no attribute rows, since sources are sites."""
    from warpmag.usd import placed_sources, world_matrix_at  # noqa: PLC0415 - a builder can do without USD

    builder, imported = context["builder"], context["result"]
    bodies = imported["path_body_map"]
    for source in placed_sources(prim):
        if source.body is not None and source.body not in bodies:
            raise InputError(f"{source.prim}: is on {source.body}, which Newton does not import as a body")
        anchor = source.body or next(iter(bodies), None)
        if anchor is None:  # a stage without bodies: only the up axis may differ
            stage = wp.transform((0.0, 0.0, 0.0), newton.math.quat_between_axes(imported["up_axis"], builder.up_axis))
        else:
            pose = wp.transform(*builder.body_q[bodies[anchor]])
            pose = pose * imported["path_body_relative_transform"].get(anchor, wp.transform_identity())
            stage = pose * wp.transform_inverse(_transform(world_matrix_at(prim, anchor)))
        frame = stage * wp.transform(source.position, source.rotation)
        keys = "" if source.drive is None else source.drive.to_text()
        add_placed_source(builder, source, -1 if source.body is None else bodies[source.body], frame, keys)
    return []
