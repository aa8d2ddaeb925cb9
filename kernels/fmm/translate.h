// Multipole-to-local translation (M2L): parts that both devices share.
//
// Sources of a box's far field are the children of its parent's neighbors that are not its own neighbors, at up to 189
// displacements d = source − target. A component of d that changes sign flips the translation matrix in rows and
// columns of odd parity only: T(σ|d|) = P T(|d|) P, with P the diagonal of the harmonics' signs under σ. Sources of
// equal |d| are therefore summed before they are translated. Let σ run over the 1, 2, 4 or 8 combinations of signs.
// Components 1 and 2 have both signs; a component 3 has one sign in an octant, and 0 has none. Then the rows of parity
// class a are
//
//     L_a = Σ_k T(|d|)_ak u_p[k],    u_p[k] = Σ_σ χ_p(σ) χ_class(k)(σ) q_σ[k],
//
// with χ the product of signs over the odd axes of a class, and p the signed axes of a. So 56 matrix products do the
// work of 189. The planes u are Walsh-Hadamard transforms of the sources. Other octants are mirror images of octant 0:
// their multipoles and results take the signs of that reflection.
//
// A parity class has one bit per axis, 1 for x, 2 for y and 4 for z, set where a harmonic is odd.
#pragma once

namespace warpmag {

constexpr int MOST_SIGNS = 8;

// Next magnitude |d| after ``code``, which has 2 bits per axis, x lowest. At least one component exceeds 1; 64 ends.
CUDA_CALLABLE inline int next_magnitude(int code) {
    do ++code;
    while (code < 64 && !(code & 42));
    return code < 64 ? code : 64;
}

// Axes whose component of |d| is 1 or 2, so that both signs occur.
CUDA_CALLABLE inline int signed_axes(int code) {
    const int axes = (code ^ code >> 1) & 21;
    return (axes & 1) | (axes >> 1 & 2) | (axes >> 2 & 4);
}

// Number of sign combinations along some axes.
CUDA_CALLABLE inline int signs_of(int axes) { return 1 << ((axes & 1) + (axes >> 1 & 1) + (axes >> 2 & 1)); }

// The bits of ``parity`` at ``axes``, packed together, and the inverse.
CUDA_CALLABLE inline int extract_axes(int parity, int axes) {
    const int y = axes & 1, z = y + (axes >> 1 & 1);
    const int bits = parity & axes;
    return (bits & 1) | (bits >> 1 & 1) << y | (bits >> 2) << z;
}

CUDA_CALLABLE inline int deposit_axes(int bits, int axes) {
    const int y = axes & 1, z = y + (axes >> 1 & 1);
    return (bits & axes & 1) | ((bits >> y) << 1 & axes & 2) | ((bits >> z) << 2 & axes & 4);
}

// Source box at a displacement of magnitude ``code`` from a box in an octant, or ``no_box``. The components of
// the displacement are positive in octant 0 and mirrored in other octants, and reversed along the axes ``flipped``.
template <class Arrays>
CUDA_CALLABLE inline int source_box(const Arrays& arrays, int parent, int octant, int code, int flipped, int no_box) {
    if (parent < 0) return no_box;
    int near = 0, child = 0;
#pragma unroll
    for (int axis = 0, stride = 1; axis < 3; ++axis, stride *= 3) {
        const int own = octant >> axis & 1, length = code >> 2 * axis & 3;
        const int position = own + ((flipped >> axis & 1) == own ? length : -length);
        near += stride * ((position >> 1) + 1);
        child |= (position & 1) << axis;
    }
    const int neighbor = arrays.neighbors.data[27 * (size_t)parent + near];
    if (neighbor < 0) return no_box;
    const int box = arrays.children.data[8 * (size_t)neighbor + child];
    return box < 0 ? no_box : box;
}

// Range in ``order`` of boxes of one octant and level that are translated together.
struct BoxRun {
    int begin, end, octant;
};

// The index-th run of at most ``width`` boxes; empty beyond the last run. Shape of octant_begin: [levels, 9].
CUDA_CALLABLE inline BoxRun box_run(const wp::array_t<int>& octant_begin, int width, int index) {
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

// Walsh-Hadamard transform of N values, in place.
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
