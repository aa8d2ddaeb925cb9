"""Energies of the moments of a system, after a solve."""

import numpy as np
import warp as wp

from warpmag.errors import InputError
from warpmag.kernels.induction.energy import launch_energy
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.wrench import MU0


class SystemEnergies:
    """Energies of the moments of a system, in buffers allocated once.

    Args:
        system: The system (``moments.system.MomentSystem``).
        packed: Its moments, packed (``kernels.pairs.packing.PackedMoments``).
        h0: Applied field of its solve [A/m], Warp array, shape [n].
        acting: Field of sources that exerts torques [A/m], Warp array, shape [n].

    Raises:
        InputError: The contact model is ``multipole``.
    """

    def __init__(self, system, packed, h0, acting):
        """Allocate the field of permanent moments at each other, which only the energy needs."""
        if system.settings.contact_model != "dipole":
            raise InputError("contact_model: the energy can be computed for dipole only, not for multipole")
        self._system, self._fields = system, (h0, acting)
        segments = [(middle, last, middle, last) for _, middle, last in system.world_ranges if last > middle]
        zero, self._permanent_field = wp.zeros_like(system.moments), wp.zeros_like(system.moments)
        self._evaluation = PairEvaluation(Quantity.FIELD, segments, packed, packed, zero, self._permanent_field)

    def of_worlds(self) -> np.ndarray:
        """Return the energy of each world [J], shape [worlds]; see :meth:`MomentSystem.energy`."""
        system, energies = self._system, self._of_moments()
        if system.source_interaction is not None:
            energies += system.source_interaction.energies()
        if system.bias is not None:  # the energy is 0 at M = M_r without field
            bias = np.linalg.norm(system.bias.numpy().astype(float), axis=1)
            volumes = 4.0 / 3.0 * np.pi * system.radii.numpy().astype(float) ** 3
            energies += 0.5 * MU0 * volumes * system.material.slope.numpy() * bias**2
        return np.array([energies[first:last].sum() for first, _, last in system.world_ranges])

    def _of_moments(self) -> np.ndarray:
        """Return the energy of each moment [J] in the fields of moments and in the applied field, shape [n]."""
        system = self._system
        self._evaluation.launch()
        if system.source_interaction is not None:
            system.source_interaction.launch_left_out()
        energies = wp.zeros(system.count, dtype=wp.float64, device=system.device)
        h0, acting = self._fields
        fields = system.h, h0, self._permanent_field, acting
        launch_energy(system.radii, system.moments, system.material, *fields, energies)
        return energies.numpy()
