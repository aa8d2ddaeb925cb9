"""Fields that coils, field maps and nearby permanent bodies apply to moments, and the reactions on these sources.

May import ``shared``, ``material`` and ``pairs``. The field of such a source does not depend on its surroundings: it
follows from a closed form, or from a table, in the frame of the source.

Fields of coils and maps act everywhere, in proportion to a strength. At a distance of a few lattice cells a lattice of
moments represents a permanent body. Within its reach targets get a correction: the closed form of the body's field less
the field of its lattice. Two bodies near each other get the force and torque between their surface charges, less those
between their moments.

Fields are evaluated once a solve at all moments, and added to the external field. The reaction on a source is summed
from the same fields, so that forces are opposite and equal. Without sources none of these kernels is launched.

| module | content |
|---|---|
| sources | records of sources, and the arrays of sources and targets on a device |
| fields | launches: fields at targets and about balls, forces, reactions |
| solids | tables of permanent bodies and of the polyhedra that bound them |
| expansion | points and tables for the expansion of a field about a ball |
| `passes.h` | passes over targets and sources |
| `target_field.h` | field and gradient at a vector of targets, and the force on moments there |
| `rates.h` | rate of change of a field at moving targets |
| `balls.h` | expansion of fields about balls |
| `sources.h` | kinds of coils and maps, and their frames |
| `point_field.h` | field and gradient at one point, in double precision; the inside of a wire |
| `loop.h`, `solenoid.h` | circular loop; cylindrical sheet of current |
| `polyline.h` | chain of straight pieces of wire |
| `field_map.h` | field on a regular grid |
| `solids.h`, `body_pairs.h` | permanent bodies, their lattices; forces between two bodies |
| `polyhedron.h` | field, gradient and potentials of a uniformly magnetized polyhedron |

A new kind of coil or map takes a header with its field, its include and case in ``sources.h``, and its name in
``sources.SourceKind``.
"""
