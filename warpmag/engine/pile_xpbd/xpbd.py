"""Newton's XPBD, corrected for bodies that are pressed together, whose work follows contacts.

Corners of boxes that lie face to face together overshoot what each of them corrects. Bodies are therefore split among
their contacts (``kernels.contacts.mass_splitting``).

Newton's solver launches every iteration over all contacts that its buffers may hold, and adds them up with atomics, in
another order in every run. Rigid bodies are moved by ``kernels.contacts.solve`` instead, which solves the same
conditions and gives the same bits in every run. It keeps momentum and angular momentum, which Newton's lever arms and
its damping of spins do not, and needs half the iterations (``kernels/contacts/contact_law.h``). What sticks stays
where it
is, since contacts remember how far they slipped. Bodies that were put into each other are pushed apart at 2 m/s at
most. Its end is Newton's own where no push overshoots. In heaps
Newton's pushes do, stay, and make its end depend on its relaxation: without friction these are the least that leave no
overlap, with friction they meet Coulomb's law.
"""

import contextlib
from collections.abc import Iterator

import newton
import numpy as np
import warp as wp

from warpmag.engine.pile_xpbd.joints import JointSolve
from warpmag.kernels.contacts import solve as contact_solve
from warpmag.kernels.contacts.free_motion import launch_accelerate, launch_move
from warpmag.kernels.contacts.joints import launch_move_by
from warpmag.kernels.contacts.mass_splitting import ENTRIES, launch_find_shares, launch_split_masses
from warpmag.kernels.rigid.newton_views import BodyView, view_bodies, view_contacts

_KINEMATIC = int(newton.BodyFlags.KINEMATIC)
_ALIKE = 0.1
"""Part by which radii and inverse masses of balls may differ that count as alike."""


class PileXPBD(newton.solvers.SolverXPBD):
    """Newton's XPBD with masses split among contacts, whose impulses keep momentum and angular momentum.

    Models with joints, free ones apart, take the steps of :mod:`warpmag.engine.pile_xpbd.joints`, and those with
    particles, tendons, restitution, moving surfaces or joints that mimic others Newton's own, with split masses.
    """

    def __init__(self, model: newton.Model, contact_max: int, *, contact_iterations: int | None = None, **settings):
        """Set up the solver.

        Args:
            model: The model.
            contact_max: Most contacts.
            contact_iterations: Iterations where there are none but contacts; by default as many as Newton's.
            settings: Those of Newton's solver.
        """
        super().__init__(model, **settings)
        splits = _splits(model, self.body_inv_mass_effective.numpy())
        self._splits = None
        if splits.any():
            self._splits = wp.array(splits, dtype=wp.int32, device=model.device)
            self._entries = wp.zeros((ENTRIES, model.body_count), dtype=wp.int32, device=model.device)
            self._shares = wp.ones(model.body_count, dtype=float, device=model.device)
            self._split = wp.empty_like(model.body_inv_mass), wp.empty_like(model.body_inv_inertia)
        self._contact_iterations = contact_iterations or self.iterations
        others = model.particle_count, model.tendon_segment_count, self.enable_restitution
        self._solve = self._joints = self._free_dofs = None
        plain = not any(others) and not self.rigid_contact_con_weighting
        if plain and (free_dofs := _free_dofs(model)) is not None:
            bodies = self._view_bodies(model.state())
            self._solve = contact_solve.allocate(contact_max, bodies, kinematic_flag=_KINEMATIC)
            if model.joint_count:
                self._free_dofs = wp.array(free_dofs, dtype=wp.int32, device=model.device)
        elif plain and not self._has_joint_mimics:
            self._joints = JointSolve(
                model,
                contact_max,
                iterations=self.iterations,
                contact_relaxation=self.rigid_contact_relaxation,
                joint_relaxation=self.joint_linear_relaxation,
            )

    def step(self, state_in, state_out, control, contacts, dt, *, observables=None) -> None:
        """Advance by ``dt`` [s]; as Newton's."""
        if self._solve is not None and contacts.rigid_contact_surface_velocity is None:
            self._step_bodies(state_in, state_out, control, contacts, dt)
            return
        if self._joints is not None:
            self._step_joints(state_in, state_out, control, contacts, dt)
            return
        self._find_shares(self._view_bodies(state_in), contacts, dt)
        with self._splitting():
            super().step(state_in, state_out, control, contacts, dt, observables=observables)

    def carried(self) -> dict[str, wp.array]:
        """Return the arrays that one substep hands on to the next one, by name."""
        return {} if self._solve is None else self._solve.carried()

    def _step_bodies(self, state_in, state_out, control, contacts, dt) -> None:
        assert self._solve is not None
        before, after = self._view_bodies(state_in), self._view_bodies(state_out)
        forces = () if control is None or self._free_dofs is None else (self._free_dofs, control.joint_f)
        launch_accelerate(before, self.model.gravity, _KINEMATIC, dt, after.q, after.qd, *forces)
        self._find_shares(after, contacts, dt)
        contact_solve.launch_solve_contacts(
            self._solve,
            view_contacts(self.model, contacts),
            after,
            self._shares if self._splits is not None else None,
            iterations=self._contact_iterations,
            relaxation=self.rigid_contact_relaxation,
            dt=dt,
        )
        launch_move(after, _KINEMATIC, dt)

    def _find_shares(self, bodies: BodyView, contacts, dt: float) -> None:
        if self._splits is None:
            return
        launch_find_shares(
            view_contacts(self.model, contacts),
            bodies,
            self._splits,
            self._entries,
            self._shares,
            relaxation=self.rigid_contact_relaxation,
            dt=dt,
        )

    def _step_joints(self, state_in, state_out, control, contacts, dt) -> None:
        assert self._joints is not None
        before, after = self._view_bodies(state_in), self._view_bodies(state_out)
        control = control or self.model.control(clone_variables=False)

        def contact_masses():
            self._find_shares(after, contacts, dt)
            return self._contact_masses()

        self._joints.step(before, after, contact_masses, control, contacts, dt)

    def _view_bodies(self, state) -> BodyView:
        """Return the bodies, of which forces and contacts do not move the kinematic ones."""
        bodies = view_bodies(self.model, state)
        bodies.inv_mass, bodies.inv_inertia = self.body_inv_mass_effective, self.body_inv_inertia_effective
        return bodies

    @contextlib.contextmanager
    def _splitting(self) -> Iterator[None]:
        """Let Newton's contacts act on their share of each body's mass."""
        self._whole = self.body_inv_mass_effective, self.body_inv_inertia_effective
        self.body_inv_mass_effective, self.body_inv_inertia_effective = self._contact_masses()
        try:
            yield
        finally:
            self.body_inv_mass_effective, self.body_inv_inertia_effective = self._whole

    def _contact_masses(self) -> tuple[wp.array, wp.array]:
        """Return the inverse masses and inertias that a contact acts on."""
        whole = self.body_inv_mass_effective, self.body_inv_inertia_effective
        if self._splits is None:
            return whole
        launch_split_masses(self._shares, whole, self._split)
        return self._split

    def _apply_body_deltas(self, model, state_in, state_out, body_deltas, dt, rigid_contact_inv_weight=None):
        """Move whole bodies by what contacts did to their shares, however slowly; the states take turns."""
        now, then = (state_in, state_out) if self._body_delta_counter else (state_out, state_in)
        self._body_delta_counter = 1 - self._body_delta_counter
        bodies = view_bodies(model, now)
        bodies.inv_mass, bodies.inv_inertia = self._whole
        launch_move_by(bodies, body_deltas, rigid_contact_inv_weight, dt, then.body_q, then.body_qd)
        return then.body_q, then.body_qd


