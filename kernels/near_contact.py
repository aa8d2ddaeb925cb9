"""The near-contact model on the device: what balls that nearly touch add to their dipoles.

``warpmag.near_contact`` holds the physics, the table and the reference implementation; names are the same. Every ball
has contact sources n = (q, N, n_Θ), and with what is left of its actual ones, ã = (−q, m − N, Θ̃),

    e = M ã,    n = ΔC e,    e_Θ = (1 − p) (e' − n_Θ/R⁵),    Θ̃ = −p R⁵ e' − (1 − p) n_Θ,    4π H_near = (M_sr a − e)_m,

e' the e_Θ that other balls make, p the polarizability. Heavy-ball sweeps

    n ← n + α s (ΔC e − n) + β (n − n'),

and the same for Θ̃, with s the inverse diagonal of 1 + ΔC M, run along with the induction, from where the last left off.

Only eligible balls take part, in pairs with one another: single inducible moments with no more near balls than there
are slots, and no more volume shared than the model allows. Near balls are found as ``neighbors`` finds overlaps, and
kept as slots: a pass over the pairs is in ``near_contact_code``, with what each row of an array is.

| variable | shape | meaning |
|---|---|---|
| near, touching | [slots, balls] | near balls, and those whose surfaces nearly touch |
| pairs, contacts, slopes | [slots, rows, balls] | what does not change while balls stand still |
| mirror | [slots, balls] | place among ``halves`` of the other ball's half |
| contact, last_contact, drive | [rows, balls] | n and Θ̃, those of the sweep before, e |
| outer | [rows, balls] | what the first pass keeps for the others |
| field, force | [3, balls] | 4π H_near [A/m]; the force over μ0/4π |
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag import near_contact as model
from warpmag.kernels import neighbors
from warpmag.kernels.curves import TANH, inverse_curve_ratio, reduced_curve_slope
from warpmag.kernels.near_contact_code import (
    CONTACT_ROWS,
    CONTACTS,
    DRIVE_ROWS,
    LANES,
    NEAR,
    OUTER_ROWS,
    OWN_DIPOLE,
    OWN_SOURCE,
    PAIR_ROWS,
    SLOPE_ROWS,
    STATE_ROWS,
    WAYS,
    force_text,
    sweep_text,
)
from warpmag.kernels.packing import ball_volume
from warpmag.kernels.pair_law import overlap_fraction, pair_factors
from warpmag.kernels.pair_loops import cores
from warpmag.kernels.wrench import MU0
from warpmag.near_contact import FUNCTIONS

SWEEPS = 2
"""Sweeps before each field evaluation: with one, a cold solve of a pile takes twice as many evaluations."""
FORCE_SWEEPS = 2
"""Sweeps before forces are taken."""
KINDS = 16
"""Susceptibilities that are told apart."""
_SKIN = 0.05
"""Part of its radius that a ball may move before near balls are sought anew."""
_CANDIDATES = 64
"""Balls that may be listed as near, or about to be."""
_BALLS_PER_THREAD = 500
"""Balls that make another thread of a CPU worth its start."""


@dataclass(frozen=True)
class NearContactBuffers:
    """All that the model keeps on the device, for n moments; balls are moments padded to ``LANES``.

    Attributes:
        group: World of each moment, −1 if it may not take part, shape [n].
        kind: Kind of material of each moment, shape [n].
        kind_count: Number of kinds.
        tables: Spline coefficients of A to P by gap for each pair of kinds, shape [kinds², gaps + 2, functions].
        lists: Balls that are near, or about to be.
        near, count: Near balls and how many, shape [NEAR, balls] and [balls].
        touching, contact_count: Those that nearly touch, shape [CONTACTS, balls] and [balls].
        used: Slots of both kinds that hold something, shape [2, n].
        share: Factor by which a ball takes part, shape [n].
        radius: Radii [m], shape [balls].
        polarizability: p of each ball's quadrupole, shape [balls].
        weight: Factor that falls as it saturates, shape [balls].
        ease: Inverse diagonals s of a ball's q and N, shape [2, balls].
        pairs, contacts, slopes, mirror, contact, last_contact, drive, field, outer, force: See the module.
        halves: What each ball sees of its contacts' forces, and a zero, shape [CONTACTS + 1, 3, balls].
        reach: Distance of the farthest contact [m]; 0 if no moment may take part.
        threads: Threads of a CPU.
    """

    group: wp.array
    kind: wp.array
    kind_count: int
    tables: wp.array
    lists: neighbors.NeighborLists
    near: wp.array
    count: wp.array
    touching: wp.array
    contact_count: wp.array
    used: wp.array
    share: wp.array
    radius: wp.array
    polarizability: wp.array
    weight: wp.array
    ease: wp.array
    pairs: wp.array
    contacts: wp.array
    slopes: wp.array
    mirror: wp.array
    contact: wp.array
    last_contact: wp.array
    drive: wp.array
    field: wp.array
    outer: wp.array
    halves: wp.array
    force: wp.array
    reach: float
    threads: int

    def forget(self):
        """Start cold, from no contact sources."""
        for array in (self.contact, self.last_contact):
            array.zero_()


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
    balls = -(-max(n, 1) // LANES) * LANES
    eligible = np.asarray(eligible, bool)
    hardness = model.hardness(susceptibility)
    levels = np.unique(hardness[eligible]) if np.any(eligible) else np.zeros(1)
    if len(levels) > KINDS:
        levels = np.quantile(levels, np.linspace(0.0, 1.0, KINDS))
    kind = np.abs(hardness[:, None] - levels[None]).argmin(1)
    tables = np.array([model.gap_table(float(own), float(other)) for own in levels for other in levels])
    padded = np.ones(balls)
    padded[:n] = np.where(eligible, radii, 1.0)

    def put(values, kind):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

    def zeros(*shape, kind=dtype):
        return wp.zeros(shape, dtype=kind, device=device)

    def itself(*shape):
        return np.broadcast_to(np.arange(balls), shape)

    ratio = 0.5 * model.REACH + _SKIN
    return NearContactBuffers(
        group=put(np.where(eligible, worlds, -1), wp.int32),
        kind=put(kind, wp.int32),
        kind_count=len(levels),
        tables=put(tables, dtype),
        lists=neighbors.allocate(n, dtype, device, ratio=ratio, capacity=_CANDIDATES),
        near=put(itself(NEAR, balls), wp.int32),
        count=zeros(balls, kind=wp.int32),
        touching=put(itself(CONTACTS, balls), wp.int32),
        contact_count=zeros(balls, kind=wp.int32),
        used=zeros(2, n, kind=wp.int32),
        share=zeros(n),
        radius=put(padded, dtype),
        polarizability=zeros(balls),
        weight=zeros(balls),
        ease=zeros(2, balls),
        pairs=zeros(NEAR, PAIR_ROWS, balls),
        contacts=zeros(CONTACTS, CONTACT_ROWS, balls),
        slopes=zeros(CONTACTS, SLOPE_ROWS, balls),
        mirror=put(CONTACTS * 3 * balls + itself(CONTACTS, balls), wp.int32),
        contact=zeros(STATE_ROWS, balls),
        last_contact=zeros(STATE_ROWS, balls),
        drive=zeros(DRIVE_ROWS, balls),
        field=zeros(3, balls),
        outer=zeros(OUTER_ROWS, balls),
        halves=zeros(CONTACTS + 1, 3, balls),
        force=zeros(3, balls),
        reach=2.0 * float(np.max(radii, initial=0.0, where=eligible)),
        threads=max(1, min(cores(), n // _BALLS_PER_THREAD)),
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
def window(gap: Any, near: Any, far: Any, shallow: Any, deep: Any):
    """Factor that fades between two gaps and between two overlaps, and its derivative; ``model.window``."""
    width = far - near
    depth = deep - shallow
    outer = (far - gap) / width
    inner = (deep + gap) / depth
    slope = smoothstep(outer) * smoothstep_slope(inner) / depth - smoothstep_slope(outer) * smoothstep(inner) / width
    return wp.vector(smoothstep(outer) * smoothstep(inner), slope, length=2)


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
    functions = wp.types.matrix((2, FUNCTIONS), dtype)
    vec4 = wp.types.vector(4, dtype)

    @wp.func
    def conductances(tables: wp.array3d[dtype], kinds: int, gap: dtype):
        """A to P and their derivatives by the gap [radii], window included."""
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
        fade = window(
            gap,
            dtype(wp.static(model.CONTACT_GAP[0])),
            dtype(wp.static(model.CONTACT_GAP[1])),
            dtype(wp.static(model.DEEPEST[0])),
            dtype(wp.static(model.DEEPEST[1])),
        )
        result = functions()
        for f in range(wp.static(FUNCTIONS)):
            value = dtype(0.0)
            change = dtype(0.0)
            for k in range(4):
                node = tables[kinds, row + k, f]
                value += w[k] * node
                change += v[k] * node
            result[0, f] = fade[0] * value
            result[1, f] = fade[0] * change + fade[1] * value
        return result

    @wp.func
    def short_range(d: dtype, a: dtype, b: dtype):
        """U_sr and its radial factors g1, g2, g3."""
        half = dtype(wp.static(0.5 * model.RANGE))
        near = pair_factors(d * d, a, b)
        far = pair_factors(d * d, half * a, half * b)
        u = averaged_potential(d, a, b) - averaged_potential(d, half * a, half * b)
        return vec4(u, near[0] - far[0], near[1] - far[1], near[2] - far[2])

    return conductances, short_range


@wp.func
def similarity(a: Any, b: Any):
    """Factor that fades the part of balls of unlike size."""
    low = type(a)(wp.static(model.LEAST_RATIO[0]))
    return smoothstep((wp.min(a, b) / wp.max(a, b) - low) / (type(a)(wp.static(model.LEAST_RATIO[1])) - low))


@cache
def _watch_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def watch_motion(
        # inputs:
        packed: wp.array2d[dtype],
        group: wp.array[int],
        found_at: wp.array[vec3],
        # outputs:
        moved_out: wp.array[int],
    ):
        i = wp.tid()
        x = vec3(packed[0, i], packed[1, i], packed[2, i])
        if group[i] >= 0 and not wp.length(x - found_at[i]) <= dtype(wp.static(_SKIN)) * packed[3, i]:
            moved_out[0] = 1

    return watch_motion


@cache
def _select_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def select_pairs(
        # inputs:
        packed: wp.array2d[dtype],
        group: wp.array[int],
        candidate: wp.array2d[int],
        candidate_count: wp.array[int],
        # outputs:
        near_out: wp.array2d[int],
        count_out: wp.array[int],
        touching_out: wp.array2d[int],
        contact_count_out: wp.array[int],
        share_out: wp.array[dtype],
    ):
        """Choose the balls that are near now, those that nearly touch first."""
        i = wp.tid()
        count_out[i] = 0
        contact_count_out[i] = 0
        share_out[i] = dtype(0.0)
        if group[i] < 0:
            return
        if candidate_count[i] > candidate.shape[1]:
            return
        x = vec3(packed[0, i], packed[1, i], packed[2, i])
        radius = packed[3, i]
        count = int(0)
        contacts = int(0)
        shared = dtype(0.0)
        others = wp.uint64(0)  # a bit for each candidate
        for k in range(candidate_count[i]):
            j = candidate[i, k]
            b = packed[3, j]
            d = wp.length(x - vec3(packed[0, j], packed[1, j], packed[2, j]))
            if d < dtype(wp.static(0.5 * model.REACH)) * (radius + b):
                count += 1
                shared += overlap_fraction(d, radius, b)
                gap = (d - radius - b) * (radius + b) / (dtype(2.0) * radius * b)
                if gap < dtype(wp.static(model.CONTACT_GAP[1])):
                    if contacts < wp.static(CONTACTS):
                        near_out[contacts, i] = j
                        touching_out[contacts, i] = j
                    contacts += 1
                else:
                    others += wp.uint64(1) << wp.uint64(k)
        low = dtype(wp.static(model.MOST_SHARED[0]))
        share = dtype(1.0) - smoothstep((shared - low) / (dtype(wp.static(model.MOST_SHARED[1])) - low))
        if count <= wp.static(NEAR) and contacts <= wp.static(CONTACTS) and share > dtype(0.0):
            count_out[i] = count
            contact_count_out[i] = contacts
            share_out[i] = share
            n = int(contacts)
            for k in range(candidate_count[i]):
                if ((others >> wp.uint64(k)) & wp.uint64(1)) == wp.uint64(1):
                    near_out[n, i] = candidate[i, k]
                    n += 1

    return select_pairs


@cache
def _pairs_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    _, short_range = _pair_functions(dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def tabulate_pairs(
        # inputs:
        packed: wp.array2d[dtype],
        count: wp.array[int],
        share: wp.array[dtype],
        used: wp.array2d[int],
        stride: int,
        # outputs:
        near_out: wp.array2d[int],
        pairs_out: wp.array3d[dtype],
    ):
        """Fill the slots of near pairs, every ``stride``-th to a thread, and empty those that are no longer used."""
        first, i = wp.tid()
        a = packed[3, i]
        x = vec3(packed[0, i], packed[1, i], packed[2, i])
        for n in range(first, wp.max(count[i], used[0, i]), stride):
            for row in range(wp.static(PAIR_ROWS)):
                pairs_out[n, row, i] = dtype(0.0)
            if n >= count[i]:
                near_out[n, i] = i
            elif share[near_out[n, i]] > dtype(0.0):
                j = near_out[n, i]
                b = packed[3, j]
                r = vec3(packed[0, j], packed[1, j], packed[2, j]) - x
                d = wp.max(wp.length(r), dtype(1.0e-6) * a)
                for c in range(3):
                    pairs_out[n, c, i] = r[c] / d
                unit = dtype(1.0) / (a + b)  # powers of metres overflow float32
                if d < dtype(wp.static(0.5 * model.RANGE)) * (a + b):
                    y = unit * d
                    g = short_range(y, unit * a, unit * b)
                    pairs_out[n, 3, i] = unit * g[0]
                    pairs_out[n, 4, i] = unit * unit * (g[1] * y)
                    pairs_out[n, 5, i] = unit * unit * unit * g[1]
                    pairs_out[n, 6, i] = unit * unit * unit * (g[2] * y * y)
                    pairs_out[n, 7, i] = unit * unit * unit * (unit * (g[3] * y * y * y))
                fade = window(
                    dtype(2.0) * unit * d - dtype(2.0),
                    dtype(wp.static(model.QUADRUPOLE_REACH[0] - 2.0)),
                    dtype(wp.static(model.QUADRUPOLE_REACH[1] - 2.0)),
                    dtype(wp.static(model.QUADRUPOLE_OVERLAP[0])),
                    dtype(wp.static(model.QUADRUPOLE_OVERLAP[1])),
                )
                part = share[i] * share[j] * similarity(a, b)
                pairs_out[n, 8, i] = dtype(1.0) / d
                pairs_out[n, 9, i] = part * fade[0]
                pairs_out[n, 10, i] = part * dtype(2.0) * unit * fade[1]

    return tabulate_pairs


@cache
def _contacts_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)
    functions = wp.types.matrix((2, FUNCTIONS), dtype)
    conductances, _ = _pair_functions(dtype)

    @wp.func
    def slot_of(touching: wp.array2d[int], count: int, i: int, j: int):
        """Slot in which ball ``i`` has ball ``j``; the one beyond all if it has not."""
        for n in range(count):
            if touching[n, i] == j:
                return n
        return wp.static(CONTACTS)

    @wp.func
    def store(
        n: int,
        i: int,
        normal: vec3,
        inverse: dtype,
        scale: dtype,
        part: dtype,
        own: functions,
        other: functions,
        contacts: wp.array3d[dtype],
        slopes: wp.array3d[dtype],
    ):
        for c in range(3):
            contacts[n, c, i] = normal[c]
        for f in range(wp.static(FUNCTIONS)):
            contacts[n, 3 + f, i] = scale * part * own[0, f]
            slopes[n, f, i] = part * own[1, f]
        contacts[n, 17, i] = scale * part * other[0, 3]
        contacts[n, 18, i] = scale * part * other[0, 9]
        contacts[n, 19, i] = scale * part * other[0, 11]
        slopes[n, 14, i] = inverse

    @wp.kernel(module="unique", enable_backward=False)
    def tabulate_contacts(
        # inputs:
        packed: wp.array2d[dtype],
        kind: wp.array[int],
        kind_count: int,
        tables: wp.array3d[dtype],
        count: wp.array[int],
        share: wp.array[dtype],
        used: wp.array2d[int],
        stride: int,
        # outputs:
        touching_out: wp.array2d[int],
        mirror_out: wp.array2d[int],
        contacts_out: wp.array3d[dtype],
        slopes_out: wp.array3d[dtype],
    ):
        """Fill the slots of contacts, those of both balls from the lower one, and empty those no longer used."""
        first, i = wp.tid()
        balls = touching_out.shape[1]
        a = packed[3, i]
        x = vec3(packed[0, i], packed[1, i], packed[2, i])
        for n in range(first, wp.max(count[i], used[1, i]), stride):
            place = int(wp.static(CONTACTS))
            j = int(i)
            if n < count[i]:
                j = touching_out[n, i]
            else:
                touching_out[n, i] = i
            if n < count[i] and share[j] > dtype(0.0):
                place = slot_of(touching_out, count[j], j, i)
                if i < j:
                    b = packed[3, j]
                    r = vec3(packed[0, j], packed[1, j], packed[2, j]) - x
                    d = wp.max(wp.length(r), dtype(1.0e-6) * a)
                    scale = dtype(2.0) * a * b / (a + b)
                    gap = (d - a - b) / scale
                    own = conductances(tables, kind[i] * kind_count + kind[j], gap)
                    other = own
                    if kind[i] != kind[j]:
                        other = conductances(tables, kind[j] * kind_count + kind[i], gap)
                    part = share[i] * share[j] * similarity(a, b)
                    inverse = dtype(1.0) / d
                    store(n, i, inverse * r, inverse, scale, part, own, other, contacts_out, slopes_out)
                    store(place, j, -inverse * r, inverse, scale, part, other, own, contacts_out, slopes_out)
            else:
                for row in range(wp.static(CONTACT_ROWS)):
                    contacts_out[n, row, i] = dtype(0.0)
                for row in range(wp.static(SLOPE_ROWS)):
                    slopes_out[n, row, i] = dtype(0.0)
            mirror_out[n, i] = place * 3 * balls + j

    return tabulate_contacts


@cache
def _ease_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def find_ease(
        # inputs:
        radius: wp.array[dtype],
        count: wp.array[int],
        contact_count: wp.array[int],
        contacts: wp.array3d[dtype],
        # outputs:
        used_out: wp.array2d[int],
        ease_out: wp.array2d[dtype],
        contact_out: wp.array2d[dtype],
        last_contact_out: wp.array2d[dtype],
    ):
        """Write the inverse diagonals, and clear the sources of balls that have no pair."""
        i = wp.tid()
        used_out[0, i] = count[i]
        used_out[1, i] = contact_count[i]
        if count[i] == 0:
            for row in range(wp.static(STATE_ROWS)):
                contact_out[row, i] = dtype(0.0)
                last_contact_out[row, i] = dtype(0.0)
            return
        sources = dtype(0.0)
        dipoles = dtype(0.0)
        for n in range(contact_count[i]):
            sources += contacts[n, 3, i]
            dipoles += (contacts[n, 7, i] + dtype(2.0) * contacts[n, 9, i]) / dtype(3.0)
        ease_out[0, i] = radius[i] / (radius[i] + dtype(wp.static(OWN_SOURCE)) * sources)
        ease_out[1, i] = radius[i] / (radius[i] + dtype(wp.static(OWN_DIPOLE)) * dipoles)

    return find_ease


@cache
def _weight_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def weigh_balls(
        # inputs:
        group: wp.array[int],
        packed: wp.array2d[dtype],
        saturation: wp.array[dtype],
        slope: wp.array[dtype],
        curve: wp.array[int],
        # outputs:
        weight_out: wp.array[dtype],
        polarizability_out: wp.array[dtype],
    ):
        """Write how far each ball is from saturation."""
        i = wp.tid()
        if group[i] < 0:
            return
        one = dtype(1.0)
        m = vec3(packed[4, i], packed[5, i], packed[6, i])
        reduced = wp.length(m) / ball_volume(packed[3, i]) / saturation[i]
        steepness = one - reduced * reduced  # of tanh
        if curve[i] != wp.static(TANH):
            steepness = reduced_curve_slope(inverse_curve_ratio(reduced, curve[i]) * reduced, curve[i])
        third = dtype(1.0 / 3.0)
        state = one / wp.max(slope[i] * steepness, dtype(1.0e-12)) - third
        linear = one / slope[i] - third
        softest = dtype(2.5)  # of the higher multipoles: polarizability 2χ/(2χ + 5)
        polarizability = one / (one + softest * wp.max(state, dtype(0.0)))
        polarizability_out[i] = polarizability
        weight_out[i] = (one + softest * linear) * polarizability

    return weigh_balls


# ---------------------------------------------------------------------------------------------------------------------
# Sweeps and forces
# ---------------------------------------------------------------------------------------------------------------------


def _vector_options() -> dict:
    """Compiler options for registers as wide as the CPU has."""
    return {"cpu_compiler_flags": f"{wp.config.cpu_compiler_flags or '-march=native'} -mprefer-vector-width=512"}


@cache
def _sweep_kernel(dtype):
    @wp.func_native(sweep_text("float" if dtype is wp.float32 else "double"))
    def sweep(
        thread: int,
        only: int,
        passes: int,
        threads: int,
        packed_in: wp.array2d[dtype],
        near_in: wp.array2d[int],
        pairs_in: wp.array3d[dtype],
        count_in: wp.array[int],
        touching_in: wp.array2d[int],
        contacts_in: wp.array3d[dtype],
        contact_count_in: wp.array[int],
        radius_in: wp.array[dtype],
        polarizability_in: wp.array[dtype],
        weight_in: wp.array[dtype],
        ease_in: wp.array2d[dtype],
        contact_in: wp.array2d[dtype],
        last_contact_in: wp.array2d[dtype],
        drive_in: wp.array2d[dtype],
        field_in: wp.array2d[dtype],
        outer_in: wp.array2d[dtype],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=_vector_options())
    def sweep_contacts(
        # inputs:
        only: int,
        passes: int,
        threads: int,
        packed: wp.array2d[dtype],
        near: wp.array2d[int],
        pairs: wp.array3d[dtype],
        count: wp.array[int],
        touching: wp.array2d[int],
        contacts: wp.array3d[dtype],
        contact_count: wp.array[int],
        radius: wp.array[dtype],
        polarizability: wp.array[dtype],
        weight: wp.array[dtype],
        ease: wp.array2d[dtype],
        # in and out:
        contact: wp.array2d[dtype],
        last_contact: wp.array2d[dtype],
        # outputs:
        drive_out: wp.array2d[dtype],
        field_out: wp.array2d[dtype],
        outer_out: wp.array2d[dtype],
    ):
        sweep(
            wp.tid(), only, passes, threads, packed, near, pairs, count, touching, contacts, contact_count, radius,
            polarizability, weight, ease, contact, last_contact, drive_out, field_out, outer_out,
        )  # fmt: skip

    return sweep_contacts


@cache
def _force_kernel(dtype):
    @wp.func_native(force_text("float" if dtype is wp.float32 else "double"))
    def sum_forces(
        thread: int,
        only: int,
        passes: int,
        threads: int,
        packed_in: wp.array2d[dtype],
        near_in: wp.array2d[int],
        pairs_in: wp.array3d[dtype],
        count_in: wp.array[int],
        touching_in: wp.array2d[int],
        contacts_in: wp.array3d[dtype],
        contact_count_in: wp.array[int],
        slopes_in: wp.array3d[dtype],
        mirror_in: wp.array2d[int],
        radius_in: wp.array[dtype],
        weight_in: wp.array[dtype],
        contact_in: wp.array2d[dtype],
        drive_in: wp.array2d[dtype],
        halves_in: wp.array3d[dtype],
        force_in: wp.array2d[dtype],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=_vector_options())
    def near_forces(
        # inputs:
        only: int,
        passes: int,
        threads: int,
        packed: wp.array2d[dtype],
        near: wp.array2d[int],
        pairs: wp.array3d[dtype],
        count: wp.array[int],
        touching: wp.array2d[int],
        contacts: wp.array3d[dtype],
        contact_count: wp.array[int],
        slopes: wp.array3d[dtype],
        mirror: wp.array2d[int],
        radius: wp.array[dtype],
        weight: wp.array[dtype],
        contact: wp.array2d[dtype],
        drive: wp.array2d[dtype],
        # outputs:
        halves_out: wp.array3d[dtype],
        force_out: wp.array2d[dtype],
    ):
        sum_forces(
            wp.tid(), only, passes, threads, packed, near, pairs, count, touching, contacts, contact_count, slopes,
            mirror, radius, weight, contact, drive, halves_out, force_out,
        )  # fmt: skip

    return near_forces


def _launch_passes(kernel, passes: int, packed, inputs, outputs, b: NearContactBuffers):
    """Launch passes of two kinds in turn: one by one on a GPU, where a launch is what they meet at."""
    gpu = packed.device.is_cuda
    for only in range(passes) if gpu else (0,):
        wp.launch(
            kernel,
            dim=WAYS * packed.count if gpu else 1,
            inputs=[only, passes, b.threads, packed.packed, *inputs],
            outputs=outputs,
            device=packed.device,
            block_dim=128,
        )


@cache
def _field_kernel(dtype):
    @wp.kernel(module="unique", enable_backward=False)
    def add_field(
        # inputs:
        row_target: wp.array[int],
        field: wp.array2d[dtype],
        # outputs:
        partial_out: wp.array3d[dtype],
    ):
        """Add 4π H_near to the sums of the field loop."""
        row = wp.tid()
        i = row_target[row]
        for c in range(3):
            partial_out[0, row, c] = partial_out[0, row, c] + field[c, i]

    return add_field


@cache
def _wrench_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def add_wrench(
        # inputs:
        row_target: wp.array[int],
        packed: wp.array2d[dtype],
        force: wp.array2d[dtype],
        field: wp.array2d[dtype],
        twisted: wp.array[int],
        # outputs:
        force_out: wp.array[vec3],
        torque_out: wp.array[vec3],
    ):
        i = row_target[wp.tid()]
        unit = dtype(wp.static(MU0 / (4.0 * np.pi)))
        force_out[i] = force_out[i] + unit * vec3(force[0, i], force[1, i], force[2, i])
        if twisted[i] == 1:
            m = vec3(packed[4, i], packed[5, i], packed[6, i])
            torque_out[i] = torque_out[i] + unit * wp.cross(m, vec3(field[0, i], field[1, i], field[2, i]))

    return add_wrench


# ---------------------------------------------------------------------------------------------------------------------
# Launches
# ---------------------------------------------------------------------------------------------------------------------


def launch_find_pairs(moments, b: NearContactBuffers):
    """Find the near pairs of packed moments (``warpmag.packed.PackedMoments``) and tabulate what they add."""
    if b.reach == 0.0 or moments.count == 0:
        return
    device, dtype, n, packed = moments.device, moments.dtype, moments.count, moments.packed
    wp.launch(
        _watch_kernel(dtype), dim=n, inputs=[packed, b.group, b.lists.found_at], outputs=[b.lists.moved], device=device
    )
    neighbors.launch_find_neighbors(packed, packed, b.group, b.group, b.reach, b.lists, b.lists)
    wp.launch(
        _select_kernel(dtype),
        dim=n,
        inputs=[packed, b.group, b.lists.neighbor, b.lists.count],
        outputs=[b.near, b.count, b.touching, b.contact_count, b.share],
        device=device,
    )
    near_threads, contact_threads = (NEAR, CONTACTS) if device.is_cuda else (1, 1)
    wp.launch(
        _pairs_kernel(dtype),
        dim=(near_threads, n),
        inputs=[packed, b.count, b.share, b.used, near_threads],
        outputs=[b.near, b.pairs],
        device=device,
    )
    wp.launch(
        _contacts_kernel(dtype),
        dim=(contact_threads, n),
        inputs=[packed, b.kind, b.kind_count, b.tables, b.contact_count, b.share, b.used, contact_threads],
        outputs=[b.touching, b.mirror, b.contacts, b.slopes],
        device=device,
    )
    wp.launch(
        _ease_kernel(dtype),
        dim=n,
        inputs=[b.radius, b.count, b.contact_count, b.contacts],
        outputs=[b.used, b.ease, b.contact, b.last_contact],
        device=device,
    )


def launch_sweeps(packed, material, b: NearContactBuffers, sweeps: int):
    """Move the contact sources towards those of the packed moments; ``material`` as in ``wrench``."""
    if b.reach == 0.0 or packed.count == 0:
        return
    wp.launch(
        _weight_kernel(packed.dtype),
        dim=packed.count,
        inputs=[b.group, packed.packed, material.saturation, material.slope, material.curve],
        outputs=[b.weight, b.polarizability],
        device=packed.device,
    )
    _launch_passes(
        _sweep_kernel(packed.dtype),
        2 * sweeps,
        packed,
        [
            b.near, b.pairs, b.count, b.touching, b.contacts, b.contact_count, b.radius, b.polarizability, b.weight,
            b.ease, b.contact, b.last_contact,
        ],
        [b.drive, b.field, b.outer],
        b,
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
    _launch_passes(
        _force_kernel(moments.dtype),
        2,
        moments,
        [
            b.near, b.pairs, b.count, b.touching, b.contacts, b.contact_count, b.slopes, b.mirror, b.radius, b.weight,
            b.contact, b.drive,
        ],
        [b.halves, b.force],
        b,
    )  # fmt: skip
    wp.launch(
        _wrench_kernel(moments.dtype),
        dim=rows.count,
        inputs=[rows.target, moments.packed, b.force, b.field, twisted],
        outputs=[forces, torques],
        device=moments.device,
    )
