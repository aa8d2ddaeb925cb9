"""The neighbour search on a CPU: candidates a vector at a time, by several threads.

Moments are sorted by the cells that ``neighbors`` puts them into, so that cells above one another follow each other in
memory: cell (x, y, z) of a world goes into bucket h(x, y, world) + z, up to the size of the table. A target then meets
nine runs of candidates, a column of three cells each. Of what other cells left there, whatever is near enough belongs
to another column.
"""

from functools import cache

import warp as wp

from warpmag.kernels.shared.vector_text import COLLECT
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, TOGETHER, team, threads_for, wide_registers

_VECTORS = f"""
    constexpr int WIDTH = 64 / (int)sizeof(REAL);
    typedef REAL NUMBER __attribute__((ext_vector_type(WIDTH)));
    typedef int INDEX __attribute__((ext_vector_type(WIDTH)));
    typedef bool BITS __attribute__((ext_vector_type(WIDTH)));
    auto numbers = [](const REAL* row) -> NUMBER {{ NUMBER n; __builtin_memcpy(&n, row, sizeof(n)); return n; }};
    auto indices = [](const int* row) -> INDEX {{ INDEX n; __builtin_memcpy(&n, row, sizeof(n)); return n; }};
    INDEX lanes;
    for (int l = 0; l < WIDTH; ++l) lanes[l] = l;
    auto bits_of = [](auto mask) -> unsigned {{
        const BITS wanted = __builtin_convertvector(mask, BITS);
        unsigned bits = 0;
        __builtin_memcpy(&bits, &wanted, WIDTH / 8);
        return bits;
    }};
    // puts the lanes of a mask at ``list``, and whatever behind them, and returns how many they are; without branches,
    // since nobody can foretell them
    auto append = [=](int* list, auto j, auto mask) -> int {{
    #if defined(__AVX512F__)
        if constexpr (WIDTH == 16) {{
            const unsigned short bits = (unsigned short)bits_of(mask);
            const INDEX kept = __builtin_ia32_compresssi512_mask(j, j, bits);
            __builtin_memcpy(list, &kept, sizeof(kept));
            return __builtin_popcount(bits);
        }}
    #endif
        int count = 0;
        for (int l = 0; l < WIDTH; ++l) {{
            list[count] = j[l];
            count += mask[l] != 0;
        }}
        return count;
    }};
    {COLLECT}
    const size_t target_pitch = targets.strides[0] / sizeof(REAL), source_pitch = sources.strides[0] / sizeof(REAL);
    const REAL* const target = (const REAL*)targets.data;
    const REAL* const source = (const REAL*)sources.data;
    const int target_count = targets.shape[1], source_count = sources.shape[1];
"""

_SHARE = f"""
    constexpr int CHUNK = 64;
    int next = 0;
    auto work = [&](int) {{
        for (;;) {{
            const int first = CHUNK * __atomic_fetch_add(&next, 1, __ATOMIC_RELAXED);
            if (first >= target_count) return;
            for (int i = first; i < target_count && i < first + CHUNK; ++i) meet(i);
        }}
    }};
    {TOGETHER}
    together(team.data, threads, work);
"""

