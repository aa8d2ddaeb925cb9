"""Gradients of :func:`warpmag.solve_induction` and of the wrenches of its result, by its arguments.

The balls are the first moments of a system, and the permanent dipoles follow (``moments.system_gradients``).
"""

from dataclasses import dataclass

import warp as wp

from warpmag.kernels.pairs.packing import launch_divide_by_volume, launch_volume_gradients
from warpmag.moments.arrays import largest
from warpmag.moments.system_gradients import SystemGradients
from warpmag.moments.tape import Gradients


@dataclass(frozen=True)
class BallGradients:
    """Gradients of one solve of ``count`` balls, at least one, by the arguments of :func:`warpmag.solve_induction`.

    Permanent moments are named ``permanent: positions`` and ``permanent: moments``.
    """

    system: SystemGradients  # with the state loaded
    radii: wp.array  # of all moments [m], shape [n]
    count: int

    def of_solve(self, cotangents: list[wp.array], needed: set[str]) -> Gradients:
        """Return the gradients of a function of M and H from ∂L/∂M and ∂L/∂H, shape [count] each."""
        system, radii = self.system, self.radii[: self.count]
        by_moments, by_field = wp.zeros_like(system.h), wp.zeros_like(system.h)
        launch_divide_by_volume(cotangents[0], radii, by_moments[: self.count])
        wp.copy(by_field, cotangents[1], count=self.count)
        system.solve(by_moments, by_field if largest(by_field) != 0.0 else None)
        system.check()
        gradients = self._split(system.by_positions, system.by_moments)
        gradients["external_field"] = system.by_field[: self.count]
        _, gradients["radii"] = self._by_magnetizations_and_radii(system.by_moments)
        if needed & {"saturation", "susceptibility"}:
            saturation, susceptibility = system.parameters(by_moments)
            gradients["saturation"], gradients["susceptibility"] = (
                saturation[: self.count],
                susceptibility[: self.count],
            )
        return gradients

    def of_wrench(self, cotangents: list[wp.array]) -> Gradients:
        """Return the gradients of a function of the balls' forces and torques from those by them, shape [count] each.

        The gradients by ``magnetizations`` are partial: the solve continues them.
        """
        padded = [wp.zeros_like(self.system.h) for _ in cotangents]
        for cotangent, rows in zip(cotangents, padded, strict=True):
            wp.copy(rows, cotangent, count=self.count)
        sums = self.system.wrench(*padded)
        gradients = self._split(sums.by_positions, sums.by_moments)
        gradients["external_field"] = sums.by_external_field[: self.count]
        gradients["magnetizations"], gradients["radii"] = self._by_magnetizations_and_radii(sums.by_moments)
        return gradients

    def _split(self, by_positions, by_moments) -> Gradients:
        """Return the gradients by positions of balls and permanent dipoles, and by moments of the latter."""
        count = self.count
        gradients = {"positions": by_positions[:count]}
        if len(by_positions) > count:
            gradients |= {"permanent: positions": by_positions[count:], "permanent: moments": by_moments[count:]}
        return gradients

    def _by_magnetizations_and_radii(self, by_moments) -> tuple[wp.array, wp.array]:
        """Return the gradients by magnetizations and radii of the balls at given gradients by their moments."""
        radii, moments = self.radii[: self.count], self.system.moments[: self.count]
        out = wp.empty_like(moments), wp.empty_like(radii)
        launch_volume_gradients(radii, moments, by_moments[: self.count], *out)
        return out
