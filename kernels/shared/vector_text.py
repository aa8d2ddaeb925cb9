"""Text of passes over balls, the same for a CPU and a GPU.

On a CPU a vector has a ball in each lane; on a GPU some threads share what is to be done for one. Arrays have
``LANES`` balls along their last axis, so that what a vector of balls needs follows in memory as it is read. What a ball
reads of others stands in one block of a cache line for each: on a CPU a vector of blocks is turned into vectors of
their numbers in registers, which is faster than to gather them one by one.

A pass is a function of the first ball i of a vector. In the text ``NUMBER`` and ``INDEX`` are a REAL and an int for
each ball, ``Four`` four numbers of a block; ``slot_at`` and ``list_at`` find what a ball keeps for one of its slots.
"""

from collections.abc import Iterable

from warpmag.kernels.shared.team import TOGETHER

LANES = 16
"""Multiple that the number of balls is padded to: lanes of the widest vectors."""
BLOCK = 16
"""Numbers in a block."""

COLLECT = """
    // the numbers of a row at places j
    auto collect = [](const REAL* row, auto j) -> NUMBER {
    #if defined(__AVX512F__)
        if constexpr (WIDTH == 16) return __builtin_ia32_gathersiv16sf(NUMBER(0), row, j, (unsigned short)-1, 4);
        else return __builtin_ia32_gathersiv8df(NUMBER(0), row, j, (unsigned char)-1, 8);
    #else
        NUMBER n;
        for (int l = 0; l < WIDTH; ++l) n[l] = row[j[l]];
        return n;
    #endif
    };
"""
"""Text that defines ``collect``, for functions that have vectors NUMBER of WIDTH reals."""

HEAR = """
    // three numbers, and a mark by which a reader knows that they are new: 16 bytes, written and read at once
    struct Told { REAL x, y, z; int mark; };
    auto hear = [](const REAL* place) -> Told {
        unsigned long long low, high;
        asm volatile("{ .reg .b128 r; ld.relaxed.gpu.global.b128 r, [%2]; mov.b128 {%0, %1}, r; }"
            : "=l"(low), "=l"(high) : "l"(__cvta_generic_to_global(place)) : "memory");
        return {__uint_as_float((unsigned)low), __uint_as_float((unsigned)(low >> 32)), __uint_as_float((unsigned)high),
                (int)(high >> 32)};
    };
"""
"""Text by which a GPU reads in float32 what another thread of the launch tells."""

# How balls tell each other what a pass has found, on a GPU: within a launch, or to the next one. Threads of a warp wait
# for what all of them want, since those that go on alone are not to be had together again.
_TELL_AT_ONCE = f"""
    {HEAR}
    auto tell = [](REAL* place, REAL x, REAL y, REAL z, int mark) {{
        const unsigned long long low = (unsigned long long)__float_as_uint(y) << 32 | __float_as_uint(x);
        const unsigned long long high = (unsigned long long)(unsigned)mark << 32 | __float_as_uint(z);
        asm volatile("{{ .reg .b128 r; mov.b128 r, {{%1, %2}}; st.relaxed.gpu.global.b128 [%0], r; }}"
            :: "l"(__cvta_generic_to_global(place)), "l"(low), "l"(high) : "memory");
    }};
    bool fresh;  // whether a pass wants what this launch tells
    auto come = [&](bool here) -> bool {{ return !fresh || __all_sync(~0u, here); }};
    constexpr bool AT_ONCE = true;
"""
_TELL_LATER = """
    struct Told { REAL x, y, z; int mark; };
    auto hear = [](const REAL* place) -> Told {
        const Four f = *(const Four*)place;
        return {f.x, f.y, f.z, 0};
    };
    auto tell = [](REAL* place, REAL x, REAL y, REAL z, int) { *(Four*)place = {x, y, z, 0}; };
    bool fresh;
    auto come = [](bool) -> bool { return true; };
    constexpr bool AT_ONCE = false;
"""

