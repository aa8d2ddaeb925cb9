"""Permanent bodies on a device, and the launches that put closed forms in the place of their lattices close up.

Tables belong to shapes, and serve all bodies of that shape:

    shape: First row and number of edges, of faces, first entry of ``begin``, first corner, first and number of points
        on edges and on faces, shape [shapes, 10].
    edge, face, corner, begin: See ``polyhedron.h``; flat.
    edge_point, face_point: Points on edges and faces (``warpmag.polyhedra``), rows of ``passes.CHUNK`` side by side,
        those of each shape filled up with points of no weight; flat.

Bodies, ordered by world, refer to them:

    body: Shape, first moment, number of moments of each, and a zero, shape [bodies, 4].
    size: 1/V of its first moment [1/m³], reach, radius of the ball around it, middle and half sides of its box [m],
        shape [bodies, 9].
    frame: Where it is, shape [bodies].
    world: First body of its world, and the end of them, shape [bodies].
    packed: All moments, packed (``packing.PackedMoments``).
    wrench: Force [N], torque about its first moment [N·m] and half the energy [J] that it has beyond what the sums over
        pairs give its moments, shape [bodies, 7].

Targets are balls, or points:

    target: Packed targets.
    wanted: 0 of those that are moments of bodies, 2 of inducible ones, 1 of others, shape [t].
    chunk: First target, how many, and the bodies of their world, shape [chunks].
    h0: Applied field, to which that at inducible targets is added [A/m], shape [t].
    near_h: Field of bodies that are not the target's own beyond that of their lattices [A/m], shape [t].
    near_x, near_y, near_z: Rows of its gradient [A/m²], shape [t].
    near_m: Of points, magnetization of the bodies there beyond that of their lattices' balls [A/m], shape [t].
    row: Body, first target and the end of those that a part of its reaction comes from, and a zero, shape [rows].
    row_begin: First row of each body, and the end, shape [bodies + 1].
    partial: Force [N] and torque [N·m] of each row, shape [rows, 6].
"""

import itertools
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.passes import CHUNK, passes_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import team, threads_for

AT_TARGETS, AT_POINTS, REACT, ADD_UP = range(4)
"""The passes; as in ``passes.h``."""
_TARGETS_PER_THREAD = 500
"""Targets that make another thread of a CPU worth waking."""
_LEAST_ROW, _MOST_ROWS = 256, 64
"""Targets in a row of a reaction, at least, and rows of a body, at most."""
_BODY_THREADS = 32
"""Threads of a GPU that share a body, or a row of its reaction."""


@dataclass(frozen=True)
class SolidMagnet:
    """A permanent body that is uniformly magnetized.

    Attributes:
        first, count: Its moments.
        volume: Volume of the first of them [m³].
        world: Its world.
        reach: Distance up to which the closed form counts [m].
        shape: The ``warpmag.polyhedra.Polyhedron`` that bounds it, in the frame of its body.
        movable: Whether the force on it is wanted.
    """

    first: int
    count: int
    volume: float
    world: int
    reach: float
    shape: Any
    movable: bool


@cache
def bodies_type(dtype):
    """Type of the bodies and targets; the module says what its arrays are."""
    vec3, transform = wp.types.vector(3, dtype), wp.types.transformation(dtype)

    @wp.struct
    class Bodies:
        shape: wp.array2d[int]
        edge: wp.array[dtype]
        face: wp.array[dtype]
        corner: wp.array[dtype]
        begin: wp.array[int]
        edge_point: wp.array[dtype]
        face_point: wp.array[dtype]
        body: wp.array2d[int]
        size: wp.array2d[dtype]
        frame: wp.array[transform]
        world: wp.array[wp.vec2i]
        packed: wp.array2d[dtype]
        wrench: wp.array2d[dtype]
        target: wp.array2d[dtype]
        wanted: wp.array[int]
        chunk: wp.array[wp.vec4i]
        h0: wp.array[vec3]
        near_h: wp.array[vec3]
        near_x: wp.array[vec3]
        near_y: wp.array[vec3]
        near_z: wp.array[vec3]
        near_m: wp.array[vec3]
        row: wp.array[wp.vec4i]
        row_begin: wp.array[int]
        partial: wp.array2d[dtype]

    return Bodies


