"""Magnetic equilibrium of inducible balls in one call on arrays."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpmag.declarations.checks import check_token, short_repr
from warpmag.declarations.curves import MagnetizationCurve
from warpmag.declarations.magnets import FORCES
from warpmag.declarations.materials import measured
from warpmag.errors import ConvergenceWarning, InputError, warn_caller
from warpmag.moments.arrays import (
    LEAST_FORCE_MOMENT,
    CallContext,
    Numbers,
    dtype_name,
    first_not_finite,
    host_radii,
    host_scalars,
    largest,
    largest_coordinate,
    precision_hint,
    real_array,
    resolve_context,
)
from warpmag.moments.induction_gradients import POINT_ARRAYS, BallGradients
from warpmag.moments.layout import MomentMaterial
from warpmag.moments.ranks import compare_arguments
from warpmag.moments.settings import SolverSettings
from warpmag.moments.system import MomentSystem
from warpmag.moments.tape import check_constant, differentiable, paused_tape, record

_FIELD_RANGE = {wp.float32: (3e-19, 1e12), wp.float64: (1e-100, 1e100)}
"""Smallest and largest field in units of the saturation, by Warp scalar type: squares and roots stay accurate."""
_PLAUSIBLE = {wp.float32: (1e-15, 1e15), wp.float64: (1e-100, 1e100)}
"""Range of plausible values by Warp scalar type. If a result is not finite, the error names arguments beyond it."""


@dataclass(frozen=True)
class InductionResult:
    """Magnetic equilibrium of n balls, returned by :func:`solve_induction`.

    A result can be pickled and copied. The copy has NumPy arrays, and its :meth:`wrench` raises an error.

    Attributes:
        magnetizations: M [A/m], shape [n, 3].
        h_field: Field H at each ball [A/m], without the field of the ball itself, shape [n, 3].
        error: Estimated relative error of the magnetizations, ‖M − M*‖/‖M*‖ over all balls, where M* is the exact
            solution. With ``dynamics="theta"`` it is the last residual times its estimated amplification (see
            ``warpmag.kernels.induction.theta_flow``). With other dynamics it is the residual ‖M − f(H)‖/‖f(H)‖, the
            computable form of Eq. 12 of Kim and Han 2022.
        evaluations: Number of field evaluations.
        converged: True if ``error`` is at most ``rtol``.
        field_error: Relative error ‖H − H_exact‖/‖H_exact‖ of the fast multipole method's field at 256 random balls,
            where H_exact is from sums over all pairs; 0 without the method.
    """

    magnetizations: Any
    h_field: Any
    error: float
    evaluations: int
    converged: bool
    field_error: float
    _system: MomentSystem | None = field(repr=False)
    _context: CallContext = field(repr=False)
    _arguments: dict = field(repr=False)
    _balls: "_Balls" = field(repr=False)
    _curve: Any = field(repr=False)  # as the argument, or the measured curve of its points

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without those on the device, for pickle and copy."""
        state = dict.fromkeys(vars(self)) | {name: value for name, value in vars(self).items() if name[0] != "_"}
        return {name: value.numpy() if isinstance(value, wp.array) else value for name, value in state.items()}

    def wrench(self, force: str = "kelvin") -> tuple[Any, Any]:
        """Return force and torque on each ball, from the other balls, permanent moments and the external field.

        Args:
            force: ``kelvin``, F = μ0 (m·∇)H (Kim and Han 2022, Eqs. 13, 14). ``zeeman``: Eq. 4, only with the contact
                model ``dipole``.

        Returns:
            Forces [N] and torques μ0 m × H [N·m], each of shape [n, 3], NumPy or Warp like the solve's arrays. The
            torques are 0 at exact convergence.

        Raises:
            InputError: The force law is unknown, a force is not finite, or moments are too small for forces in this
                precision. Or the result is a copy, without the moments on the device.

        Example:
            >>> import warpmag
            >>> pair = warpmag.solve_induction(
            ...     [[0, 0, 0], [0, 0, 0.012]], 0.005, saturation=1.7e6, external_field=(0, 0, 1e5), device="cpu"
            ... )
            >>> forces, torques = pair.wrench()
            >>> bool(forces[0, 2] > 0.0)  # the balls attract each other along the field
            True
        """
        check_token("force", force, FORCES)
        if self._system is None:
            raise InputError("wrench: a copied or unpickled result has no moments on a device, call wrench() before")
        system, dtype, count = self._system, self._context.dtype, self._balls.count
        with paused_tape() as tape:
            system.apply_forces(force)
            strongest = largest(system.moments)
            if 0.0 < strongest < LEAST_FORCE_MOMENT[dtype]:
                raise InputError(
                    f"radii, saturation, external_field: moments of at most {strongest:.3g} A·m² are too small for "
                    f"forces {precision_hint(dtype)}"
                )
            forces, torques = (self._context.result(array, count) for array in (system.forces, system.torques))
            _check_finite(dtype, count, self._arguments, force=forces, torque=torques)
            if tape is not None and count:
                self._record_wrench(tape, force, forces, torques)
        return forces, torques

    def _record(self, tape: wp.Tape) -> None:
        """Record the gradients of the solve on a tape."""
        self._check_overlaps()
        results = [self.magnetizations, self.h_field]
        record(tape, self._arguments, results, lambda *product: self._gradients.of_solve(*product))

    @cached_property
    def _gradients(self) -> BallGradients:
        """Gradients at the state of the solve."""
        system = self._system
        assert system is not None
        system.gradients.load(system.positions, system.moments, system.h, system.external_field)
        point_count = len(self._arguments.get(POINT_ARRAYS[0], ()))
        return BallGradients(system.gradients, system.radii, self._balls.count, self._curve, point_count)

    def _record_wrench(self, tape: wp.Tape, force: str, forces, torques) -> None:
        """Record the gradients of forces and torques on a tape."""
        settings, arguments = self._system.settings, {**self._arguments, "magnetizations": self.magnetizations}
        for name in ("saturation", "susceptibility", *POINT_ARRAYS):  # they act through the magnetizations
            arguments.pop(name, None)
        _check_differentiable(settings, arguments)
        self._check_overlaps()
        if force != "kelvin":
            check_constant(arguments, f"the force {force!r} has none; use 'kelvin'")
        record(tape, arguments, [forces, torques], lambda cotangents, _: self._gradients.of_wrench(cotangents))

    def _check_overlaps(self) -> None:
        """Raise ``InputError`` if radii of overlapping balls require gradients."""
        radii = {"radii": self._arguments["radii"]}
        if differentiable(radii) and self._system.overlaps:
            check_constant(radii, "overlapping balls have none with respect to radii; move them apart")


