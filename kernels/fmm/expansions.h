// Expansions of boxes: multipoles of moments (P2M) and of parents (M2M), local expansions of children (L2L), and fields
// from local expansions (L2P). expansions.py describes the arrays; warpmag/moments/harmonics.py has the equations.
//
// The gradient of a harmonic is a sum of a few harmonics of one degree less. Moments are therefore summed with plain
// harmonics first, S_jc = Σ m_c R_j(u), and each leaf converts these sums to its multipole once. Likewise each leaf
// converts its local expansion to coefficients G_jc of the field's components, H_c = −Σ G_jc R_j(u) / 4πh³, and of
// their derivatives.
#pragma once
#include "pairs/pair_terms.h"
#include "shared/arrival.h"
#include "shared/team.h"
#include "shared/vectors.h"

namespace warpmag {

constexpr int LOWER_HARMONICS = DEGREE * DEGREE; // harmonics up to one degree less
constexpr int TERMS = 5;                         // terms of a multipole's coefficient; as in expansions.py
constexpr bool has_force(Quantity q) { return q != Quantity::FIELD; }
constexpr bool has_field(Quantity q) { return q == Quantity::FIELD || q == Quantity::WRENCH; }

CUDA_CALLABLE inline int index_of(int degree, int order) { return degree * degree + degree + order; }

// Calls visit(j, R_j(u)) for the harmonics of degrees below DEGREE and orders m with m % step == first.
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

// Rows of an array of moments.
struct MomentRows {
    Real* data;
    size_t pitch;