@cache
def _kernel(dtype, group: int):
    call = "warpmag::close_up(thread, first, last, threads, team.data, arrays);"
    constants = {"GROUP": group, "MU0": MU0, "INVERSE_4PI": INVERSE_4PI}
    return passes_kernel(call, bodies_type(dtype), native_options("close_up/passes.h", dtype=dtype, **constants))


def _in_chunks(points) -> np.ndarray:
    """Points of a shape as rows of CHUNK side by side, filled up with the first point of no weight, flat."""
    count = -(-len(points) // CHUNK) * CHUNK
    filled = np.concatenate([points, np.repeat(points[:1], count - len(points), axis=0)])
    filled[len(points) :, -1] = 0.0
    return filled.reshape(-1, CHUNK, points.shape[1]).transpose(0, 2, 1)


def _tables(shapes):
    """Rows of the shapes' table, and what stands in the others."""
    rows, parts = [], {name: [] for name in ("edge", "face", "corner", "begin", "edge_point", "face_point")}
    counts = np.zeros(6, int)  # edges, faces, entries of begin, corners, points on edges, points on faces
    for shape in shapes:
        edges, faces = shape.edge_rows(), shape.normals
        begin = np.append(0, np.cumsum([len(face) for face in shape.faces]))
        on_edges, on_faces = _in_chunks(shape.edge_points()), _in_chunks(shape.face_points())
        points = CHUNK * len(on_edges), CHUNK * len(on_faces)
        start = counts.tolist()
        rows.append([
            start[0], len(edges), start[1], len(faces), start[2], start[3], start[4], points[0], start[5], points[1],
        ])  # fmt: skip
        corners = shape.corners[np.concatenate([np.asarray(face) for face in shape.faces])]
        for name, part in zip(parts, (edges, faces, corners, begin, on_edges, on_faces), strict=True):
            parts[name].append(np.asarray(part).reshape(-1))
        counts += [len(edges), len(faces), len(begin), len(corners), *points]
    return np.array(rows, np.int32), {name: np.concatenate(part) for name, part in parts.items()}


@cache
def _push_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def push(
        # inputs:
        effective: wp.array2d[dtype],
        movable: wp.array[int],
        turned: wp.array[int],
        bodies: bodies_type(dtype),
        carried: wp.array[int],
        # in and out:
        forces: wp.array[vec3],
        torques: wp.array[vec3],
    ):
        i = wp.tid()
        if movable[i] == 0:
            return
        mu0 = dtype(wp.static(MU0))
        if bodies.wanted[i] != 0:
            e = vec3(effective[0, i], effective[1, i], effective[2, i])
            f = vec3(wp.dot(bodies.near_x[i], e), wp.dot(bodies.near_y[i], e), wp.dot(bodies.near_z[i], e))
            forces[i] += mu0 * f
            if turned[i] != 0:
                torques[i] += mu0 * wp.cross(e, bodies.near_h[i])
        b = carried[i]
        if b >= 0:
            forces[i] += vec3(bodies.wrench[b, 0], bodies.wrench[b, 1], bodies.wrench[b, 2])
            torques[i] += vec3(bodies.wrench[b, 3], bodies.wrench[b, 4], bodies.wrench[b, 5])

    return push


@cache
def _energy_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_energies(
        # inputs:
        moments: wp.array[vec3],
        bodies: bodies_type(dtype),
        carried: wp.array[int],
        # in and out:
        energies: wp.array[wp.float64],
    ):
        i = wp.tid()
        if bodies.wanted[i] == 1:
            energies[i] -= wp.float64(wp.static(MU0)) * wp.float64(wp.dot(moments[i], bodies.near_h[i]))
        if carried[i] >= 0:
            energies[i] += wp.float64(bodies.wrench[carried[i], 6])

    return add_energies


@cache
def _points_kernel(dtype):
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_at_points(
        # inputs:
        bodies: bodies_type(dtype),
        # in and out:
        h: wp.array[vec3],
        b: wp.array[vec3],
        gradients: wp.array[mat33],
    ):
        i = wp.tid()
        h[i] += bodies.near_h[i]
        b[i] += dtype(wp.static(MU0)) * (bodies.near_h[i] + bodies.near_m[i])
        if gradients:
            gradients[i] += wp.matrix_from_rows(bodies.near_x[i], bodies.near_y[i], bodies.near_z[i])

    return add_at_points


class CloseUp:
    """Closed forms of the fields of permanent bodies where their lattices do not stand for them.

    Args:
        solids: The bodies, :class:`SolidMagnet`, ordered by world.
        packed: All moments, packed.
        inducible: Whether a moment is inducible, shape [n].
        movable: Whether the force on a moment is wanted, shape [n].
        worlds: World of each moment, shape [n].
        h0: Applied field that the fields at inducible moments are added to [A/m], Warp array, shape [n].

    Attributes:
        frames: Where the bodies are, transforms, shape [bodies]; written by the caller.
        near_h: Field at moments beyond that of the lattices of other bodies [A/m], shape [n].
    """

    def __init__(self, solids, packed, *, inducible, movable, worlds, h0):
        """Lay out tables and targets on the device of the moments."""
        self._solids, self._packed, self._device = list(solids), packed, packed.device
        self._bodies = bodies = bodies_type(packed.dtype)()
        self._lay_out_bodies()
        n = packed.count
        wanted, carried = 1 + np.asarray(inducible, np.int32), np.full(n, -1)
        for b, one in enumerate(self._solids):
            wanted[one.first : one.first + one.count] = 0
            carried[one.first] = b
        self._carried = self._put(carried, wp.int32)
        self._set_targets(bodies, packed, wanted, worlds)
        bodies.h0 = h0
        self.frames, self.near_h = bodies.frame, bodies.near_h
        movable = np.asarray(movable, bool)
        self._movable, self._moves = self._put(movable, wp.int32), bool(movable.any())
        self._lay_out_rows(np.asarray(worlds))

    def _put(self, values, kind):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=self._device)

    def _lay_out_bodies(self):
        bodies, solids, dtype = self._bodies, self._solids, self._packed.dtype
        shapes = {id(one.shape): one.shape for one in solids}
        rows, tables = _tables(shapes.values())
        bodies.shape = self._put(rows, wp.int32)
        for name, values in tables.items():
            setattr(bodies, name, self._put(values, wp.int32 if name == "begin" else dtype))
        number = {key: k for k, key in enumerate(shapes)}
        bodies.body = self._put([(number[id(one.shape)], one.first, one.count, 0) for one in solids], wp.int32)
        sizes = []
        for one in solids:
            lower, upper = one.shape.corners.min(axis=0), one.shape.corners.max(axis=0)
            middle = 0.5 * (lower + upper)
            radius = np.linalg.norm(one.shape.corners - middle, axis=1).max()
            sizes.append([1.0 / one.volume, one.reach, radius, *middle, *(0.5 * (upper - lower))])
        bodies.size = self._put(sizes, dtype)
        identity = np.broadcast_to([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(solids), 7))
        bodies.frame = self._put(identity, wp.types.transformation(dtype))
        world = np.array([one.world for one in solids])
        ranges = np.stack([np.searchsorted(world, world, side) for side in ("left", "right")], axis=1)
        bodies.world, self._world = self._put(ranges, wp.vec2i), world
        bodies.packed = self._packed.packed
        bodies.wrench = wp.zeros((len(solids), 7), dtype=dtype, device=self._device)

    def _set_targets(self, bodies, targets, wanted, worlds):
        """List the chunks of targets in worlds that have bodies, and allocate their fields."""
        bodies.target, bodies.wanted = targets.packed, self._put(wanted, wp.int32)
        edges, chunks = np.flatnonzero(np.diff(worlds, prepend=-1, append=-1)), []
        for begin, end in itertools.pairwise(edges):
            held = np.searchsorted(self._world, [worlds[begin], worlds[begin] + 1])
            starts = [k for k in range(begin, end, CHUNK) if held[0] < held[1] and wanted[k : k + CHUNK].any()]
            chunks += [(k, min(CHUNK, end - k), *held) for k in starts if k < end]
        bodies.chunk = self._put(np.array(chunks, np.int32).reshape(-1, 4), wp.vec4i)
        vec3 = wp.types.vector(3, targets.dtype)
        for name in ("near_h", "near_x", "near_y", "near_z"):
            setattr(bodies, name, wp.zeros(targets.count, dtype=vec3, device=self._device))

    def _lay_out_rows(self, worlds):
        """List the parts of the reaction on each movable body; bodies alone in their worlds that stay need none."""
        bodies, rows, begin = self._bodies, [], [0]
        for b, one in enumerate(self._solids):
            first, end = np.searchsorted(worlds, [one.world, one.world + 1])
            step = max(_LEAST_ROW, -(-(end - first) // _MOST_ROWS))
            rows += [(b, k, min(k + step, end), 0) for k in range(first, end, step) if one.movable]
            begin.append(len(rows))
        bodies.row = self._put(np.array(rows, np.int32).reshape(-1, 4), wp.vec4i)
        bodies.row_begin = self._put(begin, wp.int32)
        bodies.partial = wp.zeros((len(rows), 6), dtype=self._packed.dtype, device=self._device)
        together = len(self._world) > len(np.unique(self._world))
        self._reacts, self._adds = bool(rows), bool(rows) or together

    def _launch(self, first, last, items, group, bodies=None):
        bodies = bodies or self._bodies
        if items == 0:
            return
        threads = threads_for(items, _TARGETS_PER_THREAD if first < REACT else 1)
        cuda = self._device.is_cuda
        inputs = [first, last + 1, threads, None if cuda else team(), bodies]
        kernel = _kernel(bodies.target.dtype, group if cuda else 1)
        wp.launch(kernel, dim=group * items if cuda else 1, inputs=inputs, device=self._device)

    def _launch_fields(self, which, bodies):
        self._launch(which, which, CHUNK * bodies.chunk.shape[0], group_threads(self._device), bodies)

    def add_fields(self):
        """Launch the fields at all moments, those at inducible ones added to the applied field."""
        self._launch_fields(AT_TARGETS, self._bodies)

    def _add_up(self, first):
        if self._device.is_cpu:
            self._launch(first, ADD_UP, max(len(self._solids), self._bodies.row.shape[0]), 1)
            return
        if first == REACT:
            self._launch(REACT, REACT, self._bodies.row.shape[0], _BODY_THREADS)
        self._launch(ADD_UP, ADD_UP, len(self._solids), _BODY_THREADS)

    def add_forces(self, effective, turned, forces, torques):
        """Launch what all this adds to forces and torques of the moments that may move.

        Args:
            effective: Effective moments e [A·m²], shape [3, n] (``pairs.wrench``).
            turned: Whether the torque on a moment is wanted, shape [n].
            forces, torques: In and out [N] and [N·m], shape [n].
        """
        if not self._moves:
            return
        if self._adds:
            self._add_up(REACT if self._reacts else ADD_UP)
        inputs = [effective, self._movable, turned, self._bodies, self._carried]
        kernel = _push_kernel(self._packed.dtype)
        wp.launch(kernel, self._packed.count, inputs=inputs, outputs=[forces, torques], device=self._device)

    def add_energies(self, moments, energies):
        """Launch what all this adds to each moment's share of the energy [J], float64, shape [n]."""
        if self._adds:
            self._add_up(ADD_UP)
        inputs = [moments, self._bodies, self._carried]
        kernel = _energy_kernel(self._packed.dtype)
        wp.launch(kernel, self._packed.count, inputs=inputs, outputs=[energies], device=self._device)

    def at_points(self, targets, worlds):
        """Return what adds the fields at points to what a probe has measured there.

        Args:
            targets: The points, packed as balls of radius zero.
            worlds: World of each, shape [p].
        """
        bodies = bodies_type(self._packed.dtype)()
        for name in ("shape", "edge", "face", "corner", "begin", "edge_point", "face_point", "body", "size", "frame"):
            setattr(bodies, name, getattr(self._bodies, name))
        bodies.world, bodies.packed, bodies.wrench = self._bodies.world, self._bodies.packed, self._bodies.wrench
        self._set_targets(bodies, targets, np.ones(targets.count, np.int32), np.asarray(worlds))
        bodies.near_m = wp.zeros_like(bodies.near_h)

        def add(h, b, gradients):
            self._launch_fields(AT_POINTS, bodies)
            kernel = _points_kernel(targets.dtype)
            wp.launch(kernel, targets.count, inputs=[bodies], outputs=[h, b, gradients], device=self._device)

        return add
