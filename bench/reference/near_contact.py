"""Dense reference of the near-contact model that ``warpmag.kernels.near_contact`` describes, in float64 with NumPy.

Tests compare the device with this module, and this module with exact solutions of other references. Names are
those of the model.
"""

import numpy as np

from bench.reference import oracle
from warpmag.kernels.near_contact import contact_table
from warpmag.kernels.near_contact.contact_table import b_spline, gap_table, hardness


def log_gap(gap):
    """Logarithm of the gap [radii] at which the table is read, and its derivative; bounded below near contact."""
    depth = np.minimum(gap - contact_table.SMALLEST_GAP, 0.0) / contact_table.SOFTNESS
    outside = np.maximum(gap, contact_table.SMALLEST_GAP)
    value = np.log(outside) + contact_table.SOFTNESS / contact_table.SMALLEST_GAP * depth / np.sqrt(1.0 + depth**2)
    return value, (1.0 + depth**2) ** -1.5 / outside


def smoothstep(x):
    """Cubic step from 0 at x = 0 to 1 at x = 1, and its derivative."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x)


def ramp(x, limits):
    """Cubic step from 0 at ``limits[0]`` to 1 at ``limits[1]``."""
    return smoothstep((x - limits[0]) / (limits[1] - limits[0]))[0]


def window(gap, far=contact_table.CONTACT_GAP, deep=contact_table.DEEPEST):
    """Factor that fades from gap ``far[0]`` to ``far[1]`` and in overlaps beyond ``deep[0]``, and its derivative."""
    outer, outer_slope = smoothstep((far[1] - gap) / (far[1] - far[0]))
    inner, inner_slope = smoothstep((deep[1] + gap) / (deep[1] - deep[0]))
    return outer * inner, outer * inner_slope / (deep[1] - deep[0]) - inner * outer_slope / (far[1] - far[0])


def quadrupole_window(distance, radius_i, radius_j):
    """Weight of the quadrupoles of two balls, and its derivative with respect to their distance."""
    unit = 0.5 * (radius_i + radius_j)
    far = (contact_table.QUADRUPOLE_REACH[0] - 2.0, contact_table.QUADRUPOLE_REACH[1] - 2.0)
    value, slope = window(distance / unit - 2.0, far, contact_table.QUADRUPOLE_OVERLAP)
    return value, slope / unit


def conductances(gap, own, other):
    """The 14 functions A to P of pairs, and their derivatives with respect to the gap, shape [p, 14] each.

    ``gap`` is the gap between the surfaces over the radius; ``own`` and ``other`` are the :func:`hardness` of a ball
    and of its neighbor, shape [p].
    """
    gap = np.asarray(gap, float)
    u, du = log_gap(gap)
    row, weights, slopes = b_spline(u, contact_table.LOG_GAPS)
    value, slope = np.zeros((len(gap), contact_table.FUNCTIONS)), np.zeros((len(gap), contact_table.FUNCTIONS))
    for pair in {*zip(own, other, strict=True)}:
        rows = np.flatnonzero((own == pair[0]) & (other == pair[1]))
        patch = gap_table(*map(float, pair))[row[rows, None] + np.arange(4)]
        value[rows] = np.einsum("pa,paf->pf", weights[rows], patch)
        slope[rows] = np.einsum("pa,paf->pf", slopes[rows], patch) * du[rows, None]
    w, dw = window(gap)
    return w[:, None] * value, w[:, None] * slope + dw[:, None] * value


def similarity(radius_i, radius_j):
    """Weight of a pair of unequal balls, for which the table of equal balls is less accurate."""
    ratio = np.minimum(radius_i, radius_j) / np.maximum(radius_i, radius_j)
    return ramp(ratio, contact_table.LEAST_RATIO)


def shared_volume(distance, a, b):
    """Common volume of two balls over the geometric mean of their volumes."""
    d = np.clip(distance, np.abs(a - b) + 1e-9 * (a + b), a + b)
    lens = (a + b - d) ** 2 * (d**2 + 2.0 * d * (a + b) - 3.0 * (a - b) ** 2) / (16.0 * d)
    return lens / (a * b) ** 1.5


def crowding_weight(shared):
    """Weight of a ball that shares the volume ``shared`` with others: 0 removes it from the model."""
    return 1.0 - ramp(shared, contact_table.MOST_SHARED)


# ---------- The short-range potential ----------


def long_range(distance, radius_i, radius_j):
    """U_lr [1/m] of two balls and its radial factors g1, g2, g3, as ``oracle.radial_factors`` defines them."""
    a, b = 0.5 * contact_table.RANGE * radius_i, 0.5 * contact_table.RANGE * radius_j
    d = np.asarray(distance, float)
    return averaged_potential(d, a, b), *oracle.radial_factors(d, a, b)


def long_range_self(radius):
    """U_lr of a ball's source at the ball itself [1/m], and of its dipole [1/m³]."""
    b = 0.5 * contact_table.RANGE * radius
    return 1.2 / b, 1.0 / b**3


