// Transposition of a square matrix in CPU vectors.
#pragma once
#include "shared/lanes.h"

namespace warpmag {

// Exchanges blocks of STEP, 2 STEP, ... lanes; from STEP = 1 on this transposes. ``lanes`` is the sequence 0, 1, ... of
// a vector's lanes.
template <int STEP, class Simd, int LANES, int... L>
inline void transpose(Simd (&rows)[LANES], Sequence<int, L...> lanes) {
    if constexpr (STEP < LANES) {
        for (int i = 0; i < LANES; ++i) {
            if (i & STEP) continue;
            const Simd a = rows[i], b = rows[i + STEP];
            rows[i] = __builtin_shufflevector(a, b, (L & STEP ? LANES + L - STEP : L)...);
            rows[i + STEP] = __builtin_shufflevector(a, b, (L & STEP ? LANES + L : L + STEP)...);
        }
        transpose<2 * STEP>(rows, lanes);
    }
}

}
