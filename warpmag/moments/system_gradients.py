"""Gradients of the solves and of the forces of a system of moments.

The equilibrium of the inducible moments is m = V f(H), H = H0 + T m, with the symmetric tensor T of the pairs' fields.
Small changes obey δm = V f' δH + …, δH = T δm + …. For a loss L with the cotangents ∂L/∂m and ∂L/∂H of the results, the
total gradients ρ = ∂L/∂m and η = ∂L/∂H of the equations solve

    ρ = ∂L/∂m + T η,    η = ∂L/∂H + S² ρ,    S² = V f'(H).

Insertion with w = S ρ gives the symmetric positive definite system

    (1 − S T S) w = S (∂L/∂m + T ∂L/∂H),

the Hessian f⁻¹' − G of the energy between two roots of f', which stays finite at saturation. Conjugate gradients need
one field evaluation an iteration (``kernels.induction.tangent``). Gradients by parameters follow without another solve:

| parameter | gradient |
|---|---|
| external field | η |
| permanent moments | the field of moments η at them |
| positions | (η·∇)H + (m·∇)H_η, with H_η the field of moments η |
| radii | 4πR² M·T η |
| saturation, susceptibility | ρ·∂(V f)/∂Ms, ρ·∂(V f)/∂χ |
"""

import math

import numpy as np
import warp as wp

from warpmag.errors import ConvergenceWarning, InputError, warn_caller
from warpmag.kernels.applied.coil_gradients import CoilGradients
from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.applied.solid_gradients import SolidGradients
from warpmag.kernels.cells.cell_pairs import CellPairs
from warpmag.kernels.induction.cell_turns import CellTurns
from warpmag.kernels.induction.tangent import Tangent
from warpmag.kernels.material.curves import CurveParameters
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_gradients import PairGradients, one_sum_is_faster
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.work_list import pair_count
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.axpy import launch_add_scaled
from warpmag.moments.fmm import FastSums
from warpmag.moments.ranks import current_ranks


