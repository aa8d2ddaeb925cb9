// Field of a coil with one ampere-turn at the moments of its world, by which its flux linkage follows (circuits.py).
//
// ``Coils`` and ``Circuits`` are the structs of sources.py and circuits.py.
#pragma once
#include "applied/sources.h"

namespace warpmag {

// Writes the field of circuit ``thread / width`` at moment ``thread % width`` of its world.
template <class Coils, class Circuits, class Positions, class Fields>
CUDA_CALLABLE inline void unit_field(int thread, int width, const Coils& coils, const Circuits& circuits,
                                     const Positions& positions, const Fields& fields) {
    const int k = thread / width, j = thread % width, s = circuits.source.data[k];
    const auto& range = circuits.moments.data[circuits.world.data[k]];
    if (j >= range[1] - range[0]) return;
    const DoubleFrame frame = double_frame_of((const Real*)coils.frame.data + 7 * (size_t)s);
    const int begin = coils.table_begin.data[s], end = coils.table_end.data[s];
    const AppliedSource source = {coils.kind.data[s],
                                  {1, 0, 0},
                                  coils.parameters.data + (size_t)s * coils.parameters.shape[1],
                                  (const Point*)coils.table.data + begin,
                                  end - begin};
    const Point x = point_at((const Real*)positions.data, range[0] + j);
    const Point h = frame.to_world(field_of(source, frame.to_local(x - frame.origin)).h);
    Real* const out = (Real*)fields.data + 3 * (size_t)thread;
    out[0] = Real(h.x), out[1] = Real(h.y), out[2] = Real(h.z);
}
}