_SEARCH = f"""
    searching_out.data[0] = moved.data[0];
    if (moved.data[0] == 0) return;
    moved.data[0] = 0;
    {_VECTORS}
    const int buckets = begin.shape[0] - 1, pitch = entries.shape[1];
    int* const first = begin.data;  // entry of each bucket
    int *const index = entries.data, *const own_x = index + pitch, *const own_y = own_x + pitch;
    int *const own_group = own_y + pitch, *const bucket = own_group + pitch;
    REAL *const x = (REAL*)places.data, *const y = x + pitch, *const z = y + pitch, *const radius = z + pitch;
    const double per_width = 1 / width;
    struct Cell {{ int x, y, z; bool real; }};
    auto cell_of = [=](const REAL* row, size_t stride) -> Cell {{
        double place[3];
        int cell[3];
        for (int c = 0; c < 3; ++c) {{
            place[c] = row[c * stride] * per_width;
            if (!(place[c] < FARTHEST && -place[c] < FARTHEST)) return {{0, 0, 0, false}};
            cell[c] = (int)place[c];
            cell[c] -= cell[c] > place[c];
        }}
        return {{cell[0], cell[1], cell[2], true}};
    }};
    auto bucket_of = [=](int x, int y, int z, int group) -> int {{
        unsigned mixed = (unsigned)x * 73856093u ^ (unsigned)y * 19349663u ^ (unsigned)group * 49979687u;
        mixed = (mixed ^ mixed >> 15) * 0x2c1b3c6du;
        return (int)(((mixed ^ mixed >> 16) + (unsigned)z) & (unsigned)(buckets - 1));
    }};
    __builtin_memset(first, 0, (buckets + 1) * sizeof(int));
    for (int j = 0; j < source_count; ++j) {{
        const Cell cell = cell_of(source + j, source_pitch);
        const int group = source_group.data[j];
        bucket[j] = cell.real && group >= 0 ? bucket_of(cell.x, cell.y, cell.z, group) : -1;
        if (bucket[j] >= 0) ++first[bucket[j]];
    }}
    for (int b = 0, sum = 0; b <= buckets; ++b) {{
        const int count = first[b];
        first[b] = sum;
        sum += count;
    }}
    for (int j = 0; j < source_count; ++j) {{
        if (bucket[j] < 0) continue;
        const Cell cell = cell_of(source + j, source_pitch);
        const int e = first[bucket[j]]++;
        index[e] = j;
        own_x[e] = cell.x;
        own_y[e] = cell.y;
        own_group[e] = source_group.data[j];
        x[e] = source[j];
        y[e] = source[source_pitch + j];
        z[e] = source[2 * source_pitch + j];
        radius[e] = source[3 * source_pitch + j];
    }}
    for (int b = buckets; b > 0; --b) first[b] = first[b - 1];
    first[0] = 0;
    auto meet = [&](int i) {{
        int found[CAPACITY + WIDTH], count = 0;
        const REAL own[4] = {{target[i], target[target_pitch + i], target[2 * target_pitch + i],
                             target[3 * target_pitch + i]}};
        const Cell cell = cell_of(target + i, target_pitch);
        const int group = target_group.data[i], self = same_set ? i : -1;
        auto meet_run = [&](int column_x, int column_y, int begin, int end) {{
            for (int e = begin; e < end; e += WIDTH) {{
                const NUMBER rx = own[0] - numbers(x + e), ry = own[1] - numbers(y + e), rz = own[2] - numbers(z + e);
                const NUMBER s = ratio * (own[3] + numbers(radius + e)), d2 = rx * rx + ry * ry + rz * rz;
                const INDEX j = indices(index + e);
                const auto near = __builtin_convertvector(d2 < s * s, INDEX) & (lanes < end - e) & (j != self)
                    & (indices(own_x + e) == column_x) & (indices(own_y + e) == column_y)
                    & (indices(own_group + e) == group);
                count += append(found + (count < CAPACITY ? count : CAPACITY), j, near);
            }}
        }};
        for (int column = 0; column < 9 && cell.real && group >= 0; ++column) {{
            const int column_x = cell.x + column / 3 - 1, column_y = cell.y + column % 3 - 1;
            const int b = bucket_of(column_x, column_y, cell.z - 1, group);
            if (b + 3 <= buckets) meet_run(column_x, column_y, first[b], first[b + 3]);
            else for (int k = b; k < b + 3; ++k)
                meet_run(column_x, column_y, first[k & (buckets - 1)], first[(k & (buckets - 1)) + 1]);
        }}
        // in the order of their numbers: each comes behind as many as are smaller
        const int kept = count < CAPACITY ? count : CAPACITY, vectors = (kept + WIDTH - 1) / WIDTH;
        const INDEX last = __INT_MAX__;
        __builtin_memcpy(found + kept, &last, sizeof(last));
        for (int k = 0; k < kept; ++k) {{
            int place = 0;
            for (int v = 0; v < vectors; ++v)
                place += __builtin_popcount(bits_of(indices(found + WIDTH * v) < found[k]));
            neighbor_out.data[(size_t)CAPACITY * i + place] = found[k];
        }}
        neighbor_count_out.data[i] = count;
        for (int c = 0; c < 3; ++c) ((REAL*)found_at_out.data)[3 * i + c] = own[c];
    }};
    {_SHARE}
"""

_OVERLAPS = f"""
    {_VECTORS}
    auto meet = [&](int i) {{
        const int count = neighbor_count.data[i];
        const int* const list = neighbor.data + (size_t)CAPACITY * i;
        int found[CAPACITY + WIDTH], overlapping = 0;
        for (int first = 0; first < count && count <= CAPACITY; first += WIDTH) {{
            const auto listed = lanes < count - first;
            const INDEX j = listed ? indices(list + first) : INDEX(0);
            const NUMBER rx = target[i] - collect(source, j);
            const NUMBER ry = target[target_pitch + i] - collect(source + source_pitch, j);
            const NUMBER rz = target[2 * target_pitch + i] - collect(source + 2 * source_pitch, j);
            const NUMBER s = target[3 * target_pitch + i] + collect(source + 3 * source_pitch, j);
            const auto near = __builtin_convertvector(rx * rx + ry * ry + rz * rz < s * s, INDEX) & listed;
            overlapping += append(found + overlapping, j, near);
        }}
        __builtin_memcpy(overlap_out.data + (size_t)CAPACITY * i, found, overlapping * sizeof(int));
        overlap_count_out.data[i] = count <= CAPACITY ? overlapping : count;
    }};
    {_SHARE}
"""


