"""All magnetic moments of a simulation on one device: induction and forces, every buffer allocated once."""

import math

import numpy as np
import warp as wp

from warpmag.arrays import check_radii, resolve_device, resolve_dtype, vec3_type
from warpmag.dynamics import make_dynamics
from warpmag.errors import InputError
from warpmag.kernels.induction import solve_state
from warpmag.kernels.material.curves import CURVE_IDS, CurveParameters
from warpmag.kernels.near_contact import near_pairs
from warpmag.kernels.pairs import work_list as pair_loops
from warpmag.kernels.pairs.field import launch_field
from warpmag.kernels.pairs.packing import launch_divide_by_volume
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.kernels.pairs.wrench import FORCE_IDS, ZEEMAN, launch_wrench, launch_zeeman_moments
from warpmag.magnets import CONTACT_MODELS, check_force, check_rtol, check_token
from warpmag.packed import PackedMoments


class MomentSystem:
    """Moments that are brought to equilibrium and feel forces, again and again.

    Moments are ordered by world, and within a world inducible ones come first. Moments of different worlds never see
    each other. The methods only launch kernels: nothing is allocated, and nothing waits for the device, so that they
    can be captured in a graph; results stay on the device.

    Attributes:
        positions: Moment positions [m], shape [n]; written by the caller before :meth:`solve`.
        moments: Moments [A·m²], shape [n]; permanent ones written by the caller, inducible ones by :meth:`solve`.
        external_field: Applied field [A/m], shape [n]; may be changed by the caller.
        dynamics: What moves the inducible moments, an object of ``warpmag.dynamics``.
        h: Field at inducible moments [A/m], external and all other moments', shape [n].
        forces: Forces [N] on those that may move, shape [n], by :meth:`apply_forces`.
        torques: Torques e × H about each moment's position [N·m], e being m with Kelvin's law (see ``kernels.wrench``),
            shape [n]; zero for an inducible ball of one moment.
        error: Relative residual ‖M − f(H)‖/‖f(H)‖ of each world, the computable form of Eq. 12, shape [worlds].
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
        rtol=1e-3,
        max_evaluations=1000,
        step=None,
        damping=None,
        lone_torque=False,
        dtype="float32",
        device=None,
    ):
        """Allocate for n moments.

        Args:
            radii: Radii of the moments' balls [m], shape [n]. A moment's volume is its ball's.
            worlds: World of each moment, non-decreasing from 0, shape [n]; None means one world.
            permanent: Whether a moment is permanent, shape [n]; None means none is.
            bodies: Body of each moment, shape [n]; moments of one body exert no force on each other. None means each
                its own.
            movable: Whether the force on a moment is wanted, shape [n]; None means all.
            saturation: Saturation magnetization Ms [A/m], scalar or [n].
            susceptibility: Susceptibility [dimensionless], scalar or [n], may be infinite.
            curve: Magnetization curve, one of ``magnets.CURVES`` for all.
            external_field: Applied field [A/m], shape [3] or [n, 3].
            force: ``kelvin`` or ``zeeman``.
            dynamics: ``theta``: the exact flow, accelerated; or one of its rivals, explicit steps of pairs of
                submagnetizations: ``theta-euler``, ``llg``, ``llg-damping`` (see ``kernels.submagnetization``).
            contact_model: ``dipole``; or ``multipole``, which adds what inducible bodies of one moment lack where they
                nearly touch (see ``warpmag.kernels.near_contact``).
            rtol: Relative residual at which induction ends.
            max_evaluations: Field evaluations after which it gives up, with ``converged`` 0.
            step: Step κ = βΔtMs [dimensionless] of an explicit dynamics; None means its default.
            damping: Damping α [dimensionless] of ``llg``; None means its default.
            lone_torque: Whether an inducible body of one moment gets its torque m × H, which only tells how far the
                solve is from converged: in equilibrium the two are parallel.
            dtype: ``float32`` or ``float64``.
            device: Warp device; None means Warp's default.

        Raises:
            InputError: An argument is out of range.
        """
        check_token("contact_model", contact_model, CONTACT_MODELS)
        check_force("force", force, contact_model)
        check_token("curve", curve, tuple(CURVE_IDS))
        self.device, self.dtype = resolve_device(device), resolve_dtype(dtype)
        check_rtol("rtol", rtol, dtype)
        if max_evaluations < 1:
            raise InputError(f"max_evaluations: must be at least 1, got {max_evaluations}")
        n = len(radii)
        radii = np.asarray(radii, float)
        check_radii("radii", radii, self.dtype)
        worlds = np.zeros(n, int) if worlds is None else np.asarray(worlds)
        permanent = np.zeros(n, bool) if permanent is None else np.asarray(permanent, bool)
        bodies = np.arange(n) if bodies is None else np.asarray(bodies)
        movable = np.ones(n, bool) if movable is None else np.asarray(movable, bool)
        self.rtol, self.max_evaluations, self._force_law = float(rtol), int(max_evaluations), FORCE_IDS[force]

        vec3 = vec3_type(self.dtype)
        self.positions = wp.zeros(n, dtype=vec3, device=self.device)
        self.moments = wp.zeros(n, dtype=vec3, device=self.device)
        self.forces = wp.zeros(n, dtype=vec3, device=self.device)
        self.torques = wp.zeros(n, dtype=vec3, device=self.device)
        self.external_field = wp.array(np.broadcast_to(external_field, (n, 3)), dtype=vec3, device=self.device)
        self._packed = PackedMoments(
            wp.array(radii, dtype=self.dtype, device=self.device),
            largest_radius=float(radii.max(initial=0.0)),
            labels=bodies,
            groups=worlds,
        )
        self._make_material(permanent, saturation, susceptibility, curve)
        # the only moment of a body, if inducible, is parallel to the field that turns it
        _, body, size = np.unique(bodies, return_inverse=True, return_counts=True)
        twisted = permanent | (size[body] > 1) | lone_torque
        self._twisted = wp.array(twisted.astype(np.int32), dtype=wp.int32, device=self.device)
        self._make_rows(worlds, permanent, movable, twisted, near=contact_model == "multipole")
        self._effective = wp.zeros((3, n), dtype=self.dtype, device=self.device)
        self._induction = solve_state.allocate(worlds, ~permanent, self.dtype, self.device)
        self._near = None
        if contact_model == "multipole":
            lone = ~permanent & (size[body] == 1) & (radii > 0.0)
            susceptibility = np.broadcast_to(np.asarray(susceptibility, float), n)
            saturation = np.broadcast_to(np.asarray(saturation, float), n)
            self._near = near_pairs.allocate(
                self._packed, worlds, lone, susceptibility, saturation, CURVE_IDS[curve], rows=self._induced,
                partial=self._induced_partial, movable=movable, twisted=twisted, forces=self.forces,
                torques=self.torques,
            )  # fmt: skip
        self.h = self._induction.h
        self.error = self._induction.error
        self.evaluations = self._induction.evaluations
        self.converged = self._induction.converged
        solve_state.bind(self._induction, self._packed, self._material, self.moments, self.rtol, self.max_evaluations)
        if not self._applied.pair_count:
            self._induction.h0 = self.external_field
        self.dynamics = make_dynamics(dynamics, self._induction, step=step, damping=damping)

    def _make_material(self, permanent, saturation, susceptibility, curve):
        n = len(permanent)
        susceptibility = np.broadcast_to(np.asarray(susceptibility, float), n)

        def put(values, dtype):
            return wp.array(np.ascontiguousarray(np.broadcast_to(values, n)), dtype=dtype, device=self.device)

        self._material = CurveParameters(
            inducible=put((~permanent).astype(np.int32), wp.int32),
            saturation=put(np.asarray(saturation, float), self.dtype),
            slope=put(3.0 / (1.0 + 3.0 / susceptibility), self.dtype),
            curve=put(np.int32(CURVE_IDS[curve]), wp.int32),
        )

    def _make_rows(self, worlds, permanent, movable, twisted, near):
        """Work lists: inducible on inducible, permanent on inducible, everything on whatever moves."""
        induced, applied, pushed, turned = [], [], [], []
        for w in range(int(worlds[-1]) + 1 if len(worlds) else 0):
            first, last = np.searchsorted(worlds, [w, w + 1])
            middle = first + int(np.count_nonzero(~permanent[first:last]))
            induced.append((first, middle, first, middle))
            applied.append((first, middle, middle, last))
            for felt, which in ((pushed, movable & ~twisted), (turned, movable & twisted)):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], which[first:last].astype(int), [0]])))
                felt += [(first + a, first + b, first, last) for a, b in edges.reshape(-1, 2)]
        # near contacts add to partial sums
        forms = (pair_loops.LOOP, pair_loops.MIRRORED) if near else pair_loops.FORMS
        self._induced = pair_loops.make_rows(induced, self.device, forms=forms)
        self._applied = pair_loops.make_rows(applied, self.device, forms=(pair_loops.LOOP,))
        # those that are turned, too, come last: the loop over the others may bring what pushes them
        self._felt = {
            law: [
                pair_loops.make_rows(segments, self.device, quantity)
                for segments, quantity in ((pushed, push), (turned, Quantity.WRENCH))
                if segments
            ]
            for law, push in ((FORCE_IDS["kelvin"], Quantity.MUTUAL_FORCE), (ZEEMAN, Quantity.FORCE))
        }

        def partial(rows, more=0):
            splits, count, width = pair_loops.partial_shape(rows)
            return wp.zeros((splits + more, count, width), dtype=self.dtype, device=self.device)

        # and one of the near contacts
        self._induced_partial = partial(self._induced, int(near))
        self._applied_partial = partial(self._applied)
        self._felt_partial = {law: [partial(rows) for rows in passes] for law, passes in self._felt.items()}

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

    def solve(self):
        """Launch the induction solve: inducible ``moments`` in equilibrium with the field at ``positions``."""
        self.begin()
        if self._induced.count:
            # no world is done before the first evaluation, and a loop costs a GPU more than what is in it
            self.iterate()
            wp.capture_while(self._induction.condition, self.iterate)

    def begin(self):
        """Launch the start of a solve. Callers of :meth:`solve` do not need it; it serves to watch the iteration."""
        packed = self._packed
        packed.pack(self.positions, self.moments)
        if self._near is not None:
            near_pairs.launch_find_pairs(self._near)
        packed.find_overlaps()
        if self._induced.count == 0:
            return
        if self._applied.pair_count:
            pair_loops.launch_pair_loop(self._applied, packed.packed, packed.packed, self._applied_partial)
            h0 = self._induction.h0
            launch_field(self._applied, self._applied_partial, packed, packed, False, self.external_field, h0)
        self.dynamics.start()
        if self._near is not None:
            near_pairs.wait(self._near)

    def iterate(self):
        """Launch one field evaluation among the inducible moments and the step that follows from it."""
        self.dynamics.refine()
        self._sum_field()
        self.dynamics.iterate()
        self._end_sweeps()

    def evaluate(self):
        """Launch one evaluation of ``h`` at the inducible moments, without a step; :meth:`solve` does not need it."""
        self._sum_field()
        self._end_sweeps()

    def _sum_field(self):
        """Launch the sums of the field at the inducible moments; :meth:`_end_sweeps` follows."""
        packed, near, h0 = self._packed, self._near, self._induction.h0
        if near is not None:
            near_pairs.launch_sweeps(near)
        pair_loops.launch_pair_loop(self._induced, packed.packed, packed.packed, self._induced_partial)
        if near is not None:
            near_pairs.wait_for_field(near)
        launch_field(self._induced, self._induced_partial, packed, packed, True, h0, self.h)

    def _end_sweeps(self):
        """Have what is launched next wait for what near contacts do beside."""
        if self._near is not None:
            near_pairs.wait(self._near)

    def magnetizations(self):
        """Magnetizations M [A/m] of all moments, a fresh array, shape [n]; zero for point dipoles."""
        m = wp.empty_like(self.moments)
        launch_divide_by_volume(self.moments, self._packed.radii, m)
        return m

    def apply_forces(self, force=None):
        """Launch forces and torques of the moments as :meth:`solve` left them; ``force`` overrides the law."""
        packed, near = self._packed, self._near
        if force is not None:
            check_force("force", force, "dipole" if near is None else "multipole")
        law = self._force_law if force is None else FORCE_IDS[force]
        felt = self._felt[law]
        effective = packed.moments
        if law == ZEEMAN:
            effective = self._effective
            launch_zeeman_moments(packed, self.h, self._material, effective)
        if near is not None:
            near_pairs.launch_sweeps(near)
        for rows, partial in zip(felt, self._felt_partial[law], strict=True):
            pair_loops.launch_pair_loop(rows, packed.packed, packed.packed, partial, effective=effective)
            launch_wrench(
                rows,
                partial,
                packed,
                effective,
                self.external_field,
                self._twisted,
                self.forces,
                self.torques,
            )
        if near is not None:
            near_pairs.wait(near)
            near_pairs.launch_add_forces(near)
