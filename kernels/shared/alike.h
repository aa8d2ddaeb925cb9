// What several threads write at once, and all of them the same.
#pragma once

namespace warpmag {

template <class Value> CUDA_CALLABLE inline void set_alike(Value& place, Value value) {
#if defined(__CUDA_ARCH__)
    place = value;
#else
    __atomic_store(&place, &value, __ATOMIC_RELAXED);
#endif
}
}
