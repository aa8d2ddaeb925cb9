"""A ball in an uneven field: what its higher multipoles add to the force of permanent magnets near it.

As a dipole a ball feels μ0 (m·∇)H at its centre. Where the field varies over the ball, each multipole of degree l of
what is applied to it induces one of the same degree: beside a permanent ball of its own size that is 60 % of the force.
Permanent moments do not respond, so that the solution of one ball is exact for all of them: with ρ their places seen
from its centre, in its radii R, and m over R³,

    b_l = Σ_j w_j (m_j·∇) ρ^<l>/ρ^(2l+1),    B_l = p_l (2l−1)!!/l! b_l,    p_l = lχ/(lχ + 2l + 1),
    E = −½ (μ0/4π) R³ Σ_l B_l:b_l,    Ψ(ρ) = Σ_l B_l:ρ^l/ρ^(2l+1),

<l> being symmetric and traceless. The force on moment j is (μ0/4π) R² ∇(w m·∇Ψ), its torque (μ0/4π) R³ m × w ∇Ψ, the
force on the ball minus their sum: all are derivatives of E, and momentum and angular momentum are kept.

* **Degrees.** Those of 2 to 4 are added up over all moments before they act, as the fields of a magnet's parts cancel.
  Of a permanent ball, alone on its body, all higher ones follow in closed form from its own moment: with x = 1/ρ² and
  a the part of m along ρ

      E = −½ (μ0/4π) R³ p_6 w² Σ_(l>4) x^(l+2) ((l + 1)² a² + ½ l (l + 1) (m² − a²)).

  Both series converge up to contact, whatever the sizes; the second is that of the images in an iron ball.
* **Range.** w fades over ``MAGNET_REACH``, where what is left out is 3 % of the force of a dipole and less of a larger
  body's, and as the two overlap. Cells of a lattice fade where balls are no larger than they: nearer than a cell
  they do not stand for their body.
* **Saturation.** χ is the differential susceptibility at the ball's magnetization: a saturated ball is a dipole.

Coils, maps and permanent bodies of a closed form make b_l by their fields, which ``applied.expansion`` has, and there
E the same; they fade over ``MAGNET_REACH`` from the box around them. Magnets with a recoil permeability act by the
moments that they have. Inducible moments do not drive these multipoles,
nor feel them: what balls do to each other is ``near_pairs``. So the induction stays as it is, and all this is done once
a force. Reference: Jackson, Classical Electrodynamics, 3rd ed., ch. 4.

| array | shape | meaning |
|---|---|---|
| other_begin, other_end | [balls] | of a ball, where its world's magnets are; of these, if they may move, its balls |
| pushed | [balls] | whether the force on a permanent moment is wanted |
| alone | [balls] | 1 for a permanent moment that is alone on its body, 0 for a cell and a ball, −1 for others |
| bounds | [chunks, 8] | centre and radius of the ball around the places of a chunk's moments, largest of their radii |
| response | [chunks, 24, CHUNK] | B_2 to B_4 and p_6 of each ball |
"""

import numpy as np
import warp as wp

from warpmag.kernels.applied.expansion import EXPANSION_ROWS, TENSOR_ROWS
from warpmag.kernels.near_contact import contact_table
from warpmag.kernels.shared.native import CHUNK

RESPONSE_ROWS = 24
"""Numbers of a ball's response, of which 22 are used."""
BOUND_ROWS = 8
"""Numbers of a chunk's bounds, of which 5 are used."""


def constants() -> dict[str, int | float]:
    """What ``uneven.h`` takes."""
    fades = {name: getattr(contact_table, name) for name in ("MAGNET_REACH", "MAGNET_OVERLAP", "CELL_SIZE")}
    ends = {f"{name}_{end}": x for name, fade in fades.items() for end, x in zip(("LOW", "HIGH"), fade, strict=True)}
    sizes = {name: getattr(contact_table, name) for name in ("CELL_DEPTH", "LEAST_MAGNET")}
    rows = {"TENSOR_ROWS": TENSOR_ROWS, "EXPANSION_ROWS": EXPANSION_ROWS}
    return rows | {"RESPONSE_ROWS": RESPONSE_ROWS, "BOUND_ROWS": BOUND_ROWS} | sizes | ends


def expansion_constants() -> tuple[float, float, int]:
    """What ``applied/balls.h`` takes: the range over which sources of fields fade, and the rows of a response."""
    return (*map(float, contact_table.MAGNET_REACH), RESPONSE_ROWS)


def allocate(balls: int, ranges, eligible, magnets, lone, movable, dtype, device) -> tuple[int, dict[str, wp.array]]:
    """Number of pairs of a ball and a permanent moment that may act on it, and the arrays of the table.

    Args:
        balls: Moments, padded to ``CHUNK``.
        ranges: For each world its first moment, its first permanent one, and the end.
        eligible: Whether a moment is an inducible ball that takes part, shape [n].
        magnets: Whether it is that of a permanent magnet, fixed or with a recoil permeability, shape [n].
        lone: Whether a moment is its body's only one, shape [n].
        movable: Whether the force on a moment is wanted, shape [n].
        dtype: Warp scalar type.
        device: Warp device.
    """
    n = len(eligible)
    begin, end, pushed = (np.zeros(balls, np.int32) for _ in range(3))
    alone = np.full(balls, -1.0)
    alone[:n][eligible] = 0.0
    for first, _, last in ranges:
        own, others = (first + np.flatnonzero(chosen[first:last]) for chosen in (eligible, magnets))
        if own.size == 0 or others.size == 0:
            continue
        alone[others], pushed[others] = lone[others], movable[others]
        begin[own], end[own] = others[0], others[-1] + 1
        moved = others[pushed[others] > 0]
        begin[moved], end[moved] = own[0], own[-1] + 1
    arrays = {
        **{
            name: wp.array(values, dtype=wp.int32, device=device)
            for name, values in (("other_begin", begin), ("other_end", end), ("pushed", pushed))
        },
        "alone": wp.array(alone, dtype=dtype, device=device),
        "bounds": wp.zeros((balls // CHUNK, BOUND_ROWS), dtype=dtype, device=device),
        "response": wp.zeros((balls // CHUNK, RESPONSE_ROWS, CHUNK), dtype=dtype, device=device),
    }
    return int(np.sum((end - begin)[:n], where=eligible)), arrays
