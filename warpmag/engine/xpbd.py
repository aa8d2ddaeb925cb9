"""Newton's XPBD, mended for bodies that are pressed together, and one whose every run gives the same bits.

Corners of boxes that lie face to face overshoot together what each of them corrects, and turn the boxes by themselves.
Bodies that are no balls are therefore split among their contacts (``kernels.mass_splitting``), and the levers of these
are put right (``kernels.contact_levers``).

Newton's solver adds up contacts with float atomics. Warp can make those ordered, by writing every term to memory and
sorting it, in each of the 60 iterations of each substep. But which contacts a body has does not change between
iterations: here they are sorted once a substep, and Newton's own kernel runs on a copy of the body for each side of
each contact (``kernels.contact_sides``).
"""

import contextlib
from collections.abc import Iterator

import newton
import numpy as np
import warp as wp
from newton._src.solvers.xpbd.kernels import solve_body_contact_positions

from warpmag.kernels.rigid import contact_sides
from warpmag.kernels.rigid.contact_sides import ContactBodies
from warpmag.kernels.rigid.levers import launch_correct_levers, launch_take_mean
from warpmag.kernels.rigid.mass_splitting import launch_split_masses


class PileXPBD(newton.solvers.SolverXPBD):
    """Newton's XPBD with masses split among contacts, and with their levers put right.

    Levers are left as they are in models with joints, particles, tendons or restitution, which take Newton's own steps.
    """

    def __init__(self, model: newton.Model, contact_max: int, **settings):
        """Set up the solver.

        Args:
            model: The model.
            contact_max: Most contacts.
            settings: Those of Newton's solver.
        """
        super().__init__(model, **settings)
        splits = ~_single_balls(model)
        self._splits = wp.array(splits.astype(np.int32), dtype=wp.int32, device=model.device) if splits.any() else None
        self._counts = wp.zeros(model.body_count, dtype=wp.int32, device=model.device)
        self._split = wp.empty_like(model.body_inv_mass), wp.empty_like(model.body_inv_inertia)
        others = model.joint_count, model.particle_count, model.tendon_segment_count, self.enable_restitution
        self._rigid_only = not any(others)
        self._deltas = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=model.device)
        self._impulses = self._velocities = None
        if splits.any() and self._rigid_only:
            self._impulses = wp.zeros(contact_max, dtype=wp.spatial_vector, device=model.device)
            self._velocities = wp.zeros_like(self._deltas)

    def step(self, state_in, state_out, control, contacts, dt, *, observables=None) -> None:
        """Advance by ``dt`` [s]; as Newton's."""
        if self._rigid_only:
            self._step_bodies(state_in, state_out, contacts, dt)
            return
        with self._splitting(state_in, contacts):
            super().step(state_in, state_out, control, contacts, dt, observables=observables)

    def _step_bodies(self, state_in, state_out, contacts, dt) -> None:
        model = self.model
        self._apply_module_options()
        self._body_delta_counter = 0
        self.integrate_bodies(model, state_in, state_out, dt, self.angular_damping)
        motion = state_out.body_q, state_out.body_qd
        with self._splitting(state_in, contacts):
            self._take_apart(contacts)
            if self._impulses is not None:
                self._impulses.zero_()
                self._velocities.assign(motion[1])
            for _ in range(self.iterations):
                bodies = self._contact_bodies(*motion, contacts)
                self._launch_contacts(bodies, contacts, dt)
                motion = self._apply_body_deltas(model, state_in, state_out, self._add_up(bodies), dt)
            if self._impulses is not None:
                launch_take_mean(motion[1], self._velocities)
                bodies = self._contact_bodies(motion[0], self._velocities, contacts)
                launch_correct_levers(contacts, self._impulses, bodies, dt)
                motion = self._apply_body_deltas(model, state_in, state_out, self._add_up(bodies), dt)
        if motion[0].ptr != state_out.body_q.ptr:
            state_out.body_q.assign(motion[0])
            state_out.body_qd.assign(motion[1])
        self.copy_kinematic_body_state(model, state_in, state_out)

    def _launch_contacts(self, bodies: ContactBodies, contacts, dt) -> None:
        """Relax all contacts once."""
        wp.launch(
            solve_body_contact_positions,
            dim=contacts.rigid_contact_max,
            inputs=[
                bodies.q,
                bodies.qd,
                bodies.flags,
                bodies.com,
                bodies.inv_mass,
                bodies.inv_inertia,
                bodies.shape_body,
                contacts.rigid_contact_count,
                contacts.rigid_contact_point0,
                contacts.rigid_contact_point1,
                contacts.rigid_contact_surface_velocity,
                contacts.rigid_contact_offset0,
                contacts.rigid_contact_offset1,
                contacts.rigid_contact_normal,
                contacts.rigid_contact_margin0,
                contacts.rigid_contact_margin1,
                bodies.first,
                bodies.second,
                bodies.mu,
                bodies.mu_torsional,
                bodies.mu_rolling,
                self.rigid_contact_relaxation,
                dt,
            ],
            outputs=[bodies.deltas, None, self._impulses],
            device=self.model.device,
        )

    def _take_apart(self, contacts) -> None:
        """Prepare what :meth:`_contact_bodies` returns, once a substep."""

    def _contact_bodies(self, q, qd, contacts) -> ContactBodies:
        """Return what contacts act on, where ``q`` and ``qd`` are, with nothing added up yet."""
        model = self.model
        self._deltas.zero_()
        return ContactBodies(
            q=q,
            qd=qd,
            com=model.body_com,
            inv_mass=self.body_inv_mass_effective,
            inv_inertia=self.body_inv_inertia_effective,
            flags=model.body_flags,
            first=contacts.rigid_contact_shape0,
            second=contacts.rigid_contact_shape1,
            shape_body=model.shape_body,
            mu=model.shape_material_mu,
            mu_torsional=model.shape_material_mu_torsional,
            mu_rolling=model.shape_material_mu_rolling,
            deltas=self._deltas,
        )

    def _add_up(self, bodies: ContactBodies) -> wp.array:
        """Return what contacts did to each body of the model, shape [body_count]."""
        return bodies.deltas

    @contextlib.contextmanager
    def _splitting(self, state, contacts) -> Iterator[None]:
        """Let contacts see their share of each body's mass."""
        if self._splits is None:
            yield
            return
        whole = self.body_inv_mass_effective, self.body_inv_inertia_effective
        launch_split_masses(self.model, state, contacts, self._splits, *whole, self._counts, *self._split)
        with self._masses(self._split):
            self._whole = whole
            yield

    def _apply_body_deltas(self, *arguments, **options):
        """Move whole bodies by what contacts did to their shares."""
        if self._splits is None:
            return super()._apply_body_deltas(*arguments, **options)
        with self._masses(self._whole):
            return super()._apply_body_deltas(*arguments, **options)

    @contextlib.contextmanager
    def _masses(self, masses) -> Iterator[None]:
        before = self.body_inv_mass_effective, self.body_inv_inertia_effective
        self.body_inv_mass_effective, self.body_inv_inertia_effective = masses
        try:
            yield
        finally:
            self.body_inv_mass_effective, self.body_inv_inertia_effective = before


