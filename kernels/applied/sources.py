"""The sources on a device, their field at targets, and the forces and reactions that follow.

A source of strength s applies to a moment m at x the field H(x) [A/m], and with Kelvin's law (Kim and Han 2022, Eqs. 13
and 14) the force and torque

    F = μ0 ∇(m·H),   F_k = μ0 m_i ∂H_i/∂x_k,      τ = μ0 m × H,

with Eq. 4 those on the effective moment (``pairs.wrench``). ∇(m·H) is (m·∇)H where H has no curl, and everywhere the
gradient of the co-energy. The body of the source feels −ΣF and, about the source, −Σ(τ + (x − o) × F), of all moments
that are not of its own body: momentum and angular momentum are kept by construction.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.native import native_options
from warpmag.kernels.shared.passes import passes_kernel
from warpmag.kernels.shared.reductions import group_sum
from warpmag.kernels.shared.team import team, threads_for

PARAMETERS = 9
"""Numbers that a kind may have beside its table."""
_FIELDS_PER_THREAD = 500
"""Fields of a source at a target that make another thread of a CPU worth waking."""
_SHARES = 32
"""Threads of a GPU that sum the reaction on a source: a warp."""
_sum_group = group_sum(wp.spatial_vectord)


class SourceKind(IntEnum):
    """What a source is; the values are those of ``sources.h``, the headers say what its numbers mean."""

    LOOP = 0
    SOLENOID = 1
    POLYLINE = 2
    FIELD_MAP = 3


class AppliedSource(NamedTuple):
    """One source.

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


@dataclass(frozen=True)
class Targets:
    """Where fields are wanted.

    Attributes:
        positions: The places [m], Warp array of vectors, shape [n]; read at each launch.
        worlds: World of each, shape [n].
        bodies: Body of each, shape [n]; on moments of its own body a source does not act, though it magnetizes them.
        base: What fields are added to [A/m], Warp array, shape [n].
    """

    positions: wp.array
    worlds: np.ndarray
    bodies: np.ndarray
    base: wp.array = field(repr=False)


@cache
def _arrays_type(dtype):
    """Sources, targets and results; the module says what they are.

    list_begin, list: Sources of each world, in order, and where its list begins, shape [worlds + 1].
    first: First target of each world, shape [worlds]; where reactions are wanted, it has them in a row.
    field: What magnetizes: ``base`` and the field of all sources, shape [n].
    acting: What turns: ``base`` and the field of the sources of other bodies, shape [n].
    gradient: Gradient ∂H_i/∂x_k of the field of the sources of other bodies [A/m²], shape [n].
    pair_begin: Of each source where its pairs with the targets of its world begin, -1 if it is not pushed.
    pair_field, pair_gradient: Field and gradient of one source at one target, shape [pairs].
    """
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.struct
    class SourceArrays:
        kind: wp.array[int]
        frame: wp.array[wp.types.transformation(dtype)]
        strength: wp.array[vec3]
        parameters: wp.array2d[wp.float64]
        table: wp.array[wp.vec3d]
        table_begin: wp.array[int]
        table_end: wp.array[int]
        source_body: wp.array[int]
        list_begin: wp.array[int]
        list: wp.array[int]
        position: wp.array[vec3]
        world: wp.array[int]
        target_body: wp.array[int]
        first: wp.array[int]
        base: wp.array[vec3]
        field: wp.array[vec3]
        acting: wp.array[vec3]
        gradient: wp.array[mat33]
        pair_begin: wp.array[int]
        pair_field: wp.array[vec3]
        pair_gradient: wp.array[mat33]

    return SourceArrays


@cache
def _field_kernel(dtype):
    call = "(void)first, (void)last, warpmag::apply_sources(thread, threads, team.data, arrays);"
    return passes_kernel(call, _arrays_type(dtype), native_options("applied/sources.h", dtype=dtype))


