"""The coils and field maps of a finished Newton model: their frames, strengths and reactions on bodies."""

import fnmatch
import math
import re

import newton
import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.declarations.checks import check_whole, short_repr
from warpmag.declarations.coils import SourceRecord, check_strength
from warpmag.engine.magnets.circuits import CoilCircuits
from warpmag.engine.magnets.equal_worlds import KINEMATIC
from warpmag.errors import InputError
from warpmag.kernels.applied.sources import AppliedSource, SourceKind
from warpmag.kernels.rigid.sources import (
    SourceShapes,
    add_reactions,
    gather_source_motion,
    gather_sources,
    set_strengths,
)
from warpmag.kernels.shared.launches import RecordedLaunches
from warpmag.moments.arrays import check_warp_array, host_array
from warpmag.moments.system import MomentSystem


class ModelSources:
    """The field sources of a model.

    Attributes:
        shapes: Shapes that represent sources, in the order of ``applied``.
        applied: The sources as a :class:`MomentSystem` takes them.
        radii, spacing: Radii of balls that contain the coils, 0 for field maps, and the shortest distance between nodes
            of field maps [m].
        circuits: Coils with a resistance, None without any; set by :meth:`bind`.
        on_device: Their shapes and bodies, after :meth:`bind`.
    """

    def __init__(self, model: newton.Model, magnet_worlds: np.ndarray):
        """Read the sources from the attributes of the model; ``magnet_worlds`` are the worlds of ``find_magnets``."""
        self._model, self._matches, self._launch = model, {}, RecordedLaunches()
        texts = getattr(getattr(model, NAMESPACE, None), "source", ())
        self.shapes, self.applied, self._records = [], [], []
        bodies, worlds, flags = model.shape_body.numpy(), model.shape_world.numpy(), model.body_flags
        records: dict[str, SourceRecord] = {}
        for shape in [shape for shape, text in enumerate(texts) if text]:
            world = _world_of(model.shape_label[shape], int(worlds[shape]), bodies[shape] >= 0, magnet_worlds)
            record = records.get(texts[shape]) or SourceRecord.from_text(texts[shape])
            records[texts[shape]] = record
            if world is None and record.circuit is not None:
                raise InputError(f"{model.shape_label[shape]}: a coil with a resistance in a world without magnets")
            if world is None:
                continue
            body = int(bodies[shape])
            movable = body >= 0 and not flags.numpy()[body] & KINEMATIC
            kind = SourceKind[record.kind.upper()]
            self.shapes.append(shape)
            self._records.append(record)
            self.applied.append(AppliedSource(kind, record.parameters, record.table, world, body, movable))
        self.radii = [record.radius() for record in self._records]
        self.spacing = min((record.spacing() for record in self._records), default=math.inf)

    def bind(self, system: MomentSystem) -> None:
        """Set the system that the other methods write to; it was made with :attr:`applied`."""
        self._system, model = system, self._model

        def on_device(values):
            return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=model.device)

        movable = sorted((source.body, index) for index, source in enumerate(self.applied) if source.movable)
        bodies, starts = np.unique([body for body, _ in movable], return_index=True)
        self.on_device = shapes = SourceShapes()
        shapes.shape = on_device(self.shapes)
        shapes.shape_body, shapes.shape_frames = model.shape_body, model.shape_transform
        shapes.strengths = getattr(model, NAMESPACE).strength
        shapes.body_list, shapes.run_start = on_device(bodies), on_device([*starts, len(movable)])
        shapes.order = on_device([index for _, index in movable])
        shapes.kinematic_flag = KINEMATIC
        self._driven = {shape for shape, record in zip(self.shapes, self._records, strict=True) if record.circuit}
        self.circuits = CoilCircuits(model, self.shapes, self._records, system) if self._driven else None

    def gather(self, body_q) -> None:
        """Write the frames and the strengths of the sources to the system."""
        if self.applied:
            gather_sources(
                self._launch, body_q, self.on_device, self._system.sources.frames, self._system.sources.strengths
            )

    def gather_motion(self, state: newton.State, motion) -> None:
        """Write the velocities of the sources, shape [sources, 6] (``kernels.applied.sources``)."""
        if self.applied:
            gather_source_motion(self.on_device, self._model, state, self._system.sources.frames, motion)

    def add_reactions(self, state: newton.State) -> None:
        """Add the forces of the moments on the sources to the forces on their bodies."""
        if self.applied:
            frames, wrenches = self._system.sources.frames, self._system.source_interaction.wrenches
            add_reactions(self._launch, self.on_device, self._model, state, frames, wrenches)

    def set_strength(self, name: str, selector: int | str, value) -> None:
        """Set the strengths of the sources that match a shape index or a shell pattern of labels.

        ``value`` is one strength for all of them, or one for each, in the order of their shapes. Messages begin with
        ``name``. Coils with a resistance raise :class:`InputError`.
        """
        shapes = self._matching(name, selector, driven=False)
        set_strengths(self._numbers(name, value, len(shapes)), shapes, self.on_device.strengths)

    def set_voltage(self, name: str, selector: int | str, value) -> None:
        """Set the voltages of coils, as :meth:`set_strength` sets strengths; other sources raise InputError."""
        shapes = self._matching(name, selector, driven=True)
        set_strengths(self._numbers(name, value, len(shapes)), shapes, getattr(self._model, NAMESPACE).voltage)

    def _numbers(self, name: str, value, count: int) -> wp.array:
        """Return one number or ``count`` on the device."""
        if isinstance(value, wp.array):
            check_warp_array(name, value, wp.float32, self._model.device)
            values = value
        else:
            numbers = np.atleast_1d(host_array(name, value))
            for number in numbers.flat:
                check_strength(name, number)
            if numbers.ndim != 1:
                raise InputError(f"{name}: shape must be [] or [{count}], got {list(numbers.shape)}")
            values = wp.array(numbers, dtype=wp.float32, device=self._model.device)
        if len(values) not in (1, count):
            raise InputError(f"{name}: must be 1 or {count} numbers, one for each source, got {len(values)}")
        return values

    def _matching(self, name: str, selector: int | str, *, driven: bool) -> wp.array:
        """Return the shapes of the matching sources, on the device; all must have voltages if ``driven``, else none."""
        if not isinstance(selector, str):
            check_whole(name, selector)
        if (selector, driven) not in self._matches:
            self._matches[selector, driven] = self._find(name, selector, driven)
        return self._matches[selector, driven]

    def _find(self, name: str, selector: int | str, driven: bool) -> wp.array:
        labels = self._model.shape_label
        if isinstance(selector, str):
            matches = re.compile(fnmatch.translate(selector)).match
            shapes = [shape for shape in self.shapes if matches(labels[shape])]
        else:
            shapes = [shape for shape in self.shapes if shape == selector]
        if not shapes:
            raise InputError(f"{name}: {short_repr(selector)} is no source of the model")
        for shape in shapes:
            if (shape in self._driven) != driven:
                problem = "has no resistance, so its current is given" if driven else "has a voltage, which sets it"
                raise InputError(f"{name}: {labels[shape]} {problem}")
        return wp.array(shapes, dtype=wp.int32, device=self._model.device)


def _world_of(label: str, world: int, on_body: bool, magnet_worlds: np.ndarray) -> int | None:
    """Return the index of a source's world among the worlds with magnets.

    -1 stands for all of these worlds, None for a source without magnets in its world. A source outside all worlds acts
    in all of them. If the source is on a body, only one world may have magnets.
    """
    if world >= 0 and magnet_worlds[0] >= 0:
        return int(np.searchsorted(magnet_worlds, world)) if world in magnet_worlds else None
    if world >= 0:
        raise InputError(f"{label}: a source of fields in a world, while the magnets are outside all worlds")
    if len(magnet_worlds) > 1 and on_body:
        raise InputError(
            f"{label}: a source on a body outside all worlds, while {len(magnet_worlds)} worlds hold magnets"
        )
    return 0 if len(magnet_worlds) == 1 else -1
