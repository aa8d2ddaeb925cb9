"""Warp, the textbook loop: one thread a target."""

import warp as wp

from bench.peers import Evaluation


@wp.func
def dipole_field(r: wp.vec3, m: wp.vec3):
    """4π times the field of moment ``m`` at separation ``r``, zero at none."""
    d2 = wp.dot(r, r)
    h = wp.vec3()
    if d2 > 0.0:
        inv = 1.0 / wp.sqrt(d2)
        h = inv * inv * inv * (3.0 * wp.dot(r, m) * inv * inv * r - m)
    return h


@wp.kernel(enable_backward=False)
def sum_field(x: wp.array[wp.vec3], m: wp.array[wp.vec3], h_out: wp.array[wp.vec3]):
    """Field at each moment."""
    i = wp.tid()
    h = wp.vec3()
    for j in range(x.shape[0]):
        h += dipole_field(x[i] - x[j], m[j])
    h_out[i] = 0.07957747154594767 * h


def prepare(positions, moments, device):
    """See ``bench.peers``."""
    x, m = (wp.array(a, dtype=wp.vec3, device=device) for a in (positions, moments))
    return capture(sum_field, x.shape[0], [x, m], x, device, 256)


def capture(kernel, dim, inputs, like, device, block_dim):
    """An evaluation that launches a captured kernel."""
    h = wp.zeros_like(like)

    def launch():
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[h], device=device, block_dim=block_dim)

    launch()
    with wp.ScopedCapture(device) as graph:
        launch()
    return Evaluation(
        lambda: wp.capture_launch(graph.graph), lambda: wp.synchronize_device(device), lambda: h.numpy(), launch
    )
