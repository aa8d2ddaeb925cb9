"""Fields that coils, field maps and nearby permanent bodies apply to moments, and the reactions on these sources.

May import ``shared``, ``material`` and ``pairs``. The field of such a source does not depend on other sources. It
follows from a closed form, or from a table, in the frame of the source.

Coils and maps act at any distance, in proportion to a strength. A permanent body acts by few moments of the system.
Targets nearer than its far reach get a correction: the field of more moments less that of the few. Within its reach the
closed form of its field takes their place. Two bodies near each other likewise get the force and torque between more
moments, or between their surface charges.

Fields are evaluated once per solve, and added to the external field. Permanent moments that no force moves are left
out. The reaction on a source is summed from the same fields, so that forces are opposite and equal. Without sources
none of these kernels is launched.

| module | content |
|---|---|
| sources | records of sources, and the arrays of sources and targets on a device |
| fields | launches: fields at targets and about balls, forces, reactions |
| circuits | coils with voltages: time steps of their currents |
| solids | tables of permanent bodies and of the polyhedra that bound them |
| near_cells | cells near permanent bodies: averages of the field, charges on their faces |
| coil_gradients | gradients of functions of what coils and maps do |
| solid_gradients | gradients of functions of what permanent bodies do near other magnets |
| expansion | points and tables for the expansion of a field about a ball |
| `passes.h` | passes over targets and sources |
| `target_field.h` | field and gradient at a vector of targets, and the force on moments there |
| `near_cells.h` | average fields over cells, charges on faces, their forces |
| `rates.h` | rate of change of a field at moving targets |
| `balls.h` | expansion of fields about balls |
| `sources.h` | kinds of coils and maps, and their frames |
| `point_field.h` | field and gradient at one point, in double precision; the inside of a wire |
| `circuits.h` | field of one ampere-turn at moments |
| `loop.h`, `solenoid.h` | circular loop; cylindrical sheet of current |
| `polyline.h` | chain of straight pieces of wire |
| `field_map.h` | field on a regular grid |
| `solids.h`, `body_pairs.h` | permanent bodies, their lattices; forces between two bodies |
| `polyhedron.h` | field, gradient and potentials of a uniformly magnetized polyhedron |
| `cylinder.h` | potential and field of a uniformly magnetized cylinder, from a table |

A new kind of coil or map needs a header with its field, an include and a case in ``sources.h``, and a name in
``sources.SourceKind``.
"""
