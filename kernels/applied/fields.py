"""Field of sources at targets, about balls, and the forces and reactions that follow.

A source applies to a moment m at x the field H(x) [A/m], and with Kelvin's law (Kim and Han 2022, Eqs. 13 and 14) the
force and torque

    F = μ0 ∇(m·H),   F_k = μ0 m_i ∂H_i/∂x_k,      τ = μ0 m × H,

with Eq. 4 those on the effective moment (``pairs.wrench``). ∇(m·H) is (m·∇)H where H has no curl, and everywhere the
gradient of the co-energy. The source feels −ΣF and, about its origin o, −Σ(τ + (x − o) × F), of all moments that are
not of its own body: momentum and angular momentum are kept by construction. On the multipoles of balls (``expansion``)
the force acts at their centres.
"""

import itertools
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.applied import expansion
from warpmag.kernels.applied.sources import Sources, source_arrays_type
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import team, threads_for

AT_TARGETS, AT_POINTS, AT_BALLS, REACT, ADD_UP = range(5)
"""The passes; as in ``passes.h``."""
_TARGETS_PER_THREAD, _BALLS_PER_THREAD = 500, 50
"""Fields of a source at a target, and about a ball, that make another thread of a CPU worth waking."""
_LEAST_ROW, _MOST_ROWS, _BALLS_IN_ROW = 256, 64, 8
"""Targets in a row of a reaction, at least, and rows of a source, at most; balls in a row, at least."""
_BODY_THREADS = 32
"""Threads of a GPU that share a source, or a row of its reaction."""


@cache
def _kernel(dtype, one: int, group: int, coils: bool, solids: bool, rates: bool, balls: tuple):
    """Kernel of pass ``one``, or of all if that is −1."""
    call = "apply_sources(thread, first, last, threads, team.data, arrays)"
    arguments = {**PASS_ARGUMENTS, "arrays": source_arrays_type(dtype)}
    constants = {"MU0": MU0, "INVERSE_4PI": INVERSE_4PI, "COILS": int(coils), "SOLIDS": int(solids)}
    constants |= {"PASS": one, "GROUP": group, "RATES": int(rates)}
    constants |= dict(zip(("BALLS", "MAGNET_REACH_LOW", "MAGNET_REACH_HIGH", "RESPONSE_ROWS"), balls, strict=True))
    return native_kernel(call, "applied/passes.h", arguments, dtype=dtype, **constants)


class AppliedField:
    """Field of sources at targets, again and again in the same arrays.

    Args:
        sources: The sources.
        targets: The targets, packed (``packing.PackedMoments``); read at each launch, as is ``base``.
        worlds: World of each, shape [t].
        base: What fields are added to [A/m], Warp array, shape [t].
        points: Whether they are points and not the moments.

    Attributes:
        field: What magnetizes the targets: their base and the field of all sources [A/m], shape [t].
        acting: What turns them: their base and the field of the sources of other bodies [A/m], shape [t].
        along: Derivatives along x, y and z of the field of the sources of other bodies [A/m²], shape [t] each.
    """

    balls: tuple = (0, 0.0, 0.0, 0)
    """Whether fields are expanded about balls, and how; constants of ``balls.h``."""
    rates: wp.array | None = None
    """How fast fields change at the moments [A/(m·s)], shape [t]; None where that is not wanted."""

    def __init__(self, sources: Sources, targets, worlds, base, *, points: bool):
        """Allocate the results."""
        self.sources, self.count, self._points = sources, targets.count, points
        self.arrays = arrays = source_arrays_type(sources.dtype)()
        for name, values in sources.arrays.items():
            setattr(arrays, name, values)
        arrays.target, arrays.base = targets.packed, base
        self._lay_out_targets(np.asarray(worlds))
        vec3 = wp.types.vector(3, sources.dtype)
        names = ("field", "acting", "along_x", "along_y", "along_z", *(["inside"] if points else []))
        results = [wp.zeros(self.count, dtype=vec3, device=sources.device) for _ in names]
        for name, values in zip(names, results, strict=True):
            setattr(arrays, name, values)
        self.field, self.acting, self.along = arrays.field, arrays.acting, results[2:5]
        self._commands: dict[tuple, wp.Launch] = {}

    def _put(self, name: str, values, kind):
        setattr(self.arrays, name, wp.array(np.ascontiguousarray(values, np.int32), dtype=kind, device=self.device))

    def _lay_out_targets(self, worlds):
        """List the chunks of targets, each of one world, and which targets closed forms count for."""
        sources, wanted = self.sources, np.ones(self.count)
        for one in () if self._points else sources.solids:
            wanted[one.first : one.first + one.count] = 0
        self._put("wanted", wanted, wp.int32)
        edges, starts = np.flatnonzero(np.diff(worlds, prepend=-1, append=-1)), []
        for begin, end in itertools.pairwise(edges):
            starts += [(k, min(CHUNK, end - k)) for k in range(begin, end, CHUNK)]
        starts = np.array(starts, int).reshape(-1, 2)
        world = worlds[starts[:, 0]].astype(int)
        self._put("chunk", np.concatenate([starts, sources.bodies_of(world)], axis=1), wp.vec4i)
        self._put("lists", np.stack([sources.lists[world], sources.lists[world + 1]], axis=1), wp.vec2i)

    @property
    def device(self):
        """The sources' device."""
        return self.sources.device

    def make(self, first: int, last: int, items: int, group: int, share: int):
        """Launch passes ``first`` to ``last``, by a group of GPU threads to an item, or a CPU's to ``share`` items."""
        cuda, key = self.device.is_cuda, (first, last)
        if items and key not in self._commands:
            some = self.sources
            which = (first, group) if cuda else (-1, 1)
            self._commands[key] = wp.launch(
                _kernel(some.dtype, *which, bool(some.applied), bool(some.solids), bool(self.rates), self.balls),
                dim=group * items if cuda else 1,
                inputs=[first, last + 1, threads_for(items, share), None if cuda else team(), self.arrays],
                device=self.device,
                record_cmd=True,
            )
        if items:
            self._commands[key].launch()

    def launch(self):
        """Evaluate the field at the targets, where sources and targets are now."""
        group = group_threads(self.device) if self.sources.solids else 1
        share = _TARGETS_PER_THREAD // max(1, int(np.diff(self.sources.lists).max(initial=0)))
        which = AT_POINTS if self._points else AT_TARGETS
        self.make(which, which, CHUNK * self.arrays.chunk.shape[0], group, max(share, 1))

    def add_to_probe(self, b, gradients):
        """Add to flux density [T] and gradients [A/m²] at points what the fields alone lack; ``gradients`` or None."""
        inputs = [self.arrays.inside, *self.along]
        kernel = _probe_kernel(self.sources.dtype)
        wp.launch(kernel, self.count, inputs=inputs, outputs=[b, gradients], device=self.device)


