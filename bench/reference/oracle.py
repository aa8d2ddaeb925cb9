"""Reference implementation of warpmag's physics in NumPy, float64.

Every kernel is tested against this module. It is short, slow and does not use Warp. Where possible, formulas have
another form than in the kernels.

| symbol | shape | unit | meaning |
|---|---|---|---|
| positions | [n, 3] | m | positions of the moments |
| moments | [n, 3] | A·m² | m = V M |
| radii | [n] | m | radius of the uniformly magnetized ball of a moment; 0 is a point dipole |
| h | [n, 3] | A/m | field of all other moments |
| gradients | [n, 3, 3] | A/m² | ∂H_k/∂x_l |

References: Kim and Han 2022, "Fast Stabilization of Inducible Magnet Simulation", Eqs. 1, 4, 7, 10, 13, 14.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

MU0 = 4e-7 * math.pi  # vacuum permeability [T·m/A], the conventional value


def relative(values, expected) -> float:
    """L2 norm of the error of ``values`` over the L2 norm of the expected ones."""
    return float(np.linalg.norm(values - expected) / np.linalg.norm(expected))


# ---------- Pair law ----------


def radial_factors(distance, radius_i, radius_j, smoothing=0.0):
    """Radial factors g1, g2, g3 of the pair law.

    With r = x_i − x_j, a moment m at j has at i the field H = (g1 m + g2 r (r·m)) / 4π, and the gradient
    ∂H_k/∂x_l = (g2 [r_k m_l + m_k r_l + δ_kl r·m] + g3 (r·m) r_k r_l) / 4π.

    For a potential U(d), g1 = U'/d, g2 = g1'/d, g3 = g2'/d. Balls that do not overlap are point dipoles, U = 1/d.
    For overlapping balls the field of one is averaged over the other,
    U = 1/d + (a+b−d)⁴ (5a² − 20ab + 5b² − 4(a+b)d − d²) / (160 a³b³d), and −1/A³ where the smaller lies inside the
    larger of radius A.

    Args:
        distance: Distances d [m], any shape. Zero distance between point dipoles gives zero factors.
        radius_i: Target radii [m], broadcastable.
        radius_j: Source radii [m], broadcastable.
        smoothing: Length ℓ [m] of the paper's smoothing, ε² = ℓ⁵ added to d⁵ (section 5); point dipoles only.

    Returns:
        g1 [1/m³], g2 [1/m⁵], g3 [1/m⁷], shaped like the broadcast arguments.
    """
    d, a, b = np.broadcast_arrays(np.asarray(distance, float), np.asarray(radius_i, float), np.asarray(radius_j, float))
    safe = np.where(d > 0.0, d, 1.0)
    if smoothing > 0.0:
        w = 1.0 / (safe**5 + smoothing**5)
        g1, g2, g3 = -(safe**2) * w, 3.0 * w, -15.0 * w / safe**2
        return tuple(np.where(d > 0.0, g, 0.0) for g in (g1, g2, g3))
    g1, g2, g3 = -1.0 / safe**3, 3.0 / safe**5, -15.0 / safe**7
    g1, g2, g3 = (np.where(d > 0.0, g, 0.0) for g in (g1, g2, g3))

    # a point inside a ball has g1 = −1/A³, as has a small ball inside a large one
    inside = (d <= np.abs(a - b)) & (np.maximum(a, b) > 0.0)
    large = np.where(inside, np.maximum(a, b), 1.0)
    g1 = np.where(inside, -1.0 / large**3, g1)
    g2, g3 = np.where(inside, 0.0, g2), np.where(inside, 0.0, g3)

    partial = (d < a + b) & ~inside
    if np.any(partial):
        for g, value in zip((g1, g2, g3), _overlap_factors(d[partial], a[partial], b[partial]), strict=True):
            g[partial] = value
    return g1, g2, g3


def _overlap_factors(d, a, b):
    """Factors of partially overlapping balls, |a − b| < d < a + b, from the derivatives of U."""
    s, p, delta2 = a + b, a * b, (a - b) ** 2
    c = 1.0 / (160.0 * p**3)
    # U as a Laurent polynomial in d: exact at small d, where the printed form cancels
    k = 5.0 * delta2**2 * (delta2 + 6.0 * p)
    u1, u2, u3 = 45.0 * s**2 * delta2, -40.0 * s * (delta2 + p), 15.0 * (delta2 + 2.0 * p)
    g1 = c * (-k / d**3 + u1 / d + 2.0 * u2 + 3.0 * u3 * d - 5.0 * d**3)
    g2 = c * (3.0 * k / d**5 - u1 / d**3 + 3.0 * u3 / d - 15.0 * d)
    g3 = c * (-15.0 * k / d**7 + 3.0 * u1 / d**5 - 3.0 * u3 / d**3 - 15.0 / d)
    # the printed form, for d near a + b and for very different radii, where the polynomial cancels; q is q0/d − 4s − d
    # without cancellation
    e, q0 = s - d, 5.0 * a**2 - 20.0 * p + 5.0 * b**2
    q, q1, q2, q3 = (6.0 * s * e - 30.0 * p - e**2) / d, -q0 / d**2 - 1.0, 2.0 * q0 / d**3, -6.0 * q0 / d**4
    w1 = -4.0 * e**3 * q + e**4 * q1
    w2 = 12.0 * e**2 * q - 8.0 * e**3 * q1 + e**4 * q2
    w3 = -24.0 * e * q + 36.0 * e**2 * q1 - 12.0 * e**3 * q2 + e**4 * q3
    far = d > 0.5 * s
    g1 = np.where(far, -1.0 / d**3 + c * w1 / d, g1)
    g2 = np.where(far, 3.0 / d**5 + c * (w2 / d**2 - w1 / d**3), g2)
    g3 = np.where(far, -15.0 / d**7 + c * (w3 / d**3 - 3.0 * w2 / d**4 + 3.0 * w1 / d**5), g3)
    return g1, g2, g3


def _pairs(positions, targets=None, *, radii=None, target_radii=None, bodies=None, smoothing=0.0, chunk=256):
    """Yield separations [t, n, 3] and radial factors [t, n] of ``chunk`` targets at a time; see :func:`h_field`."""
    positions = np.asarray(positions, float)
    radii = np.broadcast_to(0.0 if radii is None else np.asarray(radii, float), len(positions))
    same_body = None
    if targets is None:
        bodies = np.arange(len(positions)) if bodies is None else np.asarray(bodies)
        targets, target_radii, same_body = positions, radii, bodies[:, None] == bodies
    targets = np.asarray(targets, float)
    target_radii = np.broadcast_to(0.0 if target_radii is None else np.asarray(target_radii, float), len(targets))
    for start in range(0, len(targets), chunk):
        rows = slice(start, start + chunk)
        r = targets[rows, None] - positions
        factors = radial_factors(np.sqrt(np.einsum("tnk,tnk->tn", r, r)), target_radii[rows, None], radii, smoothing)
        yield r, *(factors if same_body is None else (np.where(same_body[rows], 0.0, g) for g in factors))


def h_field(positions, moments, targets=None, **settings):
    """Field of moments at targets, or at each other (Eq. 1, with the ball-averaged law for overlapping balls).

    Args:
        positions: Moment positions [m], shape [n, 3].
        moments: Moments [A·m²], shape [n, 3].
        targets: Field points [m], shape [t, 3]; None means the moments themselves, without their own fields.
        radii: Radii of the moments' balls [m], scalar or [n]; None means point dipoles.
        target_radii: Radii of the balls over which the field at a target is averaged [m]; None means points.
        bodies: Body of each moment, shape [n]; moments of one body do not act on each other. Only without targets.
        smoothing: Length ℓ [m], see :func:`radial_factors`.
        chunk: Number of targets evaluated at a time.

    Returns:
        H [A/m], shape [t, 3].
    """
    moments, parts = np.asarray(moments, float), [np.empty((0, 3))]
    for r, g1, g2, _ in _pairs(positions, targets, **settings):
        rm = np.einsum("tnk,nk->tn", r, moments)
        parts.append((g1 @ moments + np.einsum("tn,tnk->tk", g2 * rm, r)) / (4.0 * np.pi))
    return np.concatenate(parts)


def field_gradient(positions, moments, targets=None, **settings):
    """Gradient ∂H_k/∂x_l [A/m²] of the moments' field, shape [t, 3, 3]; arguments as in :func:`h_field`."""
    moments, parts = np.asarray(moments, float), [np.empty((0, 3, 3))]
    for r, _, g2, g3 in _pairs(positions, targets, **settings):
        rm = np.einsum("tnk,nk->tn", r, moments)
        outer = np.einsum("tn,tnk,nl->tkl", g2, r, moments)
        trace = np.einsum("tn,tn->t", g2, rm)[:, None, None] * np.eye(3)
        along = np.einsum("tn,tnk,tnl->tkl", g3 * rm, r, r)
        parts.append((outer + outer.transpose(0, 2, 1) + trace + along) / (4.0 * np.pi))
    return np.concatenate(parts)


