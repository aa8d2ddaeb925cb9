"""warpmag."""

import warp as wp

from bench.cases import RADIUS
from bench.peers import Evaluation
from warpmag.kernels.pairs.evaluate import PairEvaluation
from warpmag.kernels.pairs.packing import PackedMoments
from warpmag.kernels.pairs.pair_terms import Quantity


def prepare(positions, moments, device):
    """See ``bench.peers``."""
    n = len(positions)
    x, m = (wp.array(a, dtype=wp.vec3, device=device) for a in (positions, moments))
    packed = PackedMoments(wp.full(n, 0.9 * RADIUS, dtype=wp.float32, device=device), largest_radius=0.9 * RADIUS)
    packed.pack(x, m)
    packed.find_overlaps()
    h = wp.zeros_like(x)
    evaluate = PairEvaluation(Quantity.FIELD, [(0, n, 0, n)], packed, packed, wp.zeros_like(x), h).launch
    evaluate()
    with wp.ScopedCapture(device) as capture:
        evaluate()
    return Evaluation(
        lambda: wp.capture_launch(capture.graph), lambda: wp.synchronize_device(device), lambda: h.numpy(), evaluate
    )
