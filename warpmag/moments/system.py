"""All magnetic moments of a simulation on one device: induction and forces, every buffer allocated once."""

import math
from dataclasses import replace

import numpy as np
import warp as wp

from warpmag.declarations.checks import check_count, check_token
from warpmag.declarations.magnets import CONTACT_MODELS, DYNAMICS, check_force, check_rtol
from warpmag.errors import InputError
from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.applied.sources import Sources
from warpmag.kernels.cells.couplings import CellCouplings
from warpmag.kernels.eddy.eddy import EddyCurrents
from warpmag.kernels.fmm.evaluation import sampled_error
from warpmag.kernels.induction import solve_state
from warpmag.kernels.induction.bias import launch_add_bias
from warpmag.kernels.induction.body_response import MOST_CELLS, BodyResponses, WholeBody
from warpmag.kernels.material.curves import LINEAR
from warpmag.kernels.near_contact import near_pairs, uneven
from warpmag.kernels.pairs.evaluate import GIVEN, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments, launch_divide_by_volume
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.pairs.work_list import pair_count
from warpmag.kernels.pairs.wrench import MU0, launch_zeeman_moments
from warpmag.moments.arrays import host_array, resolve_device, resolve_dtype, shape_message, vec3_type
from warpmag.moments.dynamics import make_dynamics
from warpmag.moments.energies import MomentEnergies
from warpmag.moments.fmm import SystemSums, fast_sums_for
from warpmag.moments.layout import MomentLayout, change_material, make_layout, make_material, with_cells
from warpmag.moments.ranks import ranks


