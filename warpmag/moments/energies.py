"""Energies of moments as an induction solve left them."""

import numpy as np
import warp as wp

from warpmag.kernels.induction.energy import launch_energy
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.pair_terms import Quantity


class MomentEnergies:
    """What only the energy needs: the field of permanent moments at each other, and room for what each moment has.

    Args:
        packed: Packed moments (``pairs.packing.PackedMoments``).
        ranges: For each world its first moment, its first permanent one, and the end.
        moments: Their moments [A·m²], shape [n].
    """

    def __init__(self, packed, ranges, moments):
        """Allocate it."""
        segments = [(middle, last, middle, last) for _, middle, last in ranges if last > middle]
        nothing = wp.zeros_like(moments)
        self._radii, self._moments = packed.radii, moments
        self._field = wp.zeros_like(moments)
        self._permanents = PairEvaluation(Quantity.FIELD, segments, packed, packed, nothing, self._field)
        self._energies = wp.zeros(packed.count, dtype=wp.float64, device=packed.device)

    def of_each(self, material, state, acting) -> np.ndarray:
        """Energy of each moment [J], float64, shape [n]; waits for the device.

        Args:
            material: Material of the moments.
            state: State of the solve.
            acting: Applied field that acts on moments [A/m], shape [n].
        """
        self._permanents.launch()
        fields = state.h, state.h0, self._field, acting
        launch_energy(self._radii, self._moments, material, *fields, self._energies)
        return self._energies.numpy()
