"""Balls in a non-uniform field: force of permanent magnets on the higher multipoles of a ball near them.

As a dipole a ball feels μ0 (m·∇)H at its center. Where the field varies over the ball, its multipole of degree l
induces a multipole of the same degree. Beside a permanent ball of its own size, multipoles exert 60 % of the force.
Permanent moments do not respond, so the solution of one ball is exact for all of them. With ρ the positions relative to
its center, in radii R, and m divided by R³,

    b_l = Σ_j w_j (m_j·∇) ρ^<l>/ρ^(2l+1),    B_l = p_l (2l−1)!!/l! b_l,    p_l = lχ/(lχ + 2l + 1),
    E = −½ (μ0/4π) R³ Σ_l B_l:b_l,    Ψ(ρ) = Σ_l B_l:ρ^l/ρ^(2l+1),

where <l> means the symmetric traceless part. The force on moment j is (μ0/4π) R² ∇(w m·∇Ψ), and its torque (μ0/4π) R³ m
× w ∇Ψ. The force on the ball is the opposite of the sum of forces. All are derivatives of E, so momentum and angular
momentum are conserved.

* **Degrees.** Degrees 2 to 4 are summed over all moments before they act, because the fields of a magnet's parts
  cancel. For a permanent ball that is alone on its body, all higher degrees follow in closed form from its own moment:
  with x = 1/ρ² and a the component of m along ρ,

      E = −½ (μ0/4π) R³ p_6 w² Σ_(l>4) x^(l+2) ((l + 1)² a² + ½ l (l + 1) (m² − a²)).

  Both series converge up to contact, for any ratio of sizes. The second is the series of images in an iron ball.
* **Range.** w fades over ``MAGNET_REACH``, where the omitted force is 3 % of a dipole's and less of a larger body's. It
  also fades as the two overlap. Cells of a lattice fade where balls are no larger than the cells: at smaller distances
  than a cell, they do not represent their body.
* **Saturation.** χ is the differential susceptibility at the ball's magnetization: a saturated ball is a dipole.

Coils, field maps and permanent bodies with a closed form contribute to b_l by the derivatives of their fields
(``applied.expansion``). They fade over ``MAGNET_REACH`` from their bounding box. Magnets with a recoil permeability act
by their present moments. Inducible moments neither drive these multipoles nor feel them: ``near_pairs`` has the forces
between balls. So the induction does not change, and one evaluation per force suffices. Reference: Jackson, Classical
Electrodynamics, 3rd ed., ch. 4.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.applied.expansion import EXPANSION_ROWS, TENSOR_ROWS
from warpmag.kernels.near_contact import contact_table
from warpmag.kernels.shared.native import CHUNK

RESPONSE_ROWS = 24  # rows of a ball's response, 22 of them in use
BOUND_ROWS = 8  # numbers of a chunk's bounds, 5 of them in use


@cache
def magnet_arrays(dtype) -> Any:
    """Return the struct of the arrays for permanent moments that act on balls."""

    @wp.struct
    class MagnetArrays:
        partner_begin: wp.array[wp.int32]  # first partner: a magnet for a ball, a ball for a movable magnet
        partner_end: wp.array[wp.int32]  # index after the last partner [balls]
        movable: wp.array[wp.int32]  # 1 for permanent moments whose force is evaluated [balls]
        single: wp.array[dtype]  # 1 for the only moment of a body, 0 for a cell or a ball, −1 for others [balls]
        bounds: wp.array2d[dtype]  # center and radius of a chunk's enclosing ball, largest radius [chunks, 8]
        response: wp.array3d[dtype]  # B_2 to B_4 and p_6 of each ball [chunks, 24, CHUNK]
        expansion: wp.array3d[dtype]  # derivatives of the sources' fields (``applied.expansion``), or none

    return MagnetArrays


def constants() -> dict[str, int | float]:
    """Return the constants of ``nonuniform.h``."""
    fades = {name: getattr(contact_table, name) for name in ("MAGNET_REACH", "MAGNET_OVERLAP", "CELL_SIZE")}
    ends = {f"{name}_{end}": x for name, fade in fades.items() for end, x in zip(("LOW", "HIGH"), fade, strict=True)}
    sizes = {name: getattr(contact_table, name) for name in ("CELL_DEPTH", "LEAST_MAGNET")}
    rows = {"TENSOR_ROWS": TENSOR_ROWS, "EXPANSION_ROWS": EXPANSION_ROWS}
    return rows | {"RESPONSE_ROWS": RESPONSE_ROWS, "BOUND_ROWS": BOUND_ROWS} | sizes | ends


def expansion_constants() -> tuple[float, float, int]:
    """Return the range over which the effect of sources fades, and the rows of a response, for ``applied/balls.h``."""
    return (*map(float, contact_table.MAGNET_REACH), RESPONSE_ROWS)


def allocate(
    balls: int, ranges, eligible, magnets, single, movable, *, dtype, device, expansion=None
) -> tuple[int, Any]:
    """Return the number of pairs of a ball and a permanent moment, and the arrays.

    ``balls`` is the number of moments, padded to ``CHUNK``; the other arguments are those of ``near_pairs.allocate``.
    """
    n = len(eligible)
    begin, end, magnet_movable = (np.zeros(balls, np.int32) for _ in range(3))
    is_single = np.full(balls, -1.0)
    is_single[:n][eligible] = 0.0
    for first, _, last in ranges:
        own, others = (first + np.flatnonzero(chosen[first:last]) for chosen in (eligible, magnets))
        if own.size == 0 or others.size == 0:
            continue
        is_single[others], magnet_movable[others] = single[others], movable[others]
        begin[own], end[own] = others[0], others[-1] + 1
        moved = others[magnet_movable[others] > 0]
        begin[moved], end[moved] = own[0], own[-1] + 1
    a = magnet_arrays(dtype)()
    a.partner_begin, a.partner_end, a.movable = (
        wp.array(values, dtype=wp.int32, device=device) for values in (begin, end, magnet_movable)
    )
    a.single = wp.array(is_single, dtype=dtype, device=device)
    a.bounds = wp.zeros((balls // CHUNK, BOUND_ROWS), dtype=dtype, device=device)
    a.response = wp.zeros((balls // CHUNK, RESPONSE_ROWS, CHUNK), dtype=dtype, device=device)
    a.expansion = expansion
    return int(np.sum((end - begin)[:n], where=eligible)), a
