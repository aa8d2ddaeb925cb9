"""Fields that sources without a response apply to moments: coils, field maps, permanent bodies seen from near.

May import ``shared``, ``material`` and ``pairs``. A source makes a field by a closed form, or from a table, in its own
frame, whatever is around it. Coils and maps have it everywhere, in proportion to a strength of their own. A lattice of
moments stands for a permanent body at a distance of a few cells; what is nearer than its reach gets the difference
between the closed form of the body's field and that of its lattice, and two bodies near each other the difference
between force and torque of their surfaces' charges and those of their moments.

All of it is evaluated once a solve at all moments and added to the external field. What the moments feel pushes the
source back: the reaction is summed from the same fields, so that forces are opposite and equal. Scenes without sources
launch nothing of this.

| module | what it does |
|---|---|
| sources | what sources are, and where they and the targets stand on a device |
| fields | the launches: fields at targets and about balls, forces, reactions |
| solids | tables of the polyhedra that bound permanent bodies |
| expansion | points and tables by which a field is expanded about a ball |
| `passes.h` | the passes over targets and sources |
| `seen.h` | field and gradient as several targets see them, and what pushes moments there |
| `balls.h` | expansion of fields about balls |
| `sources.h` | the table of kinds and frames |
| `field_at.h` | a field with its gradient, in double precision; what a wire is made of |
| `loop.h`, `solenoid.h` | a circular loop, a sheet of current around a cylinder |
| `polyline.h` | a chain of straight pieces of wire |
| `field_map.h` | a field on a regular grid |
| `solids.h`, `between.h` | permanent bodies, their lattices, and the force between two |
| `polyhedron.h` | field, gradient and potentials of a uniformly magnetized polyhedron |

A kind is a header with one function of a source and a place in its frame, a line in ``sources.h``, and its name in
``sources.SourceKind``.
"""
