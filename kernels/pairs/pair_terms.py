"""C text of one pair of moments, shared by the native pair loops on CPU and CUDA.

The text works on ``NUMBER``, a scalar or a vector of them. It expects r from the source to the target (``rx ry rz``),
powers of the inverse distance (``inv2 inv3``), the source's moment b (``bx by bz``) and scaled moment u (``ux uy uz``),
for a force also the target's effective moment e (``ex ey ez``), and adds to the sums of its quantity. A suffix tells
the targets of one thread apart.

Prefactors leave the loops for the sums' ends, where they cost nothing: with 1/d = i, a loop takes ``inv`` = W i for a W
of its choice (a Newton step for 1/√c is an operation shorter if it ends at 2/√c), and what is summed is then worth

| quantity | u | sums over the pairs | worth |
|---|---|---|---|
| field | W²b/3 | h = (Wi)³ [(Wi)² (r·b) r − u] | 4πH = 3 W⁻⁵ h |
| force | W²b/5 | f = (Wi)⁵ [(r·e) u + (u·e) r − (Wi)² (r·e)(r·b) r], | |
| | | a = (Wi)⁵ (r·b) | 4π(e·∇)H = 15 W⁻⁷ f + 3 W⁻⁵ a e |
| wrench | W²b/5 | f and a, and h = (Wi)⁵ (r·b) r, g = (Wi)³ b | also 4πH = 3 W⁻⁵ h − W⁻³ g |

The products are ordered so that no factor beyond r⁻³ leaves the float32 range before it meets r.
"""

from enum import IntEnum


class Quantity(IntEnum):
    """What is summed over pairs: H; (e·∇)H for an effective moment e of the target; both; (m·∇)H for its moment m.

    The values are those of ``pair_terms.h``.
    """

    FIELD = 0
    FORCE = 1
    WRENCH = 2
    MUTUAL_FORCE = 3


WIDTHS = {Quantity.FIELD: 3, Quantity.FORCE: 3, Quantity.WRENCH: 6, Quantity.MUTUAL_FORCE: 3}
"""Numbers that are stored for a target."""

TILE_COLUMNS = 8
"""Columns of a work list of tiles, ``TileEntry`` of ``pair_terms.h``: target rows begin and end, packed column of the
first of them, sources begin and end, partial sums that the tile is added to, whether it stands also for the tile with
sources and targets exchanged, and nothing, so that a GPU reads a row as two vectors."""

_FIELD_SUMS = ("hx", "hy", "hz")
_FORCE_SUMS = ("fx", "fy", "fz", "along")
SUMS = {
    Quantity.FIELD: _FIELD_SUMS,
    Quantity.FORCE: _FORCE_SUMS,
    Quantity.WRENCH: (*_FORCE_SUMS, *_FIELD_SUMS, "gx", "gy", "gz"),
}
"""Names of what a loop sums up."""

_SEPARATION = """
    const NUMBER rx = tx{k} - ax, ry = ty{k} - ay, rz = tz{k} - az;
    const NUMBER d2 = rx * rx + ry * ry + rz * rz;
"""
_POWERS = "const NUMBER inv2 = inv * inv, inv3 = inv2 * inv;"
_FIELD = """
    const NUMBER w = inv2 * (rx * bx + ry * by + rz * bz);
    hx{k} += inv3 * (w * rx - ux);
    hy{k} += inv3 * (w * ry - uy);
    hz{k} += inv3 * (w * rz - uz);
"""
_FORCE = """
    const NUMBER inv5 = inv3 * inv2;
    const NUMBER rb = rx * bx + ry * by + rz * bz;
    const NUMBER re = rx * ex{k} + ry * ey{k} + rz * ez{k};
    const NUMBER ue = ux * ex{k} + uy * ey{k} + uz * ez{k};
    const NUMBER p = inv2 * re, c = inv3 * p, q = inv5 * (ue - p * rb);
    fx{k} += c * ux;
    fy{k} += c * uy;
    fz{k} += c * uz;
    fx{k} += q * rx;
    fy{k} += q * ry;
    fz{k} += q * rz;
"""
_ALONG = "along{k} += inv5 * rb;"
_FIELD_BESIDE_FORCE = """
    const NUMBER a = inv5 * rb;
    along{k} += a;
    hx{k} += a * rx;
    hy{k} += a * ry;
    hz{k} += a * rz;
    gx{k} += inv3 * bx;
    gy{k} += inv3 * by;
    gz{k} += inv3 * bz;
"""
_ADDED = {Quantity.FIELD: _FIELD, Quantity.FORCE: _FORCE + _ALONG, Quantity.WRENCH: _FORCE + _FIELD_BESIDE_FORCE}