class Sources:
    """Sources on a device.

    Args:
        sources: The sources, ``AppliedSource``.
        world_count: Number of worlds.
        dtype: Warp scalar type of frames, strengths and fields.
        device: Warp device.

    Attributes:
        frames: Frame of each in the world, shape [s], transforms; written by the caller before fields are evaluated.
        strengths: Strength of each, as its kind understands it, vectors, shape [s]; written by the caller.
        sources: The sources.
    """

    def __init__(self, sources, world_count: int, dtype, device):
        """Put the sources on the device."""
        self.sources, self.dtype, self.device = tuple(sources), dtype, device
        self.world_count = world_count
        self._arrays = a = _arrays_type(dtype)()
        worlds = [[k for k, one in enumerate(self.sources) if one.world in (-1, world)] for world in range(world_count)]
        tables: dict[int, tuple[int, np.ndarray]] = {}
        rows = 0
        for one in self.sources:
            if id(one.table) not in tables:
                tables[id(one.table)] = rows, one.table
                rows += len(one.table)
        begins = np.array([tables[id(one.table)][0] for one in self.sources], np.int32)
        numbers = np.zeros((len(self.sources), PARAMETERS))
        for row, one in zip(numbers, self.sources, strict=True):
            row[: len(one.parameters)] = one.parameters
        a.kind = self._integers([one.kind for one in self.sources])
        a.parameters = wp.array(numbers, dtype=wp.float64, device=device)
        table = np.concatenate([np.zeros((0, 3)), *(part for _, part in tables.values())])
        a.table = wp.array(table, dtype=wp.vec3d, device=device)
        a.table_begin = self._integers(begins)
        a.table_end = self._integers(begins + [len(one.table) for one in self.sources])
        a.source_body = self._integers([one.body for one in self.sources])
        a.list_begin = self._integers(np.cumsum([0, *map(len, worlds)]))
        a.list = self._integers([k for world in worlds for k in world])
        identity = np.broadcast_to([0.0] * 6 + [1.0], (len(self.sources), 7))
        a.frame = self.frames = wp.array(identity, dtype=wp.types.transformation(dtype), device=device)
        a.strength = self.strengths = wp.zeros(len(self.sources), dtype=wp.types.vector(3, dtype), device=device)

    def _integers(self, values) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=self.device)

    def longest_list(self) -> int:
        """Sources of the world that has most."""
        return int(np.diff(self._arrays.list_begin.numpy()).max(initial=0))


class AppliedField:
    """Field of sources at targets, again and again in the same arrays.

    Args:
        sources: The sources.
        targets: The targets.
        reactions: Whether what pushes sources back is kept, for which the targets of a world must be in a row.

    Attributes:
        field: What magnetizes the targets: their base and the field of all sources [A/m], shape [n].
        acting: What turns them: their base and the field of the sources of other bodies [A/m], shape [n].
        gradient: Gradient ∂H_i/∂x_k of the field of the sources of other bodies [A/m²], shape [n], matrices.
    """

    def __init__(self, sources: Sources, targets: Targets, *, reactions: bool = False):
        """Allocate the results and record the launch."""
        dtype, device, count = sources.dtype, sources.device, len(targets.positions)
        vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)
        self.count = count
        self._arrays = a = _arrays_type(dtype)()
        for name in ("kind", "frame", "strength", "parameters", "table", "table_begin", "table_end", "source_body"):
            setattr(a, name, getattr(sources._arrays, name))
        a.list_begin, a.list = sources._arrays.list_begin, sources._arrays.list
        a.position, a.base = targets.positions, targets.base
        a.world, a.target_body = sources._integers(targets.worlds), sources._integers(targets.bodies)
        edges = np.searchsorted(targets.worlds, np.arange(sources.world_count + 1))
        a.first = sources._integers(edges[:-1])
        a.field, a.acting = (wp.zeros(count, dtype=vec3, device=device) for _ in range(2))
        a.gradient = wp.zeros(count, dtype=mat33, device=device)
        self.field, self.acting, self.gradient = a.field, a.acting, a.gradient
        begins, pairs = [], 0
        for one in sources.sources:
            begins.append(pairs if one.pushed and reactions else -1)
            pairs += int(edges[one.world + 1] - edges[one.world]) if begins[-1] >= 0 else 0
        a.pair_begin = sources._integers(begins)
        a.pair_field = wp.zeros(pairs, dtype=vec3, device=device)
        a.pair_gradient = wp.zeros(pairs, dtype=mat33, device=device)
        threads = threads_for(count * sources.longest_list(), _FIELDS_PER_THREAD)
        self._launch = wp.launch(
            _field_kernel(dtype),
            dim=count if device.is_cuda else 1,
            inputs=[0, 1, threads, None if device.is_cuda else team(), a],
            device=device,
            record_cmd=True,
        )

    def launch(self):
        """Evaluate the field at the targets, where sources and targets are now."""
        if self.count:
            self._launch.launch()


@cache
def _sum_kernel(mat33):
    @wp.kernel(module="unique", enable_backward=False)
    def add_gradients(more: wp.array[mat33], gradients_out: wp.array[mat33]):
        i = wp.tid()
        gradients_out[i] += more[i]

    return add_gradients


