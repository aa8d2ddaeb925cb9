"""The near-contact model: what two balls add to their dipoles when they almost touch. Plain NumPy, no Warp.

Close to contact the flux between two permeable balls crowds into the gap, and dipoles miss most of the force. As
Bonnecaze and Brady did for suspensions, the far field stays many-body and what it lacks is added pair by pair, from the
exact solution of two balls. Three things make it work for piles:

* **Conductances add, resistances do not.** At a contact it is the surfaces' potentials that drive the flux, whatever
  the other contacts of the ball do. So the pair's part is a conductance ΔC from potentials to sources, and a ball has a
  potential: besides its moment a source q, its net flux through contacts, which the rest of its surface gives back.
* **Two ranges.** With 1/d split into U_lr, the potential of balls inflated to ``RANGE``/2 radii, and the rest U_sr,
  which vanishes beyond ``RANGE`` radii, sources q act by U_sr only: everything new is local. Both are positive.
* **An energy.** With a = (0, m) the actual sources of a ball, split into smooth and contact ones, a = ã + n,

      E_near(m) = min over ã of ½ ã M ã + ½ n ΔC⁻¹ n − ½ a M a,    M the matrix of U_sr (source, dipole).

  It vanishes with ΔC, never endangers uniqueness, and gives with e = M ã, n = ΔC e the field (M n)_m at the moments and
  the forces ½ e ∂ΔC e − ½ ã ∂M ã + ½ a ∂M a: momentum is conserved, and two balls come out exactly.

ΔC of a pair has eight functions of the gap and the two permeabilities, tabulated from the exact solution of two equal
balls by ``bench.reference.near_contact_table``. With n_i the direction from i towards j, α = n·e_m and ⊥ across it,

    q_i = R [A φ_i + B φ_j] + R² [C α_i + D α_j],    n_i·m_i = R² [C φ_i + D' φ_j] + R³ [E α_i + F α_j],
    m_i⊥ = R³ [G e_i⊥ + H e_j⊥],

where D' is the D that ball j sees.

Reference: Bonnecaze and Brady 1990, "A method for determining the effective conductivity of dispersions of particles",
Proc. R. Soc. Lond. A 430, 285-313.
"""

from functools import cache
from pathlib import Path

import numpy as np

from warpmag import oracle

RANGE = 3.4
"""Distance [radii] up to which two balls are a near pair."""
WINDOW = 0.4
"""Width [radii] over which the pair's part fades before ``RANGE``."""
SMALLEST_GAP = 0.01
"""Gap [radii] at which forces are largest: contact solvers cannot follow them further."""
SOFTNESS = 0.03
"""Depth [radii] over which the pair's part levels off below the smallest gap."""
DEEPEST = (0.1, 0.3)
"""Overlap [radii] over which the pair's part fades: balls that deep in one another are no physical pair."""

MOST_SHARED = (0.5, 1.0)
"""Volume shared with neighbours, in volumes, over which a ball leaves the model: heaps that deep are no contacts."""
LEAST_RATIO = (0.5, 0.8)
"""Ratio of radii over which the pair's part sets in: the table is that of equal balls."""

LOG_GAPS = (float(np.log(4.9e-4)), float(np.log(1.5)), 28)
"""Natural logarithm of gap/R: first node, last node, number of nodes."""
HARDNESSES = (0.0, 1.0, 11)
"""μr^(-1/2): first node, last node, number of nodes."""
FUNCTIONS = 8

TABLE_FILE = Path(__file__).with_name("near_contact.npy")


@cache
def table() -> np.ndarray:
    """Cubic B-spline coefficients of A to H by gap, own and the other's hardness, shape [gaps + 2, n + 2, n + 2, 8]."""
    return np.load(TABLE_FILE)


def hardness(susceptibility):
    """Coordinate (1 + χ)^(-1/2) of the table; 0 for an ideally permeable ball."""
    return 1.0 / np.sqrt(1.0 + np.asarray(susceptibility, float))


