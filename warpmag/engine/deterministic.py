"""XPBD whose every run gives the same bits, on a GPU too.

Newton's solver adds up contacts with float atomics. Warp can make those ordered, by writing every term to memory and
sorting it, in each of the 60 iterations of each substep. But which contacts a body has does not change between
iterations: here they are sorted once a substep, and Newton's own kernel runs on a copy of the body for each side of
each contact (``kernels.contact_sides``).
"""

import newton
import warp as wp
from newton._src.solvers.xpbd.kernels import solve_body_contact_positions

from warpmag.kernels import contact_sides


class OrderedXPBD(newton.solvers.SolverXPBD):
    """Newton's XPBD for rigid bodies in contact, without joints, particles and restitution; sums have an order.

    With contacts in the same order it gives the same as Newton's does on a CPU, bit by bit.
    """

    def __init__(self, model: newton.Model, contact_max: int, **settings):
        """Set up the solver.

        Args:
            model: The model.
            contact_max: Most contacts.
            settings: Those of Newton's solver.
        """
        super().__init__(model, **settings)
        self._sides = contact_sides.allocate(contact_max, model.body_count, model.device)
        self._deltas = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=model.device)

    def step(self, state_in, state_out, control, contacts, dt, *, observables=None) -> None:
        """Advance by ``dt`` [s]; as Newton's."""
        model = self.model
        self._apply_module_options()
        self._body_delta_counter = 0
        self.integrate_bodies(model, state_in, state_out, dt, self.angular_damping)
        contact_sides.launch_split_contacts(
            model, contacts, self.body_inv_mass_effective, self.body_inv_inertia_effective, self._sides
        )
        body_q, body_qd = state_out.body_q, state_out.body_qd
        for _ in range(self.iterations):
            self._solve_contacts(body_q, body_qd, contacts, dt)
            body_q, body_qd = self._apply_body_deltas(model, state_in, state_out, self._deltas, dt)
        if body_q.ptr != state_out.body_q.ptr:
            state_out.body_q.assign(body_q)
            state_out.body_qd.assign(body_qd)
        self.copy_kinematic_body_state(model, state_in, state_out)

    def _solve_contacts(self, body_q, body_qd, contacts, dt) -> None:
        sides = self._sides
        contact_sides.launch_copy_motion(body_q, body_qd, sides)
        wp.launch(
            solve_body_contact_positions,
            dim=contacts.rigid_contact_max,
            inputs=[
                sides.q,
                sides.qd,
                sides.flags,
                sides.com,
                sides.inv_mass,
                sides.inv_inertia,
                sides.side_body,
                contacts.rigid_contact_count,
                contacts.rigid_contact_point0,
                contacts.rigid_contact_point1,
                contacts.rigid_contact_surface_velocity,
                contacts.rigid_contact_offset0,
                contacts.rigid_contact_offset1,
                contacts.rigid_contact_normal,
                contacts.rigid_contact_margin0,
                contacts.rigid_contact_margin1,
                sides.first,
                sides.second,
                sides.mu,
                sides.mu_torsional,
                sides.mu_rolling,
                self.rigid_contact_relaxation,
                dt,
            ],
            outputs=[sides.deltas, None, None],
            device=self.model.device,
        )
        contact_sides.launch_sum_sides(sides, self._deltas)
