"""Sources of fields on a device: coils, field maps and permanent bodies, and the arrays that kernels read and write.

Sources are numbered: coils and field maps first, permanent bodies last. :func:`source_arrays_type` is the struct that
kernels take. Targets are moments, or points of a probe.
"""

from enum import IntEnum
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import warp as wp

from warpmag.kernels.applied.near_cells import cell_arrays_type
from warpmag.kernels.applied.solids import INTEGER_TABLES, SolidMagnet, tables_of
from warpmag.kernels.shared.copies import repeat_records, repeat_rows

PARAMETERS = 9  # largest number of parameters of a source, in addition to its table


class SourceKind(IntEnum):
    """Kinds of coils and maps; each is a header that defines its parameters, table and strength."""

    LOOP = 0
    SOLENOID = 1
    POLYLINE = 2
    FIELD_MAP = 3


class AppliedSource(NamedTuple):
    """A coil or a field map."""

    kind: SourceKind  # its kind
    parameters: tuple[float, ...] = ()  # numbers that its kind defines, at most ``PARAMETERS``
    # Vectors that its kind defines, shape [k, 3]; sources with the same array object share it.
    table: np.ndarray = np.zeros((0, 3))
    world: int = -1  # world of the moments that it acts on; -1 means all worlds
    body: int = -1  # body that it is fixed to, numbered like the bodies of moments; -1 means none
    movable: bool = False  # true if it can move, so that the reaction on it is computed

    def extent(self) -> np.ndarray:
        """Return center and half sides of the box around its wires, or its nodes [m], shape [6]."""
        first, p = np.zeros(3), self.parameters
        if self.kind == SourceKind.POLYLINE:
            first, last = self.table.min(axis=0), self.table.max(axis=0)
        elif self.kind == SourceKind.FIELD_MAP:
            first = np.array(p[:3])
            last = first + np.multiply(p[3:6], np.subtract(p[6:9], 1.0))
        else:  # about the z axis, with a radius
            last = np.array([p[0], p[0], p[1] if self.kind == SourceKind.SOLENOID else 0.0])
            first = -last
        return np.concatenate([0.5 * (first + last), 0.5 * (last - first)])


@cache
def coil_arrays_type(dtype):
    """Return the struct of coils and field maps."""
    vec3, transform = wp.types.vector(3, dtype), wp.types.transformation(dtype)

    @wp.struct
    class CoilArrays:
        # Coils and maps, shape [coils]:
        kind: wp.array[int]
        parameters: wp.array2d[wp.float64]  # shape [coils, PARAMETERS]
        table: wp.array[wp.vec3d]  # tables of all coils and maps, concatenated
        table_begin: wp.array[int]
        table_end: wp.array[int]
        label: wp.array[dtype]  # body, as in packed moments
        extent: wp.array2d[dtype]  # center and half sides of a box [m], shape [coils, 6]
        frame: wp.array[transform]  # in the world
        strength: wp.array[vec3]
        motion: wp.array2d[dtype]  # velocity of the origin [m/s], angular velocity [rad/s], shape [coils, 6]
        # Coils and maps of each world:
        list: wp.array[int]
        list_begin: wp.array[int]  # shape [worlds + 1]

    return CoilArrays


@cache
def solid_arrays_type(dtype):
    """Return the struct of permanent bodies; ``solids`` describes its tables."""
    vec3, transform = wp.types.vector(3, dtype), wp.types.transformation(dtype)

    @wp.struct
    class SolidArrays:
        # Shapes:
        shape: wp.array2d[int]
        edge: wp.array[dtype]
        face: wp.array[dtype]
        corner: wp.array[dtype]
        begin: wp.array[int]
        edge_point: wp.array[dtype]
        face_point: wp.array[dtype]
        moment: wp.array[dtype]
        cylinder: wp.array[dtype]
        # Bodies, shape [bodies]:
        body: wp.array2d[int]
        size: wp.array2d[dtype]
        frame: wp.array[transform]  # in the world
        world: wp.array[wp.vec2i]  # range of bodies in the same world
        # Moments, shape [n]:
        bias: wp.array[vec3]  # M_r/χ of moments that respond to fields [A/m]; empty without them

    return SolidArrays