@compare_arguments
def solve_induction(
    positions: Numbers,
    radii: Numbers,
    *,
    saturation: Numbers | None = None,
    susceptibility: Numbers = math.inf,
    curve: str | MagnetizationCurve | Sequence[str | MagnetizationCurve] = "tanh",
    curve_points: tuple[Numbers, Numbers] | None = None,
    external_field: Numbers | None = None,
    permanent: tuple[Numbers, Numbers] | None = None,
    dynamics: str = "theta",
    contact_model: str = "dipole",
    method: str = "auto",
    rtol: float = 1e-3,
    max_evaluations: int = 1000,
    initial: Numbers | None = None,
    dtype: str = "float32",
    device: wp.DeviceLike = None,
    sources: tuple[Numbers, Numbers] | None = None,
) -> InductionResult:
    """Return the magnetic equilibrium M = f(H) of inducible balls in an applied field (Kim and Han 2022, Eq. 5).

    Balls may overlap. With the contact model ``dipole`` and sums over all pairs the solution is unique for any
    arrangement.

    On an active ``wp.Tape`` the result has gradients with respect to Warp arrays with ``requires_grad``: positions,
    radii, saturation, susceptibility, points of a curve, external field and permanent moments with their positions.

    Args:
        positions: Ball centers [m], shape [n, 3], NumPy or Warp.
        radii: Ball radii [m], scalar or [n].
        saturation: Saturation magnetization Ms [A/m], scalar or [n]; required unless all curves are measured.
        susceptibility: Susceptibility [dimensionless], scalar or [n], may be infinite.
        curve: Formula of the magnetization curve, ``tanh``, ``langevin``, ``clamped``, ``frohlich`` or
            ``tanh-applied``. Or a measured curve: a :class:`warpmag.MagnetizationCurve`, or the name of a material that
            has one. Measured curves have their own saturation and susceptibility. A tuple or list of n contains the
            curve of each ball.
        curve_points: Points of a measured curve of all balls in place of ``curve``: (fields H inside [A/m],
            magnetizations M [A/m]), each of shape [points], as for :meth:`warpmag.MagnetizationCurve.from_mh`.
        external_field: Applied field H0 [A/m], shape [3] or [n, 3].
        permanent: Permanent point dipoles as (positions [m], moments [A·m²]), each of shape [k, 3].
        dynamics: ``theta``: accelerated exact flow of Eqs. 8 and 9. ``theta-euler``: their explicit step. ``llg``,
            ``llg-damping``: Eq. 6 with and without precession.
        contact_model: ``dipole``; ``multipole`` adds the higher multipoles of balls that nearly touch, from the exact
            solution of two balls (see ``warpmag.kernels.near_contact``). With ``dipole`` two balls in line with the
            field attract too weakly: by 34 % at a gap of 0.3 radii, by 93 % at 0.01.
        method: Summation of fields: ``direct`` over all pairs, ``fmm`` by the fast multipole method with an error
            within ``rtol``, or ``auto`` for the faster one.
        rtol: Relative error of the magnetizations at which the solve ends.
        max_evaluations: Field evaluations after which the solve ends unconverged.
        initial: Magnetizations to start from [A/m], shape [n, 3].
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means the device of the arrays, or Warp's default.
        sources: Deprecated name of ``permanent``.

    Returns:
        The equilibrium, an :class:`InductionResult`.

    Raises:
        InputError: An argument has a wrong shape, contains no real numbers or is out of range of ``dtype``; the message
            names the limits. Or the result is not finite. Or a tape is active, and an argument requires a
            gradient that does not exist.

    Warns:
        ConvergenceWarning: ``max_evaluations`` field evaluations did not reach ``rtol``; the best result is returned.

    Example:
        >>> import warpmag
        >>> field = (0, 0, 1e4)
        >>> ball = warpmag.solve_induction([[0, 0, 0]], 0.005, saturation=1.7e6, external_field=field, device="cpu")
        >>> round(float(ball.magnetizations[0, 2]), -2)  # 3 H0 far below saturation
        30000.0
    """
    if sources is not None:
        warn_caller("solve_induction: sources is deprecated, use permanent", DeprecationWarning)
        permanent = sources if permanent is None else permanent
    settings = SolverSettings(
        dynamics=dynamics, contact_model=contact_model, method=method, rtol=rtol, max_evaluations=max_evaluations,
        single_torque=True,
    )  # fmt: skip
    arguments = {"positions": positions, "radii": radii, "saturation": saturation, "susceptibility": susceptibility}
    arguments["external_field"] = external_field
    with paused_tape() as tape:
        context = resolve_context(positions, dtype, device)
        balls = _read_balls(context, positions, radii, external_field, permanent)
        if permanent is not None:
            arguments["permanent: positions"], arguments["permanent: moments"] = permanent
        if curve_points is not None:
            curve, points = _read_points(curve, curve_points)
            arguments |= points
        if tape is not None:
            settings.check(dtype_name(context.dtype))
            _check_differentiable(settings, arguments)
        material = _read_material(balls.count, saturation, susceptibility, curve)
        system = balls.make_system(context, material, settings, initial)
        system.solve()
        result = _read_result(context, system, balls, arguments, initial, curve)
        if tape is not None and balls.count:
            result._record(tape)
    return result


