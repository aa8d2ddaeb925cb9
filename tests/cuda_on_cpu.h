// CUDA's words for code that Warp's fibers run on a CPU: one fiber a thread, one block after the other. A fiber runs
// until it waits for others. What a GPU leaves undefined ends the process with a word: shuffles from lanes that take no
// part, warps whose lanes come with different masks, threads that wait for each other for ever.
#define __CUDA_ARCH__ 800
#define __device__
#define __shared__ static
#define __noinline__ __attribute__((noinline))
#define alignas(size) __attribute__((aligned(size))) // which may come after __shared__
#define threadIdx (cuda_on_cpu::Place{(unsigned)wp_cpu_get_thread_idx()})
#define blockIdx (cuda_on_cpu::Place{cuda_on_cpu::block})
#define blockDim (cuda_on_cpu::Place{WP_TILE_BLOCK_DIM})

using wp::__int_as_float; // CUDA has it in the global namespace

namespace cuda_on_cpu {
constexpr int WARPS = (WP_TILE_BLOCK_DIM + 31) / 32, MOST_COPIES = 64;
struct Place {
    unsigned x;
};
// Where threads meet: how many have come, of which lanes of a warp, and how often all have.
struct Meeting {
    int come;
    unsigned mask, times;
};
struct Copy {
    void* to;
    const void* from;
};
static unsigned block, living[WARPS];
static int idle;
static Meeting of_block, of_warp[WARPS][32][33]; // by the first lane and the number of lanes
static long long values[WARPS][32];
static Copy copies[WP_TILE_BLOCK_DIM][MOST_COPIES];
static int copy_count[WP_TILE_BLOCK_DIM];

inline void check(bool holds, const char* what) {
    if (!holds) _wp_assert(what, "a CUDA kernel on a CPU", block);
}
inline int lane() { return wp_cpu_get_thread_idx() % 32; }
inline int warp() { return wp_cpu_get_thread_idx() / 32; }
// Lets all other threads go on to where they wait.
inline void pause() {
    check(++idle < 100000 * WP_TILE_BLOCK_DIM, "threads wait for each other for ever");
    wp_cpu_tile_sync();
}
// Waits until as many have come as ``expected()`` says.
template <class Expected> inline void meet(Meeting& m, unsigned mask, Expected expected) {
    const unsigned times = m.times;
    check(m.come == 0 || m.mask == mask, "lanes of a warp come with different masks");
    m.mask = mask, ++m.come;
    for (; m.times == times; pause())
        if (m.come >= expected()) {
            m.come = idle = 0, ++m.times;
            return;
        }
}
inline void meet_warp(unsigned mask) {
    const int w = warp();
    check(mask >> lane() & 1, "a lane comes with a mask that it is not in");
    meet(of_warp[w][__builtin_ctz(mask)][__builtin_popcount(mask)], mask,
         [=] { return __builtin_popcount(mask & living[w]); });
}
template <class T> inline T from_lane(unsigned mask, T mine, int from) {
    T its;
    __builtin_memcpy(&values[warp()][lane()], &mine, sizeof(T));
    meet_warp(mask);
    check((mask & living[warp()]) >> from & 1, "a shuffle reads a lane that takes no part");
    __builtin_memcpy(&its, &values[warp()][from], sizeof(T));
    meet_warp(mask);
    return its;
}
// A thread of a block of which ``left`` threads are wanted.
struct Lane {
    Lane(size_t block_id, int thread, size_t left) {
        if (thread == 0) {
            block = block_id, of_block.come = idle = 0;
            for (int w = 0; w < WARPS; ++w) {
                living[w] = left >= 32 * w + 32 ? ~0u : left > 32 * w ? (1u << (left - 32 * w)) - 1 : 0;
                for (auto& row : of_warp[w])
                    for (auto& m : row) m.come = 0;
            }
        }
        copy_count[thread] = 0;
    }
    ~Lane() { living[warp()] &= ~(1u << lane()), idle = 0; }
};
// Copies of 16 bytes that begin now and end when they are waited for.
inline void begin_copy(void* to, const void* from) {
    int& count = copy_count[wp_cpu_get_thread_idx()];
    check(count < MOST_COPIES, "more copies at a time than the stand-in holds");
    copies[wp_cpu_get_thread_idx()][count++] = {to, from};
}
inline void end_copies() {
    const int thread = wp_cpu_get_thread_idx();
    for (; copy_count[thread] > 0; --copy_count[thread]) {
        const Copy& copy = copies[thread][copy_count[thread] - 1];
        __builtin_memcpy(copy.to, copy.from, 16);
    }
}
inline float rsqrt_ftz(float x) { return x < 1.17549435e-38f ? INFINITY : 1 / sqrtf(x); }
}