# ---------- Magnetization curves ----------


def curve_slope(susceptibility):
    """Initial slope k = 3χ/(3+χ) of a ball's magnetization against the applied field; 3 for infinite χ."""
    susceptibility = np.asarray(susceptibility, float)
    return np.where(np.isinf(susceptibility), 3.0, 3.0 / (1.0 + 3.0 / susceptibility))


def reduced_curve(s, curve: str | Callable) -> tuple[np.ndarray, np.ndarray]:
    """Reduced magnetization ‖M‖/Ms of a reduced field s = k‖H‖/Ms, and its derivative.

    ``curve`` is the name of a curve, or a function of s that returns both.
    """
    s = np.asarray(s, float)
    if callable(curve):
        return curve(s)
    if curve in ("tanh", "tanh-applied"):  # Eq. 10
        return np.tanh(s), 1.0 / np.cosh(np.minimum(s, 300.0)) ** 2
    if curve == "clamped":  # Eq. 7
        return np.minimum(s, 1.0), np.where(s < 1.0, 1.0, 0.0)
    if curve == "frohlich":
        return s / (1.0 + s), 1.0 / (1.0 + s) ** 2
    if curve == "langevin":  # L(3s), so that the slope at zero is one
        x = 3.0 * s
        y = np.where(x < 0.1, 1.0, x)
        small = x / 3.0 - x**3 / 45.0 + 2.0 * x**5 / 945.0 - x**7 / 4725.0
        dsmall = 1.0 / 3.0 - x**2 / 15.0 + 2.0 * x**4 / 189.0 - x**6 / 675.0
        with np.errstate(over="ignore"):
            value = 1.0 / np.tanh(y) - 1.0 / y
            slope = 1.0 / y**2 - 1.0 / np.sinh(np.minimum(y, 300.0)) ** 2
        return np.where(x < 0.1, small, value), 3.0 * np.where(x < 0.1, dsmall, slope)
    raise ValueError(f"curve: {curve!r} is not one of tanh, langevin, clamped, frohlich, tanh-applied")