def log_gap(gap):
    """Logarithm of the gap [radii] at which the table is read, and its derivative; levels off near contact."""
    depth = np.tanh(np.minimum(gap - SMALLEST_GAP, 0.0) / SOFTNESS)
    outside = np.maximum(gap, SMALLEST_GAP)
    value = np.log(outside) + SOFTNESS / SMALLEST_GAP * depth
    return value, (1.0 - depth**2) / outside


def _smoothstep(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x)


def window(gap):
    """Factor that fades the pair's part before ``RANGE`` and in deep overlaps, and its derivative."""
    far, far_slope = _smoothstep((RANGE - 2.0 - gap) / WINDOW)
    deep, deep_slope = _smoothstep((DEEPEST[1] + gap) / (DEEPEST[1] - DEEPEST[0]))
    return far * deep, deep * -far_slope / WINDOW + far * deep_slope / (DEEPEST[1] - DEEPEST[0])


def _b_spline(x, nodes):
    """First of four coefficients, their weights and slopes of a uniform cubic B-spline at coordinates ``x``."""
    first, last, count = nodes
    scale = (count - 1) / (last - first)
    x = np.clip((np.asarray(x, float) - first) * scale, 0.0, count - 1.0)
    base = np.minimum(x.astype(int), count - 2)
    t = x - base
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], -1) / 6.0
    slopes = scale * np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], -1) / 2.0
    return base, weights, slopes


@cache
def gap_table(own: float, other: float) -> np.ndarray:
    """Coefficients of A to H by gap for a ball of hardness ``own`` near one of ``other``, shape [gaps + 2, 8]."""
    row, row_weights, _ = _b_spline(own, HARDNESSES)
    column, column_weights, _ = _b_spline(other, HARDNESSES)
    patch = table()[:, row : row + 4, column : column + 4].astype(float)
    return np.einsum("a,b,gabf->gf", row_weights, column_weights, patch)


def conductances(gap, own, other):
    """The eight functions A to H of pairs, and their derivatives by the gap.

    Args:
        gap: Gap between the surfaces over the radius, shape [p].
        own: :func:`hardness` of the ball, shape [p].
        other: That of the other, shape [p].

    Returns:
        Functions and derivatives [dimensionless], shape [p, 8] each.
    """
    gap = np.asarray(gap, float)
    u, du = log_gap(gap)
    row, weights, slopes = _b_spline(u, LOG_GAPS)
    value, slope = np.zeros((len(gap), FUNCTIONS)), np.zeros((len(gap), FUNCTIONS))
    for kind in {*zip(own, other, strict=True)}:
        rows = np.flatnonzero((own == kind[0]) & (other == kind[1]))
        patch = gap_table(*map(float, kind))[row[rows, None] + np.arange(4)]
        value[rows] = np.einsum("pa,paf->pf", weights[rows], patch)
        slope[rows] = np.einsum("pa,paf->pf", slopes[rows], patch) * du[rows, None]
    w, dw = window(gap)
    return w[:, None] * value, w[:, None] * slope + dw[:, None] * value


def similarity(radius_i, radius_j):
    """Factor that fades the pair's part of balls of unlike size, for which the table of equal ones is no guide."""
    ratio = np.minimum(radius_i, radius_j) / np.maximum(radius_i, radius_j)
    return _smoothstep((ratio - LEAST_RATIO[0]) / (LEAST_RATIO[1] - LEAST_RATIO[0]))[0]


def shared_volume(distance, a, b):
    """Volume that two balls share over the geometric mean of theirs."""
    d = np.clip(distance, np.abs(a - b) + 1e-9 * (a + b), a + b)
    lens = (a + b - d) ** 2 * (d**2 + 2.0 * d * (a + b) - 3.0 * (a - b) ** 2) / (16.0 * d)
    return lens / (a * b) ** 1.5


def crowding_weight(shared):
    """Factor that takes balls out of the model that share the volume ``shared`` with others."""
    return 1.0 - _smoothstep((shared - MOST_SHARED[0]) / (MOST_SHARED[1] - MOST_SHARED[0]))[0]


# ---------------------------------------------------------------------------------------------------------------------
# The short-range potential
# ---------------------------------------------------------------------------------------------------------------------


