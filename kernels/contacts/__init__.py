"""Contact solver for rigid bodies: broad phase, contact law, XPBD iterations over contacts and joints.

An alternative to Newton's ``SolverXPBD`` on Newton's bodies, contacts and joints, without any magnetism:

* Momentum and angular momentum are conserved, static friction does not creep, and there is no rest threshold.
* Results are bitwise repeatable: sums have a fixed order, for any order of threads.
* It converges in half the iterations, by accumulated impulses with Nesterov's momentum.

| module | contents |
|---|---|
| broad_phase | pairs of shapes whose boxes overlap, and contacts of balls (``ball_contacts.h``) |
| solve | iterations over contacts; the law of a contact is in ``contact_law.h`` |
| mass_splitting | shares of masses, with which bodies of many contacts converge |
| joints | corrections of Newton's iterations over joints, and implicit drives |
| free_motion | velocities from forces and impulses, poses from velocities |

``solve_arrays.h`` has the arrays of the iterations, which run in ``solve_cpu.h``, ``solve_cuda.h`` or
``solve_cluster.h``. Contacts are collisions of rigid bodies here; ``near_contact`` is about magnetic fields. May import
``shared``, ``pairs`` and ``rigid``.
"""
