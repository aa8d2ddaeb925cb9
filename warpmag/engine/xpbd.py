"""Newton's XPBD, corrected for bodies that are pressed together, and one whose every run gives the same bits.

Corners of boxes that lie face to face together overshoot what each of them corrects, and turn the boxes by themselves.
Bodies that are no balls are therefore split among their contacts (``kernels.rigid.mass_splitting``), and the lever arms
of contact impulses are corrected (``kernels.rigid.lever_arms``).

Newton's solver adds up contacts with float atomics. Warp can make those ordered, by writing every term to memory and
sorting it, in each of the 60 iterations of each substep. But which contacts a body has does not change between
iterations: here they are sorted once a substep, and Newton's own kernel runs on a copy of the body for each side of
each contact (``kernels.rigid.ordered_sums``).
"""

import contextlib
from collections.abc import Iterator

import newton
import numpy as np
import warp as wp
from newton._src.solvers.xpbd.kernels import solve_body_contact_positions

from warpmag.kernels.rigid import ordered_sums
from warpmag.kernels.rigid.lever_arms import launch_average_velocities, launch_correct_lever_arms
from warpmag.kernels.rigid.mass_splitting import launch_split_masses
from warpmag.kernels.rigid.newton_views import BodyView, ContactView, view_contacts


class PileXPBD(newton.solvers.SolverXPBD):
    """Newton's XPBD with masses split among contacts, and with corrected lever arms of their impulses.

    Lever arms are not corrected in models with joints, particles, tendons or restitution, which take Newton's own
    steps.
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
        self._bodies = BodyView()
        self._bodies.deltas = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=model.device)
        self._impulses = self._velocities = None
        if splits.any() and self._rigid_only:
            self._impulses = wp.zeros(contact_max, dtype=wp.spatial_vector, device=model.device)
            self._velocities = wp.zeros_like(self._bodies.deltas)

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
            found, bodies = self._begin_contacts(contacts)
            arguments = self._relaxation_arguments(contacts, found, bodies, dt)
            outputs = [bodies.deltas, None, self._impulses]
            if self._impulses is not None:
                self._impulses.zero_()
                self._velocities.assign(motion[1])
            for _ in range(self.iterations):
                inputs = [*self._begin_iteration(*motion), *arguments]
                dim = contacts.rigid_contact_max
                wp.launch(solve_body_contact_positions, dim, inputs=inputs, outputs=outputs, device=model.device)
                motion = self._apply_body_deltas(model, state_in, state_out, self._sum_deltas(), dt)
            if self._impulses is not None:
                launch_average_velocities(motion[1], self._velocities)
                bodies.q, bodies.qd = self._begin_iteration(motion[0], self._velocities)
                launch_correct_lever_arms(found, self._impulses, dt, bodies)
                motion = self._apply_body_deltas(model, state_in, state_out, self._sum_deltas(), dt)
        if motion[0].ptr != state_out.body_q.ptr:
            state_out.body_q.assign(motion[0])
            state_out.body_qd.assign(motion[1])
        self.copy_kinematic_body_state(model, state_in, state_out)

    def _relaxation_arguments(self, contacts, found: ContactView, bodies: BodyView, dt) -> list:
        """Return the inputs of Newton's kernel that follow poses and velocities."""
        names = "count point0 point1 surface_velocity offset0 offset1 normal margin0 margin1"
        return [
            *(bodies.flags, bodies.com, bodies.inv_mass, bodies.inv_inertia, found.shape_body),
            *(getattr(contacts, f"rigid_contact_{name}") for name in names.split()),
            *(found.shape0, found.shape1, found.mu, found.mu_torsional, found.mu_rolling),
            *(self.rigid_contact_relaxation, dt),
        ]

    def _begin_contacts(self, contacts) -> tuple[ContactView, BodyView]:
        """Return the contacts of a substep and the bodies that they act on."""
        bodies, model = self._bodies, self.model
        bodies.com, bodies.flags = model.body_com, model.body_flags
        bodies.inv_mass, bodies.inv_inertia = self.body_inv_mass_effective, self.body_inv_inertia_effective
        return view_contacts(model, contacts), bodies

    def _begin_iteration(self, q, qd) -> tuple[wp.array, wp.array]:
        """Clear impulses; return poses and velocities of what contacts act on, for bodies with ``q`` and ``qd``."""
        self._bodies.deltas.zero_()
        return q, qd

    def _sum_deltas(self) -> wp.array:
        """Return what contacts did to each body of the model, shape [body_count]."""
        return self._bodies.deltas

    @contextlib.contextmanager
    def _splitting(self, state, contacts) -> Iterator[None]:
        """Let contacts act on their share of each body's mass."""
        if self._splits is None:
            yield
            return
        whole = self.body_inv_mass_effective, self.body_inv_inertia_effective
        found = view_contacts(self.model, contacts)
        launch_split_masses(found, state.body_q, self._splits, whole, self._counts, self._split)
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
        self._sides = ordered_sums.allocate(contact_max, model.body_count, model.device)

    def _begin_contacts(self, contacts) -> tuple[ContactView, BodyView]:
        ordered_sums.launch_split_contacts(*super()._begin_contacts(contacts), self._sides)
        return self._sides.contacts, self._sides.bodies

    def _begin_iteration(self, q, qd) -> tuple[wp.array, wp.array]:
        ordered_sums.launch_copy_motion(q, qd, self._sides)
        return self._sides.bodies.q, self._sides.bodies.qd

    def _sum_deltas(self) -> wp.array:
        ordered_sums.launch_sum_sides(self._sides, self._bodies.deltas)
        return self._bodies.deltas
