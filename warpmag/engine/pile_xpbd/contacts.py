"""Collision and rigid-body solver for piles of small bodies that strong forces press together.

Newton's defaults suit bodies of about a meter. Here contact gaps are proportional to the sizes of bodies, and contact
and pair buffers grow when they overflow.
"""

import warnings
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from warpmag.engine.newton_versions import lost_contacts, triangle_limit
from warpmag.engine.pile_xpbd.broad_phase import NeighborBroadPhase, are_colliding
from warpmag.engine.pile_xpbd.solvers import SOLVERS, check_solver
from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.errors import InputError, extra
from warpmag.kernels.rigid.monitor import COUNT_CAPACITIES, Monitor, watch, watch_flags
from warpmag.kernels.rigid.newton_views import view_bodies, view_contacts

_NEWTON_GAP = 0.1
"""Newton's default contact gap [m], ``ModelBuilder.rigid_gap``."""
_GAP = 0.1
"""Contact gap of a shape over the thickness of its body: contacts are found within a tenth of a ball's radius."""
_CONTACTS_PER_BALL, _CONTACTS_PER_SHAPE, _PAIRS_PER_SHAPE = 8, 12, 40
"""Initial sizes of the buffers. The densest packing has 6 contacts per ball, a wall of boxes 12 per box.
A contact takes about 600 bytes on a GPU."""
_GROWTH = 1.5
"""Ratio of the new size of a buffer to the number of entries that it had to store."""
_MAX_SORTED_PAIRS = 2**20
"""Largest number of triangle pairs that Newton sorts."""
_KINDS = ("contact", "pair", "triangle")
"""Kinds of buffers: contacts, pairs of shapes, pairs of triangles."""


@dataclass(frozen=True)
class BodySizes:
    """Lengths of bodies [m], the scales of motions and penetrations, shape [body_count].

    Attributes:
        thickness: Half of the smallest dimension of the body's colliding shapes, for a ball its radius. Infinite for
            bodies that forces do not move.
        force_length: Distance over which the magnetic force on the body varies, for a ball its radius: for the shape
            with the smallest one, the geometric mean of half its dimensions, or half its middle dimension if that is
            less. In sheets it is longer than the thickness, in bars and nails hardly. Infinite as above.
        reach: Distance from the center of mass to the farthest point of a colliding shape, zero for a ball around its
            center of mass.
    """

    thickness: np.ndarray
    force_length: np.ndarray
    reach: np.ndarray


def body_sizes(model: newton.Model) -> BodySizes:
    """Return the sizes of the bodies of ``model``, from their colliding shapes."""
    shape_body: np.ndarray = model.shape_body.numpy()
    types, scales, radii = model.shape_type.numpy(), model.shape_scale.numpy(), model.shape_collision_radius.numpy()
    thickness, force_length = np.full((2, model.body_count), np.inf)
    reach = np.zeros(model.body_count)
    moving = model.body_inv_mass.numpy() > 0.0
    moving &= (model.body_flags.numpy() & newton.BodyFlags.KINEMATIC) == 0
    centers, frames = model.body_com.numpy(), model.shape_transform.numpy()
    shapes = np.flatnonzero((shape_body >= 0) & are_colliding(model))
    shapes = shapes[moving[shape_body[shapes]]]
    bodies = shape_body[shapes]
    dimensions = _half_dimensions(types, scales, model.shape_source[: model.shape_count])[shapes]
    np.minimum.at(thickness, bodies, dimensions[:, 0])
    # the cube root of each, because the product of tiny ones is 0
    np.minimum.at(force_length, bodies, np.minimum(dimensions[:, 1], np.prod(np.cbrt(dimensions), axis=1)))
    arms = np.linalg.norm(frames[shapes, :3] - centers[bodies], axis=1)
    reaching = (arms > 1e-3 * radii[shapes]) | (types[shapes] != newton.GeoType.SPHERE)
    np.maximum.at(reach, bodies[reaching], (arms + radii[shapes])[reaching])
    return BodySizes(thickness, force_length, reach)


def _half_dimensions(types: np.ndarray, scales: np.ndarray, sources: list) -> np.ndarray:
    """Return half of the dimensions [m] of each shape from the smallest on, infinite for planes, shape [n, 3]."""
    kinds = newton.GeoType
    half = np.full((len(types), 3), np.inf)
    for sized_kinds, columns in (
        ((kinds.SPHERE,), [0, 0, 0]),
        ((kinds.CYLINDER, kinds.CONE), [0, 0, 1]),
        ((kinds.BOX, kinds.ELLIPSOID), [0, 1, 2]),
    ):
        selected = np.isin(types, sized_kinds)
        half[selected] = scales[selected][:, columns]
    capsules = types == kinds.CAPSULE
    half[capsules] = scales[capsules, :1] + scales[capsules, 1:2] * [0.0, 0.0, 1.0]
    for shape in np.flatnonzero(np.isin(types, (kinds.MESH, kinds.CONVEX_MESH))).tolist():
        half[shape] = 0.5 * np.ptp(np.asarray(sources[shape].vertices) * scales[shape], axis=0)
    return np.sort(half, axis=1)


