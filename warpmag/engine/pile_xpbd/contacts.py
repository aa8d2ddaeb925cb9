"""Collision and rigid-body solver, set up for piles of small bodies that strong forces press together.

Newton's defaults are for bodies of a metre. Here contact gaps follow the size of the bodies, contact and pair buffers
have a fixed size that is checked and grown, and XPBD runs with the settings that let a magnetic pile come to rest.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from warpmag.declarations.checks import check_token
from warpmag.engine.pile_xpbd.broad_phase import NeighborBroadPhase
from warpmag.engine.pile_xpbd.xpbd import PileXPBD
from warpmag.errors import InputError, extra
from warpmag.kernels.rigid.monitor import COUNT_CAPACITIES, Watched, watch, watch_flags
from warpmag.kernels.rigid.newton_views import view_bodies, view_contacts

_NEWTON_GAP = 0.1
"""``ModelBuilder.rigid_gap`` [m] as Newton sets it: the gap of a shape for which nobody chose one."""
_GAP = 0.1
"""Contact gap of a shape over the thickness of its body: contacts are known a tenth of a radius ahead."""
_CONTACTS_PER_BALL, _CONTACTS_PER_SHAPE, _PAIRS_PER_SHAPE = 8, 12, 40
"""First sizes of the buffers: in the densest packing there are 6 contacts for each ball, in a wall of boxes 12 a box; a
contact takes some 600 bytes of a GPU."""
_GROWTH = 1.5
_NUMBERED = 2**20
"""Triangle pairs that Newton can put into an order."""
_KINDS = ("contact", "pair", "triangle")
"""Kinds of buffers."""


@dataclass(frozen=True)
class BodySizes:
    """What the motion of a body is measured by.

    Attributes:
        thickness: Half of the smallest dimension of the body's colliding shapes [m], a ball's radius; infinite for
            bodies that forces do not move. Shape [body_count].
        reach: Farthest point of a colliding shape from the centre of mass [m], zero for a ball about it. Shape
            [body_count].
        shape_thickness: Half of the smallest dimension of each shape [m], infinite for planes and height fields.
            Shape [shape_count].
    """

    thickness: np.ndarray
    reach: np.ndarray
    shape_thickness: np.ndarray


def body_sizes(model: newton.Model) -> BodySizes:
    """Measure the colliding shapes of every body."""
    shape_body: np.ndarray = model.shape_body.numpy()
    colliding = model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES
    types, scales, radii = model.shape_type.numpy(), model.shape_scale.numpy(), model.shape_collision_radius.numpy()
    shape_thickness = _thicknesses(types, scales, model.shape_source)
    thickness, reach = np.full(model.body_count, np.inf), np.zeros(model.body_count)
    moving = model.body_inv_mass.numpy() > 0.0
    moving &= (model.body_flags.numpy() & newton.BodyFlags.KINEMATIC) == 0
    centers, frames = model.body_com.numpy(), model.shape_transform.numpy()
    shapes = np.flatnonzero((shape_body >= 0) & (colliding != 0))
    shapes = shapes[moving[shape_body[shapes]]]
    bodies = shape_body[shapes]
    np.minimum.at(thickness, bodies, shape_thickness[shapes])
    arms = np.linalg.norm(frames[shapes, :3] - centers[bodies], axis=1)
    reaching = (arms > 1e-3 * radii[shapes]) | (types[shapes] != newton.GeoType.SPHERE)
    np.maximum.at(reach, bodies[reaching], (arms + radii[shapes])[reaching])
    return BodySizes(thickness, reach, shape_thickness)


def _thicknesses(types: np.ndarray, scales: np.ndarray, sources: list) -> np.ndarray:
    """Return half of the smallest dimension [m] of each shape, shape [n]."""
    kinds = newton.GeoType
    found = np.full(len(types), np.inf)
    for of, columns in (
        ((kinds.SPHERE, kinds.CAPSULE), 1),
        ((kinds.CYLINDER, kinds.CONE), 2),
        ((kinds.BOX, kinds.ELLIPSOID), 3),
    ):
        chosen = np.isin(types, of)
        found[chosen] = scales[chosen, :columns].min(axis=1)
    for shape in np.flatnonzero(np.isin(types, (kinds.MESH, kinds.CONVEX_MESH))).tolist():
        vertices = np.asarray(sources[shape].vertices) * scales[shape]
        found[shape] = 0.5 * np.ptp(vertices, axis=0).min()
    return found


@dataclass(frozen=True)
class Buffer:
    """A buffer of fixed size that can overflow.

    Attributes:
        kind: ``pair``, ``contact`` or ``triangle``.
        fill: Entries that were asked for, on the device, shape [1]; more than ``limit`` if some were dropped. Or
            whether any were, shape [n].
        limit: Entries that fit; 0 where only whether any were dropped is known.
    """

    kind: str
    fill: wp.array
    limit: int


def scale_gaps(model: newton.Model, sizes: BodySizes) -> None:
    """Give the shapes for which nobody chose a contact gap one that fits their size.

    Static shapes get that of the thickest moving body: gaps of two shapes add up, and a plane has no size.
    """
    gaps = model.shape_gap.numpy()
    unchosen = np.isclose(gaps, _NEWTON_GAP)
    moving = np.isfinite(sizes.thickness)
    if not (unchosen.any() and moving.any()):
        return
    body: np.ndarray = model.shape_body.numpy()
    scale = np.full(model.shape_count, sizes.thickness[moving].max())
    on_moving = (body >= 0) & np.isfinite(sizes.thickness[body])
    scale[on_moving] = sizes.thickness[body[on_moving]]
    model.shape_gap.assign(np.where(unchosen, np.minimum(gaps, _GAP * scale), gaps).astype(np.float32))


def _xpbd(model: newton.Model, contact_max: int):
    # Contacts are relaxed all at once: beyond a third of each correction the many contacts of a ball in a pile
    # together overshoot, which keeps the pile hot for good (RMS speed on Balls Up after 1.5 s of 0.15 cm/s at 0.35,
    # 1.6 at 0.5, 10 at Newton's 0.8). Averaging over a body's contacts instead would need far more iterations. Those of
    # ``kernels.contacts.solve`` have momentum: on Balls Up after 5 s, 30 leave the same speeds as 60, and 0.5 % of
    # the radius of overlap where these leave 0.2.
    settings = {"iterations": 60, "rigid_contact_relaxation": 0.35, "rigid_contact_con_weighting": False}
    settings["contact_iterations"] = 30
    # Joints are relaxed alike along and about their axes, or hinged bodies swing as if they were heavier (a quarter
    # swing ends at 84.9 instead of 90 degrees with Newton's 0.7 and 0.4). Two at one place are stable up to 0.5 each.
    settings |= {"joint_linear_relaxation": 0.4, "joint_angular_relaxation": 0.4}
    return PileXPBD(model, contact_max, **settings)


def _steel(model: newton.Model, contact_max: int):
    return newton.solvers.SolverSteel(
        model, iterations=60, free_body_constraint_max=3 * contact_max, warn_constraint_overflow=False
    )


def _mujoco(model: newton.Model, contact_max: int):
    return newton.solvers.SolverMuJoCo(model, use_mujoco_contacts=False, nconmax=contact_max, njmax=3 * contact_max)


SOLVERS: dict[str, Callable] = {
    "xpbd": _xpbd,
    "steel": _steel,
    "mujoco": _mujoco,
    "semi-implicit": lambda model, contact_max: newton.solvers.SolverSemiImplicit(model),
    "featherstone": lambda model, contact_max: newton.solvers.SolverFeatherstone(model),
    "kamino": lambda model, contact_max: newton.solvers.SolverKamino(model),
    "vbd": lambda model, contact_max: newton.solvers.SolverVBD(model, iterations=20),
}
"""Rigid-body solvers by name; the first is the default and the one that piles are tested with."""
UNRESUMABLE = ("mujoco", "kamino", "vbd")
"""Solvers that start each step from what they keep to themselves of the last one, which no checkpoint has."""
AHEAD = ("xpbd",)
"""Solvers whose contacts are to be closed at the end of a step, where they want kinematic bodies to stand already."""
MAXIMAL = ("xpbd", "semi-implicit", "kamino", "vbd")
"""Solvers that know each body by its own pose, so that joints need no articulation."""


def check_solver(solver: str) -> None:
    """Raise :class:`InputError` unless a solver of that name is known."""
    check_token("solver", solver, tuple(SOLVERS))


class RigidSolver:
    """One model's collision pipeline and solver.

    Attributes:
        contacts: Contacts of the last :meth:`collide`.
        overlaps: Depth of each contact over the thickness of its thinner body, once measured, on the device, shape
            [rigid_contact_max].
        buffers: The buffers that can overflow.
    """

    def __init__(
        self,
        model: newton.Model,
        sizes: BodySizes,
        *,
        solver: str = "xpbd",
        capacity: float = 1.0,
    ):
        """Set up collision and solver.

        Args:
            model: The model; shapes with Newton's default contact gap get one that fits them.
            sizes: Sizes of its bodies.
            solver: One of ``SOLVERS``.
            capacity: First size of the contact and pair buffers over the usual one.

        Raises:
            InputError: There is no such solver, or it cannot be had or cannot run this model.
        """
        check_solver(solver)
        self._model, self._name = model, solver
        scale_gaps(model, sizes)
        finite = sizes.thickness[np.isfinite(sizes.thickness)]
        self._speculation = float(2.0 * finite.max()) if len(finite) else 0.0
        types = model.shape_type.numpy()[(model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES) != 0]
        contacts = np.where(types == newton.GeoType.SPHERE, _CONTACTS_PER_BALL, _CONTACTS_PER_SHAPE).sum()
        self._limits = {
            "contact": max(16, int(capacity * contacts)),
            "pair": max(16, int(capacity * _PAIRS_PER_SHAPE * len(types))),
            "triangle": None,  # Newton's estimate
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
                max_triangle_pairs=self._limits["triangle"],
                deterministic=self._reduces_in_order(),
                include_static_kinematic_pairs=False,  # their contacts move nothing
                verify_buffers=False,  # would only print; the counters are read instead
            )
            self.contacts = self._pipeline.contacts()
            self._broad_phase = NeighborBroadPhase(self._model, self._speculation)
            self._pipeline.broad_phase = self._broad_phase
            if not self._pipeline.deterministic:  # there Newton puts contacts into an order
                self._broad_phase.write_contacts(self._pipeline, self.contacts)
            if not self._broad_phase.leaves_pairs:
                self._pipeline.narrow_phase.launch_custom_write = lambda **arguments: None  # spares its launches
            self._contact_view = view_contacts(self._model, self.contacts)
            self.overlaps = wp.zeros(self.contacts.rigid_contact_max, dtype=float, device=self._model.device)
            try:
                self._solver = SOLVERS[self._name](self._model, self._limits["contact"])
            except ImportError as error:
                reason = f"needs {extra('sim')}: {error.__cause__ or error}"
                raise InputError(f"solver {self._name}: {reason}") from None
            except (NotImplementedError, TypeError, ValueError, RuntimeError) as error:
                raise InputError(f"solver {self._name}: {' '.join(str(error).split())}") from None
        narrow = self._pipeline.narrow_phase
        self.buffers = [
            Buffer("pair", self._pipeline.broad_phase_pair_count, self._pipeline.shape_pairs_max),
            Buffer("contact", self.contacts.rigid_contact_count, self.contacts.rigid_contact_max),
        ]
        if narrow.triangle_pairs is not None:
            self.buffers += [
                Buffer("triangle", narrow.triangle_pairs_count, narrow.triangle_pairs.shape[0]),
                Buffer("triangle", self.contacts.contact_counters[2:3], 0),  # contacts lost while they were reduced
            ]
        lost = getattr(self._solver, "constraint_overflow", None)
        if lost is not None:
            self.buffers.append(Buffer("contact", lost, 0))

    def _reduces_in_order(self) -> bool:
        """Whether contacts of meshes are to be the same in every run, as long as Newton can number that many.

        Those of other shapes are, in some order, which the solver makes up for.
        """
        colliding = (self._model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES) != 0
        kinds = self._model.shape_type.numpy()[colliding]
        meshes = np.isin(kinds, (newton.GeoType.MESH, newton.GeoType.HFIELD)).any()
        on_gpu = wp.get_device(self._model.device).is_cuda
        return bool(on_gpu and meshes and (self._limits["triangle"] or 0) < _NUMBERED)

    def limits(self) -> np.ndarray:
        """Return the sizes of the buffers, for :meth:`set_limits`; 0 for Newton's estimate."""
        return np.array([self._limits[kind] or 0 for kind in _KINDS])

    def set_limits(self, limits: np.ndarray) -> None:
        """Make the buffers as large as they were at :meth:`limits`; contacts and graphs are void afterwards."""
        wanted = {kind: int(limit) or None for kind, limit in zip(_KINDS, limits, strict=True)}
        if wanted != self._limits:
            self._limits = wanted
            self._allocate()

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays that one substep hands on to the next one, by name."""
        solver = self._solver.carried() if isinstance(self._solver, PileXPBD) else {}
        return self._broad_phase.carried() | solver

    def collide(self, state: newton.State, dt: float) -> None:
        """Find the contacts of ``state`` and those expected within ``dt`` [s]; capturable in a graph."""
        self._broad_phase.set_motion(state, dt)
        self._pipeline.collide(state, self.contacts, dt=dt)

    def step(self, state_in: newton.State, state_out: newton.State, dt: float, control: newton.Control) -> None:
        """Advance by ``dt`` [s] with the contacts of the last :meth:`collide`; capturable in a graph."""
        self._solver.step(state_in, state_out, control, self.contacts, dt)

    def fills(self) -> np.ndarray:
        """Return the addresses of the fills of all buffers, 0 where these are flags."""
        return np.array([0 if one.fill.dtype is wp.bool else one.fill.ptr for one in self.buffers], np.uint64)

    def watch(self, watched: Watched, state: newton.State, *, substep: int, longest: float, threshold: float) -> None:
        """Report to the monitor the contacts at ``state`` and how full each buffer is; capturable in a graph.

        Args:
            watched: What is watched; its ``fills`` are those of this solver.
            state: The state that was collided.
            substep: Substeps since the monitor counted them, or its ``NEXT``.
            longest: Length of the substeps of the first level [s].
            threshold: Overlap from which a contact is counted, over the thickness of the thinner body.
        """
        bodies = view_bodies(self._model, state)
        watch(watched, self._contact_view, bodies, self.overlaps, substep=substep, longest=longest, threshold=threshold)
        for index, buffer in enumerate(self.buffers):
            if buffer.fill.dtype is wp.bool:
                watch_flags(buffer.fill, COUNT_CAPACITIES + index, watched.counts)

    def grow(self, fills: np.ndarray) -> bool:
        """Enlarge the buffers that overflowed; contacts and graphs are void afterwards.

        Args:
            fills: How many entries each of ``buffers`` was asked for.

        Returns:
            Whether any had to grow.
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