_PRELUDE = """
#if defined(__CUDA_ARCH__)
    typedef REAL NUMBER;
    typedef int INDEX;
    struct alignas(4 * sizeof(REAL)) Four { REAL x, y, z, w; };
    const int way = threadIdx.x % WAYS;
    const unsigned mates = ((1u << WAYS) - 1u) << (threadIdx.x % 32 / WAYS * WAYS);
    auto total_of = [](NUMBER part) -> NUMBER {
        for (int other = 1; other < WAYS; other *= 2) part += __shfl_xor_sync(~0u, part, other);
        return part;
    };
    // the largest number of a warp's balls
    auto most = [](const int* counts) -> int {
        int largest = *counts;
        for (int other = WAYS; other < 32; other *= 2) {
            const int its = __shfl_xor_sync(~0u, largest, other);
            largest = its > largest ? its : largest;
        }
        return largest;
    };
    auto any = [](bool mask) -> bool { return mask; };
    auto root = [](NUMBER x) -> NUMBER { return sqrt(x); };
    auto logarithm = [](NUMBER x) -> NUMBER { return log(x); };
    auto larger = [](NUMBER a, NUMBER b) -> NUMBER { return a > b ? a : b; };
    auto smaller = [](NUMBER a, NUMBER b) -> NUMBER { return a < b ? a : b; };
    auto number_of = [](INDEX n) -> NUMBER { return (NUMBER)n; };
    auto whole = [](NUMBER x) -> INDEX { return (int)x; };
    auto numbers = [](const REAL* row) -> NUMBER { return *row; };
    auto indices = [](const int* row) -> INDEX { return *row; };
    auto put = [](REAL* row, NUMBER n) { *row = n; };
    auto put_indices = [](int* row, INDEX n) { *row = n; };
    auto gather = [](const REAL* row, const int* j) -> NUMBER { return row[*j]; };
    auto four_at = [](const REAL* blocks, int quarter, const int* j) -> Four {
        return ((const Four*)blocks)[4 * (size_t)*j + quarter];
    };
    auto own_four = [](const REAL* blocks, int quarter, int i) -> Four {
        return ((const Four*)blocks)[4 * (size_t)i + quarter];
    };
    auto put_four = [](REAL* blocks, int quarter, int i, Four f) { ((Four*)blocks)[4 * (size_t)i + quarter] = f; };
TELL    // Of a ball's numbers thread c mod WAYS keeps number c, as its part c / WAYS.
    #define PART(count) (((count) + WAYS - 1) / WAYS)
    auto number = [](const REAL* part, int c) -> REAL { return __shfl_sync(~0u, part[c / WAYS], c % WAYS, WAYS); };
    // of 16 numbers those that are used: their sums over the threads of a ball, number c in sum[c / WAYS * WAYS] of its
    // thread, by exchanges each of which halves what a thread has
    auto add_up = [=](REAL* sum, unsigned used) {
        #pragma unroll
        for (int step = WAYS / 2; step > 0; step /= 2) {
            const bool upper = way & step;
            #pragma unroll
            for (int c = 0; c < 16; ++c) {
                if (c % WAYS >= step || !((used >> c | used >> (c + step)) & 1)) continue;
                const REAL sent = upper ? sum[c] : sum[c + step], kept = upper ? sum[c + step] : sum[c];
                sum[c] = kept + __shfl_xor_sync(~0u, sent, step);
            }
            used |= used >> step;
        }
    };
    auto recall = [=](REAL* part, const REAL* rows, int count) {
        for (int c = way; c < count; c += WAYS) part[c / WAYS] = rows[c * LANES];
    };
    auto remember = [=](const REAL* part, REAL* rows, int count) {
        for (int c = way; c < count; c += WAYS) rows[c * LANES] = part[c / WAYS];
    };
    // what a ball keeps for one of its slots: on a GPU all of it is read at once, on a CPU what is used when it is used
    struct SlotRows {
        REAL at[MOST_ROWS];
        REAL operator[](int row) const { return at[row]; }
    };
    auto slot_rows = [](const REAL* place, int count) -> SlotRows {
        SlotRows rows;
        for (int row = 0; row < count; ++row) rows.at[row] = place[row * LANES];
        return rows;
    };
    constexpr int WIDTH = 1;
    struct Places { int at[1]; };
    auto places = [](INDEX j) -> Places { return {{j}}; };
    auto lane_of = [](NUMBER x, int) -> REAL { return x; };
#else
    constexpr int WIDTH = 64 / (int)sizeof(REAL), way = 0;
    typedef REAL NUMBER __attribute__((ext_vector_type(WIDTH)));
    typedef int INDEX __attribute__((ext_vector_type(WIDTH)));
    typedef REAL QUARTER __attribute__((ext_vector_type(4)));
    struct Four { NUMBER x, y, z, w; };
    auto total_of = [](NUMBER part) -> NUMBER { return part; };
    auto most = [](const int* counts) -> int {
        int largest = 0;
        for (int l = 0; l < WIDTH; ++l) largest = counts[l] > largest ? counts[l] : largest;
        return largest;
    };
    auto any = [](auto mask) -> bool { return __builtin_reduce_or(mask) != 0; };
    auto root = [](NUMBER x) -> NUMBER { return __builtin_elementwise_sqrt(x); };
    auto logarithm = [](NUMBER x) -> NUMBER {
        if constexpr (sizeof(REAL) == 8) return __builtin_elementwise_log(x);  // one by one
        // x = 2ⁿ m, m between √½ and √2, of which the series in s = (m − 1)/(m + 1) is good to float32
        INDEX bits;
        __builtin_memcpy(&bits, &x, sizeof(bits));
        const INDEX n = (bits - 0x3f3504f3) >> 23;
        bits -= n << 23;
        NUMBER m;
        __builtin_memcpy(&m, &bits, sizeof(bits));
        const NUMBER s = (m - 1) / (m + 1), z = s * s;
        const NUMBER series = 1 + z * (REAL(1.0 / 3) + z * (REAL(1.0 / 5) + z * (REAL(1.0 / 7) + z * REAL(1.0 / 9))));
        return __builtin_convertvector(n, NUMBER) * REAL(0.693147180559945) + 2 * s * series;
    };
    auto larger = [](NUMBER a, NUMBER b) -> NUMBER { return __builtin_elementwise_max(a, b); };
    auto smaller = [](NUMBER a, NUMBER b) -> NUMBER { return __builtin_elementwise_min(a, b); };
    auto number_of = [](INDEX n) -> NUMBER { return __builtin_convertvector(n, NUMBER); };
    auto whole = [](NUMBER x) -> INDEX { return __builtin_convertvector(x, INDEX); };
    #define PART(count) (count)
    auto number = [](const NUMBER* part, int c) -> NUMBER { return part[c]; };
    auto add_up = [](NUMBER*, unsigned) {};
    auto numbers = [](const REAL* row) -> NUMBER { NUMBER n; __builtin_memcpy(&n, row, sizeof(n)); return n; };
    auto indices = [](const int* row) -> INDEX { INDEX n; __builtin_memcpy(&n, row, sizeof(n)); return n; };
    auto put = [](REAL* row, NUMBER n) { __builtin_memcpy(row, &n, sizeof(n)); };
    auto put_indices = [](int* row, INDEX n) { __builtin_memcpy(row, &n, sizeof(n)); };
    auto gather = [](const REAL* row, const int* j) -> NUMBER {
        NUMBER n = 0;
        for (int l = 0; l < WIDTH; ++l) n[l] = row[j[l]];
        return n;
    };
COLLECT
    // rows and columns of each group of four lanes change places
    auto turned = [](NUMBER a, NUMBER b, NUMBER c, NUMBER d) -> Four {
        const NUMBER ab = __builtin_shufflevector(a, b, LOW), cd = __builtin_shufflevector(c, d, LOW);
        const NUMBER top_ab = __builtin_shufflevector(a, b, HIGH), top_cd = __builtin_shufflevector(c, d, HIGH);
        return {__builtin_shufflevector(ab, cd, EVEN), __builtin_shufflevector(ab, cd, ODD),
                __builtin_shufflevector(top_ab, top_cd, EVEN), __builtin_shufflevector(top_ab, top_cd, ODD)};
    };
    auto fours = [turned](auto place) -> Four {
        auto part = [=](int l) -> QUARTER { QUARTER q; __builtin_memcpy(&q, place(l), sizeof(q)); return q; };
        auto row = [=](int l) -> NUMBER { return JOINED; };
        return turned(row(0), row(1), row(2), row(3));
    };
    auto four_at = [fours](const REAL* blocks, int quarter, const int* j) -> Four {
        return fours([=](int l) { return blocks + BLOCK * (size_t)j[l] + 4 * quarter; });
    };
    auto own_four = [fours](const REAL* blocks, int quarter, int i) -> Four {
        return fours([=](int l) { return blocks + BLOCK * (size_t)(i + l) + 4 * quarter; });
    };
    auto put_four = [turned](REAL* blocks, int quarter, int i, Four f) {
        const Four rows = turned(f.x, f.y, f.z, f.w);
        const NUMBER row[4] = {rows.x, rows.y, rows.z, rows.w};
        for (int r = 0; r < 4; ++r) {
            REAL* place = blocks + BLOCK * (size_t)(i + r) + 4 * quarter;
            PARTS
        }
    };
    struct SlotRows {
        const REAL* place;
        NUMBER operator[](int row) const {
            NUMBER n;
            __builtin_memcpy(&n, place + row * LANES, sizeof(n));
            return n;
        }
    };
    auto slot_rows = [](const REAL* place, int) -> SlotRows { return {place}; };
    struct Places { int at[WIDTH]; };
    auto places = [](INDEX j) -> Places { Places p; __builtin_memcpy(p.at, &j, sizeof(j)); return p; };
    auto lane_of = [](NUMBER x, int l) -> REAL { return x[l]; };
#endif
    // where the rows of an array stand for ball i, or for one of its slots, each LANES numbers from the last
    auto rows_at = [](REAL* array, int rows, int i) -> REAL* {
        return array + (unsigned)i / LANES * (rows * LANES) + (unsigned)i % LANES;
    };
    auto slot_at = [=](REAL* array, int slots, int rows, int s, int i) -> REAL* {
        return rows_at(array, slots * rows, i) + s * rows * LANES;
    };
    auto list_at = [](int* lists, int slots, int s, int i) -> int* {
        return lists + ((unsigned)i / LANES * slots + s) * LANES + (unsigned)i % LANES;
    };
    struct Vector { NUMBER x, y, z; };
    struct Tensor { NUMBER xx, yy, xy, yz, zx; };  // symmetric, traceless
    auto put_vector = [=](REAL* rows, Vector v) {
        put(rows, v.x);
        put(rows + LANES, v.y);
        put(rows + 2 * LANES, v.z);
    };
    auto dot = [](Vector a, Vector b) -> NUMBER { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto times = [](Tensor t, Vector a) -> Vector {
        return {t.xx * a.x + t.xy * a.y + t.zx * a.z, t.xy * a.x + t.yy * a.y + t.yz * a.z,
                t.zx * a.x + t.yz * a.y - (t.xx + t.yy) * a.z};
    };
    auto own_vector = [=](const REAL* rows) -> Vector {
        return {numbers(rows), numbers(rows + LANES), numbers(rows + 2 * LANES)};
    };
"""

