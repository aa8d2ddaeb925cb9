"""Sources of fields on Newton models: coils that a builder is given, and what a model makes of them.

A source is a site: a shape that neither collides nor weighs anything, with a body, a frame and a world, which survives
``add_builder``, ``add_world``, ``replicate`` and ``collapse_fixed_joints``.
"""

import fnmatch
import re
from typing import Any

import newton
import numpy as np
import numpy.typing as npt
import warp as wp

from warpmag.declarations.checks import check_whole, short_repr
from warpmag.declarations.coils import FARTHEST_POINT, Coil, FieldMap, SourceRecord, check_strength, checked_vectors
from warpmag.engine.magnets.attributes import NAMESPACE, check_body, check_registered
from warpmag.errors import InputError
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.kernels.rigid.motion import gather_source_motion
from warpmag.kernels.rigid.sources import SourceShapes, add_reactions, gather_sources, set_strengths
from warpmag.moments.arrays import host_array
from warpmag.moments.system import MomentSystem

_STRAIGHT = 1e-3
"""How much the length of a quaternion may differ from 1."""
_KINEMATIC = int(newton.BodyFlags.KINEMATIC)


def add_coil(
    builder: newton.ModelBuilder,
    body: int = -1,
    *,
    shape: str = "loop",
    radius: float = 0.0,
    length: float = 0.0,
    points: npt.ArrayLike | None = None,
    closed: bool = True,
    wire_radius: float = 0.0,
    ampere_turns: float = 0.0,
    xform: wp.transform | tuple | None = None,
    label: str | None = None,
) -> int:
    """Add a coil to a body, which feels what the coil does to magnets, or to the world.

    Loops and solenoids are about the z axis of their frame, and a positive current makes a field along z inside. Closer
    to the axis of a wire than its radius the field falls to zero; elsewhere it is exact, of loops (elliptic integrals),
    of sheets of current (Derby and Olbert 2010) and of thin straight pieces.

    Args:
        builder: The builder, with :func:`warpmag.register_custom_attributes` called on it.
        body: The body; -1 for a coil fixed in the world.
        shape: ``loop``, ``solenoid`` or ``polyline``.
        radius: Radius of a loop or a solenoid [m].
        length: Length of a solenoid [m], whose middle is the origin.
        points: Corners of a polyline [m], shape [k, 3], in the direction of a positive current.
        closed: Whether its last point is joined to the first; an open one is a part of a circuit.
        wire_radius: Radius of the wire, of a solenoid that of the edges of its sheet [m]; 0 means a hundredth of the
            coil's, or of the diagonal of the box around a polyline.
        ampere_turns: Current times turns [A], of a solenoid all its turns; :meth:`warpmag.Magnetics.set_current`
            changes it.
        xform: Frame of the coil in that of the body, or of the world.
        label: Label of the coil, by which :meth:`warpmag.Magnetics.set_current` finds it.

    Returns:
        The shape that stands for it, a site.

    Raises:
        InputError: The attributes are not declared, the body does not exist, or a value is out of range.
    """
    corners = ()
    if points is not None:
        corners = checked_vectors("add_coil: points", host_array("add_coil: points", points), FARTHEST_POINT)
    coil = Coil(shape, radius, length, tuple(map(tuple, corners)), closed, wire_radius, ampere_turns)
    coil.check("add_coil")
    return add_source(builder, body, coil.record(), ampere_turns, xform, _label(builder, "coil", label))


def add_field_map(
    builder: newton.ModelBuilder,
    origin: tuple[float, float, float],
    spacing: npt.ArrayLike,
    values: npt.ArrayLike,
    *,
    body: int = -1,
    factor: float = 1.0,
    xform: wp.transform | tuple | None = None,
    label: str | None = None,
) -> int:
    """Add a field that is given on a regular grid, fixed in the world or on a body, which feels what it does.

    Between nodes it is interpolated by cubic convolution, to third order in the spacing; forces are of the
    interpolant's gradient, and continuous. Beyond the grid it is zero, all at once: a map should reach to where its
    field fades.

    Args:
        builder: The builder, with :func:`warpmag.register_custom_attributes` called on it.
        origin: The first node [m], in the frame of the map.
        spacing: Distance of nodes [m], one number or one along each axis.
        values: H at the nodes [A/m], shape [nx, ny, nz, 3], at least two along each axis, NumPy.
        body: The body; -1 for a map fixed in the world.
        factor: Factor of the field; :meth:`warpmag.Magnetics.set_current` changes it.
        xform: Frame of the map in that of the body, or of the world.
        label: Label of the map.

    Returns:
        The shape that stands for it, a site.

    Raises:
        InputError: The attributes are not declared, the body does not exist, or a value is out of range.
    """
    name = "add_field_map"
    nodes, steps = host_array(f"{name}: values", values), host_array(f"{name}: spacing", spacing)
    first = host_array(f"{name}: origin", origin)
    found = FieldMap(
        tuple(np.atleast_1d(first)), tuple(np.resize(steps, 3) if steps.ndim == 0 else steps), nodes, factor
    )
    found.check(name)
    return add_source(builder, body, found.record(), factor, xform, _label(builder, "field_map", label))


