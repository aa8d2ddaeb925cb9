"""Exact solution of permeable balls in a uniform field: multipole expansions in NumPy, float64.

The scalar potential around ball i (H = −∇ψ) is a sum of its own irregular solid harmonics and of regular ones of all
other sources,

    ψ = Σ_lm a_lm C_lm(r̂)/r^(l+1) + b_lm r^l C_lm(r̂),    a_lm = −p_l b_lm,    p_l = R^(2l+1) l(μr−1)/(l μr + l+1),

C_lm in Racah's normalization. The addition theorem translates harmonics about one center to another, b = b0 + T a.
This leaves the symmetric positive definite system (1/p + T) a = −b0. Moments are m = 4π a_1. The free energy is
U = −½ μ0 Σ m·H0, so forces are F = −∂U/∂x = −2π μ0 aᵀ (∂T/∂x) a. They are exact for the truncated system, too.

Truncating the expansions at order L leaves an error of about exp(−2ξL), cosh ξ = 1 + gap/2R for equal balls: images
converge to the foci of the bispherical coordinates, exp(−ξ) of a radius off the centers. Near contact L must grow as
√(R/gap); :func:`sufficient_order` gives it.

References: Jackson, Classical Electrodynamics, 3rd ed., sections 3.6 and 4.1; Steinborn and Ruedenberg 1973, "Rotation
and translation of regular and irregular solid spherical harmonics"; Jones 1995, Electromechanics of Particles, ch. 6.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array
from scipy.special import gammaln

from bench.reference.oracle import MU0


@dataclass(frozen=True)
class Solution:
    """Balls in equilibrium.

    ``multipoles`` are the coefficients of the real irregular harmonics around each ball [A m^(l+1)], l = 1..L,
    m = −l..l, sines for m < 0, cosines for m > 0; their potential is ψ.
    """

    moments: np.ndarray  # [A·m²], shape [n, 3]
    forces: np.ndarray  # [N], shape [n, 3]
    multipoles: np.ndarray  # shape [n, L (L + 2)]
    energy: float  # free energy U = −½ μ0 Σ m·H0 [J]; the forces are −∂U/∂x
    truncation: float  # relative change of the forces against two thirds of the order: an upper bound of their error
    order: int  # order L of the expansions


def log_polarizabilities(order: int, radius: float, permeability: float) -> np.ndarray:
    """Logarithms of a ball's multipole polarizabilities p_l [m^(2l+1)], l = 1..order; μr > 1, may be infinite."""
    degree, response = np.arange(1, order + 1), 1.0
    if not math.isinf(permeability):
        response = degree * (permeability - 1.0) / (degree * (permeability + 1.0) + 1.0)
    return (2.0 * degree + 1.0) * np.log(radius) + np.log(response)


def sufficient_order(distance: float, radius_i: float, radius_j: float, tolerance: float) -> int:
    """Order L at which the truncation error of two balls is about a relative ``tolerance``."""
    xi = min(
        math.acosh(max((distance**2 + a**2 - b**2) / (2.0 * distance * a), 1.0 + 1e-9))
        for a, b in ((radius_i, radius_j), (radius_j, radius_i))
    )
    return max(6, math.ceil(-0.5 * math.log(tolerance) / xi) + 4)


# ---------- Two balls: on their axis the orders m decouple ----------


@dataclass(frozen=True)
class Pair:
    """Two balls in fields that are uniform over each ball: H_i = Σ_j R_ij m_j, along the axis and across it."""

    resistance: np.ndarray  # R [1/m³], shape [2, 2, 2]: along ([0]) and across ([1]), ball, ball
    slope: np.ndarray  # ∂R/∂d [1/m⁴] at given moments, same shape
    order: int  # order L of the expansions


def pair(distance, radii, permeabilities, *, order=None, tolerance=1e-10) -> Pair:
    """Solve two balls from the distance of their centers [m], radii [m] and permeabilities μr > 1, finite or infinite.

    If ``order`` is None, the order of the expansions follows from ``tolerance``, the relative truncation error.
    """
    unit = math.sqrt(radii[0] * radii[1])
    d, a, b = distance / unit, radii[0] / unit, radii[1] / unit
    order = order or sufficient_order(d, a, b, tolerance)
    p, q = (log_polarizabilities(order, r, mu) for r, mu in zip((a, b), permeabilities, strict=True))
    degree = np.arange(1, order + 1)
    rows, columns = degree[:, None], degree[None, :]
    resistance, slope = np.empty((2, 2, 2)), np.empty((2, 2, 2))
    for m in (0, 1):
        norm = -0.5 * (gammaln(degree + m + 1.0) + gammaln(degree - m + 1.0))
        size = gammaln(rows + columns + 1.0) + norm[:, None] + norm[None, :] - (rows + columns + 1.0) * np.log(d)
        # target second ball, source first: t = +d ẑ, scaled so that an isolated ball has the unit matrix
        coupling = (-1.0) ** (rows + m) * np.exp(size + 0.5 * q[:, None] + 0.5 * p[None, :])
        system = np.block([[np.eye(order), coupling.T], [coupling, np.eye(order)]])
        change = -(rows + columns + 1.0) / d * coupling
        change = np.block([[np.zeros_like(change), change.T], [change, np.zeros_like(change)]])
        y = cho_solve(cho_factor(system), np.eye(2 * order)[:, [0, order]])
        root = np.exp(0.5 * np.array([p[0], q[0]]))
        inverse = np.linalg.inv(y[[0, order]])
        resistance[m] = inverse / np.outer(root, root) / (4.0 * np.pi * unit**3)
        # at constant moments only the energy of the coupling changes
        slope[m] = inverse @ (y.T @ change @ y) @ inverse / np.outer(root, root) / (4.0 * np.pi * unit**4)
    return Pair(resistance, slope, order)