# A launch makes passes ``first`` to ``last``: on a GPU one, or several that hear from each other. On a CPU threads take
# chunks of balls as they come, and go on to the next pass when one is done.
_RUN = f"""
#if defined(__CUDA_ARCH__)
    {{
        const int i = thread / WAYS;
        RECALL
        #pragma unroll 1
        for (int pass = first; pass < last; ++pass) {{
            fresh = AT_ONCE && pass > first;
            make_pass(pass, i);
        }}
        REMEMBER
    }}
#else
    constexpr int CHUNK = 4 * WIDTH, MOST_PASSES = 16;
    const int chunks = (stride + CHUNK - 1) / CHUNK;
    auto make_chunk = [&](int pass, int chunk) {{
        const int end = chunk * CHUNK + CHUNK < stride ? chunk * CHUNK + CHUNK : stride;
        for (int i = chunk * CHUNK; i < end; i += WIDTH) make_pass(pass, i);
    }};
    {TOGETHER}
    // the caller takes chunks from the first on, other threads from the last: each has its own in its cache next time
    int taken[MOST_PASSES] = {{}}, ahead[MOST_PASSES] = {{}}, behind[MOST_PASSES] = {{}}, done[MOST_PASSES] = {{}};
    auto work = [&](int member) {{
        for (int pass = first; pass < last; ++pass) {{
            while (__atomic_fetch_add(&taken[pass], 1, __ATOMIC_RELAXED) < chunks) {{
                const int n = __atomic_fetch_add(member == 0 ? &ahead[pass] : &behind[pass], 1, __ATOMIC_RELAXED);
                make_chunk(pass, member == 0 ? n : chunks - 1 - n);
                __atomic_fetch_add(&done[pass], 1, __ATOMIC_RELEASE);
            }}
            while (__atomic_load_n(&done[pass], __ATOMIC_ACQUIRE) < chunks) yield_thread();
        }}
    }};
    together(team.data, threads, work);
#endif
"""


