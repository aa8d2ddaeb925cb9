// Expansions of cells: multipoles of moments, of parents from their children, local expansions of children from their
// parents', and fields from those. expansions.py says what the arrays are; warpmag/moments/harmonics.py has the
// equations.
//
// The gradient of a harmonic is a sum of a few harmonics of one degree less. So moments are first summed with plain
// harmonics, S_jc = Σ m_c R_j(u), of which a leaf makes its multipole once; and its local expansion becomes the
// coefficients G_jc of the field's components, H_c = −Σ G_jc R_j(u) / 4πh³, and of their derivatives.
#pragma once
#include "pairs/pair_terms.h"
#include "shared/arrival.h"
#include "shared/team.h"
#include "shared/vectors.h"

namespace warpmag {

constexpr int BELOW = DEGREE * DEGREE; // harmonics of one degree less
constexpr int TERMS = 5;               // terms of a multipole's coefficient, as in expansions.py
constexpr bool is_force(Quantity q) { return q != Quantity::FIELD; }
constexpr bool is_field(Quantity q) { return q == Quantity::FIELD || q == Quantity::WRENCH; }

CUDA_CALLABLE inline int index_of(int degree, int order) { return degree * degree + degree + order; }

// Calls visit(j, R_j) for the harmonics at a point below DEGREE whose order is ``first`` or a multiple of ``step``
// more.
template <class Visit>
CUDA_CALLABLE inline void visit_harmonics(const Real* growth, const Real* decay, Vector u, int first, int step,
                                          Visit visit) {
    const Number r2 = dot(u, u), zero = Number(Real(0));
    Number cosine = zero + 1, sine = zero;
    for (int m = 0; m < DEGREE; ++m) {
        if (m > 0) {
            const Number scale = zero + growth[index_of(m, m)], c = cosine;
            cosine = scale * (c * u.x - sine * u.y), sine = scale * (c * u.y + sine * u.x);
        }
        if (m % step != first) continue;
        Number a = cosine, b = sine, a_before = zero, b_before = zero;
        for (int n = m; n < DEGREE; ++n) {
            const int j = index_of(n, m);
            if (n > m) {
                const Number up = growth[j] * u.z, down = decay[j] * r2;
                const Number a_next = up * a - down * a_before, b_next = up * b - down * b_before;
                a_before = a, b_before = b, a = a_next, b = b_next;
            }
            visit(j, a);
            if (m > 0) visit(j - 2 * m, b);
        }
    }
}

// Rows of numbers of moments, one row after the other.
struct Rows {
    Real* data;
    size_t pitch;

