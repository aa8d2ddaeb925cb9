"""What sources are, and where they and their targets stand on a device.

Sources are numbered from coils and maps on, permanent bodies last:

| array | shape | meaning |
|---|---|---|
| kind, frame, strength | [coils] | of a coil or a map: its kind, where it is, how strong |
| parameters, table, table_begin, table_end | [coils, PARAMETERS], flat, [coils] | its numbers and vectors |
| label, extent | [coils], [coils, 6] | label of its body as packed rows have it; middle and half sides of a box [m] |
| list, list_begin | flat, [worlds + 1] | coils and maps of each world, and where its list begins |
| shape, edge, face, corner, begin, edge_point, face_point, body, size | | ``solids`` has them |
| solid_frame, world | [bodies] | where a permanent body is; the first body of its world, and the end of them |
| packed, effective | | all moments, packed, and those that forces act on, shape [3, n] |
| bias | [n] | M_r/χ of moments that yield to fields [A/m] (``induction.bias``); empty without them |
| row | [rows] | source, first target and the end of those that push it back, and whether they are balls |
| row_begin, partial | [sources + 1], [rows, 6] | first row of each source; force and torque of each row |
| wrench | [sources, 7] | force [N], torque [N·m] about its origin or its first moment, and half an energy, see below |

The last number of a wrench is half the energy [J] that a permanent body has with others beyond what the sums over pairs
give its moments. Targets are moments, or points:

| array | shape | meaning |
|---|---|---|
| target | [8, t] | packed targets |
| wanted | [t] | 0 of moments of permanent bodies of a closed form, 1 of others |
| chunk, lists | [chunks] | first target, how many, and the bodies of their world; the part of ``list`` |
| base | [t] | what fields are added to [A/m] |
| field | [t] | what magnetizes: ``base`` and the field of all sources [A/m] |
| acting | [t] | what turns: ``base`` and the field of the sources of other bodies [A/m] |
| along_x, along_y, along_z | [t] | derivatives of the field of the sources of other bodies [A/m²] |
| rate | [t] | rate of the field of the sources of other bodies [A/(m·s)], where it is wanted |
| motion, source_motion | [8, n], [coils, 6] | how moments move (``pairs.eddy``), and coils and maps: velocity of the |
| | | origin [m/s] and angular velocity [rad/s] |
| inside | [t] | of points, magnetization of the bodies there beyond that of their lattices' balls [A/m] |

And balls that feel multipoles of theirs:

| array | shape | meaning |
|---|---|---|
| ball | [balls] | moment, world, and the permanent bodies of that |
| points, tables | | ``expansion`` has them |
| expansion | [chunks, EXPANSION_ROWS, CHUNK] | what ``balls.h`` makes of the field about each moment |
| response | [chunks, rows, CHUNK] | what ``near_contact/uneven.h`` makes of that |
"""

from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from warpmag.kernels.applied.solids import INTEGER_TABLES, tables_of

PARAMETERS = 9
"""Numbers that a kind may have beside its table."""


class SourceKind(IntEnum):
    """What a source is; the values are those of ``sources.h``, the headers say what its numbers mean."""

    LOOP = 0
    SOLENOID = 1
    POLYLINE = 2
    FIELD_MAP = 3


class AppliedSource(NamedTuple):
    """One coil, or map.

    Attributes:
        kind: What it is.
        parameters: Its numbers, at most ``PARAMETERS``.
        table: Its vectors, shape [k, 3]; sources with one and the same array share it.
        world: The world of the moments that it acts on; -1 means all.
        body: Body that it is fixed to, as those of the moments are numbered; -1 means none.
        pushed: Whether the reaction on it is wanted.
    """

    kind: SourceKind
    parameters: tuple[float, ...] = ()
    table: np.ndarray = np.zeros((0, 3))
    world: int = -1
    body: int = -1
    pushed: bool = False

    def extent(self) -> np.ndarray:
        """Return middle and half sides of the box around its wires, or its nodes [m], shape [6]."""
        first, p = np.zeros(3), self.parameters
        if self.kind == SourceKind.POLYLINE:
            first, last = self.table.min(axis=0), self.table.max(axis=0)
        elif self.kind == SourceKind.FIELD_MAP:
            first = np.array(p[:3])
            last = first + np.multiply(p[3:6], np.subtract(p[6:9], 1.0))
        else:
            last = np.array([p[0], p[0], p[1] if self.kind == SourceKind.SOLENOID else 0.0])
            first = -last
        return np.concatenate([0.5 * (first + last), 0.5 * (last - first)])