@dataclass(frozen=True)
class _Balls:
    """n inducible balls in an applied field, and k permanent point dipoles."""

    positions: wp.array  # centers [m], shape [n]
    radii: np.ndarray  # radii [m], shape [n]
    external_field: wp.array  # applied field [A/m], shape [n]
    permanent_positions: wp.array  # positions of the dipoles [m], shape [k]
    permanent_moments: wp.array  # moments of the dipoles [A·m²], shape [k]

    @property
    def count(self) -> int:
        """Number n of balls."""
        return self.positions.shape[0]

    def make_system(self, context: CallContext, material: MomentMaterial, settings, initial) -> MomentSystem:
        """Return a system of the balls, followed by the permanent dipoles, that starts from ``initial`` if given."""
        n, k = self.count, self.permanent_positions.shape[0]

        def padded(values):  # the values of permanent moments are ignored
            return np.append(values, np.ones(k))

        system = MomentSystem(
            radii=np.append(self.radii, np.zeros(k)),
            permanent=np.arange(n + k) >= n,
            movable=np.arange(n + k) < n,
            material=MomentMaterial(
                padded(material.saturation),
                padded(material.susceptibility),
                [*material.curve, *["tanh"] * k] if isinstance(material.curve, list) else material.curve,
            ),
            settings=settings,
            dtype=dtype_name(context.dtype),
            device=context.device,
        )
        wp.copy(system.external_field, self.external_field, count=n)
        wp.copy(system.positions, self.positions, count=n)
        if k:
            wp.copy(system.positions, self.permanent_positions, dest_offset=n, count=k)
            wp.copy(system.moments, self.permanent_moments, dest_offset=n, count=k)
        if initial is not None:
            system.start_from(context.vectors("initial", initial, n))
        return system