    CUDA_CALLABLE MomentRows(const wp::array_t<Real>& table)
        : data(table.data), pitch(table.strides[0] / sizeof(Real)) {}
    CUDA_CALLABLE Vector vector(int row, int i) const {
        const Real* const at = data + row * pitch + i;
        return {numbers(at), numbers(at + pitch), numbers(at + 2 * pitch)};
    }
};

// Coefficient i of a leaf's multipole from the sums S of its moments.
template <class Arrays> CUDA_CALLABLE inline Real multipole_of(const Arrays& a, const Real* sums, int i) {
    if (i >= a.source_harmonics) return 0;
    Real q = 0;
    for (int t = TERMS * i; t < TERMS * (i + 1); ++t) q += a.multipole_weight.data[t] * sums[a.multipole_index.data[t]];
    return q;
}

// Coefficient j of the derivative along an axis of the expansion ``from``, with coefficients ``stride`` apart.
template <class Arrays>
CUDA_CALLABLE inline Real derivative(const Arrays& a, const Real* from, int stride, int j, int axis) {
    const int t = 2 * (3 * j + axis);
    return a.derivative_weight.data[t] * from[stride * a.derivative_index.data[t]]
           + a.derivative_weight.data[t + 1] * from[stride * a.derivative_index.data[t + 1]];
}

// Coefficients of the field's components, and of its derivatives xx, xy, xz, yy, yz, zz.
constexpr int FIELD_ROW = 4, FORCE_ROW = 6;
template <Quantity Q> struct FieldExpansion {
    Real field[LOWER_HARMONICS][FIELD_ROW];
    Real force[has_force(Q) ? (DEGREE - 1) * (DEGREE - 1) : 1][FORCE_ROW];
};
template <class Arrays> CUDA_CALLABLE inline void set_field(const Arrays& a, Real* row, const Real* local, int j) {
    for (int c = 0; c < 3; ++c) row[c] = derivative(a, local, 1, j, c);
}
template <Quantity Q, class Arrays>
CUDA_CALLABLE inline void set_force(const Arrays& a, FieldExpansion<Q>& fields, int j) {
    for (int c = 0, k = 0; c < 3; ++c)
        for (int d = c; d < 3; ++d) fields.force[j][k++] = derivative(a, fields.field[0] + c, FIELD_ROW, j, d);
}

// 4π times the field H, and 4π times (e·∇)H for effective moments e.
struct FieldForce {
    Vector h, f;
};
template <Quantity Q, class Arrays>
CUDA_CALLABLE inline FieldForce evaluate_expansion(const Arrays& a, const FieldExpansion<Q>& fields, Vector u,
                                                   Vector e) {
    const Number zero = Number(Real(0));
    FieldForce result = {{zero, zero, zero}, {zero, zero, zero}};
    visit_harmonics(a.growth.data, a.decay.data, u, 0, 1, [&](int j, Number r) {
        if (has_field(Q)) {
            const Real* const g = fields.field[j];
            result.h.x -= g[0] * r, result.h.y -= g[1] * r, result.h.z -= g[2] * r;
        }
        if (has_force(Q) && j < (DEGREE - 1) * (DEGREE - 1)) {
            const Real* const t = fields.force[j];
            result.f.x -= r * (t[0] * e.x + t[1] * e.y + t[2] * e.z);
            result.f.y -= r * (t[1] * e.x + t[3] * e.y + t[4] * e.z);
            result.f.z -= r * (t[2] * e.x + t[4] * e.y + t[5] * e.z);
        }
    });
    const Real scale = Real(1) / (Real)a.frame.data[4], volume = scale * scale * scale;
    return {(zero + volume) * result.h, (zero + scale) * ((zero + volume) * result.f)};
}
CUDA_CALLABLE inline void add_vectors(Real* rows, int row, int lane_count, Vector v) {
    for (int l = 0; l < lane_count && l < WIDTH; ++l, rows += row)
        rows[0] += lane_of(v.x, l), rows[1] += lane_of(v.y, l), rows[2] += lane_of(v.z, l);
}
template <Quantity Q> CUDA_CALLABLE inline void add_sums(Real* sums, int lane_count, const FieldForce& result) {
    if (has_force(Q)) add_vectors(sums, width(Q), lane_count, result.f);
    if (has_field(Q)) add_vectors(sums + width(Q) - 3, width(Q), lane_count, result.h);
}

// Computes the multipole of a leaf; on a GPU a block does.
template <class Arrays> CUDA_CALLABLE inline void leaf_multipole(const Arrays& a, int leaf) {
    const int begin = a.moment_begin.data[leaf], end = a.moment_begin.data[leaf + 1];
    const MomentRows position(a.leaf_position), sorted(a.sorted);
    Real* const multipole = a.multipoles.data + PITCH * (size_t)leaf;
#if defined(__CUDA_ARCH__)
    constexpr int EACH = (LOWER_HARMONICS + THREADS - 1) / THREADS;
    constexpr int BATCH = sizeof(Real) == 8 ? 16 : 32; // moments at a time, so that their harmonics fit into 48 KiB
    __shared__ Real harmonics[LOWER_HARMONICS][BATCH + 1], moments[3][BATCH], sums[3 * LOWER_HARMONICS];
    const int lane = threadIdx.x % BATCH;
    Real totals[EACH][3] = {};
    for (int first = begin; first < end; first += BATCH) {
        const int i = first + lane < end ? first + lane : end - 1;
        __syncthreads();
        visit_harmonics(a.growth.data, a.decay.data, position.vector(0, i), threadIdx.x / 32, THREADS / 32,
                        [&](int j, Real r) { harmonics[j][lane] = r; });
        if (threadIdx.x < 32) {
            const Vector m = sorted.vector(4, i);
            const bool exists = first + lane < end;
            moments[0][lane] = exists ? m.x : 0, moments[1][lane] = exists ? m.y : 0,
            moments[2][lane] = exists ? m.z : 0;
        }
        __syncthreads();
#pragma unroll
        for (int e = 0; e < EACH; ++e) {
            const int j = threadIdx.x + e * THREADS;
            if (j >= LOWER_HARMONICS) break;
            for (int k = 0; k < BATCH; ++k)
                for (int c = 0; c < 3; ++c) totals[e][c] += moments[c][k] * harmonics[j][k];
        }
    }
#pragma unroll
    for (int e = 0; e < EACH; ++e)
        for (int c = 0; c < 3; ++c)
            if (threadIdx.x + e * THREADS < LOWER_HARMONICS) sums[3 * (threadIdx.x + e * THREADS) + c] = totals[e][c];
    __syncthreads();
    for (int i = threadIdx.x; i < HARMONICS; i += THREADS) multipole[i] = multipole_of(a, sums, i);
    __syncthreads();
#else
    Number harmonics[LOWER_HARMONICS], parts[3 * LOWER_HARMONICS] = {};
    for (int i = begin; i < end; i += WIDTH) {
        Vector m = sorted.vector(4, i);
        for (int l = end - i; l < WIDTH; ++l) m.x[l] = m.y[l] = m.z[l] = 0;
        visit_harmonics(a.growth.data, a.decay.data, position.vector(0, i), 0, 1,
                        [&](int j, Number r) { harmonics[j] = r; });
        for (int j = 0; j < LOWER_HARMONICS; ++j) {
            parts[3 * j] += m.x * harmonics[j];
            parts[3 * j + 1] += m.y * harmonics[j];
            parts[3 * j + 2] += m.z * harmonics[j];
        }
    }
    Real sums[3 * LOWER_HARMONICS];
    for (int k = 0; k < 3 * LOWER_HARMONICS; ++k) {
        sums[k] = 0;
        for (int l = 0; l < WIDTH; ++l) sums[k] += parts[k][l];
    }
    for (int i = 0; i < HARMONICS; ++i) multipole[i] = multipole_of(a, sums, i);
#endif
}

// Adds the far field and force at all moments of a leaf; on a GPU a block does.
template <Quantity Q, class Arrays> CUDA_CALLABLE inline void leaf_fields(const Arrays& a, int leaf) {
    const int begin = a.moment_begin.data[leaf], end = a.moment_begin.data[leaf + 1];
    const MomentRows position(a.leaf_position), effective(a.effective);
    const Real* const local = a.locals.data + PITCH * (size_t)leaf;
#if defined(__CUDA_ARCH__)
    __shared__ FieldExpansion<Q> fields;
    const int first = threadIdx.x, step = THREADS;
    __syncthreads();
#else
    FieldExpansion<Q> fields;
    const int first = 0, step = 1;
#endif
    for (int j = first; j < LOWER_HARMONICS; j += step) set_field(a, fields.field[j], local, j);
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
    if (has_force(Q))
        for (int j = first; j < (DEGREE - 1) * (DEGREE - 1); j += step) set_force<Q>(a, fields, j);
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
    for (int i = begin + first * WIDTH; i < end; i += step * WIDTH) {
        const Vector u = position.vector(0, i), e = has_force(Q) ? effective.vector(0, i) : u;
        add_sums<Q>(a.sums.data + (size_t)width(Q) * i, end - i, evaluate_expansion<Q>(a, fields, u, e));
    }
}

// M2M and L2L: the multipole of a box from those of its children, and its contribution to their local expansions. The
// matrices are those of a child in octant 0; other octants are its mirror images. On a GPU a block reads a matrix once
// for all children.
#if defined(__CUDA_ARCH__)
// Adds row i of a column-major matrix times the expansions of 8 children side by side.
CUDA_CALLABLE inline void multiply_row(Real (&sums)[8], const Real* matrix, const Real (*children)[8], int i) {
#pragma unroll 8
    for (int k = 0; k < HARMONICS; ++k) {
        const Real m = matrix[k * PITCH + i];
#pragma unroll
        for (int o = 0; o < 8; ++o) sums[o] += m * children[k][o];
    }
}

// Other blocks of the same launch write these expansions, so that __ldcg reads them from L2.
template <class Arrays> CUDA_CALLABLE inline void multipole_from_children(const Arrays& a, int box) {
    __shared__ alignas(16) Real mirrored[HARMONICS][8];
    for (int item = threadIdx.x; item < 8 * HARMONICS; item += THREADS) {
        const int o = item / HARMONICS, k = item % HARMONICS, child = a.children.data[8 * (size_t)box + o];
        const Real* const from = a.multipoles.data + PITCH * (size_t)child + k;
        mirrored[k][o] = child < 0 ? 0 : a.signs.data[PITCH * o + k] * __ldcg(from);
    }
    __syncthreads();
    for (int i = threadIdx.x; i < HARMONICS; i += THREADS) {
        Real sums[8] = {}, q = 0;
        multiply_row(sums, a.multipole_to_parent.data, mirrored, i);
        for (int o = 0; o < 8; ++o) q += a.signs.data[PITCH * o + i] * sums[o];
        a.multipoles.data[PITCH * (size_t)box + i] = i < a.source_harmonics ? q : 0;
    }
}
template <class Arrays> CUDA_CALLABLE inline void locals_to_children(const Arrays& a, int box) {
    __shared__ alignas(16) Real mirrored[HARMONICS][8];
    for (int k = threadIdx.x; k < HARMONICS; k += THREADS) {
        const Real value = __ldcg(a.locals.data + PITCH * (size_t)box + k);
        for (int o = 0; o < 8; ++o) mirrored[k][o] = a.signs.data[PITCH * o + k] * value;
    }
    __syncthreads();
    for (int i = threadIdx.x; i < HARMONICS; i += THREADS) {
        Real sums[8] = {};
        multiply_row(sums, a.local_to_child.data, mirrored, i);
#pragma unroll
        for (int o = 0; o < 8; ++o) {
            const int child = a.children.data[8 * (size_t)box + o];
            if (child >= 0) a.locals.data[PITCH * (size_t)child + i] += a.signs.data[PITCH * o + i] * sums[o];
        }
    }
}
#else
// Adds to ``out`` the matrix-vector product with ``from``, mirrored by ``signs``.
inline void add_product(Real* out, const Real* matrix, const Real* from, const Real* signs) {
    constexpr int VECTORS = PITCH / WIDTH;
    Number sums[VECTORS] = {};
    for (int k = 0; k < HARMONICS; ++k)
        for (int v = 0; v < VECTORS; ++v) sums[v] += (signs[k] * from[k]) * numbers(matrix + k * PITCH + v * WIDTH);
    for (int v = 0; v < VECTORS; ++v)
        put(out + v * WIDTH, numbers(out + v * WIDTH) + numbers(signs + v * WIDTH) * sums[v]);
}
// Calls visit(child, signs of the child's octant).
template <class Arrays, class Visit> void visit_children(const Arrays& a, int box, Visit visit) {
    for (int octant = 0; octant < 8; ++octant) {
        const int child = a.children.data[8 * (size_t)box + octant];
        if (child >= 0) visit(child, a.signs.data + PITCH * octant);
    }
}
template <class Arrays> void multipole_from_children(const Arrays& a, int box) {
    Real* const multipole = a.multipoles.data + PITCH * (size_t)box;
    __builtin_memset(multipole, 0, PITCH * sizeof(Real));
    visit_children(a, box, [&](int child, const Real* signs) {
        add_product(multipole, a.multipole_to_parent.data, a.multipoles.data + PITCH * (size_t)child, signs);
    });
    for (int i = a.source_harmonics; i < HARMONICS; ++i) multipole[i] = 0;
}
template <class Arrays> void locals_to_children(const Arrays& a, int box) {
    visit_children(a, box, [&](int child, const Real* signs) {
        add_product(a.locals.data + PITCH * (size_t)child, a.local_to_child.data, a.locals.data + PITCH * (size_t)box,
                    signs);
    });
}
#endif

// Steps over all boxes: upward pass, downward pass, and evaluation at the moments. Multipoles are translated between
// boxes at least two levels below the cube only, so coarser boxes have no expansion.
enum class Step { UPWARD, DOWNWARD, EVALUATE };

#if defined(__CUDA_ARCH__)
// Each block starts at a leaf. The last block to finish a child of a box goes on with that box.
template <class Arrays> CUDA_CALLABLE inline void upward_pass(const Arrays& a, int block) {
    if (block >= a.level_begin.data[1]) return;
    leaf_multipole(a, block);
    int box = block;
    for (int level = a.counts.data[0] - 1; level >= 2; --level) {
        box = a.parent.data[box];
        int children = 0;
        for (int o = 0; o < 8; ++o) children += a.children.data[8 * (size_t)box + o] >= 0;
        if (!is_last_of(a.arrived.data + box, children)) return;
        multipole_from_children(a, box);
    }
}

// Blocks take boxes in turn, from the top down, and wait for each box's parent. The parent belongs to an earlier turn,
// or to a block of lower index, which GPUs start earlier.
template <class Arrays> CUDA_CALLABLE inline void downward_pass(const Arrays& a, int block, int blocks) {
    const int levels = a.counts.data[0];
    if (levels < 3) return;
    const int leaves = a.level_begin.data[1], parents = a.level_begin.data[2], top = a.level_begin.data[levels - 2];
    for (int box = a.level_begin.data[levels - 1] - 1 - block; box >= leaves; box -= blocks) {
        if (box < top && threadIdx.x == 0) {
            while (*(volatile int*)(a.arrived.data + box) == 0) __nanosleep(50);
            a.arrived.data[box] = 0;
            __threadfence();
        }
        __syncthreads();
        locals_to_children(a, box);
        __syncthreads();
        const int child = box >= parents && threadIdx.x < 8 ? a.children.data[8 * (size_t)box + threadIdx.x] : -1;
        if (child >= 0) {
            __threadfence();
            atomicExch(a.arrived.data + child, 1);
        }
    }
}

template <Step S, Quantity Q, class Word, class Arrays>
CUDA_CALLABLE inline void expansion_step(int thread, int threads, Word*, const Arrays& a) {
    const int block = thread / THREADS, leaf = a.leaves.data[0] + block;
    if constexpr (S == Step::UPWARD) upward_pass(a, block);
    else if constexpr (S == Step::DOWNWARD) downward_pass(a, block, threads);
    else if (leaf < a.leaves.data[1]) leaf_fields<Q>(a, leaf);
}
#else
template <Step S, Quantity Q, class Word, class Arrays>
void expansion_step(int, int threads, Word* team, const Arrays& a) {
    const int levels = a.counts.data[0], *const begin = a.level_begin.data;
    const auto for_range = [&](const int* run, auto work) {
        share_items(team, threads, run[1] - run[0], 4, [&](int i) { work(run[0] + i); });
    };
    const auto visit = [&](int height, auto work) { for_range(begin + height, work); };
    if constexpr (S == Step::UPWARD) {
        visit(0, [&](int leaf) { leaf_multipole(a, leaf); });
        for (int height = 1; height <= levels - 2; ++height)
            visit(height, [&](int box) { multipole_from_children(a, box); });
    } else if constexpr (S == Step::DOWNWARD) {
        for (int height = levels - 2; height > 0; --height) visit(height, [&](int box) { locals_to_children(a, box); });
    } else for_range(a.leaves.data, [&](int leaf) { leaf_fields<Q>(a, leaf); });
}
#endif
}
