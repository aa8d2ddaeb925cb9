"""XPBD for bodies with joints: iterations find velocities that satisfy joints, drives and contacts.

Newton's kernels evaluate the errors of joints and contacts at the predicted poses at the end of the substep.
``kernels.contacts.joints`` corrects their lever arms and their drives. The bodies move once, after the iterations.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import newton
import numpy as np
import warp as wp
from newton._src.solvers.xpbd import kernels as newton_kernels

from warpmag.kernels.contacts import joints as kernels
from warpmag.kernels.contacts.free_motion import launch_accelerate, launch_apply_impulses, launch_move
from warpmag.kernels.rigid.newton_views import BodyView, view_contacts

_KINEMATIC = int(newton.BodyFlags.KINEMATIC)
_ONE_AXIS = (newton.JointType.REVOLUTE, newton.JointType.PRISMATIC)
_PINS = (newton.JointType.REVOLUTE, newton.JointType.BALL, newton.JointType.FIXED, newton.JointType.D6)
"""Types of joints that keep two points together, unless the joint slides."""
_UNDRIVEN = (newton.JointType.FREE, newton.JointType.DISTANCE, newton.JointType.BALL, newton.JointType.FIXED)
"""Types of joints without drives."""
_UNROLLED = 6
"""Largest number of iterations in the loop body of a graph. A graph of all iterations takes seconds to capture."""


class JointSolve:
    """Substeps of a model with joints."""

    def __init__(
        self,
        model: newton.Model,
        contact_max: int,
        *,
        iterations: int,
        contact_relaxation: float,
        joint_relaxation: float,
    ):
        """Allocate all buffers. The relaxations are factors of the corrections of each contact and each joint."""
        self._model, self._iterations, device = model, iterations, model.device
        self._relaxations = contact_relaxation, joint_relaxation
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
        slides = (counts[:, 0] > 0) & ~np.isin(types, _UNDRIVEN)
        self._slides = wp.array(slides, dtype=wp.bool, device=device)
        rows, newton_dofs = _drive_rows(model)
        self._loops_left = wp.zeros(1, dtype=wp.int32, device=device)
        self._drive_impulses = wp.zeros(len(rows), dtype=float, device=device)
        self._rows = [wp.array(column, dtype=wp.int32, device=device) for column in rows.T[:3]]
        self._rows.append(wp.array(rows[:, 3] == 1, dtype=wp.bool, device=device))
        # gains of the drives that Newton's kernel evaluates
        self._gains = [
            wp.array(np.where(newton_dofs, gain.numpy(), 0.0), dtype=float, device=device)
            for gain in (model.joint_target_ke, model.joint_target_kd)
        ]

    def _view(self) -> kernels.JointView:
        """Return the model's present joint arrays."""
        model, view = self._model, kernels.JointView()
        view.parent, view.child, view.enabled = model.joint_parent, model.joint_child, model.joint_enabled
        view.parent_frame, view.child_frame, view.axis = model.joint_X_p, model.joint_X_c, model.joint_axis
        view.stiffness, view.damping = model.joint_target_ke, model.joint_target_kd
        view.effort, view.dof_start = model.joint_effort_limit, model.joint_qd_start
        view.lower, view.upper = model.joint_limit_lower, model.joint_limit_upper
        view.slides, view.pins, view.one_axis = self._slides, self._pins, self._one_axis
        view.row_joint, view.row_dof, view.row_target, view.row_is_angular = self._rows
        return view

    def step(self, before: BodyView, after: BodyView, contact_masses: Callable, control, contacts, dt: float) -> None:
        """Advance the bodies ``before``, with masses that are not split, by ``dt`` [s], and write them to ``after``.

        ``contact_masses`` returns the inverse masses and inertias for contacts. It is called once ``after`` has the
        velocities without contacts and joints.
        """
        model, joints = self._model, self._view()
        wp.copy(self._forces, before.f)
        self._add_joint_forces(before.q, control.joint_f, dt)
        before.f = self._forces
        launch_accelerate(before, model.gravity, _KINEMATIC, dt, after.q, after.qd)
        masses = contact_masses()
        kernels.launch_prepare_joints(joints, before, dt, self._frames, self._axes, self._limits)
        kernels.launch_limit_recovery_speed(view_contacts(model, contacts), after, _KINEMATIC, dt, self._margin)
        wp.copy(self._q, after.q)
        wp.copy(self._qd, after.qd)
        self._drive_impulses.zero_()
        unrolled = math.gcd(self._iterations, _UNROLLED)
        self._loops_left.fill_(self._iterations // unrolled)

        solve_contacts = self._contact_solve(masses, contacts, dt)
        solve_joints = self._joint_solve(after, control, dt)

        def iterate():
            for _ in range(unrolled):
                launch_move(after, _KINEMATIC, dt, self._q, self._qd)
                solve_contacts()
                launch_apply_impulses(after, self._deltas)
                launch_move(after, _KINEMATIC, dt, self._q, self._qd)
                solve_joints()
                self._correct_joints(joints, after, control, dt)
            kernels.launch_count_down(self._loops_left)

        wp.capture_while(self._loops_left, iterate)
        launch_move(after, _KINEMATIC, dt)

    def _correct_joints(self, joints: kernels.JointView, bodies: BodyView, control, dt: float) -> None:
        """Correct the lever arms of Newton's joint impulses, and add drives."""
        kernels.launch_correct_lever_arms(joints, bodies, self._q, self._impulses, self._deltas)
        targets, impulses = (control.joint_target_q, control.joint_target_qd), self._drive_impulses
        relaxation = self._relaxations[1]
        kernels.launch_add_drives(joints, bodies, targets, impulses, self._deltas, relaxation=relaxation, dt=dt)
        launch_apply_impulses(bodies, self._deltas)

    def _add_joint_forces(self, body_q, joint_f, dt: float) -> None:
        arrays = {"body_q": body_q, "joint_f": joint_f, "body_f": self._forces, "joint_impulse": None}
        self._bind(newton_kernels.apply_joint_forces, self._model.joint_count, dt=dt, **arrays)()

    def _contact_solve(self, masses, contacts, dt: float) -> Callable:
        names = ("count", "point0", "point1", "surface_velocity", "offset0", "offset1", "normal", "shape0", "shape1")
        return self._bind(
            newton_kernels.solve_body_contact_positions, contacts.rigid_contact_max,
            **{f"contact_{name}": getattr(contacts, f"rigid_contact_{name}") for name in names},
            contact_thickness0=self._margin, contact_thickness1=contacts.rigid_contact_margin1,
            body_q=self._q, body_qd=self._qd, body_m_inv=masses[0], body_I_inv=masses[1],
            relaxation=self._relaxations[0], dt=dt,
            deltas=self._deltas, contact_inv_weight=None, contact_impulse=None,
        )  # fmt: skip

    def _joint_solve(self, bodies: BodyView, control, dt: float) -> Callable:
        return self._bind(
            newton_kernels.solve_body_joints, self._model.joint_count,
            body_q=self._q, body_qd=self._qd, body_inv_m=bodies.inv_mass, body_inv_I=bodies.inv_inertia,
            joint_X_p=self._frames[0], joint_X_c=self._frames[1], joint_axis=self._axes,
            joint_limit_lower=self._limits[0], joint_limit_upper=self._limits[1],
            joint_target_q=control.joint_target_q, joint_target_qd=control.joint_target_qd,
            joint_target_ke=self._gains[0], joint_target_kd=self._gains[1],
            joint_linear_compliance=0.0, joint_angular_compliance=0.0,
            linear_relaxation=self._relaxations[1], angular_relaxation=self._relaxations[1], dt=dt,
            deltas=self._deltas, joint_impulse=self._impulses,
        )  # fmt: skip

    def _bind(self, kernel, dim: int, **arguments) -> Callable:
        """Return a launch of a Newton kernel. Arguments that are not given are the model's arrays of the same names."""
        names = [argument.label for argument in kernel.adj.args]
        values = [arguments[name] if name in arguments else getattr(self._model, name) for name in names]
        return partial(wp.launch, kernel, dim=dim, inputs=values, device=self._model.device)


def _axis_counts(model: newton.Model) -> np.ndarray:
    """Return the numbers of linear and angular axes of each joint, shape [joints, 2]."""
    counts: Any = model.joint_dof_dim  # Newton's annotation hides that it is an array
    return counts.numpy()


def are_pins(model: newton.Model) -> np.ndarray:
    """Return True for each joint that keeps two points together and does not slide, shape [joints]."""
    return np.isin(model.joint_type.numpy(), _PINS) & (_axis_counts(model)[:, 0] == 0)


def _drive_rows(model: newton.Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes with drives that ``kernels.contacts.joints`` evaluates, and a mask of other axes, shape [dofs].

    A row is the joint, the degree of freedom, the index of the target, and 1 for an angular axis, shape [rows, 4].
    Newton evaluates the drives of the masked axes: angular axes of joints with several angular axes.
    """
    rows, newton_dofs = [], np.ones(model.joint_dof_count, dtype=bool)
    types, counts = model.joint_type.numpy(), _axis_counts(model)
    dofs, targets = model.joint_qd_start.numpy(), model.joint_target_q_start.numpy()
    for joint in range(model.joint_count):
        if types[joint] in _UNDRIVEN:
            continue
        linear, angular = counts[joint]
        for k in range(linear + (angular if angular == 1 else 0)):
            rows.append((joint, dofs[joint] + k, targets[joint] + k, k >= linear))
            newton_dofs[dofs[joint] + k] = False
    return np.array(rows, dtype=int).reshape(-1, 4), newton_dofs
