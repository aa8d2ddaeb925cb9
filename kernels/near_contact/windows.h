// Functions that fade what near balls add: by their gap, their overlap, or what volume they share.
#pragma once
#include "shared/lanes.h"

namespace warpmag {

struct Fade {
    Number value, slope;
};
CUDA_CALLABLE inline Fade smoothstep(Number x) {
    const Number zero = x * Real(0), t = smaller(larger(x, zero), zero + 1);
    return {t * t * (3 - 2 * t), 6 * t * (1 - t)};
}
// Fades from a gap ``near`` to ``far`` and from an overlap ``shallow`` to ``deep``.
CUDA_CALLABLE inline Fade window(Number gap, Real near, Real far, Real shallow, Real deep) {
    const Real width = 1 / (far - near), depth = 1 / (deep - shallow);
    const Fade outer = smoothstep((far - gap) * width), inner = smoothstep((deep + gap) * depth);
    return {outer.value * inner.value, outer.value * inner.slope * depth - outer.slope * inner.value * width};
}
}
