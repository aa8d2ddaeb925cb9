"""Field of moments, and forces and torques between them, each in one call on arrays."""

from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.checks import check_not_negative, check_token, real_number
from warpmag.declarations.magnets import check_rtol
from warpmag.errors import InputError
from warpmag.kernels.pairs.pair_law import Quantity
from warpmag.moments.arrays import (
    LEAST_FORCE_MOMENT,
    REFERENCE_RADIUS_RANGE,
    CallContext,
    Numbers,
    check_bodies,
    first_not_finite,
    host_radii,
    largest_coordinate,
    precision_hint,
    range_message,
    resolve_context,
)
from warpmag.moments.fmm import DEFAULT_RTOL, check_fast, is_fast
from warpmag.moments.gradients import field_product, wrench_product
from warpmag.moments.pair_sums import BallMoments, SumsShape, pair_sums
from warpmag.moments.ranks import compare_arguments
from warpmag.moments.tape import check_constant, paused_tape, record

_METHODS = ("auto", "direct", "reference", "fmm")
_LEAST_FIELD_MOMENT = {wp.float32: 1e-25, wp.float64: 1e-200}
"""Lower limit [A·m²] of the largest moment component, by Warp scalar type: fields of smaller moments underflow."""


@compare_arguments
def h_field(
    positions: Numbers,
    moments: Numbers,
    targets: Numbers | None = None,
    *,
    radii: Numbers | None = None,
    target_radii: Numbers | None = None,
    smoothing: float = 0.0,
    method: str = "auto",
    rtol: float | None = None,
    dtype: str = "float32",
    device: wp.DeviceLike = None,
) -> Any:
    """Return the field H of magnetic moments (Kim and Han 2022, Eq. 1).

    Moments with a radius are uniformly magnetized balls. If a ball overlaps the target's ball, the field is averaged
    over the target. The field excludes a moment's own field. It also excludes point dipoles at a distance of
    zero from the target (in float32, below about 1e-19 m).

    On an active ``wp.Tape`` the result has gradients with respect to Warp arrays with ``requires_grad``: positions,
    moments and targets.

    Args:
        positions: Moment positions [m], shape [n, 3], NumPy or Warp.
        moments: Moments [A·m²], shape [n, 3].
        targets: Positions of the targets [m], shape [t, 3]; None means the moments' own positions.
        radii: Ball radii [m], scalar or [n]; None means point dipoles.
        target_radii: Radii [m] of the balls at the targets over which the field is averaged, scalar or [t]; None means
            points.
        smoothing: Smoothing length ℓ [m], for point dipoles only: r⁵ becomes r⁵ + ℓ⁵, where ℓ⁵ is ε² of section 5 of
            Kim and Han 2022.
        method: ``direct``: native loops over all pairs. ``reference``: a plain Warp loop. ``fmm``: the fast multipole
            method. ``auto``: the fastest method that is exact to rounding, or that meets ``rtol`` if given.
        rtol: Largest relative error ‖H − H_exact‖/‖H_exact‖ over all targets. None means 1e-3 with ``fmm``, else
            rounding.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means the device of the arrays, or Warp's default.

    Returns:
        H [A/m], shape [t, 3], as NumPy array, or as Warp array of vectors if ``positions`` is a Warp array.

    Raises:
        InputError: An argument has a wrong shape, contains no real numbers or is out of range of ``dtype``; the message
            names the limits. Or the result is not finite. Or a tape is active, and an argument requires a
            gradient that does not exist.

    Example:
        >>> import warpmag
        >>> field = warpmag.h_field([[0, 0, 0]], [[0, 0, 1]], [[0, 0, 0.1]], device="cpu")
        >>> round(float(field[0, 2]), 1)  # m / (2π r³)
        159.2
    """
    with paused_tape() as tape:
        context = resolve_context(positions, dtype, device)
        smoothing, rtol = real_number("smoothing", smoothing), None if rtol is None else real_number("rtol", rtol)
        reference = _is_reference(context, method, smoothing, radii, rtol, dtype)
        same_set = targets is None
        if same_set and target_radii is not None:
            raise InputError("target_radii: only with targets; the moments' own radii are in radii")
        size = _largest_radius("radii", radii, context.dtype, reference)
        target_size = _largest_radius("target_radii", target_radii, context.dtype, reference)
        farthest = largest_coordinate(context.dtype, size + (size if same_set else target_size), reference=reference)
        x = context.vectors("positions", positions, farthest=farthest, shared=True)
        m = context.vectors("moments", moments, x.shape[0], least=_LEAST_FIELD_MOMENT, shared=True)
        sources = _balls(context, "radii", radii, size, x, m)
        points = sources
        if not same_set:
            x = context.vectors("targets", targets, farthest=farthest, shared=True)
            points = _balls(
                context, "target_radii", target_radii, target_size, x, wp.zeros_like(x, requires_grad=False)
            )
        shape = SumsShape(
            Quantity.FIELD, context.device.alias, context.dtype, sources.count, size,
            None if same_set else points.count, target_size, reference, smoothing,
        )  # fmt: skip
        fmm_rtol = _fmm_rtol(method, rtol, shape)
        with pair_sums(shape) as sums:
            sources.pack(sums.moments)
            if not same_set:
                points.pack(sums.targets)
            sums.launch(fmm_rtol)
            _check_finite("field", context, sums.out, sources, points)
            field = context.result(sums.out, points.count)
        if tape is not None:
            check_constant({"radii": radii, "target_radii": target_radii}, "the field has none with respect to radii")
            arguments = {"positions": positions, "moments": moments, "targets": targets}
            _check_smoothing(smoothing, arguments)
            others = None if same_set else points
            record(
                tape, arguments, [field],
                lambda cotangents, needed: field_product(sources, others, cotangents[0], needed, fmm_rtol),
            )  # fmt: skip
        return field


