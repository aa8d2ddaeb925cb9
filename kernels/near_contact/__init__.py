"""Near contacts: the magnetic interaction of two balls at small gaps, beyond their dipoles.

| module | contents |
|---|---|
| contact_table | constants, and the table of two balls |
| images | images of balls in flat faces of iron; ``images.h`` and ``image_forces.h`` have the passes |
| near_pairs | buffers and launches; ``select.h``, ``tabulate.h``, ``sweeps.h`` and ``forces.h`` have the passes |
| nonuniform | balls in the non-uniform field of permanent magnets; ``nonuniform.h`` has the passes |

May import ``shared``, ``material``, ``pairs``, ``applied`` and ``cells``.

Close to contact the flux between two permeable balls concentrates in the gap, and dipoles miss most of the force. As in
Bonnecaze and Brady's method for suspensions, the far field remains many-body. The missing part is added for each pair,
from the exact solution of two balls. Four properties make this work for piles:

* **Conductances add, resistances do not.** The potential difference of the surfaces drives the flux through a contact,
  whatever the ball's other contacts do. So the contribution of a pair is a conductance ΔC from potentials to sources. A
  ball has a potential, and besides its moment a source q: its net flux through contacts, which returns through the rest
  of its surface.
* **Two ranges.** 1/d is split into U_lr, the potential of balls inflated to ``RANGE``/2 radii, and the rest U_sr, which
  vanishes beyond ``RANGE`` radii. Sources q act by U_sr only, so everything new is local. Both parts are positive.
* **Quadrupoles do not add.** The quadrupoles that neighbors induce in a ball add up before they act. In the middle of a
  pile they cancel. So each ball has a quadrupole Θ (symmetric, traceless; its potential is n·Θn/d³), which acts up to
  ``QUADRUPOLE_REACH`` radii, and on sources by U_sr. The conductance of a pair is the remainder, and vanishes beyond
  ``CONTACT_GAP``.
* **An energy.** With a = (0, m, Θ) the actual sources of a ball, split into smooth and contact sources, a = ã + n,

      E_near(m) = min over ã, Θ of ½ ã M ã + ½ n ΔC⁻¹ n + ½ Θ δ Θ − ½ a M_sr a,

  where M is the matrix of U_sr and of the quadrupoles, δ the energy of a quadrupole at finite permeability, and M_sr
  the dipole part of M. The energy vanishes with ΔC and Θ. With e = M ã and n = ΔC e it gives the field (M_sr a − e)_m
  at the moments, and the forces ½ e ∂ΔC e − ½ ã ∂M ã + ½ a ∂M_sr a. Momentum is conserved, and two balls are exact.
  Uniqueness of the minimum is tested (``test_any_arrangement_has_one_solution``), not proven: in wide gaps ΔC alone has
  eigenvalues down to −0.03 R.

Balls that share much of their volume with others leave the model: their parts of ΔC and M_sr fade together.

ΔC of a pair has 14 functions of the gap and the two permeabilities, tabulated from the exact solution of two equal
balls by ``bench.reference.near_contact_table``. With n_i the direction from i towards j, α = R n·e_m, γ the part of
R² e_Θ that is symmetric about n, and ⊥ the component perpendicular to n,

    q_i    = R [A φ_i + B φ_j + C α_i + D α_j + I γ_i + J γ_j],
    n·m_i  = R² [C φ_i + D' φ_j + E α_i + F α_j + K γ_i + L γ_j],    m_i⊥ = R³ [G e_i⊥ + H e_j⊥],
    Θ_i    = R³ [I φ_i + J' φ_j + K α_i + L' α_j + O γ_i + P γ_j] (3nn − 1)/2,

where D', J', L' are the functions D, J, L of ball j.

Reference: Bonnecaze and Brady 1990, "A method for determining the effective conductivity of dispersions of particles",
Proc. R. Soc. Lond. A 430, 285-313.
"""
