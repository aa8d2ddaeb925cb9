"""Field of moments, and forces and torques between them: one-shot calls on arrays."""

from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.checks import check_not_negative, check_token
from warpmag.declarations.magnets import check_rtol
from warpmag.errors import InputError
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.moments.arrays import (
    LEAST_OF_FORCE,
    REFERENCE_RADIUS_RANGE,
    Kind,
    Numbers,
    check_bodies,
    farthest_place,
    first_not_finite,
    hint,
    host_radii,
    range_message,
    resolve_kind,
)
from warpmag.moments.fmm import USUAL_RTOL, check_fast, is_fast
from warpmag.moments.pair_sums import SumsShape, pair_sums
from warpmag.moments.ranks import alike

_METHODS = ("auto", "direct", "reference", "fmm")
_LEAST_OF_FIELD = {wp.float32: 1e-25, wp.float64: 1e-200}
"""Least of the largest component of moments [A·m²]: fields of smaller ones have no digits left."""


@alike
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
    """Field H of magnetic moments (Kim and Han 2022, Eq. 1).

    Moments with a radius are uniformly magnetized balls; where a ball overlaps the target's ball the field is the one
    averaged over the target. Point dipoles at zero distance are left out, as is a moment's own field; zero is what is
    nearer than about 1e-19 m in float32.

    Args:
        positions: Moment positions [m], shape [n, 3], NumPy or Warp.
        moments: Moments [A·m²], shape [n, 3].
        targets: Where to evaluate [m], shape [t, 3]; None means at the moments themselves, self excluded.
        radii: Ball radii [m], scalar or [n]; None means point dipoles.
        target_radii: Radii of the balls over which to average at the targets [m], scalar or [t]; None means points.
        smoothing: Length ℓ [m] of the paper's smoothing, ε² = ℓ⁵ added to r⁵ (section 5); point dipoles only.
        method: ``direct`` (native loops over all pairs), ``reference`` (the plain Warp loop), ``fmm`` (the fast
            multipole method) or ``auto``: the fastest that is exact to rounding, or as ``rtol`` allows.
        rtol: Relative error allowed, ‖H − H_exact‖/‖H_exact‖ over all targets. None means 1e-3 with ``fmm``, and none
            otherwise.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means that of the arrays, or Warp's default.

    Returns:
        H [A/m], shape [t, 3], NumPy or a Warp array of vectors as ``positions`` is.

    Raises:
        InputError: An argument has a wrong shape, holds no real numbers, is out of range of ``dtype`` (see
            ``warpmag.moments.arrays``), or the result is not finite.
    """
    kind = resolve_kind(positions, dtype, device)
    reference = _is_reference(kind, method, smoothing, radii, rtol, dtype)
    same_set = targets is None
    if same_set and target_radii is not None:
        raise InputError("target_radii: only with targets; the moments' own radii are in radii")
    size, target_size = (_largest_radius(name, r, kind.dtype, reference) for name, r in _named(radii, target_radii))
    farthest = farthest_place(kind.dtype, size + (size if same_set else target_size), reference=reference)
    x = kind.vectors("positions", positions, farthest=farthest, shared=True)
    m = kind.vectors("moments", moments, x.shape[0], least=_LEAST_OF_FIELD, shared=True)
    points = x if same_set else kind.vectors("targets", targets, farthest=farthest, shared=True)
    t = None if same_set else points.shape[0]
    shape = SumsShape(
        Quantity.FIELD, kind.device.alias, kind.dtype, x.shape[0], size, t, target_size, reference, smoothing
    )
    with pair_sums(shape) as sums:
        _pack(kind, "radii", radii, sums.moments, x, m)
        if not same_set:
            _pack(kind, "target_radii", target_radii, sums.targets, points, wp.zeros_like(points))
        sums.launch(_fmm_rtol(method, rtol, shape))
        _check_finite("field", kind, sums.out, x, m, points)
        return kind.finish(sums.out, points.shape[0])


