"""Fields at points, besides sums over pairs: external field, flux density inside balls, gradients as matrices."""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.packing import PackedMoments, ball_volume
from warpmag.kernels.pairs.wrench import MU0


@cache
def _flux_density_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.func
    def magnetization_at(x: vec3, j: int, packed: wp.array2d[dtype]):
        """Magnetization [A/m] of source ``j`` at a point; zero outside its ball."""
        m = vec3()
        if wp.length(x - vec3(packed[0, j], packed[1, j], packed[2, j])) < packed[3, j]:
            m = vec3(packed[4, j], packed[5, j], packed[6, j]) / ball_volume(packed[3, j])
        return m

    @wp.kernel(module="unique", enable_backward=False)
    def flux_density(
        points: wp.array[vec3],
        sources: wp.array2d[dtype],
        source_count: int,
        worlds: wp.array[int],
        source_worlds: wp.array[int],
        overlaps: wp.array2d[int],
        overlap_counts: wp.array[int],
        h: wp.array[vec3],
        b_out: wp.array[vec3],
    ):
        i = wp.tid()
        total = h[i]
        count = overlap_counts[i]
        if count <= wp.static(CAPACITY):
            for k in range(count):
                total += magnetization_at(points[i], overlaps[i, k], sources)
        else:  # the list is full: visit all sources
            for j in range(source_count):
                if source_worlds[j] == worlds[i]:
                    total += magnetization_at(points[i], j, sources)
        b_out[i] = dtype(wp.static(MU0)) * total  # B = μ0 (H + M)

    return flux_density


def launch_flux_density(points, targets: PackedMoments, sources: PackedMoments, h, b):
    """Write B = μ0 (H + M) [T] at points [m], with M the sum of the magnetizations of the balls that contain a point.

    ``targets`` are the points packed as balls of radius zero, with overlaps listed; ``h`` is the field there [A/m].
    """
    inputs = [points, sources.packed, sources.count, targets.groups, sources.groups]
    inputs += [targets.overlaps, targets.overlap_counts, h]
    wp.launch(_flux_density_kernel(targets.dtype), targets.count, inputs=inputs, outputs=[b], device=targets.device)


@cache
def _world_field_kernel(vec3):
    @wp.kernel(module="unique", enable_backward=False)
    def field_of_worlds(external_field: wp.array[vec3], first: wp.array[int], base_out: wp.array[vec3]):
        i = wp.tid()
        base_out[i] = external_field[first[i]]

    return field_of_worlds


def launch_field_of_worlds(external_field, first, base):
    """Write the external field [A/m] at points, shape [p]: its value at ``first``, the index of a moment in each
    point's world.
    """
    inputs = [external_field, first]
    wp.launch(_world_field_kernel(base.dtype), len(base), inputs=inputs, outputs=[base], device=base.device)


@cache
def _gradient_kernel(vec3, mat33):
    @wp.kernel(module="unique", enable_backward=False)
    def store_gradients(
        along_x: wp.array[vec3], along_y: wp.array[vec3], along_z: wp.array[vec3], gradients_out: wp.array[mat33]
    ):
        i = wp.tid()
        gradients_out[i] = wp.matrix_from_cols(along_x[i], along_y[i], along_z[i])

    return store_gradients


def launch_store_gradients(along, gradients):
    """Write gradients [A/m²], matrices of shape [p], from the derivatives of H along x, y and z, vectors."""
    kernel, device = _gradient_kernel(along[0].dtype, gradients.dtype), gradients.device
    wp.launch(kernel, dim=len(gradients), inputs=along, outputs=[gradients], device=device)