def _free_dofs(model: newton.Model) -> np.ndarray | None:
    """Return the first degree of freedom of each body's free joint, -1 without one, shape [body_count].

    None where there are joints that constrain something, or free ones between two bodies.
    """
    dofs, joints = np.full(model.body_count, -1), model.joint_count
    if joints:
        if (model.joint_type.numpy() != newton.JointType.FREE).any() or (model.joint_parent.numpy() >= 0).any():
            return None
        first = np.where(model.joint_enabled.numpy(), model.joint_qd_start.numpy()[:joints], -1)
        np.put(dofs, model.joint_child.numpy(), first)
    return dofs


def _splits(model: newton.Model, inv_mass: np.ndarray) -> np.ndarray:
    """Return which bodies contacts may split, as integers, shape [body_count].

    Balls that are all alike stay whole: in their heaps neighbours take half of each correction.
    """
    colliding = (model.shape_flags.numpy() & newton.ShapeFlags.COLLIDE_SHAPES) != 0
    shape_body, types = model.shape_body.numpy(), model.shape_type.numpy()
    of_bodies = colliding & (shape_body >= 0)
    shapes = np.bincount(shape_body[of_bodies], minlength=model.body_count)
    is_ball = of_bodies & (types == newton.GeoType.SPHERE)
    balls = (shapes == 1) & (np.bincount(shape_body[is_ball], minlength=model.body_count) == 1) & (inv_mass > 0.0)
    radii = np.zeros(model.body_count)
    np.put(radii, shape_body[is_ball], model.shape_scale.numpy()[is_ball, 0])
    alike = not any(np.ptp(x[balls]) > _ALIKE * np.max(x[balls]) for x in (radii, inv_mass) if balls.any())
    return ((inv_mass > 0.0) & (shapes > 0) & ~(balls & alike)).astype(np.int32)
