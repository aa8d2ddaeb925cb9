"""Adds coils and field maps to Newton builders.

A field source is a site: a massless shape without collision, with a body, a frame and a world. It survives
``add_builder``, ``add_world``, ``replicate`` and ``collapse_fixed_joints``.
"""

from typing import Any

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.checks import check_text, check_whole, plain_value, short_repr
from warpmag.declarations.coils import LARGEST_POINT, Coil, FieldMap, checked_vectors
from warpmag.deprecation import keyword_arguments
from warpmag.engine.magnets.attributes import check_registered
from warpmag.engine.magnets.selection import selected
from warpmag.errors import InputError
from warpmag.moments.arrays import host_array
from warpmag.shapes.inductance import check_inductance

_UNIT_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's norm from 1; components are often rounded to few digits."""


@keyword_arguments("body")
def add_coil(
    builder: newton.ModelBuilder,
    *,
    body: int | str = -1,
    shape: str = "loop",
    radius: float = 0.0,
    length: float = 0.0,
    points: npt.ArrayLike | None = None,
    closed: bool = True,
    wire_radius: float = 0.0,
    ampere_turns: float = 0.0,
    resistance: float = 0.0,
    voltage: float = 0.0,
    turns: float = 0.0,
    inductance: float = 0.0,
    xform: wp.transform | tuple | None = None,
    label: str | None = None,
) -> int:
    """Add a coil to a body or to the world; the reaction of the magnets acts on the body.

    The axis of loops and solenoids is the z axis of their frame. A positive current makes a field along z inside them.
    Inside a wire the field falls to zero toward the wire's axis. Elsewhere the field is exact: elliptic integrals for
    loops, Derby and Olbert 2010 for current sheets, a closed form for thin straight segments.

    Args:
        builder: The builder, with :func:`warpmag.register_custom_attributes` called on it.
        body: Index or label of the body; -1 for a coil fixed in the world.
        shape: ``loop``, ``solenoid`` or ``polyline``.
        radius: Radius of a loop or a solenoid [m].
        length: Length of a solenoid [m]; its middle is the origin.
        points: Corners of a polyline [m], shape [k, 3], in the direction of a positive current.
        closed: True if a wire joins the last corner to the first. An open polyline is a part of a circuit.
        wire_radius: Radius of the wire [m]; for a solenoid, radius of the rounded edges of its current sheet. 0 means
            1 % of the coil's radius, or of the diagonal of a polyline's bounding box.
        ampere_turns: Current times turns [A], all turns of a solenoid; :meth:`warpmag.Magnetics.set_current` changes
            it. For a coil with a resistance, the value at the start.
        resistance: Resistance of the winding and its supply [Ω]. The current then follows from the voltage and from the
            flux of iron, of magnets, and of coils that do not move relative to this one. By default the current is
            given.
        voltage: Voltage [V] at a coil with a resistance; :meth:`warpmag.Magnetics.set_voltage` changes it. 0 is a
            short circuit.
        turns: Number of turns; a coil with a resistance needs it.
        inductance: Inductance of a coil with a resistance, in air [H]. The default follows from the geometry, with all
            turns in the wire of a loop or a polyline, or in the sheet of a solenoid. The smallest valid value is a
            hundredth of this default. If given inductances are too small for the computed mutual inductances, the
            mutual inductances are reduced, so that the magnetic energy cannot be negative.
        xform: Pose of the coil in the frame of the body, or in the world.
        label: Label of the coil, by which :meth:`warpmag.Magnetics.set_current` finds it.

    Returns:
        The shape that represents the coil, a site.

    Raises:
        InputError: The attributes are not declared, not exactly one body is selected, or a value is out of range.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> coil = warpmag.add_coil(builder, radius=0.01, ampere_turns=500.0, label="lift")
        >>> builder.shape_label[coil]
        'lift'
    """
    corners = ()
    if points is not None:
        corners = checked_vectors("add_coil: points", host_array("add_coil: points", points), LARGEST_POINT)
    coil = Coil(
        shape, radius, length, tuple(map(tuple, corners)), closed, wire_radius, ampere_turns,
        resistance, voltage, turns, inductance,
    )  # fmt: skip
    coil.check("add_coil")
    check_inductance("add_coil", coil.record())
    return _add_source(builder, body, coil, xform, "coil", label)