def pair(quantity: Quantity, inverse: str, k: str = "") -> str:
    """Text of one pair; ``inverse`` computes W/d from the squared distance ``d2``, clamped and masked."""
    return (_SEPARATION + f"const NUMBER inv = {inverse};" + _POWERS + _ADDED[quantity]).format(k=k)


_MIRRORED = {
    Quantity.FIELD: _FIELD
    + """
    const NUMBER back = inv2 * (rx * mx{k} + ry * my{k} + rz * mz{k});
    gx += inv3 * (back * rx - nx{k});
    gy += inv3 * (back * ry - ny{k});
    gz += inv3 * (back * rz - nz{k});
""",
    Quantity.MUTUAL_FORCE: """
    const NUMBER inv5 = inv3 * inv2;
    const NUMBER rb = rx * bx + ry * by + rz * bz;
    const NUMBER rm = rx * mx{k} + ry * my{k} + rz * mz{k};
    const NUMBER bm = bx * mx{k} + by * my{k} + bz * mz{k};
    const NUMBER c = inv5 * rb, e = inv5 * rm, q = inv5 * (bm - REAL({five!r}) * (inv2 * rb) * rm);
    const NUMBER fx = c * mx{k} + e * bx + q * rx;
    const NUMBER fy = c * my{k} + e * by + q * ry;
    const NUMBER fz = c * mz{k} + e * bz + q * rz;
    hx{k} += fx;
    hy{k} += fy;
    hz{k} += fz;
    gx -= fx;
    gy -= fy;
    gz -= fz;
""",
}


def mirrored_pair(quantity: Quantity, inverse: str, k: str = "", w: float = 1.0) -> str:
    """Text of one pair for both of its ends, the target's moment being m, for a field scaled n as well.

    What is done to the target is added to the sums h, what is done to the source to g; of a force, both are the force
    itself, 4π(m·∇)H = 3 W⁻⁵ h.
    """
    return (_SEPARATION + f"const NUMBER inv = {inverse};").format(k=k) + mirrored_sums(quantity, k, w)


def mirrored_sums(quantity: Quantity, k: str = "", w: float = 1.0) -> str:
    """Text of :func:`mirrored_pair` after its separation and inverse distance."""
    return (_POWERS + _MIRRORED[quantity]).format(k=k, five=5.0 / w**2)


def scaled_moment(quantity: Quantity, w: float) -> float:
    """Ratio u/b of the scaled moment."""
    return w**2 / (3.0 if quantity == Quantity.FIELD else 5.0)


def results(quantity: Quantity, w: float, k: str = "") -> list[str]:
    """Expressions of the numbers that a loop leaves, from its sums: the field, or the force and then the field.

    Those of ``MUTUAL_FORCE`` are from the sums of :func:`mirrored_sums`.
    """
    h, f, a, g = 3.0 * w**-5, 15.0 * w**-7, 3.0 * w**-5, w**-3
    if quantity in (Quantity.FIELD, Quantity.MUTUAL_FORCE):
        return [f"REAL({h!r}) * h{c}{k}" for c in "xyz"]
    force = [f"REAL({f!r}) * f{c}{k} + REAL({a!r}) * along{k} * e{c}{k}" for c in "xyz"]
    field = [f"REAL({h!r}) * h{c}{k} - REAL({g!r}) * g{c}{k}" for c in "xyz"]
    return force if quantity == Quantity.FORCE else force + field
