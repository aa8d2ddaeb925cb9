"""References that tests and benchmarks compare warpmag with: float64 or semi-analytic, independent, outside the wheel.

| module | reference |
|---|---|
| ``oracle`` | the physics of warpmag in NumPy: pair law, curves, forces, Newton solution of induction, eddy currents |
| ``coils`` | fields of coils by the law of Biot and Savart |
| ``near_contact`` | the near-contact model as dense matrices |
| ``ball_in_field`` | a ball in the field of permanent magnets: images, multipoles, energy of the near-contact model |
| ``spheres``, ``clusters`` | permeable balls by multipole expansions; solutions of clusters in ``clusters.json`` |
| ``magnet_pairs`` | forces between two boxes or cylinders, closed forms |
| ``surface_integrals`` | moments of inducible boxes, cylinders and bodies of boxes, by integral equations |
| ``plate`` | force of a magnet on a permeable plate, by an integral equation |
| ``fall`` | energy and momentum of a fall of soft balls |

Two programs belong to them: ``body_moments`` prints the moments of bodies with their errors, ``near_contact_table``
computes the table that ``warpmag.kernels.near_contact`` reads.

Independence: no reference imports Warp, except ``body_moments``, ``fall`` and ``plate``, which run warpmag
to compare it. ``near_contact``, ``near_contact_table`` and ``ball_in_field`` share with
``warpmag.kernels.near_contact.contact_table`` the constants that define the model; ``near_contact`` also reads the
table by that module's ``gap_table``, ``b_spline`` and ``hardness``. ``spheres`` checks the table itself.
"""
