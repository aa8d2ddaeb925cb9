"""XPBD for bodies with joints: velocities that joints, drives and contacts agree with, then one motion.

Newton's kernels say how far joints and contacts are off at the poses that velocities lead to;
``kernels.contacts.joints`` has what they lack.
"""

import math
from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp
from newton._src.solvers.xpbd import kernels as newtons

from warpmag.kernels.contacts import joints as kernels
from warpmag.kernels.contacts.free_motion import launch_accelerate, launch_move
from warpmag.kernels.rigid.newton_views import BodyView, view_contacts

_KINEMATIC = int(newton.BodyFlags.KINEMATIC)
_ONE_AXIS = (newton.JointType.REVOLUTE, newton.JointType.PRISMATIC)
_PINS = (newton.JointType.REVOLUTE, newton.JointType.BALL, newton.JointType.FIXED, newton.JointType.D6)
"""Joints whose ends are at one place, unless they slide."""
_ROWS_OF_FREE = (newton.JointType.FREE, newton.JointType.DISTANCE, newton.JointType.BALL, newton.JointType.FIXED)
"""Joints whose degrees of freedom have no drive here."""
_AT_ONCE = 6
"""Iterations between two looks at whether there are more: a graph that holds all of them takes seconds to make."""


class JointSolve:
    """The substeps of one model with joints."""

    def __init__(
        self,
        model: newton.Model,
        contact_max: int,
        *,
        iterations: int,
        contact_relaxation: float,
        joint_relaxation: float,
    ):
        """Allocate.

        Args:
            model: The model.
            contact_max: Most contacts.
            iterations: Iterations over joints and contacts.
            contact_relaxation: Part of each correction of a contact that is done.
            joint_relaxation: The same of a joint.
        """
        self._model, self._iterations = model, iterations
        self._relaxations = contact_relaxation, joint_relaxation
        device = model.device
        self._deltas = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=device)
        self._impulses = wp.zeros(model.joint_count, dtype=wp.spatial_vector, device=device)
        self._forces = wp.zeros_like(self._deltas)
        self._margin = wp.zeros(contact_max, dtype=float, device=device)
        self._q, self._qd = wp.empty_like(model.body_q), wp.empty_like(model.body_qd)
        self._frames = wp.empty_like(model.joint_X_p), wp.empty_like(model.joint_X_c)
        self._axes = wp.clone(model.joint_axis)
        self._limits = wp.empty_like(model.joint_limit_lower), wp.empty_like(model.joint_limit_upper)
        types, counts = model.joint_type.numpy(), _axis_counts(model)
        self._pins = wp.array(are_pins(model), dtype=wp.bool, device=device)
        self._one_axis = wp.array(np.isin(types, _ONE_AXIS), dtype=wp.bool, device=device)
        slides = (counts[:, 0] > 0) & ~np.isin(types, _ROWS_OF_FREE)
        self._slides = wp.array(slides, dtype=wp.bool, device=device)
        rows, others = _rows(model)
        self._left = wp.zeros(1, dtype=wp.int32, device=device)
        self._given = wp.zeros(len(rows), dtype=float, device=device)
        self._rows = [wp.array(column, dtype=wp.int32, device=device) for column in rows.T[:3]]
        self._rows.append(wp.array(rows[:, 3] == 1, dtype=wp.bool, device=device))
        # gains of the drives that Newton's kernel still has to know
        self._gains = [
            wp.array(np.where(others, gain.numpy(), 0.0), dtype=float, device=device)
            for gain in (model.joint_target_ke, model.joint_target_kd)
        ]

    def _view(self) -> kernels.JointView:
        """Return the model's joints as they are now."""
        model, view = self._model, kernels.JointView()
        view.parent, view.child, view.enabled = model.joint_parent, model.joint_child, model.joint_enabled
        view.parent_frame, view.child_frame, view.axis = model.joint_X_p, model.joint_X_c, model.joint_axis
        view.stiffness, view.damping = model.joint_target_ke, model.joint_target_kd
        view.effort, view.dof_start = model.joint_effort_limit, model.joint_qd_start
        view.lower, view.upper = model.joint_limit_lower, model.joint_limit_upper
        view.slides, view.pins, view.one_axis = self._slides, self._pins, self._one_axis
        view.row_joint, view.row_dof, view.row_target, view.row_turns = self._rows
        return view

    def step(self, before: BodyView, after: BodyView, contact_masses: Callable, control, contacts, dt: float) -> None:
        """Advance by ``dt`` [s].

        Args:
            before: The bodies as they are, with their whole masses.
            after: Out, the bodies afterwards.
            contact_masses: Called once ``after`` has the velocities without contacts and joints; returns the inverse
                masses and inertias that a contact acts on.
            control: Forces and targets of the joints.
            contacts: Newton's contacts.
            dt: Length of the substep [s].
        """
        model, joints = self._model, self._view()
        wp.copy(self._forces, before.f)
        self._add_joint_forces(before.q, control.joint_f, dt)
        before.f = self._forces
        launch_accelerate(before, model.gravity, _KINEMATIC, dt, after.q, after.qd)
        masses = contact_masses()
        kernels.launch_align(joints, before, dt, self._frames, self._axes, self._limits)
        kernels.launch_limit_push_out(view_contacts(model, contacts), after, _KINEMATIC, dt, self._margin)
        wp.copy(self._q, after.q)
        wp.copy(self._qd, after.qd)
        self._given.zero_()
        at_once = math.gcd(self._iterations, _AT_ONCE)
        self._left.fill_(self._iterations // at_once)

        def iterate():
            for _ in range(at_once):
                self._iterate(joints, after, masses, control, contacts, dt)
            kernels.launch_count_down(self._left)

        wp.capture_while(self._left, iterate)
        launch_move(after, _KINEMATIC, dt)

    def _iterate(self, joints: kernels.JointView, bodies: BodyView, masses, control, contacts, dt: float) -> None:
        """Change velocities as contacts ask for, and then as joints and drives do."""
        launch_move(bodies, _KINEMATIC, dt, self._q, self._qd)
        self._solve_contacts(masses, contacts, dt)
        kernels.launch_apply(bodies, self._deltas)
        launch_move(bodies, _KINEMATIC, dt, self._q, self._qd)
        self._solve_joints(bodies, control, dt)
        kernels.launch_turn_levers(joints, bodies, self._q, self._impulses, self._deltas)
        targets = control.joint_target_q, control.joint_target_qd
        kernels.launch_drive(joints, bodies, targets, self._given, self._deltas, relaxation=self._relaxations[1], dt=dt)
        kernels.launch_apply(bodies, self._deltas)

    def _add_joint_forces(self, body_q, joint_f, dt: float) -> None:
        model = self._model
        inputs = [body_q, model.body_com, model.joint_type, model.joint_enabled, model.joint_parent, model.joint_child]
        inputs += [model.joint_X_p, model.joint_X_c, model.joint_qd_start, model.joint_dof_dim, model.joint_axis]
        self._launch(newtons.apply_joint_forces, model.joint_count, [*inputs, joint_f, dt], [self._forces, None])

    def _solve_contacts(self, masses, contacts, dt: float) -> None:
        model = self._model
        inputs = [self._q, self._qd, model.body_flags, model.body_com, *masses, model.shape_body]
        names = ("count", "point0", "point1", "surface_velocity", "offset0", "offset1", "normal")
        inputs += [getattr(contacts, f"rigid_contact_{name}") for name in names]
        inputs.append(self._margin)
        inputs += [getattr(contacts, f"rigid_contact_{name}") for name in ("margin1", "shape0", "shape1")]
        inputs += [getattr(model, f"shape_material_{name}") for name in ("mu", "mu_torsional", "mu_rolling")]
        inputs += [self._relaxations[0], dt]
        outputs = [self._deltas, None, None]
        self._launch(newtons.solve_body_contact_positions, contacts.rigid_contact_max, inputs, outputs)

    def _solve_joints(self, bodies: BodyView, control, dt: float) -> None:
        model, relaxation = self._model, self._relaxations[1]
        inputs = [self._q, self._qd, model.body_com, bodies.inv_mass, bodies.inv_inertia, model.joint_type]
        inputs += [model.joint_enabled, model.joint_parent, model.joint_child, *self._frames]
        inputs += [*self._limits, model.joint_qd_start, model.joint_target_q_start]
        inputs += [model.joint_dof_dim, self._axes, control.joint_target_q, control.joint_target_qd, *self._gains]
        inputs += [0.0, 0.0, relaxation, relaxation, dt]
        self._launch(newtons.solve_body_joints, model.joint_count, inputs, [self._deltas, self._impulses])

    def _launch(self, kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._model.device)


def _axis_counts(model: newton.Model) -> np.ndarray:
    """Return how many axes each joint slides along, and turns about, shape [joints, 2]."""
    counts: Any = model.joint_dof_dim  # Newton's declaration hides that it is an array
    return counts.numpy()


def are_pins(model: newton.Model) -> np.ndarray:
    """Whether the ends of each joint are at one place, shape [joints]."""
    return np.isin(model.joint_type.numpy(), _PINS) & (_axis_counts(model)[:, 0] == 0)


def _rows(model: newton.Model) -> tuple[np.ndarray, np.ndarray]:
    """List the axes that drives may act on.

    Returns:
        Joint, degree of freedom, place of the target and whether it turns, shape [rows, 4], and which degrees of
        freedom are left to Newton: those of joints that turn about several axes, shape [dofs].
    """
    rows, others = [], np.ones(model.joint_dof_count, dtype=bool)
    types, counts = model.joint_type.numpy(), _axis_counts(model)
    dofs, targets = model.joint_qd_start.numpy(), model.joint_target_q_start.numpy()
    for joint in range(model.joint_count):
        if types[joint] in _ROWS_OF_FREE:
            continue
        linear, angular = counts[joint]
        for k in range(linear + (angular if angular == 1 else 0)):
            rows.append((joint, dofs[joint] + k, targets[joint] + k, k >= linear))
            others[dofs[joint] + k] = False
    return np.array(rows, dtype=int).reshape(-1, 4), others
