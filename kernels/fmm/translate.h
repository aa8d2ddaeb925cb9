// Translation of multipoles to local expansions: what both devices share.
//
// A cell's far part comes from the children of its parent's neighbours that are not its own neighbours, at 189
// displacements d = source − target. Where a component of d changes its sign, the matrix T of a translation does so in
// rows and columns of odd parity only: T(σ|d|) = P T(|d|) P, P the diagonal of the harmonics' signs under σ. So those
// of one |d| are summed before they are translated. With σ the n = 1, 2, 4 or 8 signs that components of 1 and 2 have
// (those of 3 have one sign in an octant, and zeros none), the rows of parity class a are
//
//     L_a = Σ_k T(|d|)_ak u_p[k],    u_p[k] = Σ_σ χ_p(σ) χ_class(k)(σ) q_σ[k],
//
// χ the products of signs over the odd axes of a class, p those of a: 56 matrix products do the work of 189, on planes
// u of sources, which are Walsh-Hadamard transforms. An octant has the signs of octant 0, mirrored: its multipoles and
// its results take the signs of its mirror images.
//
// A class is a bit for each axis, 1 for x, 2 for y and 4 for z, set where a harmonic is odd.
#pragma once

namespace warpmag {

constexpr int MOST_SIGNS = 8;

// Magnitude |d| as 2 bits an axis, x the lowest: all from 0 to 63 with a component beyond 1.
CUDA_CALLABLE inline int next_magnitude(int code) {
    do ++code;
    while (code < 64 && !(code & 42));
    return code < 64 ? code : 64;
}

// Axes along which both signs of a displacement of that magnitude are translated, those of a component 1 or 2.
CUDA_CALLABLE inline int signed_axes(int code) {
    const int axes = (code ^ code >> 1) & 21;
    return (axes & 1) | (axes >> 1 & 2) | (axes >> 2 & 4);
}

CUDA_CALLABLE inline int signs_of(int axes) { return 1 << ((axes & 1) + (axes >> 1 & 1) + (axes >> 2 & 1)); }

// The bits of a class at some axes, one beside the other; and back.
CUDA_CALLABLE inline int extract_axes(int parity, int axes) {
    const int y = axes & 1, z = y + (axes >> 1 & 1);
    const int wanted = parity & axes;
    return (wanted & 1) | (wanted >> 1 & 1) << y | (wanted >> 2) << z;
}

CUDA_CALLABLE inline int deposit_axes(int bits, int axes) {
    const int y = axes & 1, z = y + (axes >> 1 & 1);
    return (bits & axes & 1) | ((bits >> y) << 1 & axes & 2) | ((bits >> z) << 2 & axes & 4);
}

// The cell at a displacement of magnitude ``code`` from a cell of an octant, against the octant's own signs along the
// axes ``flipped``; ``none`` where there is none.
template <class Arrays>
CUDA_CALLABLE inline int source_cell(const Arrays& arrays, int parent, int octant, int code, int flipped, int none) {
    if (parent < 0) return none;
    int near = 0, child = 0;
#pragma unroll
    for (int axis = 0, stride = 1; axis < 3; ++axis, stride *= 3) {
        const int own = octant >> axis & 1, length = code >> 2 * axis & 3;
        const int place = own + ((flipped >> axis & 1) == own ? length : -length);
        near += stride * ((place >> 1) + 1);
        child |= (place & 1) << axis;
    }
    const int neighbor = arrays.neighbors.data[27 * (size_t)parent + near];
    if (neighbor < 0) return none;
    const int cell = arrays.children.data[8 * (size_t)neighbor + child];
    return cell < 0 ? none : cell;
}

// Cells of one octant and level that are translated together: places in ``order``.
struct CellRun {
    int begin, end, octant;
};

// The index-th run of at most ``width`` cells; none beyond the last. Shape of octant_begin: [levels, 9].
CUDA_CALLABLE inline CellRun cell_run(const wp::array_t<int>& octant_begin, int width, int index) {
    for (int level = 0; level < (int)octant_begin.shape[0]; ++level) {
        const int* const begin = octant_begin.data + 9 * level;
        for (int octant = 0; octant < 8; ++octant) {
            const int count = begin[octant + 1] - begin[octant], runs = (count + width - 1) / width;
            if (index < runs) {
                const int first = begin[octant] + index * width, left = begin[octant + 1] - first;
                return {first, first + (left < width ? left : width), octant};
            }
            index -= runs;
        }
    }
    return {0, 0, 0};
}

// Sums of N values by all their signs.
template <int N, class V> CUDA_CALLABLE inline void transform_signs(V (&values)[N]) {
#pragma unroll
    for (int step = 1; step < N; step *= 2)
#pragma unroll
        for (int i = 0; i < N; ++i) {
            if (i & step) continue;
            const V a = values[i], b = values[i | step];
            values[i] = a + b;
            values[i | step] = a - b;
        }
}

}