def inner_curve(curve, susceptibility):
    """Curve of a cell as a function for :func:`reduced_curve`: M is ``curve`` in the field H − M/3 inside.

    M = Ms c(y), y = χ H'/Ms with the field H' inside, so that s = k H/Ms = (k/χ) y + (k/3) c(y), solved by bisection.
    """
    if math.isinf(susceptibility):
        return lambda s: reduced_curve(s, "clamped")
    k = float(curve_slope(susceptibility))

    def of_reduced_field(s):
        low, high = np.zeros_like(s), s * susceptibility / k
        for _ in range(200):
            y = 0.5 * (low + high)
            above = k / susceptibility * y + k / 3.0 * reduced_curve(y, curve)[0] > s
            low, high = np.where(above, low, y), np.where(above, y, high)
        value, slope = reduced_curve(0.5 * (low + high), curve)
        return value, slope / (k / susceptibility + k / 3.0 * slope)

    return of_reduced_field


def magnetization(h, saturation, susceptibility=math.inf, curve="tanh"):
    """Magnetization M = f(H) [A/m] and its derivative ∂M/∂H [n, 3, 3] for fields H [A/m], shape [n, 3]."""
    h = np.asarray(h, float)
    ms = np.broadcast_to(np.asarray(saturation, float), len(h))
    k = np.broadcast_to(curve_slope(susceptibility), len(h))
    norm = np.linalg.norm(h, axis=1)
    unit = h / np.where(norm > 0.0, norm, 1.0)[:, None]
    value, slope = reduced_curve(k * norm / ms, curve)
    along = k * slope
    across = np.where(norm > 0.0, ms * value / np.where(norm > 0.0, norm, 1.0), k)
    outer = unit[:, :, None] * unit[:, None, :]
    derivative = across[:, None, None] * (np.eye(3) - outer) + along[:, None, None] * outer
    return ms[:, None] * value[:, None] * unit, derivative


