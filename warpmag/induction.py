"""Magnetic equilibrium of inducible balls: the one-shot call on arrays."""

import math
import warnings
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpmag.arrays import Kind, resolve_kind
from warpmag.errors import ConvergenceWarning, InputError
from warpmag.magnets import check_positive
from warpmag.system import MomentSystem


@dataclass(frozen=True)
class InductionResult:
    """Magnetic equilibrium of n balls.

    Attributes:
        magnetizations: M [A/m], shape [n, 3].
        h_field: Field H at the balls [A/m], external, from the sources and from the other balls, shape [n, 3].
        error: Relative residual ‖M − f(H)‖/‖f(H)‖ over all balls, the computable form of Eq. 12.
        evaluations: All-pairs field evaluations among the balls.
        converged: Whether ``error`` reached ``rtol``.
    """

    magnetizations: object
    h_field: object
    error: float
    evaluations: int
    converged: bool
    _system: MomentSystem
    _kind: Kind
    _count: int

    def wrench(self, force="kelvin"):
        """Force and torque on each ball from the other balls, the sources and the external field.

        Args:
            force: ``kelvin``, F = μ0 (m·∇)H (Eqs. 13, 14), or ``zeeman`` (Eq. 4), with the contact model ``dipole``.

        Returns:
            Forces [N] and torques μ0 m × H [N·m], each of shape [n, 3], in the kind of the solve's arrays. The torques
            vanish as far as the solve converged.

        Raises:
            InputError: Unknown force law.
        """
        system = self._system
        system.apply_forces(force)
        return self._kind.finish(system.forces, self._count), self._kind.finish(system.torques, self._count)


def solve_induction(
    positions,
    radii,
    *,
    saturation,
    susceptibility=math.inf,
    curve="tanh",
    external_field=None,
    sources=None,
    dynamics="theta",
    contact_model="dipole",
    rtol=1e-3,
    max_evaluations=1000,
    initial=None,
    dtype="float32",
    device=None,
):
    """Bring inducible balls to magnetic equilibrium, M = f(H), with one another and an applied field.

    Balls may overlap at will: the solution is unique for any arrangement, and the iteration safeguarded.

    Args:
        positions: Ball centres [m], shape [n, 3], NumPy or Warp.
        radii: Ball radii [m], scalar or [n].
        saturation: Saturation magnetization Ms [A/m], scalar or [n].
        susceptibility: Susceptibility [dimensionless], scalar or [n], may be infinite.
        curve: Magnetization curve, one of ``magnets.CURVES``.
        external_field: Applied field H0 [A/m], shape [3] or [n, 3].
        sources: Permanent magnets as (positions [m], moments [A·m²]), each of shape [k, 3]; point dipoles.
        dynamics: ``theta``: the exact flow of Eqs. 8 and 9, accelerated; ``theta-euler``: their explicit step;
            ``llg``, ``llg-damping``: Eq. 6 with and without precession.
        contact_model: ``dipole``; or ``multipole``, which adds what balls lack where they nearly touch, from the exact
            solution of two balls (see ``warpmag.kernels.near_contact``).
        rtol: Relative residual at which to end.
        max_evaluations: Field evaluations after which to give up; ``converged`` tells.
        initial: Magnetizations to start from [A/m], shape [n, 3].
        dtype: ``float32`` or ``float64``.
        device: Warp device; None means that of the arrays, or Warp's default.

    Returns:
        The equilibrium, an :class:`InductionResult`.

    Raises:
        InputError: An argument has a wrong shape, is not finite or is out of range.

    Warns:
        ConvergenceWarning: ``max_evaluations`` did not suffice; the result is the best that was found.
    """
    kind = resolve_kind(positions, dtype, device)
    x = kind.vectors("positions", positions)
    n = x.shape[0]
    size = _host("radii", radii, n)
    for name, value, infinite in (("saturation", saturation, False), ("susceptibility", susceptibility, True)):
        check_positive(name, float(np.min(value, initial=math.inf)) if np.size(value) else 1.0, infinite=infinite)
    if size.size and not size.min() > 0.0:
        raise InputError(f"radii: must be positive, got {size.min()}")
    external = kind.vectors("external_field", np.zeros(3) if external_field is None else external_field, n)
    source_x, source_m = (np.zeros((0, 3)),) * 2 if sources is None else sources
    source_x = kind.vectors("sources: positions", source_x)
    k = source_x.shape[0]
    source_m = kind.vectors("sources: moments", source_m, k)

    def with_sources(values):
        return np.concatenate([np.broadcast_to(np.asarray(values, float), n), np.ones(k)])

    system = MomentSystem(
        radii=np.concatenate([size, np.zeros(k)]),
        permanent=np.arange(n + k) >= n,
        movable=np.arange(n + k) < n,
        saturation=with_sources(saturation),
        susceptibility=with_sources(susceptibility),
        curve=curve,
        dynamics=dynamics,
        contact_model=contact_model,
        rtol=rtol,
        max_evaluations=max_evaluations,
        lone_torque=True,
        dtype=dtype,
        device=kind.device,
    )
    wp.copy(system.external_field, external, count=n)
    wp.copy(system.positions, x, count=n)
    if k:
        wp.copy(system.positions, source_x, dest_offset=n, count=k)
        wp.copy(system.moments, source_m, dest_offset=n, count=k)
    if initial is not None:
        system.start_from(kind.vectors("initial", initial, n))
    system.solve()
    result = InductionResult(
        magnetizations=kind.finish(system.magnetizations(), n),
        h_field=kind.finish(system.h, n),
        error=float(system.error.numpy().max(initial=0.0)),
        evaluations=int(system.evaluations.numpy().max(initial=0)),
        converged=bool(system.converged.numpy().all()),
        _system=system,
        _kind=kind,
        _count=n,
    )
    if not result.converged:
        reached = f"error {result.error:.2g} > rtol {rtol:g} after max_evaluations = {max_evaluations}"
        warnings.warn(f"solve_induction: did not converge, {reached}", ConvergenceWarning, stacklevel=2)
    return result


def _host(name, value, count):
    """NumPy float64 array of shape [count] from a scalar or an array of either kind."""
    array = np.asarray(value.numpy() if isinstance(value, wp.array) else value, float)
    if array.shape not in ((), (count,)):
        raise InputError(f"{name}: shape must be [] or [{count}], got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: must be finite")
    return np.broadcast_to(array, (count,))
