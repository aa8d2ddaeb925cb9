"""All magnetic moments of a simulation on one device: induction, forces and energy."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import warp as wp

from warpmag.declarations.magnets import check_force
from warpmag.errors import InputError
from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.applied.solids import SolidMagnet
from warpmag.kernels.applied.sources import AppliedSource, FieldSources
from warpmag.kernels.eddy.eddy import EddyCurrents
from warpmag.kernels.fmm.evaluation import sampled_error
from warpmag.kernels.induction import solve_state
from warpmag.kernels.induction.solve_state import launch_add_bias, launch_start_cold
from warpmag.kernels.material.curves import LINEAR
from warpmag.kernels.near_contact import near_pairs, nonuniform
from warpmag.kernels.near_contact.images import IronFaces
from warpmag.kernels.pairs.evaluate import GIVEN, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments, launch_divide_by_volume
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.work_list import pair_count
from warpmag.kernels.pairs.wrench import launch_zeeman_moments
from warpmag.kernels.shared.copies import put_copies, repeat_records, repeat_rows
from warpmag.moments.arrays import (
    PersistentArray,
    host_array,
    resolve_device,
    resolve_dtype,
    shape_message,
    vec3_type,
)
from warpmag.moments.body_products import make_body_fields, make_body_steps
from warpmag.moments.dynamics import make_dynamics
from warpmag.moments.fmm import SystemSums, fast_sums_for
from warpmag.moments.force_sums import force_sums
from warpmag.moments.layout import MomentLayout, MomentMaterial, change_material, make_layout, with_cells
from warpmag.moments.ranks import current_ranks
from warpmag.moments.settings import SolverSettings
from warpmag.moments.system_cells import SystemCells
from warpmag.moments.system_energies import SystemEnergies
from warpmag.moments.system_gradients import SystemGradients
from warpmag.shapes.demagnetization import Coupling


class MomentSystem:
    """Moments of a simulation, with their magnetic equilibrium and their forces, in buffers that are allocated once.

    Moments are ordered by world, inducible moments of a world before permanent moments. Moments of different worlds do
    not interact. :meth:`solve` and :meth:`apply_forces` only launch kernels. They neither allocate nor wait for the
    device, so that a graph can capture them. Results stay on the device.

    Args:
        radii: Radii of the moments' balls [m], shape [n]. A moment has the volume of its ball.
        worlds: World of each moment, non-decreasing from 0, shape [n]; None means one world.
        permanent: True for a permanent moment, shape [n]; None means that all moments are inducible.
        bodies: Body of each moment, shape [n]; moments of one body exert no force on each other. None means that each
            moment is a body.
        movable: True for a moment that needs a force, shape [n]; None means all.
        body_extent: Largest distance [m] between two moments of a movable body. The method ``fmm`` needs it if such a
            body has several moments, because it sums their pairs one by one. None means unknown.
        material: Material of the inducible moments.
        external_field: Applied field [A/m], shape [3] or [n, 3].
        settings: Settings of the solve and of the forces.
        couplings: First moment of each body that consists of cells, and the correction of the pair sums between the
            cells (``shapes.demagnetization.Coupling``).
        sources: Coils and field maps; their bodies have the same numbers as in ``bodies``.
        solids: Permanent bodies with a closed-form near field, ordered by world.
        faces: Flat faces of inducible bodies of ``couplings``, ordered by world. The contact model ``multipole`` has
            mirror images of balls in them.
        copies: Number of copies of all this, one after the other: worlds with their moments, bodies, couplings, solids
            and faces. Coils and field maps have no copies. Thousands of equal worlds are prepared in a moment.
        body_step: Difference between the number of a body and that in the copy before.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means Warp's default.

    Attributes:
        settings: As given.
        device, dtype: Warp device and Warp scalar type.
        positions: Moment positions [m], shape [n]; written by the caller before :meth:`solve`.
        moments: Moments [A·m²], shape [n]. The caller writes permanent moments, :meth:`solve` inducible moments.
        external_field: Applied field [A/m], shape [n]; the caller may change it.
        crowded: 1 if some cells have too many near cells in other bodies: they act as balls, or as uniform boxes,
            shape [1]; None unless a world has several bodies of ``couplings``.
        resting: 1 for worlds that :meth:`solve` leaves out, with their moments as they are, shape [worlds]; only the
            dynamics ``theta`` has them. The caller may write it.
        refresh: Function that launches the update of ``positions`` and ``moments`` in worlds that rest, where other
            moments stand for them; None without such moments.
        rotations: Rotation of each body of ``couplings`` from its frame to the world's (x, y, z, w), shape [bodies];
            written by the caller before :meth:`solve`. None without ``couplings``.
        sources: ``sources`` and ``solids`` on the device; the caller writes their poses and strengths before
            :meth:`solve`. None without them.
        source_interaction: Field of ``sources`` at the moments, and the wrenches of the moments on ``sources``
            (``kernels.applied.fields.AppliedForces``). None without sources.
        bias: M_r/χ [A/m] of permanent moments with recoil permeability, M_r being the remanence, shape [n]; written by
            the caller before :meth:`solve`. None without them.
        eddy: Eddy currents in balls (``kernels.eddy.eddy``), None before :meth:`set_conductivity`. The caller writes
            their ``motion`` and ``source_interaction.source_motion`` before :meth:`solve`.
        material: The material as kernels read it.
        dynamics: Magnetization dynamics of the inducible moments (``moments.dynamics``).
        is_fast: True if the fast multipole method sums the pairs.
        fmm_rtol: Relative error of the fields by the fast multipole method; None without it.
        world_ranges: (First moment, first permanent moment, end) of each world.
        h: Field at the inducible moments [A/m], without a moment's own field, with the bias, shape [n]. The
            dynamics ``theta`` ends with M = f(H) in this field.
        forces: Forces [N] on movable moments, shape [n], written by :meth:`apply_forces`.
        torques: Torques about each moment's position [N·m], shape [n], written by :meth:`apply_forces`; 0 for an
            inducible ball of a single moment, unless ``single_torque``.
        error: Relative error of each world's magnetization, estimated by ``theta`` (see ``kernels.induction``); other
            dynamics give the residual; shape [worlds].
        residual: Relative residual ‖M − f(H)‖/‖f(H)‖ of each world at its last field evaluation, the computable form of
            Eq. 12, shape [worlds]; ``theta`` takes one more step after it.
        evaluations: Field evaluations of the last solve, shape [worlds].
        converged: 1 where the last solve reached ``rtol``, shape [worlds].
    """

    def __init__(
        self,
        *,
        radii,
        worlds=None,
        permanent=None,
        bodies=None,
        movable=None,
        body_extent: float | None = None,
        material: MomentMaterial | None = None,
        external_field=(0.0, 0.0, 0.0),
        settings: SolverSettings | None = None,
        couplings: Sequence[tuple[int, Coupling]] = (),
        sources: Sequence[AppliedSource] = (),
        solids: Sequence[SolidMagnet] = (),
        faces: Sequence[IronFaces] = (),
        copies: int = 1,
        body_step: int = 0,
        dtype: str = "float32",
        device=None,
    ):
        """Allocate all buffers."""
        self.settings = settings = settings or SolverSettings()
        self.device, self.dtype = resolve_device(device), resolve_dtype(dtype)
        settings.check(dtype)
        layout = make_layout(radii, worlds, permanent, bodies, movable, self.dtype, copies, body_step)
        layout = with_cells(layout, couplings)
        self.eddy, self._ranks, self._graph = None, current_ranks(), None
        self.refresh: Callable[[], None] | None = None
        near = settings.contact_model == "multipole"
        self._layout = layout
        self._allocate(layout, external_field)
        material = material or MomentMaterial()
        self.material, susceptibility = material.parameters(layout, self.dtype, self.device)
        self._layout = layout = self._make_bias(layout)
        rotatable = ~layout.aligned | settings.single_torque
        self._rotatable = put_copies(rotatable.astype(np.int32), wp.int32, self.device, copies)
        self._fast = fast_sums_for(settings.method, self._packed, layout, body_extent, float(settings.rtol))
        self.is_fast, self.fmm_rtol = isinstance(self._fast, SystemSums), self._fast.rtol
        self._make_sources(layout, sources, solids)
        self._make_field(layout, near)
        self._make_cells(layout, couplings, {solid.first for solid in solids})
        wrench = {"with_torque": self._rotatable, "torques": self.torques, "ranks": self._ranks}
        arrays = self._effective, self._packed, self._acting_field, self.forces
        self._wrench = force_sums(layout, rotatable, self._fast, *arrays, **wrench)
        self._near = None
        if near:
            self._near = self._make_near_contacts(layout, rotatable, susceptibility, faces, len(couplings))
        limits = float(settings.rtol), int(settings.max_evaluations)
        solve_state.bind(self._induction, self._packed, self.material, self.moments, *limits)
        bodies = () if self._cells is None else self._cells.bodies
        arguments = bodies, layout, self.rotations, self._induction
        self._body_steps = make_body_steps(*arguments, settings.dynamics)
        self._body_fields = None
        if settings.dynamics == "theta" and not (near or self.is_fast or self._ranks):
            self._body_fields = make_body_fields(*arguments)
        self.dynamics = make_dynamics(settings.dynamics, self._induction, step=settings.step, damping=settings.damping)

    def _allocate(self, layout: MomentLayout, external_field):
        n, vec3, copies = layout.count, vec3_type(self.dtype), layout.copies
        self.positions, self.moments, self.forces, self.torques = (
            wp.zeros(n, dtype=vec3, device=self.device) for _ in range(4)
        )
        field, shape = host_array("external_field", external_field), layout.radii.shape
        if field.shape not in ((3,), (*shape, 3)):
            raise InputError(shape_message("external_field", f"[3] or [{shape[0]}, 3]", field))
        self.external_field = put_copies(np.broadcast_to(field, (*shape, 3)), vec3, self.device, copies)
        self._packed = PackedMoments(
            put_copies(layout.radii, self.dtype, self.device, copies),
            largest_radius=float(layout.radii.max(initial=0.0)),
            labels=put_copies(layout.bodies.astype(np.int32), wp.int32, self.device, copies, layout.body_step),
            groups=put_copies(layout.worlds.astype(np.int32), wp.int32, self.device, copies, layout.world_count),
        )
        self._effective = self._packed.vectors()
        arguments = layout.worlds, ~layout.permanent, layout.cells, self.dtype, self.device, copies
        self._induction = state = solve_state.allocate(*arguments)
        self.h, self.residual, self.error, self.resting = state.h, state.residual, state.error, state.resting
        self.evaluations, self.converged = state.evaluations, state.converged

    @cached_property
    def worlds(self) -> np.ndarray:
        """World of each moment, NumPy, shape [n]."""
        return self._layout.whole().worlds

    def _make_bias(self, layout: MomentLayout) -> MomentLayout:
        """Allocate the bias of moments with recoil permeability, which are not aligned in the returned layout."""
        n = len(layout.radii)
        recoils = (self.material.curve.numpy()[:n] == LINEAR) & ~layout.permanent
        self.bias = None
        self._biased = put_copies(np.flatnonzero(recoils).astype(np.int32), wp.int32, self.device, layout.copies, n)
        if recoils.any():
            if self.settings.dynamics != "theta":
                raise InputError(f"dynamics: {self.settings.dynamics!r} lacks recoil permeability, only 'theta' has it")
            self.bias = wp.zeros_like(self.moments)
        return replace(layout, aligned=layout.aligned & ~recoils)

    def _make_sources(self, layout: MomentLayout, sources, solids):
        """Prepare the field of sources. Added to the external field, it magnetizes moments and acts on them."""
        self.sources = self.source_interaction = None
        self._magnetizing_field = self._acting_field = self.external_field
        if sources or solids:
            self.sources = FieldSources(
                sources, solids, self._packed, layout.copies * layout.world_count, self.bias, layout.copies
            )
            self.source_interaction = AppliedForces(
                self.sources, layout.worlds, self.external_field, ~layout.permanent, layout.movable,
                balls=layout.balls if self.settings.contact_model == "multipole" else None,
                constants=nonuniform.expansion_constants(),
            )  # fmt: skip
            self._magnetizing_field = self.source_interaction.field
            self._acting_field = self.source_interaction.acting

    def _make_field(self, layout: MomentLayout, near: bool):
        """Prepare the fields of permanent and of inducible moments at inducible moments."""
        ranges = repeat_rows(np.reshape(layout.ranges(), (-1, 3)), layout.copies, len(layout.radii))
        self.world_ranges = list(zip(*ranges.T.tolist(), strict=True))
        packed, state, copies = self._packed, self._induction, layout.copies
        of_permanent, of_inducible = ranges[:, [0, 1, 1, 2]], ranges[:, [0, 1, 0, 1]]
        permanent = repeat_rows(layout.permanent, copies) if self.is_fast else layout.permanent
        sums = self._fast.sums_of(Quantity.FIELD, pair_count(of_permanent), permanent)
        self._inducible_sums = self._fast.sums_of(Quantity.FIELD, pair_count(of_inducible), ~permanent)
        arrays = packed, packed, self._magnetizing_field, state.h0
        more = {"copies": copies, "ranks": self._ranks}
        self._permanent_field = PairEvaluation(Quantity.FIELD, of_permanent, *arrays, sums=sums, **more)
        if self._permanent_field.pair_count == 0 and self.bias is None:
            state.h0 = self._magnetizing_field
        # near contacts write one more partial sum
        more |= {"extra_parts": int(near), "sums": self._inducible_sums}
        self._inducible_field = PairEvaluation(Quantity.FIELD, of_inducible, packed, packed, state.h0, self.h, **more)

    def _make_cells(self, layout: MomentLayout, couplings, closed_forms: set[int]):
        """Prepare the corrections between cells, and the averages of the fields of ``sources`` over cells."""
        self._cells = self.rotations = self.crowded = None
        if couplings:
            self._cells = cells = SystemCells(
                layout, couplings, closed_forms, rotatable=self._rotatable, packed=self._packed, moments=self.moments,
                h=self.h, forces=self.forces, torques=self.torques,
            )  # fmt: skip
            self.rotations, self.crowded = cells.rotations, cells.crowded
            if closed_forms:
                cells.average_sources(self.source_interaction)

    def _make_near_contacts(self, layout: MomentLayout, rotatable, susceptibility, faces, coupling_count: int):
        steps = {"first": len(layout.radii), "world": layout.world_count, "number": coupling_count}
        faces, copies, layout = repeat_records(faces, layout.copies, **steps), layout.copies, layout.whole()
        rotatable, susceptibility = (repeat_rows(values, copies) for values in (rotatable, susceptibility))
        magnets, worlds = layout.permanent | (self.material.curve.numpy() == LINEAR), {*layout.worlds[layout.balls]}
        for solid in () if self.sources is None else self.sources.solids:  # closed forms replace their moments
            magnets[solid.first : solid.first + solid.count] = solid.response > 0.0
        return near_pairs.allocate(
            self._packed, layout.worlds, layout.balls, susceptibility, self.material,
            ranges=self.world_ranges, magnets=magnets, single=layout.single, field=self._inducible_field,
            movable=layout.movable, rotatable=rotatable, forces=self.forces, torques=self.torques,
            expansion=None if self.source_interaction is None else self.source_interaction.expansion,
            faces=[body for body in faces if body.world in worlds],
            rotations=self.rotations,
        )  # fmt: skip

    @property
    def radii(self):
        """Radii of the moments' balls [m], shape [n]."""
        return self._packed.radii

    @property
    def largest_radius(self) -> float:
        """Largest radius of the moments' balls [m]."""
        return self._packed.largest_radius

    @property
    def bodies(self):
        """Body of each moment on the device, shape [n]."""
        return self._packed.labels

    @property
    def world_of_moments(self):
        """World of each moment on the device, shape [n]."""
        return self._packed.groups

    @property
    def count(self) -> int:
        """Number of moments n."""
        return self._packed.count

    @property
    def overlaps(self) -> bool:
        """True if any balls overlapped in the last solve. Waits for the device."""
        return bool(self._packed.overlap_counts.numpy().any())

    @property
    def rtol(self) -> float:
        """Relative error of the magnetization at which a solve ends."""
        return float(self.settings.rtol)

    @cached_property
    def gradients(self) -> SystemGradients:
        """Gradients of solves and forces. Their buffers are allocated at the first access."""
        arrays = self._packed, self._induction, self.material, self.worlds, self.world_ranges
        cells = ((), None) if self._cells is None else (self._cells.bodies, self._cells.pairs)
        return SystemGradients(*arrays, self.rtol, self.fmm_rtol, self.source_interaction, *cells)

    def start_cold(self, chosen: wp.array | None = None):
        """Start the next solve as the first one, from zero magnetization, in chosen worlds.

        ``chosen`` is not 0 for these worlds, int32, shape [worlds]; None means all worlds. Neighbor lists are rebuilt
        in all worlds.
        """
        if not self.count:
            return
        if chosen is None:
            chosen = wp.ones(len(self.world_ranges), dtype=wp.int32, device=self.device)
        launch_start_cold(self._induction, chosen)
        self._packed.request_search(chosen)
        if self._near is not None:
            self._near.start_cold(chosen)
        if self._cells is not None:
            self._cells.request_search(chosen)

    def start_from(self, magnetizations):
        """Start the next solve from given magnetizations [A/m], a Warp array of vectors, shape [n]."""
        self.dynamics.start_from(magnetizations)

    def set_material(self, moments, saturation, susceptibility):
        """Change the saturation Ms [A/m] and the susceptibility of inducible moments with indices ``moments``.

        Their curves stay. Waits for the device.
        """
        if len(moments) and self._near is not None:
            raise InputError("contact_model: multipole has tables of the materials, which cannot be changed")
        change_material(self.material, moments, saturation, susceptibility, self.dtype)

    def set_conductivity(self, conductivity, step: float):
        """Start computing eddy currents in the balls of single moments, of ``conductivity`` [S/m], shape [n].

        Computed forces act for at most ``step`` [s].
        """
        aligned, ranges = self._rotatable.numpy() == 0, [(first, last) for first, _, last in self.world_ranges]
        self.eddy = EddyCurrents(self._packed, ranges, conductivity, aligned, self.material, step)
        if self.source_interaction is not None:
            self.source_interaction.enable_rates(self.eddy.motion)

    def persistent_arrays(self) -> dict[str, PersistentArray]:
        """Return by name the arrays that one solve passes to the next. Restoring them repeats the next solve."""
        parts = {"induction": solve_state.persistent_arrays(self._induction), "pairs": self._packed.persistent_arrays()}
        parts["dynamics"] = self.dynamics.persistent_arrays()
        if self._near is not None:
            parts["near"] = self._near.persistent_arrays()
        if self._cells is not None:
            parts["cell_pairs"] = self._cells.persistent_arrays()
        inner = {f"{part}.{name}": array for part, arrays in parts.items() for name, array in arrays.items()}
        material = {"saturation": self.material.saturation, "slope": self.material.slope}
        return {"moments": self.moments, **material, **inner}

    def start_arrays(self) -> list[wp.array]:
        """Return the arrays from which the next solve starts; restore copies and :meth:`restart` to repeat it."""
        return [*solve_state.start_arrays(self._induction), *self.dynamics.persistent_arrays().values()]

    def restart(self, rejected: wp.array) -> None:
        """Start the next solve from :meth:`start_arrays` alone if ``rejected`` is not 0, int32, shape [1]."""
        solve_state.launch_restart(self._induction, rejected)

    def field_arrays(self) -> list[wp.array]:
        """Return the arrays that the caller writes before a solve, and the field that it leaves.

        Restoring them with :meth:`persistent_arrays`, and calling :meth:`evaluate_again`, brings back the last solve.
        """
        names = {
            self: ("positions", "rotations", "bias", "h"),
            self.sources: ("frames", "strengths", "solid_frames"),
            self.source_interaction: ("source_motion",),
            self.eddy: ("motion",),
        }
        arrays = [getattr(owner, name, None) for owner in names for name in names[owner]]
        return [array for array in arrays if isinstance(array, wp.array)]

    def solve(self):
        """Launch the induction solve: bring the inducible ``moments`` to equilibrium at ``positions``."""
        self.begin()
        if self._inducible_field.count:
            # No world can converge before its first evaluation. One iteration outside of the loop saves time on a GPU.
            iterate = self.iterate if self._ranks is None else self._iterate_with_ranks
            iterate()
            wp.capture_while(self._induction.condition, iterate)

    def begin(self):
        """Launch the start of a solve. :meth:`iterate` continues it; :meth:`solve` does both."""
        packed = self._packed
        packed.pack(self.positions, self.moments)
        if self.source_interaction is not None:
            self.source_interaction.launch()
        if self._near is not None:
            near_pairs.launch_find_pairs(self._near)
        packed.find_overlaps()
        self._fast.build()
        if self._permanent_field.pair_count:
            self._permanent_field.launch()
        elif self.bias is not None:
            wp.copy(self._induction.h0, self._magnetizing_field)
        if self.bias is not None:
            launch_add_bias(self.bias, self._biased, self._induction.h0)
        if self._inducible_field.count == 0:
            return
        if self._cells is not None:
            self._cells.find_pairs()
        self.dynamics.start()
        if self._near is not None:
            near_pairs.wait(self._near)

    def iterate(self):
        """Launch one field evaluation at the inducible moments and one step of the dynamics."""
        self.dynamics.refine()
        self._sum_field(everywhere=False)
        if self._body_steps is not None:
            self._body_steps.launch()
        self.dynamics.iterate()
        self._wait_for_near_contacts()

    def _iterate_with_ranks(self):
        """Launch :meth:`iterate` on all ranks, on a GPU as a graph, because NCCL cannot run in a loop of a graph."""
        if self._graph is None:
            self.iterate()
            if self.device.is_cuda:
                with wp.ScopedCapture(self.device) as capture:
                    self.iterate()
                self._graph = capture.graph
        else:
            wp.capture_launch(self._graph)

    def evaluate(self):
        """Launch one evaluation of ``h`` at the inducible moments, without a step."""
        self._sum_field(everywhere=True)
        self._wait_for_near_contacts()

    def evaluate_again(self):
        """Launch all that a solve computes from ``positions`` and ``moments``, without a step of the dynamics."""
        self.begin()
        if self._inducible_field.count:
            self.evaluate()

    def _sum_field(self, *, everywhere: bool):
        """Launch all sums of the field at inducible moments; :meth:`_wait_for_near_contacts` must follow.

        With ``everywhere`` False some sums leave out worlds that have converged.
        """
        if self._body_fields is not None:
            self._body_fields.launch(everywhere=everywhere)
            return
        near = self._near
        if near is None:
            self._inducible_field.launch()
        else:
            near_pairs.launch_sweeps(near)
            self._inducible_field.launch(wait=lambda: near_pairs.wait(near, for_field=True))
        if self._cells is not None:
            self._cells.add_field()

    def _wait_for_near_contacts(self):
        """Make later launches wait for the near contacts, which run on a stream of their own."""
        if self._near is not None:
            near_pairs.wait(self._near)

    def parts(self) -> dict[str, tuple[Callable[[], None], int]]:
        """Return launches that repeat parts of the last solve and its forces, and their numbers in it, by name.

        They leave all results but ``h``, which becomes the field of the last moments. Waits for the device.
        """
        launches: dict[str, tuple[Callable[[], None], int]] = {"neighbors": (self._packed.find_overlaps, 1)}
        if self.source_interaction is not None:
            launches["sources"] = (self.source_interaction.launch, 1)
        if self._permanent_field.pair_count:
            launches["permanent moments"] = (self._permanent_field.launch, 1)
        if self._cells is not None and self._cells.pairs is not None:
            launches["pairs of cells"] = (self._cells.find_pairs, 1)
        if self._inducible_field.count:
            launches["evaluations"] = (self.evaluate, int(self.evaluations.numpy().max(initial=1)))
        return {**launches, "forces": (self.apply_forces, 1)}

    def field_error(self) -> float:
        """Return the relative error of the fast multipole method's field at sampled moments, or 0 without the method.

        Corrections by cells and near contacts are left out of both fields. Waits for the device.
        """
        if self._inducible_field.count == 0 or GIVEN not in (self._permanent_field.form, self._inducible_field.form):
            return 0.0
        base = wp.clone(self._magnetizing_field)
        if self.bias is not None:
            launch_add_bias(self.bias, self._biased, base)
        return sampled_error(self._inducible_sums, self._packed, self.world_ranges, self._induction.h0, base)

    def magnetizations(self):
        """Return the magnetizations M [A/m] of all moments in a new array, shape [n]; 0 for point dipoles."""
        m = wp.empty_like(self.moments)
        launch_divide_by_volume(self.moments, self._packed.radii, m)
        return m

    def energy(self) -> np.ndarray:
        """Return the energy of each world's moments after :meth:`solve` [J], float64, shape [worlds].

        It is the energy of all fields and of the magnetization curves. Its negative gradient with respect to positions
        is the Kelvin force. Permanent moments of one body add a constant. Waits for the device.
        """
        return self._energies.of_worlds()

    @cached_property
    def _energies(self) -> SystemEnergies:
        return SystemEnergies(self, self._packed, self._induction.h0, self._acting_field)

    def apply_forces(self, force=None):
        """Launch the forces and torques on the moments after :meth:`solve`; ``force`` overrides the force law."""
        near, force, interaction = self._near, force or self.settings.force, self.source_interaction
        check_force("force", force, self.settings.contact_model)
        if force == "zeeman":
            launch_zeeman_moments(self._packed, self.h, self.material, self._effective)
        if self.eddy is not None:
            self.eddy.add(self._acting_field, interaction, self._effective if force == "zeeman" else None)
        if near is not None:
            near_pairs.launch_begin_forces(near)
        for evaluation in self._wrench[force]:
            evaluation.launch()
        if self._cells is not None:
            self._cells.add_forces()
        expanded = interaction is not None and interaction.expansion is not None
        if expanded:
            interaction.expand()
        if near is not None:
            near_pairs.launch_add_forces(near)
        if interaction is not None:
            effective = self._effective if force == "zeeman" else self._packed.moments
            interaction.write_image_factors(self.moments, self.radii, self.material)
            interaction.add(effective, self.forces, self.torques, near.arrays.magnets.response if expanded else None)
        if self.eddy is not None:
            self.eddy.finish(self.moments, self.torques)