def permanent_dipoles(permanent) -> tuple[Any, Any]:
    """Return positions and moments of the argument ``permanent``, of no dipoles if it is None."""
    return (np.zeros((0, 3)), np.zeros((0, 3))) if permanent is None else pair_of("permanent", permanent)


def pair_of(name: str, value) -> tuple[Any, Any]:
    """Return the two arrays of the argument ``permanent`` or ``curve_points``, or None twice for None."""
    if value is None:
        return None, None
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        names = "positions, moments" if name == "permanent" else "fields, magnetizations"
        raise InputError(f"{name}: must be ({names}), got {short_repr(value)}")
    first, second = value
    return first, second


def _read_points(curve, points) -> tuple[MagnetizationCurve, dict[str, Any]]:
    """Return the curve of the argument ``curve_points``, and its two arrays by name."""
    if not isinstance(curve, str) or curve != "tanh":
        raise InputError("curve_points: replace curve, give one or the other")
    arrays: dict[str, Any] = dict(zip(POINT_ARRAYS, pair_of("curve_points", points), strict=True))
    fields, magnetizations = (real_array(name, values) for name, values in arrays.items())
    return MagnetizationCurve.from_mh(fields, magnetizations, name="curve_points"), arrays


def _read_balls(context: CallContext, positions, radii, external_field, permanent) -> _Balls:
    """Return the checked arrays of :func:`solve_induction`."""
    radii = host_radii("radii", radii, context.dtype)
    farthest = largest_coordinate(context.dtype, 2.0 * float(radii.max(initial=0.0)))
    x = context.vectors("positions", positions, farthest=farthest)
    n = x.shape[0]
    radii = host_scalars("radii", radii, n)
    if not (radii > 0.0).all():
        raise InputError(f"radii: must be positive, got {radii.min():g}")
    applied_field = context.vectors("external_field", (0.0, 0.0, 0.0) if external_field is None else external_field, n)
    dipoles, moments = permanent_dipoles(permanent)
    dipoles = context.vectors("permanent: positions", dipoles, farthest=farthest)
    moments = context.vectors("permanent: moments", moments, dipoles.shape[0])
    return _Balls(x, radii, applied_field, dipoles, moments)


def _read_material(count: int, saturation, susceptibility, curve) -> MomentMaterial:
    """Return the material of ``count`` balls: arrays, and one curve or a list of ``count``.

    :meth:`MomentMaterial.parameters` checks the values, and replaces the values of balls with measured curves.
    """
    is_list = isinstance(curve, (tuple, list)) and len(curve) == count and count > 0
    curves = [measured("curve", item) for item in curve] if is_list else [measured("curve", curve)]
    if all(isinstance(item, MagnetizationCurve) for item in curves):
        if saturation is not None or not np.array_equal(susceptibility, math.inf):
            name = "saturation" if saturation is not None else "susceptibility"
            raise InputError(f"{name}: a measured curve has its own, give one or the other")
    elif saturation is None:
        raise InputError("saturation: must be given, unless all curves are measured")
    return MomentMaterial(
        host_scalars("saturation", 1.0 if saturation is None else saturation, count),
        host_scalars("susceptibility", susceptibility, count, infinite=True),
        curves if is_list else curves[0],
    )