@dataclass(frozen=True)
class Buffer:
    """A buffer of fixed size that can overflow; entries beyond its limit are dropped."""

    kind: str  # one of ``_KINDS``
    fill: wp.array  # number of entries to store, shape [1], or flags, true where entries were dropped, shape [n]
    limit: int  # number of entries that fit; 0 for flags


def scale_gaps(model: newton.Model, sizes: BodySizes) -> None:
    """Replace Newton's default contact gap of shapes by a gap in proportion to the size of the shape.

    Static shapes get the gap of the thickest moving body: the gaps of two shapes add up, and a plane has no size.
    """
    gaps = model.shape_gap.numpy()
    default = np.isclose(gaps, _NEWTON_GAP)
    moving = np.isfinite(sizes.thickness)
    if not (default.any() and moving.any()):
        return
    body: np.ndarray = model.shape_body.numpy()
    scale = np.full(model.shape_count, sizes.thickness[moving].max())
    on_moving = (body >= 0) & np.isfinite(sizes.thickness[body])
    scale[on_moving] = sizes.thickness[body[on_moving]]
    model.shape_gap.assign(np.where(default, np.minimum(gaps, _GAP * scale), gaps).astype(np.float32))


class RigidSolver:
    """Collision pipeline and rigid-body solver of one model.

    Attributes:
        contacts: Contacts of the last :meth:`collide`.
        overlaps: Depth of each contact over the thickness of its thinner body, as of the last :meth:`watch`, on the
            device, shape [rigid_contact_max].
        buffers: The buffers that can overflow.
    """

    def __init__(self, model: newton.Model, sizes: BodySizes, *, solver: str = "xpbd", capacity: float = 1.0):
        """Set up collision and one of ``SOLVERS``, and scale the contact gaps of the model.

        ``capacity`` is a factor on the initial sizes of the contact and pair buffers. A solver that is unknown, is not
        installed, or cannot run this model raises :class:`InputError`.
        """
        check_solver(solver)
        self._model, self._name = model, solver
        scale_gaps(model, sizes)
        finite = sizes.thickness[np.isfinite(sizes.thickness)]
        self._speculation = float(2.0 * finite.max()) if len(finite) else 0.0
        types = model.shape_type.numpy()[are_colliding(model)]
        contacts = np.where(types == newton.GeoType.SPHERE, _CONTACTS_PER_BALL, _CONTACTS_PER_SHAPE).sum()
        self._limits = {
            "contact": max(16, int(capacity * contacts)),
            "pair": max(16, int(capacity * _PAIRS_PER_SHAPE * len(types))),
            "triangle": None,  # Newton's estimate; before Newton 1.8 its default
        }
        self._allocate()

    def _allocate(self) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._pipeline = newton.CollisionPipeline(
                self._model,
                broad_phase="sap",
                speculative_contact_gap_max=self._speculation,
                rigid_contact_max=self._limits["contact"],
                shape_pairs_max=self._limits["pair"],
                **triangle_limit(self._limits["triangle"]),
                deterministic=self._sorts_contacts(),
                include_static_kinematic_pairs=False,  # these contacts move nothing
                verify_buffers=False,  # would only print; the stepper reads the counters
            )
            self.contacts = self._pipeline.contacts()
            self._broad_phase = NeighborBroadPhase(self._model, self._speculation)
            self._pipeline.broad_phase = self._broad_phase
            if not self._pipeline.deterministic:  # otherwise Newton writes and sorts the contacts of balls, too
                self._broad_phase.write_contacts(self._pipeline, self.contacts)
            if not self._broad_phase.leaves_pairs:
                self._pipeline.narrow_phase.launch_custom_write = lambda **arguments: None  # saves its launches
            self._contact_view = view_contacts(self._model, self.contacts)
            self.overlaps = wp.zeros(self.contacts.rigid_contact_max, dtype=float, device=self._model.device)
            try:
                self._solver = SOLVERS[self._name].make(self._model, self._limits["contact"])
            except ImportError as error:
                raise InputError(f"solver {self._name}: needs {extra('sim')}: {error.__cause__ or error}") from None
            except (NotImplementedError, TypeError, ValueError, RuntimeError) as error:
                raise InputError(f"solver {self._name}: {' '.join(str(error).split())}") from None
        narrow = self._pipeline.narrow_phase
        self.buffers = [
            Buffer("pair", self._pipeline.broad_phase_pair_count, self._pipeline.shape_pairs_max),
            Buffer("contact", self.contacts.rigid_contact_count, self.contacts.rigid_contact_max),
        ]
        if narrow.triangle_pairs is not None:
            self.buffers.append(Buffer("triangle", narrow.triangle_pairs_count, narrow.triangle_pairs.shape[0]))
            if (lost := lost_contacts(self.contacts)) is not None:
                self.buffers.append(Buffer("triangle", lost, 0))
        if (overflow_flags := getattr(self._solver, "constraint_overflow", None)) is not None:
            self.buffers.append(Buffer("contact", overflow_flags, 0))

    def _sorts_contacts(self) -> bool:
        """Return True if Newton has to sort contacts: with meshes on a GPU, so that every run has the same contacts.

        Contacts of other shapes arrive in any order; the solver sorts them.
        """
        kinds = self._model.shape_type.numpy()[are_colliding(self._model)]
        meshes = np.isin(kinds, (newton.GeoType.MESH, newton.GeoType.HFIELD)).any()
        on_gpu = wp.get_device(self._model.device).is_cuda
        return bool(on_gpu and meshes and (self._limits["triangle"] or 0) < _MAX_SORTED_PAIRS)

    def limits(self) -> np.ndarray:
        """Return the sizes of the buffers for :meth:`set_limits`; 0 stands for Newton's estimate."""
        return np.array([self._limits[kind] or 0 for kind in _KINDS])

    def set_limits(self, limits: np.ndarray) -> None:
        """Set the buffer sizes that :meth:`limits` returned; contacts and captured graphs become invalid."""
        new_limits = {kind: int(limit) or None for kind, limit in zip(_KINDS, limits, strict=True)}
        if new_limits != self._limits:
            self._limits = new_limits
            self._allocate()

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that the next substep depends on, by name."""
        solver = self._solver.persistent_arrays() if isinstance(self._solver, PileXPBD) else {}
        return self._broad_phase.persistent_arrays() | solver

    def reset(self, state: newton.State, mask: wp.array) -> None:
        """Discard what the next substep would reuse of the last one, in chosen worlds; capturable in a graph.

        ``mask`` is True for these worlds, with Newton's last entry for everything outside all worlds.
        """
        self._broad_phase.request_search()
        if isinstance(self._solver, PileXPBD):
            self._solver.forget(mask)
        self._solver.reset(state, world_mask=mask, flags=0)

    def collide(self, state: newton.State, dt: float) -> None:
        """Find the contacts at ``state`` and the contacts expected within ``dt`` [s]; capturable in a graph."""
        self._broad_phase.set_motion(state, dt)
        self._pipeline.collide(state, self.contacts, dt=dt)

    def step(self, state_in: newton.State, state_out: newton.State, dt: float, control: newton.Control) -> None:
        """Advance by ``dt`` [s] with the contacts of the last :meth:`collide`; capturable in a graph."""
        self._solver.step(state_in, state_out, control, self.contacts, dt)

    def fills(self) -> np.ndarray:
        """Return the device address of the fill of each buffer, 0 for flags."""
        fills = [buffer.fill for buffer in self.buffers]
        return np.array([0 if fill.dtype is wp.bool else fill.ptr for fill in fills], np.uint64)

    def watch(self, watched: Monitor, state: newton.State, *, substep: int, longest: float, threshold: float) -> None:
        """Write the overlaps at the state of the last :meth:`collide` and the fills of the buffers to a monitor.

        The monitor has the :meth:`fills` of this solver; see :func:`watch` for the other arguments. Capturable in a
        graph.
        """
        bodies = view_bodies(self._model, state)
        watch(watched, self._contact_view, bodies, self.overlaps, substep=substep, longest=longest, threshold=threshold)
        for index, buffer in enumerate(self.buffers):
            if buffer.fill.dtype is wp.bool:
                watch_flags(buffer.fill, COUNT_CAPACITIES + index, watched.counts)

    def grow(self, fills: np.ndarray) -> bool:
        """Enlarge the buffers that overflowed; return true if there are any. Contacts and graphs become invalid.

        ``fills`` are the numbers of entries that each of :attr:`buffers` had to store.
        """
        grown = {}
        for buffer, fill in zip(self.buffers, fills, strict=True):
            if fill > buffer.limit:
                size = max(other.limit for other in self.buffers if other.kind == buffer.kind)
                grown[buffer.kind] = max(int(_GROWTH * max(fill, size)), grown.get(buffer.kind, 0))
        self._limits |= grown
        if grown:
            self._allocate()
        return bool(grown)