@compare_arguments
def wrench(
    positions: Numbers,
    moments: Numbers,
    *,
    radii: Numbers | None = None,
    external_field: Numbers | None = None,
    smoothing: float = 0.0,
    method: str = "auto",
    rtol: float | None = None,
    dtype: str = "float32",
    device: wp.DeviceLike = None,
) -> tuple[Any, Any]:
    """Return the Kelvin force and the torque on each magnetic moment, from the other moments and an external field.

    F = μ0 (m·∇)H (Kim and Han 2022, Eqs. 13 and 14) and τ = μ0 m × H. The mutual forces and torques conserve linear and
    angular momentum. Point dipoles at zero distance do not act on each other.

    On an active ``wp.Tape`` the results have gradients with respect to Warp arrays with ``requires_grad``: positions,
    moments and the external field.

    Args:
        positions: Moment positions [m], shape [n, 3], NumPy or Warp.
        moments: Moments [A·m²], shape [n, 3].
        radii: Ball radii [m], scalar or [n]; None means point dipoles.
        external_field: Applied field H0 [A/m], shape [3] or [n, 3]. It exerts torques, but no forces, because its
            gradient is unknown.
        smoothing: As in :func:`h_field`.
        method: As in :func:`h_field`.
        rtol: Largest relative error of forces and of torques, see :func:`h_field`.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means the device of the arrays, or Warp's default.

    Returns:
        Forces [N] and torques about each moment's position [N·m], each of shape [n, 3], NumPy or Warp as ``positions``.

    Raises:
        InputError: An argument has a wrong shape, contains no real numbers or is out of range of ``dtype``; the message
            names the limits. Or a result is not finite. Or a tape is active, and an argument requires a
            gradient that does not exist.

    Example:
        >>> import warpmag
        >>> forces, torques = warpmag.wrench([[0, 0, 0], [0, 0, 0.1]], [[0, 0, 1], [0, 0, 1]], device="cpu")
        >>> round(float(forces[0, 2]), 4)  # aligned moments attract each other: 3 μ0 m² / (2π r⁴)
        0.006
    """
    with paused_tape() as tape:
        context = resolve_context(positions, dtype, device)
        smoothing, rtol = real_number("smoothing", smoothing), None if rtol is None else real_number("rtol", rtol)
        reference = _is_reference(context, method, smoothing, radii, rtol, dtype)
        size = _largest_radius("radii", radii, context.dtype, reference)
        farthest = largest_coordinate(context.dtype, 2.0 * size, reference=reference)
        x = context.vectors("positions", positions, farthest=farthest, shared=True)
        n = x.shape[0]
        check_bodies(f"positions: {n} moments that act on each other", n, context.dtype)
        m = context.vectors("moments", moments, n, least=LEAST_FORCE_MOMENT, shared=True)
        external = context.vectors("external_field", (0.0, 0.0, 0.0) if external_field is None else external_field, n)
        balls = _balls(context, "radii", radii, size, x, m)
        options = {"reference": reference, "smoothing": smoothing}
        shape = SumsShape(Quantity.WRENCH, context.device.alias, context.dtype, n, size, **options)
        with pair_sums(shape) as sums:
            balls.pack(sums.moments)
            wp.copy(sums.base, external)
            sums.launch(_fmm_rtol(method, rtol, shape))
            _check_finite("force", context, sums.out, balls, balls)
            _check_finite("torque", context, sums.torques, balls, balls, more=", external_field")
            forces, torques = context.result(sums.out, n), context.result(sums.torques, n)
        if tape is not None:
            check_constant({"radii": radii}, "forces and torques have none with respect to radii")
            arguments = {"positions": positions, "moments": moments, "external_field": external_field}
            _check_smoothing(smoothing, arguments)
            record(
                tape, arguments, [forces, torques],
                lambda cotangents, needed: wrench_product(balls, external, *cotangents),
            )  # fmt: skip
        return forces, torques