# Which lanes of two vectors clang's shuffles take for each group of four, those of the second counted from four on.
_SHUFFLES = {"LOW": (0, 4, 1, 5), "HIGH": (2, 6, 3, 7), "EVEN": (0, 1, 4, 5), "ODD": (2, 3, 6, 7)}


def _vector_text(width: int) -> dict[str, str]:
    """What stands for some names in the text for vectors of ``width`` numbers."""

    def listed(lanes):
        return ", ".join(map(str, lanes))

    names = {
        name: listed(group + lane % 4 + width * (lane > 3) for group in range(0, width, 4) for lane in lanes)
        for name, lanes in _SHUFFLES.items()
    }
    joined = [f"part(l + {group})" for group in range(0, width, 4)]
    while len(joined) > 1:
        lanes = listed(range(2 * width // len(joined)))
        joined = [f"__builtin_shufflevector({joined[k]}, {joined[k + 1]}, {lanes})" for k in range(0, len(joined), 2)]
    names["JOINED"] = joined[0]
    names["PARTS"] = "\n            ".join(
        f"{{ const QUARTER q = __builtin_shufflevector(row[r], row[r], {listed(range(group, group + 4))}); "
        f"__builtin_memcpy(place + {group} * BLOCK, &q, sizeof(q)); }}"
        for group in range(0, width, 4)
    )
    return names


def passes_text(
    real: str,
    ways: int,
    constants: dict,
    numbers: dict,
    integer_arrays: Iterable,
    real_arrays: Iterable,
    body: str,
    passes: str,
    balls: str = "arrays.radius.shape[0]",
    pointer: str = "arrays.{}.data",
    at_once: bool = False,
    recall: str = "",
    remember: str = "",
) -> str:
    """Text of a native function (thread, first, last, threads, team, arrays) that makes passes ``first`` to ``last``.

    Args:
        real: ``float`` or ``double``.
        ways: Threads of a GPU that share a ball, a power of two.
        constants: Integers by their names in the text.
        numbers: Reals by theirs.
        integer_arrays: Arrays of the struct ``arrays`` that the text names.
        real_arrays: Those of reals or vectors.
        body: Definitions of the passes.
        passes: Statement that makes pass ``pass`` for ball ``i``.
        balls: How many balls there are, a multiple of ``LANES``.
        pointer: What an array of a name is.
        at_once: Whether passes of one launch of a GPU hear from each other, in float32.
        recall: Statements that go before passes ``first`` to ``last`` for ball ``i`` on a GPU.
        remember: Those that follow them.
    """
    integers = "\n".join(f"constexpr int {name} = {value};" for name, value in constants.items())
    reals = "\n".join(f"constexpr REAL {name} = {value!r};" for name, value in numbers.items())
    pointers = "\n".join(
        [f"int* const {name} = (int*){pointer.format(name)};" for name in integer_arrays]
        + [f"REAL* const {name} = (REAL*){pointer.format(name)};" for name in real_arrays]
    )
    prelude = _PRELUDE.replace("COLLECT", COLLECT).replace("TELL", _TELL_AT_ONCE if at_once else _TELL_LATER)
    for name, text in _vector_text(16 if real == "float" else 8).items():
        prelude = prelude.replace(name, text)
    return f"""
    {{
    #if !defined(__CUDA_ARCH__)
    #pragma clang fp contract(fast)
    #endif
    typedef {real} REAL;
    #if defined(__CUDA_ARCH__)
    constexpr int WAYS = {ways};
    #else
    constexpr int WAYS = 1;
    #endif
    constexpr int LANES = {LANES}, BLOCK = {BLOCK};
    {integers}
    {reals}
    const int stride = {balls};
    {pointers}
    {prelude}{body}
    auto make_pass = [&](int pass, int i) {{ {passes} }};
    {_RUN.replace("RECALL", recall).replace("REMEMBER", remember)}
    }}"""