def averaged_potential(d, a, b):
    """Mean potential U [1/m] of a homogeneous ball of radius b over another one of radius a."""
    s, p, delta2 = a + b, a * b, (a - b) ** 2
    k = 5.0 * delta2**2 * (delta2 + 6.0 * p)
    u1, u2, u3 = 45.0 * s**2 * delta2, -40.0 * s * (delta2 + p), 15.0 * (delta2 + 2.0 * p)
    join = 160.0 * p**3 / s - (k / s + u1 * s + u2 * s**2 + u3 * s**3 - s**5)
    separate = np.where(d > np.abs(a - b), d, s)
    polynomial = join + k / separate + u1 * d + u2 * d**2 + u3 * d**3 - d**5
    large, small = np.maximum(a, b), np.minimum(a, b)
    inside = (3.0 * large**2 - d**2 - 0.6 * small**2) / (2.0 * large**3)
    return np.select([d <= np.abs(a - b), d < s], [inside, polynomial / (160.0 * p**3)], 1.0 / separate)


# ---------- Reference implementation, dense ----------

_HALF_ROOT = 0.5 * np.sqrt(3.0)
_BASIS = np.array(
    [
        [[0.0, _HALF_ROOT, 0.0], [_HALF_ROOT, 0.0, 0.0], [0.0, 0.0, 0.0]],
        [[0.0, 0.0, 0.0], [0.0, 0.0, _HALF_ROOT], [0.0, _HALF_ROOT, 0.0]],
        [[0.0, 0.0, _HALF_ROOT], [0.0, 0.0, 0.0], [_HALF_ROOT, 0.0, 0.0]],
        np.diag([-0.5, -0.5, 1.0]),
        np.diag([_HALF_ROOT, -_HALF_ROOT, 0.0]),
    ]
)
"""Basis of quadrupoles Θ: the energy of each in a ball of unit radius and infinite permeability is 1/2."""


def saturation_weight(h, saturation, susceptibility, curve):
    """Weight of a ball in ΔC, which falls as the ball saturates, shape [n], from its field H [A/m], shape [n, 3].

    A contact adds the higher multipoles of a ball; the lowest has the polarizability 2χ/(2χ + 5). At a finite
    magnetization χ is the differential susceptibility, 1/χ_d = dH/dM − 1/3 of the curve; it is 0 in saturation.
    """
    k = oracle.curve_slope(susceptibility)
    _, slope = oracle.reduced_curve(k * np.linalg.norm(h, axis=1) / saturation, curve)
    inverse = 1.0 / np.maximum(k * slope, 1e-12) - 1.0 / 3.0
    return (1.0 + 2.5 / np.asarray(susceptibility, float)) / (1.0 + 2.5 * np.maximum(inverse, 0.0))


