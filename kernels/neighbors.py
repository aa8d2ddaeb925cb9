"""Overlapping pairs: found once per arrangement, corrected in every pass over the pairs.

The all-pairs loops clamp the dipole at contact. What an overlapping pair lacks is added here, from a short list of
neighbours per moment. A list that is full is no error: its target walks all its sources instead.

While the pairs are at hand, the volume that a ball shares with its neighbours is summed:
o_i = Σ_j |B_i ∩ B_j|/√(V_i V_j).
Uniformly magnetized balls carry a field energy of at most ½μ0 ∫‖Σ M_i‖², so the eigenvalues of the coupling lie above
1/3 − (1 + max o_i), which is −2/3 without overlap. From it the induction solver takes a step length that converges for
any arrangement.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pair_law import field_of, gradient_of, overlap_factors, overlap_fraction

CAPACITY = 32
"""Neighbours a list can hold before its target falls back to walking all its sources."""


@cache
def _find_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.kernel(module="unique", enable_backward=False)
    def find_neighbors(
        # inputs:
        grid: wp.uint64,
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        group: wp.array[int],
        largest_radius: dtype,
        same_set: int,
        # outputs:
        neighbor_out: wp.array2d[int],
        neighbor_count_out: wp.array[int],
        overlap_out: wp.array[dtype],
    ):
        i = wp.tid()
        x = vec3(targets[0, i], targets[1, i], targets[2, i])
        radius = targets[3, i]
        count = int(0)
        overlap = dtype(0.0)
        reach = radius + largest_radius
        if not (wp.length(x) < dtype(1.0e9) * reach):
            # not finite, or so far out that its cell index overflows: no neighbours
            neighbor_count_out[i] = 0
            overlap_out[i] = dtype(0.0)
            return
        point = wp.vec3(float(x[0]), float(x[1]), float(x[2]))
        query = wp.hash_grid_query(grid, point, float(reach), group[i])
        j = int(0)
        while wp.hash_grid_query_next(query, j):
            r = x - vec3(sources[0, j], sources[1, j], sources[2, j])
            d2 = wp.dot(r, r)
            s = radius + sources[3, j]
            if d2 < s * s and not (same_set == 1 and i == j):
                if count < wp.static(CAPACITY):
                    neighbor_out[i, count] = j
                count += 1
                if radius > dtype(0.0) and sources[3, j] > dtype(0.0):
                    overlap += overlap_fraction(wp.sqrt(d2), radius, sources[3, j])
        neighbor_count_out[i] = count
        overlap_out[i] = overlap

    return find_neighbors


def launch_find_neighbors(
    grid, targets, sources, group, largest_radius, same_set, neighbors, neighbor_counts, overlaps
):
    """List the sources that overlap each target.

    Args:
        grid: Hash grid built over the sources' positions, grouped.
        targets: Packed targets, shape [8, t].
        sources: Packed sources, shape [8, n].
        group: Group of each target; it sees sources of its own group only.
        largest_radius: Largest source radius [m].
        same_set: Whether targets and sources are the same moments, so that a moment is not its own neighbour.
        neighbors: Out, indices of overlapping sources, shape [t, CAPACITY].
        neighbor_counts: Out, how many there are, also beyond the capacity, shape [t].
        overlaps: Out, shared volume o_i [dimensionless], shape [t].
    """
    wp.launch(
        _find_kernel(targets.dtype),
        dim=targets.shape[1],
        inputs=[grid.id, targets, sources, group, targets.dtype(largest_radius), int(same_set)],
        outputs=[neighbors, neighbor_counts, overlaps],
        device=targets.device,
    )


@cache
def pair_correction(dtype, gradient: bool, exclude_body: bool):
    """Warp function that corrects one target's sums for its overlapping sources within a range.

    It returns 4π times the field [A/m] and, with ``gradient``, the gradient [A/m²], as a vector of 3 or 9.
    """
    vec3 = wp.types.vector(3, dtype)
    width = 9 if gradient else 3
    sums = wp.types.vector(width, dtype)

    @wp.func
    def one_pair(targets: wp.array2d[dtype], sources: wp.array2d[dtype], i: int, j: int):
        total = sums()
        r = vec3(targets[0, i] - sources[0, j], targets[1, i] - sources[1, j], targets[2, i] - sources[2, j])
        d2 = wp.dot(r, r)
        s = targets[3, i] + sources[3, j]
        left_out = False
        if wp.static(exclude_body):
            left_out = targets[7, i] == sources[7, j]
        if d2 < s * s and not left_out:
            m = vec3(sources[4, j], sources[5, j], sources[6, j])
            g = overlap_factors(d2, targets[3, i], sources[3, j])
            h = field_of(g, r, m)
            for c in range(3):
                total[c] = h[c]
            if wp.static(gradient):
                t = gradient_of(g, r, m)
                for c in range(6):
                    total[3 + c] = t[c]
        return total

    @wp.func
    def correct_pairs(
        targets: wp.array2d[dtype],
        sources: wp.array2d[dtype],
        i: int,
        begin: int,
        end: int,
        skip: int,
        neighbor: wp.array2d[int],
        neighbor_count: wp.array[int],
    ):
        total = sums()
        count = neighbor_count[i]
        if count <= wp.static(CAPACITY):
            for n in range(count):
                j = neighbor[i, n]
                if j >= begin and j < end:
                    total += one_pair(targets, sources, i, j)
        else:
            for j in range(begin, end):
                if j != skip:
                    total += one_pair(targets, sources, i, j)
        return total

    return correct_pairs
