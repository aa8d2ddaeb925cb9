"""Fields of sources at targets and about balls, forces on moments, and reactions on sources.

By Kelvin's law (Kim and Han 2022, Eqs. 13 and 14), the field H(x) [A/m] of a source exerts on a moment m at x the force
and torque

    F = μ0 ∇(m·H),   F_k = μ0 m_i ∂H_i/∂x_k,      τ = μ0 m × H,

By Eq. 4, m is the effective moment (``pairs.wrench``). ∇(m·H) is the gradient of the co-energy; it equals (m·∇)H where
H has no curl. The reaction on the source is −ΣF and, about its origin o, −Σ(τ + (x − o) × F), over all moments of other
bodies. So momentum and angular momentum are conserved by construction. Forces on the multipoles of balls
(``expansion``) act at the balls' centers.
"""

from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.applied import expansion, near_cells
from warpmag.kernels.applied.sources import FieldSources, SourceKind, source_arrays_type
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.copies import put_copies, repeat_rows
from warpmag.kernels.shared.launches import RecordedLaunches
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.pieces import cut
from warpmag.kernels.shared.reductions import group_threads, most_blocks
from warpmag.kernels.shared.team import launch_passes, threads_for

AT_TARGETS, AT_POINTS, FIND_CELLS, AT_CELLS, AT_NEIGHBORS, AT_BALLS, ON_CELLS, REACT, ADD_UP = range(
    9
)  # passes; as in ``passes.h``
OF_TARGETS, OF_BALLS, OF_CELLS = range(3)  # kinds of rows; as in ``passes.h``
_TARGETS_PER_THREAD, _BALLS_PER_THREAD, _CELLS_PER_THREAD = 500, 50, 50
"""Fewest pairs of a source and a target, of a source and a ball, and fewest cells, per thread of a CPU."""
_PER_ROW, _MOST_ROWS, _GPU_ROWS = {OF_TARGETS: 256, OF_BALLS: 8, OF_CELLS: 8}, 64, 16_384
"""Smallest number of targets, balls or cells in a row of a reaction, and largest numbers of rows of one source, and of
all sources. The last number is for GPUs: on a CPU the sums of a world must not depend on the number of worlds."""
_GROUP = 32  # threads of a GPU that share a source, or a row of its reaction
_CELL_GROUP = 4  # threads of a GPU that share a cell
_SMALL_BLOCKS, _BLOCK = (AT_CELLS, ON_CELLS, REACT), 64
"""Passes whose kernels need many registers, and threads per block: larger blocks lower the occupancy."""
_BLOCKS = {wp.float32: 8, wp.float64: 4}
"""Smallest number of these blocks per multiprocessor, for ``launch_bounds``: it limits the registers per thread."""


@cache
def _kernel(dtype, only_pass: int, group: int, coils: bool, solids: bool, cells: bool, rates: bool, balls: tuple):
    """Return the kernel of one pass, or of all passes if ``only_pass`` is −1."""
    call = "apply_sources(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": source_arrays_type(dtype)}
    constants = {"MU0": MU0, "INVERSE_4PI": INVERSE_4PI, "COILS": int(coils), "SOLIDS": int(solids)}
    constants |= {"PASS": only_pass, "GROUP": group, "RATES": int(rates), "CELLS": int(cells)}
    constants |= dict(zip(("CELL_REACH_LOW", "CELL_REACH_HIGH"), near_cells.CELL_REACH, strict=True))
    constants |= dict(zip(("STEEP_REACH_LOW", "STEEP_REACH_HIGH"), near_cells.STEEP_REACH, strict=True))
    constants |= {kind.name: kind.value for kind in SourceKind}
    constants |= dict(zip(("BALLS", "MAGNET_REACH_LOW", "MAGNET_REACH_HIGH", "RESPONSE_ROWS"), balls, strict=True))
    launch = {"launch_bounds": (_BLOCK, _BLOCKS[dtype])} if only_pass in _SMALL_BLOCKS else None
    return native_kernel(call, "applied/passes.h", arguments, dtype=dtype, launch=launch, **constants)