class SystemGradients:
    """Vector-Jacobian products of a system's solves and forces, in buffers that are allocated once.

    :meth:`load` sets the state at which gradients are computed. A graph can capture all methods but :meth:`check` and
    :meth:`parameters`. Arrays have an entry for each moment of the system, in all worlds.

    Args:
        packed: Packed moments of the system.
        state: State of its induction solves (``kernels.induction.solve_state``).
        material: Materials of its moments.
        worlds: World of each moment, NumPy, shape [n].
        ranges: (First moment, first permanent moment, end) of each world.
        rtol: Relative error of the solves, and of the linear solve.
        fmm_rtol: Relative error of fields by the fast multipole method; None means sums over all pairs.
        interaction: Fields and forces of coils, field maps and permanent bodies; None without them.
        couplings: First moment and coupling of each body of cells.
        cell_pairs: Near cells of different bodies; None without them.

    Attributes:
        cells: Gradients by poses of bodies of cells; None without them.
        coils: Gradients by coils and field maps; None without them. The caller writes their state after :meth:`load`.
        solids: Gradients by permanent bodies with closed forms; None without them. The caller writes their ``frames``
            after :meth:`load`.
        positions: State: positions [m], shape [n].
        moments: State: moments [A·m²], shape [n].
        h: State: field [A/m] in which M = f(H), shape [n].
        external_field: State: applied field [A/m], which exerts torques, shape [n].
        by_field: η, the gradient by the applied field in the solve [m/A], after :meth:`solve`, shape [n].
        fields: Gradients of the field of all moments at each other, which :meth:`solve` launches.
        by_positions: Gradient by positions [1/m], after :meth:`solve`, shape [n].
        by_moments: Field T η, the gradient by permanent moments [1/(A·m²)], after :meth:`solve`, shape [n].
    """

    def __init__(
        self,
        packed,
        state,
        material: CurveParameters,
        worlds,
        ranges,
        rtol: float,
        fmm_rtol: float | None,
        interaction: AppliedForces | None = None,
        couplings=(),
        cell_pairs: CellPairs | None = None,
    ):
        """Allocate the buffers."""
        self._moments = PackedMoments(packed.radii, largest_radius=packed.largest_radius, groups=worlds, moving=False)
        self._acting, self._bodies = self._moments.twin(), self._moments.twin(packed.labels)
        self.positions, self.moments, self.h, self.external_field, self._field, self._zero, self._given_field = (
            wp.zeros_like(state.h) for _ in range(7)
        )
        ranges = np.reshape(ranges, (-1, 3))
        ends = [0, *ranges[:, 2]]
        self._rtol, self._is_inducible = rtol, state.row.shape[0] > 0
        self._fast, sums = [], None
        if fmm_rtol is not None:
            self._fast = [FastSums(part, fmm_rtol, worlds=len(ranges)) for part in (self._acting, self._moments)]
            sums = self._fast[0].sums(Quantity.FIELD, np.arange(packed.count) < ranges[worlds, 1])
        self._evaluation = PairEvaluation(
            Quantity.FIELD, ranges[:, [0, 1, 0, 1]], self._acting, self._acting, self._zero, self._field, sums=sums,
            ranks=current_ranks(),
        )  # fmt: skip
        self._tangent = Tangent(state, self._acting, self._field, material, rtol)
        self.cells = None
        if couplings:
            self.cells = CellTurns(couplings, cell_pairs, self._acting, self._tangent.vectors, self._field)
        self._wrenches = PairGradients(self._bodies, ends, external_field=self.external_field)
        if not self._fast and one_sum_is_faster(packed.device, pair_count(ranges[:, [0, 2, 0, 2]]), packed.count):
            self.fields = PairGradients(self._moments, ends, cotangents=self._acting.moments)
        else:
            self.fields = _EvaluatedGradients(self._moments, self._acting, self._fast or (None, None), ranges)
        self.coils = self.solids = None
        if interaction is not None and interaction.sources.applied:
            self.coils = CoilGradients(interaction.sources, self._bodies, worlds)
        if interaction is not None and interaction.sources.solids:
            self.solids = SolidGradients(interaction, worlds, packed.labels)
        self.by_field = self._tangent.eta
        self.by_positions, self.by_moments = self.fields.by_positions, self.fields.by_moments

    def load(self, positions, moments, h, external_field, rotations=None) -> None:
        """Set the state at which gradients are computed, arrays as the attributes of these names.

        ``rotations`` are those of bodies of cells, shape [bodies].
        """
        for values, own in (
            (positions, self.positions),
            (moments, self.moments),
            (h, self.h),
            (external_field, self.external_field),
        ):
            wp.copy(own, values)
        self._moments.pack(self.positions, self.moments)
        self._bodies.pack(self.positions, self.moments)
        self._acting.pack(self.positions, self._zero)
        self._moments.find_overlaps()
        for fast in self._fast:
            fast.build()
        self._tangent.linearize(self.h)
        if self.cells is not None:
            wp.copy(self.cells.rotations, rotations)
            self.cells.load(self.positions)
        if self.coils is not None:
            self.coils.by_sources.zero_()
        if self.solids is not None:
            self.solids.load(self.positions, self.moments)

    def evaluate(self) -> None:
        """Launch one field evaluation of the linear solve."""
        self._evaluation.launch()
        if self.cells is not None:
            self.cells.add_field()

    def wrench(self, force_cotangents, torque_cotangents) -> PairGradients:
        """Return the gradients of a function of forces and torques, from its gradients by them, shape [n] each.

        They are by positions, moments and the external field at fixed moments; :meth:`solve` continues them.
        """
        sums = self._wrenches
        sums.launch(force_cotangents, torque_cotangents)
        if self.cells is not None:
            self.cells.add_wrench(self.moments, force_cotangents, torque_cotangents, sums.by_positions, sums.by_moments)
        if self.coils is not None:
            self.coils.launch_wrench(force_cotangents, torque_cotangents, sums.by_positions, sums.by_moments)
        if self.solids is not None:
            self.solids.launch_wrench(force_cotangents, torque_cotangents, sums.by_positions, sums.by_moments)
        return sums

    def solve(self, by_moments, by_field=None, *, warm: bool = False) -> None:
        """Compute the gradients of a function of the equilibrium.

        Args:
            by_moments: Gradient of the function by the inducible moments [1/(A·m²)], shape [n].
            by_field: Gradient of the function by the field [m/A], 0 at permanent moments, shape [n]; None means 0.
            warm: Start from the solution of the last call, for similar cotangents. The result then depends on that
                call, within ``rtol``.
        """
        tangent = self._tangent
        wp.copy(tangent.rho, by_moments)
        if by_field is not None:
            wp.copy(self._given_field, by_field)
            self._acting.pack(self.positions, self._given_field)
            wp.copy(tangent.vectors, self._given_field)
            self.evaluate()
            launch_add_scaled(self._field, tangent.rho)
        if self._is_inducible:
            tangent.start(warm)
            self._iterate()  # no world can converge before its first evaluation
            wp.capture_while(tangent.condition, self._iterate)
        tangent.finish(None if by_field is None else self._given_field)
        self.fields.launch()
        if self.cells is not None:
            self.cells.add_solve(self.moments, self.by_field, self.by_positions, self.by_moments)
        if self.coils is not None:
            self.coils.launch_field(self.by_field, self.by_positions, self.by_moments)
        if self.solids is not None:
            self.solids.launch_field(self.by_field, self.by_positions)

    def _iterate(self):
        """Launch an iteration of the linear solve."""
        self.evaluate()
        self._tangent.iterate()

    def moment_gradient(self, by_moments) -> wp.array:
        """Return ρ, the total gradient by the inducible moments [1/(A·m²)], after :meth:`solve`, shape [n]."""
        rho = wp.clone(by_moments)
        launch_add_scaled(self.by_moments, rho)
        return rho

    def parameters(self, by_moments) -> tuple[wp.array, wp.array]:
        """Return the gradients by saturations and susceptibilities, shape [n] each, after :meth:`solve`."""
        return self._tangent.parameter_gradients(self.moment_gradient(by_moments))

    def evaluations(self) -> np.ndarray:
        """Return the field evaluations of the last linear solve of each world, shape [worlds]. Waits for the device."""
        return self._tangent.evaluations()

    def check(self) -> None:
        """Check the last :meth:`solve`. Waits for the device, unless a graph is being captured.

        Raises:
            InputError: The gradient is not finite.

        Warns:
            ConvergenceWarning: The linear solve did not reach ``rtol``.
        """
        if self.h.device.is_capturing:
            return
        ratio = self._tangent.largest_residual()
        if not math.isfinite(ratio):
            raise InputError("induction: the gradient of the loss by the magnetizations or the field is not finite")
        if ratio > 0.0:
            text = f"gradient of the induction: residual {ratio * self._rtol:.2g} > rtol {self._rtol:g}"
            warn_caller(text, ConvergenceWarning)