@cache
def source_arrays_type(dtype):
    """Type of the sources and targets; the module says what its arrays are."""
    vec3, transform = wp.types.vector(3, dtype), wp.types.transformation(dtype)
    kinds = (
        (wp.array[int], "kind table_begin table_end list list_begin begin wanted row_begin"),
        (wp.array[transform], "frame solid_frame"),
        (wp.array[vec3], "strength bias base field acting along_x along_y along_z inside rate"),
        (wp.array2d[wp.float64], "parameters"),
        (wp.array[wp.vec3d], "table"),
        (wp.array[dtype], "label edge face corner edge_point face_point points tables"),
        (wp.array3d[dtype], "expansion response"),
        (wp.array2d[dtype], "extent size packed effective partial wrench target motion source_motion"),
        (wp.array2d[int], "shape body"),
        (wp.array[wp.vec2i], "world lists"),
        (wp.array[wp.vec4i], "chunk row ball"),
    )
    members = {name: kind for kind, names in kinds for name in names.split()}
    doc = "Arrays of sources and targets."
    return wp.struct(type("SourceArrays", (), {"__doc__": doc, "__annotations__": members}))


class Sources:
    """Sources on a device.

    Args:
        applied: Coils and maps, ``AppliedSource``.
        solids: Permanent bodies, ``SolidMagnet``, ordered by world.
        packed: All moments, packed (``packing.PackedMoments``).
        world_count: Number of worlds.
        bias: M_r/χ of moments that yield to fields [A/m], shape [n]; None without them.

    Attributes:
        applied, solids: The sources.
        frames: Frame of each coil and map in the world, shape [coils], transforms; written by the caller before fields
            are evaluated.
        strengths: Strength of each of them, as its kind understands it, vectors, shape [coils]; written by the caller.
        solid_frames: Where the permanent bodies are, transforms, shape [bodies]; written by the caller.
        solid_worlds: Their worlds, NumPy.
        lists: First of each world's coils and maps in their list, and the end, NumPy.
    """

    def __init__(self, applied, solids, packed, world_count: int, bias=None):
        """Put the sources on the device."""
        self.applied, self.solids, self.packed = tuple(applied), tuple(solids), packed
        self.dtype, self.device, self.world_count = packed.dtype, packed.device, world_count
        self.arrays: dict[str, wp.array] = {"packed": packed.packed}
        if bias is not None:
            self.arrays["bias"] = bias
        self._lay_out_applied()
        if solids:
            self.arrays |= self.tables()
        self.solid_worlds = np.array([one.world for one in solids], int)
        self.put(world=(self.bodies_of(self.solid_worlds), wp.vec2i))
        transform, identity = wp.types.transformation(self.dtype), [0.0] * 6 + [1.0]
        for name, count in (("frame", len(applied)), ("solid_frame", len(solids))):
            self.put(**{name: (np.broadcast_to(identity, (count, 7)), transform)})
        self.frames, self.solid_frames = self.arrays["frame"], self.arrays["solid_frame"]
        self.strengths = self.zeros("strength", len(applied), wp.types.vector(3, self.dtype))

    def _lay_out_applied(self):
        """Put the numbers and vectors of coils and maps side by side."""
        applied, tables, rows = self.applied, {}, 0
        for one in applied:
            if id(one.table) not in tables:
                tables[id(one.table)] = rows, one.table
                rows += len(one.table)
        begins = np.array([tables[id(one.table)][0] for one in applied], np.int32)
        numbers = np.array([np.pad(one.parameters, (0, PARAMETERS - len(one.parameters))) for one in applied])
        worlds = [[k for k, one in enumerate(applied) if one.world in (-1, w)] for w in range(self.world_count)]
        self.lists = np.cumsum([0, *map(len, worlds)])
        self.put(
            kind=([one.kind for one in applied], wp.int32),
            parameters=(numbers.reshape(-1, PARAMETERS), wp.float64),
            table=(np.concatenate([np.zeros((0, 3)), *(part for _, part in tables.values())]), wp.vec3d),
            table_begin=(begins, wp.int32),
            table_end=(begins + [len(one.table) for one in applied], wp.int32),
            label=([one.body for one in applied], self.dtype),
            extent=(np.array([one.extent() for one in applied]).reshape(-1, 6), self.dtype),
            list_begin=(self.lists, wp.int32),
            list=([k for world in worlds for k in world], wp.int32),
        )

    def tables(self, *, fine: bool = False) -> dict[str, wp.array]:
        """Return the tables of permanent bodies on the device, with more points on faces if ``fine``."""
        return {
            name: wp.array(values, dtype=wp.int32 if name in INTEGER_TABLES else self.dtype, device=self.device)
            for name, values in tables_of(self.solids, fine=fine).items()
        }

    def bodies_of(self, worlds) -> np.ndarray:
        """Return the first permanent body of each of some worlds, and the end of them, shape [..., 2]."""
        return np.stack([np.searchsorted(self.solid_worlds, worlds, side) for side in ("left", "right")], axis=-1)

    def put(self, **arrays):
        """Put arrays (values, type) on the device, whole numbers as such."""
        for name, (values, kind) in arrays.items():
            whole = kind in (wp.int32, wp.vec2i, wp.vec4i)
            values = np.ascontiguousarray(values, np.int32 if whole else float)
            self.arrays[name] = wp.array(values, dtype=kind, device=self.device)

    def zeros(self, name: str, shape, kind) -> wp.array:
        """Put an array of zeros on the device."""
        self.arrays[name] = wp.zeros(shape, dtype=kind, device=self.device)
        return self.arrays[name]