def launch_add_gradients(more, gradients):
    """Add gradients [A/m²], matrices of shape [n], to others."""
    kernel = _sum_kernel(gradients.dtype)
    wp.launch(kernel, dim=len(gradients), inputs=[more], outputs=[gradients], device=gradients.device)


@cache
def _force_kernel(dtype):
    vec3, mat33 = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_applied_forces(
        # inputs:
        movable: wp.array[int],
        effective: wp.array2d[dtype],
        gradient: wp.array[mat33],
        # outputs:
        forces_out: wp.array[vec3],
    ):
        i = wp.tid()
        if movable[i] != 0:
            e = vec3(effective[0, i], effective[1, i], effective[2, i])
            forces_out[i] += dtype(wp.static(MU0)) * (wp.transpose(gradient[i]) * e)

    return add_applied_forces


@cache
def _reaction_kernel(dtype):
    vec3, arrays_type = wp.types.vector(3, dtype), _arrays_type(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def sum_reactions(
        # inputs:
        arrays: arrays_type,
        pushed: wp.array[int],
        worlds: wp.array[int],
        ends: wp.array[int],
        effective: wp.array2d[dtype],
        shares: int,
        # outputs:
        forces_out: wp.array[vec3],
        torques_out: wp.array[vec3],
    ):
        k = wp.tid() // shares
        share = wp.tid() % shares
        s = pushed[k]
        first = arrays.first[worlds[k]]
        origin = wp.transform_get_translation(arrays.frame[s])
        mine = wp.spatial_vectord()
        for i in range(first + share, ends[k], shares):
            pair = arrays.pair_begin[s] + i - first
            e = vec3(effective[0, i], effective[1, i], effective[2, i])
            force = wp.transpose(arrays.pair_gradient[pair]) * e
            torque = wp.cross(e, arrays.pair_field[pair]) + wp.cross(arrays.position[i] - origin, force)
            for c in range(3):
                mine[c] += wp.float64(force[c])
                mine[c + 3] += wp.float64(torque[c])
        total = wp.float64(-wp.static(MU0)) * _sum_group(mine, shares)
        if share == 0:
            forces_out[s] = vec3(dtype(total[0]), dtype(total[1]), dtype(total[2]))
            torques_out[s] = vec3(dtype(total[3]), dtype(total[4]), dtype(total[5]))

    return sum_reactions


class AppliedForces:
    """What sources do to moments, and these to them.

    Args:
        sources: The sources.
        moments: The moments that they act on, as targets.
        movable: Whether the force on a moment is wanted, shape [n].

    Attributes:
        at: The field at the moments.
        reaction_forces: Force [N] on each source that is pushed, shape [s].
        reaction_torques: Torque [N·m] on it about the origin of its frame, shape [s].
    """

    def __init__(self, sources: Sources, moments: Targets, movable: np.ndarray):
        """Allocate the results."""
        self.at = AppliedField(sources, moments, reactions=True)
        self._movable = sources._integers(movable)
        pushed = [k for k, one in enumerate(sources.sources) if one.pushed]
        worlds = np.array([sources.sources[k].world for k in pushed], int)
        self._pushed, self._worlds = sources._integers(pushed), sources._integers(worlds)
        self._ends = sources._integers(np.searchsorted(moments.worlds, worlds + 1))
        vec3 = wp.types.vector(3, sources.dtype)
        self.reaction_forces, self.reaction_torques = (
            wp.zeros(len(sources.sources), dtype=vec3, device=sources.device) for _ in range(2)
        )

    def add(self, effective, forces):
        """Add the forces on the moments, and sum the reactions.

        Args:
            effective: Effective moments (``pairs.wrench``) [A·m²], shape [3, n].
            forces: Forces [N] that are added to, shape [n].
        """
        dtype, device, arrays = forces.dtype._wp_scalar_type_, forces.device, self.at._arrays
        inputs = [self._movable, effective, self.at.gradient]
        wp.launch(_force_kernel(dtype), dim=self.at.count, inputs=inputs, outputs=[forces], device=device)
        shares = _SHARES if device.is_cuda else 1
        wp.launch(
            _reaction_kernel(dtype),
            dim=shares * len(self._pushed),
            inputs=[arrays, self._pushed, self._worlds, self._ends, effective, shares],
            outputs=[self.reaction_forces, self.reaction_torques],
            device=device,
        )