class _EvaluatedGradients:
    """Gradients of a function of the field of moments at each other, from a field and two forces.

    Attributes and methods are those of ``PairGradients``. ``acting`` are the cotangents as moments, ``fast`` the boxes
    of both, or None for sums over all pairs, ``ranges`` those of ``SystemGradients``.
    """

    def __init__(self, moments, acting, fast, ranges):
        """Allocate the buffers."""
        segments, device = ranges[:, [0, 2, 0, 2]], moments.device
        vec3 = wp.types.vector(3, moments.dtype)
        self.by_positions, self.by_moments, zero, torques, *self._forces = (
            wp.zeros(moments.count, dtype=vec3, device=device) for _ in range(6)
        )
        no_torque = wp.zeros(moments.count, dtype=int, device=device)

        def evaluation(quantity, sources, boxes, out, **more):
            sums, ranks = boxes and boxes.sums(quantity), current_ranks()
            return PairEvaluation(quantity, segments, sources, sources, zero, out, sums=sums, ranks=ranks, **more)

        arrays = {"with_torque": no_torque, "torques": torques}
        self._evaluations = [evaluation(Quantity.FIELD, acting, fast[0], self.by_moments)] + [
            evaluation(Quantity.FORCE, sources, boxes, out, effective=targets.moments, **arrays)
            for sources, targets, boxes, out in zip(
                (acting, moments), (moments, acting), fast, self._forces, strict=True
            )
        ]

    def launch(self) -> None:
        """Launch the sums."""
        for evaluation in self._evaluations:
            evaluation.launch()
        self.by_positions.zero_()
        for forces in self._forces:
            launch_add_scaled(forces, self.by_positions, 1.0 / MU0)