@cache
def _probe_kernel(dtype):
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_to_probe(
        # inputs:
        inside: wp.array[vec3],
        along_x: wp.array[vec3],
        along_y: wp.array[vec3],
        along_z: wp.array[vec3],
        # in and out:
        b: wp.array[vec3],
        gradients: wp.array[mat33],
    ):
        i = wp.tid()
        b[i] += dtype(wp.static(MU0)) * inside[i]
        if gradients:
            gradients[i] += wp.matrix_from_cols(along_x[i], along_y[i], along_z[i])

    return add_to_probe


@cache
def _push_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def push(
        # inputs:
        movable: wp.array[int],
        carried: wp.array[int],
        effective: wp.array2d[dtype],
        along_x: wp.array[vec3],
        along_y: wp.array[vec3],
        along_z: wp.array[vec3],
        wrench: wp.array2d[dtype],
        # in and out:
        forces: wp.array[vec3],
        torques: wp.array[vec3],
    ):
        i = wp.tid()
        if movable[i] == 0:
            return
        e = vec3(effective[0, i], effective[1, i], effective[2, i])
        f = vec3(wp.dot(along_x[i], e), wp.dot(along_y[i], e), wp.dot(along_z[i], e))
        forces[i] += dtype(wp.static(MU0)) * f
        s = carried[i]
        if s >= 0:
            forces[i] += vec3(wrench[s, 0], wrench[s, 1], wrench[s, 2])
            torques[i] += vec3(wrench[s, 3], wrench[s, 4], wrench[s, 5])

    return push


