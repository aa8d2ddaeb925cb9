"""Near contacts: what two balls add to their dipoles when they almost touch.

May import ``shared``, ``material``, ``pairs`` and ``applied``. ``contact_table`` has the constants and the table of two
balls, ``near_pairs`` the buffers and launches, headers the passes over the near pairs.

Close to contact the flux between two permeable balls crowds into the gap, and dipoles miss most of the force. As
Bonnecaze and Brady did for suspensions, the far field stays many-body and what it lacks is added pair by pair, from the
exact solution of two balls. Four things make it work for piles:

* **Conductances add, resistances do not.** At a contact it is the surfaces' potentials that drive the flux, whatever
  the other contacts of the ball do. So the pair's part is a conductance ΔC from potentials to sources, and a ball has a
  potential: besides its moment a source q, its net flux through contacts, which the rest of its surface gives back.
* **Two ranges.** With 1/d split into U_lr, the potential of balls inflated to ``RANGE``/2 radii, and the rest U_sr,
  which vanishes beyond ``RANGE`` radii, sources q act by U_sr only: everything new is local. Both are positive.
* **Quadrupoles do not add.** Those that its neighbours induce in a ball add up before they act, and cancel in the
  middle of a pile. So each ball has its quadrupole Θ (symmetric, traceless; its potential is n·Θn/d³), which acts up to
  ``QUADRUPOLE_REACH`` radii, on sources by U_sr as everything does that sources do; what a pair adds is the rest, and
  vanishes beyond ``CONTACT_GAP``.
* **An energy.** With a = (0, m, Θ) the actual sources of a ball, split into smooth and contact ones, a = ã + n,

      E_near(m) = min over ã, Θ of ½ ã M ã + ½ n ΔC⁻¹ n + ½ Θ δ Θ − ½ a M_sr a,

  M the matrix of U_sr and of the quadrupoles, δ what a quadrupole of finite permeability costs, M_sr the dipoles of M.
  It vanishes with ΔC and Θ, and gives with e = M ã, n = ΔC e the field (M_sr a − e)_m at
  the moments and the forces ½ e ∂ΔC e − ½ ã ∂M ã + ½ a ∂M_sr a: momentum is conserved, and two balls come out exactly.
  That there is one minimum is measured (``test_any_arrangement_has_one_solution``), not proven: in wide gaps ΔC alone
  has eigenvalues down to −0.03 R.

Balls that share much of their volume with others leave the model: what they have in ΔC and M_sr fades together.

ΔC of a pair has 14 functions of the gap and the two permeabilities, tabulated from the exact solution of two equal
balls by ``bench.reference.near_contact_table``. With n_i the direction from i towards j, α = R n·e_m, γ the part of
R² e_Θ that is symmetric about n, and ⊥ across it,

    q_i    = R [A φ_i + B φ_j + C α_i + D α_j + I γ_i + J γ_j],
    n·m_i  = R² [C φ_i + D' φ_j + E α_i + F α_j + K γ_i + L γ_j],    m_i⊥ = R³ [G e_i⊥ + H e_j⊥],
    Θ_i    = R³ [I φ_i + J' φ_j + K α_i + L' α_j + O γ_i + P γ_j] (3nn − 1)/2,

where D', J', L' are those that ball j sees.

Reference: Bonnecaze and Brady 1990, "A method for determining the effective conductivity of dispersions of particles",
Proc. R. Soc. Lond. A 430, 285-313.
"""
