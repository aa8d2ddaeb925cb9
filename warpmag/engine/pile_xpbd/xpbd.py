"""Newton's XPBD with a contact solver for piles that conserves momentum and is bitwise repeatable.

Newton's solver launches every iteration over the whole contact buffer and sums with atomics, in an order that differs
between runs. Here ``kernels.contacts.solve`` moves free bodies. It enforces the same contact conditions, processes
active contacts only, and sums in a fixed order. It conserves momentum and angular momentum, which Newton's lever arms
and damping of spins do not. It needs half the iterations (``kernels/contacts/contact_law.h``).

Where no impulse overshoots, the result equals Newton's. In heaps impulses overshoot. Newton never reduces them, so that
its result depends on the relaxation factor. Here impulses without friction are the smallest that leave no overlap, and
impulses with friction satisfy Coulomb's law. Sticking contacts store their slip distance, so that heaps do not
creep. Overlapping bodies are moved apart at 2 m/s at most.

Contacts at the corners of boxes that lie face to face overshoot together. The mass of each body is therefore split
among its contacts (``kernels.contacts.mass_splitting``).
"""

import contextlib
from collections.abc import Iterator

import newton
import numpy as np
import warp as wp

from warpmag.engine.newton_versions import has_joint_kernels, has_moving_surfaces, has_tendons
from warpmag.engine.pile_xpbd.broad_phase import are_colliding
from warpmag.engine.pile_xpbd.joints import JointSolve
from warpmag.kernels.contacts import solve as contact_solve
from warpmag.kernels.contacts.free_motion import launch_accelerate, launch_apply_corrections, launch_move
from warpmag.kernels.contacts.mass_splitting import ENTRIES, launch_find_shares, launch_split_masses
from warpmag.kernels.rigid.newton_views import BodyView, view_bodies, view_contacts

_KINEMATIC = int(newton.BodyFlags.KINEMATIC)
_SIMILAR = 0.1
"""Relative spread of radii and inverse masses up to which the masses of balls are not split."""


