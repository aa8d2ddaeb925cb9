// Spans of inducible moments of one world, and their elements in arrays.
//
// ``State`` is the struct of solve_state.py.
#pragma once
#include "shared/vectors.h"

namespace warpmag {

// ``count`` consecutive inducible moments of one world, from moment i on. Their neighbor lists and cache lines start at
// ``row``. The world's inducible moments are those from begin to end.
struct Span {
    int row, i, count, world, begin, end;
};

#if defined(__CUDA_ARCH__)
typedef double Wide;
CUDA_CALLABLE inline Wide wide(Number x) { return x; }

template <class State> CUDA_CALLABLE inline Span span_at(const State& state, int row) {
    const int4 moment = ((const int4*)state.row.data)[row];
    return {row, moment.x, 1, moment.y, moment.z, moment.w};
}
#else
typedef double Wide __attribute__((ext_vector_type(WIDTH)));
inline Wide wide(Number x) { return __builtin_convertvector(x, Wide); }

template <class State> inline Span span_at(const State& state, int row) {
    const auto& chunk = state.chunk.data[row / CHUNK]; // range of rows, world
    const auto& first = state.row.data[chunk[0]];
    const int offset = row % CHUNK, left = chunk[1] - chunk[0] - offset;
    return {row, first[0] + offset, left < 0 ? 0 : left > WIDTH ? WIDTH : left, chunk[2], first[2], first[3]};
}
#endif

// Elements of a span in row ``number`` of an array: their address, and vectors read and written there.
template <class Array> CUDA_CALLABLE inline Real* entries(const Array& array, const Span& at, int number = 0) {
    return (Real*)((char*)array.data + number * (size_t)array.strides[0]) + sizeof(*array.data) / sizeof(Real) * at.i;
}
template <class Array> CUDA_CALLABLE inline Vector get(const Array& array, const Span& at, int number = 0) {
    return vectors(entries(array, at, number), at.count);
}
template <class Array> CUDA_CALLABLE inline void set(const Array& array, const Span& at, Vector v, int number = 0) {
    put_vectors(entries(array, at, number), at.count, v);
}
CUDA_CALLABLE inline Vector vector_of(Four f) { return {f.x, f.y, f.z}; }
}