def _single_balls(model: newton.Model) -> np.ndarray:
    """Return which bodies are one ball, as far as they collide, or nothing at all, shape [body_count]."""
    colliding = (model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES) != 0
    shape_body, types = model.shape_body.numpy(), model.shape_type.numpy()
    shapes = np.bincount(shape_body[colliding & (shape_body >= 0)], minlength=model.body_count)
    others = np.bincount(
        shape_body[colliding & (shape_body >= 0) & (types != newton.GeoType.SPHERE)], minlength=model.body_count
    )
    return (shapes <= 1) & (others == 0)


class OrderedXPBD(PileXPBD):
    """The same for rigid bodies in contact, without joints, particles and restitution; sums have an order.

    With contacts in the same order it gives the same as :class:`PileXPBD` does on a CPU, bit by bit.
    """

    def __init__(self, model: newton.Model, contact_max: int, **settings):
        """Set up the solver; arguments as those of :class:`PileXPBD`."""
        super().__init__(model, contact_max, **settings)
        self._sides = contact_sides.allocate(contact_max, model.body_count, model.device)

    def _take_apart(self, contacts) -> None:
        contact_sides.launch_split_contacts(
            self.model, contacts, self.body_inv_mass_effective, self.body_inv_inertia_effective, self._sides
        )

    def _contact_bodies(self, q, qd, contacts) -> ContactBodies:
        sides = self._sides
        contact_sides.launch_copy_motion(q, qd, sides)
        return ContactBodies(
            q=sides.q,
            qd=sides.qd,
            com=sides.com,
            inv_mass=sides.inv_mass,
            inv_inertia=sides.inv_inertia,
            flags=sides.flags,
            first=sides.first,
            second=sides.second,
            shape_body=sides.side_body,
            mu=sides.mu,
            mu_torsional=sides.mu_torsional,
            mu_rolling=sides.mu_rolling,
            deltas=sides.deltas,
        )

    def _add_up(self, bodies: ContactBodies) -> wp.array:
        contact_sides.launch_sum_sides(self._sides, self._deltas)
        return self._deltas
