"""Magnetic equilibrium of inducible balls: the one-shot call on arrays."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.checks import short_repr
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.materials import measured
from warpmag.errors import ConvergenceWarning, InputError
from warpmag.moments.arrays import (
    LEAST_OF_FORCE,
    Kind,
    Numbers,
    farthest_place,
    first_not_finite,
    hint,
    host_positive,
    host_radii,
    host_scalars,
    largest,
    name_of,
    real_array,
    resolve_kind,
)
from warpmag.moments.ranks import alike
from warpmag.moments.system import MomentSystem

_FIELD_RANGE = {wp.float32: (3e-19, 1e12), wp.float64: (1e-100, 1e100)}
"""Least and largest field in units of saturation of which neither square nor root is lost, by Warp scalar type."""
_USUAL = {wp.float32: (1e-15, 1e15), wp.float64: (1e-100, 1e100)}
"""Numbers that are not the cause where a result is not finite, by Warp scalar type."""


@dataclass(frozen=True)
class InductionResult:
    """Magnetic equilibrium of n balls.

    Attributes:
        magnetizations: M [A/m], shape [n, 3].
        h_field: Field H at the balls [A/m], external, from the sources and from the other balls, shape [n, 3].
        error: Estimate of the relative error of the magnetizations, ‖M − M*‖/‖M*‖ over all balls, M* being the exact
            solution, rounding apart: the residual of the last iterate times what the solve learnt of its amplification
            (see ``warpmag.kernels.induction.theta_flow``). Of other dynamics than ``theta`` that residual,
            ‖M − f(H)‖/‖f(H)‖, the computable form of Eq. 12.
        evaluations: All-pairs field evaluations among the balls.
        converged: Whether ``error`` is at most ``rtol``.
        field_error: Relative error ‖H − H_exact‖/‖H_exact‖ of the fields that the solve went by, measured at 256 random
            balls by sums over all pairs: that of the fast multipole method, or 0 without it.
    """

    magnetizations: Any
    h_field: Any
    error: float
    evaluations: int
    converged: bool
    field_error: float
    _system: MomentSystem = field(repr=False)
    _kind: Kind = field(repr=False)
    _given: dict = field(repr=False)
    _count: int = field(repr=False)

    def wrench(self, force: str = "kelvin") -> tuple[Any, Any]:
        """Force and torque on each ball from the other balls, the sources and the external field.

        Args:
            force: ``kelvin``, F = μ0 (m·∇)H (Eqs. 13, 14), or ``zeeman`` (Eq. 4), with the contact model ``dipole``.

        Returns:
            Forces [N] and torques μ0 m × H [N·m], each of shape [n, 3], in the kind of the solve's arrays. The torques
            vanish as far as the solve converged.

        Raises:
            InputError: Unknown force law, a force that is not finite, or moments so small that it would have no digits.
        """
        system = self._system
        system.apply_forces(force)
        strongest = largest(system.moments)
        if 0.0 < strongest < LEAST_OF_FORCE[self._kind.dtype]:
            raise InputError(
                f"radii, saturation, external_field: moments of at most {strongest:.3g} A·m² are too small for forces "
                f"{hint(self._kind.dtype)}"
            )
        forces, torques = (self._kind.finish(array, self._count) for array in (system.forces, system.torques))
        _check_finite(self._kind, self._count, self._given, force=forces, torque=torques)
        return forces, torques


@alike
def solve_induction(
    positions: Numbers,
    radii: Numbers,
    *,
    saturation: Numbers | None = None,
    susceptibility: Numbers = math.inf,
    curve: str | MagnetizationCurve | Sequence[str | MagnetizationCurve] = "tanh",
    external_field: Numbers | None = None,
    sources: tuple[Numbers, Numbers] | None = None,
    dynamics: str = "theta",
    contact_model: str = "dipole",
    method: str = "auto",
    rtol: float = 1e-3,
    max_evaluations: int = 1000,
    initial: Numbers | None = None,
    dtype: str = "float32",
    device: wp.DeviceLike = None,
) -> InductionResult:
    """Bring inducible balls to magnetic equilibrium, M = f(H), with one another and an applied field.

    Balls may overlap at will: with the contact model ``dipole`` and sums over all pairs, the solution is unique for any
    arrangement. The iteration is safeguarded, and warns where it ends early.

    Args:
        positions: Ball centres [m], shape [n, 3], NumPy or Warp.
        radii: Ball radii [m], scalar or [n].
        saturation: Saturation magnetization Ms [A/m], scalar or [n]; must be given, unless all curves are measured.
        susceptibility: Susceptibility [dimensionless], scalar or [n], may be infinite.
        curve: Magnetization curve: one of ``magnets.CURVES``, or a measured one, which has its own saturation and
            susceptibility, as a :class:`warpmag.MagnetizationCurve` or the name of a material that has one. A tuple or
            list of n gives each ball its own.
        external_field: Applied field H0 [A/m], shape [3] or [n, 3].
        sources: Permanent magnets as (positions [m], moments [A·m²]), each of shape [k, 3]; point dipoles.
        dynamics: ``theta``: the exact flow of Eqs. 8 and 9, accelerated; ``theta-euler``: their explicit step;
            ``llg``, ``llg-damping``: Eq. 6 with and without precession.
        contact_model: ``dipole``; or ``multipole``, which adds what balls lack where they nearly touch, from the exact
            solution of two balls (see ``warpmag.kernels.near_contact``).
        method: How fields are summed: ``direct``, over all pairs; ``fmm``, by the fast multipole method, to an
            error that ``rtol`` allows; or ``auto``, the faster one.
        rtol: Relative error of the magnetizations to reach.
        max_evaluations: Field evaluations after which to give up; ``converged`` tells.
        initial: Magnetizations to start from [A/m], shape [n, 3].
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means that of the arrays, or Warp's default.

    Returns:
        The equilibrium, an :class:`InductionResult`.

    Raises:
        InputError: An argument has a wrong shape, holds no real numbers, is out of range of ``dtype`` (see
            ``warpmag.moments.arrays``), or the result is not finite.

    Warns:
        ConvergenceWarning: ``max_evaluations`` did not suffice; the result is the best that was found.
    """
    kind = resolve_kind(positions, dtype, device)
    balls = _read_balls(kind, positions, radii, saturation, susceptibility, curve, external_field, sources)
    choices = {"dynamics": dynamics, "contact_model": contact_model, "rtol": rtol, "max_evaluations": max_evaluations}
    choices["method"] = method
    system = balls.make_system(kind, initial, **choices)
    system.solve()
    return _read_result(kind, system, balls, _by_name(balls, positions, external_field, sources, initial))


@dataclass(frozen=True)
class _Balls:
    """n inducible balls in an applied field, and k permanent magnets, on the device or still on the host.

    Attributes:
        positions: Centres [m], Warp, shape [n].
        radii: Radii [m], shape [n].
        saturation: Saturation magnetizations [A/m], shape [n].
        susceptibility: Susceptibilities [dimensionless], shape [n].
        curves: Magnetization curves, one for all, or n.
        external: Applied field [A/m], Warp, shape [n].
        source_positions: Places of the permanent magnets [m], Warp, shape [k].
        source_moments: Their moments [A·m²], Warp, shape [k].
    """

    positions: wp.array
    radii: np.ndarray
    saturation: np.ndarray
    susceptibility: np.ndarray
    curves: list
    external: wp.array
    source_positions: wp.array
    source_moments: wp.array

    @property
    def count(self) -> int:
        """How many they are."""
        return self.positions.shape[0]

    def make_system(self, kind: Kind, initial, **choices) -> MomentSystem:
        """Return them as moments, the permanent ones last, before a solve from ``initial`` magnetizations or None."""
        n, k = self.count, self.source_positions.shape[0]

        def with_sources(values, others):
            return np.concatenate([values, np.full(k, others)])

        system = MomentSystem(
            radii=with_sources(self.radii, 0.0),
            permanent=np.arange(n + k) >= n,
            movable=np.arange(n + k) < n,
            saturation=with_sources(self.saturation, 1.0),
            susceptibility=with_sources(self.susceptibility, 1.0),
            curve=self.curves[0] if len(self.curves) == 1 else [*self.curves, *["tanh"] * k],
            lone_torque=True,
            dtype=name_of(kind.dtype),
            device=kind.device,
            **choices,
        )
        wp.copy(system.external_field, self.external, count=n)
        wp.copy(system.positions, self.positions, count=n)
        if k:
            wp.copy(system.positions, self.source_positions, dest_offset=n, count=k)
            wp.copy(system.moments, self.source_moments, dest_offset=n, count=k)
        if initial is not None:
            system.start_from(kind.vectors("initial", initial, n))
        return system


def _read_balls(kind: Kind, positions, radii, saturation, susceptibility, curve, external_field, sources) -> _Balls:
    """Return the arguments of :func:`solve_induction` as arrays; raises ``InputError`` for those that cannot be."""
    size = host_radii("radii", radii, kind.dtype)
    farthest = farthest_place(kind.dtype, 2.0 * float(size.max(initial=0.0)))
    x = kind.vectors("positions", positions, farthest=farthest)
    n = x.shape[0]
    size = host_scalars("radii", size, n)
    if not (size > 0.0).all():
        raise InputError(f"radii: must be positive, got {size.min():g}")
    external = kind.vectors("external_field", (0.0, 0.0, 0.0) if external_field is None else external_field, n)
    source_positions, source_moments = _sources(kind, sources, farthest)
    curves = _curves(curve, n)
    saturation, susceptibility = _materials(curves, saturation, susceptibility)
    return _Balls(
        positions=x,
        radii=size,
        saturation=host_positive("saturation", saturation, n, kind.dtype),
        susceptibility=host_positive("susceptibility", susceptibility, n, kind.dtype, infinite=True),
        curves=curves,
        external=external,
        source_positions=source_positions,
        source_moments=source_moments,
    )


def _curves(curve, count: int) -> list:
    """Return the curve of all balls, or those of each of ``count``."""
    each = isinstance(curve, (tuple, list)) and len(curve) == count and count > 0
    return [measured("curve", one) for one in curve] if each else [measured("curve", curve)]


def _materials(curves: list, saturation, susceptibility):
    """Return saturations and susceptibilities, measured ones in the place of those that are given."""
    tables = np.array([isinstance(one, MagnetizationCurve) for one in curves])
    if tables.all() and (saturation is not None or not np.array_equal(susceptibility, math.inf)):
        which = "saturation" if saturation is not None else "susceptibility"
        raise InputError(f"{which}: a measured curve says it, give one or the other")
    if saturation is None and not tables.all():
        raise InputError("saturation: must be given, unless all curves are measured")
    if not tables.any():
        return saturation, susceptibility
    given = [host_scalars("saturation", 1.0 if saturation is None else saturation, len(curves))]
    given.append(host_scalars("susceptibility", susceptibility, len(curves), infinite=True))
    own = [[getattr(one, name) if of_table else 1.0 for one, of_table in zip(curves, tables, strict=True)]
           for name in ("saturation", "susceptibility")]  # fmt: skip
    found = [np.where(tables, *pair) for pair in zip(own, given, strict=True)]
    return (found[0][0], found[1][0]) if len(curves) == 1 else tuple(found)


def _by_name(balls: _Balls, positions, external_field, sources, initial) -> dict:
    """Return the arrays that the caller has given, by the names that messages call them."""
    source_positions, source_moments = (None, None) if sources is None else sources
    return {
        "positions": positions,
        "radii": balls.radii,
        "saturation": balls.saturation,
        "external_field": external_field,
        "sources: positions": source_positions,
        "sources: moments": source_moments,
        "initial": initial,
    }


def _read_result(kind: Kind, system: MomentSystem, balls: _Balls, given: dict) -> InductionResult:
    """Return what a solve ended with, and warn if it did not converge.

    Raises:
        InputError: The result is not finite, or was not to be resolved.
    """
    n = balls.count
    m, h = (kind.finish(array, n) for array in (system.magnetizations(), system.h))
    _check_finite(kind, n, given, magnetization=m, field=h)
    error = float(system.error.numpy().max(initial=0.0))
    if not math.isfinite(error):
        raise InputError(f"external_field, sources, saturation: the error is not finite {hint(kind.dtype)}")
    strongest = float(np.abs(h if isinstance(h, np.ndarray) else h.numpy()).max(initial=0.0))
    _check_strength(kind, strongest, balls.saturation)
    converged = bool(system.converged.numpy().all())
    if not converged:
        reached = f"error {error:.2g} > rtol {system.rtol:g} after max_evaluations = {system.max_evaluations}"
        warnings.warn(f"solve_induction: did not converge, {reached}", ConvergenceWarning, stacklevel=3)
    field_error = system.field_error()
    if field_error > system.rtol:
        text = f"solve_induction: fields have an error of {field_error:.2g} > rtol {system.rtol:g}; use method direct"
        warnings.warn(text, ConvergenceWarning, stacklevel=3)
    return InductionResult(
        magnetizations=m,
        h_field=h,
        error=error,
        evaluations=int(system.evaluations.numpy().max(initial=0)),
        converged=converged,
        field_error=field_error,
        _system=system,
        _kind=kind,
        _given=given,
        _count=n,
    )


def _sources(kind: Kind, sources, farthest):
    """Positions and moments of permanent magnets, none if ``sources`` is None, as Warp arrays."""
    if sources is None:
        sources = np.zeros((0, 3)), np.zeros((0, 3))
    if not isinstance(sources, (tuple, list)) or len(sources) != 2:
        raise InputError(f"sources: must be (positions, moments), got {short_repr(sources)}")
    x = kind.vectors("sources: positions", sources[0], farthest=farthest)
    return x, kind.vectors("sources: moments", sources[1], x.shape[0])


def _check_strength(kind: Kind, strongest: float, saturation):
    """Raise ``InputError`` where the ``strongest`` field [A/m] is so weak or strong that a solve cannot resolve it."""
    least, most = _FIELD_RANGE[kind.dtype]
    tiny = float(np.finfo(name_of(kind.dtype)).tiny)  # what is smaller counts as zero
    weak = tiny <= strongest < least * max(1.0, saturation.max(initial=0.0))
    if weak or strongest > most * saturation.min(initial=np.inf):
        how, of = ("weak", saturation.max()) if weak else ("strong", saturation.min())
        raise InputError(
            f"external_field, sources, saturation: a field of {strongest:.3g} A/m is too {how} for a saturation of "
            f"{of:.3g} A/m {hint(kind.dtype)}"
        )


def _check_finite(kind: Kind, count: int, given: dict, **results):
    """Raise ``InputError`` where a row of results of the first ``count`` is not finite.

    The message names those of the ``given`` arguments that are likely to be the cause.
    """
    rows = {what: first_not_finite(array, count) for what, array in results.items()}
    where = [f"the {what} of ball {row}" for what, row in rows.items() if row is not None]
    if not where:
        return
    least, most = _USUAL[kind.dtype]
    sizes = {name: np.abs(real_array(name, value)) for name, value in given.items() if value is not None}
    unusual = [name for name, size in sizes.items() if ((size > 0.0) & ~((size > least) & (size < most))).any()]
    raise InputError(f"{', '.join(unusual or sizes)}: {where[0]} is not finite {hint(kind.dtype)}")
