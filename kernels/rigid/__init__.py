"""Rigid bodies: magnetic moments on bodies, substeps and their monitor, and what XPBD needs for piles.

| module | what it does |
|---|---|
| newton_views | structs of the arrays of Newton's bodies and contacts that the kernels here read |
| bodies | poses and moments from bodies to magnets, forces back |
| broad_phase | pairs of shapes that may touch |
| monitor | motion, penetration, buffers and induction of each substep |
| stepping | the state machine of a step: substeps, attempts, log |
| mass_splitting, lever_arms, ordered_sums | corrections to XPBD: overshoot, angular momentum, order of sums |

Contacts are collisions of rigid bodies here; near contacts of magnets are in ``near_contact``. May import ``shared``
and ``pairs``.
"""