class MomentSystem:
    """Moments that are brought to equilibrium and feel forces, again and again.

    Moments are ordered by world, and within a world inducible ones come first. Moments of different worlds never see
    each other. The methods only launch kernels: nothing is allocated, and nothing waits for the device, so that they
    can be captured in a graph; results stay on the device.

    Args:
        radii: Radii of the moments' balls [m], shape [n]. A moment's volume is its ball's.
        worlds: World of each moment, non-decreasing from 0, shape [n]; None means one world.
        permanent: Whether a moment is permanent, shape [n]; None means none is.
        bodies: Body of each moment, shape [n]; moments of one body exert no force on each other. None means each
            its own.
        movable: Whether the force on a moment is wanted, shape [n]; None means all.
        saturation: Saturation magnetization Ms [A/m], scalar or [n].
        susceptibility: Susceptibility [dimensionless], scalar or [n], may be infinite.
        curve: Magnetization curve, one of ``magnets.CURVES`` or a measured one, which has its own saturation and
            susceptibility; a tuple or list gives each moment its own, of which those of permanent ones do not count.
            ``magnets.LINEAR_CURVE`` is the response of a permanent magnet by its recoil permeability, 1 + χ.
        external_field: Applied field [A/m], shape [3] or [n, 3].
        force: ``kelvin`` or ``zeeman``.
        dynamics: ``theta``: the exact flow, accelerated; or one of its rivals, explicit steps of pairs of
            submagnetizations: ``theta-euler``, ``llg``, ``llg-damping`` (see ``kernels.submagnetization``).
        contact_model: ``dipole``; or ``multipole``, which adds what inducible bodies of one moment lack where they
            nearly touch (see ``warpmag.kernels.near_contact``).
        method: How pairs are summed: ``direct``, all of them; ``fmm``, the fast multipole method, with fields as
            exact as ``rtol`` asks for; or ``auto``, the faster one.
        body_extent: Largest distance between two moments of a body that may move [m], which the method ``fmm`` needs
            to know: it sums such pairs one by one. None means not known.
        rtol: Relative error of the inducible moments' magnetization at which induction ends.
        max_evaluations: Field evaluations after which it gives up, with ``converged`` 0.
        step: Step κ = βΔtMs [dimensionless] of an explicit dynamics; None means its default.
        damping: Damping α [dimensionless] of ``llg``; None means its default.
        lone_torque: Whether an inducible body of one moment gets its torque m × H, which only tells how far the
            solve is from converged: in equilibrium the two are parallel.
        couplings: What the moments of a body lack among themselves as balls: of each body that has cells the first
            of its moments, and the ``demagnetization.Coupling`` of all of them.
        applied: Sources without a response that act on the moments, ``AppliedSource`` of ``kernels.applied.sources``;
            their bodies are numbered as those of the moments.
        solids: Permanent bodies whose fields are closed forms close up (``kernels.applied.solids.SolidMagnet``),
            ordered by world.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means Warp's default.

    Raises:
        InputError: An argument is out of range.

    Attributes:
        rotations: Rotation of each body of ``couplings``, from its frame to the world's (x, y, z, w), shape [bodies];
            written by the caller before :meth:`solve`. None without them.
        sources: ``applied`` and ``solids`` on the device, where they are and how strong written by the caller before
            :meth:`solve`. None without them.
        applied: Their field at the moments, and by :meth:`apply_forces` what the moments do to them
            (``kernels.applied.fields.AppliedForces``); None without sources.
        positions: Moment positions [m], shape [n]; written by the caller before :meth:`solve`.
        moments: Moments [A·m²], shape [n]; permanent ones written by the caller, inducible ones by :meth:`solve`.
        external_field: Applied field [A/m], shape [n]; may be changed by the caller.
        eddy: Eddy currents in balls (``kernels.eddy.eddy``), None unless :meth:`conduct` was called; their ``motion``
            and ``applied.source_motion`` are written by the caller before :meth:`solve`.
        bias: M_r/χ [A/m] of permanent moments that respond, M_r the remanence, shape [n]; written by the caller before
            :meth:`solve`. None without them.
        dynamics: What moves the inducible moments, an object of ``warpmag.moments.dynamics``.
        is_fast: Whether pairs are summed by the fast multipole method.
        worlds: World of each moment, NumPy, shape [n].
        world_ranges: For each world its first moment, its first permanent one, and the end.
        h: Field at inducible moments [A/m], external and all other moments', of which the dynamics ``theta`` makes M =
            f(H) when it ends, shape [n]; with the bias where there is one.
        forces: Forces [N] on those that may move, shape [n], by :meth:`apply_forces`.
        torques: Torques e × H about each moment's position [N·m], e being m with Kelvin's law (see
            ``kernels.pairs.wrench``), shape [n]; zero for an inducible ball of one moment.
        error: Relative error of each world's magnetization, as ``theta`` estimates it (see ``kernels.induction``); of
            other dynamics the residual; shape [worlds].
        residual: Relative residual ‖M − f(H)‖/‖f(H)‖ of each world after its last field evaluation, the computable form
            of Eq. 12, shape [worlds]; ``theta`` goes a step on from there. Of bodies that respond as wholes (see
            ``kernels.induction.body_response``) H is the field in which they have responded.
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
        saturation=1.0,
        susceptibility=math.inf,
        curve="tanh",
        external_field=(0.0, 0.0, 0.0),
        force="kelvin",
        dynamics="theta",
        contact_model="dipole",
        method="direct",
        body_extent=None,
        rtol=1e-3,
        max_evaluations=1000,
        step=None,
        damping=None,
        lone_torque=False,
        couplings=(),
        applied=(),
        solids=(),
        dtype="float32",
        device=None,
    ):
        """Allocate all buffers."""
        check_token("contact_model", contact_model, CONTACT_MODELS)
        check_token("dynamics", dynamics, DYNAMICS)
        check_force("force", force, contact_model)
        self.device, self.dtype = resolve_device(device), resolve_dtype(dtype)
        check_rtol("rtol", rtol, dtype)
        check_count("max_evaluations", max_evaluations)
        layout = with_cells(make_layout(radii, worlds, permanent, bodies, movable, self.dtype), couplings)
        self.rtol, self.max_evaluations, self.contact_model = float(rtol), int(max_evaluations), contact_model
        self._force, self.eddy, self._ranks, self._graph = force, None, ranks(), None
        near = contact_model == "multipole"
        self._allocate(layout, external_field)
        made_of = saturation, susceptibility, curve
        self._material, susceptibility = make_material(layout.permanent, *made_of, self.dtype, self.device)
        layout = self._make_bias(layout, dynamics)
        self._apply_sources(layout, applied, solids)
        turned = ~layout.lone | lone_torque
        self._fast = fast_sums_for(method, self._packed, layout, body_extent, self.rtol)
        self.is_fast = isinstance(self._fast, SystemSums)
        self._evaluate_field(layout, near)
        self._make_cells(layout, couplings, whole=dynamics == "theta")
        self._evaluate_wrench(layout, turned)
        self._energies = None
        self._near = self._make_near_contacts(layout, turned, susceptibility) if near else None
        solve_state.bind(self._induction, self._packed, self._material, self.moments, self.rtol, self.max_evaluations)
        bodies = self._make_bodies(layout, couplings) if dynamics == "theta" else None
        self.dynamics = make_dynamics(dynamics, self._induction, bodies=bodies, step=step, damping=damping)

    def _allocate(self, layout: MomentLayout, external_field):
        n, vec3 = len(layout.radii), vec3_type(self.dtype)
        self.positions, self.moments, self.forces, self.torques = (
            wp.zeros(n, dtype=vec3, device=self.device) for _ in range(4)
        )
        applied = host_array("external_field", external_field)
        if applied.shape not in ((3,), (n, 3)):
            raise InputError(shape_message("external_field", f"[3] or [{n}, 3]", applied))
        self.external_field = wp.array(np.broadcast_to(applied, (n, 3)), dtype=vec3, device=self.device)
        self._packed = PackedMoments(
            wp.array(layout.radii, dtype=self.dtype, device=self.device),
            largest_radius=float(layout.radii.max(initial=0.0)),
            labels=layout.bodies,
            groups=layout.worlds,
        )
        self._effective = self._packed.vectors()
        self._induction = solve_state.allocate(layout.worlds, ~layout.permanent, self.dtype, self.device)
        self.h, self.residual, self.error = self._induction.h, self._induction.residual, self._induction.error
        self.evaluations, self.converged = self._induction.evaluations, self._induction.converged

    def _apply_sources(self, layout: MomentLayout, applied, solids):
        """Prepare the field of sources, which with the external one magnetizes moments, and acts on them."""
        self.sources = self.applied = None
        self._magnetizing = self._acting = self.external_field
        if applied or solids:
            self.sources = Sources(applied, solids, self._packed, len(layout.ranges()), self.bias)
            self.applied = AppliedForces(
                self.sources, layout.worlds, self.external_field, layout.movable,
                balls=layout.balls if self.contact_model == "multipole" else None,
                constants=uneven.expansion_constants(),
            )  # fmt: skip
            self._magnetizing, self._acting = self.applied.field, self.applied.acting

    def _make_bias(self, layout: MomentLayout, dynamics: str) -> MomentLayout:
        """Make room for the bias of permanent moments that respond; return the layout, in which they are no balls."""
        linear = (self._material.curve.numpy() == LINEAR) & ~layout.permanent
        self.bias, self._biased = None, wp.array(np.flatnonzero(linear), dtype=wp.int32, device=self.device)
        if linear.any():
            if dynamics != "theta":
                raise InputError(f"dynamics: {dynamics!r} knows no recoil permeability, only 'theta' does")
            self.bias = wp.zeros_like(self.moments)
        return replace(layout, lone=layout.lone & ~linear)

    def _evaluate_field(self, layout: MomentLayout, near: bool):
        """Prepare the field of permanent moments at inducible ones, and that of inducible ones among themselves."""
        self.worlds, self.world_ranges = layout.worlds, layout.ranges()
        ranges, packed, state = np.reshape(self.world_ranges, (-1, 3)), self._packed, self._induction
        applied, mutual = ranges[:, [0, 1, 1, 2]], ranges[:, [0, 1, 0, 1]]
        of_magnets = self._fast.sums_of(Quantity.FIELD, pair_count(applied), layout.permanent)
        self._among = self._fast.sums_of(Quantity.FIELD, pair_count(mutual), ~layout.permanent)
        arrays = packed, packed, self._magnetizing, state.h0
        self._applied = PairEvaluation(Quantity.FIELD, applied, *arrays, sums=of_magnets, ranks=self._ranks)
        if self._applied.pair_count == 0 and self.bias is None:
            state.h0 = self._magnetizing
        # near contacts write one more partial sum
        arrays = packed, packed, state.h0, self.h
        more = {"extra_parts": int(near), "sums": self._among, "ranks": self._ranks}
        self._mutual = PairEvaluation(Quantity.FIELD, mutual, *arrays, **more)

    def _make_cells(self, layout: MomentLayout, couplings, whole: bool):
        """Prepare what cells lack as balls; ``whole`` tells whether small bodies respond as wholes."""
        worlds = [(first, middle) for first, middle, _ in layout.ranges()]
        self._cells = self.rotations = None
        if couplings:
            which = [whole and len(one.radii) <= MOST_CELLS for _, one in couplings]
            self._cells = CellCouplings(couplings, worlds, self._packed, self.moments, self.h, which)
            self.rotations = self._cells.rotations

    def _make_bodies(self, layout: MomentLayout, couplings) -> BodyResponses | None:
        """Prepare the response of those bodies that are small enough to respond as wholes."""
        bodies = [
            WholeBody(first, int(layout.worlds[first]), number, int(self._cells.rows[number]), one.dense)
            for number, (first, one) in enumerate(couplings)
            if len(one.radii) <= MOST_CELLS
        ]
        return BodyResponses(self._induction, bodies, self._cells) if bodies else None

    def _evaluate_wrench(self, layout: MomentLayout, turned):
        """Prepare, for each force law, the force of everything on whatever moves, and its torque if it is wanted."""
        self._turned = wp.array(turned.astype(np.int32), dtype=wp.int32, device=self.device)
        segments = [np.reshape(layout.runs(layout.movable & which), (-1, 4)) for which in (~turned, turned)]
        pairs = pair_count(whole := np.concatenate(segments))  # by multipoles all in one: actions equal reactions

        def evaluations(force, effective):
            # those with a torque come last, since the others' mirrored form writes forces on all moments
            parts = [(force, segments[0]), (Quantity.WRENCH, segments[1])]
            if self._fast.serves(Quantity.WRENCH, pairs):
                parts = [(Quantity.WRENCH if len(segments[1]) else force, whole)]
            return [
                PairEvaluation(
                    quantity, which, self._packed, self._packed, self._acting, self.forces, effective=effective,
                    turned=self._turned, torques=self.torques, sums=self._fast.sums_of(quantity, pairs),
                    ranks=self._ranks,
                )
                for quantity, which in parts
                if len(which)
            ]  # fmt: skip

        self._wrench = {
            "kelvin": evaluations(Quantity.MUTUAL_FORCE, None),
            "zeeman": evaluations(Quantity.FORCE, self._effective),
        }

    def _make_near_contacts(self, layout: MomentLayout, turned, susceptibility):
        magnets = layout.permanent | (self._material.curve.numpy() == LINEAR)
        for one in () if self.sources is None else self.sources.solids:  # of closed forms, not of their moments
            magnets[one.first : one.first + one.count] = one.response > 0.0
        return near_pairs.allocate(
            self._packed, layout.worlds, layout.balls, susceptibility, self._material,
            ranges=self.world_ranges, magnets=magnets, lone=layout.alone, field=self._mutual, movable=layout.movable,
            turned=turned, forces=self.forces, torques=self.torques,
            expansion=None if self.applied is None else self.applied.expansion,
        )  # fmt: skip

    @property
    def radii(self):
        """Radii of the moments' balls [m], shape [n]."""
        return self._packed.radii

    @property
    def count(self) -> int:
        """Number of moments n."""
        return self._packed.count

    def forget(self):
        """Start the next solve cold, from no magnetization, in every world."""
        self._induction.warm.zero_()
        if self._near is not None:
            self._near.forget()

    def start_from(self, magnetizations):
        """Start the next solve from given magnetizations [A/m], a Warp array of vectors, shape [n]."""
        self.dynamics.start_from(magnetizations)

    def set_material(self, which, saturation, susceptibility):
        """Change what inducible moments are made of; curves stay. Waits for the device.

        Args:
            which: The moments.
            saturation: Their saturation magnetization Ms [A/m].
            susceptibility: Their susceptibility [dimensionless], may be infinite.

        Raises:
            InputError: The contact model has tables of what moments are made of, or a value is out of range.
        """
        if len(which) and self._near is not None:
            raise InputError(f"contact_model: {self.contact_model} has tables of materials, which cannot be changed")
        change_material(self._material, which, saturation, susceptibility, self.dtype)

    def conduct(self, conductivity, step: float):
        """Give the balls of single moments a conductivity [S/m], shape [n], for forces that count for ``step`` [s]."""
        turned, ranges = self._turned.numpy() == 0, [(first, last) for first, _, last in self.world_ranges]
        self.eddy = EddyCurrents(self._packed, ranges, conductivity, turned, self._material, step)
        if self.applied is not None:
            self.applied.follow(self.eddy.motion)

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays that one solve hands on to the next one, by name: with them in place it goes on alike."""
        parts = {"induction": solve_state.carried_arrays(self._induction), "pairs": self._packed.carried()}
        parts["dynamics"] = self.dynamics.carried()
        if self._near is not None:
            parts["near"] = self._near.carried()
        inner = {f"{part}.{name}": array for part, arrays in parts.items() for name, array in arrays.items()}
        material = {"saturation": self._material.saturation, "slope": self._material.slope}
        return {"moments": self.moments, **material, **inner}

    def solve(self):
        """Launch the induction solve: inducible ``moments`` in equilibrium with the field at ``positions``."""
        self.begin()
        if self._mutual.count:
            # no world is done before the first evaluation, and a loop costs a GPU more than what is in it
            iterate = self.iterate if self._ranks is None else self._iterate_together
            iterate()
            wp.capture_while(self._induction.condition, iterate)

    def begin(self):
        """Launch the start of a solve. Callers of :meth:`solve` do not need it; it serves to watch the iteration."""
        packed = self._packed
        packed.pack(self.positions, self.moments)
        if self.applied is not None:
            self.applied.launch()
        if self._near is not None:
            near_pairs.launch_find_pairs(self._near)
        packed.find_overlaps()
        self._fast.build()
        if self._applied.pair_count:
            self._applied.launch()
        elif self.bias is not None:
            wp.copy(self._induction.h0, self._magnetizing)
        if self.bias is not None:
            launch_add_bias(self.bias, self._biased, self._induction.h0)
        if self._mutual.count == 0:
            return
        if self._cells is not None:
            self._cells.start()
        self.dynamics.start()
        if self._near is not None:
            near_pairs.wait(self._near)

    def iterate(self):
        """Launch one field evaluation among the inducible moments and the step that follows from it."""
        self.dynamics.refine()
        self._sum_field()
        if self._cells is not None:
            self._cells.launch_others()
        self.dynamics.iterate()
        self._end_sweeps()

    def _iterate_together(self):
        """Launch :meth:`iterate` with the other ranks, on a GPU as a graph: what merges sums is in no loop of one."""
        if self._graph is None:
            self.iterate()
            if self.device.is_cuda:
                with wp.ScopedCapture(self.device) as capture:
                    self.iterate()
                self._graph = capture.graph
        else:
            wp.capture_launch(self._graph)

    def evaluate(self):
        """Launch one evaluation of ``h`` at the inducible moments, without a step; :meth:`solve` does not need it."""
        self._sum_field()
        if self._cells is not None:
            self._cells.launch()
        self._end_sweeps()

    def _sum_field(self):
        """Launch the evaluation of the field at the inducible moments; :meth:`_end_sweeps` follows."""
        near = self._near
        if near is None:
            self._mutual.launch()
        else:
            near_pairs.launch_sweeps(near)
            self._mutual.launch(wait=lambda: near_pairs.wait_for_field(near))

    def _end_sweeps(self):
        """Have what is launched next wait for what near contacts do beside."""
        if self._near is not None:
            near_pairs.wait(self._near)

    def field_error(self) -> float:
        """Relative error of the field by the fast multipole method at some moments, zero without it; waits.

        What else acts on moments, cells and near contacts, is in neither of the fields that are compared.
        """
        if self._mutual.count == 0 or GIVEN not in (self._applied.form, self._mutual.form):
            return 0.0
        base = wp.clone(self._magnetizing)
        if self.bias is not None:
            launch_add_bias(self.bias, self._biased, base)
        return sampled_error(self._among, self._packed, self.world_ranges, self._induction.h0, base)

    def magnetizations(self):
        """Magnetizations M [A/m] of all moments, a fresh array, shape [n]; zero for point dipoles."""
        m = wp.empty_like(self.moments)
        launch_divide_by_volume(self.moments, self._packed.radii, m)
        return m

    def energy(self) -> np.ndarray:
        """Energy of each world's moments as :meth:`solve` left them [J], float64, shape [worlds].

        That of magnetization curves and of all fields; its gradient by positions is minus Kelvin's force. Permanent
        moments of one body add a constant. Waits for the device.

        Raises:
            InputError: The contact model is not ``dipole``.
        """
        if self.contact_model != "dipole":
            raise InputError(f"contact_model: the energy of {self.contact_model} is not known, only that of dipole")
        if self._energies is None:
            self._energies = MomentEnergies(self._packed, self.world_ranges, self.moments)
        each = self._energies.of_each(self._material, self._induction, self._acting)
        if self.applied is not None:
            each += self.applied.energies()
        if self.bias is not None:  # counted from where nothing but the remanence is
            bias = np.linalg.norm(self.bias.numpy().astype(float), axis=1)
            volumes = 4.0 / 3.0 * np.pi * self.radii.numpy().astype(float) ** 3
            each += 0.5 * MU0 * volumes * self._material.slope.numpy() * bias**2
        return np.array([each[first:last].sum() for first, _, last in self.world_ranges])

    def apply_forces(self, force=None):
        """Launch forces and torques of the moments as :meth:`solve` left them; ``force`` overrides the law."""
        near, force = self._near, force or self._force
        check_force("force", force, "dipole" if near is None else "multipole")
        if force == "zeeman":
            launch_zeeman_moments(self._packed, self.h, self._material, self._effective)
        if self.eddy is not None:
            self.eddy.add(self._acting, self.applied, self._effective if force == "zeeman" else None)
        if near is not None:
            near_pairs.launch_begin_forces(near)
        for evaluation in self._wrench[force]:
            evaluation.launch()
        expanded = self.applied is not None and self.applied.expansion is not None
        if expanded:
            self.applied.expand()
        if near is not None:
            near_pairs.launch_add_forces(near)
        if self.applied is not None:
            effective = self._effective if force == "zeeman" else self._packed.moments
            self.applied.add(effective, self.forces, self.torques, near.arrays["response"] if expanded else None)
        if self.eddy is not None:
            self.eddy.finish(self.moments, self.torques)