# ---------- Any number of balls ----------


def spheres(positions, radii, permeability, field, **settings) -> Solution:
    """Solve n balls for one permeability and field, see :func:`spheres_in_fields`."""
    return spheres_in_fields(positions, radii, [(permeability, field)], **settings)[0]


def spheres_in_fields(positions, radii, cases, *, order=None, tolerance=1e-4, estimate=True) -> list[Solution]:
    """Solve n balls that do not touch, for several permeabilities and fields.

    Most time goes into translations of expansions of L (L + 2) terms, one per displacement between two balls: balls on
    a lattice have few displacements.

    Args:
        positions: Centers [m], shape [n, 3].
        radii: Radii [m], scalar or [n].
        cases: Relative permeability μr > 1 (may be infinite), scalar or [n], and field H0 [A/m], shape [3], of each.
        order: Order L of the expansions; None chooses it for the narrowest gap by ``tolerance``.
        tolerance: Target relative truncation error.
        estimate: Whether to estimate the truncation error, by a second solution.
    """
    x = np.asarray(positions, float)
    n = len(x)
    radii = np.broadcast_to(np.asarray(radii, float), n)
    mu = np.array([np.broadcast_to(np.asarray(permeability, float), n) for permeability, _ in cases])
    fields = np.array([field for _, field in cases], float)
    if order is None:
        pairs = itertools.combinations(range(n), 2)
        orders = [sufficient_order(math.dist(x[i], x[j]), radii[i], radii[j], tolerance) for i, j in pairs]
        order = max(orders, default=1)
    a, forces = _solve(x, radii, mu, fields, order)
    truncation = np.full(len(cases), math.nan)
    if estimate and order > 1:
        _, coarse = _solve(x, radii, mu, fields, max(1, 2 * order // 3))
        size = np.linalg.norm(forces, axis=(1, 2))
        truncation = np.linalg.norm(coarse - forces, axis=(1, 2)) / np.maximum(size, np.finfo(float).tiny)
    moments = 4.0 * np.pi * a[:, :, [2, 0, 1]]
    energies = -0.5 * MU0 * np.einsum("kni,ki->k", moments, fields)
    rows = zip(moments, forces, a, map(float, energies), truncation, strict=True)
    return [Solution(*row, order) for row in rows]


def _solve(x, radii, mu, fields, order):
    """Multipoles and forces of balls in several cases, shape [cases, n, ...], with expansions up to ``order``."""
    n, degrees = len(x), _Degrees(order)
    unit = float(np.exp(np.mean(np.log(radii))))
    x, radii = x / unit, radii / unit
    scale = np.array([[log_polarizabilities(order, *ball) for ball in zip(radii, case, strict=True)] for case in mu])
    scale = np.exp(0.5 * scale)[:, :, degrees.l - 1]  # an isolated ball has the unit matrix
    displaced: dict[tuple, list] = {}
    for i in range(n):
        for j in range(i):
            t = x[i] - x[j]
            forward = tuple(t) > (0.0, 0.0, 0.0)
            key = tuple(np.round(t if forward else -t, 12) + 0.0)
            displaced.setdefault(key, []).append((i, j) if forward else (j, i))
    pairs = [(np.array(key), *np.transpose(ends)) for key, ends in displaced.items()]
    blocks = [(degrees.translation(t), target, source) for t, target, source in pairs]

    def apply(v):
        """1 + scaled T, of vectors [cases, n, size]."""
        scaled = scale * v
        out = np.zeros_like(v)
        for block, target, source in blocks:
            out[:, target] += np.tensordot(scaled[:, source], block, (2, 1))
            out[:, source] += np.tensordot(scaled[:, target], block, (2, 0))
        return v + scale * out

    right = np.zeros_like(scale)
    # real harmonics of degree 1 in the order y, z, x
    right[:, :, :3] = scale[:, :, :3] * fields[:, None, [1, 2, 0]]
    a = scale * _conjugate_gradients(apply, right)
    forces = np.zeros((len(mu), n, 3))
    for t, target, source in pairs:
        for axis, gradient in enumerate(degrees.translation_gradient(t)):
            energy = np.sum(np.tensordot(a[:, target], gradient, (2, 0)) * a[:, source], axis=2)
            pull = -4.0 * np.pi * MU0 * unit**2 * energy
            np.add.at(forces[:, :, axis], (slice(None), target), pull)
            np.add.at(forces[:, :, axis], (slice(None), source), -pull)
    return a * unit ** (degrees.l + 2.0), forces


def _conjugate_gradients(apply, right):
    """Solve a symmetric positive definite system for several right-hand sides, shape [sides, ...], to rounding."""
    axes = tuple(range(1, right.ndim))

    def dot(u, v):
        return np.sum(u * v, axis=axes, keepdims=True)

    solution, residual, direction = np.zeros_like(right), right.copy(), right.copy()
    size, goal = dot(residual, residual), 1e-29 * dot(right, right)
    while np.any(size > goal):
        image = apply(direction)
        step = size / np.maximum(dot(direction, image), np.finfo(float).tiny)
        solution += step * direction
        residual -= step * image
        last, size = size, dot(residual, residual)
        direction = residual + size / np.maximum(last, np.finfo(float).tiny) * direction
    return solution


def _irregular(t, order):
    """Irregular solid harmonics S_lm = (l−m)! P_lm(cos θ) e^(imφ)/t^(l+1) up to an order, and the column of m = 0.

    Rows are degrees l; one row and two columns beyond the harmonics are zero.
    """
    x, y, z = t
    t2 = x * x + y * y + z * z
    s = np.zeros((order + 2, 2 * order + 3), complex)
    zero = order + 1  # column of m = 0; one spare on each side
    diagonal = 1.0 / math.sqrt(t2)
    for m in range(order + 1):
        s[m, zero + m] = diagonal
        for l in range(m, order):  # noqa: E741
            s[l + 1, zero + m] = ((2 * l + 1) * z * s[l, zero + m] - (l * l - m * m) * s[l - 1, zero + m]) / t2
        diagonal = -(2 * m + 1) * (x + 1j * y) * diagonal / t2
    signs = (-1.0) ** np.arange(1, order + 2)
    s[:, zero - 1 :: -1] = signs * np.conj(s[:, zero + 1 :])
    return s, zero


class _Degrees:
    """Indices of the harmonics up to an order, in the sequence (l, m = −l..l), and the transform to real ones."""

    def __init__(self, order):
        self.order = order
        self.l = np.concatenate([np.full(2 * k + 1, k) for k in range(1, order + 1)])
        self.m = np.concatenate([np.arange(-k, k + 1) for k in range(1, order + 1)])
        norm = np.exp(-0.5 * (gammaln(self.l + self.m + 1.0) + gammaln(self.l - self.m + 1.0)))
        self.left = norm * (-1.0) ** (self.l + self.m)
        self.right = norm
        size = len(self.l)
        index = np.arange(size)
        mirror = index - 2 * self.m
        sign = (-1.0) ** np.abs(self.m)
        # columns: cosine harmonics where m > 0, sine harmonics where m < 0
        diagonal = np.where(self.m > 0, sign / math.sqrt(2.0), np.where(self.m < 0, 1j / math.sqrt(2.0), 1.0))
        mirrored = np.where(self.m > 0, 1.0 / math.sqrt(2.0), -1j * sign / math.sqrt(2.0))
        paired = self.m != 0
        positions = np.concatenate([index, mirror[paired]]), np.concatenate([index, index[paired]])
        self.real = csr_array((np.concatenate([diagonal, mirrored[paired]]), positions), shape=(size, size))

    def translation(self, t, ladder=((0, 0, 1.0),)):
        """Matrix T from irregular real harmonics at a source to regular ones at a target, t = x_target − x_source.

        ``ladder`` lists (degrees added, orders added, factor): a combination of harmonics in place of the plain one.
        """
        s, zero = _irregular(t, 2 * self.order + 1)
        degree = self.l[:, None] + self.l[None, :]
        order = self.m[None, :] - self.m[:, None]
        block = sum(factor * s[degree + up, zero + order + turn] for up, turn, factor in ladder)
        block = self.left[:, None] * block * self.right[None, :]
        return (self.real.conj().T @ (self.real.T @ block.T).T).real

    def translation_gradient(self, t):
        """Derivatives ∂T/∂t, shape [3, size, size]."""
        return [
            self.translation(t, ((1, 1, 0.5), (1, -1, -0.5))),
            self.translation(t, ((1, 1, -0.5j), (1, -1, -0.5j))),
            self.translation(t, ((1, 0, -1.0),)),
        ]