def _check_differentiable(settings: SolverSettings, arguments: dict) -> None:
    """Raise ``InputError`` if an argument requires a gradient that a solve with these settings does not have."""
    if settings.dynamics != "theta":
        check_constant(arguments, f"the dynamics {settings.dynamics!r} has none; use 'theta'")
    if settings.contact_model != "dipole":
        check_constant(arguments, f"the contact model {settings.contact_model!r} has none; use 'dipole'")


def _read_result(
    context: CallContext, system: MomentSystem, balls: _Balls, arguments, initial, curve
) -> InductionResult:
    """Return the result of a solve, checked to be finite, and warn if it did not converge."""
    dtype, n = context.dtype, balls.count
    saturations = system.material.saturation.numpy()[:n]
    m, h = (context.result(array, n) for array in (system.magnetizations(), system.h))
    _check_finite(dtype, n, {**arguments, "initial": initial}, magnetization=m, field=h)
    error = float(system.error.numpy().max(initial=0.0))
    if not math.isfinite(error):
        raise InputError(f"external_field, permanent, saturation: the error is not finite {precision_hint(dtype)}")
    strongest = float(np.abs(h if isinstance(h, np.ndarray) else h.numpy()).max(initial=0.0))
    _check_strength(dtype, strongest, saturations)
    converged = bool(system.converged.numpy().all())
    if not converged:
        text = f"error {error:.2g} > rtol {system.rtol:g} after {int(system.evaluations.numpy().max())} evaluations"
        warn_caller(f"solve_induction: did not converge, {text}", ConvergenceWarning)
    field_error = system.field_error()
    if field_error > system.rtol:
        text = f"solve_induction: fields have an error of {field_error:.2g} > rtol {system.rtol:g}; use method direct"
        warn_caller(text, ConvergenceWarning)
    evaluations = int(system.evaluations.numpy().max(initial=0))
    return InductionResult(m, h, error, evaluations, converged, field_error, system, context, arguments, balls, curve)


def _check_strength(dtype, strongest: float, saturation):
    """Raise ``InputError`` if the strongest field [A/m] is too weak or too strong for the saturations in ``dtype``."""
    least, most = _FIELD_RANGE[dtype]
    tiny = float(np.finfo(dtype_name(dtype)).tiny)  # smaller numbers count as zero
    weak = tiny <= strongest < least * max(1.0, saturation.max(initial=0.0))
    if weak or strongest > most * saturation.min(initial=np.inf):
        adjective, limit = ("weak", saturation.max()) if weak else ("strong", saturation.min())
        raise InputError(
            f"external_field, permanent, saturation: a field of {strongest:.3g} A/m is too {adjective} for a "
            f"saturation of {limit:.3g} A/m {precision_hint(dtype)}"
        )


def _check_finite(dtype, count: int, arguments: dict, **results):
    """Raise ``InputError`` if one of the first ``count`` rows of a result is not finite.

    The message names the arguments with unusually large or small values, or else all arguments.
    """
    rows = {name: first_not_finite(array, count) for name, array in results.items()}
    failures = [f"the {name} of ball {row}" for name, row in rows.items() if row is not None]
    if not failures:
        return
    least, most = _PLAUSIBLE[dtype]
    sizes = {name: np.abs(real_array(name, value)) for name, value in arguments.items() if value is not None}
    sizes = {name: size[np.isfinite(size)] for name, size in sizes.items()}  # a susceptibility may be infinite
    unusual = [name for name, size in sizes.items() if ((size > 0.0) & ~((size > least) & (size < most))).any()]
    raise InputError(f"{', '.join(unusual or sizes)}: {failures[0]} is not finite {precision_hint(dtype)}")