# ---------- Force and torque ----------


def kelvin_force(moments, gradients):
    """Kelvin force F = μ0 (m·∇)H [N], shape [n, 3] (Eqs. 13, 14)."""
    return MU0 * np.einsum("nl,nkl->nk", np.asarray(moments, float), gradients)


def zeeman_force(volumes, h, gradients, magnetizations, derivative):
    """Force of the Zeeman energy F = μ0 V [f'(H) ∇H (2M + H) + ∇H M] [N], shape [n, 3] (Eq. 4)."""
    inner = np.einsum("nkl,nl->nk", derivative, 2.0 * magnetizations + h) + magnetizations
    return MU0 * np.asarray(volumes, float)[:, None] * np.einsum("nkl,nl->nk", gradients, inner)


def torque(moments, h):
    """Torque τ = μ0 m × H [N·m], shape [n, 3]."""
    return MU0 * np.cross(np.asarray(moments, float), h)


# ---------- Induction ----------


@dataclass
class Equilibrium:
    """Magnetic equilibrium: magnetizations and field [A/m], shape [n, 3], and the relative residual left."""

    magnetizations: np.ndarray
    h: np.ndarray
    residual: float


def coupling_matrix(positions, radii):
    """Matrix G [dimensionless], shape [3n, 3n], with H = G M for uniformly magnetized balls, without own fields."""
    positions = np.asarray(positions, float)
    n = len(positions)
    radii = np.broadcast_to(np.asarray(radii, float), n)
    r, g1, g2, _ = next(_pairs(positions, radii=radii, chunk=n))
    volumes = 4.0 / 3.0 * np.pi * radii**3
    blocks = g1[:, :, None, None] * np.eye(3) + g2[:, :, None, None] * r[:, :, :, None] * r[:, :, None, :]
    blocks *= volumes[None, :, None, None] / (4.0 * np.pi)
    return blocks.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def equilibrium(
    positions, radii, h0, *, saturation, susceptibility=math.inf, curve="tanh", extra_coupling=0.0, tolerance=1e-13
):
    """Magnetic equilibrium M = f(H0 + G M) by damped Newton iterations on the dense system.

    Solves R(H) = H − H0 − G f(H) = 0 for H, which is well conditioned when M saturates.

    Args:
        positions: Ball centers [m], shape [n, 3].
        radii: Ball radii [m], scalar or [n].
        h0: Applied field [A/m], shape [3] or [n, 3].
        saturation: Saturation magnetization Ms [A/m], scalar or [n].
        susceptibility: Susceptibility [dimensionless], scalar or [n], may be infinite.
        curve: Magnetization curve, see :func:`reduced_curve`.
        extra_coupling: Matrix added to the dipoles' coupling G, shape [3n, 3n].
        tolerance: Relative residual at which to stop.
    """
    g = coupling_matrix(positions, radii) + extra_coupling
    n = len(g) // 3
    h0 = np.broadcast_to(np.asarray(h0, float), (n, 3)).copy()
    h = h0.copy()

    def residual(h):
        m, derivative = magnetization(h, saturation, susceptibility, curve)
        return h - h0 - (g @ m.ravel()).reshape(n, 3), m, derivative

    value, m, derivative = residual(h)
    scale = max(np.linalg.norm(h0), np.finfo(float).tiny)
    for _ in range(200):
        size = np.linalg.norm(value)
        if size <= tolerance * max(scale, np.linalg.norm(h)):
            break
        jacobian = np.eye(3 * n) - np.einsum("aik,ikl->ail", g.reshape(3 * n, n, 3), derivative).reshape(3 * n, 3 * n)
        step = np.linalg.solve(jacobian, value.ravel()).reshape(n, 3)
        damping = 1.0
        while damping > 1e-8:
            trial = residual(h - damping * step)
            if np.linalg.norm(trial[0]) < (1.0 - 1e-4 * damping) * size:
                break
            damping *= 0.5
        else:
            break
        h = h - damping * step
        value, m, derivative = trial
    return Equilibrium(m, h, float(np.linalg.norm(value) / max(np.linalg.norm(h), np.finfo(float).tiny)))


