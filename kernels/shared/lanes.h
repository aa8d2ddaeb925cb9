// Number types for several balls at a time, so that one source serves both devices. On a CPU they are vectors of 64
// bytes, on a GPU one number per thread.
//
// ``Number``, ``Index`` and ``Mask`` hold a Real, an int and a truth value for each of ``WIDTH`` balls. ``Four`` holds
// four numbers of each ball's cache line. On a GPU ``GROUP`` threads share a ball; Python sets ``GROUP``, a power of
// two. Arrays have ``CHUNK`` balls along their last axis, so that a vector of balls is contiguous in memory. ``gather``
// reads its indices from memory, ``collect`` takes them in a vector. ``lower_number`` and ``upper_number`` are the two
// numbers in a word, each the upper half of a float.
#pragma once

namespace warpmag {

constexpr int CHUNK = 16; // balls side by side in an array; as in native.py
constexpr int LINE = 16;  // numbers in a ball's cache line; as in native.py

#if defined(__CUDA_ARCH__)
constexpr int WIDTH = 1;
typedef Real Number;
typedef int Index;
typedef bool Mask;
struct alignas(4 * sizeof(Real)) Four {
    Number x, y, z, w;
};

// Sets a flag that other threads may set at the same time.
CUDA_CALLABLE inline void raise_flag(int& flag) { flag = 1; }
CUDA_CALLABLE inline bool any(Mask mask) { return mask; }
CUDA_CALLABLE inline Number root(Number x) { return sqrt(x); }
CUDA_CALLABLE inline Number logarithm(Number x) { return log(x); }
CUDA_CALLABLE inline Number angle(Number y, Number x) { return atan2(y, x); }
CUDA_CALLABLE inline Number larger(Number a, Number b) { return a > b ? a : b; }
CUDA_CALLABLE inline Number smaller(Number a, Number b) { return a < b ? a : b; }
CUDA_CALLABLE inline Number number_of(Index n) { return (Number)n; }
CUDA_CALLABLE inline Index truncated(Number x) { return (int)x; }
CUDA_CALLABLE inline Mask mask_of(bool condition) { return condition; }
CUDA_CALLABLE inline Number lower_number(Index word) { return (Number)__int_as_float(word << 16); }
CUDA_CALLABLE inline Number upper_number(Index word) { return (Number)__int_as_float(word & ~0xffff); }
CUDA_CALLABLE inline Number numbers(const Real* row) { return *row; }
CUDA_CALLABLE inline Index indices(const int* row) { return *row; }
CUDA_CALLABLE inline void put(Real* row, Number n) { *row = n; }
CUDA_CALLABLE inline void put_where(Mask active, Real* row, Number n) {
    if (active) *row = n;
}
CUDA_CALLABLE inline void put_indices(int* row, Index n) { *row = n; }
CUDA_CALLABLE inline Number gather(const Real* row, const int* j) { return row[*j]; }
CUDA_CALLABLE inline Number collect(const Real* row, Index j) { return row[j]; }
template <class Lanes> CUDA_CALLABLE inline Lanes lane_of(Lanes x, int) { return x; }

CUDA_CALLABLE inline Four four_at(const Real* lines, int quarter, const int* j) {
    return ((const Four*)lines)[4 * (size_t)*j + quarter];
}
CUDA_CALLABLE inline Four own_four(const Real* lines, int quarter, int i) {
    return ((const Four*)lines)[4 * (size_t)i + quarter];
}
CUDA_CALLABLE inline Four collect_four(const Real* fours, Index j) { return ((const Four*)fours)[j]; }
CUDA_CALLABLE inline void put_four(Real* lines, int quarter, int i, Four f) {
    ((Four*)lines)[4 * (size_t)i + quarter] = f;
}
#else
constexpr int WIDTH = 64 / (int)sizeof(Real);
typedef Real Number __attribute__((ext_vector_type(WIDTH)));
typedef int Index __attribute__((ext_vector_type(WIDTH)));
typedef Real Quarter __attribute__((ext_vector_type(4)));
typedef decltype(Number() < Number()) Mask;
struct Four {
    Number x, y, z, w;
};

inline void raise_flag(int& flag) { __atomic_store_n(&flag, 1, __ATOMIC_RELAXED); }
inline bool any(Mask mask) { return __builtin_reduce_or(mask) != 0; }
inline Number root(Number x) { return __builtin_elementwise_sqrt(x); }
inline Number logarithm(Number x) {
    if constexpr (sizeof(Real) == 8) return __builtin_elementwise_log(x);
    // x = 2ⁿ m with m between √½ and √2: log x = n log 2 + 2 artanh s, s = (m − 1)/(m + 1). The series of artanh is
    // good to float32.
    Index bits;
    __builtin_memcpy(&bits, &x, sizeof(bits));
    const Index n = (bits - 0x3f3504f3) >> 23;
    bits -= n << 23;
    Number m;
    __builtin_memcpy(&m, &bits, sizeof(bits));
    const Number s = (m - 1) / (m + 1), z = s * s;
    const Number series = 1 + z * (Real(1.0 / 3) + z * (Real(1.0 / 5) + z * (Real(1.0 / 7) + z * Real(1.0 / 9))));
    return __builtin_convertvector(n, Number) * Real(0.693147180559945) + 2 * s * series;
}
// Angle between the x-axis and the point (x, y).
inline Number angle(Number y, Number x) {
    Number theta;
    if constexpr (sizeof(Real) == 8) {
        for (int l = 0; l < WIDTH; ++l) theta[l] = atan2(y[l], x[l]);
        return theta;
    }
    // t = smaller/larger coordinate; atan t = 2 atan s with s = t / (1 + √(1 + t²)), whose series is good to float32
    const Number a = __builtin_elementwise_abs(x), b = __builtin_elementwise_abs(y);
    const Number large = __builtin_elementwise_max(a, b), small = __builtin_elementwise_min(a, b);
    const Number t = small / (large > 0 ? large : Number(Real(1))), s = t / (1 + root(1 + t * t)), z = s * s;
    const Number tail = Real(0.1999821) - z * (Real(0.14239976) - z * (Real(0.10572771) - z * Real(0.0603314)));
    theta = 2 * s * (1 - z * (Real(0.33333307) - z * tail));
    theta = b > a ? Real(1.5707963267948966) - theta : theta;
    theta = x < 0 ? Real(3.141592653589793) - theta : theta;
    return y < 0 ? -theta : theta;
}
inline Number larger(Number a, Number b) { return __builtin_elementwise_max(a, b); }
inline Number smaller(Number a, Number b) { return __builtin_elementwise_min(a, b); }
inline Number number_of(Index n) { return __builtin_convertvector(n, Number); }
inline Index truncated(Number x) { return __builtin_convertvector(x, Index); }
template <class Condition> inline Mask mask_of(Condition condition) { return __builtin_convertvector(condition, Mask); }
inline Number number_of_bits(Index bits) {
    float values __attribute__((ext_vector_type(WIDTH)));
    __builtin_memcpy(&values, &bits, sizeof(values));
    return __builtin_convertvector(values, Number);
}
inline Number lower_number(Index word) { return number_of_bits(word << 16); }
inline Number upper_number(Index word) { return number_of_bits(word & ~0xffff); }
inline Number numbers(const Real* row) {
    Number n;
    __builtin_memcpy(&n, row, sizeof(n));
    return n;
}
inline Index indices(const int* row) {
    Index n;
    __builtin_memcpy(&n, row, sizeof(n));
    return n;
}
inline void put(Real* row, Number n) { __builtin_memcpy(row, &n, sizeof(n)); }
// Stores the numbers of active lanes. Other threads may write the other ones at the same time.
template <class Lanes> inline void put_where(Mask active, Real* row, Lanes n) {
#if defined(__AVX512DQ__)
    if constexpr (WIDTH == 16) __builtin_ia32_storeups512_mask(row, n, __builtin_ia32_cvtd2mask512(active));
    else __builtin_ia32_storeupd512_mask(row, n, __builtin_ia32_cvtq2mask512(active));
#else
    for (int l = 0; l < WIDTH; ++l)
        if (active[l]) row[l] = n[l];
#endif
}
inline void put_indices(int* row, Index n) { __builtin_memcpy(row, &n, sizeof(n)); }
inline Number gather(const Real* row, const int* j) {
    Number n = 0;
    for (int l = 0; l < WIDTH; ++l) n[l] = row[j[l]];
    return n;
}
inline Number collect(const Real* row, int j) { return row[j]; }
template <class Indices> inline Number collect(const Real* row, Indices j) {
#if defined(__AVX512F__)
    if constexpr (WIDTH == 16) return __builtin_ia32_gathersiv16sf(Number(0), row, j, (unsigned short)-1, 4);
    else return __builtin_ia32_gathersiv8df(Number(0), row, j, (unsigned char)-1, 8);
#else
    Number n;
    for (int l = 0; l < WIDTH; ++l) n[l] = row[j[l]];
    return n;
#endif
}
// The same functions for scalars.
inline bool any(bool mask) { return mask; }
inline bool mask_of(bool condition) { return condition; }
inline bool mask_of(int condition) { return condition; }
inline Real larger(Real a, Real b) { return a > b ? a : b; }
inline Real root(Real x) { return wp::sqrt(x); }

template <class Lanes> inline auto lane_of(Lanes x, int l) { return x[l]; }

template <class T, T... L> struct Sequence {};
typedef __make_integer_seq<Sequence, int, WIDTH> AllLanes;

// Picks lanes A, B, C, D in each group of four lanes of two vectors; the second vector's lanes count from four.
template <int A, int B, int C, int D, int... L> inline Number by_fours(Number a, Number b, Sequence<int, L...>) {
    constexpr int pattern[4] = {A, B, C, D};
    return __builtin_shufflevector(a, b, (L / 4 * 4 + pattern[L % 4] % 4 + WIDTH * (pattern[L % 4] > 3))...);
}

// Transposes each group of four lanes of four vectors.
inline Four transposed(Number a, Number b, Number c, Number d) {
    const AllLanes all;
    const Number ab = by_fours<0, 4, 1, 5>(a, b, all), cd = by_fours<0, 4, 1, 5>(c, d, all);
    const Number top_ab = by_fours<2, 6, 3, 7>(a, b, all), top_cd = by_fours<2, 6, 3, 7>(c, d, all);
    return {by_fours<0, 1, 4, 5>(ab, cd, all), by_fours<2, 3, 6, 7>(ab, cd, all),
            by_fours<0, 1, 4, 5>(top_ab, top_cd, all), by_fours<2, 3, 6, 7>(top_ab, top_cd, all)};
}

template <class Half, int... L> inline auto joined(Half a, Half b, Sequence<int, L...>) {
    return __builtin_shufflevector(a, b, L...);
}

// Loads four numbers of each ball from address(lane), and transposes them into four vectors.
template <class Address> inline Four load_fours(Address address) {
    typedef __make_integer_seq<Sequence, int, 8> Eight;
    auto part = [=](int l) -> Quarter {
        Quarter q;
        __builtin_memcpy(&q, address(l), sizeof(q));
        return q;
    };
    auto row = [=](int l) -> Number {
        const auto low = joined(part(l), part(l + 4), Eight());
        if constexpr (WIDTH == 8) return low;
        else return joined(low, joined(part(l + 8), part(l + 12), Eight()), AllLanes());
    };
    return transposed(row(0), row(1), row(2), row(3));
}
inline Four four_at(const Real* lines, int quarter, const int* j) {
    return load_fours([=](int l) { return lines + LINE * (size_t)j[l] + 4 * quarter; });
}
inline Four own_four(const Real* lines, int quarter, int i) {
    return load_fours([=](int l) { return lines + LINE * (size_t)(i + l) + 4 * quarter; });
}
inline Four collect_four(const Real* fours, Index j) {
    return load_fours([=](int l) { return fours + 4 * (size_t)j[l]; });
}
template <int FIRST> inline void put_quarters(Real* lines, Number row) {
    const Quarter q = __builtin_shufflevector(row, row, FIRST, FIRST + 1, FIRST + 2, FIRST + 3);
    __builtin_memcpy(lines + FIRST * LINE, &q, sizeof(q));
    if constexpr (FIRST + 4 < WIDTH) put_quarters<FIRST + 4>(lines, row);
}
inline void put_four(Real* lines, int quarter, int i, Four f) {
    const Four rows = transposed(f.x, f.y, f.z, f.w);
    const Number row[4] = {rows.x, rows.y, rows.z, rows.w};
    for (int r = 0; r < 4; ++r) put_quarters<0>(lines + LINE * (size_t)(i + r) + 4 * quarter, row[r]);
}
#endif

// Address of the first row of ball i in an array, or of slot s of the ball. Rows are CHUNK numbers apart.
CUDA_CALLABLE inline Real* rows_at(Real* array, int rows, int i) {
    return array + (unsigned)i / CHUNK * (rows * CHUNK) + (unsigned)i % CHUNK;
}
CUDA_CALLABLE inline Real* slot_at(Real* array, int slots, int rows, int s, int i) {
    return rows_at(array, slots * rows, i) + s * rows * CHUNK;
}
CUDA_CALLABLE inline int* list_at(int* lists, int slots, int s, int i) {
    return lists + ((unsigned)i / CHUNK * slots + s) * CHUNK + (unsigned)i % CHUNK;
}
}
