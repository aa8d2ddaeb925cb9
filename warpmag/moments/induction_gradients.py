"""Gradients of the magnetic equilibrium by implicit differentiation, from one linear solve at the converged state.

The equilibrium is m = V f(H), H = H0 + T m, with the symmetric tensor T of the pairs' fields. Small changes obey
δm = V f' δH + …, δH = T δm + …. For a loss L with the cotangents ∂L/∂M and ∂L/∂H of the results, the total
gradients ρ = ∂L/∂m and η = ∂L/∂H of the equations solve

    ρ = V⁻¹ ∂L/∂M + T η,    η = ∂L/∂H + S² ρ,    S² = V f'(H).

Insertion with w = S ρ gives the symmetric positive definite system

    (1 − S T S) w = S (V⁻¹ ∂L/∂M + T ∂L/∂H),

the Hessian f⁻¹' − G of the energy between two roots of f', which stays finite at saturation. Conjugate gradients need
one field evaluation an iteration. Gradients by parameters follow without another solve:

| parameter | gradient |
|---|---|
| external field | η |
| permanent moments | the field of moments η at them |
| positions | (η·∇)H + (m·∇)H_η, with H_η the field of moments η |
| radii | 4πR² M·T η |
| saturation, susceptibility | ρ·∂(V f)/∂Ms, ρ·∂(V f)/∂χ |
"""

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from warpmag.errors import ConvergenceWarning, InputError
from warpmag.kernels.induction.tangent import Tangent, launch_parameter_gradients, launch_volume_gradients
from warpmag.kernels.material.curves import CurveParameters
from warpmag.kernels.pairs.packing import launch_divide_by_volume
from warpmag.kernels.shared.axpy import launch_add_scaled
from warpmag.moments.arrays import largest
from warpmag.moments.gradients import sum_derivative, sum_field, wrench_product
from warpmag.moments.pair_sums import BallMoments
from warpmag.moments.tape import Gradients

_MOST_ITERATIONS = 1000
"""Most iterations of the linear solve, as of the induction solve; a few dozen reach rounding."""