def _label(builder: newton.ModelBuilder, kind: str, given: str | None) -> str:
    """Return the label of a source that is to be added."""
    check_registered(builder)
    return f"{kind}_{builder.shape_count}" if given is None else given


def add_source(
    builder: newton.ModelBuilder, body: int, record: SourceRecord, strength: float, xform, label: str, keys: str = ""
) -> int:
    """Add a source to a body, or to the world; return the site that stands for it."""
    check_registered(builder)
    check_whole("body", body)
    if body != -1:
        check_body(builder, body)
    if not isinstance(label, str):
        raise InputError(f"label: must be text, got {short_repr(label)}")
    frame = wp.transform() if xform is None else _checked_frame("xform", xform)
    values = {f"{NAMESPACE}:source": record.to_text(), f"{NAMESPACE}:strength": float(strength)}
    values[f"{NAMESPACE}:current_keys"] = keys
    return builder.add_site(body, xform=frame, label=label, custom_attributes=values)


def add_placed_source(
    builder: newton.ModelBuilder, one, label: str, body: int, frame: wp.transform, keys: str = ""
) -> int:
    """Add the source of a stage to a body, or to the world; return the site that stands for it.

    Args:
        builder: The builder.
        one: The source, a ``usd.coils.PlacedSource``.
        label: Its label.
        body: Its body, -1 for none.
        frame: Where it is in the world.
        keys: Keys of its current as text, which :class:`KeyedCurrents` follows; none where somebody else does.
    """
    strength = one.source.ampere_turns if isinstance(one.source, Coil) else one.source.factor
    if body >= 0:
        frame = wp.transform_inverse(wp.transform(*builder.body_q[body])) * frame
    return add_source(builder, body, one.source.record(), strength, frame, label, keys)


def add_sources_of_prim(prim, builder: newton.ModelBuilder, imported: dict[str, Any]) -> None:
    """Add the coil and the field map of a prim where ``builder.add_usd`` has put its stage.

    Args:
        prim: The prim.
        builder: The builder.
        imported: What ``add_usd`` returns: which prim became what.

    Raises:
        InputError: It is no such prim, or on a body that Newton has not imported.
    """
    from warpmag.usd import placed_sources, stage_clock  # noqa: PLC0415 - a builder can do without USD

    bodies, path = imported["path_body_map"], str(prim.GetPath())
    for one in placed_sources(prim):
        if one.body is not None and one.body not in bodies:
            raise InputError(f"{path}: on {one.body}, of which Newton imports no body")
        anchor = one.body or next(iter(bodies), None)
        if anchor is None:  # nothing that moves: only the axes may have been turned
            stage = wp.transform((0.0, 0.0, 0.0), newton.math.quat_between_axes(imported["up_axis"], builder.up_axis))
        else:
            found = wp.transform(*builder.body_q[bodies[anchor]])
            found = found * imported["path_body_relative_transform"].get(anchor, wp.transform_identity())
            drawn = newton.usd.get_transform(prim.GetStage().GetPrimAtPath(anchor), local=False)
            stage = found * wp.transform_inverse(drawn)
        frame, keys = stage * wp.transform(one.position, one.rotation), ""
        if one.currents is not None:
            clock = stage_clock(prim.GetStage())
            keys = one.currents.in_seconds(clock.start, clock.time_codes_per_second).to_text()
        add_placed_source(builder, one, path, -1 if one.body is None else bodies[one.body], frame, keys)


def _checked_frame(name: str, xform) -> wp.transform:
    """Return a transform, or a place and a rotation, with a rotation of length 1."""
    try:
        parts = list(xform)
    except TypeError:
        parts = []
    numbers = np.concatenate([np.zeros(0), *(host_array(name, part).ravel() for part in parts)])
    length = float(np.linalg.norm(numbers[3:]))
    if len(numbers) != 7 or not abs(length - 1.0) < _STRAIGHT or np.abs(numbers).max() > FARTHEST_POINT:
        raise InputError(f"{name}: must be a place and a quaternion x y z w of length 1, got {short_repr(xform)}")
    return wp.transform(numbers[:3], numbers[3:] / length)


