"""warpmag."""

import warp as wp

from bench.cases import RADIUS
from bench.peers import Evaluation
from warpmag.kernels.pairs.field import launch_field
from warpmag.kernels.pairs.work_list import launch_pair_loop, make_rows, partial_shape
from warpmag.packed import PackedMoments


def prepare(positions, moments, device):
    """See ``bench.peers``."""
    n = len(positions)
    x, m = (wp.array(a, dtype=wp.vec3, device=device) for a in (positions, moments))
    packed = PackedMoments(wp.full(n, 0.9 * RADIUS, dtype=wp.float32, device=device), largest_radius=0.9 * RADIUS)
    packed.pack(x, m)
    packed.find_overlaps()
    rows = make_rows([(0, n, 0, n)], device)
    partial = wp.empty(partial_shape(rows), dtype=wp.float32, device=device)
    base, h = wp.zeros_like(x), wp.zeros_like(x)

    def evaluate():
        launch_pair_loop(rows, packed.packed, packed.packed, partial)
        launch_field(rows, partial, packed, packed, True, base, h)

    evaluate()
    with wp.ScopedCapture(device) as capture:
        evaluate()
    return Evaluation(
        lambda: wp.capture_launch(capture.graph), lambda: wp.synchronize_device(device), lambda: h.numpy(), evaluate
    )
