"""Vector-Jacobian products of fields, forces and torques, by the sums over pairs that compute them.

The tensor T(r) of a pair's field, H(x_i) = Σ_j T(x_i − x_j) m_j, is symmetric and even in r. For a loss L with the
cotangents v_i = ∂L/∂H(x_i) at targets x_i, the gradients are

    ∂L/∂m_j = Σ_i T(y_j − x_i) v_i     the field of moments v at the sources,
    ∂L/∂x_i = (v_i·∇)H(x_i)            since H has no curl,
    ∂L/∂y_j = (m_j·∇)H_v(y_j)          with H_v the field of moments v.

Sources and targets exchange their roles, and the existing sums compute all three, also by multipoles. Fields of
moments at each other, and of forces, have sums of their own, ``kernels.pairs.pair_gradients``.
"""

from dataclasses import replace

import warp as wp

from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_gradients import PairGradients, one_sum_is_faster
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.kernels.pairs.wrench import MU0
from warpmag.kernels.shared.axpy import launch_add_scaled
from warpmag.moments.pair_sums import BallMoments, SumsShape, pair_sums
from warpmag.moments.tape import Gradients


def sum_field(moments: BallMoments, targets: BallMoments | None, fmm_rtol: float | None = None) -> wp.array:
    """Return the field [A/m] of moments at targets without the moments of the targets; None means the moments."""
    with pair_sums(_shape(Quantity.FIELD, moments, targets)) as sums:
        moments.pack(sums.moments)
        if targets is not None:
            replace(targets, moments=wp.zeros_like(targets.positions, requires_grad=False)).pack(sums.targets)
        sums.launch(fmm_rtol)
        return wp.clone(sums.out, requires_grad=False)


def sum_derivative(moments: BallMoments, targets: BallMoments, fmm_rtol: float | None = None) -> wp.array:
    """Return the derivative (e·∇)H of the moments' field along the moment e of each target."""
    with pair_sums(_shape(Quantity.FORCE, moments, targets)) as sums:
        moments.pack(sums.moments)
        targets.pack(sums.targets)
        sums.launch(fmm_rtol)
        derivative = wp.zeros_like(sums.out)
        launch_add_scaled(sums.out, derivative, 1.0 / MU0)  # from the force
        return derivative


def field_product(
    moments: BallMoments, targets: BallMoments | None, cotangents: wp.array, needed: set[str], fmm_rtol: float | None
) -> Gradients:
    """Return the gradients by ``positions``, ``moments`` and ``targets`` of a function of the field at targets.

    Args:
        moments: The sources.
        targets: The targets; None means the sources.
        cotangents: Gradient of the function by the field [m/A], shape [targets].
        needed: Names of the gradients to compute.
        fmm_rtol: Relative error of the fast multipole method; None means sums over all pairs.
    """
    count, by_positions = moments.count, targets is None and "positions" in needed
    if by_positions and fmm_rtol is None and one_sum_is_faster(moments.positions.device, count**2, count):
        return _mutual_product(moments, cotangents)
    acting = replace(moments if targets is None else targets, moments=cotangents)
    gradients = {}
    if "moments" in needed:
        gradients["moments"] = sum_field(acting, None if targets is None else moments, fmm_rtol)
    if "targets" in needed:
        gradients["targets"] = sum_derivative(moments, acting, fmm_rtol)
    if "positions" in needed:
        gradients["positions"] = sum_derivative(acting, moments, fmm_rtol)
        if targets is None:
            launch_add_scaled(sum_derivative(moments, acting, fmm_rtol), gradients["positions"])
    return gradients


def _mutual_product(moments: BallMoments, cotangents: wp.array) -> Gradients:
    """Return the gradients of a function of the field of moments at each other, from one sum over all pairs."""
    packed, acting = _packed(moments), _packed(replace(moments, moments=cotangents))
    sums = PairGradients(packed, (0, moments.count), cotangents=acting.moments)
    sums.launch()
    return {"positions": sums.by_positions, "moments": sums.by_moments}


def wrench_product(
    moments: BallMoments,
    external_field: wp.array,
    force_cotangents: wp.array,
    torque_cotangents: wp.array,
) -> Gradients:
    """Return the gradients by ``positions``, ``moments`` and ``external_field`` of a function of forces and torques.

    Args:
        moments: Moments that act on each other.
        external_field: Applied field H0 [A/m], shape [n].
        force_cotangents: Gradient of the function by the forces [1/N], shape [n].
        torque_cotangents: Gradient of the function by the torques [1/(N·m)], shape [n].
    """
    sums = PairGradients(_packed(moments), (0, moments.count), external_field=external_field)
    sums.launch(force_cotangents, torque_cotangents)
    return {"positions": sums.by_positions, "moments": sums.by_moments, "external_field": sums.by_external_field}


def _packed(moments: BallMoments) -> PackedMoments:
    """Return packed moments, without lists of overlapping balls."""
    radii, dtype = moments.radii, moments.positions.dtype._wp_scalar_type_
    radii = wp.zeros(moments.count, dtype=dtype, device=moments.positions.device) if radii is None else radii
    packed = PackedMoments(radii, largest_radius=moments.largest_radius, moving=False)
    moments.pack(packed)
    return packed


def _shape(quantity: Quantity, moments: BallMoments, targets: BallMoments | None) -> SumsShape:
    positions = moments.positions
    return SumsShape(
        quantity, positions.device.alias, positions.dtype._wp_scalar_type_, moments.count, moments.largest_radius,
        None if targets is None else targets.count, 0.0 if targets is None else targets.largest_radius,
    )  # fmt: skip