def _balls(context: CallContext, name, radii, size, positions, moments=None) -> BallMoments:
    """Return moments, 0 by default, with the radii of argument ``name``, at most ``size`` [m]; None means points."""
    radii = None if radii is None else context.scalars(name, radii, positions.shape[0])
    moments = wp.zeros_like(positions, requires_grad=False) if moments is None else moments
    return BallMoments(positions, moments, radii, size)


def _check_smoothing(smoothing: float, arguments: dict) -> None:
    """Raise ``InputError`` if an argument of a call with smoothing requires a gradient."""
    if smoothing > 0.0:
        check_constant(arguments, "smoothing has none: the smoothed force is no gradient; leave smoothing out")


def _fmm_rtol(method, rtol, shape: SumsShape) -> float | None:
    """Return the relative error for the fast multipole method, or None for sums over all pairs."""
    targets = shape.count if shape.target_count is None else shape.target_count
    count, pairs = shape.count + (shape.target_count or 0), targets * shape.count
    is_faster = (
        rtol is not None
        and not shape.reference  # only the plain loop computes the smoothed law
        and is_fast(pairs, count, shape.quantity, rtol, wp.get_device(shape.device), launched=True)
    )
    uses_fmm = method == "fmm" or (method == "auto" and is_faster)
    return (rtol or DEFAULT_RTOL) if uses_fmm and shape.count and shape.target_count != 0 else None


def _largest_radius(name, radii, dtype, reference) -> float:
    """Return the largest radius [m], 0 without radii; raises ``InputError`` for a radius out of range."""
    return 0.0 if radii is None else float(host_radii(name, radii, dtype, reference=reference).max(initial=0.0))


def _is_reference(context: CallContext, method, smoothing, radii, rtol, dtype) -> bool:
    """Return True if the plain loop computes the call; raises ``InputError`` for options out of range."""
    check_token("method", method, _METHODS)
    if rtol is not None:
        check_rtol("rtol", rtol, dtype)
        if method == "fmm":
            check_fast(rtol)
    check_not_negative("smoothing", smoothing)
    if smoothing > 0.0 and method == "fmm":
        raise InputError("smoothing: not with the method 'fmm'")
    if smoothing > 0.0 and radii is not None:
        raise InputError("smoothing: only for point dipoles; leave radii out")
    least, most = REFERENCE_RADIUS_RANGE[context.dtype]
    if smoothing > 0.0 and not least <= smoothing <= most:
        raise InputError(range_message("smoothing", " m", smoothing, (least, most), context.dtype))
    return method == "reference" or smoothing > 0.0


def _check_finite(name, context: CallContext, results, sources: BallMoments, targets: BallMoments, more=""):
    """Raise ``InputError`` if a result at a target is not finite.

    The message lists the arguments and ``more``, the distance of the nearest moment, and the largest moment.
    """
    row = first_not_finite(results, results.shape[0])
    if row is None:
        return
    arrays = sources.positions, targets.positions, sources.moments
    x, target, m = (array.numpy().astype(float) for array in arrays)
    distances = np.linalg.norm(x - target[row], axis=1)
    nearest = distances[distances > 0.0].min(initial=np.inf)
    raise InputError(
        f"positions, moments{more}: the {name} at row {row} is not finite, with the nearest moment at {nearest:.3g} m "
        f"and moments up to {np.abs(m).max():.3g} A·m², {precision_hint(context.dtype)}"
    )