def long_range(distance, radius_i, radius_j):
    """U_lr [1/m] of two balls and its radial factors g1, g2, g3, as ``oracle.radial_factors`` defines them."""
    a, b = 0.5 * RANGE * radius_i, 0.5 * RANGE * radius_j
    d = np.asarray(distance, float)
    return averaged_potential(d, a, b), *oracle.radial_factors(d, a, b)


def long_range_self(radius):
    """U_lr of a ball on itself [1/m], and of its dipole on itself [1/m³]."""
    b = 0.5 * RANGE * radius
    return 1.2 / b, 1.0 / b**3


def averaged_potential(d, a, b):
    """Mean potential U [1/m] of a homogeneous ball of radius b over one of radius a, |a − b| < d ≤ a + b; else 1/d."""
    s, p, delta2 = a + b, a * b, (a - b) ** 2
    k = 5.0 * delta2**2 * (delta2 + 6.0 * p)
    u1, u2, u3 = 45.0 * s**2 * delta2, -40.0 * s * (delta2 + p), 15.0 * (delta2 + 2.0 * p)
    join = 160.0 * p**3 / s - (k / s + u1 * s + u2 * s**2 + u3 * s**3 - s**5)
    polynomial = join + k / d + u1 * d + u2 * d**2 + u3 * d**3 - d**5
    return np.where(d < s, polynomial / (160.0 * p**3), 1.0 / d)


# ---------------------------------------------------------------------------------------------------------------------
# Reference implementation, dense
# ---------------------------------------------------------------------------------------------------------------------


def saturation_weight(h, saturation, susceptibility, curve):
    """Factor by which a ball's part in ΔC falls as it saturates, shape [n], from its field H [A/m], shape [n, 3].

    What a contact adds are the higher multipoles of a ball, of polarizability 2χ/(2χ + 5) for the lowest. At a finite
    magnetization they feel the differential susceptibility 1/χ_d = dH/dM − 1/3 of the curve; a saturated ball has none.
    """
    k = oracle.curve_slope(susceptibility)
    _, slope = oracle.reduced_curve(k * np.linalg.norm(h, axis=1) / saturation, curve)
    inverse = 1.0 / np.maximum(k * slope, 1e-12) - 1.0 / 3.0
    return (1.0 + 2.5 / np.asarray(susceptibility, float)) / (1.0 + 2.5 * np.maximum(inverse, 0.0))


