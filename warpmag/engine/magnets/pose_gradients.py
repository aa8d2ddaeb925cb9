"""Gradients of the forces on bodies by poses, coils, magnetizations and the external field, recorded on Warp's tape."""

import numpy as np
import warp as wp

from warpmag.declarations.attributes import NAMESPACE
from warpmag.engine.magnets.placed_moments import PlacedMoments
from warpmag.engine.magnets.sources import ModelSources
from warpmag.errors import InputError
from warpmag.kernels.rigid.pose_gradients import (
    add_coil_gradients,
    add_pose_gradients,
    add_rotation_gradients,
    rotations_of,
    spread_cotangents,
    spread_to_coils,
)
from warpmag.kernels.shared.axpy import launch_add_scaled
from warpmag.moments.system import MomentSystem
from warpmag.moments.tape import differentiable, paused_tape

_MAGNETIZATION = "model.warpmag.magnetization"


def _check_gradients(name: str, system: MomentSystem, sources: ModelSources) -> None:
    """Raise ``InputError`` if the forces of a system with sources have no gradients, by the array ``name``."""
    settings = system.settings
    reasons = {
        f"the force {settings.force!r}": settings.force != "kelvin",
        f"the dynamics {settings.dynamics!r}": settings.dynamics != "theta",
        f"the contact model {settings.contact_model!r}": settings.contact_model != "dipole",
        "the near field of a permanent body at cells of iron": _closed_forms_act_on_cells(system),
        "a coil with a resistance, whose current follows from voltages,": sources.circuits is not None,
        "recoil permeability": system.bias is not None,
        "eddy currents": system.eddy is not None,
    }
    for reason, applies in reasons.items():
        if applies:
            raise InputError(f"{name}: requires a gradient, but {reason} has none")


def _closed_forms_act_on_cells(system: MomentSystem) -> bool:
    """Return False if no permanent body with a closed form is near cells of iron. Waits for the device.

    With coils, or in a captured graph, their distance is not tested: True.
    """
    interaction, sources = system.source_interaction, system.sources
    if interaction is None or not interaction.cell_count:
        return False
    if sources.applied or system.device.is_capturing:
        return True
    cells = interaction.arrays.cells.cell.numpy()[:, 0]
    return bool((interaction.field.numpy() != system.external_field.numpy())[cells].any())


class ForceGradients:
    """Gradients of the forces that :meth:`Magnetics.apply` adds to ``state.body_f``."""

    def __init__(self, placed: PlacedMoments, sources: ModelSources, model):
        """Prepare the gradients of the moments ``placed`` and the coils ``sources`` of a model."""
        self._system, self._magnets, self._sources, self._model = placed.system, placed.table, sources, model
        self._placed = placed
        magnets = placed.worlds.magnets
        iron = [magnet.body for magnet in magnets if magnet.magnet.kind == "inducible" and magnet.body >= 0]
        self._shares_body = bool(np.isin(iron, placed.solid_bodies.numpy()).any())

    def arguments(self, state) -> dict[str, wp.array]:
        """Return the arrays that require a gradient, by name."""
        attributes = getattr(self._model, NAMESPACE)
        return differentiable(
            {
                "state.body_q": state.body_q,
                "model.shape_transform": self._model.shape_transform,
                _MAGNETIZATION: attributes.magnetization,
                "model.warpmag.strength": attributes.strength,
                "external_field": self._system.external_field,
            }
        )

    def record(self, tape: wp.Tape, state) -> None:
        """Record the gradients of the forces that were just added, if an argument requires one."""
        required = self.arguments(state)
        if not required:
            return
        name = next(iter(required))
        _check_gradients(name, self._system, self._sources)
        if self._shares_body:
            raise InputError(f"{name}: requires a gradient, but a permanent box or cylinder with iron on it has none")
        solids = () if self._system.sources is None else self._system.sources.solids
        if _MAGNETIZATION in required and any(solid.has_few_moments for solid in solids):
            raise InputError(
                f"{_MAGNETIZATION}: requires a gradient, but the model does not, call finalize(requires_grad=True)"
            )
        state.body_f.requires_grad = True
        solved = _SolvedMoments(self._system)  # the next call overwrites the system's arrays

        def add_gradients():
            with paused_tape():
                self._add(solved, state.body_q, state.body_f.grad)

        tape.record_func(add_gradients, [*required.values(), state.body_f])

    def _add(self, solved: "_SolvedMoments", body_q: wp.array, body_f: wp.array) -> None:
        """Add to the gradients of the arguments, from those by the wrenches ``body_f``."""
        model, gradients = self._model, self._system.gradients
        solved.load()
        force, torque, arms = spread_cotangents(self._magnets, model, body_q, solved.positions, solved.forces, body_f)
        coils = gradients.coils
        if coils is not None:
            cotangents = coils.source_force_cotangents, coils.source_torque_cotangents
            spread_to_coils(self._sources.on_device, model, body_q, body_f, *cotangents, coils.centers)
        sums = gradients.wrench(force, torque)
        gradients.solve(sums.by_moments, warm=True)  # from the solution of the substep after it
        gradients.check()
        launch_add_scaled(sums.by_positions, gradients.by_positions)
        launch_add_scaled(sums.by_moments, gradients.by_moments)
        solids = gradients.solids
        if solids is not None:
            if getattr(model, NAMESPACE).magnetization.requires_grad:
                solids.launch_magnetizations(gradients.by_moments)
            add_rotation_gradients(self._placed.solid_bodies, body_q, rotations_of(solids.frames), solids.by_rotations)
        add_pose_gradients(self._magnets, model, body_q, gradients.by_positions, gradients.by_moments, arms)
        cells = gradients.cells
        if cells is not None:
            add_rotation_gradients(self._placed.coupled_bodies, body_q, cells.rotations, cells.by_rotations)
        if coils is not None:
            add_coil_gradients(self._sources.on_device, model, body_q, coils.frames, coils.by_sources)
        by_external_field = self._system.external_field.grad
        if by_external_field is not None:
            launch_add_scaled(sums.by_external_field, by_external_field)
            launch_add_scaled(gradients.by_field, by_external_field)


class _SolvedMoments:
    """Copy of the moments, the fields, the forces and the coils of a system after a solve."""

    def __init__(self, system: MomentSystem):
        """Copy the arrays."""
        self._system, self.positions, self.forces = system, wp.clone(system.positions), wp.clone(system.forces)
        self._moments, self._h = wp.clone(system.moments), wp.clone(system.h)
        self._external_field = wp.clone(system.external_field, requires_grad=False)
        coils = system.sources
        self._coils = None if coils is None else (wp.clone(coils.frames), wp.clone(coils.strengths))
        self._solids = None if coils is None else wp.clone(coils.solid_frames)
        self._rotations = None if system.rotations is None else wp.clone(system.rotations)

    def load(self) -> None:
        """Compute gradients at this state."""
        gradients = self._system.gradients
        gradients.load(self.positions, self._moments, self._h, self._external_field, self._rotations)
        if self._coils is not None and gradients.coils is not None:
            wp.copy(gradients.coils.frames, self._coils[0])
            wp.copy(gradients.coils.strengths, self._coils[1])
        if self._solids is not None and gradients.solids is not None:
            wp.copy(gradients.solids.frames, self._solids)
