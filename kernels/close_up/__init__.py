"""Permanent bodies seen from near: closed forms in the place of lattices.

May import ``shared``, ``material`` and ``pairs``. A lattice of moments stands for a permanent body at a distance of a
few cells. What is nearer than its reach gets the difference between the closed form of the body's field and that of its
lattice. Two bodies near each other get the difference between force and torque of their surfaces' charges and those of
their moments. Forces are opposite and equal. Scenes without such bodies launch nothing of this.

| module | what it does |
|---|---|
| bodies | the bodies on a device and the launches |
| `polyhedron.h` | field, gradient and potentials of a uniformly magnetized polyhedron |
| `passes.h` | the passes: fields at targets, reactions on bodies, forces between bodies |
"""
