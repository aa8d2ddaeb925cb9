"""Derivative of the magnetization curve at an equilibrium, for gradients by implicit differentiation.

The derivative f'(H) = k [c' ĥĥᵀ + (c/s) (1 − ĥĥᵀ)], s = k‖H‖/Ms, is symmetric and not negative. ``Tangent`` holds the
root S of V f'(H) for each ball. See ``warpmag.moments.induction_gradients``.
"""

from functools import cache

import warp as wp

from warpmag.kernels.material.curves import CurveParameters, curve_ratio, curve_slope
from warpmag.kernels.pairs.packing import ball_volume
from warpmag.kernels.shared.native import native_options


@cache
def _tangent_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False, module_options=native_options("material/curves.h", dtype=dtype))
    def tangent(
        radii: wp.array[dtype],
        h: wp.array[vec3],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        tables: wp.array2d[dtype],
        direction_out: wp.array[vec3],
        parallel_out: wp.array[dtype],
        perpendicular_out: wp.array[dtype],
        by_saturation_out: wp.array[dtype],
        by_slope_out: wp.array[dtype],
    ):
        i = wp.tid()
        k = slope[i]
        norm = wp.length(h[i])
        s = k * norm / saturation[i]
        ratio = curve_ratio(s, k, curve[i], tables)
        steepness = wp.where(s > dtype(0.0), curve_slope(s, k, curve[i], tables), ratio)
        volume = ball_volume(radii[i])
        direction_out[i] = wp.normalize(h[i])
        parallel_out[i] = wp.sqrt(volume * k * steepness)
        perpendicular_out[i] = wp.sqrt(volume * k * ratio)
        # M = Ms c(s): ∂M/∂Ms = c − s c', ∂M/∂k = H c'
        by_saturation_out[i] = volume * s * (ratio - steepness)
        by_slope_out[i] = volume * norm * steepness

    return tangent


@cache
def _root_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def multiply_by_root(
        direction: wp.array[vec3],
        parallel: wp.array[dtype],
        perpendicular: wp.array[dtype],
        vectors: wp.array[vec3],
        products_out: wp.array[vec3],
    ):
        i = wp.tid()
        u = direction[i]
        v = vectors[i]
        products_out[i] = perpendicular[i] * v + ((parallel[i] - perpendicular[i]) * wp.dot(u, v)) * u

    return multiply_by_root


class Tangent:
    """Root S of V f'(H) [m^1.5] of n balls, a symmetric matrix each, and derivatives of V f(H) by material parameters.

    Attributes:
        direction: Direction of the field, shape [n].
        by_saturation: Derivative of V‖f‖ by the saturation [m³], shape [n].
        by_slope: Derivative of V‖f‖ by the slope k [A·m²], shape [n].
    """

    def __init__(self, radii, h, material: CurveParameters):
        """Compute the tangent in the field ``h`` [A/m]; radii [m] and field have shape [n], the material at least."""
        self.direction = wp.empty(len(h), dtype=h.dtype, device=h.device)
        out = tuple(wp.empty(len(h), dtype=radii.dtype, device=h.device) for _ in range(4))
        self._parallel, self._perpendicular, self.by_saturation, self.by_slope = out
        inputs = [radii, h, material.saturation, material.slope, material.curve, material.tables]
        wp.launch(_tangent_kernel(radii.dtype), len(h), inputs=inputs, outputs=[self.direction, *out], device=h.device)

    def times(self, vectors):
        """Return the products S v with vectors v, shape [n], in a new array."""
        products = wp.empty_like(self.direction)
        inputs = [self.direction, self._parallel, self._perpendicular, vectors]
        wp.launch(_root_kernel(self._parallel.dtype), len(products), inputs, [products], device=products.device)
        return products


@cache
def _parameters_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def parameter_gradients(
        direction: wp.array[vec3],
        by_saturation: wp.array[dtype],
        by_slope: wp.array[dtype],
        slope: wp.array[dtype],
        cotangents: wp.array[vec3],
        saturation_out: wp.array[dtype],
        susceptibility_out: wp.array[dtype],
    ):
        i = wp.tid()
        along = wp.dot(direction[i], cotangents[i])
        saturation_out[i] = by_saturation[i] * along
        # 1/k = 1/3 + 1/χ, so dk/dχ = (k/χ)² = (1 − k/3)²
        share = dtype(1.0) - slope[i] / dtype(3.0)
        susceptibility_out[i] = by_slope[i] * share * share * along

    return parameter_gradients


def launch_parameter_gradients(tangent: Tangent, slope, cotangents) -> tuple[wp.array, wp.array]:
    """Return the gradients of a loss L by saturations and by susceptibilities, each of shape [n].

    Args:
        tangent: Derivatives of the curves.
        slope: Slopes k of the curves, shape [n] or longer.
        cotangents: ∂L/∂m with m = V f, shape [n].
    """
    out = wp.empty_like(tangent.by_slope), wp.empty_like(tangent.by_slope)
    inputs = [tangent.direction, tangent.by_saturation, tangent.by_slope, slope, cotangents]
    wp.launch(_parameters_kernel(slope.dtype), len(cotangents), inputs=inputs, outputs=out, device=slope.device)
    return out


@cache
def _volume_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def volume_gradients(
        radii: wp.array[dtype],
        moments: wp.array[vec3],
        by_moments: wp.array[vec3],
        by_magnetizations_out: wp.array[vec3],
        by_radii_out: wp.array[dtype],
    ):
        i = wp.tid()
        by_magnetizations_out[i] = ball_volume(radii[i]) * by_moments[i]
        by_radii_out[i] = dtype(3.0) / radii[i] * wp.dot(moments[i], by_moments[i])

    return volume_gradients


def launch_volume_gradients(radii, moments, by_moments) -> tuple[wp.array, wp.array]:
    """Return the gradients by magnetizations and by radii of a function of the moments m = V M of balls.

    Args:
        radii: Radii R [m], positive, shape [n].
        moments: Moments [A·m²], shape [n].
        by_moments: Gradient of the function by the moments, shape [n].
    """
    device = radii.device
    out = (
        wp.empty(len(radii), dtype=moments.dtype, device=device),
        wp.empty(len(radii), dtype=radii.dtype, device=device),
    )
    wp.launch(_volume_kernel(radii.dtype), len(radii), [radii, moments, by_moments], out, device=device)
    return out
