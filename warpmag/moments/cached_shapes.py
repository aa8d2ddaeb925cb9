"""Cache of sampled shapes beside the kernels that Warp compiled."""

from pathlib import Path

import warp as wp

from warpmag.shapes.shape_cache import FOLDER, ShapeCache


def shape_cache() -> ShapeCache:
    """Return the cache of sampled shapes, beside the kernels that Warp compiled."""
    return ShapeCache(Path(wp.config.kernel_cache_dir) / FOLDER)