# ---------- Eddy currents ----------


def eddy_coefficient(radii, conductivity):
    """c = (2π/15) σ R⁵ [S·m⁴]: power of eddy currents in a ball over |dB/dt|² inside (Landau and Lifshitz, §59)."""
    return 2.0 * math.pi / 15.0 * np.asarray(conductivity, float) * np.asarray(radii, float) ** 5


def flux_rates(positions, moments, radii, velocities, angular_velocities, derivatives, field=None, *, time=1e-6):
    """dB/dt [T/s] inside balls in co-rotating frames, shape [n, 3], by central differences of fields.

    Args:
        positions, moments, radii: The moments, fixed in their bodies.
        velocities: Velocities of the moments [m/s], shape [n, 3].
        angular_velocities: Angular velocities of their bodies [rad/s], shape [n, 3].
        derivatives: ∂M/∂H of each ball, zero for permanent ones, shape [n, 3, 3].
        field: Function of positions that returns the applied field [A/m]; None means no field.
        time: Half the time between the differences [s].
    """

    def h(seconds):
        moved, rotated = positions + seconds * velocities, moments + seconds * np.cross(angular_velocities, moments)
        return h_field(moved, rotated, radii=radii) + (0.0 if field is None else field(moved))

    rates = (h(time) - h(-time)) / (2.0 * time) - np.cross(angular_velocities, h(0.0))
    return MU0 * (rates + 2.0 / 3.0 * np.einsum("nij,nj->ni", derivatives, rates))


def eddy_wrench(coefficients, rates):
    """Forces [N] and torques [N·m] of eddy currents: minus the gradient of ½ Σ c |dB/dt|² in both velocities.

    Args:
        coefficients: c of each ball, shape [n].
        rates: :func:`flux_rates` as a linear function of velocities and angular velocities, shape [n, 3] each.

    Returns:
        Function of velocities and angular velocities that returns power [W], forces and torques, shape [n, 3].
    """
    n = len(coefficients)
    unit = np.eye(6 * n).reshape(6 * n, 2, n, 3)
    basis = np.stack([rates(v, w) for v, w in unit])

    def wrench(velocities, angular_velocities):
        present = rates(velocities, angular_velocities)
        wrenches = -np.einsum("n,knc,nc->k", coefficients, basis, present).reshape(2, n, 3)
        return float(coefficients @ (present**2).sum(axis=1)), wrenches[0], wrenches[1]

    return wrench
