"""Newton's XPBD, made to converge for bodies with many contacts, and one whose every run gives the same bits.

Corners of boxes that lie face to face overshoot together what each of them corrects. Bodies that are no balls are
therefore split among their contacts (``kernels.mass_splitting``).

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

from warpmag.kernels import contact_sides
from warpmag.kernels.mass_splitting import launch_split_masses


class SplittingXPBD(newton.solvers.SolverXPBD):
    """Newton's XPBD with masses split among contacts."""

    def __init__(self, model: newton.Model, **settings):
        """Set up the solver with the settings of Newton's."""
        super().__init__(model, **settings)
        splits = ~_single_balls(model)
        self._splits = wp.array(splits.astype(np.int32), dtype=wp.int32, device=model.device) if splits.any() else None
        self._counts = wp.zeros(model.body_count, dtype=wp.int32, device=model.device)
        self._split = wp.empty_like(model.body_inv_mass), wp.empty_like(model.body_inv_inertia)

    def step(self, state_in, state_out, control, contacts, dt, **options) -> None:
        """Advance by ``dt`` [s]; as Newton's."""
        with self._splitting(state_in, contacts):
            super().step(state_in, state_out, control, contacts, dt, **options)

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


class OrderedXPBD(SplittingXPBD):
    """The same for rigid bodies in contact, without joints, particles and restitution; sums have an order.

    With contacts in the same order it gives the same as :class:`SplittingXPBD` does on a CPU, bit by bit.
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
        with self._splitting(state_in, contacts):
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