def _text(real: str, text: str, **constants) -> str:
    names = "".join(f"constexpr auto {name} = {value!r};\n" for name, value in constants.items())
    return f"{{\n#pragma clang fp contract(fast)\ntypedef {real} REAL;\n{names}{text}\n}}"


@cache
def _search_kernel(dtype, capacity: int, farthest: float):
    vec3 = wp.types.vector(3, dtype)

    @wp.func_native(_text("float" if dtype is wp.float32 else "double", _SEARCH, CAPACITY=capacity, FARTHEST=farthest))
    def search(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        target_group: wp.array[int],
        source_group: wp.array[int],
        width: wp.float64,
        ratio: dtype,
        same_set: int,
        threads: int,
        team: wp.array2d[wp.uint64],
        moved: wp.array[int],
        begin: wp.array[int],
        entries: wp.array2d[int],
        places: wp.array2d[dtype],
        searching_out: wp.array[int],
        neighbor_out: wp.array2d[int],
        neighbor_count_out: wp.array[int],
        found_at_out: wp.array[vec3],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_registers())
    def search_neighbors(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        target_group: wp.array[int],
        source_group: wp.array[int],
        width: wp.float64,
        ratio: dtype,
        same_set: int,
        threads: int,
        team: wp.array2d[wp.uint64],
        # in and out:
        moved: wp.array[int],
        # outputs:
        begin: wp.array[int],
        entries: wp.array2d[int],
        places: wp.array2d[dtype],
        searching_out: wp.array[int],
        neighbor_out: wp.array2d[int],
        neighbor_count_out: wp.array[int],
        found_at_out: wp.array[vec3],
    ):
        search(
            targets,
            sources,
            target_group,
            source_group,
            width,
            ratio,
            same_set,
            threads,
            team,
            moved,
            begin,
            entries,
            places,
            searching_out,
            neighbor_out,
            neighbor_count_out,
            found_at_out,
        )

    return search_neighbors


@cache
def _overlap_kernel(dtype, capacity: int):
    @wp.func_native(_text("float" if dtype is wp.float32 else "double", _OVERLAPS, CAPACITY=capacity))
    def find(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        threads: int,
        team: wp.array2d[wp.uint64],
        overlap_out: wp.array2d[int],
        overlap_count_out: wp.array[int],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_registers())
    def find_overlaps(
        # inputs:
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
        threads: int,
        team: wp.array2d[wp.uint64],
        # outputs:
        overlap_out: wp.array2d[int],
        overlap_count_out: wp.array[int],
    ):
        find(targets, sources, neighbor, neighbor_count, threads, team, overlap_out, overlap_count_out)

    return find_overlaps


def launch_search(targets, sources, target_group, source_group, width, lists, source_lists, farthest: float):
    """Search, if moments have moved, in cells of some width [m]; see ``neighbors.launch_find_neighbors``."""
    dtype, by_cell = targets.dtype, source_lists.by_cell
    wp.launch(
        _search_kernel(dtype, lists.neighbor.shape[1], farthest),
        dim=1,
        inputs=[
            targets,
            sources,
            target_group,
            source_group,
            width,
            dtype(lists.ratio),
            int(lists is source_lists),
            threads_for(targets.shape[1], MOMENTS_PER_THREAD),
            team(),
            lists.moved,
        ],
        outputs=[
            by_cell.begin,
            by_cell.entries,
            by_cell.places,
            lists.searching,
            lists.neighbor,
            lists.count,
            lists.found_at,
        ],
        device="cpu",
    )


def launch_overlaps(targets, sources, lists, overlap, overlap_count):
    """List what overlaps each target; see ``neighbors.launch_list_overlaps``."""
    wp.launch(
        _overlap_kernel(targets.dtype, lists.neighbor.shape[1]),
        dim=1,
        inputs=[
            targets,
            sources,
            lists.neighbor,
            lists.count,
            threads_for(targets.shape[1], MOMENTS_PER_THREAD),
            team(),
        ],
        outputs=[overlap, overlap_count],
        device="cpu",
    )