@keyword_arguments("origin", "spacing", "values")
def add_field_map(
    builder: newton.ModelBuilder,
    *,
    body: int | str = -1,
    origin: npt.ArrayLike,
    spacing: npt.ArrayLike,
    values: npt.ArrayLike,
    factor: float = 1.0,
    xform: wp.transform | tuple | None = None,
    label: str | None = None,
) -> int:
    """Add a field on a regular grid, fixed in the world or on a body; the reaction of the magnets acts on the body.

    Cubic convolution interpolates between the nodes, to third order in the spacing. Forces follow from the gradient of
    the interpolant and are continuous. Outside the grid the field is zero, with a jump at the boundary: extend a map
    to where its field is small.

    Args:
        builder: The builder, with :func:`warpmag.register_custom_attributes` called on it.
        body: Index or label of the body; -1 for a map fixed in the world.
        origin: Position of the first node [m], in the frame of the map.
        spacing: Distance between nodes [m], one number or one along each axis.
        values: Field H at the nodes [A/m], shape [nx, ny, nz, 3], at least two along each axis, NumPy.
        factor: Factor on the field; :meth:`warpmag.Magnetics.set_current` changes it.
        xform: Pose of the map in the frame of the body, or in the world.
        label: Label of the map.

    Returns:
        The shape that represents the map, a site.

    Raises:
        InputError: The attributes are not declared, not exactly one body is selected, or a value is out of range.

    Example:
        >>> import newton
        >>> import warpmag
        >>> builder = newton.ModelBuilder()
        >>> warpmag.register_custom_attributes(builder)
        >>> import numpy as np
        >>> earth = np.broadcast_to([0.0, 16.0, -35.0], (2, 2, 2, 3))  # A/m
        >>> field_map = warpmag.add_field_map(builder, origin=(-5.0, -5.0, -5.0), spacing=10.0, values=earth)
    """
    name = "add_field_map"
    nodes, steps = host_array(f"{name}: values", values), host_array(f"{name}: spacing", spacing)
    first = host_array(f"{name}: origin", origin)
    steps = np.resize(steps, 3) if steps.ndim == 0 else steps
    field_map = FieldMap(tuple(np.atleast_1d(first)), tuple(steps), nodes, factor)
    field_map.check(name)
    return _add_source(builder, body, field_map, xform, "field_map", label)


def add_placed_source(
    builder: newton.ModelBuilder, placed: Any, body: int, frame: wp.transform, current_keys: str = ""
) -> int:
    """Add a coil or a field map of a stage to a body or, for -1, to the world; return the site that represents it.

    Args:
        builder: The builder.
        placed: The source, a ``usd.read.coils.PlacedSource``; the path of its prim becomes the label.
        body: The body.
        frame: Frame of the source in the world.
        current_keys: Keys of its current as text, for :class:`KeyedCurrents`; empty if they are set elsewhere.
    """
    if body >= 0:
        frame = wp.transform_inverse(wp.transform(*builder.body_q[body])) * frame
    return _add_source(builder, body, placed.source, frame, "", placed.prim, current_keys)


def _add_source(
    builder: newton.ModelBuilder,
    body: int | str,
    source: Coil | FieldMap,
    xform,
    kind: str,
    label,
    keys="",
) -> int:
    """Add a source to a body or to the world; return its site. The default label is ``kind`` with a number."""
    check_registered(builder)
    label = f"{kind}_{builder.shape_count}" if label is None else label
    if not isinstance(body, str):
        check_whole("body", body)
    number = -1 if body == -1 else _single_body(builder, body)
    check_text("label", label)
    frame = wp.transform() if xform is None else checked_frame("xform", xform)
    values = {"source": source.record().to_text(), "current_keys": keys}
    if isinstance(source, Coil):
        values |= {"strength": float(source.ampere_turns), "voltage": float(source.voltage)}
    else:
        values["strength"] = float(source.factor)
    values = {f"{NAMESPACE}:{attribute}": value for attribute, value in values.items()}
    return builder.add_site(number, xform=frame, label=label, custom_attributes=values)


def _single_body(builder: newton.ModelBuilder, body: int | str) -> int:
    """Return the index of the only body that an argument selects, else raise :class:`InputError`."""
    bodies = selected("body", body, builder.body_label, "bodies")
    if len(bodies) > 1:
        raise InputError(f"body: {short_repr(body)} matches {len(bodies)} bodies, a source has one")
    return bodies[0]


def checked_frame(name: str, xform) -> wp.transform:
    """Return a transform from seven numbers, or from a position and a quaternion, which is normalized."""
    try:
        parts = list(plain_value(name, xform))
    except TypeError:
        parts = []
    numbers = np.concatenate([np.zeros(0), *(host_array(name, part).ravel() for part in parts)])
    length = float(np.linalg.norm(numbers[3:]))
    if len(numbers) != 7 or not abs(length - 1.0) < _UNIT_TOLERANCE or np.abs(numbers).max() > LARGEST_POINT:
        raise InputError(f"{name}: must be a place and a quaternion x y z w of length 1, got {short_repr(xform)}")
    return wp.transform(numbers[:3], numbers[3:] / length)