class AppliedForces(AppliedField):
    """What sources do to moments, and these to them.

    Args:
        sources: The sources.
        worlds: World of each moment, shape [n].
        base: What fields at moments are added to [A/m], Warp array, shape [n].
        movable: Whether the force on a moment is wanted, shape [n].
        balls: Whether a moment is a ball whose multipoles feel the field, shape [n]; None without such.
        constants: Of these what ``balls.h`` takes: first and last distance from a source [radii] over which they fade,
            and the rows of ``response``.

    Attributes:
        expansion: What ``balls.h`` makes of the field about the balls, shape [chunks, rows, CHUNK]; None without balls.
        wrenches: Force [N] on each source that is pushed, torque [N·m] about its origin, of a permanent body about its
            first moment, both without those on the moments of a body; half the energy of bodies, shape [sources, 7].
    """

    def __init__(self, sources: Sources, worlds, base, movable, *, balls=None, constants=()):
        """Allocate the results."""
        super().__init__(sources, sources.packed, worlds, base, points=False)
        self.expansion, chosen = None, np.zeros(0, int)
        if balls is not None and np.any(balls):
            self.balls, chosen = (1, *constants), np.flatnonzero(balls)
            self._lay_out_balls(chosen, np.asarray(worlds))
        carried = np.full(self.count, -1)
        carried[[one.first for one in sources.solids]] = len(sources.applied) + np.arange(len(sources.solids))
        movable = np.asarray(movable, bool)
        self._moves = bool(movable.any())
        device = sources.device
        self._fine: dict[str, wp.array] | None = None
        self._movable, self._carried = (
            wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)
            for values in (movable, carried)
        )
        self._lay_out_rows(np.asarray(worlds), np.asarray(worlds)[chosen])

    def _lay_out_balls(self, chosen, worlds):
        sources, arrays = self.sources, self.arrays
        own = worlds[chosen].astype(int)
        self._put("ball", np.column_stack([chosen, own, sources.bodies_of(own)]), wp.vec4i)
        for name, values in (("points", expansion.points()), ("tables", expansion.tables())):
            setattr(arrays, name, wp.array(values.ravel(), dtype=sources.dtype, device=self.device))
        shape = -(-self.count // CHUNK), expansion.EXPANSION_ROWS, CHUNK
        self.expansion = arrays.expansion = wp.zeros(shape, dtype=sources.dtype, device=self.device)

    def _lay_out_rows(self, worlds, ball_worlds):
        """List the parts of the reaction on each source that is pushed."""
        sources, rows, begin = self.sources, [], [0]
        pushed = [one.pushed for one in sources.applied] + [one.movable for one in sources.solids]
        for s, one in enumerate((*sources.applied, *sources.solids)):
            for least, of, kind in ((_LEAST_ROW, worlds, 0), (_BALLS_IN_ROW, ball_worlds, 1)):
                first, end = np.searchsorted(of, [one.world, one.world + 1])
                step = max(least, -(-(end - first) // _MOST_ROWS))
                rows += [(s, k, min(k + step, end), kind) for k in range(first, end, step) if pushed[s]]
            begin.append(len(rows))
        arrays, dtype, device = self.arrays, sources.dtype, self.device
        self._put("row", np.array(rows, int).reshape(-1, 4), wp.vec4i)
        self._put("row_begin", begin, wp.int32)
        arrays.partial = wp.zeros((len(rows), 6), dtype=dtype, device=device)
        self.wrenches = arrays.wrench = wp.zeros((len(pushed), 7), dtype=dtype, device=device)
        together = len(sources.solids) > len(np.unique(sources.solid_worlds))
        self._reacts, self._adds = bool(rows), bool(rows) or together

    def follow(self, motion):
        """Evaluate rates, too, from now on: of moments and sources that move as ``motion`` and ``source_motion`` say.

        Args:
            motion: How the moments move (``pairs.eddy.MOTION_ROWS``), written by the caller, shape [8, n].
        """
        arrays, sources = self.arrays, self.sources
        self.rates = arrays.rate = wp.zeros_like(arrays.field)
        self.source_motion = wp.zeros((len(sources.applied), 6), dtype=sources.dtype, device=self.device)
        arrays.motion, arrays.source_motion = motion, self.source_motion
        self._commands.clear()

    def expand(self):
        """Expand the field of the sources about the balls."""
        if self.expansion is not None:
            self.make(AT_BALLS, AT_BALLS, self.arrays.ball.shape[0], CHUNK, _BALLS_PER_THREAD)

    def _add_up(self, first: int):
        rows, sources = self.arrays.row.shape[0], self.wrenches.shape[0]
        if self.device.is_cpu:
            self.make(first, ADD_UP, max(sources, rows), 1, 1)
            return
        if first == REACT:
            self.make(REACT, REACT, rows, _BODY_THREADS, 1)
        self.make(ADD_UP, ADD_UP, sources, _BODY_THREADS, 1)

    def add(self, effective, forces, torques, response=None):
        """Add the forces on the moments and on bodies near each other, and sum the reactions.

        Args:
            effective: Effective moments (``pairs.wrench``) [A·m²], shape [3, n], followed by as many numbers as there
                are lanes.
            forces, torques: Forces [N] and torques [N·m] that are added to, shape [n].
            response: Response of the balls (``near_contact.uneven``), shape [chunks, rows, CHUNK]; None without balls.
        """
        if self.arrays.effective is None or self.arrays.effective.ptr != effective.ptr:
            self.arrays.effective, self.arrays.response = effective, response
            self._commands = {key: one for key, one in self._commands.items() if key[1] < REACT}
        if self._adds:
            self._add_up(REACT if self._reacts else ADD_UP)
        if not self._moves:
            return
        inputs = [self._movable, self._carried, effective, *self.along, self.wrenches]
        kernel = _push_kernel(self.sources.dtype)
        wp.launch(kernel, self.count, inputs=inputs, outputs=[forces, torques], device=self.device)

    def energies(self) -> np.ndarray:
        """Return what permanent bodies near each other add to the energy of their moments [J], shape [n].

        That of moments in fields is with ``acting``. Waits for the device.
        """
        found, solids, arrays = np.zeros(self.count), self.sources.solids, self.arrays
        if len(solids) < 2:
            return found
        self._fine = self._fine or self.sources.tables(fine=True)
        usual = {name: self.sources.arrays[name] for name in self._fine}
        for tables in (self._fine, usual):
            for name, values in tables.items():
                setattr(arrays, name, values)
            self._commands.pop((ADD_UP, ADD_UP), None)
            if tables is self._fine:
                self._add_up(ADD_UP)
        found[[one.first for one in solids]] = self.wrenches.numpy()[len(self.sources.applied) :, 6]
        return found