inline void __syncthreads() {
    cuda_on_cpu::meet(cuda_on_cpu::of_block, ~0u, [] { return wp_cpu_get_active_count(); });
}
// Barriers of Warp's tiles are no more than that either: a fiber that waits elsewhere must not count as one that came.
template <> inline void wp::tile_sync<WP_TILE_BLOCK_DIM>() { __syncthreads(); }
inline void __syncwarp(unsigned mask = ~0u) { cuda_on_cpu::meet_warp(mask); }
inline void __threadfence() {}
inline void __nanosleep(unsigned) { cuda_on_cpu::pause(); }
template <class T> inline T __shfl_sync(unsigned mask, T mine, int from, int width = 32) {
    return cuda_on_cpu::from_lane(mask, mine, (cuda_on_cpu::lane() & -width) + (from & (width - 1)));
}
template <class T> inline T __shfl_xor_sync(unsigned mask, T mine, int step) {
    return cuda_on_cpu::from_lane(mask, mine, cuda_on_cpu::lane() ^ step);
}
template <class T> inline T __shfl_up_sync(unsigned mask, T mine, int step) {
    const int lane = cuda_on_cpu::lane();
    return cuda_on_cpu::from_lane(mask, mine, lane < step ? lane : lane - step);
}
inline unsigned __ballot_sync(unsigned mask, bool vote) {
    const int w = cuda_on_cpu::warp();
    cuda_on_cpu::values[w][cuda_on_cpu::lane()] = vote;
    __syncwarp(mask);
    unsigned votes = 0;
    for (int l = 0; l < 32; ++l)
        if ((mask & cuda_on_cpu::living[w]) >> l & 1 && cuda_on_cpu::values[w][l]) votes |= 1u << l;
    __syncwarp(mask);
    return votes;
}
inline bool __all_sync(unsigned mask, bool vote) { return __ballot_sync(mask, !vote) == 0; }
inline int __syncthreads_count(bool vote) {
    static int count;
    __syncthreads();
    count = 0;
    __syncthreads();
    count += vote;
    __syncthreads();
    return count;
}
template <class T> inline T atomicAdd(T* place, T more) {
    const T old = *place;
    *place += more;
    return old;
}
template <class T> inline T atomicMax(T* place, T other) {
    const T old = *place;
    if (other > old) *place = other;
    return old;
}
template <class T> inline T atomicExch(T* place, T other) {
    const T old = *place;
    *place = other;
    return old;
}
template <class T> inline T __ldcg(const T* place) { return *place; }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __clzll(long long bits) { return bits ? __builtin_clzll(bits) : 64; }
inline long long __double_as_longlong(double x) { return __builtin_bit_cast(long long, x); }
inline double rsqrt(double x) { return 1 / sqrt(x); }
inline float rsqrtf(float x) { return 1 / sqrtf(x); }
template <class A, class B> inline auto max(A a, B b) { return a > b ? a : b; }
template <class A, class B> inline auto min(A a, B b) { return a < b ? a : b; }
namespace std { // NVRTC knows it by itself, Clang by a header
template <class T> class initializer_list {
    const T* first;
    size_t count;

public:
    constexpr const T* begin() const { return first; }
    constexpr const T* end() const { return first + count; }
};
}
struct int2 {
    int x, y;
};
struct int4 {
    int x, y, z, w;
};
