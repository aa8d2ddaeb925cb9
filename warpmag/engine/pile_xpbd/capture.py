"""Removes memory allocations from a substep, so that it can be a conditional node of a CUDA graph.

Such a node may contain kernels, copies and further conditional nodes, but no allocations. Newton allocates in two
places. Solvers make temporary arrays, here from the memory of a :class:`Workspace`. Collision sums counts with Warp's
``array_scan``, which allocates scratch memory; here a kernel without scratch memory replaces it.
"""

import contextlib
from collections import defaultdict
from collections.abc import Iterator

import warp as wp

from warpmag.kernels.shared.scan import launch_scan


class Workspace:
    """An allocator for Warp that reuses the memory of the first run of a step, so that a capture allocates nothing."""

    def __init__(self, device):
        """Make an empty workspace on ``device``, a CUDA device."""
        self._device = device
        self._blocks: list[wp.array] = []
        self._free: dict[int, list[int]] = defaultdict(list)

    def allocate(self, size_in_bytes: int) -> int:
        """Return a block of memory."""
        if self._free[size_in_bytes]:
            return self._free[size_in_bytes].pop()
        if self._device.is_capturing:
            raise RuntimeError(f"a captured step needs {size_in_bytes} bytes more than it needed when it ran")
        with wp.ScopedAllocator(self._device, None):
            block = wp.empty(size_in_bytes, dtype=wp.uint8, device=self._device)
        self._blocks.append(block)
        assert block.ptr is not None
        return block.ptr

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Take a block back."""
        self._free[size_in_bytes].append(ptr)


@contextlib.contextmanager
def without_allocations(device, workspace: Workspace | None) -> Iterator[None]:
    """Use ``workspace`` for temporary arrays on a CUDA device, and scan without scratch memory."""
    if not device.is_cuda:
        yield
        return
    original = wp.utils.array_scan

    def scan(values, sums, inclusive=True):
        plain = values.dtype is wp.int32 and values.is_contiguous and sums.is_contiguous
        (launch_scan if plain and values.device.is_cuda else original)(values, sums, inclusive)

    wp.utils.array_scan = scan
    try:
        with wp.ScopedAllocator(device, workspace):
            yield
    finally:
        wp.utils.array_scan = original