class AppliedField:
    """Field of sources at targets, in arrays that all launches share.

    Args:
        targets: The targets, packed (``packing.PackedMoments``); read at each launch, as is ``base``.
        worlds: World of each target of one of ``sources.copies`` of all worlds, shape [t]; for points of all worlds.
        magnetized, movable: True for targets that fields magnetize, and for targets whose force is computed, shape [t].
            The fields at others serve energies only (:meth:`launch_left_out`).
        base: Field that is added to [A/m], Warp array, shape [copies · t].
        points: True if targets are points of a probe, false if they are all moments.

    Attributes:
        field: Magnetizing field: base and the field of all sources [A/m], shape [copies · t].
        acting: Field that exerts torques: base and the field of other bodies' sources [A/m], shape [copies · t].
        along: Derivatives of the field of other bodies' sources along x, y and z [A/m²], shape [copies · t] each.
    """

    balls: tuple = (0, 0.0, 0.0, 0)
    """Constants of ``balls.h``: 1 if fields are expanded about balls, range of fading, rows of the response."""
    cell_count = 0
    """Cells whose fields are averaged near permanent bodies."""
    rates: wp.array | None = None
    """Rate of the field of other bodies' sources [A/(m·s)], shape [t]; None before :meth:`enable_rates`."""

    def __init__(self, sources: FieldSources, targets, worlds, base, *, points: bool, magnetized=True, movable=True):
        """Allocate the results."""
        self.sources, self.device, self.count, self._points = sources, sources.device, targets.count, points
        self.arrays = arrays = source_arrays_type(sources.dtype)()
        arrays.coils, arrays.solids, arrays.packed = sources.coil_arrays, sources.solid_arrays, sources.packed.packed
        arrays.targets.packed, arrays.targets.base = targets.packed, base
        self._copies, self._worlds = 1 if points else sources.copies, np.asarray(worlds)
        magnetized, movable = (np.broadcast_to(rows, self._worlds.shape) for rows in (magnetized, movable))
        self._lay_out_targets(magnetized, magnetized | movable)
        vec3 = wp.types.vector(3, sources.dtype)
        names = ("field", "acting", "along_x", "along_y", "along_z", *(["inside"] if points else []))
        results = [wp.zeros(self.count, dtype=vec3, device=sources.device) for _ in names]
        for name, values in zip(names, results, strict=True):
            setattr(arrays.targets, name, values)
        self.field, self.acting, self.along = *results[:2], results[2:5]
        self._commands: dict[tuple, wp.Launch] = {}

    def _integers(self, values, kind=wp.int32) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=self.device)

    def _in_copies(self, values, step=0) -> wp.array:
        """Return an integer for each target of all copies on the device."""
        return put_copies(np.asarray(values, np.int32), wp.int32, self.device, self._copies, step)

    def _lay_out_targets(self, magnetized, needed):
        """Mark the kinds of the targets, and list the chunks of those that are ``needed`` and of the others."""
        targets, corrected = self.arrays.targets, np.ones(len(needed), int)
        for solid in () if self._points else self.sources.solids_of_copy:
            corrected[solid.first : solid.first + solid.count] = 0
        targets.kind, self._needed = self._in_copies(corrected + 2 * magnetized), needed
        targets.chunk, targets.lists = self._chunks(needed)
        self._left_out = self._chunks(~needed)

    def _chunks(self, chosen) -> tuple[wp.array, wp.array]:
        """Return the chunks of chosen targets, each in one world, and their ranges of coils and maps."""
        sources, worlds = self.sources, np.where(chosen, self._worlds, -1)
        edges = np.flatnonzero(np.diff(worlds, prepend=-1, append=-1))
        begin, end = edges[:-1], edges[1:]
        of_world = worlds[begin] >= 0
        _, first, last = cut(begin[of_world], end[of_world], CHUNK)
        pieces = np.column_stack([first, last - first, worlds[first].astype(int)])
        steps = [len(worlds), 0, sources.world_count // self._copies]
        first, count, world = repeat_rows(pieces, self._copies, steps).T
        chunks = self._integers(np.column_stack([first, count, sources.bodies_of(world)]), wp.vec4i)
        return chunks, self._integers(np.stack([sources.lists[world], sources.lists[world + 1]], axis=1), wp.vec2i)

    def run_passes(self, first: int, last: int, items: int, group: int, share: int):
        """Launch passes: on a GPU with ``group`` threads per item, on a CPU with ``share`` items per thread."""
        cuda, key = self.device.is_cuda, (first, last)
        if items and key not in self._commands:
            sources, pass_and_group = self.sources, (first, group) if cuda else (-1, 1)
            switches = bool(sources.applied), bool(sources.solids_of_copy), self.cell_count > 0, bool(self.rates)
            kernel = _kernel(sources.dtype, *pass_and_group, *switches, self.balls)
            sizes = dict(threads=threads_for(items, share), gpu_threads=group * items)
            cells, targets = self.arrays.cells, self.arrays.targets
            lists = {AT_TARGETS: targets.active, FIND_CELLS: cells.active, AT_NEIGHBORS: cells.active}
            lists |= {AT_CELLS: cells.listed, ON_CELLS: cells.listed}
            sizes["max_blocks"] = most_blocks(self.device) if lists.get(first) else 0
            if first in _SMALL_BLOCKS:
                sizes["block_dim"] = _BLOCK
            self._commands[key] = launch_passes(
                kernel, first, last + 1, self.arrays, device=self.device, record_cmd=True, **sizes
            )
        if items:
            self._commands[key].launch()

    def launch(self):
        """Launch the evaluation of the field at the targets, from the present positions of sources and targets."""
        self._launch_at_targets()
        if self.device.is_cpu:
            self.run_passes(FIND_CELLS, AT_NEIGHBORS, self.cell_count, 1, _CELLS_PER_THREAD)
            return
        if self.cell_count:
            self._listed.zero_()
        for number, group in ((FIND_CELLS, 1), (AT_CELLS, _CELL_GROUP), (AT_NEIGHBORS, 1)):
            self.run_passes(number, number, self.cell_count, group, 1)

    def launch_left_out(self):
        """Launch the evaluation at the targets that :meth:`launch` leaves out; not to be captured in a graph."""
        targets = self.arrays.targets
        needed = targets.chunk, targets.lists, targets.active
        for chunks in ((*self._left_out, None), needed):
            targets.chunk, targets.lists, targets.active = chunks
            self._commands.pop((AT_TARGETS, AT_TARGETS), None)
            if chunks is not needed:
                self._launch_at_targets()

    def _launch_at_targets(self):
        """Launch the evaluation at the chunks of targets."""
        group = group_threads(self.device, moments=self.count) if self.sources.solids_of_copy else 1
        share = _TARGETS_PER_THREAD // max(1, int(np.diff(self.sources.lists).max(initial=0)))
        evaluation = AT_POINTS if self._points else AT_TARGETS
        self.run_passes(evaluation, evaluation, CHUNK * self.arrays.targets.chunk.shape[0], group, max(share, 1))

    def add_to_probe(self, b, gradients):
        """Add μ0 M to the flux density [T] at points inside bodies, and the sources' gradients [A/m²] unless None."""
        inputs = [self.arrays.targets.inside, *self.along]
        kernel = _probe_kernel(self.sources.dtype)
        wp.launch(kernel, self.count, inputs=inputs, outputs=[b, gradients], device=self.device)


@cache
def _probe_kernel(dtype):
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_to_probe(
        inside: wp.array[vec3],
        along_x: wp.array[vec3],
        along_y: wp.array[vec3],
        along_z: wp.array[vec3],
        b: wp.array[vec3],
        gradients: wp.array[mat33],
    ):
        i = wp.tid()
        b[i] += dtype(wp.static(MU0)) * inside[i]
        if gradients:
            gradients[i] += wp.matrix_from_cols(along_x[i], along_y[i], along_z[i])

    return add_to_probe


@cache
def _force_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_forces(
        movable: wp.array[int],
        source: wp.array[int],
        effective: wp.array2d[dtype],
        along_x: wp.array[vec3],
        along_y: wp.array[vec3],
        along_z: wp.array[vec3],
        wrench: wp.array2d[dtype],
        forces: wp.array[vec3],
        torques: wp.array[vec3],
    ):
        i = wp.tid()
        if movable[i] == 0:
            return
        e = vec3(effective[0, i], effective[1, i], effective[2, i])
        f = vec3(wp.dot(along_x[i], e), wp.dot(along_y[i], e), wp.dot(along_z[i], e))
        forces[i] += dtype(wp.static(MU0)) * f
        s = source[i]
        if s >= 0:
            forces[i] += vec3(wrench[s, 0], wrench[s, 1], wrench[s, 2])
            torques[i] += vec3(wrench[s, 3], wrench[s, 4], wrench[s, 5])

    return add_forces


class AppliedForces(AppliedField):
    """Forces and torques of sources on moments, and the reactions on sources.

    Args:
        sources, worlds, base, magnetized, movable: As of :class:`AppliedField`, whose targets are all moments.
        balls: True for balls whose multipoles respond to the field, shape [n]; None without such balls.
        constants: First and last distance from a source [radii] over which the multipoles fade, and the number of rows
            of ``response``.

    Attributes:
        movable: 1 for moments whose force is computed, on the device, shape [n].
        expansion: Field expanded about the balls (``balls.h``), shape [chunks, rows, CHUNK]; None without balls.
        wrenches: Force [N] and torque [N·m] on each source whose reaction is computed, shape [sources, 7]. Torques are
            about the source's origin, or about the first moment of a permanent body. Wrenches on the moments of a body
            are not included. The last column is half the energy [J] of a permanent body with other bodies, less that of
            their moments.
    """

    def __init__(self, sources: FieldSources, worlds, base, magnetized, movable, *, balls=None, constants=()):
        """Allocate the results."""
        super().__init__(sources, sources.packed, worlds, base, points=False, magnetized=magnetized, movable=movable)
        self.expansion, ball_indices = None, np.zeros(0, int)
        if balls is not None and np.any(balls):
            self.balls, ball_indices = (1, *constants), np.flatnonzero(repeat_rows(balls, self._copies))
            self._lay_out_balls(ball_indices)
        source_of_moment, solids = np.full(len(self._worlds), -1), self.sources.solids_of_copy
        source_of_moment[[solid.first for solid in solids]] = len(sources.applied) + np.arange(len(solids))
        self._moves, self._launch = bool(np.any(movable)), RecordedLaunches()
        self._fine_tables: dict[str, wp.array] | None = None
        self.movable = self._in_copies(np.asarray(movable, bool))
        self._source = self._in_copies(source_of_moment, len(solids))
        world_edges = np.searchsorted(self._worlds, np.arange(sources.world_count // self._copies))
        self._world_edges = np.append(repeat_rows(world_edges, self._copies, len(self._worlds)), self.count)
        self._ball_edges = np.searchsorted(ball_indices, self._world_edges)
        self._lay_out_rows(np.zeros_like(self._world_edges))

    def include_cells(self, bodies, rotations, forces, torques):
        """Average the fields of permanent bodies over cells near them from now on.

        Args:
            bodies: The bodies of cells of a copy of the worlds (``near_cells.NearCellBody``), in the order of
                ``rotations``; None for a body that takes no part.
            rotations: Rotation from each body's frame to the world, Warp array, shape [bodies].
            forces, torques: Forces [N] and torques [N·m] to add to, Warp arrays, shape [n].
        """
        sources, cells, copies = self.sources, self.arrays.cells, self._copies
        solids, ranges = self.sources.solids_of_copy, sources.bodies_of(self._worlds)
        near_cells.lay_out(cells, bodies, rotations, solids, ranges, sources.dtype, self.device, copies)
        cells.movable, cells.forces, cells.torques = self.movable, forces, torques
        for name in ("body_field", "body_field_x", "body_field_y", "body_field_z"):
            setattr(self.arrays.targets, name, wp.zeros_like(self.field))
        self.cell_count = cells.cell.shape[0]
        self._listed = cells.listed[:2] if self.device.is_cuda else None
        first_copy = cells.cell[: self.cell_count // copies].numpy()[:, 0]
        edges = np.searchsorted(first_copy, self._world_edges[: sources.world_count // copies])
        self._lay_out_rows(np.append(repeat_rows(edges, copies, len(first_copy)), self.cell_count))
        self._commands.clear()

    def _lay_out_balls(self, ball_indices):
        sources, balls = self.sources, self.arrays.balls
        copy, ball = np.divmod(ball_indices, len(self._worlds))
        world = self._worlds[ball].astype(int) + sources.world_count // self._copies * copy
        balls.ball = self._integers(np.column_stack([ball_indices, world, sources.bodies_of(world)]), wp.vec4i)
        balls.points, balls.tables = (
            wp.array(values.ravel(), dtype=sources.dtype, device=self.device)
            for values in (expansion.points(), expansion.tables())
        )
        shape = -(-self.count // CHUNK), expansion.EXPANSION_ROWS, CHUNK
        self.expansion = balls.expansion = wp.zeros(shape, dtype=sources.dtype, device=self.device)

    def _lay_out_rows(self, cell_edges):
        """List the rows of each reaction that is computed: ranges of targets, of balls and of cells.

        ``cell_edges`` is the first cell of each world, and the end, shape [worlds + 1].
        """
        sources, parts = self.sources, []
        edges_of = {OF_TARGETS: self._world_edges, OF_BALLS: self._ball_edges, OF_CELLS: cell_edges}
        applied, solids = sources.applied, sources.solids_of_copy
        solids_move = repeat_rows(np.array([solid.movable for solid in solids], bool), self._copies)
        movable = np.concatenate([np.array([source.movable for source in applied], bool), solids_move])
        world = np.concatenate([np.array([source.world for source in applied], int), sources.solid_worlds])
        is_solid = np.arange(len(world)) >= len(applied)
        in_world = np.where(world >= 0, world, sources.world_count)  # sources of all worlds have no rows
        most = _MOST_ROWS
        if self.device.is_cuda:
            most = min(most, max(1, _GPU_ROWS // max(1, len(world))))
        for kind, edges in edges_of.items():
            first, end = edges[in_world], np.append(edges[1:], edges[-1])[in_world]
            reacts = movable & is_solid if kind == OF_CELLS else movable
            step = np.maximum(_PER_ROW[kind], -(-(end - first) // most))
            source, *ends = cut(first, np.where(reacts, end, first), step)
            parts.append(np.column_stack([source, *ends, np.full(len(source), kind)]))
        rows = np.concatenate(parts)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        arrays, dtype, device = self.arrays, sources.dtype, self.device
        arrays.row = self._integers(rows, wp.vec4i)
        arrays.row_begin = self._integers(np.searchsorted(rows[:, 0], np.arange(len(world) + 1)))
        arrays.only = self._integers(movable & self._acts_alone(world))
        arrays.partial = wp.zeros((len(rows), 6), dtype=dtype, device=device)
        self.wrenches = arrays.wrench = wp.zeros((len(movable), 7), dtype=dtype, device=device)
        world_has_several_solids = len(sources.solid_worlds) > len(np.unique(sources.solid_worlds))
        self._reacts, self._adds = len(rows) > 0, len(rows) > 0 or world_has_several_solids

    def _acts_alone(self, world) -> np.ndarray:
        """Return True for each source alone in its world, shape [sources], where fields are evaluated at all targets.

        Moments of permanent bodies do not count as targets. ``world`` are the worlds of the sources, -1 for all.
        """
        missing = ~self._needed
        for solid in self.sources.solids_of_copy:
            missing[solid.first : solid.first + solid.count] = False
        alone = np.bincount(world[world >= 0], minlength=self.sources.world_count) + (world < 0).sum() == 1
        alone.reshape(self._copies, -1)[:, self._worlds[missing]] = False
        return (world >= 0) & alone[world]

    def enable_rates(self, motion):
        """Evaluate the rates of change of fields from now on.

        The caller writes ``motion`` of the moments (``eddy.eddy.MOTION_ROWS``), shape [8, n], and ``source_motion``.
        """
        arrays, sources = self.arrays, self.sources
        self.rates = arrays.targets.rate = wp.zeros_like(self.field)
        self.source_motion = wp.zeros((len(sources.applied), 6), dtype=sources.dtype, device=self.device)
        arrays.motion, arrays.coils.motion = motion, self.source_motion
        self._commands.clear()

    def expand(self):
        """Launch the expansion of the sources' field about the balls."""
        if self.expansion is not None:
            self.run_passes(AT_BALLS, AT_BALLS, self.arrays.balls.ball.shape[0], CHUNK, _BALLS_PER_THREAD)

    def _add_up(self, first: int):
        rows, sources = self.arrays.row.shape[0], self.wrenches.shape[0]
        if self.device.is_cpu:
            self.run_passes(first, ADD_UP, max(sources, rows), 1, 1)
            return
        if first == REACT:
            self.run_passes(REACT, REACT, rows, _GROUP, 1)
        self.run_passes(ADD_UP, ADD_UP, sources, _GROUP, 1)

    def list_active(self, list_active):
        """Evaluate only targets and cells of worlds that do not rest from now on, on a GPU.

        ``list_active`` returns for targets or cells, a Warp array, their list on the device: a number, then indices.
        """
        self.arrays.targets.active = list_active(self.arrays.targets.chunk)
        if self.cell_count:
            self.arrays.cells.active = list_active(self.arrays.cells.cell)
        self._commands.clear()

    def write_image_factors(self, moments, radii, material):
        """Launch :func:`near_cells.launch_image_factors` if there are cells."""
        if self.cell_count:
            near_cells.launch_image_factors(self._launch, self.arrays.cells, moments, radii, material)

    def add(self, effective, forces, torques, response=None):
        """Add the forces on moments and between bodies near each other, and sum the reactions.

        Args:
            effective: Effective moments (``pairs.wrench``) [A·m²], shape [3, n], padded by the widest vector.
            forces, torques: Forces [N] and torques [N·m] that are added to, shape [n].
            response: Multipoles of the balls (``near_contact``), shape [chunks, rows, CHUNK]; None without balls.
        """
        if self.arrays.effective is None or self.arrays.effective.ptr != effective.ptr:
            self.arrays.effective, self.arrays.balls.response = effective, response
            self._commands = {key: command for key, command in self._commands.items() if key[1] < ON_CELLS}
        if self._moves or self._reacts:
            self.run_passes(ON_CELLS, ON_CELLS, self.cell_count, _CELL_GROUP, _CELLS_PER_THREAD)
        if self._adds:
            self._add_up(REACT if self._reacts else ADD_UP)
        if not self._moves:
            return
        inputs = [self.movable, self._source, effective, *self.along, self.wrenches]
        kernel = _force_kernel(self.sources.dtype)
        self._launch(kernel, self.count, inputs=inputs, outputs=[forces, torques], device=self.device)

    def energies(self) -> np.ndarray:
        """Return the energy of permanent bodies near each other or near cells, less that of moments [J], shape [n].

        The energy of moments in fields follows from ``acting``. Waits for the device.
        """
        energies, arrays = np.zeros(self.count), self.arrays
        if self.cell_count:
            energies[arrays.cells.cell.numpy()[:, 0]] = MU0 * near_cells.energies(arrays.cells)
        if len(self.sources.solid_worlds) > 1:
            energies[[solid.first for solid in self.sources.solids]] = self._energies_between_bodies()
        return energies

    def _energies_between_bodies(self) -> np.ndarray:
        """Return half the energy of each permanent body with those near it [J], from fine points, shape [bodies]."""
        arrays = self.arrays
        self._fine_tables = self._fine_tables or self.sources.tables(fine=True)
        coarse = {name: getattr(self.sources.solid_arrays, name) for name in self._fine_tables}
        for tables in (self._fine_tables, coarse):
            for name, values in tables.items():
                setattr(arrays.solids, name, values)
            self._commands.pop((ADD_UP, ADD_UP), None)
            if tables is self._fine_tables:
                self._add_up(ADD_UP)
        return self.wrenches.numpy()[len(self.sources.applied) :, 6]
