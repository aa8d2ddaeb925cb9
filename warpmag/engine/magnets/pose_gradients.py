"""Gradients of the forces on bodies by their poses, recorded on Warp's tape."""

import warp as wp

from warpmag.errors import InputError
from warpmag.kernels.rigid.bodies import BodyMoments
from warpmag.kernels.rigid.pose_gradients import add_pose_gradients, spread_cotangents
from warpmag.kernels.shared.axpy import launch_add_scaled
from warpmag.moments.system import MomentSystem
from warpmag.moments.tape import differentiable, paused_tape


def check_pose_gradients(system: MomentSystem) -> None:
    """Raise ``InputError`` if the forces of a system have no gradients by poses."""
    settings = system.settings
    reasons = {
        f"the force {settings.force!r}": settings.force != "kelvin",
        f"the dynamics {settings.dynamics!r}": settings.dynamics != "theta",
        f"the contact model {settings.contact_model!r}": settings.contact_model != "dipole",
        "a body of cells": system.rotations is not None,
        "a coil, a field map or the near field of a permanent body": system.sources is not None,
        "recoil permeability": system.bias is not None,
        "eddy currents": system.eddy is not None,
    }
    for reason, applies in reasons.items():
        if applies:
            raise InputError(f"state.body_q: requires a gradient, but {reason} has none")


def record_forces(tape: wp.Tape, system: MomentSystem, magnets: BodyMoments, model, state) -> None:
    """Record the gradients of the forces that were just added to ``state.body_f``, if ``state.body_q`` requires one."""
    if not differentiable({"state.body_q": state.body_q}):
        return
    check_pose_gradients(system)
    state.body_f.requires_grad = True
    # the next call overwrites the system's arrays
    solved = _SolvedMoments(system)

    def add_gradients():
        with paused_tape():
            cotangents = spread_cotangents(
                magnets, model, state.body_q, solved.positions, solved.forces, state.body_f.grad
            )
            by_positions, by_moments = solved.product(*cotangents[:2])
            add_pose_gradients(magnets, model, state.body_q, by_positions, by_moments, cotangents[2])

    tape.record_func(add_gradients, [state.body_q, state.body_f])


class _SolvedMoments:
    """Copy of the moments, the fields and the forces of a system after a solve."""

    def __init__(self, system: MomentSystem):
        """Copy the arrays."""
        self.positions, self.forces = wp.clone(system.positions), wp.clone(system.forces)
        self._moments, self._h, self._external_field = map(wp.clone, (system.moments, system.h, system.external_field))
        self._system = system

    def product(self, force_cotangents: wp.array, torque_cotangents: wp.array) -> tuple[wp.array, wp.array]:
        """Return the gradients by positions and by permanent moments, shape [n] each; others are not meaningful."""
        gradients = self._system.gradients
        gradients.load(self.positions, self._moments, self._h, self._external_field)
        sums = gradients.wrench(force_cotangents, torque_cotangents)
        gradients.solve(sums.by_moments, warm=True)  # from the solution of the substep after it
        gradients.check()
        for partial, total in (
            (sums.by_positions, gradients.by_positions),
            (sums.by_moments, gradients.by_moments),
        ):
            launch_add_scaled(partial, total)
        return gradients.by_positions, gradients.by_moments