@dataclass(frozen=True)
class Equilibrium:
    """Converged state of n balls and k permanent point dipoles, as gradients need it."""

    balls: BallMoments  # with the moments m = V M of the solution
    permanent: BallMoments
    h: wp.array  # field at the balls [A/m], shape [n]
    material: CurveParameters  # of the balls, and maybe of more moments
    rtol: float  # relative error of the solution, and of the linear solve
    fmm_rtol: float | None  # relative error of fields by the fast multipole method; None means sums over all pairs

    def product(self, cotangents: list[wp.array], needed: set[str]) -> Gradients:
        """Return the gradients by the arguments ``needed`` of :func:`warpmag.solve_induction`.

        Args:
            cotangents: ∂L/∂M and ∂L/∂H, shape [n] each.
            needed: Names of arguments; permanent moments are ``permanent: positions`` and ``permanent: moments``.
        """
        by_magnetization, by_field = cotangents
        by_moment = wp.zeros_like(by_field)
        launch_divide_by_volume(by_magnetization, self.balls.radii, by_moment)
        return self._product(by_moment, by_field, needed)

    def product_of_moments(self, by_moment: wp.array, needed: set[str]) -> Gradients:
        """Return the gradients by the arguments ``needed`` of a function of the moments m = V M, from ∂L/∂m."""
        return self._product(by_moment, wp.zeros_like(by_moment), needed)

    def _product(self, by_moment: wp.array, by_field: wp.array, needed: set[str]) -> Gradients:
        """Return the gradients from V⁻¹ ∂L/∂M and ∂L/∂H."""
        tangent = Tangent(self.balls.radii, self.h, self.material)
        own = self._field(by_field) if largest(by_field) != 0.0 else wp.zeros_like(by_field)
        rho = wp.clone(by_moment)
        launch_add_scaled(own, rho)
        right = tangent.times(rho)
        size = largest(right)
        if not math.isfinite(size):
            raise InputError("induction: the gradient of the loss by the magnetizations or the field is not finite")
        w, coupled = self._solve(tangent, _scaled(right, 1.0 / size if size > 0.0 else 0.0))
        w, coupled = _scaled(w, size), _scaled(coupled, size)
        launch_add_scaled(coupled, own)  # T η = T (∂L/∂H + S w)
        launch_add_scaled(coupled, rho)  # ρ = V⁻¹ ∂L/∂M + T η
        eta = tangent.times(w)
        launch_add_scaled(by_field, eta)
        return self._gradients(eta, own, rho, tangent, needed)

    def _field(self, vectors: wp.array) -> wp.array:
        """Return T v, the field at the balls of moments v at the balls."""
        return sum_field(replace(self.balls, moments=vectors), None, self.fmm_rtol)

    def _solve(self, tangent: Tangent, right: wp.array) -> tuple[wp.array, wp.array]:
        """Return the solution w of (1 − S T S) w = ``right`` by conjugate gradients, and T S w.

        The matrix is positive definite with eigenvalues below 3, so that the residual bounds the error. Components of
        ``right`` are at most 1, so that squares do not underflow.
        """
        w, coupled, residual, direction = wp.zeros_like(right), wp.zeros_like(right), wp.clone(right), wp.clone(right)
        first = square = _inner(residual, residual)
        least = (self.rtol * self.rtol) * first
        for _ in range(_MOST_ITERATIONS):
            if square <= least:
                break
            field = self._field(tangent.times(direction))
            image = wp.clone(direction)
            launch_add_scaled(tangent.times(field), image, -1.0)
            step = square / _inner(direction, image)
            launch_add_scaled(direction, w, step)
            launch_add_scaled(field, coupled, step)
            launch_add_scaled(image, residual, -step)
            before, square = square, _inner(residual, residual)
            next_direction = wp.clone(residual)
            launch_add_scaled(direction, next_direction, square / before)
            direction = next_direction
        else:
            text = f"gradient of solve_induction: residual {math.sqrt(square / first):.2g} > rtol {self.rtol:g}"
            warnings.warn(text, ConvergenceWarning, stacklevel=2)
        return w, coupled

    def _gradients(self, eta, eta_field, rho, tangent: Tangent, needed: set[str]) -> Gradients:
        """Return the gradients by the arguments ``needed`` from η, T η and ρ."""
        balls, permanent = self.balls, self.permanent
        acting = replace(balls, moments=eta)
        gradients = {"external_field": eta}
        if "positions" in needed:
            gradients["positions"] = sum_derivative(balls, acting, self.fmm_rtol)
            launch_add_scaled(sum_derivative(acting, balls, self.fmm_rtol), gradients["positions"])
            if permanent.count:
                launch_add_scaled(sum_derivative(permanent, acting), gradients["positions"])
        if "permanent: positions" in needed:
            gradients["permanent: positions"] = sum_derivative(acting, permanent)
        if "permanent: moments" in needed:
            gradients["permanent: moments"] = sum_field(acting, permanent)
        if "radii" in needed:
            _, gradients["radii"] = launch_volume_gradients(balls.radii, balls.moments, eta_field)
        if needed & {"saturation", "susceptibility"}:
            parameters = launch_parameter_gradients(tangent, self.material.slope, rho)
            gradients["saturation"], gradients["susceptibility"] = parameters
        return gradients


def wrench_product_of_balls(moments: BallMoments, count: int, external_field: wp.array, cotangents: list[wp.array]):
    """Return the gradients of a function of the forces and torques on the first ``count`` moments, which are balls.

    The gradients by ``magnetizations`` are partial: the equilibrium continues them. Names are as in
    :meth:`Equilibrium.product`.

    Args:
        moments: Balls with radii, then permanent dipoles; n in all.
        count: Number of balls, at least 1.
        external_field: Applied field [A/m], shape [n].
        cotangents: ∂L/∂F and ∂L/∂τ, shape [count] each.
    """
    padded = [wp.zeros(moments.count, dtype=external_field.dtype, device=external_field.device) for _ in cotangents]
    for cotangent, rows in zip(cotangents, padded, strict=True):
        wp.copy(rows, cotangent, count=count)
    gradients = wrench_product(moments, external_field, *padded)
    balls = {name: gradient[:count] for name, gradient in gradients.items()}
    parts = launch_volume_gradients(moments.radii[:count], moments.moments[:count], balls.pop("moments"))
    balls["magnetizations"], balls["radii"] = parts
    if moments.count > count:
        balls |= {f"permanent: {name}": gradients[name][count:] for name in ("positions", "moments")}
    return balls


def _scaled(values: wp.array, factor: float) -> wp.array:
    """Return a factor times an array."""
    product = wp.zeros_like(values)
    launch_add_scaled(values, product, factor)
    return product


def _inner(a: wp.array, b: wp.array) -> float:
    """Return the inner product of two arrays of vectors; waits for the device."""
    product: Any = wp.utils.array_inner(a, b)
    return float(product)