@cache
def target_arrays_type(dtype):
    """Return the struct of targets and of the fields there."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class TargetArrays:
        # Data in, shape [t]:
        packed: wp.array2d[dtype]  # packed targets, shape [8, t]
        kind: wp.array[int]  # bits: 1 for all but moments of permanent bodies, 2 for what fields magnetize, and points
        base: wp.array[vec3]  # field that is added to [A/m]
        # Chunks of targets, each in one world, shape [chunks]:
        chunk: wp.array[wp.vec4i]  # first target, number of targets, range of permanent bodies
        lists: wp.array[wp.vec2i]  # range of ``coils.list``
        active: wp.array[int]  # on a GPU the number of chunks that are evaluated, then these; None for all
        # Data out, shape [t]:
        field: wp.array[vec3]  # magnetizing field: base and the field of all sources [A/m]
        acting: wp.array[vec3]  # field that exerts torques: base and the field of other bodies' sources [A/m]
        along_x: wp.array[vec3]  # derivatives of the field of other bodies' sources [A/m²]
        along_y: wp.array[vec3]
        along_z: wp.array[vec3]
        body_field: wp.array[vec3]  # with cells: field of permanent bodies, where it is corrected [A/m]
        body_field_x: wp.array[vec3]  # its derivatives [A/m²]
        body_field_y: wp.array[vec3]
        body_field_z: wp.array[vec3]
        rate: wp.array[vec3]  # rate of the field of other bodies' sources [A/(m·s)]
        inside: wp.array[vec3]  # at points: magnetization less that of the lattices' balls [A/m]

    return TargetArrays


@cache
def source_arrays_type(dtype):
    """Return the struct of all sources and targets of a launch."""
    coil_arrays, solid_arrays, target_arrays, cell_arrays = (
        make(dtype) for make in (coil_arrays_type, solid_arrays_type, target_arrays_type, cell_arrays_type)
    )

    @wp.struct
    class BallArrays:
        # Balls whose multipoles respond to the field, shape [balls]:
        ball: wp.array[wp.vec4i]  # moment, world, range of permanent bodies
        points: wp.array[dtype]  # as in ``expansion``
        tables: wp.array[dtype]
        response: wp.array3d[dtype]  # multipoles of each moment, shape [chunks, rows, CHUNK]
        # Data out:
        expansion: wp.array3d[dtype]  # shape [chunks, EXPANSION_ROWS, CHUNK]

    @wp.struct
    class SourceArrays:
        coils: coil_arrays
        solids: solid_arrays
        targets: target_arrays
        cells: cell_arrays
        balls: BallArrays
        # All moments:
        packed: wp.array2d[dtype]  # shape [8, n]
        effective: wp.array2d[dtype]  # effective moments of the force, shape [3, n]
        motion: wp.array2d[dtype]  # ``eddy.eddy`` describes its rows, shape [8, n]
        # Reactions on sources:
        row: wp.array[wp.vec4i]  # source, range of targets, balls or cells, which of these (``fields``)
        row_begin: wp.array[int]  # first row of each source
        only: wp.array[int]  # 1 for a source with a reaction whose field is all that acts on targets of its world
        partial: wp.array2d[dtype]  # force and torque of each row, shape [rows, 6]
        wrench: wp.array2d[dtype]  # force, torque and half the energy of each source, shape [sources, 7]

    return SourceArrays


class FieldSources:
    """Coils, field maps and permanent bodies on a device.

    ``solids`` are ordered by world, and those of one of ``copies`` of all worlds and moments. ``bias`` is M_r/χ of
    moments that respond to fields [A/m], shape [n].

    Attributes:
        applied: Coils and field maps.
        copies: Number of copies of the worlds.
        solids_of_copy: Permanent bodies of a copy.
        coil_arrays, solid_arrays: The sources as structs.
        frames: Frame of each coil and map in the world, shape [coils], transforms; written by the caller before fields
            are evaluated.
        strengths: Strength of each coil and map, as its kind defines it, vectors, shape [coils]; written by the caller.
        solid_frames: Frames of the permanent bodies, transforms, shape [bodies]; written by the caller.
        solid_worlds: World of each permanent body, NumPy.
        lists: First entry of each world in ``coil_arrays.list``, and the end of the list, NumPy.
    """

    def __init__(self, applied, solids, packed, world_count: int, bias=None, copies: int = 1):
        """Copy the sources to the device."""
        self.applied, self.solids_of_copy, self.packed, self.copies = tuple(applied), tuple(solids), packed, copies
        self.dtype, self.device, self.world_count = packed.dtype, packed.device, world_count
        self.coil_arrays = coils = coil_arrays_type(self.dtype)()
        self.solid_arrays = bodies = solid_arrays_type(self.dtype)()
        self._lay_out_coils(coils)
        if bias is not None:
            bodies.bias = bias
        for name, values in self.tables().items() if solids else ():
            setattr(bodies, name, values)
        worlds = np.array([solid.world for solid in solids], int)
        self.solid_worlds = repeat_rows(worlds, copies, world_count // copies)
        bodies.world = self._copy(self.bodies_of(self.solid_worlds), wp.vec2i)
        transform, identity = wp.types.transformation(self.dtype), [0.0] * 6 + [1.0]
        self.frames, self.solid_frames = (
            self._copy(np.broadcast_to(identity, (count, 7)), transform)
            for count in (len(applied), len(self.solid_worlds))
        )
        self.strengths = wp.zeros(len(applied), dtype=wp.types.vector(3, self.dtype), device=self.device)
        coils.frame, bodies.frame, coils.strength = self.frames, self.solid_frames, self.strengths

    @cached_property
    def solids(self) -> list[SolidMagnet]:
        """Permanent bodies of all copies."""
        steps = {"first": self.packed.count // self.copies, "world": self.world_count // self.copies}
        return repeat_records(self.solids_of_copy, self.copies, **steps)

    def _lay_out_coils(self, coils):
        """Copy coils and maps to the device, with concatenated tables, and list the coils and maps of each world."""
        applied, tables, rows = self.applied, {}, 0
        for source in applied:
            if id(source.table) not in tables:
                tables[id(source.table)] = rows, source.table
                rows += len(source.table)
        begins = np.array([tables[id(source.table)][0] for source in applied], np.int32)
        parameters = [np.pad(source.parameters, (0, PARAMETERS - len(source.parameters))) for source in applied]
        worlds = [[k for k, source in enumerate(applied) if source.world in (-1, w)] for w in range(self.world_count)]
        self.lists = np.cumsum([0, *map(len, worlds)])
        coils.kind = self._copy([source.kind for source in applied], wp.int32)
        coils.parameters = self._copy(np.reshape(parameters, (-1, PARAMETERS)), wp.float64)
        coils.table = self._copy(np.concatenate([np.zeros((0, 3)), *(part for _, part in tables.values())]), wp.vec3d)
        coils.table_begin = self._copy(begins, wp.int32)
        coils.table_end = self._copy(begins + [len(source.table) for source in applied], wp.int32)
        coils.label = self._copy([source.body for source in applied], self.dtype)
        coils.extent = self._copy(np.reshape([source.extent() for source in applied], (-1, 6)), self.dtype)
        coils.list_begin = self._copy(self.lists, wp.int32)
        coils.list = self._copy([k for world in worlds for k in world], wp.int32)

    def tables(self, *, fine: bool = False) -> dict[str, wp.array]:
        """Return the tables of permanent bodies on the device, with more points on faces if ``fine``."""
        tables = tables_of(self.solids_of_copy, fine=fine)
        step = [0, self.packed.count // self.copies, 0, 0]
        for name, change in (("body", step), ("size", 0)):
            tables[name] = repeat_rows(tables[name], self.copies, change)
        return {
            name: wp.array(values, dtype=wp.int32 if name in INTEGER_TABLES else self.dtype, device=self.device)
            for name, values in tables.items()
        }

    def bodies_of(self, worlds) -> np.ndarray:
        """Return the range of permanent bodies in each of ``worlds``, shape [..., 2]."""
        return np.stack([np.searchsorted(self.solid_worlds, worlds, side) for side in ("left", "right")], axis=-1)

    def _copy(self, values, kind) -> wp.array:
        """Return an array on the device, of integers or floating-point numbers as ``kind`` requires."""
        is_integer = kind in (wp.int32, wp.vec2i)
        values = np.ascontiguousarray(values, np.int32 if is_integer else float)
        return wp.array(values, dtype=kind, device=self.device)
