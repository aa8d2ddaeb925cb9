"""The near-contact model on the device: what balls that nearly touch add to their dipoles.

``warpmag.near_contact`` holds the physics, the table and the reference implementation; names are the same. Every ball i
has contact sources n_i = (q, N), and with its actual ones a_i = (0, m_i)

    e = M (a − n),    n = ΔC e,    4π H_near = (M n)_m,

M the short-range matrix of sources and dipoles, ΔC the conductances of the near pairs. The eigenvalues of 1 + ΔC M lie
between 1 and a bound L that follows from the pairs, so heavy-ball sweeps

    n ← n + α (ΔC e − n) + β (n − n'),    α = 4/(√L + 1)², β = ((√L − 1)/(√L + 1))²,

converge. They run along with the induction, from where the last left off.

Only eligible balls take part, in pairs with one another: single inducible moments with at most ``CAPACITY`` near ones
and no more volume shared than the model allows.

| variable | shape | meaning |
|---|---|---|
| pairs | [n, CAPACITY, 16] | direction to j; A to H as ball i sees them; D as j does; U_sr, g1 d, g1, g2 d² |
| contact, last_contact, drive | [n] | n, n of the sweep before, e: vectors (q or φ, x, y, z) |
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag import near_contact as model
from warpmag.kernels.curves import inverse_curve_ratio, reduced_curve_slope
from warpmag.kernels.packing import ball_volume
from warpmag.kernels.pair_law import averaged_factors, overlap_fraction, pair_factors
from warpmag.kernels.wrench import MU0

CAPACITY = 32
"""Near balls a list can hold; balls that do not overlap have at most about 22."""
SWEEPS = 2
"""Sweeps before each field evaluation: with one, a cold solve of a pile takes twice as many evaluations."""
FORCE_SWEEPS = 2
"""Sweeps before forces are taken."""
KINDS = 16
"""Susceptibilities that are told apart."""
_COEFFICIENTS = 16
_MOST_GRID_CELLS = 64


@dataclass(frozen=True)
class NearContactBuffers:
    """All that the model keeps on the device, for n moments.

    Attributes:
        eligible: Whether a moment may take part, shape [n].
        group: World of each moment, shape [n].
        kind: Kind of material of each moment, shape [n].
        kind_count: Number of kinds.
        tables: Spline coefficients of A to H by gap for each pair of kinds, shape [kinds², gaps + 2, 8].
        neighbor, count: Near balls of each and how many, shape [n, CAPACITY] and [n].
        share: Factor by which a ball takes part, shape [n].
        weight: Factor that falls as it saturates, shape [n].
        pairs, contact, last_contact, drive: See the module.
        field: 4π H_near [A/m], shape [n].
        bound: Bound L of each world, shape [worlds].
        points: Positions in float32 [m], shape [n].
        grid: Hash grid over them.
        reach: Distance of the farthest pair [m]; 0 if no moment may take part.
    """

    eligible: wp.array
    group: wp.array
    kind: wp.array
    kind_count: int
    tables: wp.array
    neighbor: wp.array
    count: wp.array
    share: wp.array
    weight: wp.array
    pairs: wp.array
    contact: wp.array
    last_contact: wp.array
    drive: wp.array
    field: wp.array
    bound: wp.array
    points: wp.array
    grid: wp.HashGrid
    reach: float


def allocate(radii, worlds, eligible, susceptibility, dtype, device) -> NearContactBuffers:
    """Allocate the buffers.

    Args:
        radii: Ball radii [m], NumPy, shape [n].
        worlds: World of each moment, shape [n].
        eligible: Whether a moment may take part, shape [n].
        susceptibility: Susceptibility of each, shape [n], may be infinite.
        dtype: Warp scalar type.
        device: Warp device.
    """
    n = len(radii)
    hardness = model.hardness(susceptibility)
    levels = np.unique(hardness[eligible]) if np.any(eligible) else np.zeros(1)
    if len(levels) > KINDS:
        levels = np.quantile(levels, np.linspace(0.0, 1.0, KINDS))
    kind = np.abs(hardness[:, None] - levels[None]).argmin(1)
    tables = np.array([model.gap_table(float(own), float(other)) for own in levels for other in levels])
    vec4 = wp.types.vector(4, dtype)

    def put(values, kind):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

    # about one ball per cell of a compact pile; a larger grid only costs time to clear
    cells = int(np.clip(2 ** np.ceil(np.log2(max(n, 1)) / 3.0), 8, _MOST_GRID_CELLS))
    grid = wp.HashGrid(cells, cells, cells, device=device)
    grid.reserve(max(n, 1), with_groups=True)
    return NearContactBuffers(
        eligible=put(np.asarray(eligible, np.int32), wp.int32),
        group=put(np.asarray(worlds, np.int32), wp.int32),
        kind=put(kind.astype(np.int32), wp.int32),
        kind_count=len(levels),
        tables=put(tables, dtype),
        neighbor=wp.zeros((n, CAPACITY), dtype=int, device=device),
        count=wp.zeros(n, dtype=int, device=device),
        share=wp.zeros(n, dtype=dtype, device=device),
        weight=wp.zeros(n, dtype=dtype, device=device),
        pairs=wp.zeros((n, CAPACITY, _COEFFICIENTS), dtype=dtype, device=device),
        **{name: wp.zeros(n, dtype=vec4, device=device) for name in ("contact", "last_contact", "drive")},
        field=wp.zeros(n, dtype=wp.types.vector(3, dtype), device=device),
        bound=wp.zeros(int(np.max(worlds, initial=0)) + 1, dtype=dtype, device=device),
        points=wp.zeros(n, dtype=wp.vec3, device=device),
        grid=grid,
        reach=model.RANGE * float(np.max(radii, initial=0.0, where=np.asarray(eligible, bool))),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Pairs
# ---------------------------------------------------------------------------------------------------------------------


@wp.func
def smoothstep(x: Any):
    """Smooth step from 0 at x = 0 to 1 at x = 1."""
    t = wp.clamp(x, type(x)(0.0), type(x)(1.0))
    return t * t * (type(x)(3.0) - type(x)(2.0) * t)


@wp.func
def smoothstep_slope(x: Any):
    """Derivative of :func:`smoothstep`."""
    t = wp.clamp(x, type(x)(0.0), type(x)(1.0))
    return type(x)(6.0) * t * (type(x)(1.0) - t)


@wp.func
def averaged_potential(d: Any, a: Any, b: Any):
    """Potential U of two homogeneous balls, as ``model.averaged_potential``; nearly concentric ones as touching."""
    s = a + b
    d = wp.max(d, type(d)(0.05) * s)
    if d >= s:
        return type(d)(1.0) / d
    e = s - d
    p = a * b
    q = type(d)(5.0) * (a - b) * (a - b) - type(d)(10.0) * p - type(d)(4.0) * s * d - d * d
    return (type(d)(1.0) + e * e * e * e * q / (type(d)(160.0) * p * p * p)) / d


@cache
def _pair_functions(dtype):
    """Warp functions of one pair: its ΔC (functions and slopes by the gap) and its short-range factors."""
    functions = wp.types.matrix((2, 8), dtype)
    vec4 = wp.types.vector(4, dtype)

    @wp.func
    def conductances(tables: wp.array3d[dtype], kinds: int, gap: dtype):
        """A to H and their derivatives by the gap [radii], window included."""
        first = dtype(wp.static(model.LOG_GAPS[0]))
        scale = dtype(wp.static((model.LOG_GAPS[2] - 1) / (model.LOG_GAPS[1] - model.LOG_GAPS[0])))
        smallest = dtype(wp.static(model.SMALLEST_GAP))
        softness = dtype(wp.static(model.SOFTNESS))
        outside = wp.max(gap, smallest)
        depth = wp.tanh(wp.min(gap - smallest, dtype(0.0)) / softness)
        x = (wp.log(outside) + softness / smallest * depth - first) * scale
        x = wp.clamp(x, dtype(0.0), dtype(wp.static(model.LOG_GAPS[2] - 1.0)))
        row = wp.min(int(x), wp.static(model.LOG_GAPS[2] - 2))
        t = x - dtype(row)
        u = dtype(1.0) - t
        sixth = dtype(1.0 / 6.0)
        half = dtype(0.5)
        w = vec4(
            sixth * u * u * u,
            sixth * (dtype(4.0) - dtype(6.0) * t * t + dtype(3.0) * t * t * t),
            sixth * (dtype(4.0) - dtype(6.0) * u * u + dtype(3.0) * u * u * u),
            sixth * t * t * t,
        )
        slope = scale * (dtype(1.0) - depth * depth) / outside
        v = slope * vec4(
            -half * u * u,
            half * (dtype(3.0) * t * t - dtype(4.0) * t),
            -half * (dtype(3.0) * u * u - dtype(4.0) * u),
            half * t * t,
        )
        far = (dtype(wp.static(model.RANGE - 2.0)) - gap) / dtype(wp.static(model.WINDOW))
        width = dtype(wp.static(model.DEEPEST[1] - model.DEEPEST[0]))
        deep = (dtype(wp.static(model.DEEPEST[1])) + gap) / width
        window = smoothstep(far) * smoothstep(deep)
        window_slope = smoothstep(far) * smoothstep_slope(deep) / width - smoothstep_slope(far) * smoothstep(
            deep
        ) / dtype(wp.static(model.WINDOW))
        result = functions()
        for f in range(8):
            value = dtype(0.0)
            change = dtype(0.0)
            for k in range(4):
                node = tables[kinds, row + k, f]
                value += w[k] * node
                change += v[k] * node
            result[0, f] = window * value
            result[1, f] = window * change + window_slope * value
        return result

    @wp.func
    def short_range(d: dtype, a: dtype, b: dtype):
        """U_sr and its radial factors g1, g2, g3."""
        half = dtype(wp.static(0.5 * model.RANGE))
        near = pair_factors(d * d, a, b)
        far = averaged_factors(d, half * a, half * b)
        u = averaged_potential(d, a, b) - averaged_potential(d, half * a, half * b)
        return vec4(u, near[0] - far[0], near[1] - far[1], near[2] - far[2])

    return conductances, short_range


@wp.func
def similarity(a: Any, b: Any):
    """Factor that fades the part of balls of unlike size."""
    low = type(a)(wp.static(model.LEAST_RATIO[0]))
    return smoothstep((wp.min(a, b) / wp.max(a, b) - low) / (type(a)(wp.static(model.LEAST_RATIO[1])) - low))


@cache
def _find_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_near_balls(
        # inputs:
        grid: wp.uint64,
        packed: wp.array2d[dtype],
        eligible: wp.array[int],
        group: wp.array[int],
        reach: float,
        # outputs:
        neighbor_out: wp.array2d[int],
        count_out: wp.array[int],
        share_out: wp.array[dtype],
        bound_out: wp.array[dtype],
    ):
        i = wp.tid()
        bound_out[group[i]] = dtype(1.0)
        count_out[i] = 0
        share_out[i] = dtype(0.0)
        x = vec3(packed[0, i], packed[1, i], packed[2, i])
        # not finite, or so far out that the index of its cell overflows: not in the model
        if eligible[i] == 0 or not (wp.length(x) < dtype(1.0e8) * dtype(reach)):
            return
        radius = packed[3, i]
        query = wp.hash_grid_query(grid, wp.vec3(float(x[0]), float(x[1]), float(x[2])), reach, group[i])
        count = int(0)
        shared = dtype(0.0)
        j = int(0)
        while wp.hash_grid_query_next(query, j):
            if j != i and eligible[j] == 1:
                d = wp.length(x - vec3(packed[0, j], packed[1, j], packed[2, j]))
                if d < dtype(wp.static(0.5 * model.RANGE)) * (radius + packed[3, j]):
                    if count < wp.static(CAPACITY):
                        neighbor_out[i, count] = j
                    count += 1
                    shared += overlap_fraction(d, radius, packed[3, j])
        if count > wp.static(CAPACITY):
            return
        count_out[i] = count
        low = dtype(wp.static(model.MOST_SHARED[0]))
        share_out[i] = dtype(1.0) - smoothstep((shared - low) / (dtype(wp.static(model.MOST_SHARED[1])) - low))

    return find_near_balls


@cache
def _pairs_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    vec4 = wp.types.vector(4, dtype)
    conductances, short_range = _pair_functions(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def tabulate_pairs(
        # inputs:
        packed: wp.array2d[dtype],
        group: wp.array[int],
        kind: wp.array[int],
        kind_count: int,
        tables: wp.array3d[dtype],
        neighbor: wp.array2d[int],
        count: wp.array[int],
        share: wp.array[dtype],
        # outputs:
        pairs_out: wp.array3d[dtype],
        contact_out: wp.array[vec4],
        last_contact_out: wp.array[vec4],
        bound_out: wp.array[dtype],
    ):
        i = wp.tid()
        if share[i] == dtype(0.0) or count[i] == 0:
            contact_out[i] = vec4()
            last_contact_out[i] = vec4()
            return
        radius = packed[3, i]
        half = dtype(wp.static(0.5 * model.RANGE))
        stiffness = dtype(0.0)
        strongest = dtype(0.0)
        for n in range(count[i]):
            j = neighbor[i, n]
            b = packed[3, j]
            r = vec3(packed[0, j] - packed[0, i], packed[1, j] - packed[1, i], packed[2, j] - packed[2, i])
            d = wp.length(r)
            scale = dtype(2.0) * radius * b / (radius + b)
            gap = (d - radius - b) / scale
            part = scale * share[i] * share[j] * similarity(radius, b)
            own = conductances(tables, kind[i] * kind_count + kind[j], gap)
            other = own
            if kind[i] != kind[j]:
                other = conductances(tables, kind[j] * kind_count + kind[i], gap)
            unit = dtype(1.0) / (radius + b)  # powers of metres overflow float32
            g = short_range(unit * d, unit * radius, unit * b)
            if share[j] == dtype(0.0):
                g = vec4()
            for c in range(3):
                pairs_out[i, n, c] = r[c] / wp.max(d, dtype(1.0e-6) * radius)
            pairs_out[i, n, 12] = unit * g[0]
            pairs_out[i, n, 13] = unit * unit * (g[1] * unit * d)
            pairs_out[i, n, 14] = unit * unit * unit * g[1]
            pairs_out[i, n, 15] = unit * unit * unit * (g[2] * unit * d * unit * d)
            for f in range(8):
                pairs_out[i, n, 3 + f] = part * own[0, f]
            pairs_out[i, n, 11] = part * other[0, 3]
            stiffness += part * own[0, 0]
            strongest = wp.max(strongest, part * own[0, 4])
        inverse = dtype(1.0) / (half * radius)
        source = dtype(1.0) / radius - dtype(1.2) * inverse
        dipole = dtype(1.0) - inverse * inverse * inverse * radius * radius * radius
        wp.atomic_max(bound_out, group[i], dtype(1.0) + stiffness * source + dtype(1.5) * strongest * dipole / radius)

    return tabulate_pairs


# ---------------------------------------------------------------------------------------------------------------------
# Sweeps
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _drive_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    vec4 = wp.types.vector(4, dtype)

    @wp.func
    def times_pair(pairs: wp.array3d[dtype], i: int, n: int, q: dtype, m: vec3):
        """Block of M for the n-th pair of ball i, times a source and a moment of the other ball."""
        normal = vec3(pairs[i, n, 0], pairs[i, n, 1], pairs[i, n, 2])
        along = wp.dot(normal, m)
        field = -(pairs[i, n, 13] * q + pairs[i, n, 15] * along) * normal - pairs[i, n, 14] * m
        return vec4(pairs[i, n, 12] * q + pairs[i, n, 13] * along, field[0], field[1], field[2])

    @wp.kernel(module="unique", enable_backward=False)
    def find_drive(
        # inputs:
        radii: wp.array[dtype],
        moments: wp.array[vec3],
        share: wp.array[dtype],
        neighbor: wp.array2d[int],
        count: wp.array[int],
        pairs: wp.array3d[dtype],
        contact: wp.array[vec4],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        # outputs:
        drive_out: wp.array[vec4],
        field_out: wp.array[vec3],
        weight_out: wp.array[dtype],
    ):
        """Write e = M (a − n), 4π H_near, and how far each ball still is from saturation."""
        i = wp.tid()
        field_out[i] = vec3()
        weight_out[i] = dtype(0.0)
        if share[i] == dtype(0.0) or count[i] == 0:
            return
        inverse = dtype(1.0) / radii[i]
        far = dtype(wp.static(2.0 / model.RANGE)) * inverse
        source = inverse - dtype(1.2) * far
        dipole = inverse * inverse * inverse - far * far * far
        m = moments[i]
        own = contact[i]
        from_contacts = vec4(source * own[0], dipole * own[1], dipole * own[2], dipole * own[3])
        from_moments = vec4(dtype(0.0), dipole * m[0], dipole * m[1], dipole * m[2])
        for n in range(count[i]):
            j = neighbor[i, n]
            its = contact[j]
            from_contacts += times_pair(pairs, i, n, its[0], vec3(its[1], its[2], its[3]))
            from_moments += times_pair(pairs, i, n, dtype(0.0), moments[j])
        drive_out[i] = from_moments - from_contacts
        field_out[i] = vec3(from_contacts[1], from_contacts[2], from_contacts[3])
        reduced = wp.length(m) / ball_volume(radii[i]) / saturation[i]
        steepness = reduced_curve_slope(inverse_curve_ratio(reduced, curve[i]) * reduced, curve[i])
        third = dtype(1.0 / 3.0)
        state = dtype(1.0) / wp.max(slope[i] * steepness, dtype(1.0e-12)) - third
        linear = dtype(1.0) / slope[i] - third
        softest = dtype(2.5)  # of the higher multipoles: polarizability 2χ/(2χ + 5)
        weight_out[i] = (dtype(1.0) + softest * linear) / (dtype(1.0) + softest * wp.max(state, dtype(0.0)))

    return find_drive


@cache
def _field_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_field(
        # inputs:
        row_target: wp.array[int],
        field: wp.array[vec3],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        """Add 4π H_near to the sums of the field loop."""
        row = wp.tid()
        h = field[row_target[row]]
        for c in range(3):
            partial_out[0, row, c] = partial_out[0, row, c] + h[c]

    return add_field


@cache
def _contact_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    vec4 = wp.types.vector(4, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def sweep_contacts(
        # inputs:
        radii: wp.array[dtype],
        group: wp.array[int],
        share: wp.array[dtype],
        weight: wp.array[dtype],
        neighbor: wp.array2d[int],
        count: wp.array[int],
        pairs: wp.array3d[dtype],
        drive: wp.array[vec4],
        bound: wp.array[dtype],
        # in and out:
        contact: wp.array[vec4],
        last_contact: wp.array[vec4],
    ):
        """Move n towards ΔC e."""
        i = wp.tid()
        if share[i] == dtype(0.0) or count[i] == 0:
            return
        own = radii[i]
        phi = drive[i][0]
        e = vec3(drive[i][1], drive[i][2], drive[i][3])
        q = dtype(0.0)
        m = vec3()
        for n in range(count[i]):
            j = neighbor[i, n]
            w = weight[i] * weight[j]
            normal = vec3(pairs[i, n, 0], pairs[i, n, 1], pairs[i, n, 2])
            its = radii[j]
            phi_j = drive[j][0]
            e_j = (w * its) * vec3(drive[j][1], drive[j][2], drive[j][3])
            phi_j = w * phi_j
            alpha = (w * own) * wp.dot(normal, e)
            alpha_j = -wp.dot(normal, e_j)
            q += w * pairs[i, n, 3] * phi + pairs[i, n, 4] * phi_j + pairs[i, n, 5] * alpha + pairs[i, n, 6] * alpha_j
            along = (
                w * pairs[i, n, 5] * phi
                + pairs[i, n, 11] * phi_j
                + (pairs[i, n, 7] - pairs[i, n, 9]) * alpha
                + (pairs[i, n, 8] + pairs[i, n, 10]) * alpha_j
            )
            m += along * normal + (w * own * pairs[i, n, 9]) * e + pairs[i, n, 10] * e_j
        goal = vec4(q, own * m[0], own * m[1], own * m[2])
        root = wp.sqrt(bound[group[i]])
        one = dtype(1.0)
        pace = dtype(4.0) / ((root + one) * (root + one))
        momentum = (root - one) * (root - one) / ((root + one) * (root + one))
        now = contact[i]
        moved = now + pace * (goal - now) + momentum * (now - last_contact[i])
        if not wp.isfinite(wp.length(moved)):
            moved = vec4()
        last_contact[i] = now
        contact[i] = moved

    return sweep_contacts


# ---------------------------------------------------------------------------------------------------------------------
# Forces
# ---------------------------------------------------------------------------------------------------------------------


@cache
def _force_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    vec4 = wp.types.vector(4, dtype)
    conductances, short_range = _pair_functions(dtype)

    @wp.func
    def source_force(g: vec4, r: vec3, q: dtype, m: vec3, q_j: dtype, m_j: vec3):
        """Force of a source and moment (q_j, m_j) on (q, m) at separation r = x − x_j."""
        a = wp.dot(r, m_j)
        b = wp.dot(r, m)
        field = g[1] * (m_j - q_j * r) + (g[2] * a) * r
        gradient = g[2] * (b * m_j + a * m + wp.dot(m, m_j) * r) + (g[3] * a * b) * r
        return q * field + gradient - q_j * (g[1] * m + (g[2] * b) * r)

    @wp.func
    def contact_force(
        own: wp.types.matrix((2, 8), dtype), other: wp.types.matrix((2, 8), dtype), scale: dtype, d: dtype,
        normal: vec3, a: dtype, b: dtype, e: vec4, e_j: vec4,
    ):  # fmt: skip
        """Derivative of ½ e ΔC e of a pair by the position of its ball of radius a, ``normal`` the way to the other."""
        half = dtype(0.5)
        h = a * vec3(e[1], e[2], e[3])
        h_j = b * vec3(e_j[1], e_j[2], e_j[3])
        alpha = wp.dot(normal, h)
        alpha_j = -wp.dot(normal, h_j)
        square = wp.dot(h, h) - alpha * alpha
        square_j = wp.dot(h_j, h_j) - alpha_j * alpha_j
        mixed = wp.dot(h, h_j) + alpha * alpha_j
        radial = half * (own[1, 0] * e[0] * e[0] + other[1, 0] * e_j[0] * e_j[0]) + own[1, 1] * e[0] * e_j[0]
        radial += own[1, 2] * e[0] * alpha + other[1, 2] * e_j[0] * alpha_j
        radial += own[1, 3] * e[0] * alpha_j + other[1, 3] * e_j[0] * alpha
        radial += half * (own[1, 4] * alpha * alpha + other[1, 4] * alpha_j * alpha_j) + own[1, 5] * alpha * alpha_j
        radial += half * (own[1, 6] * square + other[1, 6] * square_j) + own[1, 7] * mixed
        shared = own[0, 5] + own[0, 7]
        turn = own[0, 2] * e[0] + other[0, 3] * e_j[0] + (own[0, 4] - own[0, 6]) * alpha + shared * alpha_j
        turn_j = other[0, 2] * e_j[0] + own[0, 3] * e[0] + (other[0, 4] - other[0, 6]) * alpha_j + shared * alpha
        across = turn * h - turn_j * h_j
        across -= wp.dot(normal, across) * normal
        return -radial * normal - (scale / d) * across

    @wp.kernel(module="unique", enable_backward=False)
    def add_forces(
        # inputs:
        row_target: wp.array[int],
        packed: wp.array2d[dtype],
        kind: wp.array[int],
        kind_count: int,
        tables: wp.array3d[dtype],
        share: wp.array[dtype],
        weight: wp.array[dtype],
        neighbor: wp.array2d[int],
        count: wp.array[int],
        contact: wp.array[vec4],
        drive: wp.array[vec4],
        field: wp.array[vec3],
        twisted: wp.array[int],
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        i = row_target[wp.tid()]
        if share[i] == dtype(0.0) or count[i] == 0:
            return
        a = packed[3, i]
        m = vec3(packed[4, i], packed[5, i], packed[6, i])
        smooth = m - vec3(contact[i][1], contact[i][2], contact[i][3])
        total = vec3()
        for n in range(count[i]):
            j = neighbor[i, n]
            if share[j] > dtype(0.0):
                b = packed[3, j]
                r = vec3(packed[0, i] - packed[0, j], packed[1, i] - packed[1, j], packed[2, i] - packed[2, j])
                d = wp.max(wp.length(r), dtype(1.0e-6) * a)
                m_j = vec3(packed[4, j], packed[5, j], packed[6, j])
                smooth_j = m_j - vec3(contact[j][1], contact[j][2], contact[j][3])
                unit = dtype(1.0) / (a + b)  # powers of metres overflow float32
                square = unit * unit
                cube = square * unit
                g = short_range(unit * d, unit * a, unit * b)
                x = unit * r
                sources = source_force(
                    g, x, -square * contact[i][0], cube * smooth, -square * contact[j][0], cube * smooth_j
                )
                sources -= source_force(g, x, dtype(0.0), cube * m, dtype(0.0), cube * m_j)
                total += sources / square
                scale = dtype(2.0) * a * b / (a + b)
                gap = (d - a - b) / scale
                part = share[i] * share[j] * similarity(a, b) * weight[i] * weight[j]
                own = conductances(tables, kind[i] * kind_count + kind[j], gap)
                other = own
                if kind[i] != kind[j]:
                    other = conductances(tables, kind[j] * kind_count + kind[i], gap)
                total += part * contact_force(own, other, scale, d, -r / d, a, b, drive[i], drive[j])
        force_out[i] = force_out[i] + dtype(wp.static(MU0 / (4.0 * np.pi))) * total
        if twisted[i] == 1:
            torque_out[i] = torque_out[i] + dtype(wp.static(MU0 / (4.0 * np.pi))) * wp.cross(m, field[i])

    return add_forces


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


def launch_find_pairs(moments, b: NearContactBuffers):
    """Find the near pairs of packed moments (``warpmag.packed.PackedMoments``) and tabulate what they add."""
    if b.reach == 0.0 or moments.count == 0:
        return
    device, dtype = moments.device, moments.dtype
    wp.launch(_points_kernel(dtype), dim=moments.count, inputs=[moments.packed], outputs=[b.points], device=device)
    b.grid.build(b.points, b.reach, b.group)
    wp.launch(
        _find_kernel(dtype),
        dim=moments.count,
        inputs=[b.grid.id, moments.packed, b.eligible, b.group, b.reach],
        outputs=[b.neighbor, b.count, b.share, b.bound],
        device=device,
    )
    wp.launch(
        _pairs_kernel(dtype),
        dim=moments.count,
        inputs=[
            moments.packed, b.group, b.kind, b.kind_count, b.tables, b.neighbor, b.count, b.share,
        ],
        outputs=[b.pairs, b.contact, b.last_contact, b.bound],
        device=device,
    )  # fmt: skip


@cache
def _points_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def copy_points(
        # inputs:
        packed: wp.array2d[dtype],
        # outputs:
        points_out: wp.array[wp.vec3],
    ):
        i = wp.tid()
        points_out[i] = wp.vec3(float(packed[0, i]), float(packed[1, i]), float(packed[2, i]))

    return copy_points


def launch_sweeps(packed, moments, material, b: NearContactBuffers, sweeps: int):
    """Move the contact sources towards those of given moments [A·m²], shape [n]; ``material`` as in ``wrench``."""
    if b.reach == 0.0 or packed.count == 0:
        return
    for _ in range(sweeps):
        wp.launch(
            _drive_kernel(packed.dtype),
            dim=packed.count,
            inputs=[
                packed.radii, moments, b.share, b.neighbor, b.count, b.pairs, b.contact,
                material.saturation, material.slope, material.curve,
            ],
            outputs=[b.drive, b.field, b.weight],
            device=packed.device,
        )  # fmt: skip
        wp.launch(
            _contact_kernel(packed.dtype),
            dim=packed.count,
            inputs=[
                packed.radii, b.group, b.share, b.weight, b.neighbor, b.count, b.pairs, b.drive, b.bound,
                b.contact, b.last_contact,
            ],
            device=packed.device,
        )  # fmt: skip


def launch_add_field(rows, b: NearContactBuffers, partial):
    """Add 4π times the field of the contact sources, as the last sweep found it, to the field loop's sums."""
    if b.reach == 0.0 or rows.count == 0:
        return
    wp.launch(
        _field_kernel(partial.dtype),
        dim=rows.count,
        inputs=[rows.target, b.field],
        outputs=[partial],
        device=partial.device,
    )


def launch_add_forces(rows, moments, b: NearContactBuffers, twisted, forces, torques):
    """Add the forces [N] of near pairs to the moments of ``rows``, and the torques [N·m] to those ``twisted``."""
    if b.reach == 0.0 or rows.count == 0:
        return
    wp.launch(
        _force_kernel(moments.dtype),
        dim=rows.count,
        inputs=[
            rows.target, moments.packed, b.kind, b.kind_count, b.tables, b.share, b.weight,
            b.neighbor, b.count, b.contact, b.drive, b.field, twisted,
        ],
        outputs=[forces, torques],
        device=moments.device,
    )  # fmt: skip
