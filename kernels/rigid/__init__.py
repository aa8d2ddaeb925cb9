"""Rigid bodies: magnetic moments on bodies, substeps and their monitor, and what XPBD needs for piles.

| module | what it does |
|---|---|
| newton_views | structs of the arrays of Newton's bodies and contacts that the kernels here read |
| bodies | poses and moments from bodies to magnets, forces back |
| broad_phase | pairs of shapes that may touch |
| monitor | motion, penetration, buffers and induction of each substep |
| stepping | the state machine of a step: substeps, attempts, log |
| keyed_poses | poses and velocities of kinematic bodies whose transforms are keyed |
| free_motion | what forces change in velocities, and velocities in poses |
| contact_solve | XPBD's iterations over contacts; law in `contact_law.h`, all in a launch in `solve_cluster.h` |
| joints | what XPBD's iterations over joints lack in Newton's kernels: moments, drives, slow motion |
| mass_splitting | a correction to XPBD: shares of bodies that many contacts push |

Contacts are collisions of rigid bodies here; near contacts of magnets are in ``near_contact``. May import ``shared``
and ``pairs``.
"""