    CUDA_CALLABLE Rows(const wp::array_t<Real>& table) : data(table.data), pitch(table.strides[0] / sizeof(Real)) {}
    CUDA_CALLABLE Vector vector(int row, int i) const {
        const Real* const at = data + row * pitch + i;
        return {numbers(at), numbers(at + pitch), numbers(at + 2 * pitch)};
    }
};

// Coefficient i of a multipole from the sums S of a leaf's moments.
template <class Arrays> CUDA_CALLABLE inline Real multipole_of(const Arrays& a, const Real* sums, int i) {
    if (i >= a.sources) return 0;
    Real q = 0;
    for (int t = TERMS * i; t < TERMS * (i + 1); ++t) q += a.gather_weight.data[t] * sums[a.gather_index.data[t]];
    return q;
}

// Derivative along an axis of an expansion, its coefficient j, of one in ``from``, whose coefficients are ``stride``
// apart.
template <class Arrays>
CUDA_CALLABLE inline Real derivative(const Arrays& a, const Real* from, int stride, int j, int axis) {
    const int t = 2 * (3 * j + axis);
    return a.spread_weight.data[t] * from[stride * a.spread_index.data[t]]
           + a.spread_weight.data[t + 1] * from[stride * a.spread_index.data[t + 1]];
}

// Coefficients of the components of a field, and of the derivatives xx, xy, xz, yy, yz, zz.
constexpr int FIELD_ROW = 4, FORCE_ROW = 6;
template <Quantity Q> struct Fields {
    Real field[BELOW][FIELD_ROW];
    Real force[is_force(Q) ? (DEGREE - 1) * (DEGREE - 1) : 1][FORCE_ROW];
};
template <class Arrays> CUDA_CALLABLE inline void set_field(const Arrays& a, Real* row, const Real* local, int j) {
    for (int c = 0; c < 3; ++c) row[c] = derivative(a, local, 1, j, c);
}
template <Quantity Q, class Arrays> CUDA_CALLABLE inline void set_force(const Arrays& a, Fields<Q>& fields, int j) {
    for (int c = 0, k = 0; c < 3; ++c)
        for (int d = c; d < 3; ++d) fields.force[j][k++] = derivative(a, fields.field[0] + c, FIELD_ROW, j, d);
}

// What moments in a leaf feel: 4π times the field H, and (e·∇)H for moments e.
struct Felt {
    Vector h, f;
};
template <Quantity Q, class Arrays>
CUDA_CALLABLE inline Felt felt_at(const Arrays& a, const Fields<Q>& fields, Vector u, Vector e) {
    const Number zero = Number(Real(0));
    Felt felt = {{zero, zero, zero}, {zero, zero, zero}};
    visit_harmonics(a.growth.data, a.decay.data, u, 0, 1, [&](int j, Number r) {
        if (is_field(Q)) {
            const Real* const g = fields.field[j];
            felt.h.x -= g[0] * r, felt.h.y -= g[1] * r, felt.h.z -= g[2] * r;
        }
        if (is_force(Q) && j < (DEGREE - 1) * (DEGREE - 1)) {
            const Real* const t = fields.force[j];
            felt.f.x -= r * (t[0] * e.x + t[1] * e.y + t[2] * e.z);
            felt.f.y -= r * (t[1] * e.x + t[3] * e.y + t[4] * e.z);
            felt.f.z -= r * (t[2] * e.x + t[4] * e.y + t[5] * e.z);
        }
    });
    const Real scale = Real(1) / (Real)a.frame.data[4], volume = scale * scale * scale;
    return {(zero + volume) * felt.h, (zero + scale) * ((zero + volume) * felt.f)};
}
CUDA_CALLABLE inline void add_vectors(Real* rows, int row, int held, Vector v) {
    for (int l = 0; l < held && l < WIDTH; ++l, rows += row)
        rows[0] += lane_of(v.x, l), rows[1] += lane_of(v.y, l), rows[2] += lane_of(v.z, l);
}
template <Quantity Q> CUDA_CALLABLE inline void add_felt(Real* sums, int held, const Felt& felt) {
    if (is_force(Q)) add_vectors(sums, width(Q), held, felt.f);
    if (is_field(Q)) add_vectors(sums + width(Q) - 3, width(Q), held, felt.h);
}

// The multipole of a leaf; on a GPU by a block.
template <class Arrays> CUDA_CALLABLE inline void leaf_multipole(const Arrays& a, int leaf) {
    const int begin = a.moment_begin.data[leaf], end = a.moment_begin.data[leaf + 1];
    const Rows inside(a.inside), sorted(a.sorted);
    Real* const multipole = a.multipoles.data + PITCH * (size_t)leaf;
#if defined(__CUDA_ARCH__)
    constexpr int EACH = (BELOW + THREADS - 1) / THREADS;
    constexpr int BATCH = sizeof(Real) == 8 ? 16 : 32; // moments at a time: 48 KiB hold their harmonics
    __shared__ Real harmonics[BELOW][BATCH + 1], moments[3][BATCH], sums[3 * BELOW];
    const int lane = threadIdx.x % BATCH;
    Real own[EACH][3] = {};
    for (int first = begin; first < end; first += BATCH) {
        const int i = first + lane < end ? first + lane : end - 1;
        __syncthreads();
        visit_harmonics(a.growth.data, a.decay.data, inside.vector(0, i), threadIdx.x / 32, THREADS / 32,
                        [&](int j, Real r) { harmonics[j][lane] = r; });
        if (threadIdx.x < 32) {
            const Vector m = sorted.vector(4, i);
            const bool held = first + lane < end;
            moments[0][lane] = held ? m.x : 0, moments[1][lane] = held ? m.y : 0, moments[2][lane] = held ? m.z : 0;
        }
        __syncthreads();
#pragma unroll
        for (int e = 0; e < EACH; ++e) {
            const int j = threadIdx.x + e * THREADS;
            if (j >= BELOW) break;
            for (int k = 0; k < BATCH; ++k)
                for (int c = 0; c < 3; ++c) own[e][c] += moments[c][k] * harmonics[j][k];
        }
    }
#pragma unroll
    for (int e = 0; e < EACH; ++e)
        for (int c = 0; c < 3; ++c)
            if (threadIdx.x + e * THREADS < BELOW) sums[3 * (threadIdx.x + e * THREADS) + c] = own[e][c];
    __syncthreads();
    for (int i = threadIdx.x; i < HARMONICS; i += THREADS) multipole[i] = multipole_of(a, sums, i);
    __syncthreads();
#else
    Number harmonics[BELOW], parts[3 * BELOW] = {};
    for (int i = begin; i < end; i += WIDTH) {
        Vector m = sorted.vector(4, i);
        for (int l = end - i; l < WIDTH; ++l) m.x[l] = m.y[l] = m.z[l] = 0;
        visit_harmonics(a.growth.data, a.decay.data, inside.vector(0, i), 0, 1,
                        [&](int j, Number r) { harmonics[j] = r; });
        for (int j = 0; j < BELOW; ++j) {
            parts[3 * j] += m.x * harmonics[j];
            parts[3 * j + 1] += m.y * harmonics[j];
            parts[3 * j + 2] += m.z * harmonics[j];
        }
    }
    Real sums[3 * BELOW];
    for (int k = 0; k < 3 * BELOW; ++k) {
        sums[k] = 0;
        for (int l = 0; l < WIDTH; ++l) sums[k] += parts[k][l];
    }
    for (int i = 0; i < HARMONICS; ++i) multipole[i] = multipole_of(a, sums, i);
#endif
}

// Adds what all moments of a leaf feel from afar; on a GPU by a block.
template <Quantity Q, class Arrays> CUDA_CALLABLE inline void leaf_fields(const Arrays& a, int leaf) {
    const int begin = a.moment_begin.data[leaf], end = a.moment_begin.data[leaf + 1];
    const Rows inside(a.inside), effective(a.effective);
    const Real* const local = a.locals.data + PITCH * (size_t)leaf;
#if defined(__CUDA_ARCH__)
    __shared__ Fields<Q> fields;
    const int first = threadIdx.x, step = THREADS;
    __syncthreads();
#else
    Fields<Q> fields;
    const int first = 0, step = 1;
#endif
    for (int j = first; j < BELOW; j += step) set_field(a, fields.field[j], local, j);
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
    if (is_force(Q))
        for (int j = first; j < (DEGREE - 1) * (DEGREE - 1); j += step) set_force<Q>(a, fields, j);
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
    for (int i = begin + first * WIDTH; i < end; i += step * WIDTH) {
        const Vector u = inside.vector(0, i), e = is_force(Q) ? effective.vector(0, i) : u;
        add_felt<Q>(a.sums.data + (size_t)width(Q) * i, end - i, felt_at<Q>(a, fields, u, e));
    }
}

// The multipole of a cell from those of its children, and what its local expansion adds to theirs: a matrix for a child
// in octant 0, mirrored for the others. On a GPU a block reads it once for all children.
#if defined(__CUDA_ARCH__)
// Row i of a matrix, of which columns follow each other, times the expansions of 8 children side by side.
CUDA_CALLABLE inline void multiply_row(Real (&sums)[8], const Real* matrix, const Real (*children)[8], int i) {
#pragma unroll 8
    for (int k = 0; k < HARMONICS; ++k) {
        const Real m = matrix[k * PITCH + i];
#pragma unroll
        for (int o = 0; o < 8; ++o) sums[o] += m * children[k][o];
    }
}

// Other blocks of this launch write what is read of expansions here, so that it comes from the cache of all of them.
template <class Arrays> CUDA_CALLABLE inline void merge_children(const Arrays& a, int cell) {
    __shared__ alignas(16) Real signed_from[HARMONICS][8];
    for (int item = threadIdx.x; item < 8 * HARMONICS; item += THREADS) {
        const int o = item / HARMONICS, k = item % HARMONICS, child = a.children.data[8 * (size_t)cell + o];
        const Real* const from = a.multipoles.data + PITCH * (size_t)child + k;
        signed_from[k][o] = child < 0 ? 0 : a.signs.data[PITCH * o + k] * __ldcg(from);
    }
    __syncthreads();
    for (int i = threadIdx.x; i < HARMONICS; i += THREADS) {
        Real sums[8] = {}, q = 0;
        multiply_row(sums, a.up.data, signed_from, i);
        for (int o = 0; o < 8; ++o) q += a.signs.data[PITCH * o + i] * sums[o];
        a.multipoles.data[PITCH * (size_t)cell + i] = i < a.sources ? q : 0;
    }
}
template <class Arrays> CUDA_CALLABLE inline void spread_to_children(const Arrays& a, int cell) {
    __shared__ alignas(16) Real signed_from[HARMONICS][8];
    for (int k = threadIdx.x; k < HARMONICS; k += THREADS) {
        const Real own = __ldcg(a.locals.data + PITCH * (size_t)cell + k);
        for (int o = 0; o < 8; ++o) signed_from[k][o] = a.signs.data[PITCH * o + k] * own;
    }
    __syncthreads();
    for (int i = threadIdx.x; i < HARMONICS; i += THREADS) {
        Real sums[8] = {};
        multiply_row(sums, a.down.data, signed_from, i);
#pragma unroll
        for (int o = 0; o < 8; ++o) {
            const int child = a.children.data[8 * (size_t)cell + o];
            if (child >= 0) a.locals.data[PITCH * (size_t)child + i] += a.signs.data[PITCH * o + i] * sums[o];
        }
    }
}
#else
inline void add_product(Real* out, const Real* matrix, const Real* from, const Real* signs) {
    constexpr int VECTORS = PITCH / WIDTH;
    Number sums[VECTORS] = {};
    for (int k = 0; k < HARMONICS; ++k)
        for (int v = 0; v < VECTORS; ++v) sums[v] += (signs[k] * from[k]) * numbers(matrix + k * PITCH + v * WIDTH);
    for (int v = 0; v < VECTORS; ++v)
        put(out + v * WIDTH, numbers(out + v * WIDTH) + numbers(signs + v * WIDTH) * sums[v]);
}
// Calls visit(child, signs of its octant).
template <class Arrays, class Visit> void visit_children(const Arrays& a, int cell, Visit visit) {
    for (int octant = 0; octant < 8; ++octant) {
        const int child = a.children.data[8 * (size_t)cell + octant];
        if (child >= 0) visit(child, a.signs.data + PITCH * octant);
    }
}
template <class Arrays> void merge_children(const Arrays& a, int cell) {
    Real* const multipole = a.multipoles.data + PITCH * (size_t)cell;
    __builtin_memset(multipole, 0, PITCH * sizeof(Real));
    visit_children(a, cell, [&](int child, const Real* signs) {
        add_product(multipole, a.up.data, a.multipoles.data + PITCH * (size_t)child, signs);
    });
    for (int i = a.sources; i < HARMONICS; ++i) multipole[i] = 0;
}
template <class Arrays> void spread_to_children(const Arrays& a, int cell) {
    visit_children(a, cell, [&](int child, const Real* signs) {
        add_product(a.locals.data + PITCH * (size_t)child, a.down.data, a.locals.data + PITCH * (size_t)cell, signs);
    });
}
#endif

// Steps over all cells: up from the leaves, down to them, and the fields at their moments. Only cells two levels and
// more below the cube are translated to each other, so that none above has an expansion.
enum class Step { RISE, FALL, FIELDS };

#if defined(__CUDA_ARCH__)
// A block has a leaf; the last of those of a cell's children goes on with the cell.
template <class Arrays> CUDA_CALLABLE inline void rise(const Arrays& a, int block) {
    if (block >= a.level_begin.data[1]) return;
    leaf_multipole(a, block);
    int cell = block;
    for (int level = a.counts.data[0] - 1; level >= 2; --level) {
        cell = a.parent.data[cell];
        int children = 0;
        for (int o = 0; o < 8; ++o) children += a.children.data[8 * (size_t)cell + o] >= 0;
        if (!is_last_of(a.arrived.data + cell, children)) return;
        merge_children(a, cell);
    }
}

// Blocks have cells in turn, from the top down, and wait for a cell's parent. It belongs to an earlier turn, or to a
// block before this one, which GPUs start before.
template <class Arrays> CUDA_CALLABLE inline void fall(const Arrays& a, int block, int blocks) {
    const int levels = a.counts.data[0];
    if (levels < 3) return;
    const int leaves = a.level_begin.data[1], parents = a.level_begin.data[2], top = a.level_begin.data[levels - 2];
    for (int cell = a.level_begin.data[levels - 1] - 1 - block; cell >= leaves; cell -= blocks) {
        if (cell < top && threadIdx.x == 0) {
            while (*(volatile int*)(a.arrived.data + cell) == 0) __nanosleep(50);
            a.arrived.data[cell] = 0;
            __threadfence();
        }
        __syncthreads();
        spread_to_children(a, cell);
        __syncthreads();
        const int child = cell >= parents && threadIdx.x < 8 ? a.children.data[8 * (size_t)cell + threadIdx.x] : -1;
        if (child >= 0) {
            __threadfence();
            atomicExch(a.arrived.data + child, 1);
        }
    }
}

template <Step S, Quantity Q, class Word, class Arrays>
CUDA_CALLABLE inline void visit_cells(int thread, int threads, Word*, const Arrays& a) {
    const int block = thread / THREADS, leaf = a.leaves.data[0] + block;
    if constexpr (S == Step::RISE) rise(a, block);
    else if constexpr (S == Step::FALL) fall(a, block, threads);
    else if (leaf < a.leaves.data[1]) leaf_fields<Q>(a, leaf);
}
#else
template <Step S, Quantity Q, class Word, class Arrays>
void visit_cells(int, int threads, Word* team, const Arrays& a) {
    const int levels = a.counts.data[0], *const begin = a.level_begin.data;
    const auto visit_run = [&](const int* run, auto work) {
        share_out(team, threads, run[1] - run[0], 4, [&](int i) { work(run[0] + i); });
    };
    const auto visit = [&](int height, auto work) { visit_run(begin + height, work); };
    if constexpr (S == Step::RISE) {
        visit(0, [&](int leaf) { leaf_multipole(a, leaf); });
        for (int height = 1; height <= levels - 2; ++height) visit(height, [&](int cell) { merge_children(a, cell); });
    } else if constexpr (S == Step::FALL) {
        for (int height = levels - 2; height > 0; --height)
            visit(height, [&](int cell) { spread_to_children(a, cell); });
    } else visit_run(a.leaves.data, [&](int leaf) { leaf_fields<Q>(a, leaf); });
}
#endif
}
