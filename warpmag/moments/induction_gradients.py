"""Gradients of :func:`warpmag.solve_induction` and of the wrenches of its result, by its arguments.

The balls are the first moments of a system, and the permanent dipoles follow (``moments.system_gradients``).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.curve_gradients import point_gradients
from warpmag.kernels.pairs.packing import launch_divide_by_volume, launch_volume_gradients
from warpmag.moments.arrays import largest
from warpmag.moments.system_gradients import SystemGradients
from warpmag.moments.tape import Gradients

POINT_ARRAYS: tuple[str, str] = "curve_points: fields", "curve_points: magnetizations"
"""Names of the arrays of the argument ``curve_points``."""


@dataclass(frozen=True)
class BallGradients:
    """Gradients of one solve of ``count`` balls, at least one, by the arguments of :func:`warpmag.solve_induction`.

    Permanent moments are named ``permanent: positions`` and ``permanent: moments``, points of a curve as in
    ``POINT_ARRAYS``.
    """

    system: SystemGradients  # with the state loaded
    radii: wp.array  # of all moments [m], shape [n]
    count: int
    curve: Any  # of the balls, a ``MagnetizationCurve`` where gradients by its points are needed
    point_count: int  # points of the argument ``curve_points``, which may lack the curve's origin

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
        if needed & {*POINT_ARRAYS}:
            gradients |= self._by_points(by_moments)
        return gradients

    def _by_points(self, by_moments) -> Gradients:
        """Return the gradients by the points of the measured curve; the curve is evaluated on the host."""
        rho, h, radii = (
            array[: self.count].numpy().astype(float)
            for array in (self.system.moment_gradient(by_moments), self.system.h, self.radii)
        )
        strength = np.linalg.norm(h, axis=1)
        along = np.divide(np.sum(h * rho, axis=1), strength, out=np.zeros_like(strength), where=strength > 0.0)
        sums = point_gradients(self.curve, strength, 4.0 / 3.0 * np.pi * radii**3 * along)
        return {
            name: wp.array(values[-self.point_count :], dtype=wp.float64, device=self.radii.device)
            for name, values in zip(POINT_ARRAYS, sums, strict=True)
        }

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