@alike
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
    """Kelvin force and torque on each of a set of magnetic moments, mutual and from an external field.

    F = μ0 (m·∇)H (Kim and Han 2022, Eqs. 13 and 14) and τ = μ0 m × H. Mutual forces obey Newton's third law, and with
    the torques angular momentum is conserved.

    Args:
        positions: Moment positions [m], shape [n, 3], NumPy or Warp.
        moments: Moments [A·m²], shape [n, 3].
        radii: Ball radii [m], scalar or [n]; None means point dipoles.
        external_field: Applied field H0 [A/m], shape [3] or [n, 3]; it turns moments, and, being given without a
            gradient, does not pull them.
        smoothing: Length ℓ [m] of the paper's smoothing, ε² = ℓ⁵ added to r⁵ (section 5); point dipoles only.
        method: As in :func:`h_field`.
        rtol: Relative error allowed of forces and torques, see :func:`h_field`.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means that of the arrays, or Warp's default.

    Returns:
        Forces [N] and torques about each moment's position [N·m], each of shape [n, 3], in the kind of ``positions``.

    Raises:
        InputError: An argument has a wrong shape, holds no real numbers, is out of range of ``dtype`` (see
            ``warpmag.moments.arrays``), or the result is not finite.
    """
    kind = resolve_kind(positions, dtype, device)
    reference = _is_reference(kind, method, smoothing, radii, rtol, dtype)
    size = _largest_radius("radii", radii, kind.dtype, reference)
    farthest = farthest_place(kind.dtype, 2.0 * size, reference=reference)
    x = kind.vectors("positions", positions, farthest=farthest, shared=True)
    n = x.shape[0]
    check_bodies(f"positions: {n} moments that act on each other", n, kind.dtype)
    m = kind.vectors("moments", moments, n, least=LEAST_OF_FORCE, shared=True)
    external = kind.vectors("external_field", (0.0, 0.0, 0.0) if external_field is None else external_field, n)
    shape = SumsShape(Quantity.WRENCH, kind.device.alias, kind.dtype, n, size, reference=reference, smoothing=smoothing)
    with pair_sums(shape) as sums:
        _pack(kind, "radii", radii, sums.moments, x, m)
        wp.copy(sums.base, external)
        sums.launch(_fmm_rtol(method, rtol, shape))
        _check_finite("force", kind, sums.out, x, m, x)
        _check_finite("torque", kind, sums.torques, x, m, x, more=", external_field")
        return kind.finish(sums.out, n), kind.finish(sums.torques, n)


def _named(radii, target_radii):
    return ("radii", radii), ("target_radii", target_radii)


def _pack(kind: Kind, name, radii, packed: PackedMoments, positions, moments) -> None:
    """Pack one-shot arrays, radii under ``name``; points have those that the packed moments began with."""
    if radii is not None:
        wp.copy(packed.radii, kind.scalars(name, radii, positions.shape[0]))
    packed.pack(positions, moments)


def _fmm_rtol(method, rtol, shape: SumsShape) -> float | None:
    """Error to allow the fast multipole method, None where it is not wanted or would not be faster."""
    targets = shape.count if shape.target_count is None else shape.target_count
    count, pairs = shape.count + (shape.target_count or 0), targets * shape.count
    better = (
        rtol is not None
        and not shape.reference  # the plain loop alone has the smoothed law
        and is_fast(pairs, count, shape.quantity, rtol, wp.get_device(shape.device), launched=True)
    )
    wanted = method == "fmm" or (method == "auto" and better)
    return (rtol or USUAL_RTOL) if wanted and shape.count and shape.target_count != 0 else None


def _largest_radius(name, radii, dtype, reference) -> float:
    """Largest radius [m], zero for none; ``InputError`` for one that is out of range."""
    return 0.0 if radii is None else float(host_radii(name, radii, dtype, reference=reference).max(initial=0.0))


def _is_reference(kind: Kind, method, smoothing, radii, rtol, dtype) -> bool:
    """Whether the plain loop is to be used; ``InputError`` where options are out of range."""
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
    least, most = REFERENCE_RADIUS_RANGE[kind.dtype]
    if smoothing > 0.0 and not least <= smoothing <= most:
        raise InputError(range_message("smoothing", " m", smoothing, (least, most), kind.dtype))
    return method == "reference" or smoothing > 0.0


def _check_finite(what, kind: Kind, results, positions, moments, at, more=""):
    """Raise ``InputError`` where results [n] at places ``at`` are not finite, with what is likely to be the cause."""
    row = first_not_finite(results, results.shape[0])
    if row is None:
        return
    x, place, m = (a.numpy().astype(float) for a in (positions, at, moments))
    apart = np.linalg.norm(x - place[row], axis=1)
    nearest = apart[apart > 0.0].min(initial=np.inf)
    raise InputError(
        f"positions, moments{more}: the {what} at row {row} is not finite, with the nearest moment at {nearest:.3g} m "
        f"and moments up to {np.abs(m).max():.3g} A·m², {hint(kind.dtype)}"
    )