class PileXPBD(newton.solvers.SolverXPBD):
    """Newton's XPBD with masses split among contacts, and impulses that conserve momentum and angular momentum.

    The step depends on the model:

    * rigid bodies without joints, or with free joints only: ``kernels.contacts.solve``;
    * other joints: :mod:`warpmag.engine.pile_xpbd.joints`;
    * particles, tendons, restitution, moving surfaces, mimic joints, and joints in Newton before 1.8: Newton's own
      step, with split masses.
    """

    def __init__(self, model: newton.Model, contact_max: int, *, contact_iterations: int | None = None, **settings):
        """Set up Newton's solver with ``settings``, for contact buffers of ``contact_max`` entries.

        ``kernels.contacts.solve`` runs ``contact_iterations``, by default Newton's ``iterations``.
        """
        super().__init__(model, **settings)
        split_bodies = _find_split_bodies(model, self.body_inv_mass_effective.numpy())
        self._split_bodies = None
        if split_bodies.any():
            self._split_bodies = wp.array(split_bodies, dtype=wp.int32, device=model.device)
            self._entries = wp.zeros((ENTRIES, model.body_count), dtype=wp.int32, device=model.device)
            self._shares = wp.ones(model.body_count, dtype=float, device=model.device)
            self._split_masses = wp.empty_like(model.body_inv_mass), wp.empty_like(model.body_inv_inertia)
        self._contact_iterations = contact_iterations or self.iterations
        newton_only = model.particle_count, has_tendons(model), self.enable_restitution
        self._solve = self._joints = self._free_dofs = None
        plain = not any(newton_only) and not self.rigid_contact_con_weighting
        if plain and (free_dofs := _free_dofs(model)) is not None:
            bodies = self._view_bodies(model.state())
            self._solve = contact_solve.allocate(contact_max, bodies, kinematic_flag=_KINEMATIC)
            if model.joint_count:
                self._free_dofs = wp.array(free_dofs, dtype=wp.int32, device=model.device)
        elif plain and has_joint_kernels(self):
            relaxations = {"contact_relaxation": self.rigid_contact_relaxation}
            relaxations["joint_relaxation"] = self.joint_linear_relaxation
            self._joints = JointSolve(model, contact_max, iterations=self.iterations, **relaxations)

    def step(self, state_in, state_out, control, contacts, dt, **options) -> None:
        """Advance by ``dt`` [s]; takes the arguments of Newton's solver, and ``options`` of its own step."""
        if self._solve is not None and not has_moving_surfaces(contacts):
            self._step_bodies(state_in, state_out, control, contacts, dt)
            return
        if self._joints is not None:
            self._step_joints(state_in, state_out, control, contacts, dt)
            return
        self._find_shares(self._view_bodies(state_in), contacts, dt)
        with self._splitting():
            super().step(state_in, state_out, control, contacts, dt, **options)

    def persistent_arrays(self) -> dict[str, wp.array]:
        """Return the arrays that the next substep depends on, by name."""
        return {} if self._solve is None else self._solve.persistent_arrays()

    def forget(self, mask: wp.array) -> None:
        """Discard what the next substep would reuse of the last one, in worlds that a complete mask chooses."""
        if self._solve is not None:
            contact_solve.launch_forget_slips(self._solve, mask, self.model.body_world)

    def _step_bodies(self, state_in, state_out, control, contacts, dt) -> None:
        assert self._solve is not None
        before, after = self._view_bodies(state_in), self._view_bodies(state_out)
        forces = () if control is None or self._free_dofs is None else (self._free_dofs, control.joint_f)
        launch_accelerate(before, self.model.gravity, _KINEMATIC, dt, after.q, after.qd, *forces)
        self._find_shares(after, contacts, dt)
        contact_solve.launch_solve_contacts(
            self._solve, view_contacts(self.model, contacts), after,
            None if self._split_bodies is None else self._shares,
            iterations=self._contact_iterations, relaxation=self.rigid_contact_relaxation, dt=dt,
        )  # fmt: skip
        launch_move(after, _KINEMATIC, dt)

    def _find_shares(self, bodies: BodyView, contacts, dt: float) -> None:
        if self._split_bodies is not None:
            buffers, relaxation = (self._split_bodies, self._entries, self._shares), self.rigid_contact_relaxation
            launch_find_shares(view_contacts(self.model, contacts), bodies, *buffers, relaxation=relaxation, dt=dt)

    def _step_joints(self, state_in, state_out, control, contacts, dt) -> None:
        assert self._joints is not None
        before, after = self._view_bodies(state_in), self._view_bodies(state_out)
        control = control or self.model.control(clone_variables=False)

        def contact_masses():
            self._find_shares(after, contacts, dt)
            return self._contact_masses()

        self._joints.step(before, after, contact_masses, control, contacts, dt)

    def _view_bodies(self, state) -> BodyView:
        """Return the bodies with their effective masses, infinite for kinematic bodies."""
        bodies = view_bodies(self.model, state)
        bodies.inv_mass, bodies.inv_inertia = self.body_inv_mass_effective, self.body_inv_inertia_effective
        return bodies

    @contextlib.contextmanager
    def _splitting(self) -> Iterator[None]:
        """Replace the masses in Newton's contacts by the split masses within the context."""
        self._unsplit_masses = self.body_inv_mass_effective, self.body_inv_inertia_effective
        self.body_inv_mass_effective, self.body_inv_inertia_effective = self._contact_masses()
        try:
            yield
        finally:
            self.body_inv_mass_effective, self.body_inv_inertia_effective = self._unsplit_masses

    def _contact_masses(self) -> tuple[wp.array, wp.array]:
        """Return the inverse masses and inertias for contacts, split where bodies are split."""
        unsplit = self.body_inv_mass_effective, self.body_inv_inertia_effective
        if self._split_bodies is None:
            return unsplit
        launch_split_masses(self._shares, unsplit, self._split_masses)
        return self._split_masses

    def _apply_body_deltas(self, model, state_in, state_out, body_deltas, dt, rigid_contact_inv_weight=None):
        """Apply the impulses of an iteration to the unsplit bodies. Newton's version stops slow bodies."""
        # the two states alternate
        source, target = (state_in, state_out) if self._body_delta_counter else (state_out, state_in)
        self._body_delta_counter = 1 - self._body_delta_counter
        bodies = view_bodies(model, source)
        bodies.inv_mass, bodies.inv_inertia = self._unsplit_masses
        launch_apply_corrections(bodies, body_deltas, rigid_contact_inv_weight, dt, target.body_q, target.body_qd)
        return target.body_q, target.body_qd


def _free_dofs(model: newton.Model) -> np.ndarray | None:
    """Return the first degree of freedom of each body's free joint, -1 without a free joint, shape [body_count].

    Return None if the model has other joints, or free joints between two bodies.
    """
    dofs, joints = np.full(model.body_count, -1), model.joint_count
    if joints:
        if (model.joint_type.numpy() != newton.JointType.FREE).any() or (model.joint_parent.numpy() >= 0).any():
            return None
        first = np.where(model.joint_enabled.numpy(), model.joint_qd_start.numpy()[:joints], -1)
        np.put(dofs, model.joint_child.numpy(), first)
    return dofs


def _find_split_bodies(model: newton.Model, inv_mass: np.ndarray) -> np.ndarray:
    """Return 1 for each body with a mass to split among contacts, else 0, shape [body_count].

    If all balls are similar, their masses are not split: two similar balls share each correction equally.
    """
    shape_body, types = model.shape_body.numpy(), model.shape_type.numpy()
    on_body = are_colliding(model) & (shape_body >= 0)
    shapes = np.bincount(shape_body[on_body], minlength=model.body_count)
    is_ball = on_body & (types == newton.GeoType.SPHERE)
    balls = (shapes == 1) & (np.bincount(shape_body[is_ball], minlength=model.body_count) == 1) & (inv_mass > 0.0)
    radii = np.zeros(model.body_count)
    np.put(radii, shape_body[is_ball], model.shape_scale.numpy()[is_ball, 0])
    similar = not any(np.ptp(x[balls]) > _SIMILAR * np.max(x[balls]) for x in (radii, inv_mass) if balls.any())
    return ((inv_mass > 0.0) & (shapes > 0) & ~(balls & similar)).astype(np.int32)
