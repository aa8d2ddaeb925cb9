"""Field of moments, and forces and torques between them: one-shot calls on arrays."""

import numpy as np
import warp as wp

from warpmag.arrays import Kind, check_radii, resolve_kind, vec3_type
from warpmag.errors import InputError
from warpmag.kernels.pairs.evaluate import REFERENCE, PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_terms import Quantity
from warpmag.magnets import check_rtol, check_token

_METHODS = ("auto", "vectorized", "reference")


def h_field(
    positions,
    moments,
    targets=None,
    *,
    radii=None,
    target_radii=None,
    smoothing=0.0,
    method="auto",
    rtol=None,
    dtype="float32",
    device=None,
):
    """Field H of magnetic moments (Kim and Han 2022, Eq. 1).

    Moments with a radius are uniformly magnetized balls; where a ball overlaps the target's ball the field is the one
    averaged over the target. Point dipoles at zero distance are left out, as is a moment's own field.

    Args:
        positions: Moment positions [m], shape [n, 3], NumPy or Warp.
        moments: Moments [A·m²], shape [n, 3].
        targets: Where to evaluate [m], shape [t, 3]; None means at the moments themselves, self excluded.
        radii: Ball radii [m], scalar or [n]; None means point dipoles.
        target_radii: Radii of the balls over which to average at the targets [m], scalar or [t]; None means points.
        smoothing: Length ℓ [m] of the paper's smoothing, ε² = ℓ⁵ added to r⁵ (section 5); point dipoles only.
        method: ``vectorized`` (native loops), ``reference`` (the plain Warp loop) or ``auto``.
        rtol: Relative error wanted; the all-pairs sums are exact to rounding, so it is only checked against ``dtype``.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means that of the arrays, or Warp's default.

    Returns:
        H [A/m], shape [t, 3], NumPy or a Warp array of vectors as ``positions`` is.

    Raises:
        InputError: An argument has a wrong shape, is not finite or is out of range.
    """
    kind = resolve_kind(positions, dtype, device)
    _check_method(method, rtol, dtype)
    x = kind.vectors("positions", positions)
    m = kind.vectors("moments", moments, x.shape[0])
    same_set = targets is None
    if same_set and target_radii is not None:
        raise InputError("target_radii: only with targets; the moments' own radii are in radii")
    _check_smoothing(smoothing, radii)
    sources = _packed(kind, "radii", radii, x, m)
    at = sources
    if not same_set:
        points = kind.vectors("targets", targets)
        at = _packed(kind, "target_radii", target_radii, points, wp.zeros_like(points))
    base = wp.zeros(at.count, dtype=vec3_type(kind.dtype), device=kind.device)
    h = wp.zeros_like(base)
    form = _prepare(at, sources, method, smoothing)
    segments = [(0, at.count, 0, sources.count)]
    PairEvaluation(Quantity.FIELD, segments, at, sources, base, h, form=form, smoothing=smoothing).launch()
    return kind.finish(h)


def wrench(
    positions,
    moments,
    *,
    radii=None,
    external_field=None,
    smoothing=0.0,
    method="auto",
    rtol=None,
    dtype="float32",
    device=None,
):
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
        method: ``vectorized`` (native loops), ``reference`` (the plain Warp loop) or ``auto``.
        rtol: Relative error wanted; only checked against ``dtype``, see :func:`h_field`.
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means that of the arrays, or Warp's default.

    Returns:
        Forces [N] and torques about each moment's position [N·m], each of shape [n, 3], in the kind of ``positions``.

    Raises:
        InputError: An argument has a wrong shape, is not finite or is out of range.
    """
    kind = resolve_kind(positions, dtype, device)
    _check_method(method, rtol, dtype)
    _check_smoothing(smoothing, radii)
    x = kind.vectors("positions", positions)
    m = kind.vectors("moments", moments, x.shape[0])
    n = x.shape[0]
    external = kind.vectors("external_field", np.zeros(3) if external_field is None else external_field, n)
    packed = _packed(kind, "radii", radii, x, m)
    forces, torques = wp.zeros_like(x), wp.zeros_like(x)
    turned = wp.ones(n, dtype=int, device=kind.device)
    form = _prepare(packed, packed, method, smoothing)
    PairEvaluation(
        Quantity.WRENCH, [(0, n, 0, n)], packed, packed, external, forces, turned=turned, torques=torques, form=form,
        smoothing=smoothing,
    ).launch()  # fmt: skip
    return kind.finish(forces), kind.finish(torques)


def _packed(kind: Kind, name, radii, positions, moments) -> PackedMoments:
    """Pack one-shot arrays, radii checked under ``name``."""
    n = positions.shape[0]
    array = kind.scalars(name, 0.0 if radii is None else radii, n)
    packed = PackedMoments(array, largest_radius=_largest_radius(name, radii, kind.dtype))
    packed.pack(positions, moments)
    return packed


def _prepare(at, sources, method, smoothing):
    """Form of the sums, None for the fastest, which wants overlapping pairs to be found."""
    if method == "reference" or smoothing > 0.0:
        return REFERENCE
    at.find_overlaps(None if at is sources else sources)
    return None


def _largest_radius(name, radii, dtype) -> float:
    """Largest radius [m]; ``InputError`` for one that is negative or too small."""
    if radii is None:
        return 0.0
    host = radii.numpy() if isinstance(radii, wp.array) else np.asarray(radii, float)
    if host.size == 0:
        return 0.0
    check_radii(name, host, dtype)
    return float(host.max())


def _check_method(method, rtol, dtype):
    check_token("method", method, _METHODS)
    if rtol is not None:
        check_rtol("rtol", rtol, dtype)


def _check_smoothing(smoothing, radii):
    if not (smoothing >= 0.0 and np.isfinite(smoothing)):
        raise InputError(f"smoothing: must be zero or positive and finite, got {smoothing}")
    if smoothing > 0.0 and radii is not None:
        raise InputError("smoothing: only for point dipoles; leave radii out")
