"""Fields that sources without a response apply to moments: coils, field maps.

May import ``shared``, ``material`` and ``pairs``. Such a source makes a field by a closed form, or from a table, in its
own frame, in proportion to a strength of its own, whatever is around it. That field is evaluated once a solve at all
moments and added to the external one. What the moments feel pushes the body of the source back: the reaction is summed
from the same fields, so that forces are opposite and equal.

| module | what it does |
|---|---|
| sources | the sources on a device, their field at targets, forces and reactions |
| `sources.h` | the table of kinds, frames, sums over the sources of a world |
| `field_at.h` | a field with its gradient, in double precision; what a wire is made of |
| `loop.h`, `solenoid.h` | a circular loop, a sheet of current around a cylinder |
| `polyline.h` | a chain of straight pieces of wire |
| `field_map.h` | a field on a regular grid |

A kind is a header with one function of a source and a place in its frame, a line in ``sources.h``, and its name in
``sources.SourceKind``.
"""