class NearContacts:
    """The near pairs of n balls and their matrices, sources and moments interleaved: q, m_x, m_y, m_z of each ball."""

    def __init__(self, positions, radii, susceptibility, weights=1.0):
        """Find the pairs and their ΔC, of balls whose part is scaled by ``weights`` (:func:`saturation_weight`)."""
        self.positions = np.asarray(positions, float)
        n = self.count = len(self.positions)
        self.radii = np.broadcast_to(np.asarray(radii, float), n)
        y = np.broadcast_to(hardness(susceptibility), n)
        w = np.broadcast_to(np.asarray(weights, float), n).copy()
        r = self.positions[:, None] - self.positions[None]
        reach = 0.5 * RANGE * (self.radii[:, None] + self.radii[None])
        self.i, self.j = np.nonzero(np.triu(np.linalg.norm(r, axis=2) < reach, 1))
        i, j = self.i, self.j
        self.separation = self.positions[j] - self.positions[i]
        self.distance = np.linalg.norm(self.separation, axis=1)
        self.direction = self.separation / np.maximum(self.distance, np.finfo(float).tiny)[:, None]
        a, b = self.radii[i], self.radii[j]
        self.scale = 2.0 * a * b / (a + b)  # the curvature of the gap
        both = shared_volume(self.distance, a, b)
        w *= crowding_weight(np.bincount(i, both, n) + np.bincount(j, both, n))
        gap = (self.distance - a - b) / self.scale
        share = (w[i] * w[j] * similarity(a, b))[:, None]
        seen = [conductances(gap, y[one], y[other]) for one, other in ((i, j), (j, i))]
        self.value = [share * self.scale[:, None] * value for value, _ in seen]  # as ball i and as ball j sees them
        self.slope = [share * slope for _, slope in seen]
        self.short_range = self._short_range()
        self.conductance = self._conductance()

    def _factors(self):
        """U_sr and its radial factors g1, g2, g3 of the pairs."""
        a, b, d = self.radii[self.i], self.radii[self.j], self.distance
        near = averaged_potential(d, a, b), *oracle.radial_factors(d, a, b)
        return [x - y for x, y in zip(near, long_range(d, a, b), strict=True)]

    def _short_range(self):
        """M, shape [4n, 4n]: 4π potentials and minus fields of sources and moments."""
        n = self.count
        matrix = np.zeros((n, 4, n, 4))
        source, dipole = long_range_self(self.radii)
        balls = np.arange(n)
        matrix[balls, 0, balls, 0] = 1.0 / self.radii - source
        for axis in (1, 2, 3):
            matrix[balls, axis, balls, axis] = 1.0 / self.radii**3 - dipole
        u, g1, g2, _ = self._factors()
        r = -self.separation  # x_i − x_j
        block = np.zeros((len(r), 4, 4))
        block[:, 0, 0] = u
        block[:, 0, 1:] = -g1[:, None] * r
        block[:, 1:, 0] = g1[:, None] * r
        block[:, 1:, 1:] = -g1[:, None, None] * np.eye(3) - g2[:, None, None] * r[:, :, None] * r[:, None, :]
        matrix[self.i, :, self.j, :] = block
        matrix[self.j, :, self.i, :] = block.transpose(0, 2, 1)
        return matrix.reshape(4 * n, 4 * n)

    def _conductance(self):
        """ΔC, shape [4n, 4n]."""
        n = self.count
        matrix = np.zeros((n, 4, n, 4))
        outer = self.direction[:, :, None] * self.direction[:, None, :]
        across = np.eye(3) - outer
        size = {1: self.radii[self.i], -1: self.radii[self.j]}
        for side, one, other, sign in ((0, self.i, self.j, 1), (1, self.j, self.i, -1)):
            own, its = size[sign], size[-sign]
            normal = sign * self.direction
            a, b, c, d, e, f, g, h = self.value[side].T
            back = self.value[1 - side][:, 3]
            block = np.zeros((len(a), 4, 4))
            block[:, 0, 0] = a
            block[:, 0, 1:] = block[:, 1:, 0] = (c * own)[:, None] * normal
            block[:, 1:, 1:] = (own**2)[:, None, None] * (e[:, None, None] * outer + g[:, None, None] * across)
            np.add.at(matrix, (one, slice(None), one), block)
            block = np.zeros((len(a), 4, 4))
            block[:, 0, 0] = b
            block[:, 0, 1:] = -(d * its)[:, None] * normal
            block[:, 1:, 0] = (back * own)[:, None] * normal
            block[:, 1:, 1:] = (own * its)[:, None, None] * (h[:, None, None] * across - f[:, None, None] * outer)
            matrix[one, :, other, :] = block
        return matrix.reshape(4 * n, 4 * n)

    def coupling(self):
        """Matrix, shape [3n, 3n], of the field [A/m] that the model adds at the balls for given moments [A·m²]."""
        moments = np.arange(4 * self.count) % 4 > 0
        m, c = self.short_range, self.conductance
        contact = np.linalg.solve(np.eye(len(m)) + c @ m, c @ m)
        return (m @ contact)[np.ix_(moments, moments)] / (4.0 * np.pi)

    def forces(self, moments):
        """Forces [N] that the model adds for moments [A·m²], shape [n, 3] each."""
        m, c = self.short_range, self.conductance
        actual = np.concatenate([np.zeros((self.count, 1)), moments], axis=1)
        smooth = np.linalg.solve(np.eye(len(m)) + c @ m, actual.ravel())
        drive = (m @ smooth).reshape(-1, 4)
        pull = self._conductance_force(drive) + self._source_force(smooth.reshape(-1, 4)) - self._source_force(actual)
        forces = np.zeros((self.count, 3))
        np.add.at(forces, self.j, pull)
        np.add.at(forces, self.i, -pull)
        return oracle.MU0 / (4.0 * np.pi) * forces

    def _conductance_force(self, drive):
        """Derivative of ½ e ΔC e of each pair by the position of ball j."""
        unit = self.direction
        own, its = self.radii[self.i], self.radii[self.j]
        (phi_i, field_i), (phi_j, field_j) = ((drive[k, 0], drive[k, 1:]) for k in (self.i, self.j))
        alpha_i, alpha_j = (own * np.einsum("pk,pk->p", unit, field_i), -its * np.einsum("pk,pk->p", unit, field_j))
        square_i = own**2 * np.sum(field_i**2, 1) - alpha_i**2
        square_j = its**2 * np.sum(field_j**2, 1) - alpha_j**2
        mixed = own * its * np.einsum("pk,pk->p", field_i, field_j) + alpha_i * alpha_j
        energy_i = [0.5 * phi_i**2, phi_i * phi_j, phi_i * alpha_i, phi_i * alpha_j, 0.5 * alpha_i**2]
        energy_i += [alpha_i * alpha_j, 0.5 * square_i, mixed]
        zero = np.zeros_like(mixed)  # what both share counts once
        energy_j = [
            0.5 * phi_j**2,
            zero,
            phi_j * alpha_j,
            phi_j * alpha_i,
            0.5 * alpha_j**2,
            zero,
            0.5 * square_j,
            zero,
        ]
        radial = np.einsum("pf,fp->p", self.slope[0], energy_i) + np.einsum("pf,fp->p", self.slope[1], energy_j)
        _, _, c, d, e, f, g, h = self.value[0].T
        _, _, c_j, d_j, e_j, _, g_j, _ = self.value[1].T
        turn_i = own * (c * phi_i + d_j * phi_j + (e - g) * alpha_i + (f + h) * alpha_j)
        turn_j = its * (c_j * phi_j + d * phi_i + (e_j - g_j) * alpha_j + (f + h) * alpha_i)
        turn = turn_i[:, None] * field_i - turn_j[:, None] * field_j
        turn -= np.einsum("pk,pk->p", unit, turn)[:, None] * unit
        return radial[:, None] * unit + turn / self.distance[:, None]

    def _source_force(self, sources):
        """Force on ball j of each pair by ball i through U_sr, in units of μ0/4π."""
        _, g1, g2, g3 = (x[:, None] for x in self._factors())
        r = self.separation  # from i, the source, to j
        q_i, m_i, q_j, m_j = sources[self.i, :1], sources[self.i, 1:], sources[self.j, :1], sources[self.j, 1:]
        a, b = (np.sum(r * m, 1, keepdims=True) for m in (m_i, m_j))
        field = g1 * (m_i - q_i * r) + g2 * a * r
        gradient = g2 * (m_i * b + m_j * a + r * np.sum(m_i * m_j, 1, keepdims=True)) + g3 * a * b * r
        return q_j * field + gradient - q_i * (g1 * m_j + g2 * b * r)