class ModelSources:
    """The sources of fields of a model.

    Args:
        model: The model.
        held: Worlds that hold magnets, -1 where there are none.

    Attributes:
        shapes: Shapes that they are, in the order of ``applied``.
        applied: What a :class:`MomentSystem` takes for them.
    """

    def __init__(self, model: newton.Model, held: np.ndarray):
        """Find them.

        Raises:
            InputError: One is on a body outside all worlds, and would be felt in several.
        """
        self._model, self._found = model, {}
        texts = getattr(getattr(model, NAMESPACE, None), "source", ())
        self.shapes, self.applied = [], []
        bodies, worlds, flags = model.shape_body.numpy(), model.shape_world.numpy(), model.body_flags
        records: dict[str, SourceRecord] = {}
        for shape in [shape for shape, text in enumerate(texts) if text]:
            world = _world_of(model.shape_label[shape], int(worlds[shape]), bodies[shape] >= 0, held)
            if world is None:
                continue
            record = records.setdefault(texts[shape], SourceRecord.from_text(texts[shape]))
            body = int(bodies[shape])
            pushed = body >= 0 and not flags.numpy()[body] & _KINEMATIC
            kind = SourceKind[record.kind.upper()]
            self.shapes.append(shape)
            self.applied.append(AppliedSource(kind, record.parameters, record.table, world, body, pushed))

    def bind(self, system: MomentSystem) -> None:
        """Serve the sources of ``system``, which was made with :attr:`applied`."""
        self._system, model = system, self._model

        def put(values):
            return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=model.device)

        pushed = [(one.body, k) for k, one in enumerate(self.applied) if one.pushed]
        bodies, starts = np.unique([body for body, _ in sorted(pushed)], return_index=True)
        self._shapes = shapes = SourceShapes()
        shapes.shape = put(self.shapes)
        shapes.shape_body, shapes.shape_frames = model.shape_body, model.shape_transform
        shapes.strengths = getattr(model, NAMESPACE).strength
        shapes.body_list, shapes.run_start = put(bodies), put([*starts, len(pushed)])
        shapes.order = put([k for _, k in sorted(pushed)])
        shapes.kinematic_flag = _KINEMATIC

    def gather(self, body_q) -> None:
        """Tell the system where the sources are, and how strong."""
        if self.applied:
            gather_sources(body_q, self._shapes, self._system.sources.frames, self._system.sources.strengths)

    def gather_motion(self, state: newton.State, motion) -> None:
        """Write how the sources move, shape [sources, 6] (``kernels.applied.sources``)."""
        if self.applied:
            gather_source_motion(self._shapes, self._model, state, self._system.sources.frames, motion)

    def add_reactions(self, state: newton.State) -> None:
        """Add what the moments do to the sources to the forces on their bodies."""
        if self.applied:
            frames, wrenches = self._system.sources.frames, self._system.applied.wrenches
            add_reactions(self._shapes, self._model, state, frames, wrenches)

    def set_strength(self, name: str, which: int | str, value) -> None:
        """Set the strength of those sources that ``which`` tells, a shape or a pattern of labels, in their order."""
        if not isinstance(which, str):
            check_whole(name, which)
        if which not in self._found:
            self._found[which] = self._find(name, which)
        shapes = self._found[which]
        if isinstance(value, wp.array):
            if value.dtype is not wp.float32 or value.ndim != 1 or value.device != self._model.device:
                raise InputError(f"{name}: must be a Warp array of float32 on {self._model.device}")
            values = value
        else:
            numbers = np.atleast_1d(host_array(name, value))
            for one in numbers.flat:
                check_strength(name, one)
            if numbers.ndim != 1:
                raise InputError(f"{name}: shape must be [] or [{len(shapes)}], got {list(numbers.shape)}")
            values = wp.array(numbers, dtype=wp.float32, device=self._model.device)
        if len(values) not in (1, len(shapes)):
            raise InputError(f"{name}: must be 1 or {len(shapes)} numbers, for so many sources, got {len(values)}")
        set_strengths(values, shapes, self._shapes.strengths)

    def _find(self, name: str, which: int | str) -> wp.array:
        labels = self._model.shape_label
        if isinstance(which, str):
            matches = re.compile(fnmatch.translate(which)).match
            found = [shape for shape in self.shapes if matches(labels[shape])]
        else:
            found = [shape for shape in self.shapes if shape == which]
        if not found:
            raise InputError(f"{name}: {short_repr(which)} is no source of the model")
        return wp.array(found, dtype=wp.int32, device=self._model.device)


def _world_of(label: str, world: int, on_body: bool, held: np.ndarray) -> int | None:
    """Return the number of a source's world among those that hold magnets, -1 for all; None where there are none.

    Outside all worlds it acts in all of them, unless a body would have to feel that.
    """
    if world >= 0 and held[0] >= 0:
        return int(np.searchsorted(held, world)) if world in held else None
    if world >= 0:
        raise InputError(f"{label}: a source of fields in a world, while the magnets are outside all worlds")
    if len(held) > 1 and on_body:
        raise InputError(f"{label}: a source on a body outside all worlds, while {len(held)} worlds hold magnets")
    return 0 if len(held) == 1 else -1