class NearContacts:
    """The near pairs of n balls and their matrices, sources interleaved: q, m_x, m_y, m_z, Θ of each ball."""

    def __init__(self, positions, radii, susceptibility, weights=1.0):
        """Find the pairs and their ΔC; ``weights`` are those of :func:`saturation_weight`."""
        self.positions = np.asarray(positions, float)
        n = self.count = len(self.positions)
        self.radii = np.broadcast_to(np.asarray(radii, float), n)
        y = np.broadcast_to(hardness(susceptibility), n)
        w = np.broadcast_to(np.asarray(weights, float), n).copy()
        self.polarizability = w / (1.0 + 2.5 / np.broadcast_to(np.asarray(susceptibility, float), n))
        r = self.positions[:, None] - self.positions[None]
        reach = 0.5 * contact_table.REACH * (self.radii[:, None] + self.radii[None])
        self.i, self.j = np.nonzero(np.triu(np.linalg.norm(r, axis=2) < reach, 1))
        i, j = self.i, self.j
        self.separation = self.positions[j] - self.positions[i]
        a, b = self.radii[i], self.radii[j]
        length = np.linalg.norm(self.separation, axis=1)
        self.direction = self.separation / np.maximum(length, np.finfo(float).tiny)[:, None]
        self.distance = np.maximum(length, 1e-12 * (a + b))  # keeps powers of 1/d with zero weight finite
        self.scale = 2.0 * a * b / (a + b)  # the curvature of the gap
        shared = shared_volume(self.distance, a, b)
        crowding = crowding_weight(np.bincount(i, shared, n) + np.bincount(j, shared, n))
        gap = (self.distance - a - b) / self.scale
        self.present = crowding[i] * crowding[j]
        weight = self.present * similarity(a, b)
        self.quadrupole = [weight * factor for factor in quadrupole_window(self.distance, a, b)]
        factor = (w[i] * w[j] * weight)[:, None]
        functions = [conductances(gap, y[ball], y[other]) for ball, other in ((i, j), (j, i))]
        self.value = [factor * self.scale[:, None] * value for value, _ in functions]  # of ball i and of ball j
        self.slope = [factor * slope for _, slope in functions]
        self.short_range = self._short_range()
        self.conductance = self._conductance()

    def _factors(self):
        """U_sr and its radial factors g1, g2, g3 of the pairs, times the weight of the pair."""
        a, b, d = self.radii[self.i], self.radii[self.j], self.distance
        near = averaged_potential(d, a, b), *oracle.radial_factors(d, a, b)
        return [self.present * (x - y) for x, y in zip(near, long_range(d, a, b), strict=True)]

    def _short_range(self):
        """M, shape [9n, 9n]: 4π potentials, minus fields and minus their gradients, of the sources."""
        n = self.count
        matrix = np.zeros((n, 9, n, 9))
        source, dipole = long_range_self(self.radii)
        balls = np.arange(n)
        matrix[balls, 0, balls, 0] = 1.0 / self.radii - source
        for axis in (1, 2, 3):
            matrix[balls, axis, balls, axis] = 1.0 / self.radii**3 - dipole
        for axis in range(4, 9):
            matrix[balls, axis, balls, axis] = 1.0 / self.radii**5
        u, g1, g2, _ = self._factors()
        r = -self.separation  # x_i − x_j
        block = np.zeros((len(r), 9, 9))
        block[:, 0, 0] = u
        block[:, 0, 1:4] = -g1[:, None] * r
        block[:, 1:4, 0] = g1[:, None] * r
        block[:, 1:4, 1:4] = -g1[:, None, None] * np.eye(3) - g2[:, None, None] * r[:, :, None] * r[:, None, :]
        n = self.direction
        projected = np.einsum("abk,pk->pab", _BASIS, n)
        along = np.einsum("pak,pk->pa", projected, n)
        d = self.distance[:, None, None]
        shape = along * (g2 * self.distance**2)[:, None] / 3.0
        block[:, 0, 4:] = shape * self.quadrupole[0][:, None]
        block[:, 4:, 0] = shape * self.quadrupole[0][:, None]
        on_dipoles = 5.0 * n[:, :, None] * along[:, None, :] - 2.0 * projected.transpose(0, 2, 1)
        block[:, 1:4, 4:] = on_dipoles / d**4
        block[:, 4:, 1:4] = -on_dipoles.transpose(0, 2, 1) / d**4
        mutual = 2.0 * np.einsum("akl,bkl->ab", _BASIS, _BASIS)[None] + 35.0 * along[:, :, None] * along[:, None, :]
        block[:, 4:, 4:] = (mutual - 20.0 * np.einsum("pak,pbk->pab", projected, projected)) / (3.0 * d**5)
        block[:, 4:, 1:] *= self.quadrupole[0][:, None, None]
        block[:, 1:4, 4:] *= self.quadrupole[0][:, None, None]
        matrix[self.i, :, self.j, :] = block
        matrix[self.j, :, self.i, :] = block.transpose(0, 2, 1)
        return matrix.reshape(9 * self.count, 9 * self.count)

    def _conductance(self):
        """ΔC, shape [9n, 9n]."""
        n = self.count
        matrix = np.zeros((n, 9, n, 9))
        for side, ball, other, sign in ((0, self.i, self.j, 1), (1, self.j, self.i, -1)):
            axes_i, axes_j = self._axes(ball, sign), self._axes(other, -sign)
            a, b, c, d, e, f, g, h, i, j, k, l, o, p = self.value[side].T  # noqa: E741
            _, _, _, d_j, _, _, _, _, _, j_j, _, l_j, _, _ = self.value[1 - side].T
            own = np.array([[a, c, i], [c, e, k], [i, k, o]])
            cross = np.array([[b, d, j], [d_j, f, l], [j_j, l_j, p]])
            across = np.eye(3) - self.direction[:, :, None] * self.direction[:, None, :]
            across = across * self.radii[ball, None, None]
            block = np.einsum("uvp,pua,pvb->pab", own, axes_i, axes_i)
            block[:, 1:4, 1:4] += (g * self.radii[ball])[:, None, None] * across
            np.add.at(matrix, (ball, slice(None), ball), block)
            block = np.einsum("uvp,pua,pvb->pab", cross, axes_i, axes_j)
            block[:, 1:4, 1:4] += (h * self.radii[other])[:, None, None] * across
            matrix[ball, :, other, :] = block
        return matrix.reshape(9 * n, 9 * n)

    def _axes(self, ball, sign):
        """Sources q, m, Θ of unit strength on the axis towards the other ball, shape [pairs, 3, 9]."""
        axes = np.zeros((len(ball), 3, 9))
        axes[:, 0, 0] = 1.0
        axes[:, 1, 1:4] = sign * self.radii[ball, None] * self.direction
        along = np.einsum("akl,pk,pl->pa", _BASIS, self.direction, self.direction)
        axes[:, 2, 4:] = self.radii[ball, None] ** 2 * along
        return axes

    def _solve(self, moments):
        """Smooth sources ã for given moments, shape [9n, columns], as the columns of ``moments`` [3n, columns]."""
        n = self.count
        kind = np.arange(9 * n) % 9
        actual = np.zeros((9 * n, moments.shape[1]))
        actual[(kind > 0) & (kind < 4)] = moments
        system = np.eye(9 * n) + self.conductance @ self.short_range
        # (M ã)_Θ = −δ Θ with the polarizability p = 1/(1 + δ), in units of R⁵
        rows = kind > 3
        p, size = np.repeat(self.polarizability, 5)[:, None], np.repeat(self.radii**5, 5)[:, None]
        system[rows] = p * size * self.short_range[rows] + (1.0 - p) * system[rows]
        return np.linalg.solve(system, actual)

    def coupling(self):
        """Matrix, shape [3n, 3n], of the field [A/m] that the model adds at the balls for given moments [A·m²]."""
        moments = np.isin(np.arange(9 * self.count) % 9, (1, 2, 3))
        drive = self.short_range @ self._solve(np.eye(3 * self.count))
        return (self.short_range[np.ix_(moments, moments)] - drive[moments]) / (4.0 * np.pi)

    def forces(self, moments):
        """Forces [N] that the model adds for moments [A·m²], shape [n, 3] each."""
        smooth = self._solve(np.reshape(moments, (-1, 1)))
        drive, smooth = (self.short_range @ smooth).reshape(-1, 9), smooth.reshape(-1, 9)
        actual = np.concatenate([np.zeros((self.count, 1)), moments], axis=1)
        pull = self._conductance_force(drive) + self._source_force(smooth) - self._source_force(actual)
        pull += self._quadrupole_force(smooth)
        forces = np.zeros((self.count, 3))
        np.add.at(forces, self.j, pull)
        np.add.at(forces, self.i, -pull)
        return oracle.MU0 / (4.0 * np.pi) * forces

    def _conductance_force(self, drive):
        """Derivative of ½ e ΔC e of each pair with respect to the position of ball j."""
        unit = self.direction
        radial, turn = 0.0, 0.0
        for side, ball, other, sign in ((0, self.i, self.j, 1.0), (1, self.j, self.i, -1.0)):
            first, second = self._at_contact(drive, ball, sign), self._at_contact(drive, other, -sign)
            phi, alpha, gamma, field, pull, square = first
            phi_j, alpha_j, gamma_j, field_j, _, _ = second
            # terms of both balls count half for each
            mixed = np.sum(field * field_j, 1) + alpha * alpha_j
            energy = [0.5 * phi**2, 0.5 * phi * phi_j, phi * alpha, phi * alpha_j]
            energy += [0.5 * alpha**2, 0.5 * alpha * alpha_j]
            energy += [0.5 * square, 0.5 * mixed, phi * gamma, phi * gamma_j, alpha * gamma, alpha * gamma_j]
            energy += [0.5 * gamma**2, 0.5 * gamma * gamma_j]
            radial += np.einsum("pf,fp->p", self.slope[side], np.array(energy))
            _, _, c, _, e, f, g, h, i, _, k, l, o, p = self.value[side].T  # noqa: E741
            _, _, _, d_j, _, _, _, _, _, j_j, _, l_j, _, _ = self.value[1 - side].T
            by_alpha = c * phi + d_j * phi_j + (e - g) * alpha + (f + h) * alpha_j + k * gamma + l * gamma_j
            by_gamma = i * phi + j_j * phi_j + k * alpha + l_j * alpha_j + o * gamma + p * gamma_j
            turn += sign * by_alpha[:, None] * field + 2.0 * by_gamma[:, None] * pull
        turn -= np.einsum("pk,pk->p", unit, turn)[:, None] * unit
        return radial[:, None] * unit + turn / self.distance[:, None]

    def _at_contact(self, drive, ball, sign):
        """φ, α and γ of a ball of each pair, R e_m, R² e_Θ n, and the square of R e_m perpendicular to the axis."""
        size = self.radii[ball]
        field = size[:, None] * drive[ball, 1:4]
        alpha = sign * np.sum(field * self.direction, 1)
        pull = size[:, None] ** 2 * np.einsum("pa,akl,pl->pk", drive[ball, 4:], _BASIS, self.direction)
        gamma = np.sum(pull * self.direction, 1)
        return drive[ball, 0], alpha, gamma, field, pull, np.sum(field**2, 1) - alpha**2

    def _source_force(self, sources):
        """Force on ball j of each pair by ball i through U_sr, in units of μ0/4π."""
        _, g1, g2, g3 = (x[:, None] for x in self._factors())
        r = self.separation  # from i, the source, to j
        q_i, m_i, q_j, m_j = (sources[k, columns] for k in (self.i, self.j) for columns in (slice(0, 1), slice(1, 4)))
        a, b = (np.sum(r * m, 1, keepdims=True) for m in (m_i, m_j))
        field = g1 * (m_i - q_i * r) + g2 * a * r
        gradient = g2 * (m_i * b + m_j * a + r * np.sum(m_i * m_j, 1, keepdims=True)) + g3 * a * b * r
        return q_j * field + gradient - q_i * (g1 * m_j + g2 * b * r)

    def _quadrupole_force(self, sources):
        """Force on ball j of each pair through the quadrupoles, in units of μ0/4π."""
        n, d = self.direction, self.distance
        q_i, q_j = sources[self.i, 0], sources[self.j, 0]
        m_i, m_j = sources[self.i, 1:4], sources[self.j, 1:4]
        t_i, t_j = (np.einsum("pa,akl->pkl", sources[k, 4:], _BASIS) for k in (self.i, self.j))
        v_i, v_j = (np.einsum("pkl,pl->pk", t, n) for t in (t_i, t_j))

        def dot(a, b):
            return np.sum(a * b, axis=-1)

        s_i, s_j = dot(v_i, n), dot(v_j, n)
        _, _, g2, g3 = self._factors()
        # energies over g2 d²/3, d⁻⁴ and d⁻⁵, and their derivatives with respect to the direction
        energy_3 = q_i * s_j + q_j * s_i
        turn_3 = 2.0 * (q_i[:, None] * v_j + q_j[:, None] * v_i)
        energy_4, turn_4 = 0.0, 0.0
        for m, t, v, s, sign in ((m_i, t_j, v_j, s_j, 1.0), (m_j, t_i, v_i, s_i, -1.0)):
            along = dot(m, n)
            energy_4 += sign * (5.0 * along * s - 2.0 * dot(m, v))
            projected = np.einsum("pkl,pl->pk", t, m)
            turn_4 += sign * (5.0 * s[:, None] * m + 10.0 * along[:, None] * v - 2.0 * projected)
        energy_5 = (2.0 * np.sum(t_i * t_j, axis=(1, 2)) - 20.0 * dot(v_i, v_j) + 35.0 * s_i * s_j) / 3.0
        turn_5 = -20.0 * (np.einsum("pkl,pl->pk", t_i, v_j) + np.einsum("pkl,pl->pk", t_j, v_i))
        turn_5 = (turn_5 + 70.0 * (s_j[:, None] * v_i + s_i[:, None] * v_j)) / 3.0
        weight, slope = self.quadrupole
        third, fourth, fifth = g2 * d**2 / 3.0, d**-4.0, d**-5.0
        radial = slope * (third * energy_3 + fourth * energy_4 + fifth * energy_5)
        radial += weight * (g3 * d**3 + 2.0 * g2 * d) / 3.0 * energy_3
        radial -= weight / d * (4.0 * fourth * energy_4 + 5.0 * fifth * energy_5)
        turn = third[:, None] * turn_3 + fourth[:, None] * turn_4 + fifth[:, None] * turn_5
        turn -= dot(turn, n)[:, None] * n
        return -(radial[:, None] * n + (weight / d)[:, None] * turn)


def equilibrium(positions, radii, h0, *, saturation, susceptibility=np.inf, curve="tanh"):
    """Equilibrium (``oracle.Equilibrium``) and forces [N], shape [n, 3], of balls with the near-contact model.

    Arguments are those of ``oracle.equilibrium``. The weights of the balls' saturation are iterated.
    """
    positions = np.asarray(positions, float)
    n = len(positions)
    volumes = 4.0 / 3.0 * np.pi * np.broadcast_to(np.asarray(radii, float), n) ** 3
    weights, material = np.ones(n), {"saturation": saturation, "susceptibility": susceptibility, "curve": curve}
    for _ in range(60):
        near = NearContacts(positions, radii, susceptibility, weights)
        coupling = near.coupling() * np.repeat(volumes, 3)
        solution = oracle.equilibrium(positions, radii, h0, **material, extra_coupling=coupling)
        last, weights = weights, saturation_weight(solution.h, saturation, susceptibility, curve)
        if np.abs(weights - last).max() < 1e-10:
            break
    moments = volumes[:, None] * solution.magnetizations
    gradients = oracle.field_gradient(positions, moments, radii=radii)
    return solution, oracle.kelvin_force(moments, gradients) + near.forces(moments)