def equilibrium(positions, radii, h0, *, saturation, susceptibility=np.inf, curve="tanh", iterations=60):
    """Magnetic equilibrium and Kelvin forces of balls in uniform fields, with the near-contact model.

    Arguments are those of ``oracle.equilibrium``. The weights that follow the balls' saturation are found by iteration.

    Returns:
        The equilibrium (``oracle.Equilibrium``) and the forces [N], shape [n, 3].
    """
    positions = np.asarray(positions, float)
    n = len(positions)
    volumes = 4.0 / 3.0 * np.pi * np.broadcast_to(np.asarray(radii, float), n) ** 3
    weights = np.ones(n)
    for _ in range(iterations):
        near = NearContacts(positions, radii, susceptibility, weights)
        found = oracle.equilibrium(
            positions, radii, h0, saturation=saturation, susceptibility=susceptibility, curve=curve,
            extra_coupling=near.coupling() * np.repeat(volumes, 3),
        )  # fmt: skip
        last, weights = weights, saturation_weight(found.h, saturation, susceptibility, curve)
        if np.abs(weights - last).max() < 1e-10:
            break
    moments = volumes[:, None] * found.magnetizations
    gradients = oracle.field_gradient(positions, moments, radii=radii)
    return found, oracle.kelvin_force(moments, gradients) + near.forces(moments)
